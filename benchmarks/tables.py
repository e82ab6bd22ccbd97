"""The tables of the results page, as Markdown. Each takes what was run; a number that is not there is a dash."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from benchmarks.aggregates import Interval
from benchmarks.probes import ProbeLine
from benchmarks.store import FinishedRun
from benchmarks.summary import Row, Spread, ratio, spread

__all__ = [
    "across", "final", "machines", "matrices", "number", "parts", "predictions", "ratios", "rival", "solve", "tasks",
]  # fmt: skip

DASH = "\N{EN DASH}"
TARGETS = {"rollouts": 60.0, "steps": 200.0, "seconds": 5.0}
"""How many times less than the best baseline we want to need."""


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]], texts: int = 1) -> str:
    """A table.

    :param texts: so many columns from the left are words, the others numbers
    """
    rules = ["---" if i < texts else "---:" for i in range(len(header))]
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, rules, *lines))


def number(value: float | None, digits: int | None = None) -> str:
    """A number with separators, three digits where it is small; a dash where there is none.

    :param digits: after the point
    """
    if value is None or not math.isfinite(value):
        return DASH
    if digits is None:
        size = abs(value)
        digits = 0 if size >= 100 or value == round(value) else 1 if size >= 10 else 2 if size >= 1 else 3
    return f"{value:,.{digits}f}".replace("-", "−")


def percent(value: float) -> str:
    """A share."""
    return DASH if not math.isfinite(value) else f"{100.0 * value:,.1f} %".replace("-", "−")


def _quartiles(values: Spread, digits: int | None = None) -> str:
    low, median, high, _ = values
    if not math.isfinite(median):
        return DASH
    return f"{number(median, digits)} [{number(low, digits)}, {number(high, digits)}]"


def _with_range(values: Sequence[float], digits: int | None = None) -> str:
    """Median, and in brackets the smallest and the largest where they differ."""
    low, median, high = (number(float(v), digits) for v in (min(values), np.median(values), max(values)))
    return median if low == high else f"{median} ({low} to {high})"


# -- training runs --


def solve(rows: Sequence[Row]) -> str:
    """When runs are solved, and what they end at."""
    header = ("row", "seeds", "trained for, steps", "solved", "held", "rollouts to solve", "steps", "seconds", "final")
    lines = []
    for row in rows:
        n = len(row.verdicts)
        rollouts, steps, seconds = (
            spread([getattr(v, of) for v in row.verdicts]) for of in ("rollouts", "steps", "seconds")
        )
        worst = f" ({number(rollouts.worst)})" if math.isfinite(rollouts.median) else ""
        lines.append((
            f"`{row.name}`", str(n), number(row.steps),
            f"{sum(v.rollouts is not None for v in row.verdicts)}/{n}", f"{sum(v.held for v in row.verdicts)}/{n}",
            _quartiles(rollouts) + worst, _quartiles(steps), _quartiles(seconds),
            number(float(np.median(row.final)), 0),
        ))  # fmt: skip
    return markdown(header, lines)


def ratios(pairs: Mapping[str, tuple[Row, Sequence[Row]]]) -> str:
    """How many times more the best baseline needs.

    :param pairs: title -> our row, and the baselines on the same plant in the same engine
    """
    header = ("", "best baseline", "until solved", "theirs", "ours", "ratio", "wanted")
    lines = []
    for title, (ours, baselines) in pairs.items():
        for quantity, target in TARGETS.items():
            median = spread([getattr(v, quantity) for v in ours.verdicts]).median
            found = ratio(quantity, ours, baselines)
            name, theirs, shown = DASH, DASH, DASH
            if found is not None:
                more = "> " if found.at_least else ""
                name, theirs = f"`{found.baseline}`", more + number(found.value * median)
                shown = f"{more}{number(found.value)}"
            lines.append((title, name, quantity, theirs, number(median), shown, f"≥ {target:.0f}"))
    return markdown(header, lines, texts=3)


def final(rows: Sequence[Row]) -> str:
    """What runs end at, beside the references."""
    header = ("row", "seeds", "trained for, steps", "final score", "share of the oracle's", "best evaluation")
    lines = [
        (f"`{row.name}`", str(len(row.final)), number(row.steps), _quartiles(spread(list(row.final)), 0),
         percent(float(np.median(row.final)) / row.oracle), number(float(np.median(row.best)), 0))
        for row in rows
    ]  # fmt: skip
    for env, row in {row.env: row for row in rows}.items():
        lines += [
            (f"{name}, `{env}`", "", "", number(score, 0), percent(score / row.oracle), "")
            for name, score in (("oracle", row.oracle), ("LQR", row.lqr))
        ]
    return markdown(header, lines)


def parts(rows: Mapping[str, Row]) -> str:
    """What runs with one change end at, the oracle's score being 1.

    :param rows: label -> row
    """
    header = ("change", "seeds", "solved", "held", "at the end, median", "each", "best, median")
    lines = []
    for label, row in rows.items():
        n, end = len(row.verdicts), row.final / row.oracle
        lines.append((
            label, str(n), f"{sum(v.rollouts is not None for v in row.verdicts)}/{n}",
            f"{sum(v.held for v in row.verdicts)}/{n}", number(float(np.median(end)), 3),
            ", ".join(number(float(share), 2) for share in end),
            number(float(np.median(row.best)) / row.oracle, 3),
        ))  # fmt: skip
    return markdown(header, lines)


def across(means: Mapping[str, Interval], sizes: Mapping[str, tuple[int, int]]) -> str:
    """Interquartile means over several tasks.

    :param means: by learner
    :param sizes: by learner: how many seeds and tasks
    """
    header = ("learner", "seeds", "tasks", "interquartile mean", "95 % interval")
    lines = [
        (name, *map(str, sizes[name]), number(value, 3), f"{number(low, 3)} to {number(high, 3)}")
        for name, (value, low, high) in means.items()
    ]
    return markdown(header, lines)


def machines(finished: Sequence[FinishedRun]) -> str:
    """Where, when, and with what runs were made."""
    groups = defaultdict(list)
    for run in finished:
        groups[run.machine, run.versions].append(run)
    lines = []
    for (machine, versions), runs in groups.items():
        dates = sorted({run.date[:10] for run in runs})
        commits = ", ".join(f"`{commit}`" for commit in sorted({run.commit for run in runs if run.commit})) or DASH
        hours = sum(run.wall_seconds for run in runs) / 3600.0
        when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
        lines.append((machine, str(len(runs)), number(hours, 1), when, commits, versions.replace("=", " ")))
    return markdown(("machine", "runs", "hours", "when", "commit", "versions"), lines)


# -- probes --


def _values(lines: Sequence[ProbeLine], **keys: str | float) -> list[float]:
    """The values of the lines with these keys, one a seed."""
    return [float(line["value"]) for line in lines if all(line.get(key) == keys[key] for key in keys)]


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan


def predictions(found: Mapping[str, Sequence[ProbeLine]]) -> str:
    """How well learned models predict.

    :param found: row -> lines of the probe of model quality
    """
    lines = []
    for name, probe in found.items():
        asked = {(str(line["motion"]), float(line["steps"])): None for line in probe if line.get("motion")}
        for motion, steps in asked:
            keys: dict[str, str | float] = {"quantity": "error", "motion": motion, "steps": steps}
            learned, true = _values(probe, model="learned", **keys), _values(probe, model="true", **keys)
            where = "in contact" if motion == "contact" else "in free motion"
            shown = _with_range(learned, 3) if learned else DASH
            lines.append((f"`{name}`", where, number(steps), shown, number(_median(true), 3)))
    return markdown(("row", "", "steps", "learned model", "true model"), lines, texts=2)


def matrices(found: Mapping[str, Sequence[ProbeLine]]) -> str:
    """How far the matrices of learned models are from the true ones; those of a contact over all contacts.

    :param found: row -> lines of the probe of model quality
    """
    names = ("A", "B", "d", "D", "E", "c", "effect")
    lines = []
    for name, probe in found.items():
        values = {matrix: _values(probe, matrix=matrix, quantity="error") for matrix in names}
        spurious = _values(probe, quantity="spurious contacts")
        # a contact that was found has a D; one that was not has an effect's error alone
        counts = (f"{len(values['D'])}/{len(values['effect'])}", number(sum(spurious)))
        lines.append((f"`{name}`", *(number(_median(values[matrix]), 3) for matrix in names), *counts))
    return markdown(("row", *names, "contacts found", "spurious"), lines)


def tasks(found: Mapping[str, Sequence[ProbeLine]]) -> str:
    """Scores in tasks that the model was not learned for.

    :param found: row -> lines of the probe of reuse
    """
    lines = []
    for name, probe in found.items():
        for task in dict.fromkeys(line["task"] for line in probe):
            learned, oracle, lqr = (
                _values(probe, task=task, controller=each, quantity="score") for each in ("learned", "oracle", "lqr")
            )
            shown = _with_range(learned, 0) if learned else DASH
            lines.append((f"`{name}`", str(task), shown, number(_median(oracle), 0), number(_median(lqr), 0)))
    return markdown(("row", "task", "learned model", "oracle", "LQR"), lines, texts=2)


# -- another learner --


def rival(lines: Sequence[Mapping[str, float]], ours: Row | None) -> str:
    """Another learner's evaluations, each beside our last one until then.

    :param lines: its steps, rollouts, seconds and score
    :param ours: medians over seeds are shown
    """
    shown = []
    for line in lines:
        mine: list[str] = [DASH] * 4
        if ours is not None:
            steps = line["steps"]
            last = [max(e for e in run if e.steps <= steps) for run in ours.evaluations.values()]
            mine = [number(float(np.median(column)), digits) for column, digits in zip(
                zip(*last, strict=True), (0, None, None, 0), strict=True
            )]  # fmt: skip
        theirs = (number(line["steps"]), number(line["rollouts"]), number(line["seconds"]), number(line["score"], 0))
        shown.append((*theirs, *mine))
    header = ("PETS: steps", "rollouts", "seconds", "score", "ours: steps", "rollouts", "seconds", "score")
    return markdown(header, shown, texts=0)
