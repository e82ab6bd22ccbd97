"""Each engine simulates the described mechanism, reproducibly and apart from every other."""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import pytest

from contact_envs.dynamics import integrate
from contact_envs.plants import AcrobotParameters, CartPoleParameters, Plant
from contact_envs.simulators import SIMULATORS, Simulator, simulator_class

PARAMETERS = CartPoleParameters()
ACROBOT = AcrobotParameters()
CONTROL_STEP = 0.01


class Case(NamedTuple):
    """A motion under a constant force."""

    start: list[float]
    force: float
    steps: int
    parameters: Plant = PARAMETERS


FREE_FLIGHT = Case([0.0, 0.5, 0.1, 0.5], 3.0, 20)
RIGHT_IMPACT = Case([0.15, 0.8, 0.15, 0.5], 0.0, 25)
LEFT_IMPACT = Case([-0.2, -0.4, -0.1, -1.0], -2.0, 25)
FREE_FALL = Case([0.05, -0.1, 0.5, -1.0], 1.0, 20, ACROBOT)
RIGHT_STOP = Case([0.15, -0.2, 1.0, -0.5], 1.0, 25, ACROBOT)
LEFT_STOP = Case([-0.15, 0.1, -1.0, 0.0], -1.0, 25, ACROBOT)
CASES = {
    "cart-pole, free": FREE_FLIGHT,
    "cart-pole, right": RIGHT_IMPACT,
    "cart-pole, left": LEFT_IMPACT,
    "acrobot, free": FREE_FALL,
    "acrobot, right": RIGHT_STOP,
    "acrobot, left": LEFT_STOP,
}
every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
both_plants = pytest.mark.parametrize("parameters", [PARAMETERS, ACROBOT], ids=["cart-pole", "acrobot"])


def make(engine: str, physics_step: float = 0.001, parameters: Plant = PARAMETERS) -> Simulator:
    return simulator_class(engine)(parameters, physics_step, round(CONTROL_STEP / physics_step))


def run(simulator: Simulator, start, forces) -> np.ndarray:
    """(steps, 6) the state and the contacts' forces after each control step."""
    simulator.reset(np.array(start, dtype=np.float64))
    return np.array([np.concatenate(simulator.step(float(force))) for force in forces])


def exact(start, force: float, steps: int, parameters: Plant = PARAMETERS) -> np.ndarray:
    return integrate(start, force, steps * CONTROL_STEP, parameters)


@pytest.mark.parametrize(
    ("case", "largest"),
    [
        (FREE_FLIGHT, 0.01),
        (RIGHT_IMPACT, 0.3),
        (LEFT_IMPACT, 0.3),
        (FREE_FALL, 0.02),
        (RIGHT_STOP, 0.02),
        (LEFT_STOP, 0.02),
    ],
    ids=CASES.keys(),
)
def test_error_against_the_exact_motion_falls_with_the_physics_step(engine, case, largest):
    start, force, steps, parameters = case
    reference = exact(*case)
    errors = []
    for physics_step in (0.002, 0.001, 0.0005):
        final = run(make(engine, physics_step, parameters), start, [force] * steps)[-1]
        assert (final[4:] >= 0).all()
        errors.append(np.abs(final[:4] - reference).max())
    # First order: half the step, half the error.
    assert 1.7 < errors[0] / errors[1] < 2.4
    assert 1.7 < errors[1] / errors[2] < 2.4
    assert errors[1] < largest


@pytest.mark.parametrize("case", [RIGHT_IMPACT, RIGHT_STOP], ids=["cart-pole", "acrobot"])
def test_a_very_small_physics_step_gives_the_exact_motion_of_an_impact(engine, case):
    start, force, steps, parameters = case
    final = run(make(engine, 2e-5, parameters), start, [force] * steps)[-1]
    np.testing.assert_allclose(final[:4], exact(*case), atol=0.01)


@pytest.mark.parametrize(
    ("odd", "start"),
    [
        (CartPoleParameters(1.3, 0.7, 0.9, 0.5, 0.2, 300.0, 3.7, 0.05), [0.0, 0.6, 0.1, 0.5]),
        (AcrobotParameters(1.1, 0.9, 0.4, 0.13, 1.3, 1.7, 0.8, 0.31, 0.3, 0.1, 200.0, 3.7), [0.05, 0.2, 0.8, 0.5]),
    ],
    ids=["cart-pole", "acrobot"],
)
def test_every_parameter_reaches_the_engine(engine, odd, start):
    force, steps = 1.0, 25
    final = run(make(engine, 1e-4, odd), start, [force] * steps)
    assert final[:, 4].max() > 1.0
    np.testing.assert_allclose(final[-1, :4], exact(start, force, steps, odd), atol=0.02)


@both_plants
def test_fast_motion_is_not_cut_off(engine, parameters):
    start = [0.0, 0.0, 0.0, 150.0]
    final = run(make(engine, 1e-5, parameters), start, [0.0])[-1]
    np.testing.assert_allclose(final[:4], exact(start, 0.0, 1, parameters), rtol=2e-3, atol=2e-3)


@every_case
def test_engines_agree_with_each_other(both_engines, case):
    start, force, steps, parameters = case
    first, second = (run(make(name, parameters=parameters), start, [force] * steps) for name in both_engines)
    difference = np.abs(first - second)
    assert difference[:, parameters.POSITIONS].max() < 1e-3
    assert difference[:, parameters.VELOCITIES].max() < 1e-2
    # Far closer than either is to the exact motion.
    assert difference[-1, :4].max() < 0.2 * np.abs(first[-1, :4] - exact(*case)).max()


@pytest.mark.parametrize(("case", "wall"), [(RIGHT_IMPACT, 0), (LEFT_IMPACT, 1)])
def test_wall_forces_are_the_impulse_of_the_impact(engine, case, wall):
    """The horizontal momentum changes by what the cart's force and the walls give."""
    start, force, steps, p = case

    def momentum(state):
        _, x_dot, theta, theta_dot = state[:4]
        return (p.cart_mass + p.pole_mass) * x_dot + p.pole_mass * p.mass_centre * np.cos(theta) * theta_dot

    path = run(make(engine), start, [force] * steps)
    impulse = path[:, 4:].sum(axis=0) * CONTROL_STEP
    assert impulse[wall] > 0.1
    assert impulse[1 - wall] == 0.0
    gained = momentum(path[-1]) - momentum(np.array(start)) - force * steps * CONTROL_STEP
    np.testing.assert_allclose(impulse[1] - impulse[0], gained, rtol=0.02)


@pytest.mark.parametrize(("side", "stop"), [(1.0, 0), (-1.0, 1)])
def test_stop_torques_are_the_angular_impulse_on_the_acrobot(engine, side, stop):
    """Without gravity nothing else changes its angular momentum about the shoulder: the motor's torque is
    internal."""
    p = AcrobotParameters(gravity=0.0)

    def momentum(state):
        _, theta_2, dot_1, dot_2 = state[:4]
        lower = p.lower_mass * p.lower_mass_centre**2
        coupling = p.lower_mass * p.upper_length * p.lower_mass_centre * np.cos(theta_2)
        upper = p.upper_mass * p.upper_mass_centre**2 + p.lower_mass * p.upper_length**2
        return (upper + lower + 2 * coupling) * dot_1 + (lower + coupling) * dot_2

    start = side * np.array([0.0, -0.1, 2.0, 0.0])
    path = run(make(engine, parameters=p), start, [0.5 * side] * 25)
    impulse = path[:, 4:].sum(axis=0) * CONTROL_STEP
    assert impulse[stop] > 0.1
    assert impulse[1 - stop] == 0.0
    gained = momentum(path[-1]) - momentum(start)
    np.testing.assert_allclose(impulse[1] - impulse[0], gained, rtol=0.02)


def test_stop_torque_is_that_of_the_step_itself_and_not_of_the_one_before(engine):
    simulator = simulator_class(engine)(ACROBOT, 0.001, 1)
    for shoulder in (0.3, 0.0, -0.4):
        torques = run(simulator, [shoulder, 0.0, 0.0, 0.0], [0.0])[0, 4:]
        depth = np.maximum(np.array([shoulder, -shoulder]) - 0.2, 0.0)
        np.testing.assert_allclose(torques, 300.0 * depth, rtol=0.02)


def test_wall_force_is_that_of_the_step_itself_and_not_of_the_one_before(engine):
    simulator = simulator_class(engine)(PARAMETERS, 0.001, 1)
    for x in (0.45, 0.0, -0.5):
        forces = run(simulator, [x, 0.0, 0.0, 0.0], [0.0])[0, 4:]
        depth = np.maximum(np.array([x, -x]) - 0.35, 0.0)
        np.testing.assert_allclose(forces, 700.0 * depth, rtol=0.02)


def test_wall_force_deep_inside_a_wall_is_its_spring_force(engine):
    """Also further in than any wall is thick."""
    for x, wall in ((0.85, 0), (-0.85, 1), (1.6, 0)):
        forces = run(make(engine), [x, 0.0, 0.0, 0.0], [0.0])[0, 4:]
        np.testing.assert_allclose(forces[wall], 700.0 * (abs(x) - 0.35), rtol=0.12)
        assert forces[1 - wall] == 0.0


@both_plants
def test_same_start_and_forces_give_the_same_bits_whatever_ran_before(engine, parameters):
    rng = np.random.default_rng(0)
    used = make(engine, parameters=parameters)
    touched = 0
    for _ in range(15):
        start, forces = rng.uniform(-1, 1, 4) * [0.35, 1.0, 0.3, 1.0], rng.uniform(-20, 20, 40)
        fresh = run(make(engine, parameters=parameters), start, forces)
        # Left in the middle of whatever it was doing, often inside a wall.
        run(used, rng.uniform(-1, 1, 4) * [0.5, 1.0, 0.5, 1.0], rng.uniform(-30, 30, rng.integers(1, 30)))
        np.testing.assert_array_equal(run(used, start, forces), fresh)
        touched += bool(fresh[:, 4:].any())
    assert touched >= 5


@pytest.mark.parametrize(
    "cases",
    [(RIGHT_IMPACT, LEFT_IMPACT), (RIGHT_STOP, LEFT_STOP), (RIGHT_IMPACT, RIGHT_STOP)],
    ids=["cart-poles", "acrobots", "one of each"],
)
def test_simulators_in_one_process_do_not_disturb_each_other(engine, cases):
    rng = np.random.default_rng(1)
    forces = rng.uniform(-10, 10, (2, 30))
    alone = [
        run(make(engine, parameters=case.parameters), case.start, f) for case, f in zip(cases, forces, strict=True)
    ]
    together = [make(engine, parameters=case.parameters) for case in cases]
    for simulator, case in zip(together, cases, strict=True):
        simulator.reset(np.array(case.start))
    paths = np.array(
        [[np.concatenate(simulator.step(f)) for simulator, f in zip(together, fs, strict=True)] for fs in forces.T]
    )
    np.testing.assert_array_equal(paths.swapaxes(0, 1), alone)
    together[0].close()
    together[1].step(0.0)


@both_plants
def test_closing_twice_is_harmless(engine, parameters):
    simulator = make(engine, parameters=parameters)
    simulator.close()
    simulator.close()


@pytest.mark.parametrize("name", sorted(SIMULATORS))
def test_a_missing_engine_says_how_to_install_it(name, monkeypatch):
    package = {"drake": "pydrake", "pybullet": "pybullet"}[name]
    for module in [m for m in sys.modules if m.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.delitem(sys.modules, SIMULATORS[name].split(":")[0], raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf"pip install {name}.*pip install 'sb3-mpc-policy\[{name}\]'"):
        simulator_class(name)


def test_an_unknown_engine_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"simulator must be one of \['drake', 'pybullet'\], got 'mujoco'"):
        simulator_class("mujoco")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="displays are X's")
@pytest.mark.parametrize("display", [None, ":4711"])
def test_pybullets_window_without_a_display_is_an_error_and_not_a_crash(display, monkeypatch):
    pytest.importorskip("pybullet")
    monkeypatch.delenv("DISPLAY", raising=False)
    if display is not None:
        monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(RuntimeError, match="rgb_array"):
        simulator_class("pybullet")(PARAMETERS, 0.001, 10, viewer=True)
