"""Probes measure what they say: each against something known beforehand."""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO

import sb3_mpc_policy  # noqa: F401 - registers the policy and the environments
from benchmarks.evaluation import RESET_SEEDS, controller_of, score
from benchmarks.probes import robustness
from benchmarks.probes.robustness import Change, changes
from benchmarks.references import contact_env, lqr
from contact_envs.dynamics import CartPoleParameters, integrate

HARD = "CartPoleSoftWallsHardPyBullet-v0"
ACROBOT = "AcrobotSoftLimitsPyBullet-v0"


def the_change(env_id: str, name: str, amount: float) -> Change:
    (found,) = (one for one in changes(env_id) if (one.change, one.amount) == (name, amount))
    return found


def still(observations: np.ndarray) -> np.ndarray:
    return np.zeros((len(observations), 1))


def trajectory(change: Change, actions: np.ndarray, seed: int = RESET_SEEDS[0]) -> np.ndarray:
    """(n+1, n_x) the observations of an episode under given actions."""
    with contextlib.closing(gym.make(change.spec)) as env:
        seen = [env.reset(seed=seed)[0]]
        for action in actions:
            seen.append(env.step(np.array([action], np.float32))[0])
    return np.array(seen)


# -- robustness --


@pytest.mark.parametrize("env_id", [HARD, ACROBOT])
def test_exactly_one_thing_differs_from_the_registered_environment(env_id: str) -> None:
    with contact_env(env_id) as registered:
        plant = registered.parameters
    for change in changes(env_id):
        with contact_env(change.spec) as env:
            assert (env.parameters != plant) is change.of_model, change
            assert bool(change.spec.additional_wrappers) is (change.change in ("noise", "delay")), change
    assert not gym.spec(env_id).additional_wrappers
    with contact_env(env_id) as registered:
        assert registered.parameters == plant


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_heavier_pole_is_heavier_in_the_equations_of_motion(factor: float) -> None:
    with contact_env(the_change(HARD, "pole mass", factor).spec) as env, contact_env(HARD) as registered:
        state = np.array([0.0, 0.3, 0.1, -0.4])
        x_ddot, theta_ddot = env.equations_of_motion(state, 1.0)[[1, 3]]
        cart, centre = registered.parameters.cart_mass, registered.parameters.mass_centre  # type: ignore[attr-defined]
        # the force changes the momentum of the cart and of the point mass at x + l_c sin(theta)
        of_pole = x_ddot + centre * (np.cos(0.1) * theta_ddot - np.sin(0.1) * 0.4**2)
        assert (1.0 - cart * x_ddot) / of_pole == pytest.approx(factor * registered.parameters.pole_mass)  # type: ignore[attr-defined]


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_longer_pole_touches_the_wall_from_further_away_and_falls_like_a_longer_pendulum(factor: float) -> None:
    with contact_env(the_change(HARD, "pole length", factor).spec) as env:
        tilted = np.array([0.0, 0.0, 1e-4, 0.0])
        tip = 0.35 - env.parameters.contact_gaps(tilted)[0]
        assert tip == pytest.approx(factor * 0.6e-4, rel=1e-6)
        A = env.true_lcs().A
    with contact_env(HARD) as registered:
        expected = registered.true_lcs().A
    # the rate of falling goes with 1 / sqrt(length)
    rates = [np.log(np.abs(np.linalg.eigvals(one)).max()) for one in (A, expected)]
    assert rates[0] / rates[1] == pytest.approx(factor**-0.5, rel=1e-6)


@pytest.mark.parametrize("stiffness", [200.0, 2000.0])
def test_a_changed_wall_pushes_with_its_own_stiffness_in_the_simulator(stiffness: float) -> None:
    deep = np.array([0.36, 0.0, 0.0, 0.0])
    spec = the_change(HARD, "wall stiffness", stiffness).spec
    spec.kwargs["physics_step"] = 1e-4  # the engine's error is of first order in it
    with contextlib.closing(gym.make(spec)) as env:
        env.reset(options={"state": deep})
        after = env.step(np.zeros(1, np.float32))[0]
    exact = integrate(deep, 0.0, 0.01, CartPoleParameters(wall_stiffness=stiffness))
    np.testing.assert_allclose(after[[1, 3]], exact[[1, 3]], rtol=0.01)


def test_a_lighter_link_of_the_acrobot_weighs_less() -> None:
    for name, share in (("upper mass", (0.7, 1.0)), ("lower mass", (1.0, 0.7))):
        with contact_env(the_change(ACROBOT, name, 0.7).spec) as env:
            lean = np.array([0.1, 0.0, 0.0, 0.0])
            energy = env.parameters.mechanical_energy(lean)
        upper, lower = 0.5 * 0.5 * share[0], 1.0 * 1.5 * share[1]  # mass times height, upright
        assert energy == pytest.approx(9.81 * np.cos(0.1) * (upper + lower))


def test_a_delayed_zero_is_a_zero() -> None:
    delay, nothing = the_change(HARD, "delay", 1.0), the_change(HARD, "nothing", 0.0)
    assert score(still, delay.spec, 3) == score(still, nothing.spec, 3)


def test_a_delayed_action_acts_one_step_later() -> None:
    actions = np.array([0.5, -0.3, 0.8, 0.1, -0.6])
    delayed = trajectory(the_change(HARD, "delay", 1.0), actions)
    late = trajectory(the_change(HARD, "nothing", 0.0), np.concatenate([[0.0], actions[:-1]]))
    np.testing.assert_array_equal(delayed, late)


def test_noise_is_of_the_size_it_says_and_leaves_the_motion_alone() -> None:
    actions = np.zeros(60)
    quiet = trajectory(the_change(HARD, "nothing", 0.0), actions)
    noise = [trajectory(the_change(HARD, "noise", share), actions) - quiet for share in (0.002, 0.01)]
    np.testing.assert_allclose(noise[1], 5.0 * noise[0], atol=1e-12)  # else the states would part ways
    np.testing.assert_allclose(noise[1].std(axis=0), 0.01 * np.array([0.35, 1.0, 0.3, 1.0]), rtol=0.4)
    again = trajectory(the_change(HARD, "noise", 0.01), actions) - quiet
    np.testing.assert_array_equal(again, noise[1])
    other = trajectory(the_change(HARD, "noise", 0.01), actions, seed=5)
    assert not np.allclose(other[0] - quiet[0], noise[1][0])


def test_what_is_scored_is_the_model_s_deterministic_policy() -> None:
    model = PPO("MlpPolicy", gym.make(HARD), n_steps=64, batch_size=64, seed=0, device="cpu")
    rows = robustness.probe(model, HARD, small=True)
    assert rows[0] == {"change": "nothing", "amount": 0.0, "quantity": "score",
                       "value": score(controller_of(model), HARD, 4)}  # fmt: skip
    assert len({(row["change"], row["amount"]) for row in rows}) == len(rows) == 11
    assert len({row["value"] for row in rows}) > 5


def test_the_table_of_references_tells_who_knows_of_the_change(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(robustness, "oracle", lambda env_id: asked.append(env_id) or lqr(env_id))
    robustness.main(["--env", HARD, "--episodes", "1", "--output", str(tmp_path / "table.csv")])
    lines = (tmp_path / "table.csv").read_text().splitlines()
    assert lines[0] == "env,controller,change,amount,quantity,value"
    assert len(lines) == 1 + 11 + 11 + 6
    assert asked[0] == HARD and all(spec.kwargs["parameters"] for spec in asked[1:]) and len(asked) == 7


def test_other_environments_are_refused() -> None:
    with pytest.raises(TypeError, match="env_id"):
        changes("Pendulum-v1")
