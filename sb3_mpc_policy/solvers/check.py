"""Whether a solution is one: the optimality conditions, taken without regard to how it was found."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import nnls

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers.base import Solution, Solver
from sb3_mpc_policy.solvers.condensed import CondensedProblem

__all__ = ["CheckedSolver", "kkt_residual"]

# A constraint this close, in scaled coordinates, may hold a multiplier where the solver gave none.
_CLOSE = 1e-4
# Far above rounding and the reference's tolerance, far below what an action would show.
_ACCEPTED = 1e-6


def kkt_residual(
    problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights, solution: Solution
) -> np.ndarray:
    """Largest violation of the optimality conditions of the relaxed problem, (N,), relative to its slope's size.

    Stationarity, primal and dual feasibility and complementary slackness. Where the solution comes without
    multipliers, those of the constraints within 1e-4 that fit stationarity best are taken.

    :param s0: (N, n_x) scaled
    """
    if not len(s0):
        return np.zeros(0)
    condensed = CondensedProblem(problem)
    x = np.concatenate([solution.actions.reshape(len(s0), -1), solution.forces.reshape(len(s0), -1)], axis=1)
    f, g = condensed.slope(s0, weights), condensed.gap_offset(s0)
    multipliers = solution.multipliers
    if multipliers is None:
        rows = [_fitted_multipliers(condensed, *row) for row in zip(x, f, g, strict=True)]
        multipliers = np.array(rows).reshape(len(x), condensed.n + len(condensed.G))
    return condensed.residual(x, multipliers, f, g)


def _fitted_multipliers(condensed: CondensedProblem, x: np.ndarray, f: np.ndarray, g: np.ndarray) -> np.ndarray:
    """(n + n_gaps,) of one problem: non-negative least squares on the constraints that are close."""
    n, G = condensed.n, condensed.G
    result = np.zeros(n + len(G))
    slope = x @ condensed.Q + f
    if not (np.isfinite(slope).all() and np.isfinite(g).all()):
        return result
    low = np.flatnonzero(x - condensed.low < _CLOSE)
    high = np.flatnonzero(condensed.high - x < _CLOSE)
    gap = np.flatnonzero(G @ x + g < _CLOSE)
    pushes = np.hstack([-np.eye(n)[:, low], np.eye(n)[:, high], -G[gap].T])
    if pushes.shape[1]:
        fitted, _ = nnls(pushes, -slope, maxiter=100 * pushes.shape[1])
        result[low] -= fitted[: len(low)]
        result[high] += fitted[len(low) : len(low) + len(high)]
        result[n + gap] -= fitted[len(low) + len(high) :]
    return result


class CheckedSolver(Solver):
    """Another solver, each of whose solutions must meet the optimality conditions; what does not counts as unsolved.

    :param solver: the one that solves
    """

    def __init__(self, solver: Solver) -> None:
        self.solver = solver
        self.largest_residual = 0.0
        """The worst KKT residual among the solutions accepted so far."""

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        solution = self.solver.solve(problem, s0, weights)
        index = np.flatnonzero(solution.solved)
        some = ComplementarityWeights(weights.gap[index], weights.force[index])
        residual = kkt_residual(problem, s0[index], some, solution[index])
        accepted = residual <= _ACCEPTED  # False for NaN
        solution.solved[index] = accepted
        self.largest_residual = max(self.largest_residual, float(residual[accepted].max(initial=0.0)))
        return solution

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        return self.solver.differentiable_actions(problem, model, s0, weights, solution)
