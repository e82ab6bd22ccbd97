"""Moreau's batched interior-point method and its derivative, called directly on the sparse problem.

Its active-set method is left out: on these problems it stops at its limit of iterations from 20 steps on.
"""

from __future__ import annotations

import dataclasses

import moreau
import numpy as np
import scipy.sparse as sp
import torch
from moreau.torch import Solver as BatchSolver

from benchmarks.rivals.base import TOLERANCE
from benchmarks.rivals.staged import StagedProblem
from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers import Solution, Solver

__all__ = ["MoreauRival"]

_IN_ROWS = ("A", "B", "C", "D", "E", "F")
"""The matrices that the constraints' rows are made of; d and c are on the right-hand side."""


class MoreauRival(Solver):
    """One call for the whole batch; a solver is set up once for each batch size."""

    def __init__(self) -> None:
        self._staged: StagedProblem | None = None
        self._solvers: dict[object, BatchSolver] = {}

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        model = LcsMatrices(*(torch.as_tensor(matrix) for matrix in problem.model))
        with torch.no_grad():
            x, z, solved = self._run(problem, model, torch.as_tensor(s0), weights)
        assert self._staged is not None
        _, on_gap, at_low, at_high = np.split(z.numpy(), self._split, axis=1)
        bound = np.zeros(x.shape)
        bound[:, self._high] = at_high
        bound[:, self._low] -= at_low
        return self._staged.solution(x.numpy(), bound, -on_gap, solved)

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        x, _, _ = self._run(problem, model, s0, weights)
        assert self._staged is not None
        return x[:, torch.as_tensor(self._staged.actions)]

    def _run(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
    ) -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
        """Solutions (N, n), multipliers (N, m), success (N,)"""
        if self._staged is None or self._staged.problem is not problem:
            self._setup(problem)
        staged = self._staged
        assert staged is not None
        numbers = torch.cat([getattr(model, name).reshape(-1) for name in _IN_ROWS])
        rows = self._constants.masked_scatter(self._of_model, -numbers[self._place])
        n, H = len(s0), problem.horizon
        w_phi, w_lam = torch.as_tensor(weights.gap), torch.as_tensor(weights.force)
        slope = torch.as_tensor(problem.stage_slope).expand(n, H, -1)
        slope = torch.cat([slope, w_lam], dim=2) + w_phi @ torch.cat([model.D, model.E, model.F], dim=1)
        q = torch.cat([slope.reshape(n, -1), torch.as_tensor(problem.terminal_slope).expand(n, -1)], dim=1)
        bounds = np.concatenate([-staged.low[self._low], staged.high[self._high]])
        right = torch.cat([model.d.repeat(H), model.c.repeat(H), torch.as_tensor(bounds)])
        right = torch.cat([s0, right.expand(n, -1)], dim=1)

        solver = self._solver(n, torch.is_grad_enabled())
        found = solver.solve(torch.as_tensor(self._cost.data), rows, q, right)
        solved = np.array([status == moreau.SolverStatus.Solved for status in np.atleast_1d(solver.info.status)])
        return found.x, found.z, solved

    def _setup(self, problem: RelaxedProblem) -> None:
        """Find where each number of the model stands in the constraints."""
        self._staged = staged = StagedProblem(problem)
        # the same problem with the place of each number, counted from 2, in place of the number
        count, places = 2, {}
        for name in _IN_ROWS:
            shape = getattr(problem.model, name).shape
            places[name] = np.arange(count, count + np.prod(shape, dtype=int), dtype=float).reshape(shape)
            count += places[name].size
        of_places = StagedProblem(dataclasses.replace(problem, model=problem.model._replace(**places)))
        identity = sp.identity(staged.n, format="csr")
        self._low, self._high = np.flatnonzero(np.isfinite(staged.low)), np.flatnonzero(np.isfinite(staged.high))
        blocks = (of_places.M, -of_places.G, -identity[self._low], identity[self._high])
        rows = sp.csr_matrix(sp.vstack(blocks))
        rows.sort_indices()
        self._split = np.cumsum([block.shape[0] for block in blocks[:-1]])
        is_place = rows.data < -1.5
        self._of_model, self._place = torch.as_tensor(is_place), torch.as_tensor(-rows.data[is_place] - 2.0).long()
        self._constants = torch.as_tensor(rows.data)
        self._rows, self._cost = rows, sp.csr_matrix(staged.P)

    def _solver(self, batch: int, with_gradient: bool) -> BatchSolver:
        key = (batch, with_gradient, self._rows.shape, self._rows.indices.tobytes())
        if key not in self._solvers:
            equalities = int(self._split[0])
            accuracy = moreau.IPMSettings(tol_gap_abs=TOLERANCE, tol_gap_rel=TOLERANCE, tol_feas=TOLERANCE)
            self._solvers[key] = BatchSolver(
                n=self._rows.shape[1],
                m=self._rows.shape[0],
                P_row_offsets=torch.as_tensor(self._cost.indptr),
                P_col_indices=torch.as_tensor(self._cost.indices),
                A_row_offsets=torch.as_tensor(self._rows.indptr),
                A_col_indices=torch.as_tensor(self._rows.indices),
                cones=moreau.Cones(num_zero_cones=equalities, num_nonneg_cones=self._rows.shape[0] - equalities),
                settings=moreau.Settings(
                    solver="ipm", device="cpu", batch_size=batch, enable_grad=with_gradient, ipm_settings=accuracy
                ),
            )
        return self._solvers[key]
