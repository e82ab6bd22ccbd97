"""The equations of motion are those of the described mechanism, and the reference integration is one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from contact_envs.dynamics import equations_of_motion, integrate, mechanical_energy, wall_forces
from contact_envs.plants import AcrobotParameters, CartPoleParameters, Plant

PARAMETERS = CartPoleParameters()
ACROBOT = AcrobotParameters()
# Unlike the default in every field, so that no two constants can be mistaken for one another.
ODD = CartPoleParameters(1.3, 0.7, 0.9, 0.5, 0.2, 300.0, 3.7)
ODD_ACROBOT = AcrobotParameters(1.1, 0.9, 0.4, 0.13, 1.3, 1.7, 0.8, 0.31, 0.15, 0.1, 200.0, 3.7)
PLANTS = [PARAMETERS, ODD, ACROBOT, ODD_ACROBOT]
SPREAD = {CartPoleParameters: [0.4, 1.5, 1.0, 3.0], AcrobotParameters: [0.4, 1.0, 1.5, 3.0]}


def random_states(count: int, seed: int = 0, plant: Plant = PARAMETERS) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 4)) * SPREAD[type(plant)]


def point_masses(q: np.ndarray, p: Plant) -> tuple[np.ndarray, np.ndarray]:
    """The masses (n,), and (n, 2) where they are: x and z."""
    if isinstance(p, CartPoleParameters):
        x, theta = q
        bob = [x + p.mass_centre * np.sin(theta), p.mass_centre * np.cos(theta)]
        return np.array([p.cart_mass, p.pole_mass]), np.array([[x, 0.0], bob])
    upper = np.array([np.sin(q[0]), np.cos(q[0])])
    lower = np.array([np.sin(q[0] + q[1]), np.cos(q[0] + q[1])])
    centres = [p.upper_mass_centre * upper, p.upper_length * upper + p.lower_mass_centre * lower]
    return np.array([p.upper_mass, p.lower_mass]), np.array(centres)


def spin_energy(q_dot: np.ndarray, p: Plant) -> float:
    """Of bodies that turn about their mass centres."""
    if isinstance(p, CartPoleParameters):
        return 0.0
    return 0.5 * p.upper_inertia * q_dot[0] ** 2 + 0.5 * p.lower_inertia * (q_dot[0] + q_dot[1]) ** 2


def spring_energy(q: np.ndarray, p: Plant) -> float:
    if isinstance(p, CartPoleParameters):
        tip = q[0] + p.pole_length * np.sin(q[1])
        return 0.5 * p.wall_stiffness * max(abs(tip) - p.wall_distance, 0.0) ** 2
    return 0.5 * p.limit_stiffness * max(abs(q[0]) - p.limit_angle, 0.0) ** 2


def applied(q_dot: np.ndarray, force: float, p: Plant) -> np.ndarray:
    """What the actuator and the dampers do to each joint."""
    if isinstance(p, CartPoleParameters):
        return np.array([force, 0.0])
    return np.array([0.0, force]) - p.damping * q_dot


def lagrangian(q: np.ndarray, q_dot: np.ndarray, p: Plant) -> float:
    """From where the masses are; their velocities by finite differences."""
    h = 1e-5
    masses, positions = point_masses(q, p)
    velocities = (point_masses(q + h * q_dot, p)[1] - point_masses(q - h * q_dot, p)[1]) / (2 * h)
    kinetic = 0.5 * masses @ (velocities**2).sum(axis=1) + spin_energy(q_dot, p)
    return kinetic - p.gravity * masses @ positions[:, 1] - spring_energy(q, p)


@pytest.mark.parametrize("parameters", PLANTS)
def test_motion_obeys_lagranges_equations(parameters):
    h, axes = 1e-3, np.eye(2)
    states = random_states(20, plant=parameters)
    for state, force in zip(states, np.linspace(-30, 30, 20), strict=True):
        q, q_dot = state[[*parameters.POSITIONS]], state[[*parameters.VELOCITIES]]
        derivative = equations_of_motion(state, force, parameters)
        np.testing.assert_array_equal(derivative[[*parameters.POSITIONS]], q_dot)
        q_ddot = derivative[[*parameters.VELOCITIES]]

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
        np.testing.assert_allclose(rate - generalised, applied(q_dot, force, parameters), atol=2e-3)


@pytest.mark.parametrize("parameters", PLANTS)
def test_energy_changes_by_what_the_actuator_gives_and_the_dampers_take(parameters):
    for state, force in zip(random_states(20, plant=parameters), np.linspace(-30, 30, 20), strict=True):
        q_dot = state[[*parameters.VELOCITIES]]
        derivative = equations_of_motion(state, force, parameters)
        h = 1e-7
        ahead, behind = (mechanical_energy(state + sign * h * derivative, parameters) for sign in (1.0, -1.0))
        power = applied(q_dot, force, parameters) @ q_dot
        np.testing.assert_allclose((ahead - behind) / (2 * h), power, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("parameters", [PARAMETERS, ACROBOT])
def test_equations_broadcast_over_states_and_forces(parameters):
    states, forces = random_states(6).reshape(2, 3, 4), np.arange(6.0).reshape(2, 3)
    batched = equations_of_motion(states, forces, parameters)
    assert batched.shape == (2, 3, 4)
    np.testing.assert_array_equal(batched[1, 2], equations_of_motion(states[1, 2], forces[1, 2], parameters))


def test_walls_are_one_sided_springs_at_the_tip():
    for tip, right, left in ((0.34, 0.0, 0.0), (0.36, 7.0, 0.0), (-0.45, 0.0, 70.0)):
        x = tip - 0.6 * np.sin(0.2)
        np.testing.assert_allclose(wall_forces([x, 0, 0.2, 0], PARAMETERS), [right, left], atol=1e-9)


def test_stops_are_one_sided_springs_at_the_shoulder():
    for shoulder, right, left in ((0.19, 0.0, 0.0), (0.21, 3.0, 0.0), (-0.4, 0.0, 60.0)):
        np.testing.assert_allclose(ACROBOT.contact_forces([shoulder, 0.7, 1.0, 1.0]), [right, left], atol=1e-9)


@pytest.mark.parametrize("parameters", [PARAMETERS, ODD, ACROBOT, dataclasses.replace(ODD_ACROBOT, damping=0.0)])
def test_reference_integration_conserves_energy_through_impacts(parameters):
    touched = 0
    for state in random_states(10, plant=parameters):
        path = [state]
        for _ in range(10):
            path.append(integrate(path[-1], 0.0, 0.05, parameters))
        touched += bool((parameters.contact_gaps(path) < 0.0).any())
        energy = mechanical_energy(path, parameters)
        np.testing.assert_allclose(energy, energy[0], rtol=0, atol=1e-9 * max(1.0, abs(energy[0])))
    assert touched >= 5


@pytest.mark.parametrize("parameters", [PARAMETERS, ACROBOT])
def test_reference_integration_agrees_with_another_method_that_ignores_touches(parameters):
    states = random_states(5, seed=1, plant=parameters)
    for state, force in zip(states, (-20.0, -5.0, 0.0, 5.0, 20.0), strict=True):
        other = solve_ivp(
            lambda _, s, u: equations_of_motion(s, u, parameters),
            (0, 0.1),
            state,
            "RK45",
            args=(force,),
            max_step=1e-4,
            rtol=1e-10,
            atol=1e-12,
        )
        np.testing.assert_allclose(integrate(state, force, 0.1, parameters), other.y[:, -1], atol=1e-7)


def test_reference_integration_starts_on_a_face_and_at_rest_on_it():
    weightless = dataclasses.replace(PARAMETERS, gravity=0.0)
    resting = integrate([0.35, 0, 0, 0], 0.0, 0.1, weightless)
    np.testing.assert_array_equal(resting, [0.35, 0, 0, 0])
    leaving = integrate([0.35, -1.0, 0, 0], 0.0, 0.1, weightless)
    np.testing.assert_allclose(leaving, [0.25, -1.0, 0, 0], atol=1e-10)


@pytest.mark.parametrize(
    ("plant", "field", "value", "error"),
    [
        (CartPoleParameters, "cart_mass", 0.0, ValueError),
        (CartPoleParameters, "pole_length", -0.6, ValueError),
        (CartPoleParameters, "wall_stiffness", float("nan"), ValueError),
        (CartPoleParameters, "wall_distance", float("inf"), ValueError),
        (CartPoleParameters, "gravity", -9.81, ValueError),
        (CartPoleParameters, "pole_mass", "0.4", TypeError),
        (CartPoleParameters, "mass_centre", True, TypeError),
        (AcrobotParameters, "lower_mass", 0.0, ValueError),
        (AcrobotParameters, "upper_inertia", -0.1, ValueError),
        (AcrobotParameters, "damping", -0.1, ValueError),
        (AcrobotParameters, "limit_angle", 0.0, ValueError),
        (AcrobotParameters, "limit_stiffness", None, TypeError),
    ],
)
def test_impossible_parameters_are_named(plant, field, value, error):
    with pytest.raises(error, match=field):
        plant(**{field: value})
