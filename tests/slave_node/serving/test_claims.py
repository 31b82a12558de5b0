"""Whatever the network does to requests, each one takes effect exactly once."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, rule

from protocol.errors import SequenceError, SlaveBusyError
from slave_node.serving.claims import Claims, Holder

Request = tuple[int, int]  # epoch, sequence number


def holder(run: str = "run-1") -> Holder:
    """A master."""
    return Holder(run, "host", 4711, "2025-01-01T12:00:00+00:00")


class Network(RuleBasedStateMachine):
    """A master numbers its requests; the network drops, repeats, delays and reorders them."""

    requests = Bundle("requests")

    def __init__(self) -> None:
        super().__init__()
        self.claims = Claims()
        self.epoch = 0  # the master's, 0 if it holds nothing
        self.sent = 0
        self.effects: dict[Request, int] = {}
        self.order: list[Request] = []
        self.epochs: list[int] = []

    @rule(run=st.sampled_from(["run-1", "run-2", "run-3"]))
    def claim(self, run: str) -> None:
        """A claim is granted to one run at a time; asking again changes nothing."""
        present = self.claims.holder
        if present is None:
            self.epoch, self.sent = self.claims.claim(holder(run)), 0
            self.epochs.append(self.epoch)
        elif present.run == run:
            assert self.claims.claim(holder(run)) == self.epoch
        else:
            with pytest.raises(SlaveBusyError):
                self.claims.claim(holder(run))

    @rule(draw=st.integers(-2, 5))
    def release(self, draw: int) -> None:
        """Only the present epoch can give the slave back; not one before, nor a number near it."""
        known = [0, *self.epochs]
        epoch = known[draw % len(known)] if draw >= 0 else self.epoch - draw
        if self.epoch and epoch == self.epoch:
            self.claims.release(epoch)
            self.epoch = 0
        else:
            with pytest.raises(SequenceError):
                self.claims.release(epoch)

    @rule(target=requests)
    def send(self) -> Request:
        """The master's next request goes to the network, where it waits for its fate."""
        self.sent += 1
        return self.epoch, self.sent

    @rule(request=requests)
    def deliver(self, request: Request) -> None:
        """Early, late, once or often: the network hands over any request that was ever sent."""
        present = self.epoch and request[0] == self.epoch
        done = max((s for e, s in self.effects if e == self.epoch), default=0)
        try:
            reply = self.claims.admit(*request)
        except SequenceError:
            assert not present or request[1] not in (done, done + 1) or not done + request[1]
            return
        if reply is None:
            self.effects[request] = self.effects.get(request, 0) + 1
            self.order.append(request)
            self.claims.record(request[1], repr(request).encode())
        else:
            assert reply == repr(request).encode()

    @invariant()
    def exactly_once(self) -> None:
        """No request takes effect twice, and effects come in the order of the numbers."""
        assert all(count == 1 for count in self.effects.values())
        places = [(self.epochs.index(epoch), s) for epoch, s in self.order]
        assert places == sorted(places)
        for epoch in self.epochs:
            numbers = [s for e, s in self.order if e == epoch]
            assert numbers == list(range(1, len(numbers) + 1))

    @invariant()
    def epochs_differ(self) -> None:
        """No epoch is ever given twice."""
        assert len(self.epochs) == len(set(self.epochs))


TestNetwork = Network.TestCase
TestNetwork.settings = settings(max_examples=150, stateful_step_count=40)


def test_who_knows_the_run_only_gets_no_epoch() -> None:
    """The id of a run is on the bus for all to see: another master could go on in its place."""
    claims = Claims()
    master = replace(holder(), secret="a secret")
    epoch = claims.claim(master)
    assert claims.claim(master) == epoch
    for secret in ("", "another", "a secret ", "ä"):
        with pytest.raises(SlaveBusyError) as info:
            claims.claim(replace(master, secret=secret))
        assert "a secret" not in str(info.value)
    assert "a secret" not in f"{master} {master!r}"
    claims.release(epoch)
    assert claims.claim(replace(master, secret="another")) != epoch


def test_nobody_needs_to_be_asked_twice() -> None:
    """A lost reply is given again, bit for bit, without a second effect."""
    claims = Claims()
    epoch = claims.claim(holder())
    assert claims.admit(epoch, 1) is None
    claims.record(1, b"reply")
    assert claims.admit(epoch, 1) == b"reply"
    assert claims.admit(epoch, 1) == b"reply"
    assert claims.admit(epoch, 2) is None


@pytest.mark.parametrize("sequence", [0, 3, 5, 2**63 - 1])
def test_a_number_out_of_order_is_refused(sequence: int) -> None:
    """Late and early requests have no effect, and the message says what was expected."""
    claims = Claims()
    epoch = claims.claim(holder())
    for number in range(1, 5):
        assert claims.admit(epoch, number) is None
        claims.record(number, b"reply")
    if sequence == 5:
        assert claims.admit(epoch, sequence) is None
        return
    with pytest.raises(SequenceError, match=f"request {sequence} after request 4"):
        claims.admit(epoch, sequence)


def test_a_stale_epoch_is_refused_with_the_remedy() -> None:
    """A master that comes back after another took over is told so."""
    claims = Claims()
    old = claims.claim(holder("run-1"))
    assert claims.admit(old, 1) is None
    claims.record(1, b"reply")
    claims.release(old)
    with pytest.raises(SequenceError, match="not held"):
        claims.admit(old, 1)
    new = claims.claim(holder("run-2"))
    for refused in (claims.check, claims.release, lambda epoch: claims.admit(epoch, 1)):
        with pytest.raises(SequenceError, match=r"held by run run-2 on host .*start the run again"):
            refused(old)
    with pytest.raises(SequenceError) as told:
        claims.check(1)
    assert str(new) not in str(told.value)
    assert claims.holder == holder("run-2")
    assert claims.admit(new, 1) is None  # the numbers begin again


def test_epochs_cannot_be_guessed() -> None:
    """Whoever asks without a claim would need 2^61 attempts; who holds an epoch is not told it."""
    epochs = []
    for _ in range(100):
        claims = Claims()
        epochs.append(claims.claim(holder()))
    assert len(set(epochs)) == 100
    assert 2**61 < max(epochs) <= 2**62
    differences = {abs(a - b) for a in epochs for b in epochs if a != b}
    assert min(differences) > 2**30


def test_busy_names_the_holder() -> None:
    """Run, host, process and time of who holds the slave, and what to do."""
    claims = Claims()
    epoch = claims.claim(holder("run-1"))
    with pytest.raises(SlaveBusyError) as caught:
        claims.claim(holder("run-2"))
    assert str(caught.value) == (
        "busy: held by run run-1 on host (pid 4711) since 2025-01-01T12:00:00+00:00; "
        "wait for that run to end, or start another slave under another name"
    )
    assert claims.claim(holder("run-1")) == epoch == claims.epoch
