"""What result files come to: verdicts, medians and quartiles, ratios, learning curves.

A run that is never solved counts as solved later than every other one, at infinity. A median, or quartile, that is not
finite says that so many runs were not solved.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks import evaluation
from benchmarks.evaluation import Evaluation
from benchmarks.store import FinishedRun

__all__ = ["Ratio", "Row", "Spread", "Verdict", "curve", "ratio", "spread", "verdict"]


# -- one run --


class Verdict(NamedTuple):
    """What a run came to. ``None`` where it was never solved."""

    rollouts: int | None
    steps: int | None
    seconds: float | None
    held: bool
    final: float
    worst_after: float | None


def verdict(evaluations: Sequence[Evaluation], oracle_score: float) -> Verdict:
    """Judge a run by the protocol of :mod:`benchmarks.evaluation`."""
    first = evaluation.solved(evaluations, oracle_score)
    after = evaluation.after_solving(evaluations, oracle_score)
    return Verdict(
        rollouts=None if first is None else first.rollouts,
        steps=None if first is None else first.steps,
        seconds=None if first is None else first.seconds,
        held=evaluation.held(evaluations, oracle_score),
        final=evaluations[-1].score,
        worst_after=min((e.score for e in after), default=None),
    )


# -- the runs of a row --


@dataclass(frozen=True)
class Row:
    """The finished runs of a row of the table of experiments."""

    name: str
    env: str
    oracle: float
    lqr: float
    """Not a number where it was not measured."""
    evaluations: Mapping[int, Sequence[Evaluation]]
    """By seed."""
    finished: Sequence[FinishedRun] = ()
    """Where and when they were made; empty where that is not known."""

    @functools.cached_property
    def verdicts(self) -> list[Verdict]:
        """In the order of the seeds."""
        return [verdict(run, self.oracle) for run in self.evaluations.values()]

    @property
    def steps(self) -> int:
        """How long the longest run is, environment steps."""
        return max(run[-1].steps for run in self.evaluations.values())

    @property
    def final(self) -> np.ndarray:
        """(n_seeds,) scores of the last evaluation."""
        return np.array([run[-1].score for run in self.evaluations.values()])

    @property
    def best(self) -> np.ndarray:
        """(n_seeds,) scores of the best evaluation."""
        return np.array([max(e.score for e in run) for run in self.evaluations.values()])


# -- several runs --


class Spread(NamedTuple):
    """Of a number over the seeds."""

    low: float
    """First quartile."""
    median: float
    high: float
    """Third quartile."""
    worst: float
    """The largest."""


def spread(values: Sequence[float | None]) -> Spread:
    """Median, quartiles (linear between neighbours) and the largest; ``None`` is infinity.

    :raises ValueError: there is no value
    """
    if not len(values):
        raise ValueError("values must not be empty")
    ordered = sorted(math.inf if value is None else float(value) for value in values)

    def quantile(share: float) -> float:
        position = share * (len(ordered) - 1)
        below, above = ordered[math.floor(position)], ordered[math.ceil(position)]
        # infinity minus infinity is not a number
        return above if below == above else below + (position - math.floor(position)) * (above - below)

    return Spread(quantile(0.25), quantile(0.5), quantile(0.75), ordered[-1])


class Ratio(NamedTuple):
    """How many times more a baseline needs."""

    baseline: str
    """The row that needs least."""
    value: float
    at_least: bool
    """The baseline's median run is not solved: it needs more than it was given."""


def ratio(quantity: str, ours: Row, baselines: Sequence[Row]) -> Ratio | None:
    """Median of the best baseline over our median, until solved; None where ours is not solved or nothing to compare.

    The best baseline is the one with the smallest median. Where none has a finite one, unsolved runs are taken to be
    solved at their end, which is too early.

    :param quantity: "rollouts", "steps" or "seconds"
    """
    median = spread([getattr(v, quantity) for v in ours.verdicts]).median
    if not baselines or not 0.0 < median < math.inf:
        return None
    medians = {row.name: spread([getattr(v, quantity) for v in row.verdicts]).median for row in baselines}
    solved = math.isfinite(min(medians.values()))
    if not solved:
        medians = {row.name: spread(_until_solved_or_end(quantity, row)).median for row in baselines}
    best = min(medians, key=lambda name: medians[name])
    return Ratio(best, medians[best] / median, not solved)


def _until_solved_or_end(quantity: str, row: Row) -> list[float]:
    pairs = zip(row.verdicts, row.evaluations.values(), strict=True)
    return [getattr(run[-1] if v.rollouts is None else v, quantity) for v, run in pairs]


def curve(row: Row, unit: str, start: float) -> tuple[np.ndarray, np.ndarray]:
    """Quartiles of the score in the course of training.

    Seeds are evaluated at different times; between evaluations a score changes linearly with the logarithm of time.

    :param unit: "rollouts" or "steps"
    :param start: the time, in that unit, that stands for zero
    :return: (N,) times, up to where the first seed ends, and (3, N) first quartile, median, third quartile
    """
    known = []
    for run in row.evaluations.values():
        latest = {max(float(getattr(e, unit)), start): e.score for e in run}  # the last of those at the same time
        known.append((np.log(list(latest)), np.array(list(latest.values()))))
    end = min(times[-1] for times, _ in known)
    grid = np.unique(np.concatenate([times[times <= end] for times, _ in known]))
    scores = [np.interp(grid, times, values) for times, values in known]
    return np.exp(grid), np.quantile(scores, [0.25, 0.5, 0.75], axis=0)
