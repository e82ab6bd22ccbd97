"""Controllers that know the true model: what a learned policy is measured against."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from scipy.linalg import solve_discrete_are

from benchmarks.evaluation import Controller
from contact_envs.cart_pole_soft_walls import CartPoleSoftWallsEnv
from contact_envs.soft_contact_env import SoftContactEnv
from sb3_mpc_policy import LcsMpc, LinearComplementaritySystem, QuadraticReward, hyperparams

CONTROLLER_SETTINGS = ("horizon", "terminal_value", "penalty", "smoothing", "n_iterations", "solver")
"""What the oracle shares with the policy."""


@contextlib.contextmanager
def contact_env(env_id: str | EnvSpec) -> Iterator[SoftContactEnv]:
    """An environment of ``contact_envs`` without its wrappers, to ask for its numbers.

    :param env_id: a registered id, or a specification with other arguments
    :raises TypeError: ``env_id`` names some other environment
    """
    with contextlib.closing(gym.make(env_id)) as env:
        plant = env.unwrapped
        if not isinstance(plant, SoftContactEnv):
            raise TypeError(f"env_id must name an environment of contact_envs, got {env_id!r}")
        yield plant


@contextlib.contextmanager
def cart_pole(env_id: str) -> Iterator[CartPoleSoftWallsEnv]:
    """As :func:`contact_env`, for what only a cart-pole has.

    :raises TypeError: ``env_id`` names some other environment
    """
    with contact_env(env_id) as plant:
        if not isinstance(plant, CartPoleSoftWallsEnv):
            raise TypeError(f"env_id must name a cart-pole with soft walls, got {env_id!r}")
        yield plant


def lqr(env_id: str | EnvSpec) -> Controller:
    """Linear-quadratic regulator of the true model without its contacts, for the environment's own reward.

    :param env_id: see :func:`contact_env`
    """
    with contact_env(env_id) as plant:
        model = plant.true_lcs()
        Q = np.diag(plant.state_weights)
        R = np.array([[plant.action_weight * plant.max_force**2]])
    P = solve_discrete_are(model.A, model.B, Q, R)
    K = np.linalg.solve(R + model.B.T @ P @ model.B, model.B.T @ P @ model.A)

    def act(observations: np.ndarray) -> np.ndarray:
        return -observations @ K.T

    return act


def oracle_controller(env_id: str | EnvSpec, **settings: Any) -> LcsMpc:
    """The learned policy's controller with the true model and the true reward: "MPC with true dynamics".

    Horizon, penalty, scales and the like are the environment's tuned ones; untuned, states are scaled by the
    reset range.

    :param env_id: see :func:`contact_env`
    :param settings: of :class:`LcsMpc`, in place of the tuned ones
    """
    tuned = hyperparams(env_id if isinstance(env_id, str) else env_id.id).get("policy_kwargs", {})
    with contact_env(env_id) as plant:
        space = plant.action_space
        assert isinstance(space, gym.spaces.Box)
        return LcsMpc(
            LinearComplementaritySystem.from_matrices(
                *plant.true_lcs(), state_scale=tuned.get("state_scale", plant.reset_range)
            ),
            QuadraticReward(plant.state_weights, plant.action_weight * plant.max_force**2),
            space.low,
            space.high,
            **{name: tuned[name] for name in CONTROLLER_SETTINGS if name in tuned} | settings,
        )


def oracle(env_id: str | EnvSpec) -> Controller:
    """:func:`oracle_controller`, as a controller to be scored."""
    controller = oracle_controller(env_id)

    def act(observations: np.ndarray) -> np.ndarray:
        return controller.plan(observations).actions[:, 0]

    return act
