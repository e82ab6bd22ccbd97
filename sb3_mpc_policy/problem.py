"""The controller's problem, eq (6), with its complementarity relaxed: as data, and as a statement in CVXPY.

    minimise    Σ_{k<H} (z_kᵀ W z_k + wᵀ z_k)  +  s_Hᵀ P s_H + pᵀ s_H               z_k = (s_k, a_k)
                + Σ_{k<H} (w_phi_kᵀ phi_k + w_lam_kᵀ lam_k + delta |lam_k|²)
    subject to  s_{k+1} = A s_k + B a_k + C lam_k + d
                phi_k   = D s_k + E a_k + F lam_k + c
                lam_k >= 0,  phi_k >= 0,  a_low <= a_k <= a_high,  s_0 given

The product ``lamᵀ phi = 0`` of eq (6) is not convex; the weights ``w_phi`` and ``w_lam`` (mpc.py) stand in for it, and
make the rest a convex quadratic programme. ``delta`` is tiny and makes the forces unique where the cost does not
feel them. Everything here is in scaled coordinates and float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cvxpy as cp
import numpy as np

from sb3_mpc_policy.lcs import LcsMatrices

__all__ = ["ComplementarityWeights", "RelaxedProblem", "relaxed_problem"]


class ComplementarityWeights(NamedTuple):
    """What stands in for ``lam ⟂ phi``: gap weights w_phi and force weights w_lam, each (N, H, n_lambda) >= 0."""

    gap: np.ndarray
    force: np.ndarray


@dataclass(frozen=True, eq=False)
class RelaxedProblem:
    """The data of the problem that all states of a batch share.

    :param model: the matrices of eq (5)
    :param stage_weight: W (n_x + n_a, n_x + n_a) positive semidefinite, positive definite in the actions
    :param stage_slope: w (n_x + n_a,)
    :param terminal_weight: P (n_x, n_x) positive semidefinite
    :param terminal_slope: p (n_x,)
    :param action_low: (n_a,), may be -inf
    :param action_high: (n_a,), may be inf
    :param horizon: H >= 1
    :param force_weight: delta > 0
    :param device: where the model's parameters live; solvers for whole batches work there
    """

    model: LcsMatrices[np.ndarray]
    stage_weight: np.ndarray
    stage_slope: np.ndarray
    terminal_weight: np.ndarray
    terminal_slope: np.ndarray
    action_low: np.ndarray
    action_high: np.ndarray
    horizon: int
    force_weight: float
    device: str = "cpu"

    @property
    def sizes(self) -> tuple[int, int, int]:
        """n_x, n_a, n_lambda"""
        return (*self.model.B.shape, len(self.model.c))

    @cached_property
    def stiffness(self) -> np.ndarray:
        """(n_lambda,) diagonal of F, which turns forces into gaps."""
        return np.diag(self.model.F)

    def cost(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The cost of eq (6) without penalty. states: (N, H+1, n_x), actions: (N, H, n_a) -> (N,)"""
        z = np.concatenate([states[:, :-1], actions], axis=-1)
        last = states[:, -1]
        stage = ((z @ self.stage_weight) * z).sum(axis=(1, 2)) + (z @ self.stage_slope).sum(axis=1)
        return stage + ((last @ self.terminal_weight) * last).sum(axis=1) + last @ self.terminal_slope


class Statement(NamedTuple):
    """The problem in CVXPY, with the names of its parameters and variables."""

    problem: cp.Problem
    parameters: dict[str, cp.Parameter]
    variables: dict[str, cp.Variable]


def relaxed_problem(like: RelaxedProblem) -> Statement:
    """State the problem for the sizes and the action bounds of ``like``; everything else is a parameter.

    Convex in the variables and, by CVXPY's DPP rules, affine in each parameter: hence a ``CvxpyLayer``.
    """
    n_x, n_a, n_c = like.sizes
    H = like.horizon
    shapes: dict[str, tuple[int, ...]] = {
        "A": (n_x, n_x), "B": (n_x, n_a), "d": (n_x,), "s0": (n_x,),
        "W_sqrt": (n_x + n_a, n_x + n_a), "w": (n_x + n_a,), "P_sqrt": (n_x, n_x), "p": (n_x,),
    }  # fmt: skip
    if n_c:
        shapes |= {
            "C": (n_x, n_c), "D": (n_c, n_x), "E": (n_c, n_a), "F": (n_c, n_c), "c": (n_c,),
            "w_phi": (H, n_c), "w_lam": (H, n_c),
        }  # fmt: skip
    v = {name: cp.Parameter(shape, name=name) for name, shape in shapes.items()}
    s, a = cp.Variable((H + 1, n_x), name="s"), cp.Variable((H, n_a), name="a")
    variables = {"s": s, "a": a}
    if n_c:
        lam, phi = cp.Variable((H, n_c), name="lam"), cp.Variable((H, n_c), name="phi")
        variables |= {"lam": lam, "phi": phi}

    cost = cp.sum_squares(v["P_sqrt"] @ s[H]) + v["p"] @ s[H]
    constraints = [s[0] == v["s0"]]
    for k in range(H):
        z = cp.hstack([s[k], a[k]])
        cost += cp.sum_squares(v["W_sqrt"] @ z) + v["w"] @ z
        dynamics = v["A"] @ s[k] + v["B"] @ a[k] + v["d"]
        if n_c:
            dynamics += v["C"] @ lam[k]
            cost += v["w_phi"][k] @ phi[k] + v["w_lam"][k] @ lam[k]
            constraints.append(phi[k] == v["D"] @ s[k] + v["E"] @ a[k] + v["F"] @ lam[k] + v["c"])
        constraints.append(s[k + 1] == dynamics)
    if n_c:
        cost += like.force_weight * cp.sum_squares(lam)
        constraints += [lam >= 0, phi >= 0]
    for i in range(n_a):
        if np.isfinite(like.action_low[i]):
            constraints.append(a[:, i] >= like.action_low[i])
        if np.isfinite(like.action_high[i]):
            constraints.append(a[:, i] <= like.action_high[i])
    return Statement(cp.Problem(cp.Minimize(cost), constraints), v, variables)
