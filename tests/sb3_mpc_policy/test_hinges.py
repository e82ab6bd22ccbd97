"""The search for hinges finds the walls that were planted in the surprises, and none where there are none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_mpc_policy.hinges import Hinges, Surprises, find_hinges

N_X, P = 3, 5  # three states, one action, one
LEAST_NOISE = 0.02
# They push along ``direction`` with ``slope · max(0, −(gap))``; each touches about one transition of a hundred.
WALLS = {
    "left": ((0.6, 0.8, 0.0), (1.0, 0.1, 0.0, 0.0, 1.0), 40.0),
    "right": ((-0.8, 0.6, 0.0), (-1.0, 0.0, 0.0, 0.0, 0.98), 40.0),
    "ceiling": ((0.0, 0.0, -1.0), (0.0, 0.1, -1.0, 0.0, 1.0), 30.0),
}


def walls(*names: str) -> Hinges:
    directions, gaps, slopes = zip(*(WALLS[name] for name in names), strict=True)
    return Hinges(np.array(directions).T, np.array(slopes)[:, None] * np.array(gaps))


class Scene(NamedTuple):
    """Surprises as arrays, before any is left out."""

    z: np.ndarray
    surprise: np.ndarray
    noise: np.ndarray

    def surprises(self, near: np.ndarray | None = None, **changes: Any) -> Surprises:
        """As data of a search. The first and the third state are positions: they change little in a step."""
        arguments: dict[str, Any] = dict(
            drift=np.array([0.005, 0.1, 0.005, 0.5, 0.0]), unit=np.ones(N_X), rng=np.random.default_rng(0)
        )
        count = np.ones(len(self.z)) if near is None else near
        return Surprises(self.z, self.surprise, count, self.noise, **(arguments | changes))


def scene(truth: Hinges, seed: int = 0, noise: float = 0.0, n: int = 2_000) -> Scene:
    rng = np.random.default_rng(seed)
    z = np.hstack([rng.uniform(-1.0, 1.0, (n, P - 1)), np.ones((n, 1))])
    surprise = truth.push(z) + noise * rng.normal(size=(n, N_X))
    return Scene(z, surprise, np.full(n, max(2.0 * noise, LEAST_NOISE)))


def nothing() -> Hinges:
    return Hinges.none(N_X, P)


def assert_found(found: Hinges, *names: str, tolerance: float = 0.05) -> None:
    """Each of these walls and no other: direction, gap (of unit slope) within the tolerance, slope within thrice it."""
    truth = walls(*names)
    assert found.n == truth.n
    for C, row in zip(truth.C.T, truth.P, strict=True):
        k = int(np.argmax(found.C.T @ C))
        np.testing.assert_allclose(found.C[:, k], C, atol=tolerance)
        slope, expected = np.linalg.norm(found.P[k, :-1]), np.linalg.norm(row[:-1])
        np.testing.assert_allclose(found.P[k] / slope, row / expected, atol=tolerance)
        assert slope == pytest.approx(expected, rel=3.0 * tolerance)


# -- the push of a hinge ---------------------------------------------------------------------------------------


def test_hinges_push_where_their_gaps_are_closed() -> None:
    left_and_right = walls("left", "right")
    z = np.array([[0.0, 0, 0, 0, 1], [-1.5, 0, 0, 9, 1], [1.48, 0, 0, 0, 1], [-1.5, 5.0, 0, 0, 1]])
    np.testing.assert_allclose(left_and_right.forces(z), [[0, 0], [20, 0], [0, 20], [0, 0]], atol=1e-12)
    np.testing.assert_allclose(left_and_right.push(z), [[0, 0, 0], [12, 16, 0], [-16, 12, 0], [0, 0, 0]], atol=1e-12)
    assert not nothing().push(z).any()


def test_normalising_changes_lengths_and_not_the_push() -> None:
    rng = np.random.default_rng(0)
    hinges, z = Hinges(rng.normal(size=(N_X, 4)), rng.normal(size=(4, P))), rng.normal(size=(50, P))
    unit = hinges.normalised()
    np.testing.assert_allclose(np.linalg.norm(unit.C, axis=0), 1.0)
    np.testing.assert_allclose(unit.push(z), hinges.push(z))


# -- what is found ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("seed", range(4))
def test_two_walls_that_one_transition_of_a_hundred_touches_are_recovered(noise: float, seed: int) -> None:
    data = scene(walls("left", "right"), seed, noise)
    assert (walls("left", "right").forces(data.z) > 0).mean(axis=0) == pytest.approx([0.0125, 0.015], abs=0.006)
    assert_found(find_hinges(data.surprises(), 4, nothing()), "left", "right")


def test_surprises_that_no_hinge_explains_give_none() -> None:
    for seed in range(6):
        data, rng = scene(nothing(), seed, noise=0.01), np.random.default_rng(seed)
        struck = rng.choice(len(data.z), 20, replace=False)
        data.surprise[struck] += rng.choice([1.0, 10.0, 1e3], (20, 1)) * rng.normal(size=(20, N_X))
        assert find_hinges(data.surprises(), 4, nothing()).n == 0


def test_noise_alone_gives_none() -> None:
    for noise in (0.0, 0.01, 1.0):
        assert find_hinges(scene(nothing(), noise=noise).surprises(), 4, nothing()).n == 0


@pytest.mark.parametrize("size", [10.0, 1e2, 1e6, 1e12])
def test_outliers_however_large_do_not_move_the_walls(size: float) -> None:
    for seed in range(2):
        data, rng = scene(walls("left", "right"), seed, noise=0.01), np.random.default_rng(seed + 1)
        struck = rng.choice(len(data.z), 10, replace=False)  # half as many as touch a wall
        data.surprise[struck] += size * rng.normal(size=(10, N_X))
        assert_found(find_hinges(data.surprises(), 4, nothing()), "left", "right")


@pytest.mark.parametrize("most", [0, 1, 2, 3])
def test_there_are_never_more_hinges_than_asked_for(most: int) -> None:
    data = scene(walls(*WALLS))
    assert find_hinges(data.surprises(), most, nothing()).n == most
    assert find_hinges(data.surprises(), most, Hinges(walls(*WALLS).C[:, :most], walls(*WALLS).P[:most])).n == most


def test_there_are_no_more_hinges_than_walls() -> None:
    assert_found(find_hinges(scene(walls(*WALLS)).surprises(), 8, nothing()), *WALLS)


def test_a_wall_that_is_only_touched_where_hardly_anything_counts_is_not_learned() -> None:
    data = scene(walls("left", "right"))
    for weight, expected in ((5e-4, ("right",)), (2e-3, ("left", "right"))):
        near = np.where(data.z[:, 0] < 0.0, weight, 1.0)
        assert_found(find_hinges(data.surprises(near, drift=np.zeros(P)), 4, nothing()), *expected)


def test_one_touch_makes_no_wall_and_a_few_do() -> None:
    data = scene(walls("right"))
    deep = np.argsort(np.linalg.norm(data.surprise, axis=1))[::-1]
    for n, expected in ((1, 0), (8, 1)):
        some = np.zeros_like(data.surprise)
        some[deep[:n]] = data.surprise[deep[:n]]
        assert find_hinges(Scene(data.z, some, data.noise).surprises(drift=np.zeros(P)), 4, nothing()).n == expected


@pytest.mark.parametrize("slow", [0, 1])
def test_where_a_handful_of_contacts_leave_it_open_a_gap_depends_on_what_changes_slowly(slow: int) -> None:
    """All touches lie on a line, along which the first two states say the same."""
    rng = np.random.default_rng(0)
    z = np.hstack([rng.uniform([-0.5, -0.5, -1.0, -1.0], 1.0, (1_000, P - 1)), np.ones((1_000, 1))])
    depth = np.linspace(0.01, 0.08, 8)
    z[:8, :2] = -0.9 - depth[:, None]
    surprise = np.zeros((1_000, N_X))
    surprise[:8] = 10.0 * depth[:, None]
    drift = np.array([0.1, 0.1, 0.1, 0.5, 0.0])
    drift[slow] = 0.005
    found = find_hinges(Scene(z, surprise, np.full(1_000, LEAST_NOISE)).surprises(drift=drift), 2, nothing())
    assert found.n == 1
    row = found.P[0] / found.P[0, slow]
    assert np.abs(np.delete(row[:-1], slow)).max() < 0.03
    assert row[-1] == pytest.approx(0.9, abs=0.01)


def sticky(D: tuple[float, float], C: tuple[float, float]) -> Hinges:
    """A hinge at the left of which D C is 10 (D_0 C_0 + D_1 C_1)."""
    return Hinges(np.array([[*C, 0.0]]).T, 10.0 * np.array([[*D, 0.0, 0.0, 0.96 * abs(D[0])]]))


@pytest.mark.parametrize(
    ("hinge", "unit", "accepted"),
    [
        (sticky((1.0, 0.0), (1.0, 0.0)), (1.0, 1.0, 1.0), True),
        (sticky((1.0, 0.0), (-1.0, 0.0)), (1.0, 1.0, 1.0), False),
        (sticky((1.0, 0.2), (-0.6, 0.8)), (1.0, 1.0, 1.0), False),
        (sticky((1.0, 0.2), (-0.6, 0.8)), (0.1, 1.0, 1.0), True),
    ],
    ids=["opens", "closes", "closes in these units", "opens in those of the state"],
)
def test_a_force_that_would_close_its_own_gap_is_no_contact(
    hinge: Hinges, unit: tuple[float, float, float], accepted: bool
) -> None:
    data = scene(hinge)
    assert (hinge.forces(data.z) > 0.0).sum() >= 15
    found = find_hinges(data.surprises(unit=np.array(unit)), 2, nothing())
    assert found.n == int(accepted)


# -- where it starts -------------------------------------------------------------------------------------------


def test_a_start_that_explains_everything_is_kept_as_it_is() -> None:
    truth = walls("left", "right").normalised()
    found = find_hinges(scene(truth).surprises(drift=np.zeros(P)), 4, truth)
    np.testing.assert_array_equal(found.C, truth.C)
    np.testing.assert_array_equal(found.P, truth.P)


def far_away() -> Hinges:
    """A wall that nothing touches."""
    return Hinges(np.array([[0.0, 0.0, 1.0]]).T, np.array([[0.0, 0.0, 1.0, 0.0, 50.0]]))


def test_of_a_start_what_does_nothing_is_taken_out() -> None:
    truth = walls("left", "right").normalised()
    found = find_hinges(scene(truth).surprises(drift=np.zeros(P)), 4, far_away().plus(*truth))
    np.testing.assert_array_equal(found.C, truth.C)
    np.testing.assert_array_equal(found.P, truth.P)


def test_what_a_start_lacks_is_added() -> None:
    start = far_away().plus(*walls("right"))
    assert_found(find_hinges(scene(walls("left", "right"), noise=0.01).surprises(), 2, start), "left", "right")


def test_a_wall_of_the_start_is_kept_by_two_touches_that_would_make_no_new_one() -> None:
    data = scene(walls("left", "right"))
    touched = np.flatnonzero(walls("left").forces(data.z)[:, 0] > 0.0)
    some = data.surprise.copy()
    some[touched[2:]] = 0.0
    rest = np.setdiff1d(np.arange(len(data.z)), touched[2:])  # as if the others had not happened
    few = Scene(data.z[rest], some[rest], data.noise[rest]).surprises()
    assert_found(find_hinges(few, 2, nothing()), "right")
    assert_found(find_hinges(few, 2, walls("left", "right")), "left", "right")


def test_a_wall_that_was_found_in_two_pieces_becomes_one() -> None:
    whole = walls("left").normalised()
    pieces = Hinges(np.hstack([whole.C, whole.C]), np.vstack([0.4 * whole.P, 0.6 * whole.P]))
    np.testing.assert_allclose(pieces.absorbed(0).P, whole.P)
    assert_found(find_hinges(scene(walls("left"), noise=0.01).surprises(), 2, pieces), "left")


def test_a_wrong_start_does_no_harm() -> None:
    rng = np.random.default_rng(0)
    for _ in range(8):
        start = Hinges(rng.normal(size=(N_X, 2)), 100.0 * rng.normal(size=(2, P)))
        assert_found(find_hinges(scene(walls("left", "right"), noise=0.01).surprises(), 2, start), "left", "right")


# -- the descent -----------------------------------------------------------------------------------------------


def random_start(seed: int) -> tuple[Surprises, Hinges]:
    rng = np.random.default_rng(seed)
    data = scene(walls("left", "ceiling"), seed, noise=0.05, n=400)
    surprises = data.surprises(rng.uniform(0.1, 1.0, 400))
    return surprises, Hinges(rng.normal(size=(N_X, 2)), rng.normal(size=(2, P))).normalised()


@pytest.mark.parametrize("seed", range(3))
def test_the_normal_equations_are_those_of_the_cost(seed: int, central_difference: Callable[..., np.ndarray]) -> None:
    """Half the gradient, since Cauchy weights change the cost's curvature and not its slope; and JᵀJ of the errors."""
    surprises, start = random_start(seed)
    fit = surprises.evaluate(start)

    def hinges(x: np.ndarray) -> Hinges:
        return Hinges(x[:, :N_X].T, x[:, N_X:])

    def errors(x: np.ndarray) -> np.ndarray:
        """Weighted residuals, the weights those of the start, and the prior's."""
        moved = hinges(x)
        weight = np.sqrt(surprises.near / surprises.variance / (1.0 + fit.excess))
        residual = (moved.push(surprises.z) - surprises.r) * weight[:, None]
        return np.concatenate([residual.ravel(), (moved.P * surprises.prior).ravel()])

    x = np.hstack([start.C.T, start.P])
    matrix, gradient = surprises._normal_equations(fit)
    expected = central_difference(lambda x: surprises.evaluate(hinges(x)).cost / 2.0, x)
    np.testing.assert_allclose(gradient.reshape(x.shape), expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    steps = 1e-6 * np.eye(x.size).reshape(x.size, *x.shape)
    jacobian = np.stack([(errors(x + step) - errors(x - step)) / 2e-6 for step in steps], axis=1)
    np.testing.assert_allclose(matrix, jacobian.T @ jacobian, rtol=1e-5, atol=1e-6 * matrix.max())


@pytest.mark.parametrize("seed", range(3))
def test_the_cost_never_rises_and_falls_to_where_its_gradient_is_small(seed: int) -> None:
    surprises, start = random_start(seed)
    fit = surprises.evaluate(start)
    first, costs = np.abs(surprises._normal_equations(fit)[1]).max(), [fit.cost]
    for _ in range(60):
        fit = surprises.descend(fit, 1)
        costs.append(fit.cost)
    assert (np.diff(costs) <= 0.0).all() and costs[-1] < 0.9 * costs[0]
    assert np.abs(surprises._normal_equations(fit)[1]).max() < 0.1 * first
    np.testing.assert_allclose(np.linalg.norm(fit.hinges.C, axis=0), 1.0)
    assert fit.cost == surprises.evaluate(fit.hinges).cost


# -- of many transitions some ----------------------------------------------------------------------------------


def test_the_transitions_that_take_part_stand_for_all() -> None:
    truth = walls("left", "right")
    data = scene(truth, noise=0.01, n=80_000)
    near = np.ones(len(data.z))
    surprises = data.surprises(near)
    assert len(surprises.z) == 3_000 and (near == 1.0).all()
    assert surprises.near.sum() == pytest.approx(80_000, rel=1e-9)
    # the cost over all of them, written out: the left wall alone, so that half of the surprises are unexplained
    left = walls("left")
    error = np.square(left.push(data.z) - data.surprise).sum(axis=1)
    size = np.square(data.noise) + np.square(0.1 * np.linalg.norm(data.surprise, axis=1))
    everything = np.log1p(error / size).sum() + np.square(left.P * surprises.prior).sum()
    assert surprises.evaluate(left).cost == pytest.approx(everything, rel=0.05)
    assert_found(find_hinges(surprises, 4, nothing()), "left", "right")


# -- chance and symmetry ---------------------------------------------------------------------------------------


def test_the_global_random_state_is_neither_used_nor_touched() -> None:
    found = []
    for seed in (0, 1):
        np.random.seed(seed)  # noqa: NPY002 - the global state is what this is about
        torch.manual_seed(seed)
        before = np.random.get_state()[1].copy(), torch.get_rng_state()  # type: ignore[index, union-attr]  # noqa: NPY002
        found.append(find_hinges(scene(walls("left", "right"), noise=0.01).surprises(), 4, nothing()))
        after = np.random.get_state()[1], torch.get_rng_state()  # type: ignore[index]  # noqa: NPY002
        np.testing.assert_array_equal(before[0], after[0])
        assert torch.equal(before[1], after[1])
    np.testing.assert_array_equal(found[0].C, found[1].C)
    np.testing.assert_array_equal(found[0].P, found[1].P)


@settings(max_examples=8, deadline=None, derandomize=True)
@given(
    flips=st.lists(st.sampled_from([-1.0, 1.0]), min_size=P - 1, max_size=P - 1),
    seed=st.integers(0, 1_000),
    noise=st.sampled_from([0.0, 0.01, 0.05]),
)
def test_mirrored_surprises_give_mirrored_hinges(flips: list[float], seed: int, noise: float) -> None:
    data = scene(walls("left", "ceiling"), seed, noise, n=1_000)
    mirror, mirrored_states = np.array([*flips, 1.0]), np.array(flips[:N_X])
    mirrored = Scene(data.z * mirror, data.surprise * mirrored_states, data.noise)
    one, two = (find_hinges(some.surprises(), 3, nothing()) for some in (data, mirrored))
    assert one.n == two.n
    np.testing.assert_allclose(two.C, one.C * mirrored_states[:, None], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(two.P, one.P * mirror, rtol=1e-6, atol=1e-9)
