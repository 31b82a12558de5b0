"""Protocol of master and slave: calls, signals, errors, wire format, keys and the bus."""
