"""One run of a coupled system, from instantiated slaves to terminated ones."""
