"""Commands ``import`` and ``export``: packages in the format SSP."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from master_node.cli.options import PackageBus
from protocol.host.interruption import interruptible
from protocol.host.terminal import say

log = logging.getLogger("master_node")


def import_(
    package: Annotated[
        Path,
        typer.Argument(
            metavar="SYSTEM.ssp", help="A package, PACKAGE.ssp#VARIANT.ssd, or an .ssd file."
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="System file [default: SYSTEM.toml].")
    ] = None,
    package_bus: PackageBus = False,
) -> None:
    """Write an SSP as SYSTEM.toml, with its FMUs in a folder SYSTEM_models beside it."""
    from master_node.system.files import import_system

    path = output or package.with_name(f"{package.stem.replace('.ssp#', '_')}.toml")
    with interruptible():
        for note in import_system(package, path, package_bus=package_bus):
            log.warning("%s", note)
    say(path)


def export(
    system_file: Annotated[
        Path, typer.Argument(metavar="SYSTEM.toml", help="A system whose slaves are FMUs.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Package [default: SYSTEM.ssp].")
    ] = None,
) -> None:
    """Write a system and its FMUs as an SSP package."""
    from master_node.system.files import export_system

    path = output or system_file.with_suffix(".ssp")
    with interruptible():
        export_system(system_file, path)
    say(path)
