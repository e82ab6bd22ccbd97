"""The dual active-set method DAQP (Arnström, Bemporad and Axehill 2022) on the condensed problem: exact, and quick."""

from __future__ import annotations

import daqp
import numpy as np
import torch

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers.base import Solution, Solver
from sb3_mpc_policy.solvers.condensed import CondensedProblem, attach_gradient

__all__ = ["DaqpSolver"]

_UNBOUNDED = 1e30  # DAQP's infinity
_OPTIMAL = 1  # exit flag
_ACTIVE_AT_LOWER = 1 | 2  # constraint flags
# On a few ill-conditioned problems the plain method cycles; its proximal-point form solves those, at more iterations.
_ATTEMPTS: dict[str, dict[str, float]] = {
    "plain": {"primal_tol": 1e-9},
    "proximal": {"primal_tol": 1e-9, "eps_prox": 1e-6},
}


class DaqpSolver(Solver):
    """One factorisation for the batch; a change of linear term and bounds for each problem."""

    def __init__(self) -> None:
        self._condensed: CondensedProblem | None = None
        self._models: dict[str, daqp.Model] = {}

    def _prepare(self, problem: RelaxedProblem) -> CondensedProblem:
        if self._condensed is None or self._condensed.problem is not problem:
            self._condensed = CondensedProblem(problem)
            self._models = {}
        return self._condensed

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        condensed = self._prepare(problem)
        n_gaps = len(condensed.G)
        slope = condensed.slope(s0, weights)
        upper = np.minimum(np.concatenate([condensed.high, np.full(n_gaps, _UNBOUNDED)]), _UNBOUNDED)
        lower = np.empty((len(s0), condensed.n + n_gaps))
        lower[:, : condensed.n] = np.maximum(condensed.low, -_UNBOUNDED)
        lower[:, condensed.n :] = -condensed.gap_offset(s0)
        guess = _guessed_active_set(condensed, weights)

        x, multipliers = np.zeros_like(slope), np.zeros_like(lower)
        solved = np.zeros(len(s0), dtype=bool)
        if np.isfinite(condensed.Q).all() and np.isfinite(condensed.G).all():
            for i in np.flatnonzero(np.isfinite(slope).all(axis=1) & np.isfinite(lower).all(axis=1)):
                for attempt in _ATTEMPTS:
                    x[i], multipliers[i], solved[i] = self._solve_one(
                        attempt, condensed, slope[i], upper, lower[i], guess[i]
                    )
                    if solved[i]:
                        break
        return condensed.expand(x, s0, solved, multipliers)

    def _solve_one(
        self,
        attempt: str,
        condensed: CondensedProblem,
        slope: np.ndarray,
        upper: np.ndarray,
        lower: np.ndarray,
        guess: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        model = self._models.get(attempt)
        if model is None:
            model = daqp.Model()
            model.settings = _ATTEMPTS[attempt]
            flag, _ = model.setup(condensed.Q, slope, condensed.G, upper, lower, guess)
            if flag >= 0:  # a workspace that was refused must not be updated
                self._models[attempt] = model
        else:
            flag = model.update(f=slope, bupper=upper, blower=lower, sense=guess)
        if flag < 0:
            return np.zeros_like(slope), np.zeros_like(lower), False
        x, _, flag, info = model.solve()
        return (
            x,
            info["lam"],
            bool(flag == _OPTIMAL and np.isfinite(x).all() and np.isfinite(info["lam"]).all()),
        )

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        return attach_gradient(self._prepare(problem), model, s0, weights, solution)

    def __getstate__(self) -> dict[str, object]:
        return {"_condensed": None, "_models": {}}  # the C workspace is rebuilt where it is needed


def _guessed_active_set(condensed: CondensedProblem, weights: ComplementarityWeights) -> np.ndarray:
    """(N, n_constraints) DAQP's flags: forces held at zero where the nominal is free, gaps where it is in contact.

    Without the guess the method would start where all forces are as large as the tiny ``delta`` lets them be.
    """
    in_contact = (weights.gap > weights.force).reshape(len(weights.gap), len(condensed.G))
    flags = np.zeros((len(in_contact), condensed.n + len(condensed.G)), dtype=np.intc)
    flags[:, condensed.n_actions : condensed.n] = np.where(in_contact, 0, _ACTIVE_AT_LOWER)
    flags[:, condensed.n :] = np.where(in_contact, _ACTIVE_AT_LOWER, 0)
    return flags
