"""From instantiated slaves to initialized ones: configuration, trial steps, T_0."""
