"""What PETS is told about the task is what the environment does."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest
import torch

from benchmarks.rivals.pets_task import reward_function, termination_function
from contact_envs.cart_pole_soft_walls import CartPoleSoftWallsEnv

SCALE = torch.tensor([100.0, 2.0, 50.0, 0.7], dtype=torch.float64)


@pytest.fixture
def plant() -> Iterator[CartPoleSoftWallsEnv]:
    with contextlib.closing(gym.make("CartPoleSoftWallsPyBullet-v0")) as env:
        assert isinstance(env.unwrapped, CartPoleSoftWallsEnv)
        yield env.unwrapped


def episodes(plant: CartPoleSoftWallsEnv) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States, actions (some beyond the bounds), rewards, next states and ends of episodes that end in each way."""
    rng = np.random.default_rng(0)
    rows = []
    for start in ([0.0, 0.0, 1.0, 1.0], [0.0, 0.0, -1.0, -1.0], [0.97, 6.0, -0.9, 0.0], [-0.97, -6.0, 0.9, 0.0]):
        state, _ = plant.reset(options={"state": start})
        terminated = False
        while not terminated:
            action = rng.uniform(-1.5, 1.5, size=1)
            next_state, reward, terminated, _, _ = plant.step(action)
            rows.append((state, action, reward, next_state, terminated))
            state = next_state
    states, actions, rewards, next_states, ends = (np.array(part) for part in zip(*rows, strict=True))
    assert len({(abs(s[0]) > plant.x_limit, s[0] > 0, s[2] > 0) for s in next_states[ends]}) == 4
    return states, actions, rewards, next_states, ends


def test_rewards_are_the_environments(plant: CartPoleSoftWallsEnv) -> None:
    states, actions, rewards, _, _ = episodes(plant)
    told = reward_function(plant, SCALE)(torch.as_tensor(actions), torch.as_tensor(states) * SCALE)
    np.testing.assert_allclose(told.numpy(), rewards[:, None], rtol=0.0, atol=1e-12)


def test_episodes_end_where_the_environments_do(plant: CartPoleSoftWallsEnv) -> None:
    _, actions, _, next_states, ends = episodes(plant)
    told = termination_function(plant, SCALE)(torch.as_tensor(actions), torch.as_tensor(next_states) * SCALE)
    assert told.dtype == torch.bool and not ends.all()
    np.testing.assert_array_equal(told.numpy(), ends[:, None])
