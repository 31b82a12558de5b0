"""Whole runs over the faulty bus: what a seed makes of one, and the laws that hold for all.

``python -m tests.faults.fault_schedules SEED`` repeats one with all that happened on the way.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from random import Random

from master_node.coupling.coupled_system import resolve
from master_node.hosts.opening import claim_slave, claimed_slaves, describe
from master_node.hosts.presence import Presence
from master_node.observing.observers import Attempt, RunEnd, RunStart
from master_node.running.co_simulation import CoSimulation
from master_node.slaves.group import SlaveGroup
from master_node.slaves.remote import RemoteSlave
from master_node.slaves.request_bounds import RequestBounds
from master_node.system.system import System
from protocol.bus.bus import Bus
from protocol.calls import Call, Reply
from protocol.description import SlaveDescription
from protocol.errors import DoublestepError, SlaveCrashedError
from protocol.wire.keys import ABORT, CLAIM, EXECUTE, RELEASE, STATUS, SlaveKey, alive_master
from protocol.wire.records import decode_map, encode_map
from slave_node.serving.node import SlaveNode
from tests.support.faulty_bus import NO_FAULTS, Faults, FaultyBus, Network
from tests.support.light_slaves import COUPLINGS, LightWorker, system_of_light_slaves
from tests.support.virtual_clock import VirtualClock

SYSTEM = System(
    **system_of_light_slaves(stop_time=0.4, initial_step_size=0.02, largest_step_size=0.02, order=1)
)
SHORT = SYSTEM.with_simulation(stop_time=0.08)
"""A run behind the disturbed one, which shows that the slaves are as good as new."""
STEP_TIMEOUT = 3.0
ORPHAN_TIME = 5.0
DISCOVERY_TIME = 5.0
RECONNECT_TIME = 4.0
REQUEST_TIME = 30.0
"""No request takes longer than this, repetitions included [s]."""
RUN_TIME = 1000.0
"""No run does; claims are allowed 90 s each [s]."""
FREE_TIME = RECONNECT_TIME + 2.0 * ORPHAN_TIME + 60.0
"""Then every slave is free again, whatever became of its master [s]."""


class BrokenLawError(AssertionError):
    """A law of the schedules was broken."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one schedule.

    Attributes:
        what: ``same bits``, or the class of the error.
        error: as text.
        time: that the run took [s], virtual.
        longest_request: [s], virtual.
    """

    what: str
    error: str
    time: float
    longest_request: float


class _Bits:
    """An observer that keeps what a run computed, to the last bit."""

    def __init__(self) -> None:
        self.bits: list[bytes] = []

    def started(self, start: RunStart) -> None:
        self.bits.append(start.outputs.tobytes())

    def attempted(self, attempt: Attempt) -> None:
        self.bits.append(repr(attempt[:7]).encode())
        self.bits += [
            repr(point.time).encode() + point.outputs.tobytes() for point in attempt.points
        ]

    def ended(self, end: RunEnd) -> None:
        self.bits.append(str(end.outcome).encode())


@dataclass
class _TimedLink:
    """A link that knows how long its requests took."""

    link: RemoteSlave
    clock: VirtualClock
    longest: float = 0.0
    _begin: float = 0.0

    def start(self, calls: Sequence[Call]) -> None:
        self._begin = self.clock.monotonic()
        self.link.start(calls)

    def finish(self) -> Reply:
        try:
            return self.link.finish()
        finally:
            self.longest = max(self.longest, self.clock.monotonic() - self._begin)


class _SlowWorker(LightWorker):
    """Takes virtual time, sometimes much of it, and sometimes crashes."""

    def __init__(self, name: str, clock: VirtualClock, random: Random) -> None:
        super().__init__(name)
        self._clock = clock
        self._random = random
        self.slow = 0.0
        self.crash = 0.0

    def execute(self, program: bytes) -> bytes:
        """See `Worker`."""
        is_slow = self.slow and self._random.random() < self.slow
        holder = self._executor
        self._clock.sleep(self._random.uniform(0.0, 2.0 * STEP_TIMEOUT if is_slow else 2e-3))
        if self.crash and self._random.random() < self.crash:
            self.kill()
        if self._executor is not holder:  # killed in the middle of it
            raise SlaveCrashedError("the process that held the model died by SIGKILL")
        return super().execute(program)

    def start(self) -> SlaveDescription:
        """See `Worker`."""
        self._clock.sleep(self._random.uniform(0.0, 0.5))
        return super().start()


def faults_of(random: Random) -> Faults:
    """Some of everything: from a network that is hardly disturbed to one that is hardly there."""
    badness = 10.0 ** random.uniform(-2.5, 0.0)

    def some(most: float) -> float:
        return random.choice((0.0, most * badness * random.random()))

    return Faults(
        latency=10.0 ** random.uniform(-4.0, -2.0),
        late=some(0.5),
        lateness=random.choice((0.05, 0.5, 5.0)),
        lost=some(0.1),
        doubled=some(1.0),
        cuts=some(2.0),
        cut_time=random.choice((0.02, 0.2, 2.0, 20.0)),
        blinks=some(4.0),
        blink_time=random.choice((0.01, 0.3, 3.0)),
        deaths=some(0.5),
    )


@dataclass
class _Schedule:
    seed: int
    random: Random = field(init=False)
    clock: VirtualClock = field(init=False)
    network: Network = field(init=False)
    workers: dict[str, _SlowWorker] = field(default_factory=dict)
    buses: dict[str, FaultyBus] = field(default_factory=dict)
    longest: float = 0.0
    are_launched: bool = field(init=False)

    def __post_init__(self) -> None:
        self.random = Random(self.seed)
        self.clock = VirtualClock()
        self.network = Network(self.clock, self.random, NO_FAULTS)
        self.are_launched = self.random.random() < 0.5

    def run(self) -> Outcome:
        """All of it; raises `BrokenLawError`."""
        try:
            return self.clock.run(self._whole, limit=RUN_TIME + 10.0 * FREE_TIME)
        finally:
            self.clock.close()

    def _whole(self) -> Outcome:
        faults = faults_of(self.random)
        self._serve()
        self.network.faults = faults
        for worker in self.workers.values():
            worker.slow = self.random.choice((0.0, 0.0, 0.02))
            worker.crash = self.random.choice((0.0, 0.0, 0.0, 0.01))
        self.clock.start(self.network.misfortune)
        if self.random.random() < 0.5:
            self.clock.start(self._intrude)
        begin = self.clock.monotonic()
        bits, error = self._simulate("master", "run-1")
        taken = self.clock.monotonic() - begin
        self._check(bits, error, taken)
        self.network.heal()
        for worker in self.workers.values():
            worker.slow = worker.crash = 0.0
        self._check_that_all_is_well()
        return Outcome(
            "same bits" if error is None else type(error).__name__,
            "" if error is None else str(error),
            taken,
            self.longest,
        )

    def _serve(self) -> None:
        for name in COUPLINGS:
            worker = self.workers[name] = _SlowWorker(name, self.clock, self.random)
            bus = self.buses[name] = self.network.join(name)
            key = SlaveKey(name, "0123abcd")
            node = SlaveNode(bus, worker, key, worker.start(), ORPHAN_TIME, clock=self.clock)
            self.clock.start(node.serve)

    def _simulate(
        self, name: str, run: str, system: System = SYSTEM
    ) -> tuple[list[bytes], DoublestepError | None]:
        """A whole run of a master that joins the bus for it."""
        bus, observer = self.network.join(name), _Bits()
        try:
            bus.announce(alive_master(run))
            presence = Presence(bus, self.clock)
            keys = presence.wait(
                list(COUPLINGS),
                {},
                (),
                discovery_timeout=DISCOVERY_TIME,
                load_timeout=DISCOVERY_TIME,
            )
            claim = partial(
                claim_slave,
                bus,
                run=run,
                bounds=RequestBounds(STEP_TIMEOUT, STEP_TIMEOUT, STEP_TIMEOUT),
                reconnect_time=RECONNECT_TIME,
                clock=self.clock,
            )
            with claimed_slaves(
                claim, presence, keys, self._why_ended, reconnect_time=RECONNECT_TIME
            ) as remotes:
                links = {n: _TimedLink(remote, self.clock) for n, remote in remotes.items()}
                try:
                    coupled = resolve(system, describe(links))
                    CoSimulation(SlaveGroup(links), coupled, system, observer).run()
                finally:
                    self.longest = max(self.longest, *(link.longest for link in links.values()))
        except DoublestepError as error:
            return observer.bits, error
        finally:
            bus.close()
        return observer.bits, None

    def _why_ended(self, remote: RemoteSlave) -> str:
        """Known of a slave that was launched, never of one elsewhere."""
        is_known = self.are_launched and not self.buses[remote.key.name].is_alive
        return "its process died" if is_known else ""

    def _check(self, bits: list[bytes], error: DoublestepError | None, taken: float) -> None:
        if taken > RUN_TIME:
            raise BrokenLawError(f"it took {taken:g} s")
        if self.longest > REQUEST_TIME:
            raise BrokenLawError(f"a request took {self.longest:g} s")
        if error is None:
            if bits != undisturbed():
                raise BrokenLawError("the run was completed with other bits than undisturbed")
            return
        if bits[:-1] != undisturbed()[: len(bits[:-1])]:
            raise BrokenLawError(f"before {error} there were other bits than undisturbed")
        if not (error.slave and error.phase and error.cause):
            raise BrokenLawError(f"no slave, phase and cause in {error!r}: {error}")

    def _check_that_all_is_well(self) -> None:
        """Once nothing disturbs any more, every living slave comes free and is as good as new."""
        self.clock.sleep(FREE_TIME)
        living = [name for name, bus in self.buses.items() if bus.is_alive]
        bus = self.network.join("visitor")
        for name in living:
            key = SlaveKey(name, "0123abcd")
            status = decode_map(bus.caller(key.verb(STATUS), 10.0).request(b""))
            if status["state"] != "free":
                raise BrokenLawError(f"{name} is never free again: {status}")
        if len(living) == len(self.buses):
            bits, error = self._simulate("second master", "run-2", SHORT)
            if error is not None:
                raise BrokenLawError(f"another run on the same slaves fails: {error}")
            if bits != undisturbed(short=True):
                raise BrokenLawError("another run on the same slaves gives other bits")

    def _intrude(self) -> None:
        """A task: somebody who asks for what is not his."""
        bus: Bus = self.network.join("intruder")
        while self.network.faults is not NO_FAULTS:
            self.clock.sleep(self.random.expovariate(10.0))
            key = SlaveKey(self.random.choice(list(COUPLINGS)), "0123abcd")
            verb = self.random.choice((CLAIM, RELEASE, ABORT, EXECUTE, STATUS, "do_step", "reset"))
            message: Mapping[str, str | int] = {"epoch": self.random.choice((0, 7, 99))}
            if verb == CLAIM:
                message = {"run": "intruder", "host": "elsewhere", "pid": 1}
            try:
                bus.caller(key.verb(verb), 1.0).request(encode_map(message))
            except DoublestepError:
                continue


@cache
def undisturbed(*, short: bool = False) -> list[bytes]:
    """The bits of a run over a network without faults."""
    system = SHORT if short else SYSTEM
    schedule = _Schedule(0)
    try:
        schedule.clock.run(schedule._serve, limit=10.0)
        bits, error = schedule.clock.run(
            lambda: schedule._simulate("master", "run-0", system), limit=100.0
        )
    finally:
        schedule.clock.close()
    if error is not None:
        raise error
    return bits


def run_schedule(seed: int) -> Outcome:
    """Run one schedule.

    Raises:
        BrokenLawError, TimeIsUpError, DeadlockError: a law did not hold; a note says with which
            seed and how to repeat it.
    """
    try:
        return _Schedule(seed).run()
    except BaseException as error:
        error.add_note(f"seed {seed}: python -m tests.faults.fault_schedules {seed}")
        raise


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s")
    print(run_schedule(int(sys.argv[1])))  # noqa: T201
