"""What runs came to, as a table for the console."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from benchmarks.evaluation import Evaluation
from benchmarks.runs import Row
from benchmarks.summary import Verdict, verdict


def verdicts(rows: Sequence[Row]) -> dict[tuple[str, str, int], Verdict]:
    """Verdicts by (env, variant, seed)."""
    result = {}
    for run, lines in itertools.groupby(sorted(rows), key=lambda row: (row.env, row.variant, row.seed)):
        ordered = list(lines)
        result[run] = verdict([Evaluation(*row[3:7]) for row in ordered], ordered[0].oracle)
    return result


def summary(rows: Sequence[Row]) -> Table:
    """A table of the runs in one environment: a line each, and one with medians for each variant.

    "worst" is the lowest evaluation after the one that solved the run. A run that is not solved counts as
    later than every one that is; a median among those is shown as a dash.
    """
    table = Table(title=f"{rows[0].env}: until 95 % of the oracle's {rows[0].oracle:,.0f}, and after", box=SIMPLE_HEAD)
    table.add_column("variant", min_width=7, overflow="fold")
    for name in ("seed", "solved", "rollouts", "steps", "seconds", "held", "final", "worst"):
        table.add_column(name, justify="right", no_wrap=True)

    for variant, group in itertools.groupby(verdicts(rows).items(), key=lambda item: item[0][1]):
        judged = {seed: judgement for (_, _, seed), judgement in group}
        for seed, v in judged.items():
            solved, held = ("yes" if yes else "no" for yes in (v.rollouts is not None, v.held))
            table.add_row(
                variant, str(seed), solved, _shown(v.rollouts), _shown(v.steps), _shown(v.seconds, 1),
                held, _shown(v.final), _shown(v.worst_after),
            )  # fmt: skip
        every = list(judged.values())
        table.add_row(
            variant,
            "median",
            f"{sum(v.rollouts is not None for v in every)}/{len(every)}",
            _shown(_median([v.rollouts for v in every])),
            _shown(_median([v.steps for v in every])),
            _shown(_median([v.seconds for v in every]), 1),
            f"{sum(v.held for v in every)}/{len(every)}",
            _shown(_median([v.final for v in every])),
            style="bold",
            end_section=True,
        )
    return table


def _median(values: Sequence[float | None]) -> float:
    return float(np.median([np.inf if value is None else value for value in values]))


def _shown(value: float | None, digits: int = 0) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:,.{digits}f}"
