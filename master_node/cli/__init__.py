"""The ``master-node`` command, one module for each group of commands."""
