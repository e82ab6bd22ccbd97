"""The whole algorithm in one go: train on the cart-pole with soft walls, score the result, draw it.

    python -m benchmarks.demo --output demo

Leaves learning_curve.png, rollout.gif, scores.csv and the trained model mpc.zip in the output folder.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks import evaluation, plots, runs
from benchmarks.evaluation import RESET_SEEDS, Evaluation, EvaluationCallback, Evaluator
from benchmarks.references import contact_env, lqr, oracle
from sb3_mpc_policy import MpcLcsPolicy


class ProgressCallback(BaseCallback):
    """Moves a progress bar on with each environment step."""

    def __init__(self, progress: Progress, bar: TaskID, total: int) -> None:
        super().__init__()
        self.progress, self.bar, self.total = progress, bar, total

    def _on_step(self) -> bool:
        self.progress.update(self.bar, completed=min(self.num_timesteps, self.total))
        return True


def planner(policy: MpcLcsPolicy) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """What :func:`benchmarks.plots.rollout_animation` asks for, from a policy."""

    def plan(observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = policy.plan(observation[None])
        return found.actions[0, 0], found.states[0]

    return plan


def liveliest_episode(env_id: str) -> int:
    """The reset seed, of those that are scored, whose plant starts nearest to a contact or deepest in one."""
    with contact_env(env_id) as plant:
        starts = np.array([plant.reset(seed=seed)[0] for seed in RESET_SEEDS])
        return RESET_SEEDS[int(np.argmin(plant.parameters.contact_gaps(starts).min(axis=1)))]


def write_scores(path: Path, scores: Mapping[str, float]) -> None:
    """Write the scores and their fractions of the oracle's."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["controller", "score", "fraction_of_oracle"])
        for name, score in scores.items():
            writer.writerow([name, round(score, 1), round(score / scores["oracle"], 4)])


def table_of(scores: Mapping[str, float]) -> Table:
    """The scores for the terminal."""
    table = Table(title=f"Mean return over {len(RESET_SEEDS)} episodes")
    table.add_column("controller")
    table.add_column("score", justify="right")
    table.add_column("of the oracle", justify="right")
    for name, score in scores.items():
        table.add_row(
            name,
            f"{score:,.0f}",
            f"{score / scores['oracle']:.1%}",
            style="bold" if name == "learned" else "",
        )
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the demo from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="CartPoleSoftWalls-v0", metavar="ID")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=2_000, help="environment steps of training")
    parser.add_argument("--eval-every", type=int, default=128, help="environment steps between evaluations")
    parser.add_argument("--output", type=Path, default=Path("demo"))
    args = parser.parse_args(argv)
    args.output.mkdir(parents=True, exist_ok=True)
    console, begun = Console(), time.perf_counter()

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        contextlib.closing(Evaluator(args.env)) as evaluator,
        Progress(*columns, console=console) as progress,
    ):
        bar = progress.add_task("scoring the oracle and LQR", total=args.steps)
        references = {"oracle": evaluator.score(oracle(args.env)), "LQR": evaluator.score(lqr(args.env))}

        def report(e: Evaluation) -> None:
            progress.console.print(
                f"{e.steps:6,} steps {e.rollouts:4} rollouts {e.seconds:6.1f} s   "
                f"score {e.score:7,.0f}, {e.score / references['oracle']:4.0%} of the oracle"
            )

        progress.update(bar, description=f"training on {args.env}")
        scored = EvaluationCallback(evaluator, args.eval_every, on_evaluation=report)
        settings = runs.settings_for(args.env, {})
        model = runs.train(
            args.env, settings, args.seed, args.steps, [ProgressCallback(progress, bar, args.steps), scored]
        )

    policy, evaluations = model.policy, scored.evaluations
    assert isinstance(policy, MpcLcsPolicy)
    references["untrained"] = evaluations[0].score
    scores = {**references, "learned": evaluations[-1].score}
    model.save(args.output / "mpc.zip")
    write_scores(args.output / "scores.csv", scores)
    plots.learning_curve(args.output / "learning_curve.png", evaluations, references, f"{args.env}, seed {args.seed}")
    plots.rollout_animation(args.output / "rollout.gif", args.env, planner(policy), liveliest_episode(args.env))

    console.print(table_of(scores))
    first = evaluation.solved(evaluations, references["oracle"])
    if first is None:
        console.print(f"Not solved (95 % of the oracle) within {args.steps:,} steps.")
    else:
        console.print(
            f"Solved (95 % of the oracle) after {first.rollouts} rollouts, {first.steps:,} steps, "
            f"{first.seconds:.1f} s of training."
        )
    for name, what in (
        ("learning_curve.png", "the score against rollouts and steps"),
        ("rollout.gif", "an episode with the plans made in it"),
        ("scores.csv", "the table above"),
        ("mpc.zip", "the trained model: PPO.load(...)"),
    ):
        console.print(f"  {args.output / name}  {what}", soft_wrap=True)
    console.print(f"{time.perf_counter() - begun:.0f} s in all")


if __name__ == "__main__":
    main()
