"""The equations of motion are those of the described mechanism, and the reference integration is one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from contact_envs.dynamics import (
    CartPoleParameters,
    equations_of_motion,
    integrate,
    mechanical_energy,
    tip_position,
    wall_forces,
)

PARAMETERS = CartPoleParameters()
# Unlike the default in every field, so that no two constants can be mistaken for one another.
ODD = CartPoleParameters(1.3, 0.7, 0.9, 0.5, 0.2, 300.0, 3.7)


def random_states(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 4)) * [0.4, 1.5, 1.0, 3.0]


def lagrangian(q: np.ndarray, q_dot: np.ndarray, p: CartPoleParameters) -> float:
    """From the positions of the two point masses and the tip alone; their velocities by finite
    differences."""

    def masses(q: np.ndarray) -> np.ndarray:
        x, theta = q
        return np.array([x, 0.0, x + p.mass_centre * np.sin(theta), p.mass_centre * np.cos(theta)])

    h = 1e-5
    velocity = (masses(q + h * q_dot) - masses(q - h * q_dot)) / (2 * h)
    kinetic = 0.5 * p.cart_mass * velocity[:2] @ velocity[:2] + 0.5 * p.pole_mass * velocity[2:] @ velocity[2:]
    tip = q[0] + p.pole_length * np.sin(q[1])
    spring = 0.5 * p.wall_stiffness * max(abs(tip) - p.wall_distance, 0.0) ** 2
    return kinetic - p.pole_mass * p.gravity * masses(q)[3] - spring


@pytest.mark.parametrize("parameters", [PARAMETERS, ODD])
def test_motion_obeys_lagranges_equations(parameters):
    h, axes = 1e-3, np.eye(2)
    for state, force in zip(random_states(20), np.linspace(-30, 30, 20), strict=True):
        q, q_dot = state[[0, 2]], state[[1, 3]]
        q_ddot = equations_of_motion(state, force, parameters)[[1, 3]]

        def momentum(q, q_dot):
            return np.array(
                [
                    (lagrangian(q, q_dot + h * e, parameters) - lagrangian(q, q_dot - h * e, parameters)) / (2 * h)
                    for e in axes
                ]
            )

        t = 1e-4
        rate = (
            momentum(q + t * q_dot + 0.5 * t**2 * q_ddot, q_dot + t * q_ddot)
            - momentum(q - t * q_dot + 0.5 * t**2 * q_ddot, q_dot - t * q_ddot)
        ) / (2 * t)
        generalised = np.array(
            [
                (lagrangian(q + 1e-6 * e, q_dot, parameters) - lagrangian(q - 1e-6 * e, q_dot, parameters)) / 2e-6
                for e in axes
            ]
        )
        np.testing.assert_allclose(rate - generalised, [force, 0.0], atol=2e-3)


def test_equations_broadcast_over_states_and_forces():
    states, forces = random_states(6).reshape(2, 3, 4), np.arange(6.0).reshape(2, 3)
    batched = equations_of_motion(states, forces, PARAMETERS)
    assert batched.shape == (2, 3, 4)
    np.testing.assert_array_equal(batched[1, 2], equations_of_motion(states[1, 2], forces[1, 2], PARAMETERS))


def test_walls_are_one_sided_springs_at_the_tip():
    for tip, right, left in ((0.34, 0.0, 0.0), (0.36, 7.0, 0.0), (-0.45, 0.0, 70.0)):
        x = tip - 0.6 * np.sin(0.2)
        np.testing.assert_allclose(wall_forces([x, 0, 0.2, 0], PARAMETERS), [right, left], atol=1e-9)


@pytest.mark.parametrize("parameters", [PARAMETERS, ODD])
def test_reference_integration_conserves_energy_through_impacts(parameters):
    touched = 0
    for state in random_states(10):
        path = [state]
        for _ in range(10):
            path.append(integrate(path[-1], 0.0, 0.05, parameters))
        touched += bool((np.abs(tip_position(path, parameters)) > parameters.wall_distance).any())
        energy = mechanical_energy(path, parameters)
        np.testing.assert_allclose(energy, energy[0], rtol=0, atol=1e-9 * max(1.0, abs(energy[0])))
    assert touched >= 5


def test_reference_integration_agrees_with_another_method_that_ignores_touches():
    for state, force in zip(random_states(5, seed=1), (-20.0, -5.0, 0.0, 5.0, 20.0), strict=True):
        other = solve_ivp(
            lambda _, s, u: equations_of_motion(s, u, PARAMETERS),
            (0, 0.1),
            state,
            "RK45",
            args=(force,),
            max_step=1e-4,
            rtol=1e-10,
            atol=1e-12,
        )
        np.testing.assert_allclose(integrate(state, force, 0.1), other.y[:, -1], atol=1e-7)


def test_reference_integration_starts_on_a_face_and_at_rest_on_it():
    weightless = dataclasses.replace(PARAMETERS, gravity=0.0)
    resting = integrate([0.35, 0, 0, 0], 0.0, 0.1, weightless)
    np.testing.assert_array_equal(resting, [0.35, 0, 0, 0])
    leaving = integrate([0.35, -1.0, 0, 0], 0.0, 0.1, weightless)
    np.testing.assert_allclose(leaving, [0.25, -1.0, 0, 0], atol=1e-10)


@pytest.mark.parametrize(
    ("field", "value", "error"),
    [
        ("cart_mass", 0.0, ValueError),
        ("pole_length", -0.6, ValueError),
        ("wall_stiffness", float("nan"), ValueError),
        ("wall_distance", float("inf"), ValueError),
        ("gravity", -9.81, ValueError),
        ("pole_mass", "0.4", TypeError),
        ("mass_centre", True, TypeError),
    ],
)
def test_impossible_parameters_are_named(field, value, error):
    with pytest.raises(error, match=field):
        CartPoleParameters(**{field: value})
