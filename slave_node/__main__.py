"""``python -m slave_node`` is the ``slave-node`` command."""

from slave_node.cli import main

if __name__ == "__main__":
    main()
