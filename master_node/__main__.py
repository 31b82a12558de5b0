"""``python -m master_node`` is the ``master-node`` command."""

from master_node.cli import main

if __name__ == "__main__":
    main()
