"""A ``CvxpyLayer`` as its documentation suggests it: diffcp with Clarabel, everything else at its default."""

from __future__ import annotations

import numpy as np
import torch
from cvxpylayers.torch import CvxpyLayer
from scipy.linalg import sqrtm

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem, relaxed_problem
from sb3_mpc_policy.solvers import Solution, Solver

__all__ = ["CvxpyLayerRival"]


class CvxpyLayerRival(Solver):
    """Clarabel's default tolerance, diffcp's default derivative (LSQR): quicker than the package's reference, and less
    exact. Gives no multipliers."""

    def __init__(self) -> None:
        self._key: object = None

    def _run(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
    ) -> dict[str, torch.Tensor]:
        key = (problem.sizes, problem.horizon, problem.force_weight, problem.action_low.tobytes())
        if key != self._key:
            self._statement = relaxed_problem(problem)
            parameters, variables = self._statement.parameters.values(), self._statement.variables.values()
            self._layer = CvxpyLayer(
                self._statement.problem,
                parameters=list(parameters),
                variables=list(variables),
                solver="DIFFCP",
                canon_backend=None,
            )
            self._key = key
        values = dict(zip(LcsMatrices._fields, model, strict=True)) | {
            "s0": s0,
            "W_sqrt": torch.as_tensor(sqrtm(problem.stage_weight).real),
            "w": torch.as_tensor(problem.stage_slope),
            "P_sqrt": torch.as_tensor(sqrtm(problem.terminal_weight).real),
            "p": torch.as_tensor(problem.terminal_slope),
            "w_phi": torch.as_tensor(weights.gap),
            "w_lam": torch.as_tensor(weights.force),
        }
        inputs = (values[name] for name in self._statement.parameters)
        outputs = self._layer(*inputs, solver_args={"solve_method": "Clarabel"})
        return dict(zip(self._statement.variables, outputs, strict=True))

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        model = LcsMatrices(*(torch.as_tensor(matrix) for matrix in problem.model))
        with torch.no_grad():
            found = self._run(problem, model, torch.as_tensor(s0), weights)
        nothing = torch.zeros(len(s0), problem.horizon, 0)
        return Solution(
            actions=found["a"].numpy(),
            states=found["s"].numpy(),
            forces=found.get("lam", nothing).numpy(),
            gaps=found.get("phi", nothing).numpy(),
            solved=np.ones(len(s0), dtype=bool),  # the layer raises otherwise
        )

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        return self._run(problem, model, s0, weights)["a"]
