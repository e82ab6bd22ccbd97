"""How far the benchmark is, and how long it will take."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.experiments import MPC_POLICY, Experiment

# Seconds, roughly: they only rank rows of which nothing is known yet. The first finished runs correct their scale.
_STEP = {MPC_POLICY: 0.02, "PPO": 0.001, "CrossQ": 0.2, "off-policy": 0.02}
_EPISODE = {MPC_POLICY: 0.1, "PPO": 0.03, "off-policy": 0.04}


class Costs:
    """Expected seconds of a training run: those of the row's finished runs, or else a guess.

    Guesses are corrected by what the finished runs of other rows took against the guess for them.
    """

    def __init__(self) -> None:
        self._of_row: dict[str, list[float]] = {}
        self._guessed = self._taken = 0.0

    def finished(self, experiment: Experiment, seconds: float) -> None:
        """Take account of a run that took so many seconds."""
        self._of_row.setdefault(_key(experiment), []).append(seconds)
        self._guessed += guess(experiment)
        self._taken += seconds

    def of(self, experiment: Experiment) -> float:
        """Expected seconds of a run."""
        known = self._of_row.get(_key(experiment))
        if known:
            return sum(known) / len(known)
        return guess(experiment) * (self._taken / self._guessed if self._guessed else 1.0)


def _key(experiment: Experiment) -> str:
    return f"{experiment.name} {experiment.settings_hash}"


def guess(experiment: Experiment) -> float:
    """Seconds of a run, from its numbers of steps and of scored episodes."""
    kind = experiment.policy if experiment.policy == MPC_POLICY else experiment.algorithm
    step, episode = _STEP.get(kind, _STEP["off-policy"]), _EPISODE.get(kind, _EPISODE["off-policy"])
    evaluations, begun = 1.0, 0
    for until, every in experiment.evaluate:
        end = experiment.steps if until is None else min(until, experiment.steps)
        evaluations += max(end - begun, 0) / every
        begun = end
    return step * experiment.steps + episode * experiment.episodes * evaluations


class ProgressBar:
    """A bar over tasks, with the time that those left will take.

    :param title: what is going on
    :param expected: names of the tasks -> a function that gives their expected seconds, as known by then
    :param under_way: names of the tasks that are being worked on, and since when (:func:`time.monotonic`)
    :param jobs: how many tasks are worked on at a time
    """

    def __init__(
        self,
        console: Console,
        title: str,
        expected: Mapping[str, Callable[[], float]],
        under_way: Mapping[str, float],
        jobs: int,
    ) -> None:
        self._left, self._under_way, self._jobs = dict(expected), under_way, jobs
        self._console, self._total = console, len(expected)
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
        )  # fmt: skip
        self._progress = Progress(*columns, console=console)
        self._bar = self._progress.add_task(title, total=len(expected), left="")

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def advance(self, name: str) -> None:
        """A task is done."""
        self._left.pop(name)
        left = f"about {duration(self.seconds_left())} left"
        self._progress.update(self._bar, advance=1, left=left)
        if not self._console.is_terminal:  # where a bar does not move, e.g. in a log
            done = self._total - len(self._left)
            self._console.print(f"{done}/{self._total} {name}; {left}", markup=False, highlight=False, soft_wrap=True)

    def seconds_left(self) -> float:
        """Expected seconds until all tasks are done."""
        now = time.monotonic()
        seconds = {name: expected() for name, expected in self._left.items()}
        for name, begun in dict(self._under_way).items():
            if name in seconds:
                seconds[name] = max(seconds[name] - (now - begun), 0.0)
        return max(sum(seconds.values()) / self._jobs, *seconds.values(), 0.0)


def duration(seconds: float) -> str:
    """Seconds in words, e.g. ``2 h 05 min``."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes // 60} h {minutes % 60:02} min" if minutes >= 60 else f"{minutes} min"
