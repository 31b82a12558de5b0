"""Saved states of slaves whose models cannot, or shall not, save them themselves."""
