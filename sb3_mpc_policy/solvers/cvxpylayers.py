"""The reference: the problem as it is stated in CVXPY, solved and differentiated by a ``CvxpyLayer``."""

from __future__ import annotations

import diffcp
import numpy as np
import torch
from cvxpylayers.torch import CvxpyLayer

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem, Statement, relaxed_problem
from sb3_mpc_policy.solvers.base import Solution, Solver

__all__ = ["CvxpyLayersSolver"]

# diffcp's own default, SCS, returns "Solved/Inaccurate" on these problems. The quadratic cost becomes the epigraph of a
# cone, in which an action is known to the root of the tolerance only: hence far below Clarabel's default of 1e-8.
_TOLERANCE = 1e-12
_SOLVER_ARGS = {
    "solve_method": "Clarabel",
    "tol_gap_abs": _TOLERANCE,
    "tol_gap_rel": _TOLERANCE,
    "tol_feas": _TOLERANCE,
}
# With diffcp's default LSQR the derivative is wrong by factors on these problems, whose scales are far apart.
_DERIVATIVE_ARGS = _SOLVER_ARGS | {"mode": "dense"}
_MODEL_PARAMETERS = ("A", "B", "C", "d", "D", "E", "F", "c")


class CvxpyLayersSolver(Solver):
    """Slow and independent of the other solvers' algebra: what they are tested against.

    The layer is kept out of every ``nn.Module``: it registers its canonical matrices as buffers, which would end up in
    saved policies.
    """

    def __init__(self) -> None:
        self._key: tuple[object, ...] | None = None
        self._statement: Statement | None = None
        self._layer: CvxpyLayer | None = None

    def _prepare(self, problem: RelaxedProblem) -> tuple[Statement, CvxpyLayer]:
        bounds = (problem.action_low.tobytes(), problem.action_high.tobytes())
        key = (problem.sizes, problem.horizon, problem.force_weight, *bounds)
        if self._statement is None or self._layer is None or key != self._key:
            self._statement = relaxed_problem(problem)
            self._layer = CvxpyLayer(
                self._statement.problem,
                parameters=list(self._statement.parameters.values()),
                variables=list(self._statement.variables.values()),
                solver="DIFFCP",
                canon_backend=None,
            )
            self._key = key
        return self._statement, self._layer

    def _run(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
    ) -> dict[str, torch.Tensor]:
        statement, layer = self._prepare(problem)
        values = dict(zip(_MODEL_PARAMETERS, model, strict=True)) | {
            "s0": s0,
            "W_sqrt": torch.as_tensor(_square_root(problem.stage_weight)),
            "w": torch.as_tensor(problem.stage_slope),
            "P_sqrt": torch.as_tensor(_square_root(problem.terminal_weight)),
            "p": torch.as_tensor(problem.terminal_slope),
            "w_phi": torch.as_tensor(weights.gap),
            "w_lam": torch.as_tensor(weights.force),
        }
        arguments = _DERIVATIVE_ARGS if torch.is_grad_enabled() else _SOLVER_ARGS
        outputs = layer(*(values[name] for name in statement.parameters), solver_args=arguments)
        return dict(zip(statement.variables, outputs, strict=True))

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        n_x, n_a, n_c = problem.sizes
        n, H = len(s0), problem.horizon
        result = Solution(
            actions=np.zeros((n, H, n_a)),
            states=np.zeros((n, H + 1, n_x)),
            forces=np.zeros((n, H, n_c)),
            gaps=np.zeros((n, H, n_c)),
            solved=np.zeros(n, dtype=bool),
        )
        # what is not finite would pass through the layer as a solution that means nothing
        finite = np.isfinite(s0).all(axis=1) & np.isfinite(weights.gap + weights.force).all(axis=(1, 2))
        everything = np.flatnonzero(finite)
        if not len(everything) or not all(np.isfinite(matrix).all() for matrix in problem.model):
            return result
        try:
            self._solve_into(result, everything, problem, s0, weights)
        except (diffcp.SolverError, ValueError):
            # the layer fails as a whole where one problem fails: find out which
            for i in everything[:, None] if len(everything) > 1 else ():
                try:
                    self._solve_into(result, i, problem, s0, weights)
                except (diffcp.SolverError, ValueError):
                    result.solved[i] = False
        return result

    def _solve_into(
        self,
        result: Solution,
        index: np.ndarray,
        problem: RelaxedProblem,
        s0: np.ndarray,
        weights: ComplementarityWeights,
    ) -> None:
        model = LcsMatrices(*(torch.as_tensor(matrix) for matrix in problem.model))
        some = ComplementarityWeights(weights.gap[index], weights.force[index])
        with torch.no_grad():
            found = self._run(problem, model, torch.as_tensor(s0[index]), some)
        result.actions[index], result.states[index] = found["a"].numpy(), found["s"].numpy()
        if "lam" in found:
            result.forces[index], result.gaps[index] = found["lam"].numpy(), found["phi"].numpy()
        result.solved[index] = np.isfinite(result.states[index]).all(axis=(1, 2))

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        on_cpu = LcsMatrices(*(matrix.cpu() for matrix in model))
        return self._run(problem, on_cpu, s0.cpu(), weights)["a"].to(s0.device)

    def __getstate__(self) -> dict[str, object]:
        return {"_key": None, "_statement": None, "_layer": None}  # rebuilt where it is needed


def _square_root(matrix: np.ndarray) -> np.ndarray:
    """R with RᵀR = matrix, for a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
