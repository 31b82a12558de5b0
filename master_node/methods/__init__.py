"""Methods: one communication step is taken, judged and followed by the next."""
