"""The linear complementarity system is the linearisation of the equations of motion, in contact and out of
it."""

from __future__ import annotations

from itertools import chain, combinations

import numpy as np
import pytest

from contact_envs.dynamics import LcsMatrices, integrate, true_lcs
from contact_envs.plants import AcrobotParameters, CartPoleParameters, Plant

PARAMETERS = CartPoleParameters()
ACROBOT = AcrobotParameters()
DAMPED = AcrobotParameters(damping=0.3, upper_inertia=0.02)
STEP = 0.01

both_plants = pytest.mark.parametrize("parameters", [PARAMETERS, ACROBOT], ids=["cart-pole", "acrobot"])


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


@pytest.mark.parametrize("parameters", [PARAMETERS, ACROBOT, DAMPED], ids=["cart-pole", "acrobot", "damped acrobot"])
@pytest.mark.parametrize("control_step", [0.01, 0.02])
@pytest.mark.parametrize("max_force", [10.0, 100.0])
def test_free_motion_is_the_derivative_of_the_integrated_step(parameters, control_step, max_force):
    lcs = true_lcs(parameters, control_step, max_force)
    h = 1e-5

    def after(state, force):
        return integrate(state, force, control_step, parameters)

    for axis in range(4):
        s = h * np.eye(4)[axis]
        column = (after(s, 0.0) - after(-s, 0.0)) / (2 * h)
        np.testing.assert_allclose(lcs.A[:, axis], column, atol=1e-6)
    column = (after(np.zeros(4), h * max_force) - after(np.zeros(4), -h * max_force)) / (2 * h)
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


def test_stop_torques_push_like_a_held_torque_on_the_shoulder():
    """On stops so soft that their torque hardly changes within the step, in a mechanism without gravity."""
    soft = AcrobotParameters(limit_stiffness=1.0, gravity=0.0)
    lcs = true_lcs(soft, STEP)
    for side, column in ((1.0, 0), (-1.0, 1)):
        start = np.array([side * 0.6, 0, 0, 0])  # 0.4 rad into the stop: 0.4 N m
        after, force = lcs_step(lcs, start, np.zeros(1))
        np.testing.assert_allclose(force[column], 0.4, rtol=1e-3)
        assert force[1 - column] == 0.0
        np.testing.assert_allclose(after, integrate(start, 0.0, STEP, soft), atol=1e-5)


def test_gap_is_the_distance_to_each_wall_while_there_is_no_contact():
    lcs = true_lcs(PARAMETERS, STEP, gap_instant=0.0)
    state = np.array([0.1, 0.3, 0.05, -0.4])
    tip = 0.1 + 0.6 * 0.05
    np.testing.assert_allclose(lcs.D @ state + lcs.c, [0.35 - tip, 0.35 + tip], atol=1e-12)


def test_gap_is_the_angle_to_each_stop_while_there_is_no_contact():
    lcs = true_lcs(ACROBOT, STEP, gap_instant=0.0)
    np.testing.assert_allclose(lcs.D @ [0.05, 0.3, 1.0, -0.4] + lcs.c, [0.15, 0.25], atol=1e-12)


@pytest.mark.parametrize(
    ("parameters", "state"),
    [
        (PARAMETERS, [0.36, 0.0, 0.0, 0.0]),
        (PARAMETERS, [-0.33, -0.2, -0.05, -0.5]),
        (PARAMETERS, [0.3, 0.4, 0.1, 0.2]),
        (ACROBOT, [0.21, 0.0, 0.0, 0.0]),
        (ACROBOT, [-0.22, 0.1, -0.3, 0.5]),
        (ACROBOT, [0.195, -0.1, 2.0, -1.0]),
    ],
)
def test_one_step_in_contact_matches_the_integrated_equations(parameters, state):
    predicted, force = lcs_step(true_lcs(parameters, STEP, 100.0), np.array(state), np.array([0.05]))
    assert force.max() > 1.0
    exact = integrate(state, 5.0, STEP, parameters)
    change = np.abs(exact - state).max()
    assert np.abs(predicted - exact).max() < 0.05 * change


def near_a_contact(count: int, parameters: Plant) -> np.ndarray:
    """Random states within 3 cm of a wall's face, or 30 mrad of a stop's; near upright otherwise, so that the
    linearisation's other errors stay small beside those in the contact."""
    spread = {PARAMETERS: [0.35, 1.0, 0.15, 1.5], ACROBOT: [0.25, 0.1, 1.0, 0.5]}[parameters]
    rng, states = np.random.default_rng(0), []
    while len(states) < count:
        state = rng.uniform(-1, 1, 4) * spread
        if abs(parameters.contact_gaps(state).min()) < 0.03:
            states.append(state)
    return np.array(states)


@pytest.mark.parametrize(("parameters", "max_force"), [(PARAMETERS, 10.0), (PARAMETERS, 100.0), (ACROBOT, 10.0)])
def test_reading_the_gap_in_the_middle_of_the_step_is_best(parameters, max_force):
    states = near_a_contact(150, parameters)
    actions = np.random.default_rng(1).uniform(-1, 1, (150, 1))
    exact = np.array([integrate(s, max_force * a[0], STEP, parameters) for s, a in zip(states, actions, strict=True)])
    spread = (exact - states).std(axis=0)

    def error(lcs: LcsMatrices) -> float:
        predicted = [lcs_step(lcs, s, a)[0] for s, a in zip(states, actions, strict=True)]
        return float(np.sqrt(np.mean(((predicted - exact) / spread) ** 2)))

    start, middle, end = (
        error(true_lcs(parameters, STEP, max_force, gap_instant=instant)) for instant in (0.0, 0.5, 1.0)
    )
    assert 3.0 * middle < min(start, end)
    np.testing.assert_equal(error(true_lcs(parameters, STEP, max_force)), middle)


@both_plants
@pytest.mark.parametrize("gap_instant", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("control_step", [0.001, 0.01, 0.1])
def test_the_complementarity_problem_has_one_solution(parameters, gap_instant, control_step):
    F = true_lcs(parameters, control_step, gap_instant=gap_instant).F
    np.testing.assert_allclose(F, F.T, atol=1e-15)
    assert np.linalg.eigvalsh(F).min() > 0.0


@both_plants
def test_actions_are_in_units_of_the_scale(parameters):
    small, large = true_lcs(parameters, STEP, 10.0), true_lcs(parameters, STEP, 100.0)
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
