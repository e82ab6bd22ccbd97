"""A primal-dual interior-point method for whole batches in torch, on any device.

Mehrotra's predictor-corrector (Nocedal and Wright 2006, algorithm 16.4) on the problem with its states kept: Newton's
step is then a linear-quadratic regulator for each problem, found by a Riccati recursion (Rao, Wright and Rawlings
1998). The loops run over iterations and stages, never over problems, and an iteration's work grows with H, not with H³.

The method stops early: the active-set system (active_set.py) then gives the exact solution, after a few corrections of
the set where need be. The few problems where that fails go to the active-set method on the host.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers.active_set import exact_solution
from sb3_mpc_policy.solvers.base import Solution, Solver
from sb3_mpc_policy.solvers.condensed import CondensedProblem
from sb3_mpc_policy.solvers.daqp import DaqpSolver
from sb3_mpc_policy.solvers.gradient import attach_gradient

__all__ = ["InteriorPointSolver"]

_ITERATIONS = 30
_TOLERANCE = 1e-7  # of the interior point, where it hands over to its active set
_STEP = 0.995  # share of the way to the boundary
_SOLVED = 1e-12  # of the KKT residual: rounding alone leaves 1e-14
_LARGEST_BATCH = 4096  # problems at a time, which bounds the memory


class InteriorPointSolver(Solver):
    """Batched in torch, on the device of the problem."""

    def __init__(self) -> None:
        self._condensed: CondensedProblem | None = None
        self._active_set_method = DaqpSolver()
        self.handed_over = 0
        """Problems so far that went to the active-set method on the host."""

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        solution = self.solve_alone(problem, s0, weights)
        hard = np.flatnonzero(~solution.solved)
        self.handed_over += len(hard)
        if len(hard):
            those = ComplementarityWeights(weights.gap[hard], weights.force[hard])
            solution.replace(hard, self._active_set_method.solve(problem, s0[hard], those))
        return solution

    def solve_alone(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        """Without handing over what this method cannot solve."""
        condensed = self._prepare(problem)
        f, g = condensed.slope(s0, weights), condensed.gap_offset(s0)
        x, multipliers = np.zeros_like(f), np.zeros((len(f), condensed.n + len(condensed.G)))
        solved = np.zeros(len(f), dtype=bool)
        usable = np.isfinite(f).all(axis=1) & np.isfinite(g).all(axis=1)
        if usable.any() and _is_convex(condensed.Q) and np.isfinite(condensed.G).all():
            stages = _Stages(problem)
            for start in range(0, len(f), _LARGEST_BATCH):
                some = start + np.flatnonzero(usable[start : start + _LARGEST_BATCH])
                those = ComplementarityWeights(weights.gap[some], weights.force[some])
                low, high, gap = stages.active(s0[some], those)
                x[some], multipliers[some] = exact_solution(condensed, problem.device, f[some], g[some], low, high, gap)
                solved[some] = condensed.residual(x[some], multipliers[some], f[some], g[some]) < _SOLVED
        return condensed.expand(x, s0, solved, multipliers)

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        return attach_gradient(self._prepare(problem), model, s0, weights, solution)

    def _prepare(self, problem: RelaxedProblem) -> CondensedProblem:
        if self._condensed is None or self._condensed.problem is not problem:
            self._condensed = CondensedProblem(problem)
        return self._condensed

    def __getstate__(self) -> dict[str, object]:
        return {"_condensed": None, "_active_set_method": self._active_set_method, "handed_over": self.handed_over}


class _Batch(NamedTuple):
    """Linear terms and starts of the problems: cost (1, N, 1), slope (H, N, n_v), s0 (N, n_x)."""

    cost: torch.Tensor
    slope: torch.Tensor
    s0: torch.Tensor


class _Point(NamedTuple):
    """An iterate: v (H, N, n_v), s_H (N, n_x), slacks y > 0 and multipliers z > 0 of the inequalities (H, N, m)."""

    v: torch.Tensor
    last: torch.Tensor
    y: torch.Tensor
    z: torch.Tensor


class _Regulator(NamedTuple):
    """A Riccati recursion's result, stage by stage: inverse curvature (N, n_u, n_u) and gain (N, n_u, n_x)."""

    inverse: list[torch.Tensor]
    gain: list[torch.Tensor]


class _Stages:
    """The problem stage by stage: ``v_k = (s_k, a_k, lam_k)``, ``s_{k+1} = Z v_k + d``, ``J v_k >= h``.

    J stacks the forces, the gaps, and the actions above their finite lower and below their finite upper bounds.
    """

    def __init__(self, problem: RelaxedProblem) -> None:
        self.device = problem.device
        A, B, C, d, D, E, F, c = (self._tensor(matrix) for matrix in problem.model)
        self.n_x, self.n_a, self.n_c = problem.sizes
        n_z = self.n_x + self.n_a
        n_v = n_z + self.n_c
        self.H = problem.horizon
        self.Z, self.d = torch.cat([A, B, C], dim=1), d
        self.curvature = A.new_zeros(n_v, n_v)
        self.curvature[:n_z, :n_z] = 2.0 * self._tensor(problem.stage_weight)
        self.curvature[n_z:, n_z:] = 2.0 * problem.force_weight * torch.eye(self.n_c, dtype=A.dtype, device=A.device)
        self.stage_slope = self._tensor(problem.stage_slope)
        self.end_curvature = 2.0 * self._tensor(problem.terminal_weight)
        self.end_slope = self._tensor(problem.terminal_slope)
        self.gap_row = torch.cat([D, E, F], dim=1)

        unit = torch.eye(n_v, dtype=A.dtype, device=A.device)
        self.low, self.high = (np.flatnonzero(np.isfinite(b)) for b in (problem.action_low, problem.action_high))
        self.J = torch.cat([unit[n_z:], self.gap_row, unit[self.n_x + self.low], -unit[self.n_x + self.high]])
        bounds = [self._tensor(b) for b in (problem.action_low[self.low], -problem.action_high[self.high])]
        self.h = torch.cat([torch.zeros_like(c), -c, *bounds])
        length = self.J.norm(dim=1)
        length[length == 0] = 1.0
        self.J, self.h = self.J / length[:, None], self.h / length
        self.J_squares = (self.J[:, :, None] * self.J[:, None, :]).reshape(len(self.J), n_v * n_v)

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, device=self.device)

    def active(
        self, s0: np.ndarray, weights: ComplementarityWeights
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Which of x (N, n) is at its lower and at its upper bound, and which gaps (N, H n_lambda) are closed."""
        gap, force = (self._tensor(part).transpose(0, 1) for part in weights)
        n, n_z, n_c = len(s0), self.n_x + self.n_a, self.n_c
        slope = gap @ self.gap_row
        slope[:, :, :n_z] += self.stage_slope
        slope[:, :, n_z:] += force
        cost = 1.0 / (1.0 + slope.abs().amax(dim=(0, 2)))[None, :, None]
        point = self._interior(_Batch(cost, cost * slope, self._tensor(s0)))

        active = (point.z > point.y).transpose(0, 1)
        at_low, at_high = active.new_zeros(2, n, self.H, self.n_a)
        ends = 2 * n_c + len(self.low)
        at_low[:, :, self.low] = active[:, :, 2 * n_c : ends]
        at_high[:, :, self.high] = active[:, :, ends:]
        no_force = active[:, :, :n_c].reshape(n, -1)
        low = torch.cat([at_low.reshape(n, -1), no_force], dim=1)
        high = torch.cat([at_high.reshape(n, -1), torch.zeros_like(no_force)], dim=1)
        return low, high, active[:, :, n_c : 2 * n_c].reshape(n, -1)

    def _interior(self, batch: _Batch) -> _Point:
        point = self._start(batch)
        result = _Point(*(part.clone() for part in point))
        todo = torch.arange(len(batch.s0), device=self.device)
        share = torch.ones_like(batch.cost)  # of the first residuals that is left
        for _ in range(_ITERATIONS if len(self.h) else 0):
            point, step = self._iterate(point, batch)
            share = share * (1.0 - step)
            mean = (point.y * point.z).mean(dim=(0, 2), keepdim=True)
            # a step of zero has no successor
            going = ((torch.maximum(mean, share) > _TOLERANCE) & (step > 0)).flatten()
            # the slowest problems need twice the iterations of most: carry on with those alone
            if 2 * int(going.sum()) <= len(todo):
                self._store(result, todo, point)
                todo = todo[going]
                if not len(todo):
                    return result
                point = _Point(point.v[:, going], point.last[going], point.y[:, going], point.z[:, going])
                batch = _Batch(batch.cost[:, going], batch.slope[:, going], batch.s0[going])
                share = share[:, going]
        self._store(result, todo, point)
        return result

    @staticmethod
    def _store(result: _Point, index: torch.Tensor, point: _Point) -> None:
        result.v[:, index], result.last[index] = point.v, point.last
        result.y[:, index], result.z[:, index] = point.y, point.z

    def _start(self, batch: _Batch) -> _Point:
        """Mehrotra's: the optimum with springs for constraints; its slacks and the springs' forces made positive."""
        v = batch.slope.new_zeros(self.H, len(batch.s0), len(self.Z[0]))
        s = batch.s0
        for k in range(self.H):
            v[k, :, : self.n_x] = s
            s = s @ self.Z[:, : self.n_x].mT + self.d
        y = v @ self.J.mT - self.h
        slope, end = self._slopes(_Point(v, s, y, -y), batch)
        dv, last = self._newton(self._regulator(torch.ones_like(y), batch.cost), slope, end)
        v, s = v + dv, s + last
        y = v @ self.J.mT - self.h
        if not y.numel():
            return _Point(v, s, y, y)
        ends = (0, 2)
        shift = 1.0 - y.amin(dim=ends, keepdim=True).clamp(max=1.0)
        dual_shift = 1.0 + y.amax(dim=ends, keepdim=True).clamp(min=-1.0)
        return _Point(v, s, y + shift, dual_shift - y)

    def _slopes(self, point: _Point, batch: _Batch) -> tuple[torch.Tensor, torch.Tensor]:
        """Of the Lagrangian without the dynamics' multipliers, in v (H, N, n_v) and in s_H (N, n_x)."""
        slope = batch.cost * (point.v @ self.curvature) + batch.slope - point.z @ self.J
        return slope, batch.cost[0] * (point.last @ self.end_curvature + self.end_slope)

    def _iterate(self, point: _Point, batch: _Batch) -> tuple[_Point, torch.Tensor]:
        """One step, and its length (1, N, 1): 0 where there is none to take."""
        v, last, y, z = point
        missing = v @ self.J.mT - self.h - y
        slope, end = self._slopes(point, batch)
        regulator = self._regulator(z / y, batch.cost)

        def direction(product: torch.Tensor) -> _Point:
            """Newton's step towards ``y z = y z - product``."""
            dv, dlast = self._newton(regulator, slope + ((product + z * missing) / y) @ self.J, end)
            dy = dv @ self.J.mT + missing
            return _Point(dv, dlast, dy, -(product + z * dy) / y)

        affine = direction(y * z)
        step = _longest(point, affine)
        mean = (y * z).mean(dim=(0, 2), keepdim=True)
        reached = ((y + step * affine.y) * (z + step * affine.z)).mean(dim=(0, 2), keepdim=True)
        move = direction(y * z + affine.y * affine.z - (reached / mean) ** 3 * mean)
        step = _STEP * _longest(point, move)
        finite = (move.v.isfinite().all(dim=2) & move.z.isfinite().all(dim=2)).all(dim=0)[None, :, None]
        step = torch.where(finite, step, 0.0)
        v, y, z = (torch.where(finite, old + step * new, old) for old, new in ((v, move.v), (y, move.y), (z, move.z)))
        return _Point(v, torch.where(finite[0], last + step[0] * move.last, last), y, z), step

    def _regulator(self, weight: torch.Tensor, cost: torch.Tensor) -> _Regulator:
        """Riccati recursion for the curvature ``cost curvature + Jᵀ diag(weight) J`` of each stage."""
        H, n, _ = weight.shape
        n_x, n_v = self.n_x, len(self.Z[0])
        stages = (cost * self.curvature.flatten() + weight @ self.J_squares).reshape(H, n, n_v, n_v)
        P = cost.reshape(n, 1, 1) * self.end_curvature
        inverse, gain = [], []
        for k in reversed(range(H)):
            PZ = (P.reshape(n * n_x, n_x) @ self.Z).reshape(n, n_x, n_v)
            M = stages[k] + (PZ.mT.reshape(n * n_v, n_x) @ self.Z).reshape(n, n_v, n_v)
            inverse.append(torch.linalg.inv_ex(M[:, n_x:, n_x:]).inverse)
            gain.append(inverse[-1] @ M[:, n_x:, :n_x])
            P = M[:, :n_x, :n_x] - M[:, :n_x, n_x:] @ gain[-1]
        return _Regulator(inverse[::-1], gain[::-1])

    def _newton(
        self, regulator: _Regulator, slope: torch.Tensor, end: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The step in v (H, N, n_v) and s_H (N, n_x) for these slopes; it keeps to the dynamics."""
        n_x = self.n_x
        feedforward = []
        p = end
        for k in reversed(range(self.H)):
            m = torch.addmm(slope[k], p, self.Z)
            feedforward.append(_times(regulator.inverse[k], m[:, n_x:]))
            p = m[:, :n_x] - _times(regulator.gain[k].mT, m[:, n_x:])
        step = torch.empty_like(slope)
        ds = torch.zeros_like(end)
        for k, ahead in enumerate(reversed(feedforward)):
            step[k, :, :n_x] = ds
            step[k, :, n_x:] = -ahead - _times(regulator.gain[k], ds)
            ds = step[k] @ self.Z.mT
        return step, ds


def _is_convex(Q: np.ndarray) -> bool:
    """Whether Q is finite and positive definite: else what meets the optimality conditions may be no optimum."""
    if not np.isfinite(Q).all():
        return False
    try:
        np.linalg.cholesky(Q)
    except np.linalg.LinAlgError:
        return False
    return True


def _times(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """(N, i, j) times (N, j)"""
    return torch.bmm(matrix, vector[..., None])[..., 0]


def _longest(point: _Point, move: _Point) -> torch.Tensor:
    """(1, N, 1) the longest step, at most one, that keeps slacks and multipliers positive."""
    value, change = torch.cat([point.y, point.z], dim=2), torch.cat([move.y, move.z], dim=2)
    ratio = torch.where(change < 0, -value / change, torch.inf)
    return ratio.amin(dim=(0, 2), keepdim=True).clamp(max=1.0)
