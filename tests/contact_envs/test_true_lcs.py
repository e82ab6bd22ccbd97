"""The linear complementarity system is the linearisation of the equations of motion, in contact and out of
it."""

from __future__ import annotations

from itertools import chain, combinations

import numpy as np
import pytest

from contact_envs.dynamics import CartPoleParameters, LcsMatrices, integrate, tip_position, true_lcs

PARAMETERS = CartPoleParameters()
STEP = 0.01


def solve_lcp(F: np.ndarray, q: np.ndarray) -> np.ndarray:
    """By trying every active set."""
    size = len(q)
    for active in chain.from_iterable(combinations(range(size), count) for count in range(size + 1)):
        force = np.zeros(size)
        rows = list(active)
        if rows:
            force[rows] = np.linalg.solve(F[np.ix_(rows, rows)], -q[rows])
        if (force >= 0).all() and (F @ force + q >= -1e-12).all():
            return force
    raise AssertionError("no solution")


def lcs_step(lcs: LcsMatrices, state: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    force = solve_lcp(lcs.F, lcs.D @ state + lcs.E @ action + lcs.c)
    return lcs.A @ state + lcs.B @ action + lcs.C @ force + lcs.d, force


@pytest.mark.parametrize("control_step", [0.01, 0.02])
@pytest.mark.parametrize("max_force", [10.0, 100.0])
def test_free_motion_is_the_derivative_of_the_integrated_step(control_step, max_force):
    lcs = true_lcs(PARAMETERS, control_step, max_force)
    h = 1e-4
    for axis in range(4):
        s = h * np.eye(4)[axis]
        column = (integrate(s, 0.0, control_step) - integrate(-s, 0.0, control_step)) / (2 * h)
        np.testing.assert_allclose(lcs.A[:, axis], column, atol=1e-6)
    column = (
        integrate(np.zeros(4), h * max_force, control_step) - integrate(np.zeros(4), -h * max_force, control_step)
    ) / (2 * h)
    np.testing.assert_allclose(lcs.B[:, 0], column, atol=1e-5)
    np.testing.assert_array_equal(lcs.d, np.zeros(4))


def test_wall_forces_push_like_a_held_force_on_the_tip():
    """On a wall so soft that its force hardly changes within the step, at an angle near zero."""
    soft = CartPoleParameters(wall_stiffness=1.0)
    lcs = true_lcs(soft, STEP)
    for side, column in ((1.0, 0), (-1.0, 1)):
        start = np.array([side * 0.75, 0, 0, 0])  # 0.4 m into the wall: 0.4 N
        after, force = lcs_step(lcs, start, np.zeros(1))
        np.testing.assert_allclose(force[column], 0.4, rtol=1e-3)
        assert force[1 - column] == 0.0
        np.testing.assert_allclose(after, integrate(start, 0.0, STEP, soft), atol=1e-6)


def test_gap_is_the_distance_to_each_wall_while_there_is_no_contact():
    lcs = true_lcs(PARAMETERS, STEP, gap_instant=0.0)
    state = np.array([0.1, 0.3, 0.05, -0.4])
    tip = 0.1 + 0.6 * 0.05
    np.testing.assert_allclose(lcs.D @ state + lcs.c, [0.35 - tip, 0.35 + tip], atol=1e-12)


def test_one_step_in_contact_matches_the_integrated_equations():
    lcs = true_lcs(PARAMETERS, STEP, 100.0)
    for state in ([0.36, 0.0, 0.0, 0.0], [-0.33, -0.2, -0.05, -0.5], [0.3, 0.4, 0.1, 0.2]):
        predicted, force = lcs_step(lcs, np.array(state), np.array([0.05]))
        assert force.max() > 1.0
        exact = integrate(state, 5.0, STEP)
        change = np.abs(exact - state).max()
        assert np.abs(predicted - exact).max() < 0.05 * change


def near_a_wall(count: int) -> np.ndarray:
    """Random states whose tip is within 3 cm of a wall's face."""
    rng, states = np.random.default_rng(0), []
    while len(states) < count:
        state = rng.uniform(-1, 1, 4) * [0.35, 1.0, 0.15, 1.5]
        if abs(abs(tip_position(state, PARAMETERS)) - PARAMETERS.wall_distance) < 0.03:
            states.append(state)
    return np.array(states)


@pytest.mark.parametrize("max_force", [10.0, 100.0])
def test_reading_the_gap_in_the_middle_of_the_step_is_best(max_force):
    states = near_a_wall(150)
    actions = np.random.default_rng(1).uniform(-1, 1, (150, 1))
    exact = np.array([integrate(s, max_force * a[0], STEP) for s, a in zip(states, actions, strict=True)])
    spread = (exact - states).std(axis=0)

    def error(lcs: LcsMatrices) -> float:
        predicted = [lcs_step(lcs, s, a)[0] for s, a in zip(states, actions, strict=True)]
        return float(np.sqrt(np.mean(((predicted - exact) / spread) ** 2)))

    start, middle, end = (
        error(true_lcs(PARAMETERS, STEP, max_force, gap_instant=instant)) for instant in (0.0, 0.5, 1.0)
    )
    assert 3.0 * middle < min(start, end)
    np.testing.assert_equal(error(true_lcs(PARAMETERS, STEP, max_force)), middle)


@pytest.mark.parametrize("gap_instant", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("control_step", [0.001, 0.01, 0.1])
def test_the_complementarity_problem_has_one_solution(gap_instant, control_step):
    F = true_lcs(PARAMETERS, control_step, gap_instant=gap_instant).F
    np.testing.assert_allclose(F, F.T, atol=1e-15)
    assert np.linalg.eigvalsh(F).min() > 0.0


def test_actions_are_in_units_of_the_scale():
    small, large = true_lcs(PARAMETERS, STEP, 10.0), true_lcs(PARAMETERS, STEP, 100.0)
    np.testing.assert_allclose(10 * small.B, large.B, rtol=1e-12)
    np.testing.assert_allclose(10 * small.E, large.E, rtol=1e-12)
    for name in ("A", "C", "D", "F"):
        np.testing.assert_allclose(getattr(small, name), getattr(large, name), rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"control_step": 0.0}, "control_step"),
        ({"action_scale": -1.0}, "action_scale"),
        ({"gap_instant": 1.5}, "gap_instant"),
    ],
)
def test_impossible_arguments_are_named(arguments, name):
    with pytest.raises(ValueError, match=name):
        true_lcs(PARAMETERS, **arguments)
