"""A slave as its master sees it: in process or remote, recorded and restorable."""
