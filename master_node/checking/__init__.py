"""Check of a system whose slaves are initialized and take no step (docs/checking.md)."""
