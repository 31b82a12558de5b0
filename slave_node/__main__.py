"""The ``slave-node`` command, also as ``python -m slave_node``. Imports as little as can be."""

from protocol.host.command_start import run_command


def main() -> None:
    """Entry point."""
    run_command("slave-node", "slave_node.cli.app")


if __name__ == "__main__":
    main()
