"""The problems that the solvers' speed is measured on."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import torch

from contact_envs.dynamics import CartPoleParameters, LcsMatrices, true_lcs
from sb3_mpc_policy import LcsMpc, LinearComplementaritySystem, QuadraticReward, hyperparams
from sb3_mpc_policy.lcs import LcsMatrices as ModelMatrices
from sb3_mpc_policy.lqr import affine_lqr
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers import Solution, Solver

__all__ = ["Problems", "cart_pole_lcs", "cart_pole_problems", "first_pass", "published_problems"]

HARD = "CartPoleSoftWallsHard-v0"
FORCE, RESET_RANGE = 10.0, np.array([0.35, 1.0, 0.30, 1.0])
"""Of the environment :data:`HARD`: N, and the magnitude of each component of the starting state."""
CONTROL_STEP = 0.01
# Where pairs of walls touch the pole: height above the hinge and distance from the origin, m. The first is the
# environment's own pair, at the tip; the further ones are as near as the pole's lower parts come out.
WALLS = ((0.6, 0.35), (0.3, 0.30), (0.45, 0.32), (0.15, 0.28))


class Problems(NamedTuple):
    """A batch of relaxed problems as the controller hands them to its solver.

    ``s0`` is (N, n_x), scaled coordinates as all the rest.
    """

    problem: RelaxedProblem
    s0: np.ndarray
    weights: ComplementarityWeights

    def first(self, n: int) -> Problems:
        """The first n problems."""
        return Problems(self.problem, self.s0[:n], ComplementarityWeights(self.weights.gap[:n], self.weights.force[:n]))

    def with_unseen_model(self) -> Problems:
        """The same problems, of a model that no solver has prepared anything for: as after a gradient step."""
        return self._replace(problem=dataclasses.replace(self.problem))

    def tensors(self) -> tuple[ModelMatrices[torch.Tensor], torch.Tensor]:
        """The model and s0 as leaves that gradients are asked for."""
        model = ModelMatrices(*(torch.tensor(matrix, requires_grad=True) for matrix in self.problem.model))
        return model, torch.tensor(self.s0, requires_grad=True)


def cart_pole_lcs(n_contacts: int) -> LcsMatrices:
    """The true LCS of the cart-pole with more pairs of walls, or none; two contacts are the environment's own.

    :param n_contacts: even, 0 to 8; shapes: :class:`contact_envs.dynamics.LcsMatrices` with n_contacts walls
    :raises ValueError: for any other number of contacts
    """
    if n_contacts % 2 or not 0 <= n_contacts <= 2 * len(WALLS):
        raise ValueError(f"n_contacts must be an even number from 0 to {2 * len(WALLS)}, got {n_contacts!r}")
    plants = [CartPoleParameters(pole_length=height, wall_distance=out) for height, out in WALLS]
    alone = [true_lcs(plant, CONTROL_STEP, FORCE) for plant in plants]
    # the gap is read in the middle of the step: what the forces have moved by then couples the contacts
    halfway = np.hstack([true_lcs(plant, CONTROL_STEP / 2, FORCE).C for plant in plants])
    inward = np.vstack([[[-1.0, 0.0, -height, 0.0], [1.0, 0.0, height, 0.0]] for height, _ in WALLS])
    compliance = np.eye(len(inward)) / plants[0].wall_stiffness
    some = slice(n_contacts)
    return LcsMatrices(
        A=alone[0].A,
        B=alone[0].B,
        C=np.hstack([one.C for one in alone])[:, some],
        d=alone[0].d,
        D=np.vstack([one.D for one in alone])[some],
        E=np.vstack([one.E for one in alone])[some],
        F=(inward @ halfway + compliance)[some, some],
        c=np.hstack([one.c for one in alone])[some],
    )


class _Recorder(Solver):
    """Keeps what the controller asks of its solver, and solves nothing."""

    def __init__(self) -> None:
        self.asked: list[Problems] = []

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        self.asked.append(Problems(problem, s0, weights))
        n_x, n_a, n_c = problem.sizes
        n, H = len(s0), problem.horizon
        sizes = {"actions": (H, n_a), "states": (H + 1, n_x), "forces": (H, n_c), "gaps": (H, n_c)}
        unsolved = np.zeros(n, dtype=bool)
        return Solution(**{name: np.zeros((n, *size)) for name, size in sizes.items()}, solved=unsolved)

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: ModelMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        raise NotImplementedError("this only records what is asked of a solver")


def cart_pole_problems(n_contacts: int, horizon: int, batch: int, seed: int = 0) -> Problems:
    """The first pass of the controller with the true LCS, from the Hard environment's starting states.

    :param n_contacts: see :func:`cart_pole_lcs`
    :param horizon: H
    :param batch: N
    :param seed: of the states
    """
    tuned = hyperparams(HARD)["policy_kwargs"]
    lcs = LinearComplementaritySystem.from_matrices(*cart_pole_lcs(n_contacts), state_scale=tuned["state_scale"])
    bound = np.ones(1)
    controller = LcsMpc(lcs, QuadraticReward(**tuned["reward"]), -bound, bound, horizon=horizon, n_iterations=1)
    states = np.random.default_rng(seed).uniform(-RESET_RANGE, RESET_RANGE, (batch, len(RESET_RANGE)))
    return first_pass(controller, states)


def first_pass(controller: LcsMpc, states: np.ndarray) -> Problems:
    """What a controller asks of its solver first.

    :param states: (N, n_x), environment units
    """
    solver = controller.solver
    recorder = controller.solver = _Recorder()
    try:
        controller.plan(states)
    finally:
        controller.solver = solver
    return recorder.asked[0]


def published_problems(batch: int = 128, horizon: int = 20, n_x: int = 8, n_u: int = 4, seed: int = 0) -> Problems:
    """Problems of the size that the README of FreyJo/differentiable_nmpc reports: no contacts, bounds on actions.

    The system is random with a spectral radius of 1.02; the starts are so far out that some bounds are active.
    """
    rng = np.random.default_rng(seed)
    A = np.eye(n_x) + 0.2 * rng.normal(size=(n_x, n_x))
    A *= 1.02 / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(n_x, n_u))
    d = 0.1 * rng.normal(size=n_x)
    W = np.diag(np.concatenate([np.ones(n_x), np.full(n_u, 0.1)]))
    w = 0.1 * rng.normal(size=n_x + n_u)
    lqr = affine_lqr(A, B, d, W, w)
    model = ModelMatrices(
        A, B, np.zeros((n_x, 0)), d, np.zeros((0, n_x)), np.zeros((0, n_u)), np.zeros((0, 0)), np.zeros(0)
    )
    problem = RelaxedProblem(model, W, w, lqr.P, lqr.p, np.full(n_u, -1.0), np.full(n_u, 1.0), horizon, 1e-6)
    nothing = np.zeros((batch, horizon, 0))
    return Problems(problem, 5.0 * rng.normal(size=(batch, n_x)), ComplementarityWeights(nothing, nothing))
