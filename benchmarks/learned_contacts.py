"""Does training find the walls, and does it pay?

    python -m benchmarks.learned_contacts --jobs 2
    python -m benchmarks.learned_contacts --jobs 2 --variant linear --eval-every 3840 --output LINEAR.csv

Trains, with contacts in the model or without, and evaluates as :mod:`benchmarks.run` does. At each evaluation the
walls are read out of the model as well:

* ``position``: where the gap closes along the first state (the cart with the pole upright, the acrobot's shoulder),
  all other states and the action zero: the zero of ``D s + c``;
* ``stiffness``: what the contact does to the next state for each unit it is closed by along that line, relative to
  the true model, in the direction of the true model's: 1 is right;
* ``error``: root mean square error of the predicted next states on transitions in contact that training has not
  seen (those of LQR with noise), each component in units of its standard deviation there; ``true_error`` is the same
  of the true LCS. Transitions with a pole leaning by more than 0.3 rad are left out: there the true LCS, a
  linearisation about upright, is worse than no contacts at all, and nothing to be compared with.

A wall that is not in the model has neither position nor stiffness.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import functools
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from joblib import Parallel, delayed, parallel_config
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from benchmarks import runs
from benchmarks.console import summary as summary_of_runs
from benchmarks.evaluation import Evaluation, EvaluationCallback, Evaluator
from benchmarks.references import contact_env, lqr, oracle
from contact_envs.cart_pole_soft_walls import CartPoleSoftWallsEnv
from sb3_mpc_policy import LinearComplementaritySystem
from sb3_mpc_policy.lcs import LcsMatrices

ENVS = ["CartPoleSoftWallsHardPyBullet-v0"]
VARIANTS: dict[str, dict[str, Any]] = {"tuned": {}, "linear": {"policy_kwargs": {"n_contacts": 0}}}
"""What each changes in the environment's tuned settings."""
SEEDS = list(range(1000, 1010))
TEST_SEEDS = range(2_000_000, 2_000_100)
_TEST_NOISE = 0.3  # standard deviation of LQR's actions
_TEST_STEPS = 100  # of each episode
_UPRIGHT = 0.3  # rad, of the cart-pole's pole


class Wall(NamedTuple):
    """A contact along the first state: where it closes, and its effect on the next state for each unit closed."""

    position: float
    effect: np.ndarray


class Reading(NamedTuple):
    """One wall at one evaluation."""

    env: str
    seed: int
    steps: int
    rollouts: int
    true_position: float
    position: float
    stiffness: float
    error: float
    true_error: float


def walls(model: LcsMatrices[np.ndarray]) -> list[Wall]:
    """The contacts of a model that close along the first state."""
    _, _, C, _, D, _, F, c = model
    return [
        Wall(float(-c[k] / D[k, 0]), C[:, k] * D[k, 0] / F[k, k])
        for k in range(len(c))
        if D[k, 0] != 0.0 and C[:, k].any()
    ]


def reading(true: Wall, learned: Sequence[Wall], scale: np.ndarray) -> tuple[float, float]:
    """Position and relative stiffness of the learned wall that is most like a true one; not a number where none is.

    :param scale: (n_x,) of the states
    """

    def stiffness(wall: Wall) -> float:
        effect, other = true.effect / scale, wall.effect / scale
        return float(effect @ other / (effect @ effect))

    # on the true wall's side, those that are open at the origin
    side = [wall for wall in learned if wall.position * true.position > 0.0]
    best = max(side, key=stiffness, default=None)
    return (math.nan, math.nan) if best is None else (best.position, stiffness(best))


class ContactTransitions:
    """Transitions in contact, of LQR with noise in episodes of their own."""

    def __init__(self, env_id: str) -> None:
        with contact_env(env_id) as plant:
            self.true = plant.true_lcs()
            has_pole = isinstance(plant, CartPoleSoftWallsEnv)
        regulator = lqr(env_id)
        rng = np.random.default_rng(0)
        rows = []
        with contextlib.closing(gym.make(env_id)) as env:
            for seed in TEST_SEEDS:
                s, _ = env.reset(seed=seed)
                for _ in range(_TEST_STEPS):
                    a = np.clip(regulator(s[None])[0] + _TEST_NOISE * rng.normal(size=1), -1.0, 1.0)
                    s_next, _, terminated, truncated, info = env.step(a.astype(np.float32))
                    touches = np.any(info[env.unwrapped.CONTACT_FORCES])  # type: ignore[attr-defined]
                    if touches and not (has_pole and abs(s[2]) > _UPRIGHT):
                        rows.append(np.concatenate([s, a, s_next]))
                    s = s_next
                    if terminated or truncated:
                        break
        n_x = self.true.A.shape[0]
        self.s, self.a, self.s_next = np.split(np.array(rows), [n_x, n_x + 1], axis=1)
        self.deviation = (self.s_next - self.s).std(axis=0)

    def error(self, model: LinearComplementaritySystem) -> float:
        """Root mean square error of a model's predictions."""
        predicted = model.step(self.s, self.a).detach().cpu().numpy()
        return float(np.sqrt(np.square((predicted - self.s_next) / self.deviation).mean()))


def train(
    env_id: str, variant: str, seed: int, steps: int, every: int, n_episodes: int, oracle_score: float
) -> tuple[list[runs.Row], list[Reading]]:
    """One training run with its evaluations and readings."""
    test = ContactTransitions(env_id)
    true_error = test.error(LinearComplementaritySystem.from_matrices(*test.true))
    readings: list[Reading] = []
    with contextlib.closing(Evaluator(env_id, n_episodes)) as evaluator:

        def read(evaluation: Evaluation) -> None:
            model: LinearComplementaritySystem = callback.model.policy.lcs  # type: ignore[assignment]
            if not model.n_contacts:
                return
            learned = walls(LcsMatrices(*(part.detach().cpu().numpy() for part in model.matrices())))
            scale, error = model.state_scale.cpu().numpy(), test.error(model)
            for wall in walls(LcsMatrices(*test.true)):
                found = reading(wall, learned, scale)
                at = env_id, seed, evaluation.steps, evaluation.rollouts
                readings.append(Reading(*at, wall.position, *found, error, true_error))

        callback = EvaluationCallback(evaluator, every, read)
        settings = runs.settings_for(env_id, VARIANTS[variant])
        runs.train(env_id, settings, seed, steps, [callback])
    return runs.rows_of(callback, env_id, variant, seed, oracle_score), readings


def write_readings(path: Path, readings: Sequence[Reading]) -> None:
    """Write all readings, numbers to four digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Reading._fields)
        for line in sorted(readings):
            writer.writerow([f"{entry:.4g}" if isinstance(entry, float) else entry for entry in line])


def summary(readings: Sequence[Reading], most_rollouts: int) -> Table:
    """What the models say at the last evaluation of each run that has had at most so many rollouts."""
    table = Table(title=f"{readings[0].env}: walls after at most {most_rollouts} rollouts", box=SIMPLE_HEAD)
    for name in ("seed", "rollouts", "steps", "walls", "stiffness", "error", "of the true LCS"):
        table.add_column(name, justify="right", no_wrap=True)
    ordered = sorted(readings, key=lambda line: (line.seed, line.steps))
    for seed, of_seed in itertools.groupby(ordered, key=lambda line: line.seed):
        lines = [line for line in of_seed if line.rollouts <= most_rollouts]
        last = [line for line in lines if line.steps == lines[-1].steps]
        table.add_row(
            str(seed), str(last[0].rollouts), f"{last[0].steps:,}",
            "  ".join(f"{line.position:+.3f}" for line in last),
            "  ".join(f"{line.stiffness:.2f}" for line in last),
            f"{last[0].error:.3f}", f"{last[0].true_error:.3f}",
        )  # fmt: skip
    return table


def arguments(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=ENVS, metavar="ID")
    parser.add_argument("--variant", nargs="+", default=["tuned"], choices=sorted(VARIANTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, metavar="N")
    parser.add_argument("--steps", type=int, default=3_840, help="environment steps of each run")
    parser.add_argument("--eval-every", type=int, default=640, help="environment steps between evaluations")
    parser.add_argument("--episodes", type=int, default=50, help="scored episodes of an evaluation")
    parser.add_argument("--rollouts", type=int, default=20, help="after which the walls are shown")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time, one thread each")
    parser.add_argument(
        "--output", type=Path, default=Path("benchmarks/results/learned_contacts.csv"),
        help="of the evaluations; the readings go beside it, with _walls in the name",
    )  # fmt: skip
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> tuple[list[runs.Row], list[Reading]]:
    """Run the benchmark from the command line."""
    args = arguments(argv)
    console = Console()

    @functools.cache
    def oracle_score(env_id: str) -> float:
        with contextlib.closing(Evaluator(env_id, args.episodes)) as evaluator:
            console.print(f"{env_id}: LQR {evaluator.score(lqr(env_id)):,.0f}")
            return evaluator.score(oracle(env_id))

    tasks = (
        delayed(train)(env_id, variant, seed, args.steps, args.eval_every, args.episodes, oracle_score(env_id))
        for env_id, variant, seed in itertools.product(args.env, args.variant, args.seeds)
    )
    total = len(args.env) * len(args.variant) * len(args.seeds)
    columns = (TextColumn("training"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    rows: list[runs.Row] = []
    readings: list[Reading] = []
    with Progress(*columns, console=console) as progress, parallel_config("loky", inner_max_num_threads=1):
        bar = progress.add_task("training", total=total)
        for finished, found in Parallel(n_jobs=args.jobs, return_as="generator_unordered")(tasks):
            rows += finished
            readings += found
            runs.write_rows(args.output, rows)  # each time, so that what is done is kept
            write_readings(args.output.with_stem(args.output.stem + "_walls"), readings)
            progress.advance(bar)
    for _, of_env in itertools.groupby(sorted(rows), key=lambda row: row.env):
        console.print(summary_of_runs(list(of_env)))
    for _, of_one in itertools.groupby(sorted(readings), key=lambda line: line.env):
        console.print(summary(list(of_one), args.rollouts))
    console.print(f"{len(rows)} evaluations in {args.output}")
    return rows, readings


if __name__ == "__main__":
    main()
