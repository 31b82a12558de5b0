"""Errors and defects of a step, and the order and step size that follow from them."""
