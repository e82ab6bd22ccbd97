"""Controllers that know the true model: what a learned policy is measured against."""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
from scipy.linalg import solve_discrete_are

from benchmarks.evaluation import Controller
from contact_envs.cart_pole_soft_walls import CartPoleSoftWallsEnv


def lqr(env_id: str) -> Controller:
    """Linear-quadratic regulator of the true model without its walls, for the environment's own reward.

    :param env_id: an environment with ``true_lcs()``, see :mod:`contact_envs`
    """
    with contextlib.closing(gym.make(env_id)) as env:
        plant: CartPoleSoftWallsEnv = env.unwrapped
        model = plant.true_lcs()
        Q = np.diag(plant.state_weights)
        R = np.array([[plant.action_weight * plant.max_force**2]])
    P = solve_discrete_are(model.A, model.B, Q, R)
    K = np.linalg.solve(R + model.B.T @ P @ model.B, model.B.T @ P @ model.A)
    return lambda observations: -observations @ K.T
