"""Result files: evaluations, finished runs and probes, by row of the table.

In the folder, for the row ``mpc/easy``:

- ``mpc__easy.csv``: a line for each evaluation;
- ``mpc__easy.runs.csv``: a line for each finished run. What the other files say of a seed counts only with this line;
- ``mpc__easy.<probe>.csv``: what a probe found;
- ``references.csv``, of all rows: the scores of the oracle and of LQR.

Files are replaced as a whole, so that a process that is killed leaves either the old one or the new one.
"""

from __future__ import annotations

import contextlib
import csv
import math
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_type_hints

from benchmarks.evaluation import Evaluation
from benchmarks.probes import PROBES, ProbeLine

RESULTS = Path("benchmarks/results/runs")
"""Where results are, from the root folder."""


class ResultFileError(ValueError):
    """A result file that can not be read. The message names it."""


class EvaluationLine(NamedTuple):
    """An evaluation, and the run it belongs to."""

    seed: int
    steps: int
    rollouts: int
    seconds: float
    score: float

    @property
    def evaluation(self) -> Evaluation:
        """Without the seed."""
        return Evaluation(*self[1:])


class FinishedRun(NamedTuple):
    """A run that is done: what with, what to measure it against, and where and when it was made."""

    seed: int
    env: str
    settings: str
    """Hash of the settings, see :attr:`benchmarks.experiments.Experiment.settings_hash`."""
    oracle: float
    """Score of the oracle on as many episodes; not a number where there is none."""
    lqr: float
    """The same of LQR."""
    wall_seconds: float
    """With evaluations, unlike :attr:`Evaluation.seconds`."""
    commit: str
    """Of the repository; "+" at its end: with changes; empty: unknown."""
    machine: str
    versions: str
    date: str
    """When it was finished, ISO 8601, UTC."""


class Reference(NamedTuple):
    """Scores of the controllers that know the true model; not a number where the environment does not tell it."""

    env: str
    episodes: int
    oracle: float
    lqr: float
    settings: str
    """Hash of the oracle's settings."""


_Line = TypeVar("_Line", EvaluationLine, FinishedRun, Reference)


class Store:
    """Reads and writes the result files of a folder. One process at a time may write.

    :param folder: is made when the first result is written
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    # -- reading --

    def runs(self, row: str) -> dict[int, FinishedRun]:
        """The finished runs of a row, by seed.

        :raises ResultFileError: the file is not what this class writes
        """
        return {run.seed: run for run in _read(self._path(row, ".runs"), FinishedRun)}

    def evaluations(self, row: str) -> dict[int, list[Evaluation]]:
        """The evaluations of the finished runs of a row, by seed, in the order of steps.

        :raises ResultFileError: a file is not what this class writes
        """
        lines = _read(self._path(row), EvaluationLine)
        return {seed: sorted(line.evaluation for line in lines if line.seed == seed) for seed in sorted(self.runs(row))}

    def probe(self, row: str, probe: str) -> list[ProbeLine]:
        """What a probe found in the finished runs of a row; numbers as numbers.

        :raises ResultFileError: a file is not what this class writes
        """
        path, finished = self._path(row, f".{probe}"), self.runs(row)
        lines = _read_table(path, ["seed", "quantity", "value"], exactly=False)
        parsed: list[ProbeLine] = [
            {
                name: _entry(path, i, name, text, int if name == "seed" else float if name == "value" else _plain)
                for name, text in line.items()
            }
            for i, line in lines
        ]
        return [line for line in parsed if line["seed"] in finished]

    def references(self) -> dict[tuple[str, int], Reference]:
        """Scores of the references by (env, episodes).

        :raises ResultFileError: the file is not what this class writes
        """
        return {(line.env, line.episodes): line for line in _read(self.folder / "references.csv", Reference)}

    # -- writing --

    def add_run(self, row: str, run: FinishedRun, evaluations: Sequence[Evaluation]) -> None:
        """Store a finished run in place of the one with the same seed, if any, and of what was probed in it.

        The line that says it is finished goes first when an old run goes, and comes last when the new one does.

        :raises ValueError: there is no evaluation, or a score is not a number
        """
        if not evaluations:
            raise ValueError(f"{row}, seed {run.seed}: a run without evaluations is not stored")
        for evaluation in evaluations:
            if not math.isfinite(evaluation.score):
                raise ValueError(
                    f"{row}, seed {run.seed}: the score after {evaluation.steps} steps is {evaluation.score}, "
                    "and nothing of the run is stored"
                )
        others = [each for each in self.runs(row).values() if each.seed != run.seed]
        path, marker = self._path(row), self._path(row, ".runs")
        lines = [line for line in _read(path, EvaluationLine) if line.seed != run.seed]
        probed = {probe: self.probe(row, probe) for probe in PROBES}
        if marker.exists():
            _write(marker, FinishedRun, others)
        for probe, found in probed.items():
            if found:
                kept = [line for line in found if line["seed"] != run.seed]
                _write_table(self._path(row, f".{probe}"), _columns(kept), kept)
        lines += [
            EvaluationLine(run.seed, *e._replace(seconds=round(e.seconds, 2), score=round(e.score, 3)))
            for e in evaluations
        ]
        _write(path, EvaluationLine, lines)
        _write(marker, FinishedRun, [*others, run])

    def add_probe(self, row: str, seed: int, probe: str, found: Sequence[ProbeLine]) -> None:
        """Store what a probe found in a finished run, in place of what it found in it before.

        :raises ValueError: it found nothing, or its lines lack something
        """
        if not found or any("quantity" not in line or "value" not in line for line in found):
            raise ValueError(f"{row}, seed {seed}: probe {probe!r} must return lines with quantity and value")
        kept = [line for line in self.probe(row, probe) if line["seed"] != seed]
        new: list[ProbeLine] = [{"seed": seed, **line, "value": float(f"{line['value']:.6g}")} for line in found]
        lines = sorted([*kept, *new], key=lambda line: line["seed"])  # stable: the probe's own order within a seed
        _write_table(self._path(row, f".{probe}"), _columns(lines), lines)

    def add_reference(self, reference: Reference) -> None:
        """Store a reference in place of the one for the same environment and number of episodes."""
        others = self.references()
        others[reference.env, reference.episodes] = reference
        _write(self.folder / "references.csv", Reference, others.values())

    def _path(self, row: str, what: str = "") -> Path:
        return self.folder / f"{row.replace('/', '__')}{what}.csv"


# -- files --


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A temporary file beside ``path`` that takes its place when the block ends well, at once and for good.

    Whoever reads ``path``, even after the machine went down, sees all of the old file or all of the new one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _read(path: Path, kind: type[_Line]) -> list[_Line]:
    """The lines of a file; none if it is not there."""
    parsers = get_type_hints(kind)
    return [
        kind(*(_entry(path, i, name, text, parsers[name]) for name, text in line.items()))
        for i, line in _read_table(path, list(kind._fields))
    ]


def _read_table(path: Path, columns: Sequence[str], exactly: bool = True) -> list[tuple[int, dict[str, str]]]:
    """Numbered lines of a file, entries still text."""
    if not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *lines = list(csv.reader(file, strict=True)) or [[]]
    except (csv.Error, UnicodeDecodeError) as error:
        raise ResultFileError(f"{path}: not a CSV file: {error}") from error
    if header != list(columns) if exactly else not set(columns) <= set(header):
        raise ResultFileError(f"{path}: its columns must be {','.join(columns)}, and are {','.join(header)}")
    for i, line in enumerate(lines, start=2):
        if len(line) != len(header):
            raise ResultFileError(f"{path}, line {i}: {len(header)} entries are needed, and there are {len(line)}")
    return [(i, dict(zip(header, line, strict=True))) for i, line in enumerate(lines, start=2)]


def _entry(path: Path, line: int, name: str, text: str, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(text)
    except ValueError:
        raise ResultFileError(f"{path}, line {line}: {name} must be a number, got {text!r}") from None


def _plain(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text


def _columns(lines: Iterable[Mapping[str, Any]]) -> list[str]:
    """All keys of the lines: the seed, then those of the probe, then quantity and value."""
    keys = dict.fromkeys(key for line in lines for key in line)
    ends = ("seed", "quantity", "value")
    return ["seed", *(key for key in keys if key not in ends), "quantity", "value"]


def _write(path: Path, kind: type[_Line], lines: Iterable[_Line]) -> None:
    _write_table(path, kind._fields, (line._asdict() for line in sorted(lines)))


def _write_table(path: Path, columns: Sequence[str], lines: Iterable[Mapping[str, Any]]) -> None:
    with replaced(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
