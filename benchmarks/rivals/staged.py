"""The relaxed problem with its states kept: one sparse quadratic programme, a block of variables for each stage.

    minimise ½ zᵀ P z + qᵀ z   subject to   M z = b,   G z >= -c,   low <= z <= high

in ``z = (s_0, a_0, lam_0, s_1, .. , s_H)``. All states of a batch share everything but ``q`` and the first rows of
``b``. Its inequality multipliers are those of the problem without states.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import scipy.sparse as sp

from benchmarks.rivals.base import ForwardRival
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers import Solution

__all__ = ["StagedProblem", "StagedRival"]


class StagedProblem:
    """What the batch shares; built once for a batch.

    :param problem: the relaxed problem
    """

    def __init__(self, problem: RelaxedProblem) -> None:
        self.problem = problem
        A, B, C, d, D, E, F, c = problem.model
        n_x, n_a, n_c = problem.sizes
        H = problem.horizon
        stage = n_x + n_a + n_c
        self.n = H * stage + n_x
        # where s_k, a_k and lam_k stand in z
        first = np.arange(H)[:, None] * stage
        self.states = np.concatenate([first, [[H * stage]]]) + np.arange(n_x)
        self.actions = first + n_x + np.arange(n_a)
        self.forces = first + n_x + n_a + np.arange(n_c)

        weight = sp.block_diag([2.0 * problem.stage_weight, 2.0 * problem.force_weight * np.eye(n_c)])
        self.P = sp.csc_matrix(sp.block_diag([sp.kron(np.eye(H), weight), 2.0 * problem.terminal_weight]))
        # s_0 = s0 and s_{k+1} - A s_k - B a_k - C lam_k = d
        now = sp.hstack([sp.kron(np.eye(H), np.hstack([A, B, C])), sp.csc_matrix((H * n_x, n_x))])
        pick = sp.csc_matrix((np.ones(self.states.size), (np.arange(self.states.size), self.states.ravel())))
        self.M = sp.csc_matrix(pick - sp.vstack([sp.csc_matrix((n_x, self.n)), now]))
        self.b = np.concatenate([np.zeros(n_x), np.tile(d, H)])
        gaps = sp.hstack([sp.kron(np.eye(H), np.hstack([D, E, F])), sp.csc_matrix((H * n_c, n_x))])
        self.G, self.c = sp.csc_matrix(gaps), np.tile(c, H)
        self.low, self.high = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        self.low[self.actions], self.high[self.actions] = problem.action_low, problem.action_high
        self.low[self.forces] = 0.0
        self._q = np.zeros(self.n)
        self._q[np.concatenate([self.states[:-1], self.actions], axis=1)] = problem.stage_slope
        self._q[self.states[-1]] = problem.terminal_slope

    def data(self, s0: np.ndarray, weights: ComplementarityWeights) -> tuple[np.ndarray, np.ndarray]:
        """q (N, n) and b (N, n_equalities)"""
        q = np.tile(self._q, (len(s0), 1))
        q += weights.gap.reshape(len(s0), -1) @ self.G
        q[:, self.forces.ravel()] += weights.force.reshape(len(s0), -1)
        b = np.tile(self.b, (len(s0), 1))
        b[:, : s0.shape[1]] = s0
        return q, b

    def solution(self, z: np.ndarray, bound: np.ndarray, on_gap: np.ndarray, solved: np.ndarray) -> Solution:
        """From z (N, n), multipliers of its bounds (N, n), < 0 at the lower one, and of the gaps (N, H n_lambda)."""
        n, H = len(z), self.problem.horizon
        inner = np.concatenate([self.actions.ravel(), self.forces.ravel()])
        return Solution(
            actions=z[:, self.actions],
            states=z[:, self.states],
            forces=z[:, self.forces],
            gaps=(z @ self.G.T + self.c).reshape(n, H, -1),
            solved=solved,
            multipliers=np.concatenate([bound[:, inner], on_gap], axis=1),
        )


class StagedRival(ForwardRival):
    """Solves the sparse problem of each state in turn."""

    def __init__(self) -> None:
        self._staged: StagedProblem | None = None

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        if self._staged is None or self._staged.problem is not problem:
            self._staged = StagedProblem(problem)
            self._setup(self._staged)
        q, b = self._staged.data(s0, weights)
        z, bound = np.zeros_like(q), np.zeros_like(q)
        on_gap = np.zeros((len(s0), len(self._staged.c)))
        solved = np.zeros(len(s0), dtype=bool)
        for i in range(len(s0)):
            z[i], bound[i], on_gap[i], solved[i] = self._solve_one(q[i], b[i])
        return self._staged.solution(z, bound, on_gap, solved)

    @abstractmethod
    def _setup(self, staged: StagedProblem) -> None:
        """Prepare for a model."""

    @abstractmethod
    def _solve_one(self, q: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
        """z, multipliers of the bounds on z (< 0 at the lower one), multipliers of the gaps (<= 0), success"""
