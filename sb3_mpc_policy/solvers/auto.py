"""The solver for a batch, by where the model lives, how many problems there are, and how long the horizon is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers.base import Solution, Solver
from sb3_mpc_policy.solvers.daqp import DaqpSolver
from sb3_mpc_policy.solvers.interior_point import InteriorPointSolver

__all__ = ["CHOICES", "AutomaticSolver", "Choice", "choose"]


class Choice(NamedTuple):
    """A solver, and the batches it is for."""

    device: str
    least_batch: int
    longest_horizon: float
    solver: str


CHOICES = (
    Choice("cpu", 1, float("inf"), "daqp"),
    Choice("cuda", 2048, float("inf"), "torch"),
    Choice("cuda", 1, float("inf"), "daqp"),
)
"""The first that fits is taken."""


def choose(device: str, batch: int, horizon: int) -> str:
    """The name of the solver for so many problems of this horizon; "daqp" for a device that is not in the table."""
    for choice in CHOICES:
        if choice.device == device and batch >= choice.least_batch and horizon <= choice.longest_horizon:
            return choice.solver
    return "daqp"


class AutomaticSolver(Solver):
    """Hands each batch to the solver that :func:`choose` names, and the problems that it cannot solve to the other."""

    def __init__(self) -> None:
        self.active_set_method, self.interior_point = DaqpSolver(), InteriorPointSolver()
        self.handed_over = 0
        """Problems so far that the active-set method did not solve."""

    def _for(self, problem: RelaxedProblem, batch: int) -> Solver:
        name = choose(torch.device(problem.device).type, batch, problem.horizon)
        return self.interior_point if name == "torch" else self.active_set_method

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        chosen = self._for(problem, len(s0))
        solution = chosen.solve(problem, s0, weights)
        if chosen is self.interior_point:  # which hands over by itself
            return solution
        hard = np.flatnonzero(~solution.solved)
        self.handed_over += len(hard)
        if len(hard):
            those = ComplementarityWeights(weights.gap[hard], weights.force[hard])
            solution.replace(hard, self.interior_point.solve_alone(problem, s0[hard], those))
        return solution

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        return self._for(problem, len(s0)).differentiable_actions(problem, model, s0, weights, solution)
