"""What rivals without a derivative share."""

from __future__ import annotations

import torch

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers import Solution, Solver

__all__ = ["TOLERANCE", "ForwardRival"]

TOLERANCE = 1e-8
"""Absolute, of the residuals, for every rival that stops at a tolerance; the default of Clarabel and PIQP."""


class ForwardRival(Solver):
    """Solves, and has no derivative."""

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        """
        :raises NotImplementedError: always
        """
        raise NotImplementedError(f"{type(self).__name__} solves only; for a gradient take another solver")
