"""The learning benchmark: how many rollouts until a policy is as good as the oracle, and does it stay so?

    python -m benchmarks.learn --env CartPoleSoftWalls-v0 --seeds 0 1 2 3 4 --steps 2000 --jobs 2

One training run for each environment, variant and seed; one CSV line for each evaluation; a table at the end.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed, parallel_config
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from benchmarks import runs
from benchmarks.evaluation import Evaluation, EvaluationCallback, Evaluator
from benchmarks.references import lqr, oracle
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


def learn(
    env_id: str,
    variant: str,
    changes: Mapping[str, Any],
    seed: int,
    steps: int,
    every: int,
    n_episodes: int,
    oracle_score: float,
) -> list[Row]:
    """One training run with its evaluations."""
    with contextlib.closing(Evaluator(env_id, n_episodes)) as evaluator:
        callback = EvaluationCallback(evaluator, every)
        runs.train(env_id, runs.settings_for(env_id, changes), seed, steps, [callback])
    return runs.rows_of(callback, env_id, variant, seed, oracle_score)


def arguments(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    variants = runs.named_variants()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--env", nargs="+", default=["CartPoleSoftWalls-v0", "CartPoleSoftWallsPyBullet-v0"], metavar="ID"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4], metavar="N")
    parser.add_argument("--steps", type=int, default=2_000, help="environment steps of each run")
    parser.add_argument("--eval-every", type=int, default=128, help="environment steps between evaluations")
    parser.add_argument("--episodes", type=int, default=50, help="scored episodes of an evaluation")
    parser.add_argument(
        "--variant", nargs="+", default=["tuned"], choices=sorted(variants), help="named in variants.yml"
    )
    parser.add_argument(
        "--set", nargs="+", default=[], metavar="NAME=VALUE",
        help="change settings of every variant, e.g. learning_rate=1e-3 policy_kwargs.horizon=20",
    )  # fmt: skip
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time, one thread each")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/learn.csv"))
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> list[Row]:
    """Run the benchmark from the command line."""
    args = arguments(argv)
    console = Console()
    label = "".join(f" {change}" for change in args.set)
    variants = {
        name + label: runs.changed(runs.named_variants()[name], runs.parsed_changes(args.set)) for name in args.variant
    }

    oracles = {}
    for env_id in args.env:
        with contextlib.closing(Evaluator(env_id, args.episodes)) as evaluator:
            oracles[env_id] = evaluator.score(oracle(env_id))
            console.print(f"{env_id}: oracle {oracles[env_id]:,.0f}, LQR {evaluator.score(lqr(env_id)):,.0f}")

    todo = list(itertools.product(args.env, variants, args.seeds))
    tasks = (
        delayed(learn)(env_id, name, variants[name], seed, args.steps, args.eval_every, args.episodes, oracles[env_id])
        for env_id, name, seed in todo
    )
    columns = (TextColumn("training"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    rows: list[Row] = []
    with Progress(*columns, console=console) as progress, parallel_config("loky", inner_max_num_threads=1):
        bar = progress.add_task("training", total=len(todo))
        for finished in Parallel(n_jobs=args.jobs, return_as="generator_unordered")(tasks):
            rows += finished
            runs.write_rows(args.output, rows)  # each time, so that what is done is kept
            progress.advance(bar)
    for _, of_env in itertools.groupby(sorted(rows), key=lambda row: row.env):
        console.print(summary(list(of_env)))
    console.print(f"{len(rows)} evaluations in {args.output}")
    return rows


if __name__ == "__main__":
    main()
