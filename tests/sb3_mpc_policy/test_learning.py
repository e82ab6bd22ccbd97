"""The whole algorithm on real simulators: it learns, within the bounds that are promised."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

import sb3_mpc_policy
from benchmarks.evaluation import SOLVED, score
from benchmarks.learned_contacts import walls
from benchmarks.references import oracle
from sb3_mpc_policy.lcs import LcsMatrices

ENGINES = ("CartPoleSoftWalls-v0", "CartPoleSoftWallsPyBullet-v0")


def train(env_id: str, seed: int, steps: int, **policy_kwargs: object) -> tuple[PPO, list[float]]:
    """The trained model, and the returns of the training episodes that ended."""
    settings = sb3_mpc_policy.hyperparams(env_id)
    settings["policy_kwargs"] |= policy_kwargs
    env = Monitor(gym.make(env_id))
    model = PPO("MpcLcsPolicy", env, seed=seed, **settings)
    model.learn(steps)
    return model, env.get_episode_rewards()


def share_of_oracle(model: PPO, env_id: str) -> float:
    return score(model, env_id, n_episodes=10) / score(oracle(env_id), env_id, n_episodes=10)


def test_the_cart_pole_is_balanced_after_four_short_rollouts() -> None:
    env_id = "CartPoleSoftWallsPyBullet-v0"
    model, returns = train(env_id, seed=0, steps=256)
    assert share_of_oracle(model, env_id) >= SOLVED
    assert len(returns) <= 40


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ENGINES)
@pytest.mark.parametrize("seed", range(5))
def test_every_seed_balances_on_both_engines(env_id: str, seed: int) -> None:
    model, returns = train(env_id, seed, steps=512)
    assert share_of_oracle(model, env_id) >= SOLVED
    assert len(returns) <= 40


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_learned_reward_serves_as_well_as_a_known_one(seed: int) -> None:
    env_id = "CartPoleSoftWallsPyBullet-v0"
    model, _ = train(env_id, seed, steps=512, reward=None)
    assert share_of_oracle(model, env_id) >= SOLVED


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_the_inverted_pendulum_reaches_its_maximum_return_within_30_episodes(seed: int) -> None:
    _, returns = train("InvertedPendulum-v5", seed, steps=3_000)
    assert max(returns[:30]) == 1_000.0


@pytest.mark.slow
def test_pendulum_runs_with_no_arguments() -> None:
    model = PPO("MpcLcsPolicy", "Pendulum-v1", seed=0).learn(2_000)
    assert all(np.isfinite(parameter.detach().numpy()).all() for parameter in model.policy.parameters())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_contacts_stay_silent_where_there_are_none(seed: int) -> None:
    model, returns = train("InvertedPendulum-v5", seed, steps=1_500, n_contacts="auto")
    assert not model.policy.lcs.C.detach().numpy().any()
    assert max(returns) == 1_000.0


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["CartPoleSoftWallsHard-v0", "CartPoleSoftWallsHardPyBullet-v0"])
def test_the_walls_are_found_within_a_centimetre(env_id: str) -> None:
    model, _ = train(env_id, seed=0, steps=3_840)
    learned = walls(LcsMatrices(*(part.detach().numpy() for part in model.policy.lcs.matrices())))
    np.testing.assert_allclose(sorted(wall.position for wall in learned), [-0.35, 0.35], atol=0.01)
