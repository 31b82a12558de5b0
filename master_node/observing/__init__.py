"""Observers of a run: progress, metrics, warnings."""
