"""Host of a process: clock, files, logs, other processes, terminals."""
