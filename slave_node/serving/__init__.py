"""A slave on the bus: claims, health, metrics, and masters that vanish."""
