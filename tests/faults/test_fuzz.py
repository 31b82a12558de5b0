"""Hostile messages: what the fuzzer of ``python -m benchmarks fuzz`` finds, in small."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Iterator

import pytest

from protocol.errors import MalformedMessageError
from slave_node.serving.claims import Claims
from tests.faults.fuzz import harness
from tests.faults.fuzz.harness import Service, fuzz
from tests.faults.fuzz.messages import KINDS, Mutator
from tests.support.waiting import wait_until

pytestmark = pytest.mark.skipif(os.name != "posix", reason="measured on POSIX only")


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """The slave tells of every refused claim."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("messages", [4_000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_hostile_messages_are_answered_or_refused(messages: int) -> None:
    """Law: no message makes the codec or a slave do anything else; the slave still serves after."""
    findings = fuzz(2, 0, messages)
    assert findings.messages == messages
    assert findings.slowest < 2.0
    # It must reach behind the first check of the first byte, and not only repeat what is valid.
    for outcome in ("codec taken", "codec refused", "slave answered", "slave refused"):
        assert findings.outcomes[outcome] > messages // 20, findings.outcomes


def test_every_message_follows_from_seed_and_number() -> None:
    """So that a number is enough to look at what was found."""
    some = [Mutator(3).message(number) for number in range(200)]
    again = Mutator(3)
    assert [again.message(number) for number in range(199, -1, -1)] == some[::-1]
    assert [Mutator(4).message(number) for number in range(200)] != some


def test_valid_messages_are_taken() -> None:
    """Messages that the mutator begins with are valid for the decoder that gets them."""
    for kind in KINDS[:3]:
        for number, data in enumerate(kind.examples):
            assert harness.decode(kind, number, data) == "taken", (kind.name, number)


def test_a_decoder_that_raises_something_else_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fuzzer fails, naming seed and number."""

    def careless(data: bytes) -> list[object]:
        if len(data) < 4:
            raise IndexError("careless")
        raise MalformedMessageError("refused")

    monkeypatch.setattr(harness, "decode_program", careless)
    with pytest.raises(IndexError) as info:
        fuzz(2, 0, 5000)
    assert any(note.startswith("seed 2, message ") for note in info.value.__notes__)


def test_a_slave_that_loses_its_master_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A guard that takes any sequence number lets a hostile request spoil the master's."""
    admitted: list[int] = []

    def careless(self: Claims, epoch: int, sequence: int) -> bytes | None:
        admitted.append(sequence)
        return b"\x90" if len(admitted) > 100 else None

    monkeypatch.setattr(Claims, "admit", careless)
    with pytest.raises((AssertionError, MalformedMessageError)):
        fuzz(2, 0, 5000)


def test_the_service_checks_a_real_result() -> None:
    """Three steps of a known solution, to the last bit."""
    with Service() as service:
        service.check()


def test_claims_without_number_make_no_threads_without_number() -> None:
    """A slave looks after its master later: once, not once for every claim that there was."""
    before = threading.active_count()
    with Service() as service:
        serving = threading.active_count()
        assert serving > before
        for _ in range(100):
            service.check()
        wait_until(lambda: threading.active_count() <= serving + 1)
