"""The terminal value ``V(s_H)`` of eq (6), one class a choice.

Each gives the cost beyond the horizon as a convex quadratic ``sᵀ P s + pᵀ s`` in scaled coordinates. It is taken
anew before each rollout and is a constant in between, as the data of a policy's gradient step must be.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import torch
from torch import nn

from sb3_mpc_policy.lqr import AffineLqr

__all__ = ["TERMINAL_VALUES", "CriticValue", "NoValue", "QuadraticCritic", "RiccatiValue", "TerminalValue"]


class QuadraticCritic(nn.Module):
    """PPO's critic restricted to a concave quadratic ``V(s) = v0 + vᵀ x − |L x|²``, ``x = s / state_scale``.

    :param state_scale: (n_x,)
    """

    state_scale: torch.Tensor

    def __init__(self, state_scale: torch.Tensor) -> None:
        super().__init__()
        n_states = len(state_scale)
        self.register_buffer("state_scale", state_scale.detach().clone().float())
        self.constant = nn.Parameter(torch.zeros(1))
        self.linear = nn.Parameter(torch.zeros(n_states))
        self.factor = nn.Parameter(torch.eye(n_states))

    def forward(self, s: torch.Tensor) -> torch.Tensor:
        """s: (N, n_x) environment units -> (N, 1)"""
        x = s / self.state_scale
        return (self.constant + x @ self.linear - (x @ self.factor.mT).square().sum(dim=-1)).unsqueeze(-1)


class TerminalValue(ABC):
    """The cost beyond the horizon."""

    needs_quadratic_critic = False

    @abstractmethod
    def quadratic(
        self, lqr: AffineLqr, critic: QuadraticCritic | None, reward_scale: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        :param lqr: regulator of the current model and reward
        :param critic: PPO's critic where it is quadratic
        :param reward_scale: what the rewards that the critic saw were divided by
        :return: P (n_x, n_x) positive semidefinite and p (n_x,), scaled coordinates
        """


class RiccatiValue(TerminalValue):
    """The undiscounted infinite-horizon cost of the current model without its contacts (lqr.py)."""

    def quadratic(
        self, lqr: AffineLqr, critic: QuadraticCritic | None, reward_scale: float
    ) -> tuple[np.ndarray, np.ndarray]:
        return lqr.P, lqr.p


class CriticValue(TerminalValue):
    """PPO's own critic, learned from the rewards, restricted to a concave quadratic."""

    needs_quadratic_critic = True

    def quadratic(
        self, lqr: AffineLqr, critic: QuadraticCritic | None, reward_scale: float
    ) -> tuple[np.ndarray, np.ndarray]:
        if critic is None:
            raise ValueError("terminal_value='critic' needs a critic, and none was given; use 'riccati' or 'none'")
        factor = critic.factor.detach().cpu().numpy().astype(np.float64)
        linear = critic.linear.detach().cpu().numpy().astype(np.float64)
        return reward_scale * factor.T @ factor, -reward_scale * linear


class NoValue(TerminalValue):
    """Nothing counts beyond the horizon."""

    def quadratic(
        self, lqr: AffineLqr, critic: QuadraticCritic | None, reward_scale: float
    ) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros_like(lqr.P), np.zeros_like(lqr.p)


TERMINAL_VALUES: dict[str, type[TerminalValue]] = {
    "riccati": RiccatiValue,
    "critic": CriticValue,
    "none": NoValue,
}
