"""The ``master-node`` command, also as ``python -m master_node``. Imports as little as can be."""

from protocol.host.command_start import run_command


def main() -> None:
    """Entry point."""
    run_command("master-node", "master_node.cli.app")


if __name__ == "__main__":
    main()
