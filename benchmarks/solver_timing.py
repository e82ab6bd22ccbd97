"""Time, memory and exactness of one solver on one batch of problems."""

from __future__ import annotations

import contextlib
import multiprocessing
import resource
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from functools import cache
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np
import torch

from benchmarks.rivals import RIVALS, SOLVES_AGAIN
from benchmarks.rivals.base import ForwardRival
from benchmarks.solver_problems import Problems
from sb3_mpc_policy.solvers import SOLVERS, Solution, Solver, kkt_residual

__all__ = ["Duration", "Measurement", "Reference", "make_contestant", "measure", "peak_memory", "reference"]

# A time is the median of repeats: at least three and at least this many seconds, but no more seconds than the budget.
_LEAST_SECONDS, _LEAST_REPEATS, _MOST_REPEATS = 0.1, 3, 200
# Where a solver gives no multipliers they are fitted, which takes long: only for so many problems.
_CHECKED_WITHOUT_MULTIPLIERS = 16
_VERIFIED = 1e-8  # KKT residual of a solution that others are compared with


def clock() -> float:
    """Seconds: processor time of this process where torch has one thread, wall-clock time where it has more.

    On one thread and an idle machine the two are the same; on a busy one only the first says how fast a solver is.
    """
    return time.process_time() if torch.get_num_threads() == 1 else time.perf_counter()


class Duration(NamedTuple):
    """Seconds of one call for the whole batch, see :func:`clock`."""

    median: float
    least: float
    repeats: int


class Measurement(NamedTuple):
    """What a solver did with a batch. None where there is nothing to measure."""

    forward: Duration
    """A solve for a model that the solver has not seen, set-up for this model included: as after a gradient step."""
    again: Duration
    """A solve for the model of the solve before: as between two gradient steps."""
    differentiable: Duration | None
    """All that comes before the backward pass: ``forward`` and its preparation for the gradient, or where the two are
    one call of the solver, that call."""
    backward: Duration | None
    failures: int
    kkt_residual: float | None
    action_error: float | None
    gradient_error: float | None


class Reference(NamedTuple):
    """The active-set method's verified solution, and the gradient made from it."""

    actions: np.ndarray
    gradient: np.ndarray


def make_contestant(name: str) -> Solver:
    """A solver of the package or a rival, by name."""
    return SOLVERS[name]() if name in SOLVERS else RIVALS[name].make()


@cache
def cotangent(shape: tuple[int, ...]) -> torch.Tensor:
    """What the actions are multiplied by before they are summed and differentiated."""
    return torch.as_tensor(np.random.default_rng(0).normal(size=shape))


def gradient(problems: Problems, solver: Solver, solution: Solution) -> tuple[np.ndarray, float, float]:
    """Of a weighted sum of all actions, to all matrices and s0, in one row; seconds before and in the backward pass."""
    model, s0 = problems.tensors()
    leaves = [leaf for leaf in (*model, s0) if leaf.numel()]
    begun = clock()
    actions = solver.differentiable_actions(problems.problem, model, s0, problems.weights, solution)
    loss = (actions * cotangent(tuple(actions.shape))).sum()
    between = clock()
    parts = torch.autograd.grad(loss, leaves)
    done = clock()
    return np.concatenate([part.numpy().ravel() for part in parts]), between - begun, done - between


def reference(problems: Problems) -> Reference | None:
    """None where the active-set method's own solution does not meet the optimality conditions."""
    solver = SOLVERS["daqp"]()
    solution = solver.solve(*problems)
    if not solution.solved.all() or not kkt_residual(*problems, solution).max() < _VERIFIED:
        return None
    return Reference(solution.actions, gradient(problems, solver, solution)[0])


def measure(name: str, problems: Problems, budget: float, reference: Reference | None) -> Measurement:
    """Time a solver and judge what it returns.

    :param budget: seconds for the repeats of each time
    :param reference: to compare with, if there is one
    """
    solver = make_contestant(name)
    small = problems.first(1)
    solver.solve(*small)  # what is done once for all problems of this structure
    solution = None

    def solve(unseen_model: bool) -> tuple[float]:
        nonlocal problems, solution
        if unseen_model:
            problems = problems.with_unseen_model()
        begun = clock()
        solution = solver.solve(*problems)
        return (clock() - begun,)

    (forward,) = _repeated(lambda: solve(unseen_model=True), budget)
    (again,) = _repeated(lambda: solve(unseen_model=False), budget)
    assert solution is not None

    differentiable = backward = gradient_error = None
    if not isinstance(solver, ForwardRival):
        found = np.empty(0)

        def differentiate() -> tuple[float, float]:
            nonlocal found
            found, before, behind = gradient(problems, solver, solution)
            return before, behind

        gradient(small, solver, solution[np.arange(len(small.s0))])
        before, backward = _repeated(differentiate, budget)
        if name in SOLVES_AGAIN:
            differentiable = before
        else:
            both = forward.median + before.median, forward.least + before.least
            differentiable = Duration(*both, min(forward.repeats, before.repeats))
        if reference is not None:
            size = float(np.linalg.norm(reference.gradient))
            gradient_error = float(np.linalg.norm(found - reference.gradient)) / max(size, 1e-12)
    return Measurement(
        forward,
        again,
        differentiable,
        backward,
        failures=int((~solution.solved).sum()),
        kkt_residual=_residual(problems, solution),
        action_error=None if reference is None else _worst(np.abs(solution.actions - reference.actions), solution),
        gradient_error=gradient_error,
    )


def _repeated(run: Callable[[], tuple[float, ...]], budget: float) -> list[Duration]:
    """Repeat what times itself."""
    times: list[tuple[float, ...]] = []
    begun = clock()
    while True:
        times.append(run())
        spent = clock() - begun
        enough = spent >= _LEAST_SECONDS and len(times) >= _LEAST_REPEATS
        if enough or len(times) >= _MOST_REPEATS or spent * (1 + 1 / len(times)) > budget:
            return [Duration(statistics.median(one), min(one), len(one)) for one in zip(*times, strict=True)]


def _residual(problems: Problems, solution: Solution) -> float | None:
    index = np.flatnonzero(solution.solved)
    if solution.multipliers is None:
        index = index[:_CHECKED_WITHOUT_MULTIPLIERS]
    if not len(index):
        return None
    weights = type(problems.weights)(problems.weights.gap[index], problems.weights.force[index])
    return float(kkt_residual(problems.problem, problems.s0[index], weights, solution[index]).max())


def _worst(errors: np.ndarray, solution: Solution) -> float | None:
    return float(errors[solution.solved].max()) if solution.solved.any() else None


# -- memory --


def peak_memory(name: str, problems: Problems, limit: float = 120.0) -> float | None:
    """How far one solve, gradient and backward pass push up the peak of a fresh process's resident memory, MiB.

    The process is forked from a server that has only imported the package; it holds the problems, and has solved the
    first of them, before the peak is first read. None on systems without such servers, or where it takes too long.

    :param limit: seconds
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return None
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    mine, other = context.Pipe(duplex=False)
    process = context.Process(target=_report_memory, args=(other, name, problems, torch.get_num_threads()), daemon=True)
    process.start()
    other.close()
    result = None
    if mine.poll(limit):
        with contextlib.suppress(EOFError):  # the process died
            result = mine.recv()
    process.kill()
    process.join()
    return result


def _report_memory(connection: Connection, name: str, problems: Problems, threads: int) -> None:
    torch.set_num_threads(threads)
    warnings.simplefilter("ignore")
    solver = make_contestant(name)
    _solve_and_differentiate(solver, problems.first(1))
    before = _peak()
    _solve_and_differentiate(solver, problems)
    connection.send(_peak() - before)


def _solve_and_differentiate(solver: Solver, problems: Problems) -> None:
    solution = solver.solve(*problems)
    if not isinstance(solver, ForwardRival):
        gradient(problems, solver, solution)


def _peak() -> float:
    """Of this process's resident memory, MiB."""
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
