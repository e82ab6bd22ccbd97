"""Clarabel, an interior-point method for cones, called directly on the sparse problem with its quadratic cost."""

from __future__ import annotations

import clarabel
import numpy as np
import scipy.sparse as sp

from benchmarks.rivals.base import TOLERANCE
from benchmarks.rivals.staged import StagedProblem, StagedRival

__all__ = ["ClarabelRival"]


class ClarabelRival(StagedRival):
    """One symbolic factorisation for the batch; a change of linear term and right-hand side for each problem."""

    def _setup(self, staged: StagedProblem) -> None:
        identity = sp.identity(staged.n, format="csc")
        self._low, self._high = np.flatnonzero(np.isfinite(staged.low)), np.flatnonzero(np.isfinite(staged.high))
        self._split = np.cumsum([len(staged.b), len(staged.c), len(self._low)])
        rows = sp.csc_matrix(sp.vstack([staged.M, -staged.G, -identity[self._low], identity[self._high]]))
        self._right = np.concatenate([staged.b, staged.c, -staged.low[self._low], staged.high[self._high]])
        inequalities = rows.shape[0] - len(staged.b)
        cones = [clarabel.ZeroConeT(len(staged.b))]
        if inequalities:
            cones.append(clarabel.NonnegativeConeT(inequalities))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        settings.presolve_enable = False  # it would rule out updates
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
        upper = sp.csc_matrix(sp.triu(staged.P))
        self._solver = clarabel.DefaultSolver(upper, np.zeros(staged.n), rows, self._right, cones, settings)

    def _solve_one(self, q: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
        self._right[: len(b)] = b
        self._solver.update(q=q, b=self._right)
        found = self._solver.solve()
        dual = np.array(found.z)
        _, on_gap, at_low, at_high = np.split(dual, self._split)
        bound = np.zeros(len(q))
        bound[self._high] = at_high
        bound[self._low] -= at_low
        return np.array(found.x), bound, -on_gap, found.status == clarabel.SolverStatus.Solved
