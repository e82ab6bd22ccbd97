"""The global optimum of the controller's problem, eq (6), with its complementarity as it stands: nothing relaxed.

    minimise    Σ_{k<H} (z_kᵀ W z_k + wᵀ z_k)  +  s_Hᵀ P s_H + pᵀ s_H               z_k = (s_k, a_k)
    subject to  s_{k+1} = A s_k + B a_k + C lam_k + d
                0 <= lam_k  ⟂  phi_k = D s_k + E a_k + F lam_k + c >= 0
                a_low <= a_k <= a_high,   s_0 given

SCIP (Bolusani et al. 2024) branches on which of the two in each pair ``(lam, phi)`` is zero: special ordered sets of
type 1, which rest on no guessed bound of either. It leaves a plan, and a proof that no plan is cheaper than so much.
What counts as the cost of a plan is that of the LCS simulated under its actions, as for the controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from pyscipopt import Model, quicksum

from sb3_mpc_policy.problem import RelaxedProblem
from sb3_mpc_policy.simulation import LcsSimulator

__all__ = ["PROVEN", "GlobalOptimum", "global_optimum"]

PROVEN = 1e-4
"""Relative difference of cost and bound at which an optimum counts as proven."""

# SCIP's limits on how far constraints are violated; the bound is as good as these are tight.
_FEASIBILITY = 1e-8
_GAP = PROVEN / 10.0
# Scaled coordinates: a bound further out helps the search less than it harms SCIP's arithmetic.
_LARGEST_BOUND = 100.0


class GlobalOptimum(NamedTuple):
    """The best plan from one state.

    :param actions: (H, n_a), scaled coordinates
    :param cost: of eq (6), when the LCS is simulated under the actions
    :param bound: no plan costs less
    """

    actions: np.ndarray
    cost: float
    bound: float

    @property
    def proven(self) -> bool:
        """The cost is the optimum, up to :data:`PROVEN`."""
        return self.cost - self.bound <= PROVEN * abs(self.cost)


def global_optimum(
    problem: RelaxedProblem, s0: np.ndarray, known: np.ndarray, time_limit: float = 60.0
) -> GlobalOptimum:
    """Solve eq (6) to global optimality.

    :param problem: what is asked for, with finite bounds of the actions; its ``force_weight`` is not used
    :param s0: (n_x,), scaled coordinates
    :param known: (H, n_a) actions of a plan to beat, scaled coordinates, within the bounds. A good one shortens the
        search, no plan changes its result
    :param time_limit: s of the processor, after which the best plan so far is returned with what is proven by then
    :raises ValueError: an argument of the wrong shape, unbounded actions, or ``known`` out of bounds
    """
    n_x, n_a, _ = problem.sizes
    for name, value, shape in (("s0", s0, (n_x,)), ("known", known, (problem.horizon, n_a))):
        if value.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {value.shape}")
    if not np.isfinite([problem.action_low, problem.action_high]).all():
        raise ValueError(f"problem must bound every action, got {problem.action_low} to {problem.action_high}")
    if not ((problem.action_low <= known) & (known <= problem.action_high)).all():
        raise ValueError(f"known must lie between {problem.action_low} and {problem.action_high}, got {known!r}")
    known_cost = _cost(problem, s0, known)
    size = max(abs(known_cost), 1e-12)

    scip, a, cost = _statement(problem, s0, size)
    scip.hideOutput()
    scip.setParam("timing/clocktype", 1)  # the processor's: other processes do not count
    scip.setParam("limits/time", time_limit)
    scip.setParam("limits/gap", _GAP)
    scip.setParam("numerics/feastol", _FEASIBILITY)
    scip.addCons(cost <= known_cost / size + PROVEN)
    scip.optimize()

    best = GlobalOptimum(known, known_cost, min(float(scip.getDualbound()) * size, known_cost))
    if scip.getNSols():
        found = np.array([[scip.getVal(entry) for entry in row] for row in a])
        found = np.clip(found, problem.action_low, problem.action_high)
        if (found_cost := _cost(problem, s0, found)) < known_cost:
            best = GlobalOptimum(found, found_cost, min(best.bound, found_cost))
    return best


def _cost(problem: RelaxedProblem, s0: np.ndarray, actions: np.ndarray) -> float:
    rollout = LcsSimulator(problem.model).under(s0[None], actions[None])
    return float(problem.cost(rollout.states, rollout.actions)[0])


def _reach(problem: RelaxedProblem, s0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest states (H+1, n_x) that any actions lead to, by interval arithmetic.

    For the forces: ``lamᵀ F lam = -lamᵀ q`` makes ``|lam| <= |max(-q, 0)| / alpha`` with the least eigenvalue alpha of
    F's symmetric part.
    """
    A, B, C, d, D, E, F, c = problem.model
    to_state, to_gap = np.hstack([A, B, C]), np.hstack([D, E])
    least = np.linalg.eigvalsh((F + F.T) / 2.0).min(initial=np.inf)
    low, high = [s0], [s0]
    for _ in range(problem.horizon):
        middle = np.hstack([low[-1] + high[-1], problem.action_low + problem.action_high]) / 2.0
        radius = np.hstack([high[-1] - low[-1], problem.action_high - problem.action_low]) / 2.0
        closing = np.maximum(np.abs(to_gap) @ radius - to_gap @ middle - c, 0.0)
        half = np.full(len(c), np.linalg.norm(closing) / least / 2.0)
        centre = to_state @ np.hstack([middle, half]) + d
        spread = np.abs(to_state) @ np.hstack([radius, half])
        low.append(centre - spread)
        high.append(centre + spread)
    return np.array(low), np.array(high)


def _statement(problem: RelaxedProblem, s0: np.ndarray, size: float) -> tuple[Model, list[list[Any]], Any]:
    """The problem for SCIP, its actions (H, n_a), and its cost divided by ``size``."""
    A, B, C, d, D, E, F, c = problem.model
    n_x, _, n_c = problem.sizes
    H = problem.horizon
    scip = Model()

    def variables(low: np.ndarray, high: np.ndarray) -> list[list[Any]]:
        bounds = (
            np.where(np.abs(side) < _LARGEST_BOUND, side, side + np.copysign(np.inf, side)) for side in (low, high)
        )
        rows = zip(*bounds, strict=True)
        return [[scip.addVar(lb=float(l), ub=float(h)) for l, h in zip(*row, strict=True)] for row in rows]  # noqa: E741

    def linear(matrix: np.ndarray, vector: Sequence[Any], i: int) -> Any:
        return quicksum(matrix[i, j] * vector[j] for j in range(matrix.shape[1]))

    def quadratic(matrix: np.ndarray, slope: np.ndarray, vector: Sequence[Any]) -> Any:
        squares = quicksum(matrix[i, j] * vector[i] * vector[j] for i, j in zip(*np.nonzero(matrix), strict=True))
        return squares + quicksum(slope[i] * vector[i] for i in range(len(slope)))

    # Forces and gaps stay without an upper bound: with one, SCIP adds rows that its arithmetic does not survive.
    contact = np.zeros((H, n_c)), np.full((H, n_c), np.inf)
    s, lam, phi = variables(*_reach(problem, s0)), variables(*contact), variables(*contact)
    a = variables(np.tile(problem.action_low, (H, 1)), np.tile(problem.action_high, (H, 1)))
    total = quadratic(problem.terminal_weight / size, problem.terminal_slope / size, s[H])
    for k in range(H):
        total += quadratic(problem.stage_weight / size, problem.stage_slope / size, [*s[k], *a[k]])
        for i in range(n_x):
            scip.addCons(s[k + 1][i] == linear(A, s[k], i) + linear(B, a[k], i) + linear(C, lam[k], i) + float(d[i]))
        for i in range(n_c):
            gap = linear(D, s[k], i) + linear(E, a[k], i) + linear(F, lam[k], i) + float(c[i])
            scip.addCons(phi[k][i] == gap)
            scip.addConsSOS1([lam[k][i], phi[k][i]])
    cost = scip.addVar(lb=None)
    scip.addCons(total <= cost)
    scip.setObjective(cost)
    return scip, a, cost
