"""What every solver of the relaxed problem offers. A new one is a file beside this and a line in ``__init__``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem

__all__ = ["Solution", "Solver"]


@dataclass
class Solution:
    """Solutions of a batch of relaxed problems, scaled coordinates.

    :param actions: (N, H, n_a)
    :param states: (N, H+1, n_x)
    :param forces: (N, H, n_lambda)
    :param gaps: (N, H, n_lambda)
    :param solved: (N,) False where the solver did not reach an optimum; the other fields are then not to be used
    :param multipliers: (N, n_constraints) where the solver gives them
    """

    actions: np.ndarray
    states: np.ndarray
    forces: np.ndarray
    gaps: np.ndarray
    solved: np.ndarray
    multipliers: np.ndarray | None = None

    def __getitem__(self, index: np.ndarray) -> Solution:
        rest = None if self.multipliers is None else self.multipliers[index]
        return Solution(
            self.actions[index],
            self.states[index],
            self.forces[index],
            self.gaps[index],
            self.solved[index],
            rest,
        )

    def replace(self, index: np.ndarray, other: Solution) -> None:
        """Overwrite the problems at ``index`` by those of ``other``, in place."""
        for name in ("actions", "states", "forces", "gaps", "solved", "multipliers"):
            if getattr(self, name) is not None:
                getattr(self, name)[index] = getattr(other, name)


class Solver(ABC):
    """Solves batches of one relaxed problem, and differentiates its actions (eq 9 to 11, by the KKT system)."""

    @abstractmethod
    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        """
        :param problem: what the batch shares
        :param s0: (N, n_x) first states, scaled
        :param weights: of the relaxation, a problem each
        """

    @abstractmethod
    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        """The actions of ``solution`` (N, H, n_a) with gradients to ``model`` and ``s0``.

        Only called for problems that were solved.

        :param model: the matrices of ``problem.model`` as tensors
        :param s0: (N, n_x) float64
        """
