"""Participants on the bus, listed and diagnosed."""
