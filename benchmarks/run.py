"""The benchmark: trains what the table of experiments says and is not trained yet.

    python -m benchmarks.run --list
    python -m benchmarks.run --only "mpc/*" --jobs 2
    python -m benchmarks.run --small --jobs 2

Results are stored the moment a run is finished (:mod:`benchmarks.store`). Stop it whenever you like: the same command
goes on with what is missing. Changed settings make their runs missing again.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks import execution, experiments, training
from benchmarks.execution import Executor, Failure, Outcome, Task
from benchmarks.experiments import Experiment
from benchmarks.progress import Costs, ProgressBar
from benchmarks.runs import parsed_changes
from benchmarks.store import RESULTS, FinishedRun, Reference, ResultFileError, Store
from benchmarks.training import Probed, SavedModel, Trained

SCRATCH = Path("build/benchmark")
PROBE_SECONDS = 20.0
"""A guess of what a probe takes, to tell how long all of it will."""
FAILED, BAD_ARGUMENTS, INTERRUPTED = 1, 2, 130
"""Exit statuses."""


class Missing(NamedTuple):
    """A run, or what was asked of it, that there are no results of."""

    experiment: Experiment
    seed: int
    probes: tuple[str, ...]
    model: SavedModel | None
    """The trained model, when only probes are missing; None: it has to be trained."""

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self.experiment.name}, seed {self.seed}"


class Benchmark:
    """Finds out what is missing, has it run, and stores it.

    :param store: of the results
    :param scratch: folder of the trained models and of the tracebacks of failures
    :param executor: runs it
    :param small: probes make do with few episodes
    """

    def __init__(self, store: Store, scratch: Path, executor: Executor, console: Console, small: bool = False) -> None:
        self.store, self.scratch, self.executor, self.console, self.small = store, scratch, executor, console, small
        self.failures: dict[str, Failure] = {}
        """What could not be done, and why."""

    def missing(self, experiment: Experiment) -> list[Missing]:
        """What is not there, or was made with other settings.

        :raises ResultFileError: the results can not be read
        """
        self.store.evaluations(experiment.name)  # to be added to: better found out now
        runs = self.store.runs(experiment.name)
        probed = {
            name: {line["seed"] for line in self.store.probe(experiment.name, name)} for name in experiment.probes
        }
        result = []
        for seed in experiment.seeds:
            if seed not in runs or runs[seed].settings != experiment.settings_hash:
                result.append(Missing(experiment, seed, experiment.probes, None))
            elif probes := tuple(name for name in experiment.probes if seed not in probed[name]):
                model = SavedModel.read(self._model_folder(experiment, seed), experiment)
                result.append(Missing(experiment, seed, probes if model else experiment.probes, model))
        return result

    def missing_of(self, experiments: Iterable[Experiment]) -> dict[str, list[Missing]]:
        """What is missing of each row whose results can be read, by its name; the other rows are failures."""
        result = {}
        for experiment in experiments:
            try:
                result[experiment.name] = self.missing(experiment)
            except ResultFileError as error:
                self.failures[experiment.name] = Failure(str(error), str(error))
        return result

    def run(self, missing: Sequence[Missing]) -> None:
        """Run it, the longest first, and store what comes of it as it comes."""
        references = self._references([m for m in missing if m.model is None])
        missing = [m for m in missing if m.model is not None or _reference_key(m) in references]
        costs = self._costs(missing)
        by_name = {m.name: m for m in sorted(missing, key=lambda m: _seconds(m, costs), reverse=True)}
        expected = {name: functools.partial(_seconds, m, costs) for name, m in by_name.items()}
        tasks = [_task(m, self.small) for m in by_name.values()]
        for outcome in self._with_progress("training", tasks, expected):
            done = by_name[outcome.task.name]
            if isinstance(outcome.result, Trained):
                costs.finished(done.experiment, outcome.result.wall_seconds)
                self._store(done, outcome.result, references[_reference_key(done)])
            elif isinstance(outcome.result, Probed):
                self._store_probes(done, outcome.result)

    def _references(self, missing: Sequence[Missing]) -> dict[tuple[str, int], Reference]:
        """What runs are measured against. Runs for which there is none are failures."""
        wanted = dict.fromkeys(_reference_key(m) for m in missing)
        known = self.store.references() if wanted else {}
        for key in list(known):
            if known[key].settings != training.reference_settings(key[0]):
                del known[key]
        names = {f"oracle and LQR in {env}, {episodes} episodes": (env, episodes) for env, episodes in wanted}
        tasks = [Task(name, training.reference, key) for name, key in names.items() if key not in known]
        for outcome in self._with_progress("oracle and LQR", tasks, {task.name: lambda: 10.0 for task in tasks}):
            if outcome.failure is None:
                known[names[outcome.task.name]] = outcome.result
                self.store.add_reference(outcome.result)
            else:
                del self.failures[outcome.task.name]  # to be told once for each run that needs it
                for m in missing:
                    if _reference_key(m) == names[outcome.task.name]:
                        self._failed(m.name, outcome.failure)
        return known

    def _with_progress(
        self, title: str, tasks: Sequence[Task], expected: Mapping[str, Callable[[], float]]
    ) -> Iterator[Outcome]:
        """What comes of the tasks, behind a bar; failures are noted."""
        if not tasks:
            return
        executor = self.executor
        with (
            ProgressBar(self.console, title, expected, executor.under_way, executor.backend.jobs) as bar,
            contextlib.closing(executor.outcomes(tasks)) as outcomes,
        ):
            for outcome in outcomes:
                if outcome.failure is not None:
                    self._failed(outcome.task.name, outcome.failure)
                yield outcome
                bar.advance(outcome.task.name)

    def _costs(self, missing: Iterable[Missing]) -> Costs:
        costs = Costs()
        for experiment in {m.experiment.name: m.experiment for m in missing}.values():
            for run in self.store.runs(experiment.name).values():
                if run.settings == experiment.settings_hash:
                    costs.finished(experiment, run.wall_seconds)
        return costs

    def _store(self, done: Missing, trained: Trained, reference: Reference) -> None:
        row = done.experiment.name
        trained.model.write(self._model_folder(done.experiment, done.seed))
        run = FinishedRun(
            seed=done.seed,
            env=done.experiment.env,
            settings=done.experiment.settings_hash,
            oracle=reference.oracle,
            lqr=reference.lqr,
            wall_seconds=round(trained.wall_seconds, 2),
            commit=commit(),
            machine=trained.machine,
            versions=trained.versions,
            date=trained.date,
        )
        try:
            self.store.add_run(row, run, trained.evaluations)
        except ResultFileError as error:  # somebody else has written there meanwhile
            self._failed(done.name, Failure(str(error), str(error)))
        else:
            self._store_probes(done, trained.probed)

    def _store_probes(self, done: Missing, probed: Probed) -> None:
        failed = {name: Failure(text.splitlines()[-1], text) for name, text in probed.failed.items()}
        for name, found in probed.found.items():
            try:
                self.store.add_probe(done.experiment.name, done.seed, name, found)
            except ValueError as error:
                failed[name] = Failure(str(error), str(error))
        for name, failure in failed.items():
            self._failed(f"{done.name}, probe {name}", failure)

    def _failed(self, name: str, failure: Failure) -> None:
        self.failures[name] = failure
        self.console.print(f"[red]failed[/red] {escape(name)}: {escape(failure.reason)}", soft_wrap=True)
        path = self.scratch / "failures" / f"{name.replace('/', '__').replace(', ', '-').replace(' ', '-')}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(failure.details + "\n", encoding="utf-8")

    def _model_folder(self, experiment: Experiment, seed: int) -> Path:
        return self.scratch / "models" / experiment.name / str(seed)


def _reference_key(missing: Missing) -> tuple[str, int]:
    return missing.experiment.env, missing.experiment.episodes


def _seconds(missing: Missing, costs: Costs) -> float:
    training_seconds = costs.of(missing.experiment) if missing.model is None else 0.0
    return training_seconds + PROBE_SECONDS * len(missing.probes)


def _task(missing: Missing, small: bool) -> Task:
    if missing.model is None:
        return Task(missing.name, training.train, (missing.experiment, missing.seed, small))
    return Task(missing.name, training.probe, (missing.experiment, missing.model, missing.probes, small))


def commit() -> str:
    """Of the code that runs; "+" at its end where files differ from it; empty where git does not know."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        # what this program writes is no change of it
        changed = git("status", "--porcelain", "--", ":/", ":(exclude,top)benchmarks/results")
        return git("rev-parse", "--short=10", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


# -- command line --


def arguments(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path, default=experiments.TABLE, metavar="FILE")
    parser.add_argument("--only", nargs="+", metavar="PATTERN", help='rows, e.g. "mpc/*"; without it, all')
    parser.add_argument("--seeds", nargs="+", type=int, metavar="N", help="in place of those of the table")
    parser.add_argument("--jobs", type=int, help="runs at a time, one thread each; 1, or all cores of a Ray cluster")
    parser.add_argument("--executor", choices=["loky", "ray"], default="loky", help="processes here, or a Ray cluster")
    parser.add_argument("--address", help="of the Ray cluster; without it, one is started on this machine")
    parser.add_argument("--results", type=Path, help=f"folder of the result files, {RESULTS} without it")
    parser.add_argument("--scratch", type=Path, default=SCRATCH, help="folder of trained models and of failures")
    parser.add_argument("--small", action="store_true", help="one short run of each row, into the scratch folder")
    parser.add_argument("--list", action="store_true", help="show the rows and what is missing of them, run nothing")
    parser.add_argument(
        "--set", nargs="+", default=[], metavar="NAME=VALUE",
        help="change every row, e.g. steps=500 settings.n_epochs=5; with --results, to keep those of the table",
    )  # fmt: skip
    args = parser.parse_args(argv)
    if args.set and args.results is None and not args.small:
        parser.error("--set changes what the results mean: name another folder for them with --results")
    if args.jobs is not None and args.jobs < 1:
        parser.error(f"--jobs must be at least 1, got {args.jobs}")
    if args.address is not None and args.executor != "ray":
        parser.error("--address is for --executor ray")
    if args.small:
        args.scratch /= "small"
        args.results = args.results or args.scratch
    args.results = args.results or RESULTS
    return args


def chosen(args: argparse.Namespace) -> list[Experiment]:
    """The experiments that the command line asks for.

    :raises OSError: there is no table
    :raises ValueError: something is wrong with it, with a change to it, or a pattern matches nothing
    """
    table = experiments.read_table(args.table, parsed_changes(args.set))
    table = experiments.selected(table, args.only)
    if args.seeds is not None:
        table = [dataclasses.replace(each, seeds=experiments.seeds(args.seeds)) for each in table]
    return [each.small() for each in table] if args.small else table


def listing(table: Sequence[Experiment], missing: Mapping[str, Sequence[Missing]]) -> Table:
    """The rows, and how much of them is there."""
    shown = Table(box=SIMPLE_HEAD)
    shown.add_column("row", no_wrap=True)
    for name in ("steps", "done", "missing", "probes missing"):
        shown.add_column(name, justify="right")
    for row in table:
        left = missing.get(row.name)
        if left is None:
            shown.add_row(row.name, f"{row.steps:,}", "?", "?", "?", style="red")
            continue
        untrained = sum(m.model is None for m in left)
        numbers = (len(row.seeds) - untrained, untrained, len(left) - untrained)
        shown.add_row(row.name, f"{row.steps:,}", *(str(n) if n else "-" for n in numbers))
    return shown


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark from the command line.

    :return: the exit status
    """
    args = arguments(argv)
    console = Console()
    try:
        table = chosen(args)
        backend = (
            execution.loky(args.jobs or 1)
            if args.list or args.executor == "loky"
            else execution.ray(args.address, args.jobs)
        )
    except (OSError, ValueError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_ARGUMENTS
    executor = Executor(backend, lambda text: console.print(text, markup=False, soft_wrap=True))
    benchmark = Benchmark(Store(args.results), args.scratch, executor, console, args.small)
    missing = benchmark.missing_of(table)
    todo = [m for of_row in missing.values() for m in of_row]
    if args.list:
        console.print(listing(table, missing))
    else:
        try:
            benchmark.run(todo)
        except KeyboardInterrupt:
            console.print(f"Stopped. What is finished is in {args.results}; the same command goes on with the rest.")
            return INTERRUPTED
    return _reported(benchmark, args, console)


def _reported(benchmark: Benchmark, args: argparse.Namespace, console: Console) -> int:
    for name, failure in benchmark.failures.items():
        print(f"failed: {name}: {failure.reason}", file=sys.stderr)
    if benchmark.failures:
        print(f"{len(benchmark.failures)} failed; tracebacks are in {args.scratch / 'failures'}", file=sys.stderr)
        return FAILED
    if not args.list:
        console.print(f"All results are in {args.results}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
