"""The tuned settings: there for every environment, and in the form that PPO and RL Zoo take."""

from __future__ import annotations

from importlib import resources

import gymnasium as gym
import numpy as np
import pytest
import yaml
from stable_baselines3 import PPO

import contact_envs
from sb3_mpc_policy import hyperparams
from tests.sb3_mpc_policy.toy_environments import CART_POLE, policy_of

TABLE = yaml.safe_load((resources.files("sb3_mpc_policy") / "hyperparams" / "ppo.yml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("env_id", contact_envs.ENV_IDS)
def test_every_registered_environment_has_settings_that_ppo_takes(env_id: str) -> None:
    pytest.importorskip("pybullet" if "PyBullet" in env_id else "pydrake")
    model = PPO("MpcLcsPolicy", env_id, device="cpu", **hyperparams(env_id))
    assert np.isfinite(model.predict(np.zeros(4))[0]).all()


def test_the_settings_reach_ppo_and_the_policy() -> None:
    env = gym.make(CART_POLE).unwrapped
    model = PPO("MpcLcsPolicy", env, device="cpu", **hyperparams(CART_POLE))
    entry = TABLE[CART_POLE]
    assert (model.n_steps, model.batch_size, model.n_epochs) == tuple(
        entry[name] for name in ("n_steps", "batch_size", "n_epochs")
    )
    given = entry["learning_rate"]
    peak = float(given.removeprefix("lin_")) if isinstance(given, str) else given
    assert model.lr_schedule(1.0) == pytest.approx(peak)
    assert model.lr_schedule(0.5) == pytest.approx(peak / 2 if isinstance(given, str) else peak)
    # the reward is the environment's, with the action as a share of the greatest force
    weights = [*env.state_weights, env.action_weight * env.max_force**2]
    np.testing.assert_allclose(policy_of(model).mpc.cost_weight, np.diag(weights))


def test_an_unknown_environment_names_the_known_ones() -> None:
    with pytest.raises(KeyError, match=r"no hyperparameters for env_id 'CartPole-v1'.*CartPoleSoftWalls-v0"):
        hyperparams("CartPole-v1")


def test_changing_the_result_changes_nothing_for_the_next_caller() -> None:
    first = hyperparams(CART_POLE)
    first["policy_kwargs"].clear()
    first.clear()
    assert hyperparams(CART_POLE)["policy_kwargs"]


@pytest.mark.parametrize("env_id", sorted(TABLE))
def test_the_file_has_the_form_of_rl_zoo(env_id: str) -> None:
    entry = TABLE[env_id]
    assert entry["policy"] == "MpcLcsPolicy"
    assert isinstance(entry["n_timesteps"], float) and entry["n_timesteps"] > 0
    # the zoo evaluates strings for these two, and knows schedules by this prefix
    assert isinstance(eval(entry["policy_kwargs"]), dict)
    for name in ("learning_rate", "clip_range"):
        value = entry.get(name, 0.1)
        assert isinstance(value, (int, float)) or (value.startswith("lin_") and float(value.removeprefix("lin_")) > 0)
