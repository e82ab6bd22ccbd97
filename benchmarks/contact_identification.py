"""How well contact models are learned from transitions of random systems, by us and by others.

    python -m benchmarks.contact_identification --jobs 2

The set-up is that of the public evaluations of "Learning Linear Complementarity Systems" (Jin et al., L4DC 2022;
DAIRLab/Learning-LCS): entries of A, B, C, d, D, E, c, G and H uniform in ±1, ``F = G Gᵀ + stiffness I + H − Hᵀ``,
states uniform in ±10, actions in ±5, noise of standard deviation 0.01 on the next state. A is divided by as much as it
takes for a spectral radius of 0.95. Each trial is a new system. The *smaller* the stiffness, the more rigid the
contact: forces go with F's inverse.

Errors are root mean squares over components and 1,000 fresh test data:

* ``error``: predicted next state against that without noise, in units of the noise;
* ``ratio``: predicted against *noisy* next state, relative to the same for the true model. It is 1 at best;
* ``error_10``, ``ratio_10``: the same for the states of 10 steps under random actions, predicted from the first state
  and the actions alone; the noisy system has its noise in every step. Medians over trajectories, since some systems
  are unstable where contacts act.

The rivals get their published number of iterations at n_lambda = 4 and 5,000 samples; where they get fewer, or fewer
trials are made, the table says so (``--iterations``, ``--rival-iterations``, ``--trials``, ``--rival-trials``).
"""

from __future__ import annotations

import argparse
import csv
import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from joblib import Parallel, delayed, parallel_config
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from benchmarks.identification_rivals import RIVALS, Predictor
from sb3_mpc_policy.identification import identify
from sb3_mpc_policy.lcp import LcpSolver
from sb3_mpc_policy.lcs import LcsMatrices

N_STATES, N_ACTIONS, NOISE = 4, 2, 1e-2
STATE_RANGE, ACTION_RANGE = 10.0, 5.0
SPECTRAL_RADIUS = 0.95
TEST_SIZE, HORIZON = 1000, 10
OURS = "identify"
WELL = 1.5  # ratio up to which a trial counts as learned


class Setting(NamedTuple):
    """What distinguishes one set of trials from another."""

    n_lambda: int = 4
    samples: int = 5000
    stiffness: float = 0.5


BASE = Setting()
SETTINGS = [
    BASE,
    *(BASE._replace(n_lambda=n_lambda) for n_lambda in (1, 2, 8, 16)),
    *(BASE._replace(samples=samples) for samples in (500, 1000, 2000)),
    *(BASE._replace(stiffness=stiffness) for stiffness in (5.0, 0.05, 0.005)),
]
_SLOW_CONTACTS = 16  # from here on, the rivals get a quarter of the iterations


class Row(NamedTuple):
    """One trial of one method. Errors: see the module; seconds are processor time."""

    n_lambda: int
    samples: int
    stiffness: float
    method: str
    trial: int
    iterations: int
    error: float
    ratio: float
    error_10: float
    ratio_10: float
    seconds: float


# -- systems and data --


def random_system(setting: Setting, rng: np.random.Generator) -> LcsMatrices[np.ndarray]:
    """A random LCS, see the module."""
    n = setting.n_lambda
    shapes = [(N_STATES, N_STATES), (N_STATES, N_ACTIONS), (N_STATES, n), (N_STATES,), (n, N_STATES), (n, N_ACTIONS)]
    A, B, C, d, D, E = (rng.uniform(-1.0, 1.0, shape) for shape in shapes)
    G, H = np.tril(rng.uniform(-1.0, 1.0, (n, n))), rng.uniform(-1.0, 1.0, (n, n))
    F = G @ G.T + setting.stiffness * np.eye(n) + H - H.T
    A = A / max(1.0, np.abs(np.linalg.eigvals(A)).max() / SPECTRAL_RADIUS)
    return LcsMatrices(A, B, C, d, D, E, F, rng.uniform(-1.0, 1.0, n))


def predictor(system: LcsMatrices[np.ndarray]) -> Predictor:
    """Eq (5) as a function (s, a) -> s_next."""
    A, B, C, d, D, E, F, c = system
    solver = LcpSolver(F)
    return lambda s, a: s @ A.T + a @ B.T + solver(s @ D.T + a @ E.T + c)[0] @ C.T + d


def random_inputs(rng: np.random.Generator, *size: int) -> tuple[np.ndarray, np.ndarray]:
    """States (size[0], n_x) and actions (*size, n_a)."""
    s = rng.uniform(-STATE_RANGE, STATE_RANGE, (size[0], N_STATES))
    return s, rng.uniform(-ACTION_RANGE, ACTION_RANGE, (*size, N_ACTIONS))


def trajectories(step: Predictor, s: np.ndarray, actions: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """States (N, H, n_x) after each action; noise of that shape is added to each. What diverges stays large."""
    states = []
    for k in range(actions.shape[1]):
        s = np.clip(step(s, actions[:, k]) + noise[:, k], -1e12, 1e12)
        states.append(s)
    return np.stack(states, axis=1)


# -- trials --


def errors(learned: Predictor, true: Predictor, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """error, ratio, error_10, ratio_10: see the module."""
    s, a = random_inputs(rng, TEST_SIZE)
    predicted, exact = learned(s, a), true(s, a)
    noisy = exact + NOISE * rng.normal(size=exact.shape)
    s, actions = random_inputs(rng, TEST_SIZE, HORIZON)
    noise = NOISE * rng.normal(size=(TEST_SIZE, HORIZON, N_STATES))
    exact_10, noisy_10 = trajectories(true, s, actions, 0.0 * noise), trajectories(true, s, actions, noise)
    predicted_10 = trajectories(learned, s, actions, 0.0 * noise)

    def rms(difference: np.ndarray) -> float:
        return float(np.sqrt(np.square(difference).mean()))

    def median(difference: np.ndarray) -> float:
        return float(np.median(np.sqrt(np.square(difference).mean(axis=(1, 2)))))

    return (
        rms(predicted - exact) / NOISE,
        rms(predicted - noisy) / rms(exact - noisy),
        median(predicted_10 - exact_10) / NOISE,
        median(predicted_10 - noisy_10) / median(exact_10 - noisy_10),
    )


def run_trial(setting: Setting, method: str, trial: int, iterations: int) -> Row:
    """Learn one system. The system and the data depend on the setting and the trial only."""
    torch.set_num_threads(1)
    rng = np.random.default_rng([trial, setting.n_lambda, round(1e6 * setting.stiffness)])
    system = random_system(setting, rng)
    true = predictor(system)
    s, a = random_inputs(rng, setting.samples)
    s_next = true(s, a) + NOISE * rng.normal(size=s.shape)
    test = np.random.default_rng([trial, 1])
    start = time.process_time()
    learned: Predictor
    if method == OURS:
        found = identify(s, a, s_next, setting.n_lambda, rng=trial)
        learned, iterations = found.predict, found.n_starts
    else:
        learned = RIVALS[method](s, a, s_next, setting.n_lambda, iterations, trial)
    seconds = time.process_time() - start
    return Row(*setting, method, trial, iterations, *errors(learned, true, test), seconds)


def plan(args: argparse.Namespace) -> list[tuple[Setting, str, int, int]]:
    """(setting, method, trial, iterations), ours first."""
    ours = [(setting, OURS, trial, 0) for setting in args.settings for trial in range(args.trials)]
    theirs = []
    for setting, rival in itertools.product(args.settings, RIVALS):
        iterations = args.iterations if setting == BASE else args.rival_iterations
        if setting.n_lambda >= _SLOW_CONTACTS:
            iterations = max(1, iterations // 4)
        theirs += [(setting, rival, trial, iterations) for trial in range(args.rival_trials)]
    return ours + theirs


# -- the table --


def summary(rows: Sequence[Row]) -> Table:
    """Medians over trials, and in how many of them the system was learned."""
    table = Table(title=f"medians over trials; learned: ratio up to {WELL}", box=SIMPLE_HEAD)
    for name in ("n_lambda", "samples", "stiffness", "method"):
        table.add_column(name, no_wrap=True)
    for name in ("iterations", "error", "ratio", "learned", "ratio_10", "seconds"):
        table.add_column(name, justify="right", no_wrap=True)
    settings = list(dict.fromkeys([*SETTINGS, *(_of(row) for row in rows)]))
    for setting, method in itertools.product(settings, [OURS, *RIVALS]):
        trials = [row for row in rows if (_of(row), row.method) == (setting, method)]
        if not trials:
            continue

        def median(name: str, trials: Sequence[Row] = trials) -> str:
            return f"{np.median([getattr(row, name) for row in trials]):,.3g}"

        learned = f"{sum(row.ratio <= WELL for row in trials)}/{len(trials)}"
        table.add_row(
            str(setting.n_lambda), str(setting.samples), str(setting.stiffness), method, median("iterations"),
            median("error"), median("ratio"), learned, median("ratio_10"), median("seconds"),
        )  # fmt: skip
    return table


def _of(row: Row) -> Setting:
    return Setting(row.n_lambda, row.samples, row.stiffness)


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write all trials, numbers to four digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        for row in sorted(rows, key=lambda row: row[:5]):
            writer.writerow([f"{entry:.4g}" if isinstance(entry, float) else entry for entry in row])


def arguments(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=15)
    parser.add_argument("--rival-trials", type=int, default=5, help="the first of these")
    parser.add_argument("--iterations", type=int, default=10_000, help="of rivals at the first setting")
    parser.add_argument("--rival-iterations", type=int, default=2_000, help="of rivals elsewhere")
    parser.add_argument(
        "--settings", nargs="+", type=_setting, default=SETTINGS, metavar="N_LAMBDA,SAMPLES,STIFFNESS",
        help="sets of trials, e.g. 4,5000,0.5",
    )  # fmt: skip
    parser.add_argument("--jobs", type=int, default=1, help="trials at a time, one thread each")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/contact_identification_synthetic.csv"))
    return parser.parse_args(argv)


def _setting(text: str) -> Setting:
    n_lambda, samples, stiffness = text.split(",")
    return Setting(int(n_lambda), int(samples), float(stiffness))


def main(argv: Sequence[str] | None = None) -> list[Row]:
    """Run the benchmark from the command line."""
    args = arguments(argv)
    console = Console()
    todo = plan(args)
    rows: list[Row] = []
    columns = (TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress, parallel_config("loky", inner_max_num_threads=1):
        bar = progress.add_task("trials", total=len(todo))
        tasks = (delayed(run_trial)(*job) for job in todo)
        for row in Parallel(n_jobs=args.jobs, return_as="generator_unordered")(tasks):
            rows.append(row)
            write_rows(args.output, rows)  # each time, so that what is done is kept
            progress.advance(bar)
    console.print(summary(rows))
    console.print(f"{len(rows)} trials in {args.output}")
    return rows


if __name__ == "__main__":
    main()
