"""The dual active-set method DAQP (Arnström, Bemporad and Axehill 2022) on the condensed problem: exact, and quick."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import daqp
import numpy as np
import torch

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers.active_set import active_constraints, exact_solution
from sb3_mpc_policy.solvers.base import Solution, Solver
from sb3_mpc_policy.solvers.condensed import CondensedProblem
from sb3_mpc_policy.solvers.gradient import attach_gradient

__all__ = ["ACTIVE_AT_LOWER", "ACTIVE_AT_UPPER", "OPTIMAL", "DaqpSolver", "guessed_active_set"]

_UNBOUNDED = 1e30  # DAQP's infinity
OPTIMAL = 1  # exit flag
ACTIVE_AT_UPPER, ACTIVE_AT_LOWER = 1, 1 | 2  # constraint flags
# On a few ill-conditioned problems the plain method cycles; its proximal-point form solves those, at more iterations.
_ATTEMPTS: dict[str, dict[str, float]] = {
    "plain": {"primal_tol": 1e-9, "iter_limit": 3000},
    "proximal": {"primal_tol": 1e-9, "iter_limit": 3000, "eps_prox": 1e-6},
}
# Where Q's condition is beyond this, and in the proximal form, digits may be lost that show in the actions. The active
# set is right or nearly so: the solution is then found again on it, and must meet the optimality conditions.
_ILL_CONDITIONED = 1e11
# Of the KKT residual: a right active set leaves 1e-15, and 1e-10 has been seen beside wrong actions.
_EXACT, _SOLVED = 1e-14, 1e-12
# A solve lets go of Python's lock, the call around it does not: on fewer variables threads would wait for each other.
_THREADED_SIZE = 60
_LEAST_PER_THREAD = 16


class DaqpSolver(Solver):
    """One factorisation for the batch; a change of linear term and bounds for each problem.

    On problems large enough to gain by it, it uses as many threads as torch does (``torch.set_num_threads``).
    """

    def __init__(self) -> None:
        self._condensed: CondensedProblem | None = None
        self._workspaces: list[_Workspace] = []
        self.retries = 0
        """Problems so far that the plain method did not solve."""

    def _prepare(self, problem: RelaxedProblem) -> CondensedProblem:
        if self._condensed is None or self._condensed.problem is not problem:
            self._condensed = CondensedProblem(problem)
            self._workspaces = []
        return self._condensed

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        condensed = self._prepare(problem)
        batch = _Batch(condensed, s0, weights)
        if condensed.is_finite:
            usable = np.flatnonzero(np.isfinite(batch.slope).all(axis=1) & np.isfinite(batch.lower).all(axis=1))
            threads = 1
            if condensed.n >= _THREADED_SIZE:
                threads = max(1, min(torch.get_num_threads(), len(usable) // _LEAST_PER_THREAD))
            while len(self._workspaces) < threads:
                self._workspaces.append(_Workspace(condensed))
            if threads == 1:
                self._workspaces[0].solve(batch, usable)
            else:
                with ThreadPoolExecutor(threads) as pool:
                    shares = np.array_split(usable, threads)
                    list(pool.map(_Workspace.solve, self._workspaces, [batch] * threads, shares))
            self.retries += int(batch.retried.sum())
            doubtful = batch.retried | (condensed.condition > _ILL_CONDITIONED)
            self._refine(condensed, batch, np.flatnonzero(batch.solved & doubtful))
        return condensed.expand(batch.x, s0, batch.solved, batch.multipliers)

    @staticmethod
    def _refine(condensed: CondensedProblem, batch: _Batch, index: np.ndarray) -> None:
        """Find the solutions at ``index`` that are not exact again, on their active sets, and keep the better ones."""
        if not len(index):
            return
        gaps = -batch.lower[:, condensed.n :]
        before = condensed.residual(batch.x[index], batch.multipliers[index], batch.slope[index], gaps[index])
        index, before = index[~(before < _EXACT)], before[~(before < _EXACT)]
        if not len(index):
            return
        f, g, multipliers = batch.slope[index], gaps[index], batch.multipliers[index]
        free, on_gap = active_constraints(torch.as_tensor(multipliers), condensed.n)
        at_low = ~free & torch.as_tensor(multipliers[:, : condensed.n] < 0)
        x, exact = exact_solution(condensed, "cpu", f, g, at_low, ~free & ~at_low, on_gap)
        after = condensed.residual(x, exact, f, g)
        better = after < before  # False for NaN
        batch.x[index[better]], batch.multipliers[index[better]] = x[better], exact[better]
        batch.solved[index] = np.where(better, after, before) < _SOLVED

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
        # the C workspaces are rebuilt where they are needed
        return {"_condensed": None, "_workspaces": [], "retries": self.retries}


class _Batch:
    """What differs between the problems, and their results."""

    def __init__(self, condensed: CondensedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> None:
        n, n_gaps = condensed.n, len(condensed.G)
        self.slope = condensed.slope(s0, weights)
        self.lower = np.empty((len(s0), n + n_gaps))
        self.lower[:, :n] = np.maximum(condensed.low, -_UNBOUNDED)
        self.lower[:, n:] = -condensed.gap_offset(s0)
        self.guess = guessed_active_set(condensed, weights)
        self.x, self.multipliers = np.zeros_like(self.slope), np.zeros_like(self.lower)
        self.solved, self.retried = np.zeros((2, len(s0)), dtype=bool)


class _Workspace:
    """DAQP's memory for one model, a thread's own."""

    def __init__(self, condensed: CondensedProblem) -> None:
        self._Q, self._G = condensed.Q, condensed.G
        upper = np.concatenate([condensed.high, np.full(len(condensed.G), _UNBOUNDED)])
        self._upper = np.minimum(upper, _UNBOUNDED)
        self._models: dict[str, daqp.Model] = {}

    def solve(self, batch: _Batch, index: Iterable[int]) -> None:
        for i in index:
            for attempt in _ATTEMPTS:
                batch.solved[i] = self._attempt(attempt, batch, i)
                if batch.solved[i]:
                    break
                batch.retried[i] = True

    def _attempt(self, attempt: str, batch: _Batch, i: int) -> bool:
        model = self._models.get(attempt)
        if model is None:
            model = daqp.Model()
            model.settings = _ATTEMPTS[attempt]
            flag, _ = model.setup(self._Q, batch.slope[i], self._G, self._upper, batch.lower[i], batch.guess[i])
            if flag < 0:  # a workspace that was refused must not be updated
                return False
            self._models[attempt] = model
        # The first problem too: set up without an update, its solution would differ in the last bits from that of the
        # same problem solved later, and a copied policy from its original.
        if model.update(f=batch.slope[i], blower=batch.lower[i], sense=batch.guess[i]) < 0:
            return False
        batch.x[i], _, flag, info = model.solve()
        batch.multipliers[i] = info["lam"]
        return bool(flag == OPTIMAL and np.isfinite(batch.x[i]).all() and np.isfinite(batch.multipliers[i]).all())


def guessed_active_set(condensed: CondensedProblem, weights: ComplementarityWeights) -> np.ndarray:
    """(N, n_constraints) DAQP's flags: forces held at zero where the nominal is free, gaps where it is in contact.

    Without the guess the method would start where all forces are as large as the tiny ``delta`` lets them be.
    """
    in_contact = (weights.gap > weights.force).reshape(len(weights.gap), len(condensed.G))
    flags = np.zeros((len(in_contact), condensed.n + len(condensed.G)), dtype=np.intc)
    flags[:, condensed.n_actions : condensed.n] = np.where(in_contact, 0, ACTIVE_AT_LOWER)
    flags[:, condensed.n :] = np.where(in_contact, ACTIVE_AT_LOWER, 0)
    return flags
