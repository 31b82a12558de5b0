"""Three hosts, and all that happens to them at once: nothing of a run is lost."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from master_node import Result, load_system, simulate
from protocol.wire.agents import CHUNK_BYTES
from tests.faults.test_network import Commands, hosts, start
from tests.faults.test_processes import has_stepped, worker_of
from tests.slave_node.agent.test_agents import long_wheel, slave_processes, system_file
from tests.support.network_namespaces import Hosts
from tests.support.waiting import wait_until

__all__ = ["hosts", "long_wheel", "start"]

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="uses signals"),
    pytest.mark.usefixtures("no_process_left"),
    pytest.mark.slow,
]

SIMULATION = "stop_time = 2.5\nlargest_step_size = 1e-3\n"
"""So many steps that a run takes much longer than what happens to it at its beginning."""

CUT = 2.0
"""Time for which the cable is pulled [s]."""


def steps_on_disk(directory: Path) -> int:
    """Number of attempts in the results directory."""
    return len(Result.load(directory).steps)


def test_an_upload_a_cut_and_killed_slaves_change_nothing(
    start: Commands, hosts: Hosts, tmp_path: Path, fmu_dir: Path, long_wheel: Path
) -> None:
    """The quarter car through a router, with an agent on either side of it.

    One agent lacks the FMU, which is sent to it in pieces. Its host's cable is pulled for 2 s in
    mid run; then the node of its slave is killed, and the worker of the other one. Each gets its
    warning, nothing is left running, and the files are those of a run in process, byte for byte.
    """
    where = f"tcp/{hosts.addresses['router']}:7447"
    through = ("--connect", where, "--mode", "client", "--insecure")
    start("slave_node", "router", "--listen", where, "--insecure", on=hosts.prefix("router"))
    (tmp_path / "empty").mkdir()
    near = start(
        *("slave_node", "agent", "--name", "near", "--models", fmu_dir, *through),
        on=hosts.prefix("master"),
    )
    far = start(
        *("slave_node", "agent", "--name", "far", "--label", "side=far", "--allow-upload"),
        *("--models", tmp_path / "empty", "--cache", tmp_path / "cache", *through),
        on=hosts.prefix("slave"),
    )
    for agent in (near, far):
        agent.wait_for("ready")
    file = system_file(
        tmp_path,
        {"model": fmu_dir / "chassis.fmu", "host": "near"},
        {"model": long_wheel, "requires": {"side": "far"}},
        simulation=SIMULATION,
    )
    out = tmp_path / "out"
    master = start(
        *("master_node", "run", file, "--output", out, "--no-plot", *through),
        on=hosts.prefix("master"),
    )
    wait_until(lambda: has_stepped(out))
    size = long_wheel.stat().st_size
    assert size > 2 * CHUNK_BYTES
    assert [path.stat().st_size for path in (tmp_path / "cache").glob("*.fmu")] == [size]

    hosts.cut("slave")
    time.sleep(CUT)
    before = steps_on_disk(out)
    hosts.heal("slave")
    wait_until(lambda: steps_on_disk(out) > before)

    slave_processes(far)["wheel"].kill()
    master.wait_for("started again and restored")
    worker_of(slave_processes(near)["chassis"]).kill()
    master.wait_for("started again and restored")
    assert Result.load(out).summary == {}, "all of it happened in mid run"
    assert master.wait() == 0, master.text

    warnings = [line for line in master.text.splitlines() if "WARNING: " in line]
    restored = [line for line in warnings if "started again and restored" in line]
    assert [line.partition("WARNING: ")[2].partition(":")[0] for line in restored] == [
        "wheel",
        "chassis",
    ]
    others = [line for line in warnings if line not in restored]
    assert all("the connection to wheel was lost" in line for line in others), master.text
    assert Result.load(out).summary["restarts"] == {"chassis": 1, "wheel": 1}
    for agent in (near, far):
        wait_until(lambda agent=agent: not slave_processes(agent))
        agent.send(signal.SIGTERM)
        assert agent.wait() == 0, agent.text

    models = {"chassis": {"model": fmu_dir / "chassis.fmu"}, "wheel": {"model": long_wheel}}
    undisturbed = load_system(system_file(tmp_path, **models, simulation=SIMULATION))
    simulate(undisturbed, output=tmp_path / "undisturbed", in_process=True)
    for name in ("results.csv", "steps.csv"):
        assert (out / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes()
