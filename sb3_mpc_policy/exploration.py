"""Exploration beside the Gaussian noise of eq (1): rollouts around a target that wanders.

A controller that works never comes near the walls, and white noise hardly moves it there. So rollouts may take place
around other steady states than the target: the policy's mean is ``mu(s − s_e) + a_e`` with ``s_e = A s_e + B a_e`` of
the learned model. The shift ``(s_e, a_e)`` is constant over a rollout and the update on it, so the probability ratio of
PPO compares like with like: it is exploration in the policy's parameters (Plappert et al. 2018), of a few that are
known to keep the system upright. It is drawn at random, and then its opposite, so that both sides are seen.
"""

from __future__ import annotations

import numpy as np
import torch

from sb3_mpc_policy.lcs import LinearComplementaritySystem

__all__ = ["MOST_NOISE", "WanderingTarget"]

# Standard deviation of the Gaussian, as a share of half the range of a bounded action. Of wider noise the clipped
# action is hardly more than one bound or the other, and PPO widens it without end where actions saturate.
MOST_NOISE = 0.5

_HELD = 9  # rollouts on one side
_APPROACH = 0.6  # share of the way there in each rollout
_LEAST_SIZE, _LARGEST_SIZE = 1.0, 1.3  # of a shift


class WanderingTarget:
    """The shift of the rollouts' target.

    :param size: >= 0, least size of ``(s_e, a_e)`` in scaled units; 0 for none
    """

    def __init__(self, n_states: int, n_actions: int, size: float) -> None:
        if not (np.isfinite(size) and size >= 0):
            raise ValueError(f"target_noise must be a finite number >= 0, got {size!r}")
        self.n_states, self.n_actions, self.size = n_states, n_actions, float(size)
        self.reset()

    def reset(self) -> None:
        """Back to the target itself."""
        self.state, self.action = np.zeros(self.n_states), np.zeros(self.n_actions)
        self._goal = np.zeros(self.n_states + self.n_actions)
        self._spread = 0.0
        self._moves = 0

    @property
    def is_shifted(self) -> bool:
        return bool(self.state.any() or self.action.any())

    @torch.no_grad()
    def move(self, lcs: LinearComplementaritySystem) -> None:
        """Choose the shift of the coming rollout.

        :param lcs: model whose steady states are meant
        """
        if not self.size:
            return
        if self._moves % (2 * _HELD) == 0:
            self._goal = torch.randn(self.n_states + self.n_actions, dtype=torch.float64).numpy()
            self._spread = _LEAST_SIZE + (_LARGEST_SIZE - _LEAST_SIZE) * torch.rand(1).item()
        elif self._moves % _HELD == 0:
            self._goal = -self._goal
        self._moves += 1
        A, B = (part.cpu().numpy() for part in (lcs.A_scaled, lcs.B_scaled))
        # (A − I) s_e + B a_e = 0: at least as many directions as there are actions
        steady = np.linalg.svd(np.hstack([A - np.eye(self.n_states), B]))[2][self.n_states :]
        # the one nearest to the goal: singular vectors alone come with either sign, and turn where the model changes
        goal = steady.T @ (steady @ self._goal)
        goal *= self.size * self._spread / np.linalg.norm(goal)
        scale = lcs.state_scale.cpu().numpy(), lcs.action_scale.cpu().numpy()
        self.state += _APPROACH * (goal[: self.n_states] * scale[0] - self.state)
        self.action += _APPROACH * (goal[self.n_states :] * scale[1] - self.action)
