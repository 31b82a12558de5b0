"""System files: what is to be simulated, and with which settings."""
