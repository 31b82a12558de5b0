"""What a process needs of its host: clock, files, logs, other processes, terminals."""
