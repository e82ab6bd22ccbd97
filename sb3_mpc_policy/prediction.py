"""The model's loss, eq (12), and how it joins PPO's, eq (15) and (16).

Both losses are measured in whitened coordinates: each component of the error divided by the standard deviation of
that component of ``s' − s`` in the data, so that no unit outweighs another.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from sb3_mpc_policy.lcp import LcpSolver
from sb3_mpc_policy.lcs import LinearComplementaritySystem

__all__ = ["PREDICTION_LOSSES", "add_to_backward", "prediction_loss", "step_deviation", "violation_loss"]

# Weight 1/epsilon of the complementarity's violation, in whitened units (Jin et al. 2022 use 1e-2 to 1e-4).
_VIOLATION_EPSILON = 1e-2


def step_deviation(s: np.ndarray, s_next: np.ndarray) -> np.ndarray:
    """(n_x,) standard deviation of the components of ``s' − s``; components that never move count as one whole."""
    deviation = (s_next - s).std(axis=0)
    return np.where(deviation > 1e-12, deviation, 1.0)


def prediction_loss(
    lcs: LinearComplementaritySystem,
    s: torch.Tensor,
    a: torch.Tensor,
    s_next: torch.Tensor,
    deviation: torch.Tensor,
) -> torch.Tensor:
    """Eq (12): mean over the data of ``|(s' − f(s, a)) / deviation|²``, through the complementarity problem.

    :param s: (N, n_x) float64, environment units
    :param a: (N, n_a) the action applied
    :param s_next: (N, n_x)
    :param deviation: (n_x,) > 0
    """
    error = (lcs.step(s, a) - s_next) / deviation
    return error.square().sum(dim=1).mean()


def violation_loss(
    lcs: LinearComplementaritySystem,
    s: torch.Tensor,
    a: torch.Tensor,
    s_next: torch.Tensor,
    deviation: torch.Tensor,
) -> torch.Tensor:
    """The loss of Jin, Aydinoglu, Halm and Posa (L4DC 2022), which has a gradient where no contact is active.

    The mean over the data of

        min over lam, phi >= 0 of  |(A s + B a + C lam + d − s') / deviation|²
                                   + 1/epsilon (lamᵀ phi + 1/(2 gamma) |D s + E a + F lam + c − phi|²)

    For ``gamma < lambda_min(F + Fᵀ)`` the inner problem is strictly convex. It is solved exactly, as the
    complementarity problem of its optimality conditions, and its minimiser is a constant in the gradient (envelope
    theorem). Arguments as in :func:`prediction_loss`.
    """
    A, B, C, d, D, E, F, c = lcs.scaled()
    x, u = s / lcs.state_scale, a / lcs.action_scale
    weight = lcs.state_scale / deviation
    free_error = (x @ A.mT + u @ B.mT + d - s_next / lcs.state_scale) * weight  # (N, n_x)
    if lcs.n_contacts == 0:
        return free_error.square().sum(dim=1).mean()
    push = C * weight[:, None]  # (n_x, n_lambda)
    q = x @ D.mT + u @ E.mT + c
    n = lcs.n_contacts
    with torch.no_grad():
        gamma = 0.5 * torch.linalg.eigvalsh(F + F.mT)[0].clamp(1e-6, 1.0)
        identity = torch.eye(n, dtype=F.dtype, device=F.device)
        # half of epsilon times the objective is ½ zᵀ H z + gᵀ z in z = (lam, phi)
        H = torch.cat(
            [
                torch.cat(
                    [2 * _VIOLATION_EPSILON * push.mT @ push + F.mT @ F / gamma, identity - F.mT / gamma],
                    dim=1,
                ),
                torch.cat([identity - F / gamma, identity / gamma], dim=1),
            ]
        )
        g = torch.cat([2 * _VIOLATION_EPSILON * free_error @ push + q @ F / gamma, -q / gamma], dim=1)
        z, _ = LcpSolver(H.cpu().numpy())(g.cpu().numpy())
        lam, phi = torch.as_tensor(z, device=F.device).split(n, dim=1)
    error = free_error + lam @ push.mT
    mismatch = q + lam @ F.mT - phi
    violation = (lam * phi).sum(dim=1) + mismatch.square().sum(dim=1) / (2 * gamma)
    return (error.square().sum(dim=1) + violation / _VIOLATION_EPSILON).mean()


Loss = Callable[[LinearComplementaritySystem, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]
PREDICTION_LOSSES: dict[str, Loss] = {"prediction": prediction_loss, "violation": violation_loss}


class _AddToBackward(torch.autograd.Function):
    """The identity, with a loss that is added to whatever is being minimised downstream."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor, loss: torch.Tensor) -> torch.Tensor:
        return value.view_as(value)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return grad, torch.ones((), dtype=torch.float64, device=grad.device)


def add_to_backward(value: torch.Tensor, loss: torch.Tensor) -> torch.Tensor:
    """Return ``value`` unchanged; ``backward`` through it also runs ``loss.backward()``.

    Eq (16): the gradient of ``L_clip + alpha L_pred`` without a change to the code that computes ``L_clip``. The value
    must enter the outer loss exactly once, whichever its weight there is.

    :param value: any tensor that is differentiated, such as the log-probabilities
    :param loss: a float64 number
    """
    return _AddToBackward.apply(value, loss)
