"""Steps of slaves as requests: single, double and iterated ones."""
