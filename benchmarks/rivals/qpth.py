"""qpth (Amos and Kolter 2017), a batched dense interior-point method in torch, on the problem without states.

Its package asks for NumPy 1 and runs with NumPy 2: ``pip install --no-deps qpth``.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from qpth.qp import QPFunction

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers import Solution, Solver
from sb3_mpc_policy.solvers.condensed import CondensedProblem

__all__ = ["QpthRival"]


class QpthRival(Solver):
    """States are eliminated in torch, so that its own derivative reaches the model. Gives no multipliers."""

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        condensed = CondensedProblem(problem)
        data = (condensed.Q, condensed.slope(s0, weights), condensed.G, condensed.gap_offset(s0))
        with torch.no_grad():
            x = _solved(problem, *(torch.as_tensor(part) for part in data)).numpy()
        solution = condensed.expand(x, s0, np.isfinite(x).all(axis=1), x)
        return dataclasses.replace(solution, multipliers=None)

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        n_a = problem.sizes[1]
        x = _solved(problem, *_condensed(problem, model, s0, weights))
        return x[:, : problem.horizon * n_a].reshape(len(s0), problem.horizon, n_a)


def _solved(
    problem: RelaxedProblem, Q: torch.Tensor, f: torch.Tensor, G: torch.Tensor, g: torch.Tensor
) -> torch.Tensor:
    """x (N, n) that minimises ``½ xᵀ Q x + fᵀ x`` subject to ``G x >= -g`` and the bounds."""
    n_gaps, n = G.shape
    low = np.concatenate([np.tile(problem.action_low, problem.horizon), np.zeros(n_gaps)])
    high = np.concatenate([np.tile(problem.action_high, problem.horizon), np.full(n_gaps, np.inf)])
    at_low, at_high = np.flatnonzero(np.isfinite(low)), np.flatnonzero(np.isfinite(high))
    identity = torch.eye(n, dtype=Q.dtype)
    rows = torch.cat([-G, -identity[at_low], identity[at_high]])
    bounds = torch.as_tensor(np.concatenate([-low[at_low], high[at_high]]))
    right = torch.cat([g, bounds.expand(len(f), -1)], dim=1)
    none = torch.empty(0, dtype=Q.dtype)
    # expanded here, because for shared matrices it returns the mean of the gradients and not their sum
    Q, rows = Q.expand(len(f), -1, -1), rows.expand(len(f), -1, -1)
    return QPFunction(verbose=-1)(Q, f, rows, right, none, none)


def _condensed(
    problem: RelaxedProblem, model: LcsMatrices[torch.Tensor], s0: torch.Tensor, weights: ComplementarityWeights
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Q, f (N, n), G and g (N, H n_lambda) of the problem without states, with gradients to model and s0."""
    A, B, C, d, D, E, F, c = model
    n_x, n_a, n_c = problem.sizes
    H, n = problem.horizon, len(s0)
    identity = torch.eye(H * (n_a + n_c), dtype=s0.dtype)
    actions = identity[: H * n_a].reshape(H, n_a, len(identity))
    forces = identity[H * n_a :].reshape(H, n_c, len(identity))
    # s_k = to_state[k] x + free[k], k = 0 .. H
    to_state, free = [torch.zeros(n_x, len(identity), dtype=s0.dtype)], [s0]
    for k in range(H):
        to_state.append(A @ to_state[k] + B @ actions[k] + C @ forces[k])
        free.append(free[k] @ A.mT + d)
    X, at = torch.stack(to_state), torch.stack(free, dim=1)

    W, P = torch.as_tensor(problem.stage_weight), torch.as_tensor(problem.terminal_weight)
    stage = torch.cat([X[:H], actions], dim=1)  # z_k = stage[k] x + (free[k], 0)
    Q = 2.0 * ((stage.mT @ W @ stage).sum(dim=0) + X[H].mT @ P @ X[H])
    Q = Q + 2.0 * problem.force_weight * torch.diag((torch.arange(len(Q)) >= H * n_a).to(Q))
    on_z = 2.0 * at[:, :H] @ W[:n_x] + torch.as_tensor(problem.stage_slope)
    on_last = 2.0 * at[:, H] @ P + torch.as_tensor(problem.terminal_slope)
    G = (D @ X[:H] + E @ actions + F @ forces).reshape(H * n_c, len(identity))
    f = torch.einsum("nkz,kzx->nx", on_z, stage) + on_last @ X[H]
    f = f + torch.as_tensor(weights.gap).reshape(n, H * n_c) @ G
    f = f + torch.as_tensor(weights.force).reshape(n, H * n_c) @ identity[H * n_a :]
    return Q, f, G, (at[:, :H] @ D.mT + c).reshape(n, H * n_c)
