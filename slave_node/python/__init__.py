"""Python models as slaves."""
