"""The relaxed problem with its states eliminated, and the derivative of its solution.

In ``x = (a_0 .. a_{H-1}, lam_0 .. lam_{H-1})`` the problem is

    minimise ½ xᵀ Q x + fᵀ x   subject to   x_low <= x <= x_high,   G x >= -g

where all states of a batch share ``Q`` and ``G``; only ``f`` and ``g`` differ. The derivative comes from the KKT system
on the active constraints (implicit function theorem, Amos and Kolter 2017): one small system a problem, then a pass
along the horizon that turns its solution into gradients of the shared model as sums of matrix products.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers.base import Solution

__all__ = ["CondensedProblem", "attach_gradient", "kkt_residual"]

# A multiplier above this share of the largest gradient entry counts its constraint as active.
_ACTIVE = 1e-9
# Far below the smallest curvature along a gap's normal.
_SHIFT = 1e-13


class CondensedProblem:
    """Maps from x = (actions, forces) and s_0 to states, gaps and cost; built once for a batch.

    :param problem: what the batch shares
    """

    def __init__(self, problem: RelaxedProblem) -> None:
        self.problem = problem
        A, B, C, d, D, E, F, c = problem.model
        n_x, n_a, n_c = problem.sizes
        H = problem.horizon
        self.n_actions, self.n = H * n_a, H * (n_a + n_c)
        # s_k = to_state[k] x + from_start[k] s_0 + offset[k]
        to_state = np.zeros((H + 1, n_x, self.n))
        from_start = np.zeros((H + 1, n_x, n_x))
        offset = np.zeros((H + 1, n_x))
        from_start[0] = np.eye(n_x)
        for k in range(H):
            to_state[k + 1] = A @ to_state[k]
            to_state[k + 1, :, k * n_a : (k + 1) * n_a] = B
            to_state[k + 1, :, self.n_actions + k * n_c : self.n_actions + (k + 1) * n_c] = C
            from_start[k + 1] = A @ from_start[k]
            offset[k + 1] = A @ offset[k] + d
        self._to_state, self._from_start, self._offset = to_state, from_start, offset

        steps = np.arange(H)
        take_action = np.zeros((H, n_a, self.n))
        take_force = np.zeros((H, n_c, self.n))
        for i in range(n_a):
            take_action[steps, i, steps * n_a + i] = 1.0
        for i in range(n_c):
            take_force[steps, i, self.n_actions + steps * n_c + i] = 1.0

        W, w, P, p = (
            problem.stage_weight,
            problem.stage_slope,
            problem.terminal_weight,
            problem.terminal_slope,
        )
        stage = np.concatenate([to_state[:H], take_action], axis=1)  # z_k = stage[k] x + ...
        weighted = (W @ stage).reshape(-1, self.n)
        terminal = P @ to_state[H]
        Q = 2.0 * (stage.reshape(-1, self.n).T @ weighted + to_state[H].T @ terminal)
        Q[range(self.n_actions, self.n), range(self.n_actions, self.n)] += 2.0 * problem.force_weight
        self.Q = (Q + Q.T) / 2
        weighted = weighted.reshape(H, n_x + n_a, self.n)[:, :n_x].reshape(-1, self.n)
        self._slope_from_start = 2.0 * (weighted.T @ from_start[:H].reshape(-1, n_x) + terminal.T @ from_start[H])
        self._slope = (
            2.0 * (weighted.T @ offset[:H].ravel() + terminal.T @ offset[H])
            + stage.reshape(-1, self.n).T @ np.tile(w, H)
            + to_state[H].T @ p
        )
        # phi = G x + gap_from_start s_0 + gap_offset
        self.G = (D @ to_state[:H] + E @ take_action + F @ take_force).reshape(H * n_c, self.n)
        self._gap_from_start = (D @ from_start[:H]).reshape(H * n_c, n_x)
        self._gap_offset = (offset[:H] @ D.T + c).ravel()
        forces = np.zeros(H * n_c)
        self.low = np.concatenate([np.tile(problem.action_low, H), forces])
        self.high = np.concatenate([np.tile(problem.action_high, H), forces + np.inf])

    def slope(self, s0: np.ndarray, weights: ComplementarityWeights) -> np.ndarray:
        """f (N, n)"""
        f = s0 @ self._slope_from_start.T + self._slope
        if self.G.size:
            f += weights.gap.reshape(len(s0), len(self.G)) @ self.G
            f[:, self.n_actions :] += weights.force.reshape(len(s0), len(self.G))
        return f

    def gap_offset(self, s0: np.ndarray) -> np.ndarray:
        """g (N, H n_lambda), the gaps at x = 0"""
        return s0 @ self._gap_from_start.T + self._gap_offset

    def expand(self, x: np.ndarray, s0: np.ndarray, solved: np.ndarray, multipliers: np.ndarray) -> Solution:
        """x (N, n) back to actions, states, forces and gaps."""
        _, n_a, n_c = self.problem.sizes
        H = self.problem.horizon
        states = np.tensordot(x, self._to_state, (1, 2)) + np.tensordot(s0, self._from_start, (1, 2)) + self._offset
        return Solution(
            actions=x[:, : self.n_actions].reshape(len(x), H, n_a),
            states=states,
            forces=x[:, self.n_actions :].reshape(len(x), H, n_c),
            gaps=(x @ self.G.T + self.gap_offset(s0)).reshape(len(x), H, n_c),
            solved=solved,
            multipliers=multipliers,
        )


def kkt_residual(
    problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights, solution: Solution
) -> np.ndarray:
    """Largest violation of the optimality conditions of the relaxed problem, (N,), relative to its slope's size.

    Stationarity, primal and dual feasibility and complementary slackness. Independent of how the solution was found.

    :raise ValueError: where the solution comes without multipliers
    """
    if solution.multipliers is None:
        raise ValueError("this solution has no multipliers, so its KKT residual cannot be taken")
    condensed = CondensedProblem(problem)
    n = condensed.n
    x = np.concatenate([solution.actions.reshape(len(s0), -1), solution.forces.reshape(len(s0), -1)], axis=1)
    f = condensed.slope(s0, weights)
    gap = x @ condensed.G.T + condensed.gap_offset(s0)
    bound, on_gap = solution.multipliers[:, :n], solution.multipliers[:, n:]
    parts = [
        np.abs(x @ condensed.Q + f + bound + on_gap @ condensed.G),
        np.maximum(condensed.low - x, 0.0),
        np.maximum(x - condensed.high, 0.0),
        np.maximum(-gap, 0.0),
        np.maximum(on_gap, 0.0),
        np.abs(on_gap * gap),
        np.where(bound < 0, np.minimum(-bound, np.abs(x - condensed.low)), 0.0),
        np.where(bound > 0, np.minimum(bound, np.abs(condensed.high - x)), 0.0),
    ]
    residual = np.concatenate(parts, axis=1).max(axis=1)
    return residual / (1.0 + np.abs(f).max(axis=1))


class _Actions(torch.autograd.Function):
    """The actions of a solution already found; its backward is the adjoint of the KKT system."""

    @staticmethod
    def forward(ctx: Any, condensed: CondensedProblem, gap_weight: np.ndarray, solution: Solution, *inputs: Any) -> Any:
        ctx.condensed, ctx.gap_weight, ctx.solution = condensed, gap_weight, solution
        ctx.device = inputs[0].device
        return torch.as_tensor(solution.actions, device=ctx.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> Any:
        gradients = _adjoint(ctx.condensed, ctx.gap_weight, ctx.solution, grad.detach().cpu().numpy())
        return (None, None, None, *(torch.as_tensor(g, device=ctx.device) for g in gradients))


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
    condensed: CondensedProblem, gap_weight: np.ndarray, solution: Solution, grad: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Gradients of ``Σ grad · actions`` with respect to s_0 and A, B, C, d, D, E, F, c.

    With the Lagrangian ``L(x; Theta)`` and the adjoint direction (δx, δmu) that solves the KKT system for ``-grad``,
    the gradient is ``d/dTheta`` of ``δxᵀ dL/dx + δmuᵀ dL/dmu``. Written with the states not eliminated, that needs the
    costates ``p`` and ``δp`` only, and each matrix of the model appears in one product.
    """
    problem = condensed.problem
    A, B, C, _, D, *_ = problem.model
    n_x, _, n_c = problem.sizes
    H, W = problem.horizon, problem.stage_weight
    n = len(grad)
    dx, dmu = _adjoint_direction(condensed, solution, grad)
    da = dx[:, : condensed.n_actions].reshape(n, H, -1)
    dlam = dx[:, condensed.n_actions :].reshape(n, H, n_c)
    dpi = dmu[:, condensed.n :].reshape(n, H, n_c)
    # the gap's coefficient in the Lagrangian: penalty weight plus multiplier
    assert solution.multipliers is not None
    pi = gap_weight + solution.multipliers[:, condensed.n :].reshape(n, H, n_c)

    s, a, lam = solution.states, solution.actions, solution.forces
    ds = np.zeros((n, H + 1, n_x))
    for k in range(H):
        ds[:, k + 1] = ds[:, k] @ A.T + da[:, k] @ B.T + dlam[:, k] @ C.T
    p = np.empty((n, H + 1, n_x))
    dp = np.empty((n, H + 1, n_x))
    p[:, H] = 2.0 * s[:, H] @ problem.terminal_weight + problem.terminal_slope
    dp[:, H] = 2.0 * ds[:, H] @ problem.terminal_weight
    for k in reversed(range(H)):
        p[:, k] = (
            p[:, k + 1] @ A
            + 2.0 * (s[:, k] @ W[:n_x, :n_x] + a[:, k] @ W[n_x:, :n_x])
            + problem.stage_slope[:n_x]
            + pi[:, k] @ D
        )
        dp[:, k] = dp[:, k + 1] @ A + 2.0 * (ds[:, k] @ W[:n_x, :n_x] + da[:, k] @ W[n_x:, :n_x]) + dpi[:, k] @ D

    def outer(left: np.ndarray, d_left: np.ndarray, right: np.ndarray, d_right: np.ndarray) -> np.ndarray:
        """Σ over batch and horizon of left d_rightᵀ + d_left rightᵀ"""
        flat = [part.reshape(n * H, -1) for part in (left, d_left, right, d_right)]
        return flat[0].T @ flat[3] + flat[1].T @ flat[2]

    p1, dp1 = p[:, 1:], dp[:, 1:]
    s_k, ds_k = s[:, :-1], ds[:, :-1]
    return (
        dp[:, 0],
        outer(p1, dp1, s_k, ds_k),
        outer(p1, dp1, a, da),
        outer(p1, dp1, lam, dlam),
        dp1.sum(axis=(0, 1)),
        outer(pi, dpi, s_k, ds_k),
        outer(pi, dpi, a, da),
        outer(pi, dpi, lam, dlam),
        dpi.sum(axis=(0, 1)),
    )


def _adjoint_direction(
    condensed: CondensedProblem, solution: Solution, grad: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the KKT system on the active constraints:

        Q δx + δmu_bound + Gᵀ δmu_gap = -grad,      δx = 0 at active bounds,      G δx = 0 at active gaps

    Active bounds fix their variable; what is left is one symmetric system of the free variables and the active gaps,
    padded to the most active gaps in the batch so that one batched solve does them all.
    """
    Q, G, n = condensed.Q, condensed.G, condensed.n
    multipliers = solution.multipliers
    assert multipliers is not None
    size = len(grad)
    full = np.zeros((size, n))
    full[:, : condensed.n_actions] = grad.reshape(size, -1)
    active = np.abs(multipliers) > _ACTIVE * (1.0 + np.abs(multipliers).max(axis=1, keepdims=True))
    free, on_gap = ~active[:, :n], active[:, n:]

    most = int(on_gap.sum(axis=1).max(initial=0))
    order = np.argsort(~on_gap, axis=1, kind="stable")[:, :most]
    used = np.take_along_axis(on_gap, order, axis=1)
    system = np.zeros((size, n + most, n + most))
    system[:, :n, :n] = np.where(free[:, :, None] & free[:, None, :], Q, np.eye(n))
    coupling = np.where(used[:, :, None] & free[:, None, :], G[order], 0.0)
    system[:, n:, :n], system[:, :n, n:] = coupling, coupling.transpose(0, 2, 1)
    # a redundant active gap makes the system singular; the small shift picks one of its solutions
    i = np.arange(n, n + most)
    system[:, i, i] = np.where(used, -_SHIFT, 1.0)
    rhs = np.concatenate([np.where(free, -full, 0.0), np.zeros((size, most))], axis=1)
    solved = np.linalg.solve(system, rhs[..., None])[..., 0]

    dx = solved[:, :n]
    dmu = np.zeros_like(multipliers)
    np.put_along_axis(dmu[:, n:], order, solved[:, n:], axis=1)
    dmu[:, :n] = np.where(free, 0.0, -(full + dx @ Q + dmu[:, n:] @ G))
    return dx, dmu
