"""Where slaves run: started, found on the bus, started by agents, started again."""
