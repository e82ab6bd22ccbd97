"""Reads all that the results page is made of. A damaged file is noted, and as if it were not there."""

from __future__ import annotations

import contextlib
import csv
import fnmatch
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import runs
from benchmarks.evaluation import Evaluation
from benchmarks.experiments import Experiment
from benchmarks.probes import ProbeLine
from benchmarks.store import ResultFileError, Store
from benchmarks.summary import Row

__all__ = ["Results", "read_lines", "read_older", "read_row"]


class Results:
    """The result files of a folder, and of the one above it, where other commands than the runner write.

    :param folder: of the runs
    :param table: of experiments: which rows there should be
    """

    def __init__(self, folder: Path, table: Sequence[Experiment]) -> None:
        self.store = Store(folder)
        self.table = table
        self.problems: list[str] = []
        """What is wrong with which file."""

    def names(self, patterns: Sequence[str]) -> list[str]:
        """The rows of the table that match a pattern: those of the first pattern first, else in the table's order."""
        every = [experiment.name for experiment in self.table]
        return list(dict.fromkeys(name for pattern in patterns for name in fnmatch.filter(every, pattern)))

    def rows(self, names: Sequence[str]) -> list[Row]:
        """Those of the rows that were run."""
        return [row for row in map(self.row, names) if row is not None]

    @functools.cache  # noqa: B019 - there is one of these in a program
    def row(self, name: str) -> Row | None:
        """The finished runs of a row; None without any."""
        with self._noted():
            return read_row(self.store, name)
        return None

    @functools.cache  # noqa: B019
    def older(self, stem: str) -> Row | None:
        """Runs from before the table, by the name of their file; None without any."""
        with self._noted():
            return read_older(self.store.folder.parent / f"{stem}.csv", stem)
        return None

    def probed(self, probe: str) -> list[str]:
        """The rows that a probe is asked of."""
        return [experiment.name for experiment in self.table if probe in experiment.probes]

    @functools.cache  # noqa: B019
    def probe(self, name: str, probe: str) -> Sequence[ProbeLine]:
        """What a probe found in the finished runs of a row."""
        with self._noted():
            return self.store.probe(name, probe) if self.row(name) else []
        return []

    @functools.cache  # noqa: B019
    def lines(self, stem: str, **columns: Callable[[str], Any]) -> Sequence[dict[str, Any]]:
        """The lines of the file of another command; none if it is not there."""
        with self._noted():
            return read_lines(self.store.folder.parent / f"{stem}.csv", columns)
        return []

    @contextlib.contextmanager
    def _noted(self) -> Iterator[None]:
        try:
            yield
        except ResultFileError as error:
            if str(error) not in self.problems:
                self.problems.append(str(error))


def read_row(store: Store, name: str) -> Row | None:
    """The finished runs of a row; None without any.

    :raises ResultFileError: a file is damaged, says nothing of a finished run, or has runs of different settings
    """
    finished, evaluations = store.runs(name), store.evaluations(name)
    if not finished:
        return None
    where = store.folder / f"{name.replace('/', '__')}.csv"
    for seed, run in evaluations.items():
        if not run:
            raise ResultFileError(f"{where}: seed {seed} is said to be finished, and has no evaluation")
        if not all(math.isfinite(e.score) for e in run):
            raise ResultFileError(f"{where}: seed {seed} has a score that is not a number")
    every = list(finished.values())
    if len({(run.env, run.settings) for run in every}) > 1:
        raise ResultFileError(f"{where}: its runs have different settings; run the row again")
    oracle, lqr = (float(np.median([getattr(run, of) for run in every])) for of in ("oracle", "lqr"))
    if not oracle > 0.0:
        raise ResultFileError(f"{where}: the oracle's score must be positive, got {oracle}")
    return Row(name, every[0].env, oracle, lqr, evaluations, every)


def read_older(path: Path, name: str) -> Row | None:
    """Runs in the format of :class:`benchmarks.runs.Row`, made before the table of experiments; None without any.

    :param name: what to call them
    :raises ResultFileError: the file is damaged
    """
    if not path.exists():
        return None
    with _naming(path):
        lines = runs.read_rows(path)
        seeds = sorted({line.seed for line in lines})
        evaluations = {seed: sorted(Evaluation(*line[3:7]) for line in lines if line.seed == seed) for seed in seeds}
        return Row(name, lines[0].env, lines[0].oracle, math.nan, evaluations) if lines else None


def read_lines(path: Path, columns: Mapping[str, Callable[[str], Any]]) -> list[dict[str, Any]]:
    """The lines of any other CSV file; none if it is not there.

    :param columns: name -> parser of its entries
    :raises ResultFileError: the file is damaged
    """
    if not path.exists():
        return []
    with _naming(path), path.open(newline="", encoding="utf-8") as file:
        return [{name: parse(line[name]) for name, parse in columns.items()} for line in csv.DictReader(file)]


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Name the file in what goes wrong while it is read."""
    try:
        yield
    except KeyError as error:
        raise ResultFileError(f"{path}: there is no column {error}") from error
    except (csv.Error, TypeError, ValueError) as error:  # a line that is too short gives None, and so a TypeError
        raise ResultFileError(f"{path}: {error}") from error
