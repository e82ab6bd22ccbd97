"""Rivals that solve the problem with its states eliminated, one state after the other."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from benchmarks.rivals.base import ForwardRival
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers import Solution
from sb3_mpc_policy.solvers.condensed import CondensedProblem

__all__ = ["CondensedRival"]


class CondensedRival(ForwardRival):
    """Minimises ``½ xᵀ Q x + fᵀ x`` subject to bounds on x and ``G x >= -g``; only f and g differ in a batch."""

    def __init__(self) -> None:
        self._condensed: CondensedProblem | None = None

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        if self._condensed is None or self._condensed.problem is not problem:
            self._condensed = CondensedProblem(problem)
            self._setup(self._condensed)
        slope, offset = self._condensed.slope(s0, weights), self._condensed.gap_offset(s0)
        x = np.zeros_like(slope)
        multipliers = np.zeros((len(s0), self._condensed.n + len(self._condensed.G)))
        solved = np.zeros(len(s0), dtype=bool)
        for i in range(len(s0)):
            x[i], multipliers[i], solved[i] = self._solve_one(slope[i], offset[i])
        return self._condensed.expand(x, s0, solved, multipliers)

    @abstractmethod
    def _setup(self, condensed: CondensedProblem) -> None:
        """Prepare for a model."""

    @abstractmethod
    def _solve_one(self, slope: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """x, multipliers of its bounds and of the gaps (< 0 at a lower bound), success

        :param slope: f (n,)
        :param offset: g (H n_lambda,)
        """
