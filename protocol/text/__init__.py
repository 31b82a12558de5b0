"""Text that people read: names, limits, and what is printable."""
