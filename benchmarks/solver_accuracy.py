"""How often the solvers fail, and how exact they and their derivative are.

    python -m benchmarks.solver_accuracy

Two families of problems, each with as many states: *training*, all that the controller asks of its solver while PPO
learns the cart-pole with soft walls and its Hard variant, and *random*, contact models of every size up to 8 contacts
and horizon 20, under the controller's own cost, penalty and nominal.

Solved problems are judged by the optimality conditions, which need no reference. Of each random model one state is also
solved by two references that share the statement in CVXPY and nothing else with the solvers: its cone programme (the
solver "cvxpylayers", which also differentiates it) and its quadratic programme, both by Clarabel to 1e-12. Where the
two differ, the second is right: a cone programme knows an action to the root of its tolerance only. Derivatives are
also held against central differences of the solutions. What counts as agreement is in :data:`LIMITS`.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np
import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track
from rich.table import Table
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks import runs
from benchmarks.solver_problems import Problems
from sb3_mpc_policy import LcsMpc, LinearComplementaritySystem, MpcLcsPolicy, QuadraticReward
from sb3_mpc_policy.mpc import ControllerStatistics
from sb3_mpc_policy.problem import ComplementarityWeights, Statement, relaxed_problem
from sb3_mpc_policy.solvers import Solution, Solver, kkt_residual
from sb3_mpc_policy.solvers.active_set import active_constraints
from sb3_mpc_policy.solvers.auto import AutomaticSolver
from sb3_mpc_policy.solvers.cvxpylayers import CvxpyLayersSolver
from sb3_mpc_policy.solvers.interior_point import InteriorPointSolver

TRAINING = {"CartPoleSoftWallsPyBullet-v0": 10, "CartPoleSoftWallsHardPyBullet-v0": 11}
"""Environments and their training seeds."""
STEPS = 2_000  # of a training run, which the schedules stretch over; it is left once it has met its share of states
MODELS_PER_STRUCTURE = 20  # sizes and horizon in common: stating a problem in CVXPY takes longer than solving it
LIMITS = {"failed": 0.0, "retried": 0.0, "excluded": 0.0, "kkt residual": 1e-8, "actions": 1e-6, "gradient": 1e-4}
"""Largest value that counts as agreement, by kind of quantity: differences are relative to the largest action of the
plan, and to the size of the gradient."""
MARGIN = 1e-3  # slack or multiplier, scaled, that every constraint must have for the derivative to be asked for
DIFFERENCES = (1e-3, 1e-4, 1e-5, 1e-6)  # steps, tried in turn until one is good enough
DIFFERENCES_AGREE = 1e-5  # of the step and its half, relative as the gradient: else differences cannot judge it
TOLERANCE = {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}


class Row(NamedTuple):
    """One line of the result file: how many values there are, and how many of them are above the limit."""

    family: str
    solver: str
    quantity: str
    problems: int
    limit: float
    above: int
    share: float
    median: float
    p99: float
    largest: float


def row(family: str, solver: str, quantity: str, values: Sequence[float] | np.ndarray) -> Row:
    """Summarise values; one that is not a number counts as above the limit, and as infinite."""
    limit = next(limit for kind, limit in LIMITS.items() if quantity.startswith(kind))
    found = np.nan_to_num(np.asarray(values, dtype=np.float64), nan=np.inf)
    above = int((found > limit).sum())
    statistics = np.quantile(found, [0.5, 0.99, 1.0], method="higher") if len(found) else [np.nan] * 3
    return Row(family, solver, quantity, len(found), limit, above, above / max(len(found), 1), *map(float, statistics))


# -- the problems --


class Recorder(Solver):
    """The automatic choice, and what was asked of it and how that went.

    It also counts states, and those whose plan is the regulator's.
    """

    def __init__(self) -> None:
        self.solver = AutomaticSolver()
        self.asked: list[Problems] = []
        self.failed: list[np.ndarray] = []
        self.residuals: list[np.ndarray] = []
        self.states = self.fallbacks = 0

    def solve(self, *problems: Any) -> Solution:
        solution = self.solver.solve(*problems)
        self.asked.append(Problems(*problems))
        self.failed.append(~solution.solved)
        self.residuals.append(residual_of_solved(self.asked[-1], solution))
        return solution

    def differentiable_actions(self, *arguments: Any) -> torch.Tensor:
        return self.solver.differentiable_actions(*arguments)

    def count(self, controller: LcsMpc) -> None:
        """Add the controller's counts since the last call."""
        self.states += controller.statistics.plans
        self.fallbacks += controller.statistics.failed
        controller.statistics = ControllerStatistics()


def residual_of_solved(problems: Problems, solution: Solution) -> np.ndarray:
    """KKT residuals of the problems that were solved."""
    index = np.flatnonzero(solution.solved)
    weights = ComplementarityWeights(problems.weights.gap[index], problems.weights.force[index])
    return kkt_residual(problems.problem, problems.s0[index], weights, solution[index])


class _RecordTraining(BaseCallback):
    """Puts a recorder in the policy's controller; ends training once it has met so many states."""

    def __init__(self, recorder: Recorder, states: int) -> None:
        super().__init__()
        self.recorder, self.states = recorder, states

    def _on_training_start(self) -> None:
        controller = _policy(self.model).mpc
        controller.solver = self.recorder
        controller.statistics = ControllerStatistics()
        controller.register_forward_hook(lambda *_: self.recorder.count(controller))

    def _on_step(self) -> bool:
        return self.recorder.states < self.states


def _policy(model: BaseAlgorithm) -> MpcLcsPolicy:
    assert isinstance(model.policy, MpcLcsPolicy)
    return model.policy


def record_training(states: int) -> Recorder:
    """All that is asked of the solver in training runs, until the controller has planned for so many states."""
    recorder = Recorder()
    for i, (env_id, seed) in enumerate(TRAINING.items(), start=1):
        callback = _RecordTraining(recorder, i * states // len(TRAINING))
        while recorder.states < callback.states:  # small runs stop within the first; large ones go on with new seeds
            runs.train(env_id, runs.settings_for(env_id, {}), seed, STEPS, [callback])
            seed += len(TRAINING)
    return recorder


class Structure(NamedTuple):
    """What models that share a statement have in common."""

    n_x: int
    n_a: int
    n_lambda: int
    horizon: int


def structures(models: int, seed: int) -> Iterator[Structure]:
    """A structure for each model: n_lambda 0 to 8, n_x 2 to 6, n_a 1 to 3, H 1 to 20."""
    rng = np.random.default_rng(seed)
    for i in range(-(-models // MODELS_PER_STRUCTURE)):
        n_x, n_a, horizon = rng.integers([2, 1, 1], [7, 4, 21])
        structure = Structure(int(n_x), int(n_a), i % 9, int(horizon))
        yield from itertools.repeat(structure, min(MODELS_PER_STRUCTURE, models - i * MODELS_PER_STRUCTURE))


def random_controller(structure: Structure, rng: np.random.Generator) -> LcsMpc:
    """A controller around a random model whose contacts and action bounds are both met by states of order one."""
    n_x, n_a, n_c, horizon = structure
    lcs = LinearComplementaritySystem(n_x, n_a, n_c)
    push = rng.normal(size=(n_c, n_x))
    push /= np.linalg.norm(push, axis=1, keepdims=True)
    with torch.no_grad():
        for parameter, value in (
            (lcs.A_scaled, np.eye(n_x) + 0.15 * rng.normal(size=(n_x, n_x))),
            (lcs.B_scaled, 0.5 * rng.normal(size=(n_x, n_a))),
            (lcs.C_scaled, 0.3 * push.T + 0.1 * rng.normal(size=(n_x, n_c))),
            (lcs.d_scaled, 0.05 * rng.normal(size=n_x)),
            (lcs.D_scaled, push),
            (lcs.E_scaled, 0.1 * rng.normal(size=(n_c, n_a))),
            (lcs.c_scaled, rng.uniform(0.1, 1.0, n_c)),
            (lcs.F_factor, np.eye(n_c) + 0.3 * rng.normal(size=(n_c, n_c))),
            (lcs.F_skew, 0.2 * rng.normal(size=(n_c, n_c))),
        ):
            parameter.copy_(torch.as_tensor(value))
    weight = np.exp(rng.uniform([-2.0] * n_x + [-3.0] * n_a, [2.0] * n_x + [1.0] * n_a))
    weight /= weight.mean()
    return LcsMpc(lcs, QuadraticReward(weight[:n_x], weight[n_x:]), np.full(n_a, -0.7), np.ones(n_a), horizon)


def record_random(models: int, states: int, seed: int) -> tuple[Recorder, list[Problems]]:
    """All that is asked of the solver for so many states in all, and the first problem of each model."""
    recorder, firsts = Recorder(), []
    rng = np.random.default_rng(seed)
    for structure in track(list(structures(models, seed)), "random models", transient=True):
        controller = random_controller(structure, rng)
        controller.solver = recorder
        n, before = max(states // models, 1), len(recorder.asked)
        plan = controller.plan(rng.normal(size=(n, structure.n_x)) * rng.uniform(0.1, 2.0, (n, 1)))
        recorder.states += n
        recorder.fallbacks += int((plan.status == "fallback").sum())
        first = recorder.asked[before]
        # but for rounding the same for all; the layer is made for one value
        problem = dataclasses.replace(first.problem, force_weight=round(first.problem.force_weight, 12))
        firsts.append(first.first(1)._replace(problem=problem))
    return recorder, firsts


# -- failures and residuals --


def judge(family: str, recorder: Recorder) -> list[Row]:
    """The automatic choice on all that was recorded, on a CPU daqp; then torch."""
    active_set_method = recorder.solver.active_set_method
    found = [
        row(family, "auto", "failed", np.concatenate(recorder.failed)),
        row(family, "auto", "failed: plans that are the regulator's", np.arange(recorder.states) < recorder.fallbacks),
        row(family, "auto", "kkt residual", np.concatenate(recorder.residuals)),
        _share(family, "daqp", "retried in proximal form", recorder, active_set_method.retries),
        _share(family, "daqp", "retried by torch", recorder, recorder.solver.handed_over),
    ]
    interior_point = InteriorPointSolver()
    failed, residuals = [], []
    for problems in track(list(_together(recorder.asked)), f"torch, {family}", transient=True):
        solution = interior_point.solve(*problems)
        failed.append(~solution.solved)
        residuals.append(residual_of_solved(problems, solution))
    return [
        *found,
        row(family, "torch", "failed", np.concatenate(failed)),
        _share(family, "torch", "retried by daqp", recorder, interior_point.handed_over),
        row(family, "torch", "kkt residual", np.concatenate(residuals)),
    ]


def _share(family: str, solver: str, quantity: str, recorder: Recorder, number: int) -> Row:
    return row(family, solver, quantity, np.arange(sum(map(len, recorder.failed))) < number)


def _together(asked: Sequence[Problems]) -> Iterator[Problems]:
    """Consecutive batches of one model as one batch."""
    for _, group in itertools.groupby(asked, key=lambda problems: id(problems.problem)):
        parts = list(group)
        gap, force = (np.concatenate([part.weights[i] for part in parts]) for i in range(2))
        yield Problems(
            parts[0].problem, np.concatenate([part.s0 for part in parts]), ComplementarityWeights(gap, force)
        )


# -- against the references --


def quadratic_programme(statement: Statement, problems: Problems) -> np.ndarray:
    """The actions (H, n_a) of the first problem, by Clarabel on the quadratic programme that CVXPY makes of it."""
    p = problems.problem
    values = dict(zip("ABCdDEFc", p.model, strict=True)) | {
        "s0": problems.s0[0],
        "W_sqrt": np.linalg.cholesky(p.stage_weight).T,
        "w": p.stage_slope,
        "P_sqrt": _square_root(p.terminal_weight),
        "p": p.terminal_slope,
        "w_phi": problems.weights.gap[0],
        "w_lam": problems.weights.force[0],
    }
    for name, parameter in statement.parameters.items():
        parameter.value = values[name]
    statement.problem.solve(solver=cp.CLARABEL, **TOLERANCE)
    actions = statement.variables["a"].value
    return np.full((p.horizon, p.sizes[1]), np.nan) if actions is None else np.asarray(actions)


def _square_root(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    root: np.ndarray = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return root


def strict(problems: Problems, solution: Solution) -> bool:
    """Whether every constraint of the first problem has a slack or a multiplier that is not small."""
    assert solution.multipliers is not None
    p = problems.problem
    x = np.concatenate([solution.actions[0].ravel(), solution.forces[0].ravel()])
    bounds = [np.tile(bound, p.horizon) for bound in (p.action_low, p.action_high)]
    n_actions = solution.actions[0].size
    at_bound = np.minimum(x[:n_actions] - bounds[0], bounds[1] - x[:n_actions])
    slack = np.concatenate([at_bound, x[n_actions:], solution.gaps[0].ravel()])
    return bool((np.maximum(np.abs(solution.multipliers[0]), slack) > MARGIN).all())


Gradient = dict[str, np.ndarray]


def gradient(problems: Problems, solver: Solver, solution: Solution, cotangent: np.ndarray) -> Gradient:
    """Of the sum of all actions times the cotangent, to s0 and each matrix of the model."""
    model, s0 = problems.tensors()
    actions = solver.differentiable_actions(problems.problem, model, s0, problems.weights, solution)
    (actions * torch.as_tensor(cotangent)).sum().backward()
    leaves = model._asdict() | {"s0": s0}
    return {name: np.zeros(leaf.shape) if leaf.grad is None else leaf.grad.numpy() for name, leaf in leaves.items()}


def difference(
    problems: Problems, solution: Solution, cotangent: np.ndarray, name: str, direction: np.ndarray, enough: float
) -> tuple[float, float] | None:
    """The derivative of the same sum along a direction of one argument, by central differences of fourth order.

    :param enough: uncertainty at which no smaller step is tried
    :return: the derivative, and as its uncertainty what half the step changes; None where every step changes the
        active set
    """
    p = problems.problem

    def solve(step: float) -> Solution:
        if name == "s0":
            moved = problems._replace(s0=problems.s0 + step * direction)
        else:
            matrix = getattr(p.model, name) + step * direction
            moved = problems._replace(problem=dataclasses.replace(p, model=p.model._replace(**{name: matrix})))
        return AutomaticSolver().solve(*moved)

    def active(found: Solution) -> torch.Tensor:
        free, on_gap = active_constraints(torch.as_tensor(found.multipliers), found.actions.size + found.forces.size)
        return torch.cat([free, on_gap], dim=1)

    best: tuple[float, float] | None = None
    for step in DIFFERENCES:
        found = {sign * share: solve(sign * share * step) for share in (1.0, 0.5, 0.25) for sign in (1, -1)}
        if not all(one.solved.all() and bool((active(one) == active(solution)).all()) for one in found.values()):
            continue
        value = {share: float((one.actions * cotangent).sum()) for share, one in found.items()}
        second = [(value[share] - value[-share]) / (2.0 * share * step) for share in (1.0, 0.5, 0.25)]
        fourth = [(4.0 * finer - coarser) / 3.0 for coarser, finer in itertools.pairwise(second)]
        uncertainty = abs(fourth[1] - fourth[0])
        if best is None or uncertainty < best[1]:
            best = fourth[1], uncertainty
        if uncertainty <= enough:
            break
    return best


def compare(firsts: Sequence[Problems], layers: int, seed: int) -> list[Row]:
    """The solvers and their derivatives against the references, one problem a model.

    :param layers: for how many of the problems the layer's derivative is taken too, which takes longest
    """
    rng = np.random.default_rng(seed)
    actions: dict[tuple[str, str], list[float]] = {}
    gradients: dict[tuple[str, str], list[float]] = {}
    solvers: dict[str, Solver] = {"auto": AutomaticSolver(), "torch": InteriorPointSolver()}
    layer, statement, shared = CvxpyLayersSolver(), None, None
    excluded, unjudged = [], []
    every = max(len(firsts) // max(layers, 1), 1)
    for i, problems in enumerate(track(firsts, "references", transient=True)):
        structure = (problems.problem.sizes, problems.problem.horizon)
        if statement is None or structure != shared:
            statement, shared = relaxed_problem(problems.problem), structure
        solutions = {name: solver.solve(*problems) for name, solver in solvers.items()}
        cone = layer.solve(*problems)
        found = {name: one.actions[0] for name, one in (solutions | {"cvxpylayers": cone}).items()}
        references = {"quadratic": quadratic_programme(statement, problems), "cone": found["cvxpylayers"]}
        for (name, mine), (kind, other) in itertools.product(found.items(), references.items()):
            if (name, kind) != ("cvxpylayers", "cone"):
                error = np.abs(mine - other).max() / np.abs(references["quadratic"]).max()
                actions.setdefault((name, f"actions against the {kind} programme"), []).append(error)

        excluded.append(not strict(problems, solutions["auto"]))
        if excluded[-1]:
            continue
        cotangent = rng.normal(size=solutions["auto"].actions.shape)
        derivatives = {name: gradient(problems, solver, solutions[name], cotangent) for name, solver in solvers.items()}
        with_layer = i % every == 0
        if with_layer:
            derivatives["cvxpylayers"] = gradient(problems, layer, cone, cotangent)
        errors = _errors(problems, solutions["auto"], cotangent, derivatives, rng)
        unjudged.append(errors is None)
        if errors is None:
            continue
        for name, error in errors.items():
            gradients.setdefault((name, "gradient against differences"), []).append(error)
        if with_layer:
            for name in solvers:
                size = _sizes(derivatives["cvxpylayers"])
                error = max(
                    float(np.linalg.norm(derivatives[name][part] - derivatives["cvxpylayers"][part])) / size[part]
                    for part in size
                )
                gradients.setdefault((name, "gradient against the layer's"), []).append(error)
    return [
        *(row("random", *key, values) for key, values in (actions | gradients).items()),
        row("random", "auto", "excluded from gradients: no strict complementarity", excluded),
        row("random", "auto", "excluded from gradients: differences uncertain or across modes", unjudged),
    ]


def _sizes(derivative: Gradient) -> Mapping[str, float]:
    """What an error in each part is relative to: its norm, or where it is small a thousandth of the whole's, or of one.

    Where all actions are at their bounds the derivative is zero.
    """
    norms = {part: float(np.linalg.norm(value)) for part, value in derivative.items() if value.size}
    whole = float(np.linalg.norm(list(norms.values())))
    return {part: max(norm, 1e-3 * whole, 1e-3) for part, norm in norms.items()}


def _errors(
    problems: Problems,
    solution: Solution,
    cotangent: np.ndarray,
    derivatives: Mapping[str, Gradient],
    rng: np.random.Generator,
) -> dict[str, float] | None:
    """Each derivative's largest error over s0 and the matrices, along random directions of ones and minus ones.

    Relative to the size of the first derivative. None where differences cannot judge one of them.
    """
    size = _sizes(next(iter(derivatives.values())))
    shapes = {"s0": problems.s0.shape} | {
        name: matrix.shape for name, matrix in problems.problem.model._asdict().items()
    }
    errors = dict.fromkeys(derivatives, 0.0)
    for part in size:
        direction = rng.choice([-1.0, 1.0], size=shapes[part])
        uncertain = DIFFERENCES_AGREE * size[part]
        judge = difference(problems, solution, cotangent, part, direction, 0.01 * uncertain)
        if judge is None or judge[1] > uncertain:
            return None
        expected = judge[0]
        for name, derivative in derivatives.items():
            error = abs(float((derivative[part] * direction).sum()) - expected) / size[part]
            errors[name] = max(errors[name], error) if np.isfinite(error) else np.inf
    return errors


# -- the command --


def table(rows: Sequence[Row]) -> Table:
    """For the terminal."""
    result = Table(title="failures and accuracy of the solvers", box=SIMPLE_HEAD)
    for name in ("family", "solver", "quantity"):
        result.add_column(name, overflow="fold")
    for name in ("problems", "limit", "above", "share", "median", "99 %", "largest"):
        result.add_column(name, justify="right", no_wrap=True)
    for one in rows:
        statistics = (one.median, one.p99, one.largest) if one.limit else ()
        numbers = [f"{value:.1e}" for value in statistics]
        result.add_row(
            one.family, one.solver, one.quantity, f"{one.problems:,}", f"{one.limit:g}", f"{one.above:,}",
            f"{one.share:.3%}", *numbers,
        )  # fmt: skip
    return result


def main(argv: Sequence[str] | None = None) -> list[Row]:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=int, default=1_000, help="random models")
    parser.add_argument("--states", type=int, default=50_000, help="of each of the two families")
    parser.add_argument("--layers", type=int, default=200, help="models for which the layer's derivative is taken")
    parser.add_argument("--seed", type=int, default=0, help="of the random models")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/solver_accuracy.csv"))
    args = parser.parse_args(argv)
    for name in ("models", "states"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(args, name)}")
    rows = judge("training", record_training(args.states))
    recorder, firsts = record_random(args.models, args.states, args.seed)
    rows += judge("random", recorder)
    rows += compare(firsts, args.layers, args.seed)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        writer.writerows([*one[:6], *(f"{value:.3g}" for value in one[6:])] for one in rows)
    Console().print(table(rows))
    return rows


if __name__ == "__main__":
    main()
