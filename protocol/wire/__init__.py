"""Messages: keys, records and programs of calls as bytes."""
