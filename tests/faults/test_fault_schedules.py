"""Whole runs over a faulty bus in virtual time: the same bits, or a named failure in bounded time.

All 10 000 schedules: ``python -m benchmarks fault_schedules``. One of them with all that happened:
``python -m tests.faults.fault_schedules SEED``.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from random import Random

import pytest

from master_node.slaves.remote import RemoteSlave
from protocol.errors import DeadlineError, SlaveLostError
from slave_node.serving.claims import Claims
from slave_node.serving.node import SlaveNode
from tests.faults.fault_schedules import BrokenLawError, run_schedule
from tests.support.faulty_bus import NO_FAULTS, Faults, Network
from tests.support.virtual_clock import DeadlockError, TimeIsUpError, VirtualClock

SCHEDULES = 300
ENOUGH = 300
"""Within so many schedules a planted defect must be found."""


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """The slaves tell of all that happens to them."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


# ---- The laws ----------------------------------------------------------------------------------


@pytest.mark.parametrize("schedules", [30, pytest.param(SCHEDULES, marks=pytest.mark.slow)])
def test_a_disturbed_run_has_the_same_bits_or_a_named_failure(schedules: int) -> None:
    """Law: whatever the bus does; and afterwards the slaves serve another master as if new."""
    outcomes = Counter(run_schedule(seed).what for seed in range(schedules))
    # The schedules must be neither harmless nor hopeless.
    assert schedules // 5 < outcomes["same bits"] < 4 * schedules // 5, outcomes
    for what in ("SlaveLostError", "DeadlineError", "SlaveCrashedError"):
        assert outcomes[what] > schedules // 50, outcomes


def test_a_schedule_follows_from_its_seed() -> None:
    """A seed gives one outcome to the last digit of its time, so a number repeats a find."""
    for seed in range(8):
        first, second = run_schedule(seed), run_schedule(seed)
        assert replace(first, error="") == replace(second, error="")  # it names wall-clock times


# ---- Defects that the schedules must find -------------------------------------------------------


def find() -> BaseException:
    """Error of the first schedule that finds something; it names its seed."""
    for seed in range(ENOUGH):
        try:
            run_schedule(seed)
        except Exception as error:
            found = error
            break
    else:
        raise AssertionError("nothing was found")
    assert found.__notes__ == [f"seed {seed}: python -m tests.faults.fault_schedules {seed}"]
    return found


def test_a_repetition_that_is_executed_again_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the stored reply a repeated request steps twice."""

    def careless(self: Claims, epoch: int, sequence: int) -> bytes | None:
        self.check(epoch)
        return None

    monkeypatch.setattr(Claims, "admit", careless)
    assert isinstance(find(), BrokenLawError)


def test_a_stale_reply_that_is_given_out_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reply to another request than the one that was asked is a silent difference."""

    def careless(self: Claims, epoch: int, sequence: int) -> bytes | None:
        self.check(epoch)
        return self._reply if sequence <= self._sequence else None

    def record(self: Claims, sequence: int, reply: bytes) -> None:
        self._sequence = sequence + (sequence % 7 == 0)  # now and then the next one counts as done
        self._reply = reply

    monkeypatch.setattr(Claims, "admit", careless)
    monkeypatch.setattr(Claims, "record", record)
    assert isinstance(find(), AssertionError)


def test_a_slave_that_keeps_a_vanished_master_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Never free again: no other master could use it."""
    monkeypatch.setattr(SlaveNode, "_free_orphan", lambda *_: None)
    assert "is never free again" in str(find())


def test_a_slave_that_is_not_reset_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leftovers of one run would be in the next one."""
    monkeypatch.setattr(SlaveNode, "_renew", lambda *_: None)
    monkeypatch.setattr(SlaveNode, "_reset", lambda *_: None)
    assert "another run on the same slaves" in str(find())


def test_a_master_that_asks_for_ever_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wait without a bound ends the schedule, not the patience of who looks."""

    def patient(self: RemoteSlave) -> bytes:
        while True:
            try:
                return self._new_caller().request(self._payload)
            except (SlaveLostError, DeadlineError):
                self._bus.alive("*", 1.0)

    monkeypatch.setattr(RemoteSlave, "_ask_again", patient)
    assert isinstance(find(), TimeIsUpError | BrokenLawError)


# ---- The bus and its clock ----------------------------------------------------------------------


def test_time_passes_only_while_all_wait() -> None:
    """Sleeps overlap, and end in the order of their times."""
    clock, heard = VirtualClock(), []

    def sleep(seconds: float) -> None:
        clock.sleep(seconds)
        heard.append(clock.monotonic())

    def main() -> None:
        for seconds in (3.0, 1.0, 2.0):
            clock.start(lambda seconds=seconds: sleep(seconds))  # type: ignore[misc]
        clock.sleep(10.0)

    clock.run(main, limit=20.0)
    assert heard == [1.0, 2.0, 3.0]
    assert clock.monotonic() == 10.0


def test_waits_that_never_end_are_told() -> None:
    """Everybody waits: an error at once; time goes on and on: an error at the limit."""
    clock = VirtualClock()
    with pytest.raises(DeadlockError):
        clock.run(lambda: clock.condition().wait(), limit=1.0)
    clock.close()
    with pytest.raises(TimeIsUpError):
        clock.run(lambda: clock.sleep(2.0), limit=1.0)
    clock.close()


def test_a_lock_is_held_by_one_task_at_a_time_in_order() -> None:
    """Also while its holder waits for something else."""
    clock, inside = VirtualClock(), []
    lock = clock.lock()

    def work(name: str) -> None:
        with lock:
            assert lock.locked()
            inside.append(f"{name} in")
            clock.sleep(1.0)
            inside.append(f"{name} out")

    def main() -> None:
        for name in "abc":
            clock.start(lambda name=name: work(name))  # type: ignore[misc]
        clock.sleep(10.0)

    clock.run(main, limit=20.0)
    assert inside == [f"{name} {what}" for name in "abc" for what in ("in", "out")]
    assert not lock.locked()


def replies_over(faults: Faults, seed: int) -> tuple[list[int], list[object], float]:
    """50 requests: what the handler heard, what came back, and when all was over."""
    clock = VirtualClock()
    network = Network(clock, Random(seed), NO_FAULTS)
    server, client = network.join("server"), network.join("client")
    heard: list[int] = []

    def handle(data: bytes) -> bytes:
        heard.append(data[0])
        return data

    def main() -> list[object]:
        server.serve("a/echo", handle)
        network.faults = faults
        clock.start(network.misfortune)
        pending = [client.caller("a/echo", 2.0).send(bytes([i])) for i in range(50)]
        outcomes: list[object] = []
        for reply in pending:
            try:
                outcomes.append(reply.result()[0])
            except (SlaveLostError, DeadlineError) as error:
                outcomes.append(type(error))
        return outcomes

    try:
        return heard, clock.run(main, limit=10.0), clock.monotonic()
    finally:
        clock.close()


def test_without_faults_it_is_a_bus() -> None:
    """Every request is answered with its own reply."""
    heard, outcomes, taken = replies_over(NO_FAULTS, 1)
    assert sorted(heard) == outcomes == list(range(50))
    assert taken < 0.1


@pytest.mark.parametrize(
    ("faults", "symptom"),
    [
        (Faults(lost=0.2), "lost"),
        (Faults(doubled=0.3), "doubled"),
        (Faults(late=0.3, lateness=1.0), "overtaken"),
        (Faults(latency=0.1, cuts=20.0, cut_time=5.0), "cut"),
        (Faults(latency=0.1, deaths=20.0), "dead"),
    ],
)
def test_each_fault_shows(faults: Faults, symptom: str) -> None:
    """The faults happen; a reply that comes is the right one, and none is waited for too long."""
    heard, outcomes, taken = replies_over(faults, 1)
    answered = [i for i, outcome in enumerate(outcomes) if outcome == i]
    assert {
        "lost": DeadlineError in outcomes,
        "doubled": len(heard) > 50,
        "overtaken": heard != sorted(heard) and len(answered) == 50,
        "cut": SlaveLostError in outcomes or DeadlineError in outcomes,
        "dead": SlaveLostError in outcomes,
    }[symptom], outcomes
    assert all(outcomes[i] == i for i in answered)
    assert len(answered) + outcomes.count(DeadlineError) + outcomes.count(SlaveLostError) == 50
    assert taken <= 2.0


def test_tokens_follow_links_and_blink() -> None:
    """Watchers hear every change in order; a cut that is not noticed changes nothing."""
    clock = VirtualClock()
    network = Network(clock, Random(1), NO_FAULTS)
    server, client = network.join("server"), network.join("client")
    news: list[bool] = []

    def main() -> None:
        server.announce("a/alive")
        client.watch("a/*", lambda key, alive: news.append(alive))
        assert client.alive("a/*", 1.0) == ["a/alive"]
        server.blink(1.0)
        assert client.alive("a/*", 1.0) == []
        clock.sleep(2.0)
        network.cut(server, client, 1e-6)
        clock.sleep(2.0)
        network.cut(server, client, 10.0)
        clock.sleep(20.0)
        server.die()
        clock.sleep(1.0)

    clock.run(main, limit=100.0)
    clock.close()
    assert news == [True, False, True, False, True, False], news
