"""The derivative of a condensed problem's solution, eq (9) to (11): the adjoint of its KKT system.

Implicit function theorem on the active constraints (Amos and Kolter 2017). With the Lagrangian ``L(x; Theta)`` and the
direction (δx, δmu) that solves the KKT system for ``-grad``, the gradient of ``Σ grad · actions`` is ``d/dTheta`` of
``δxᵀ dL/dx + δmuᵀ dL/dmu``. Written with the states not eliminated, that needs the costates ``p`` and ``δp`` only, and
each matrix of the model appears in one product: the sum over batch and horizon is a matrix product too.

Where the solution sits on the edge of two modes its derivative jumps; this is the derivative with every constraint
that has no multiplier taken as inactive, one of the one-sided ones. A problem whose system is singular has none: its
gradient is zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights
from sb3_mpc_policy.solvers.active_set import active_constraints, solve_on_active_set
from sb3_mpc_policy.solvers.base import Solution
from sb3_mpc_policy.solvers.condensed import CondensedProblem

__all__ = ["attach_gradient"]


class _Actions(torch.autograd.Function):
    """The actions of a solution already found; its backward is the adjoint of the KKT system."""

    @staticmethod
    def forward(ctx: Any, condensed: CondensedProblem, gap_weight: np.ndarray, solution: Solution, *inputs: Any) -> Any:
        ctx.condensed, ctx.gap_weight, ctx.solution = condensed, gap_weight, solution
        return torch.as_tensor(solution.actions, device=inputs[0].device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> Any:
        return (None, None, None, *_adjoint(ctx.condensed, ctx.gap_weight, ctx.solution, grad))


def attach_gradient(
    condensed: CondensedProblem,
    model: LcsMatrices[torch.Tensor],
    s0: torch.Tensor,
    weights: ComplementarityWeights,
    solution: Solution,
) -> torch.Tensor:
    """The actions of ``solution`` (N, H, n_a), with gradients to the tensors of ``model`` and to ``s0``."""
    return _Actions.apply(condensed, weights.gap, solution, s0, *model)


def _adjoint(
    condensed: CondensedProblem, gap_weight: np.ndarray, solution: Solution, grad: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Gradients of ``Σ grad · actions`` with respect to s_0 and A, B, C, d, D, E, F, c."""
    problem = condensed.problem
    n_x, n_a, n_c = problem.sizes
    n, H = len(grad), problem.horizon

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, device=grad.device)

    assert solution.multipliers is not None
    multipliers = tensor(solution.multipliers)
    free, on_gap = active_constraints(multipliers, condensed.n)
    target = torch.cat([-grad.reshape(n, -1), grad.new_zeros(n, H * n_c)], dim=1)
    no_gap = grad.new_zeros(n, H * n_c)
    dx, dnu = solve_on_active_set(tensor(condensed.Q), tensor(condensed.G), free, on_gap, target, no_gap)
    lost = ~(dx.isfinite().all(dim=1) & dnu.isfinite().all(dim=1))
    dx[lost], dnu[lost] = 0.0, 0.0

    s, a, lam = tensor(solution.states), tensor(solution.actions), tensor(solution.forces)
    ds = (dx @ tensor(condensed.to_state).mT).reshape(n, H + 1, n_x)
    da = dx[:, : condensed.n_actions].reshape(n, H, n_a)
    dlam = dx[:, condensed.n_actions :].reshape(n, H, n_c)
    # a gap's coefficient in the Lagrangian: penalty weight plus multiplier
    pi = tensor(gap_weight) + multipliers[:, condensed.n :].reshape(n, H, n_c)
    dpi = dnu.reshape(n, H, n_c)

    W, D, w = tensor(problem.stage_weight[:, :n_x]), tensor(problem.model.D), tensor(problem.stage_slope[:n_x])
    P, to_costate = 2.0 * tensor(problem.terminal_weight), tensor(condensed.to_costate)

    def costates(slope: torch.Tensor, s: torch.Tensor, a: torch.Tensor, pi: torch.Tensor, at_end: Any) -> torch.Tensor:
        stage = 2.0 * torch.cat([s[:, :-1], a], dim=2) @ W + slope + pi @ D
        pushed = torch.cat([stage, (s[:, -1] @ P + at_end)[:, None]], dim=1)
        return (pushed.reshape(n, -1) @ to_costate).reshape(n, H + 1, n_x)

    p = costates(w, s, a, pi, tensor(problem.terminal_slope))
    dp = costates(torch.zeros_like(w), ds, da, dpi, 0.0)

    def outer(left: torch.Tensor, d_left: torch.Tensor, right: torch.Tensor, d_right: torch.Tensor) -> torch.Tensor:
        """Σ over batch and horizon of left d_rightᵀ + d_left rightᵀ"""
        flat = [part.reshape(n * H, -1) for part in (left, d_left, right, d_right)]
        return flat[0].mT @ flat[3] + flat[1].mT @ flat[2]

    p[lost] = 0.0
    p1, dp1 = p[:, 1:], dp[:, 1:]
    s_k, ds_k = s[:, :-1], ds[:, :-1]
    return (
        dp[:, 0],
        outer(p1, dp1, s_k, ds_k),
        outer(p1, dp1, a, da),
        outer(p1, dp1, lam, dlam),
        dp1.sum(dim=(0, 1)),
        outer(pi, dpi, s_k, ds_k),
        outer(pi, dpi, a, da),
        outer(pi, dpi, lam, dlam),
        dpi.sum(dim=(0, 1)),
    )
