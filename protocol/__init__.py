"""What master and slave must agree on: calls, signals, errors, wire format, keys and the bus."""
