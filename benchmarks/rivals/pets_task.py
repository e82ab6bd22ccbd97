"""What a planner over a learned model is told about a task, on batches of torch tensors: reward and end of episode.

Needs no package of a rival's, so that it can be checked against the environment wherever the tests run.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from contact_envs.cart_pole_soft_walls import CartPoleSoftWallsEnv

__all__ = ["TaskFunction", "reward_function", "termination_function"]

TaskFunction = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""Actions (N, 1) and scaled states (N, 4) -> (N, 1)."""


def reward_function(plant: CartPoleSoftWallsEnv, scale: torch.Tensor) -> TaskFunction:
    """The environment's reward.

    :param plant: whose numbers are taken
    :param scale: (4,) factors that the function's states have been multiplied by
    """
    weights = torch.as_tensor(plant.state_weights, dtype=scale.dtype) / scale.square()
    action_weight = plant.action_weight * plant.max_force**2

    def reward(actions: torch.Tensor, states: torch.Tensor) -> torch.Tensor:
        cost = states.square() @ weights + action_weight * actions.clamp(-1.0, 1.0).square().sum(dim=1)
        return (plant.reward_constant - cost)[:, None]

    return reward


def termination_function(plant: CartPoleSoftWallsEnv, scale: torch.Tensor) -> TaskFunction:
    """Whether an episode ends with a step that leads to these states.

    :param plant: whose limits are taken
    :param scale: see :func:`reward_function`
    """

    def terminated(actions: torch.Tensor, next_states: torch.Tensor) -> torch.Tensor:
        x, _, theta, _ = (next_states / scale).unbind(dim=1)
        return ((theta.abs() > plant.theta_limit) | (x.abs() > plant.x_limit))[:, None]

    return terminated
