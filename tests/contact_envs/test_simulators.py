"""Each engine simulates the described mechanism, reproducibly and apart from every other."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from contact_envs.dynamics import CartPoleParameters, integrate
from contact_envs.simulators import SIMULATORS, Simulator, simulator_class

PARAMETERS = CartPoleParameters()
CONTROL_STEP = 0.01
# start, force, control steps
FREE_FLIGHT = ([0.0, 0.5, 0.1, 0.5], 3.0, 20)
RIGHT_IMPACT = ([0.15, 0.8, 0.15, 0.5], 0.0, 25)
LEFT_IMPACT = ([-0.2, -0.4, -0.1, -1.0], -2.0, 25)


def make(engine: str, physics_step: float = 0.001, parameters: CartPoleParameters = PARAMETERS) -> Simulator:
    return simulator_class(engine)(parameters, physics_step, round(CONTROL_STEP / physics_step))


def run(simulator: Simulator, start, forces) -> np.ndarray:
    """(steps, 6) the state and the wall forces after each control step."""
    simulator.reset(np.array(start, dtype=np.float64))
    return np.array([np.concatenate(simulator.step(float(force))) for force in forces])


def exact(start, force: float, steps: int, parameters: CartPoleParameters = PARAMETERS) -> np.ndarray:
    return integrate(start, force, steps * CONTROL_STEP, parameters)


@pytest.mark.parametrize("case", [FREE_FLIGHT, RIGHT_IMPACT, LEFT_IMPACT])
def test_error_against_the_exact_motion_falls_with_the_physics_step(engine, case):
    start, force, steps = case
    reference = exact(*case)
    errors = []
    for physics_step in (0.002, 0.001, 0.0005):
        final = run(make(engine, physics_step), start, [force] * steps)[-1]
        assert (final[4:] >= 0).all()
        errors.append(np.abs(final[:4] - reference).max())
    # First order: half the step, half the error.
    assert 1.7 < errors[0] / errors[1] < 2.4
    assert 1.7 < errors[1] / errors[2] < 2.4
    assert errors[1] < (0.01 if case is FREE_FLIGHT else 0.3)


def test_a_very_small_physics_step_gives_the_exact_motion_of_an_impact(engine):
    start, force, steps = RIGHT_IMPACT
    final = run(make(engine, 2e-5), start, [force] * steps)[-1]
    np.testing.assert_allclose(final[:4], exact(*RIGHT_IMPACT), atol=0.01)


def test_every_parameter_reaches_the_engine(engine):
    odd = CartPoleParameters(1.3, 0.7, 0.9, 0.5, 0.2, 300.0, 3.7, 0.05)
    start, force, steps = [0.0, 0.6, 0.1, 0.5], 1.0, 25
    final = run(make(engine, 1e-4, odd), start, [force] * steps)
    assert final[:, 4].max() > 1.0
    np.testing.assert_allclose(final[-1, :4], exact(start, force, steps, odd), atol=0.02)


def test_fast_motion_is_not_cut_off(engine):
    start = [0.0, 0.0, 0.0, 150.0]
    final = run(make(engine, 1e-5), start, [0.0])[-1]
    np.testing.assert_allclose(final[:4], exact(start, 0.0, 1), rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("case", [FREE_FLIGHT, RIGHT_IMPACT, LEFT_IMPACT])
def test_engines_agree_with_each_other(both_engines, case):
    start, force, steps = case
    first, second = (run(make(name), start, [force] * steps) for name in both_engines)
    difference = np.abs(first - second)
    assert difference[:, [0, 2]].max() < 1e-3
    assert difference[:, [1, 3]].max() < 1e-2
    # Far closer than either is to the exact motion.
    assert difference[-1, :4].max() < 0.2 * np.abs(first[-1, :4] - exact(*case)).max()


@pytest.mark.parametrize(("case", "wall"), [(RIGHT_IMPACT, 0), (LEFT_IMPACT, 1)])
def test_wall_forces_are_the_impulse_of_the_impact(engine, case, wall):
    """The horizontal momentum changes by what the cart's force and the walls give."""
    start, force, steps = case
    p = PARAMETERS

    def momentum(state):
        _, x_dot, theta, theta_dot = state[:4]
        return (p.cart_mass + p.pole_mass) * x_dot + p.pole_mass * p.mass_centre * np.cos(theta) * theta_dot

    path = run(make(engine), start, [force] * steps)
    impulse = path[:, 4:].sum(axis=0) * CONTROL_STEP
    assert impulse[wall] > 0.1
    assert impulse[1 - wall] == 0.0
    gained = momentum(path[-1]) - momentum(np.array(start)) - force * steps * CONTROL_STEP
    np.testing.assert_allclose(impulse[1] - impulse[0], gained, rtol=0.02)


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


def test_same_start_and_forces_give_the_same_bits_whatever_ran_before(engine):
    rng = np.random.default_rng(0)
    used = make(engine)
    touched = 0
    for _ in range(15):
        start, forces = rng.uniform(-1, 1, 4) * [0.35, 1.0, 0.3, 1.0], rng.uniform(-20, 20, 40)
        fresh = run(make(engine), start, forces)
        # Left in the middle of whatever it was doing, often inside a wall.
        run(used, rng.uniform(-1, 1, 4) * [0.5, 1.0, 0.5, 1.0], rng.uniform(-30, 30, rng.integers(1, 30)))
        np.testing.assert_array_equal(run(used, start, forces), fresh)
        touched += bool(fresh[:, 4:].any())
    assert touched >= 5


def test_simulators_in_one_process_do_not_disturb_each_other(engine):
    rng = np.random.default_rng(1)
    forces = rng.uniform(-10, 10, (2, 30))
    alone = [run(make(engine), case[0], f) for case, f in zip((RIGHT_IMPACT, LEFT_IMPACT), forces, strict=True)]
    together = [make(engine), make(engine)]
    for simulator, case in zip(together, (RIGHT_IMPACT, LEFT_IMPACT), strict=True):
        simulator.reset(np.array(case[0]))
    paths = np.array(
        [[np.concatenate(simulator.step(f)) for simulator, f in zip(together, fs, strict=True)] for fs in forces.T]
    )
    np.testing.assert_array_equal(paths.swapaxes(0, 1), alone)
    together[0].close()
    together[1].step(0.0)


def test_closing_twice_is_harmless(engine):
    simulator = make(engine)
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
