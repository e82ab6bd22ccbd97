"""The solver for a batch, by where the model lives, how many problems there are, and how large they are."""

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
    """A solver, and the batches it is for: on this device (None: any), so many problems or more, each with so many
    contacts over its horizon (H n_lambda) or more."""

    device: str | None
    least_batch: int
    least_contacts: int
    solver: str


CHOICES = (
    # The active-set method's time grows with the cube of the contacts over the horizon, the interior point's linearly.
    # Forward, ms a problem at batch 64 to 128, daqp against torch: 0.09 and 0.8 at 40 contacts, 0.3 and 1.5 at 80, 1.3
    # to 1.5 and 1.8 to 3.2 at 160, 12 to 13 and 5 to 6 at 320 (benchmarks/results/solver_speed.csv)
    Choice(None, 64, 320, "torch"),
    Choice(None, 1, 640, "torch"),
    # Not measured, for want of a GPU: below this batch the launches alone are estimated to take longer than daqp.
    Choice("cuda", 2048, 0, "torch"),
    Choice(None, 1, 0, "daqp"),
)
"""The first that fits is taken."""


def choose(device: str, batch: int, contacts: int) -> str:
    """The name of the solver for so many problems, each with so many contacts over its horizon (H n_lambda)."""
    for choice in CHOICES:
        if choice.device in (None, device) and batch >= choice.least_batch and contacts >= choice.least_contacts:
            return choice.solver
    return "daqp"


class AutomaticSolver(Solver):
    """Hands each batch to the solver that :func:`choose` names, and the problems that it cannot solve to the other."""

    def __init__(self) -> None:
        self.active_set_method, self.interior_point = DaqpSolver(), InteriorPointSolver()
        self.handed_over = 0
        """Problems so far that the active-set method did not solve."""

    def _for(self, problem: RelaxedProblem, batch: int) -> Solver:
        *_, n_contacts = problem.sizes
        name = choose(problem.device.partition(":")[0], batch, problem.horizon * n_contacts)
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
