"""PIQP (Schwan, Jiang, Kuhn and Jones 2023), a proximal interior-point method: dense without the states, and staged.

The staged one factorises block by block along the horizon, as a Riccati recursion does, so that its time grows
linearly with the horizon.
"""

from __future__ import annotations

import numpy as np
import piqp

from benchmarks.rivals.base import TOLERANCE
from benchmarks.rivals.condensed import CondensedRival
from benchmarks.rivals.staged import StagedProblem, StagedRival
from sb3_mpc_policy.solvers.condensed import CondensedProblem

__all__ = ["PiqpDense", "PiqpMultistage"]


def _configure(settings: piqp.Settings) -> None:
    settings.eps_abs = settings.eps_duality_gap_abs = TOLERANCE
    settings.verbose = False


class PiqpDense(CondensedRival):
    """The problem without states, dense."""

    def _setup(self, condensed: CondensedProblem) -> None:
        self._solver = piqp.DenseSolver()
        _configure(self._solver.settings)
        gaps = dict(G=np.asfortranarray(condensed.G), h_l=np.zeros(len(condensed.G))) if len(condensed.G) else {}
        self._solver.setup(
            np.asfortranarray(condensed.Q), np.zeros(condensed.n), **gaps, x_l=condensed.low, x_u=condensed.high
        )

    def _solve_one(self, slope: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        self._solver.update(c=slope, **(dict(h_l=-offset) if len(offset) else {}))
        status = self._solver.solve()
        found = self._solver.result
        return found.x, np.concatenate([found.z_bu - found.z_bl, -found.z_l]), status == piqp.PIQP_SOLVED


class PiqpMultistage(StagedRival):
    """The problem with states, factorised stage by stage."""

    def _setup(self, staged: StagedProblem) -> None:
        self._solver = piqp.SparseSolver()
        _configure(self._solver.settings)
        self._solver.settings.kkt_solver = piqp.KKTSolver.sparse_multistage
        gaps = dict(G=staged.G, h_l=-staged.c) if len(staged.c) else {}
        self._solver.setup(staged.P, np.zeros(staged.n), staged.M, staged.b, **gaps, x_l=staged.low, x_u=staged.high)

    def _solve_one(self, q: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
        self._solver.update(c=q, b=b)
        status = self._solver.solve()
        found = self._solver.result
        return found.x, found.z_bu - found.z_bl, -found.z_l, status == piqp.PIQP_SOLVED
