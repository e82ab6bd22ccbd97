"""Small environments whose every step is known, and the runs that the tests of the policy share."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_mpc_policy import MpcLcsPolicy

CART_POLE = "CartPoleSoftWallsPyBullet-v0"


class PointMass(gym.Env[np.ndarray, np.ndarray]):
    """A mass on a line that a force moves, between two springy walls; it ends far from the origin.

    State (position, velocity), action in [-0.5, 0.5], reward ``3 − 2 x² − v² − 0.5 a²``. Resets jump far from where
    episodes end, so that a transition across a reset cannot pass for a true one.

    :param limit: the episode terminates beyond this position
    :param spoil_step: the observation of this step of the first episode is not a number; never where None
    :param flat_reward: a reward of one whatever happens
    """

    def __init__(self, limit: float = 0.6, spoil_step: int | None = None, flat_reward: bool = False) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = spaces.Box(-0.5, 0.5, (1,), np.float32)
        self.limit, self.spoil_step, self.flat_reward = limit, spoil_step, flat_reward
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.state = self.np_random.uniform([-0.3, -0.5], [0.3, 0.5])
        return self.state.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        (x, v), a = self.state, float(action[0])
        reward = 1.0 if self.flat_reward else 3.0 - 2.0 * x**2 - v**2 - 0.5 * a**2
        reward = float(np.float32(reward))  # some vectorised environments pass it on in that precision
        push = 20.0 * max(0.0, -0.5 - x) - 20.0 * max(0.0, x - 0.5)
        self.state = np.array([x + 0.1 * v, v + 0.1 * x + 0.4 * a + 0.1 * push])
        self.steps += 1
        seen = np.full(2, np.nan) if self.steps == self.spoil_step else self.state.copy()
        return seen, reward, abs(self.state[0]) > self.limit, False, {}


class Recorder(gym.Wrapper):
    """Keeps each transition (state, action received, reward, next state) from inside the environment."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.rows: list[np.ndarray] = []

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
        self.seen, info = self.env.reset(**kwargs)
        return self.seen, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        following, reward, terminated, truncated, info = self.env.step(action)
        self.rows.append(np.concatenate([self.seen, action, [reward], following]).astype(np.float64))
        self.seen = following
        return following, reward, terminated, truncated, info

    def recorded(self) -> np.ndarray:
        """(N, 2 n_x + n_a + 1), in the columns of ``TransitionStore.rows``."""
        return np.array(self.rows)


def point_mass(**kwargs: Any) -> gym.Env:
    """A recorded point mass that terminates at times and is truncated at others."""
    return Recorder(TimeLimit(PointMass(**kwargs), max_episode_steps=15))


def box_env(n_states: int, n_actions: int, bound: float = 1.0, seed: int = 0) -> gym.Env:
    """A random stable linear system with Box spaces of any size."""
    return TimeLimit(_LinearSystem(n_states, n_actions, bound, seed), max_episode_steps=20)


class _LinearSystem(gym.Env[np.ndarray, np.ndarray]):
    def __init__(self, n_states: int, n_actions: int, bound: float, seed: int) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (n_states,), np.float32)
        self.action_space = spaces.Box(-bound, bound, (n_actions,), np.float32)
        rng = np.random.default_rng(seed)
        self.A = 0.9 * np.linalg.qr(rng.normal(size=(n_states, n_states)))[0]
        self.B = 0.3 * rng.normal(size=(n_states, n_actions))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.state = self.np_random.normal(size=len(self.A))
        return self.state.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        reward = -float(self.state @ self.state)
        self.state = self.A @ self.state + self.B @ np.clip(action, -100.0, 100.0)
        return self.state.astype(np.float32), reward, False, False, {}


def small_ppo(env: gym.Env | VecEnv | str | None = None, **arguments: Any) -> PPO:
    """PPO with MpcLcsPolicy, quick: short rollouts, few epochs. Unknown keywords are the policy's."""
    settings: dict[str, Any] = dict(n_steps=32, batch_size=16, n_epochs=2, seed=0, device="cpu", verbose=0)
    known = {*settings, "learning_rate", "ent_coef", "vf_coef", "normalize_advantage", "clip_range", "max_grad_norm"}
    known |= {"gamma", "clip_range_vf"}
    settings |= {name: arguments.pop(name) for name in list(arguments) if name in known}
    quick: dict[str, Any] = dict(horizon=3)
    return PPO(
        "MpcLcsPolicy", point_mass(limit=0.4) if env is None else env, policy_kwargs=quick | arguments, **settings
    )


def policy_of(model: BaseAlgorithm) -> MpcLcsPolicy:
    assert isinstance(model.policy, MpcLcsPolicy)
    return model.policy


def several(count: int, **kwargs: Any) -> DummyVecEnv:
    """``count`` recorded point masses in one process."""
    return DummyVecEnv([lambda: point_mass(**kwargs)] * count)


def recorded(env: VecEnv) -> np.ndarray:
    """What the environments logged, in the order of a vectorised rollout: by step, then by environment."""
    logs = np.array(env.env_method("recorded"))  # (n_envs, n_steps, columns)
    return logs.swapaxes(0, 1).reshape(-1, logs.shape[-1])


def fingerprint(module: torch.nn.Module) -> str:
    """A hash of every bit of the parameters and buffers."""
    digest = hashlib.sha256()
    for name, value in sorted(module.state_dict().items()):
        digest.update(name.encode() + value.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def every_callback(callback: BaseCallback) -> Iterator[BaseCallback]:
    """A callback and all that it holds, at any depth."""
    yield callback
    for child in [*getattr(callback, "callbacks", []), getattr(callback, "callback", None)]:
        if isinstance(child, BaseCallback):
            yield from every_callback(child)
