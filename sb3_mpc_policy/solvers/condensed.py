"""The relaxed problem with its states eliminated, and its optimality conditions.

In ``x = (a_0 .. a_{H-1}, lam_0 .. lam_{H-1})`` the problem is

    minimise ½ xᵀ Q x + fᵀ x   subject to   x_low <= x <= x_high,   G x >= -g

where all states of a batch share ``Q`` and ``G``; only ``f`` and ``g`` differ.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers.base import Solution

__all__ = ["CondensedProblem"]

# What a model that explodes within the horizon leaves is not finite; the solvers reject it.
_may_explode = np.errstate(over="ignore", invalid="ignore")


class CondensedProblem:
    """Maps from x = (actions, forces) and s_0 to states, gaps and cost; built once for a batch.

    :param problem: what the batch shares
    """

    @_may_explode
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
        # all s_k in one column: to_state x + from_start s_0 + offset
        self.to_state = to_state.reshape(-1, self.n)
        self._start_to_state = from_start.reshape(-1, n_x).T.copy()
        self._from_start, self._offset = from_start, offset

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

    @_may_explode
    def slope(self, s0: np.ndarray, weights: ComplementarityWeights) -> np.ndarray:
        """f (N, n)"""
        f = s0 @ self._slope_from_start.T + self._slope
        if self.G.size:
            f += weights.gap.reshape(len(s0), len(self.G)) @ self.G
            f[:, self.n_actions :] += weights.force.reshape(len(s0), len(self.G))
        return f

    @_may_explode
    def gap_offset(self, s0: np.ndarray) -> np.ndarray:
        """g (N, H n_lambda), the gaps at x = 0"""
        return s0 @ self._gap_from_start.T + self._gap_offset

    @cached_property
    def to_costate(self) -> np.ndarray:
        """Square, (H+1) n_x: a row of the cost's slopes in s_0 .. s_H times this is the row of costates.

        ``p_k = Σ_{j>=k} (A^{j-k})ᵀ slope_j``: what the cost gains from a push of s_k.
        """
        n_x, _, _ = self.problem.sizes
        H = self.problem.horizon
        result = np.zeros((H + 1, n_x, H + 1, n_x))
        for k in range(H + 1):
            result[k:, :, k] = self._from_start[: H + 1 - k]
        return result.reshape((H + 1) * n_x, (H + 1) * n_x)

    @cached_property
    def is_finite(self) -> bool:
        """Whether the matrices that the problems share are."""
        return bool(np.isfinite(self.Q).all() and np.isfinite(self.G).all())

    @cached_property
    def condition(self) -> float:
        """LAPACK's estimate of Q's condition number in the 1-norm; infinite where Q is not positive definite."""
        if not np.isfinite(self.Q).all():
            return np.inf
        factor, failed = lapack.dpotrf(self.Q, lower=True)
        if failed:
            return np.inf
        reciprocal, _ = lapack.dpocon(factor, np.abs(self.Q).sum(axis=0).max(), uplo="L")
        return float(1.0 / reciprocal) if reciprocal > 0 else np.inf

    @_may_explode
    def residual(self, x: np.ndarray, multipliers: np.ndarray, f: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Violation of the optimality conditions (N,), see check.py.

        :param x: (N, n)
        :param multipliers: (N, n + H n_lambda), positive at upper bounds, negative at lower ones and at gaps
        :param f: :meth:`slope`
        :param g: :meth:`gap_offset`
        """
        gap = x @ self.G.T + g
        bound, on_gap = multipliers[:, : self.n], multipliers[:, self.n :]
        parts = [
            np.abs(x @ self.Q + f + bound + on_gap @ self.G),
            np.maximum(self.low - x, 0.0),
            np.maximum(x - self.high, 0.0),
            np.maximum(-gap, 0.0),
            np.maximum(on_gap, 0.0),
            np.abs(on_gap * gap),
            np.where(bound < 0, np.minimum(-bound, np.abs(x - self.low)), 0.0),
            np.where(bound > 0, np.minimum(bound, np.abs(self.high - x)), 0.0),
        ]
        worst: np.ndarray = np.concatenate(parts, axis=1).max(axis=1)
        return worst / (1.0 + np.abs(f).max(axis=1))

    @_may_explode
    def expand(self, x: np.ndarray, s0: np.ndarray, solved: np.ndarray, multipliers: np.ndarray) -> Solution:
        """x (N, n) back to actions, states, forces and gaps."""
        n_x, n_a, n_c = self.problem.sizes
        H = self.problem.horizon
        states = x @ self.to_state.T
        states += s0 @ self._start_to_state
        states += self._offset.ravel()
        return Solution(
            actions=x[:, : self.n_actions].reshape(len(x), H, n_a),
            states=states.reshape(len(x), H + 1, n_x),
            forces=x[:, self.n_actions :].reshape(len(x), H, n_c),
            gaps=(x @ self.G.T + self.gap_offset(s0)).reshape(len(x), H, n_c),
            solved=solved,
            multipliers=multipliers,
        )
