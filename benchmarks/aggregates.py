"""What a learner comes to over several tasks, by rliable: Agarwal et al., "Deep RL at the edge of the statistical
precipice", NeurIPS 2021.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rliable import library, metrics  # type: ignore[import-untyped]

from benchmarks.evaluation import random_state_kept
from benchmarks.summary import Row

__all__ = ["Interval", "across_tasks", "iqm", "profile"]


class Interval(NamedTuple):
    """A number and its 95 % stratified bootstrap interval."""

    value: float
    low: float
    high: float


def across_tasks(rows: Sequence[Row | None]) -> np.ndarray | None:
    """(n_seeds, n_tasks) final scores, the oracle's being 1, of the seeds that every task has; None without any.

    :param rows: of one learner, a task each; None where it was not run
    """
    known = [row for row in rows if row is not None]
    seeds = sorted(set.intersection(*(set(row.evaluations) for row in known))) if known else []
    if not seeds or len(known) < len(rows):
        return None
    return np.array([[row.evaluations[seed][-1].score / row.oracle for row in known] for seed in seeds])


def iqm(scores: Mapping[str, np.ndarray], reps: int = 2_000) -> dict[str, Interval]:
    """Interquartile means over all runs of all tasks: the mean of the middle half.

    :param scores: learner -> (n_seeds, n_tasks), see :func:`across_tasks`
    :param reps: bootstrap replications
    """
    values, intervals = _bootstrapped(
        lambda: library.get_interval_estimates(scores, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=reps)
    )
    return {name: Interval(float(values[name][0]), *(float(end) for end in intervals[name][:, 0])) for name in scores}


def profile(
    scores: Mapping[str, np.ndarray], thresholds: np.ndarray, reps: int = 500
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Performance profiles: the share of runs that score above each threshold, (N,), and its interval, (2, N).

    :param scores: see :func:`iqm`
    :param thresholds: (N,)
    :param reps: bootstrap replications
    """
    values, intervals = _bootstrapped(lambda: library.create_performance_profile(scores, thresholds, reps=reps))
    return {name: (values[name], intervals[name]) for name in scores}


def _bootstrapped(estimate: Callable[[], Any]) -> Any:
    """The same numbers at every call. rliable draws from NumPy's global state, whatever random state it is given."""
    with random_state_kept():
        np.random.seed(0)  # noqa: NPY002
        return estimate()
