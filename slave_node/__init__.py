"""One co-simulation slave, one process: serves an FMU or a Python model on the bus."""
