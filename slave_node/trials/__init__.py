"""Trial steps of a slave: what each kind of them shows."""
