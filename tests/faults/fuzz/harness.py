"""Gives hostile messages to the codec and to a slave on a bus; says what did not hold.

Laws: every decoder returns a well-formed value or raises one of the errors that it names; the
slave answers everything, with bytes that its asker can read, and still serves its master after;
neither time nor memory for a message goes beyond a bound.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from protocol.bus.bus import InProcessBus
from protocol.calls import CALLS, DoStep, ExitInitializationMode, GetOutputs, Initialize
from protocol.errors import (
    DoublestepError,
    MalformedMessageError,
    SlaveBusyError,
    VersionError,
)
from protocol.wire.keys import ABORT, CLAIM, EXECUTE, RELEASE, STATUS, SlaveKey
from protocol.wire.programs import (
    decode_program,
    decode_request,
    decode_single,
    encode_program,
    encode_request,
)
from protocol.wire.records import decode_map, encode_map
from protocol.wire.replies import decode_reply
from slave_node.serving.node import SlaveNode
from tests.faults.fuzz.messages import Kind, Mutator, calls_of_reply
from tests.support.light_slaves import LightWorker

KEY = SlaveKey("left", "0123abcd")
_REFUSALS = (MalformedMessageError, VersionError)
_VERBS = (EXECUTE, CLAIM, RELEASE, ABORT, STATUS, *(call.verb for call in CALLS))
_CHECK_EVERY = 500
"""So often a master runs a few steps on the slave and looks at the result."""


def decode(kind: Kind, number: int, data: bytes) -> str:
    """Give a message to the decoders.

    Returns:
        What became of it: ``refused``, or ``taken``.
    """
    outcome = "refused"
    if kind.name in ("request", "program"):
        program = data
        if kind.name == "request":
            try:
                _, _, program = decode_request(data)
            except _REFUSALS:
                return outcome
        try:
            decode_program(program)
            outcome = "taken"
        except _REFUSALS:
            pass
    elif kind.name == "reply":
        try:
            decode_reply(calls_of_reply(number), data)
            outcome = "taken"
        except _REFUSALS:
            pass
    elif kind.name == "single":
        for call in (CALLS[number % len(CALLS)], Initialize):
            try:
                decode_single(call, data)
                outcome = "taken"
            except _REFUSALS:
                pass
    else:
        try:
            decode_map(data)
            outcome = "taken"
        except DoublestepError:  # also those that it reports
            pass
    return outcome


@dataclass
class Findings:
    """Findings of a number of messages.

    Attributes:
        messages: how many there were.
        outcomes: counts of what became of them.
        slowest: the longest processor time that one took [s]; who sleeps is not slow here, and
            whoever waits for ever is found by its caller.
        slowest_number: which one.
    """

    messages: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0
    slowest_number: int = -1


class Service:
    """A slave on an in-process bus that hears everything, and a master that looks after it."""

    def __init__(self) -> None:
        self._bus = InProcessBus()
        worker = LightWorker(KEY.name)
        # A claim that fuzzing won is never given back: only who holds it could.
        self._node = SlaveNode(self._bus, worker, KEY, worker.start(), orphan_time=1e9)
        self._ready = threading.Event()
        self._bus.watch(KEY.alive, lambda _, up: self._ready.set() if up else None)
        self._thread = threading.Thread(target=self._node.serve)

    def __enter__(self) -> Self:
        self._thread.start()
        if not self._ready.wait(10.0):
            raise TimeoutError("the slave does not serve")
        self._epoch, self._sequence = self._claim(), 0
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._bus.close()
        self._thread.join(10.0)

    def _claim(self) -> int:
        claim = encode_map({"run": "run-1", "host": "nowhere", "pid": 0})
        epoch = decode_map(self._bus.handle(KEY.verb(CLAIM), claim))["epoch"]
        assert isinstance(epoch, int)
        return epoch

    def _take_back(self) -> None:
        """Claim the slave anew, also from a claim that fuzzing won: its epoch is a later one."""
        for epoch in range(self._epoch, self._epoch + _CHECK_EVERY + 2):
            self._bus.handle(KEY.verb(RELEASE), encode_map({"epoch": epoch}))
            try:
                self._epoch, self._sequence = self._claim(), 0
            except SlaveBusyError:
                continue
            return
        raise AssertionError("the slave does not come free")

    def hear(self, kind: Kind, number: int, data: bytes) -> str:
        """Send a message to a verb; a program also as the next request of the holder.

        Returns:
            What the slave answered: ``answered``, or ``refused``.
        """
        if kind.name == "program" and number % 4:
            self._sequence += 1
            request = encode_request(self._epoch, self._sequence, data)
            reply = self._bus.handle(KEY.verb(EXECUTE), request)
        else:
            verb = EXECUTE if kind.name == "request" else _VERBS[number % len(_VERBS)]
            reply = self._bus.handle(KEY.verb(verb), data)
            if verb not in (EXECUTE, CLAIM, RELEASE, ABORT, STATUS):
                return "answered"
            if verb != EXECUTE:
                return self._administered(reply)
        # Whoever asked can read at least why not; its results belong to a program that is his.
        try:
            return "answered" if decode_reply((), reply).error is None else "refused"
        except MalformedMessageError as error:
            if "at most 0 results" not in str(error):
                raise
            return "answered"

    @staticmethod
    def _administered(reply: bytes) -> str:
        try:
            decode_map(reply)
        except MalformedMessageError as error:
            if not error.slave:  # else it is what the slave has to say
                raise
            return "refused"
        except DoublestepError:
            return "refused"
        return "answered"

    def check(self) -> None:
        """Run three steps as a master and look at the result.

        Raises:
            AssertionError: the slave does not do what it does for a master that comes first.
        """
        status = decode_map(self._bus.handle(KEY.verb(STATUS), b""))
        assert status["name"] == KEY.name
        self._take_back()
        program = (
            Initialize(inputs=("u",), outputs=("x",)),
            ExitInitializationMode(),
            *(DoStep(t, 0.25) for t in (0.0, 0.25, 0.5)),
            GetOutputs(),
        )
        self._sequence += 1
        request = encode_request(self._epoch, self._sequence, encode_program(program))
        reply = decode_reply(program, self._bus.handle(KEY.verb(EXECUTE), request))
        assert reply.error is None, reply.error
        assert reply.results[-1].tolist() == [[_EXPECTED]], reply  # type: ignore[attr-defined]


def _expected() -> float:
    """x(0.75) with x' = -x, x(0) = 1 by three steps of the classical Runge-Kutta method."""
    h, x = 0.25, 1.0
    for _ in range(3):
        k_1 = -x
        k_2 = -(x + 0.5 * h * k_1)
        k_3 = -(x + 0.5 * h * k_2)
        k_4 = -(x + h * k_3)
        x += h / 6.0 * (k_1 + 2.0 * (k_2 + k_3) + k_4)
    return x


_EXPECTED = _expected()


def fuzz(seed: int, first: int, count: int) -> Findings:
    """Give ``count`` messages from number ``first`` on to codec and service.

    Raises:
        AssertionError: a law did not hold; says with which message. So does whatever a decoder
            or the slave raised that it must not raise.
    """
    mutator, findings = Mutator(seed), Findings()
    with Service() as service:
        for number in range(first, first + count):
            kind, data = mutator.message(number)
            begin = time.process_time()
            try:
                findings.outcomes[f"codec {decode(kind, number, data)}"] += 1
                findings.outcomes[f"slave {service.hear(kind, number, data)}"] += 1
                if number % _CHECK_EVERY == 0:
                    service.check()
            except BaseException as error:
                error.add_note(f"seed {seed}, message {number} ({kind.name}): {data[:200]!r}")
                raise
            taken = time.process_time() - begin
            if taken > findings.slowest:
                findings.slowest, findings.slowest_number = taken, number
            findings.messages += 1
        service.check()
    return findings
