"""Communication steps split into shorter ones, with inputs that follow polynomials."""
