"""The store keeps what it is given, and knows the current rollout."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_mpc_policy.transitions import Transitions, TransitionStore


def batch(n: int, seed: int = 0) -> Transitions:
    rng = np.random.default_rng(seed)
    return Transitions(rng.normal(size=(n, 3)), rng.normal(size=(n, 2)), rng.normal(size=n), rng.normal(size=(n, 3)))


def test_what_was_added_comes_back_in_order_as_float64() -> None:
    store = TransitionStore(3, 2)
    first, second = batch(4, 0), batch(2, 1)
    store.add(*first)
    store.add(*(part.astype(np.float32) for part in second))
    assert len(store) == 6
    for found, one, two in zip(store.everything(), first, second, strict=True):
        assert found.dtype == np.float64
        np.testing.assert_array_equal(found, np.concatenate([one, two.astype(np.float32)]))


def test_the_rollout_is_what_came_since_its_start() -> None:
    store = TransitionStore(3, 2)
    store.add(*batch(4, 0))
    store.start_rollout()
    assert len(store.rollout().s) == 0
    store.add(*batch(2, 1))
    store.add(*batch(3, 2))
    expected = (np.concatenate(parts) for parts in zip(batch(2, 1), batch(3, 2), strict=True))
    for found, part in zip(store.rollout(), expected, strict=True):
        np.testing.assert_array_equal(found, part)
    assert len(store.everything().s) == 9


def test_the_latest_are_the_last_ones_across_batches() -> None:
    store = TransitionStore(3, 2)
    store.add(*batch(4, 0))
    store.add(*batch(2, 1))
    for found, one, two in zip(store.latest(3), batch(4, 0), batch(2, 1), strict=True):
        np.testing.assert_array_equal(found, np.concatenate([one[-1:], two]))
    assert len(store.latest(10).s) == 6


def test_what_is_added_is_a_copy() -> None:
    store, given = TransitionStore(3, 2), batch(1)
    store.add(*given)
    given.s[:] = np.nan
    assert np.isfinite(store.rows()).all()


def test_an_empty_store_has_empty_transitions() -> None:
    store = TransitionStore(3, 2)
    assert len(store) == 0
    assert [part.shape for part in store.everything()] == [(0, 3), (0, 2), (0,), (0, 3)]


def test_rows_restore_everything_and_leave_no_current_rollout() -> None:
    store, other = TransitionStore(3, 2), TransitionStore(3, 2)
    store.add(*batch(4))
    other.add(*batch(1, 9))
    other.restore(store.rows())
    np.testing.assert_array_equal(other.rows(), store.rows())
    assert len(other.rollout().s) == 0
    other.add(*batch(2))
    assert (len(store), len(other)) == (4, 6)


@pytest.mark.parametrize("shape", [(4, 8), (9,), (1, 2, 9)])
def test_rows_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"rows must have shape \(N, 9\)"):
        TransitionStore(3, 2).restore(np.zeros(shape))


def test_taking_picks_the_same_transitions_of_every_part() -> None:
    given = batch(5)
    for part, taken in zip(given, given.take(np.array([3, 1])), strict=True):
        np.testing.assert_array_equal(taken, part[[3, 1]])


@pytest.mark.parametrize("part", ["s", "a", "reward", "s_next"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_refused(part: str, value: float) -> None:
    store, given = TransitionStore(3, 2), batch(3)
    getattr(given, part)[1] = value
    with pytest.raises(ValueError, match="transitions must be finite, got state"):
        store.add(*given)
    assert len(store) == 0
