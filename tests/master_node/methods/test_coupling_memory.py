"""Laws of the choice between explicit and iterated double steps."""

from __future__ import annotations

import pytest

from master_node.methods.coupling_memory import CALM, LASTING, STIFF, CouplingMemory

FIRST = CouplingMemory()
ITERATING = FIRST.after_explicit(1.0).iterating(())


def noted(*gains: float) -> CouplingMemory:
    """After explicit double steps with these loop gains."""
    memory = FIRST
    for gain in gains:
        memory = memory.noted(gain)
    return memory


@pytest.mark.parametrize(("gain", "steps"), [(STIFF, 3), (LASTING, 24)])
def test_a_gain_is_borne_for_a_while(gain: float, steps: int) -> None:
    """A large one for three double steps, one that is at the stability limit of feed-through for
    twenty-four.
    """
    assert not noted(*[gain] * (steps - 1)).asks_for_iteration
    assert noted(*[gain] * steps).asks_for_iteration
    assert not noted(*[0.99 * LASTING] * 1000).asks_for_iteration


def test_single_small_gains_do_not_hide_a_lasting_one() -> None:
    """They make three double steps good, not all: a step size that swings at its limit shows."""
    assert noted(*([LASTING] * 9 + [0.0]) * 4).asks_for_iteration
    assert not noted(*([LASTING] * 3 + [0.0]) * 100).asks_for_iteration


def test_iterated_steps_that_lead_no_further_are_given_up_with_more_patience() -> None:
    """After six of them, and the next trial takes twice as many large gains."""
    memory = ITERATING.after_iterated((), 4, 1.0, 1.0)  # the first one is the largest so far
    for _ in range(6):
        assert memory.is_implicit
        memory = memory.after_iterated((), 4, 1.0, 1.0)
    assert not memory.is_implicit
    for _ in range(5):
        memory = memory.noted(STIFF)
        assert not memory.asks_for_iteration
    assert memory.noted(STIFF).asks_for_iteration


def test_step_sizes_that_still_grow_are_not_given_up() -> None:
    """Iterated double steps begin with the H of explicit ones, however much more they allow."""
    memory = ITERATING
    for number in range(20):
        memory = memory.after_iterated((), 8, 1e-3 * 1.3**number, 1.0)
        assert memory.is_implicit


def test_explicit_steps_come_back_where_nothing_is_stiff() -> None:
    """Two iterated double steps in a row with a small loop gain; an unknown gain is not small."""
    once = ITERATING.after_iterated((), 1, 10.0, CALM)
    assert once.is_implicit
    assert not once.after_iterated((), 1, 10.0, CALM).is_implicit
    between = once.after_iterated((), 1, 10.0, float("inf"))
    assert between.after_iterated((), 1, 10.0, CALM).is_implicit
