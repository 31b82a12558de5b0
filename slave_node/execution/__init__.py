"""Calls executed on a slave in the order that FMI allows, with its saved states."""
