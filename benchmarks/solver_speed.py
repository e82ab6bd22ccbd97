"""How fast, how exact and how frugal the solvers of the relaxed problem are, ours and other people's.

    python -m benchmarks.solver_speed

All solvers in turn on the same problems, in one process, on one thread unless told otherwise. The problems are the
controller's first pass with the cart-pole's true model, from the Hard environment's starting states, with 0, 2, 4 and
8 contacts (benchmarks/solver_problems.py), and those of a published set-up. Times are medians for a whole batch, on one
thread of processor time, which other programs on the machine do not lengthen; memory is that of a fresh process
(benchmarks/solver_timing.py says what exactly). A batch whose forward and backward
pass would take longer than the budget, by extrapolation from smaller ones, is not run, and the table says so; batches
that are in the picture have four times the budget.

    python -m benchmarks.solver_speed --latency --training

measures, in place of that, how long a trained policy's ``predict`` takes for one state, and which share of a training
run the controller has (benchmarks/policy_speed.py).

Rivals that are not installed are left out: ``pip install proxsuite piqp moreau`` and ``pip install --no-deps qpth``.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import os
import platform
import warnings
from collections.abc import Iterable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks import policy_speed, solver_picture
from benchmarks.rivals import RIVALS, missing_package
from benchmarks.solver_problems import Problems, cart_pole_problems, published_problems
from benchmarks.solver_timing import Duration, Measurement, Reference, measure, peak_memory, reference
from sb3_mpc_policy.solvers import SOLVERS

RESULTS, PICTURE = Path("benchmarks/results"), Path("docs/images/solver_speed.png")
BATCHES, HORIZONS, CONTACTS = (1, 8, 64, 128, 512, 2048), (5, 10, 20, 40, 80), (0, 2, 4, 8)
_IN_PICTURE = 4.0  # times the budget
# Memory takes a process a time: only for these problems.
MEMORY_CONTACTS, MEMORY_BATCHES = 2, (128, 2048)
PACKAGES = (
    "clarabel", "cvxpy", "cvxpylayers", "daqp", "diffcp", "moreau", "numpy", "piqp", "proxsuite", "qpth", "scipy",
    "torch",
)  # fmt: skip


class Row(NamedTuple):
    """One line of a result file: a solver on a batch of problems. Times are seconds for the whole batch."""

    problems: str
    solver: str
    n_lambda: int
    horizon: int
    batch: int
    status: str
    """"measured", "not run", "not installed", "failed", or "published" for other people's figures"""
    forward_s: float | None = None
    forward_least_s: float | None = None
    forward_repeats: int | None = None
    forward_again_s: float | None = None
    differentiable_s: float | None = None
    backward_s: float | None = None
    backward_least_s: float | None = None
    backward_repeats: int | None = None
    memory_mib: float | None = None
    failures: int | None = None
    kkt_residual: float | None = None
    action_error: float | None = None
    gradient_error: float | None = None
    note: str = ""

    @property
    def pass_s(self) -> float | None:
        """A forward and a backward pass; the forward pass alone where there is no derivative."""
        if self.differentiable_s is None or self.backward_s is None:
            return self.forward_s
        return self.differentiable_s + self.backward_s


PUBLISHED = [
    Row(
        "published", "acados", 0, 20, 128, "published", forward_s=8.3e-3, differentiable_s=8.3e-3, backward_s=33.1e-3,
        note="README of FreyJo/differentiable_nmpc: 4 threads of an i7-8665U, its own random system, adjoint",
    )
]  # fmt: skip
"""Measured by others, on another machine."""


# -- the grid --


def run_grid(
    solvers: Sequence[str],
    contacts: Iterable[int],
    horizons: Sequence[int],
    batches: Sequence[int],
    budget: float,
) -> Iterator[Row]:
    """Every solver on every batch, smallest first: what a batch takes says whether the next larger one is run.

    :param budget: seconds, see the module
    """
    for n_contacts in contacts:
        seconds: dict[tuple[str, int, int], float] = {}
        for horizon, batch in itertools.product(sorted(horizons), sorted(batches)):
            problems = cart_pole_problems(n_contacts, horizon, batch)
            allowed = budget * (_IN_PICTURE if solver_picture.shows(n_contacts, horizon, batch) else 1.0)
            known = _reference(problems, _expected(seconds, "daqp", horizon, batch), allowed)
            with_memory = n_contacts == MEMORY_CONTACTS and batch in MEMORY_BATCHES
            for solver in solvers:
                expected = _expected(seconds, solver, horizon, batch)
                row = run_cell("cart-pole", solver, problems, allowed, expected, known, with_memory)
                if row.pass_s is not None:
                    seconds[solver, horizon, batch] = row.pass_s
                elif expected is not None:
                    seconds[solver, horizon, batch] = expected  # so that larger ones are not run either
                yield row


def run_published(solvers: Sequence[str], budget: float, batch: int = 128) -> Iterator[Row]:
    """The same for the published set-up, and the figures that were published for it."""
    problems = published_problems(batch)
    known = reference(problems)
    for solver in solvers:
        yield run_cell("published", solver, problems, budget, None, known, with_memory=True)
    yield from PUBLISHED


def run_cell(
    name: str,
    solver: str,
    problems: Problems,
    budget: float,
    expected: float | None,
    known: Reference | None,
    with_memory: bool,
) -> Row:
    """One solver on one batch.

    :param name: of the problems
    :param expected: seconds that a pass is expected to take, if there is anything to go by
    """
    n_c = problems.problem.sizes[2]
    row = Row(name, solver, n_c, problems.problem.horizon, len(problems.s0), "measured")
    lacking = missing_package(solver) if solver in RIVALS else None
    if lacking is not None:
        return row._replace(status="not installed", note=f"no module {lacking}")
    if expected is not None and expected > budget:
        return row._replace(status="not run", note=f"a pass was expected to take {expected:.1f} s, over {budget:g} s")
    try:
        found = measure(solver, problems, budget / 2, known)
    except Exception as error:  # whatever a rival may raise is its result, and no reason to stop
        return row._replace(status="failed", note=f"{type(error).__name__}: {error}"[:200])
    memory = peak_memory(solver, problems) if with_memory else None
    return _filled(row, found, memory)


def _filled(row: Row, found: Measurement, memory: float | None) -> Row:
    nothing = (None, None, None)
    backward: Duration | tuple[None, None, None] = found.backward or nothing
    return row._replace(
        forward_s=found.forward.median,
        forward_least_s=found.forward.least,
        forward_repeats=found.forward.repeats,
        forward_again_s=found.again.median,
        differentiable_s=found.differentiable.median if found.differentiable else None,
        backward_s=backward[0],
        backward_least_s=backward[1],
        backward_repeats=backward[2],
        memory_mib=memory,
        failures=found.failures,
        kkt_residual=found.kkt_residual,
        action_error=found.action_error,
        gradient_error=found.gradient_error,
    )


def _reference(problems: Problems, expected: float | None, budget: float) -> Reference | None:
    return None if expected is not None and expected > budget else reference(problems)


def _expected(seconds: dict[tuple[str, int, int], float], solver: str, horizon: int, batch: int) -> float | None:
    """Seconds of a pass, from what smaller batches and shorter horizons took; None where there is nothing to go by.

    The time grows at most in proportion to the batch, and from one batch to the next as it did for the horizon before;
    with the horizon as its square.
    """
    mine = {(h, b): t for (s, h, b), t in seconds.items() if s == solver}
    smaller = [b for h, b in mine if h == horizon and b < batch]
    shorter = [h for h, b in mine if h < horizon and b == batch]
    guesses = []
    if smaller:
        guesses.append(mine[horizon, max(smaller)] * batch / max(smaller))
    if smaller and shorter and (max(shorter), max(smaller)) in mine:
        growth = mine[max(shorter), batch] / mine[max(shorter), max(smaller)]
        guesses.append(mine[horizon, max(smaller)] * growth)
    if shorter and not smaller:
        guesses.append(mine[max(shorter), batch] * (horizon / max(shorter)) ** 2)
    return min(guesses, default=None)


# -- files --


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a result file, numbers to four digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        for row in rows:
            writer.writerow([f"{entry:.4g}" if isinstance(entry, float) else entry for entry in row])


def read_rows(path: Path) -> list[Row]:
    """Read what :func:`write_rows` wrote."""
    whole = ("n_lambda", "horizon", "batch", "forward_repeats", "backward_repeats", "failures")
    text = ("problems", "solver", "status", "note")

    def parsed(name: str, entry: str) -> Any:
        if name in text:
            return entry
        return None if not entry else int(entry) if name in whole else float(entry)

    with path.open(newline="") as file:
        return [Row(**{name: parsed(name, entry) for name, entry in line.items()}) for line in csv.DictReader(file)]


def machine(threads: int) -> dict[str, Any]:
    """What the figures were measured on."""
    processor = platform.processor() or platform.machine()
    described = Path("/proc/cpuinfo")
    if described.exists():
        names = [line.split(":", 1)[1].strip() for line in described.read_text().splitlines() if "model name" in line]
        processor = names[0] if names else processor
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "threads": threads,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": versions,
    }


# -- tables for the terminal --


def summary(rows: Sequence[Row], n_contacts: int = 2, horizon: int = 10, batch: int = 128) -> Table:
    """Every solver on one batch."""
    table = Table(
        title=f"n_lambda = {n_contacts}, H = {horizon}, batch {batch}: milliseconds for one problem",
        box=SIMPLE_HEAD,
        padding=0,
        caption="same: model seen before; with grad.: all before the backward pass.\n"
        "off: largest error of an action; relative error of the gradient",
    )
    table.add_column("solver", no_wrap=True)
    names = ("for-\nward", "same", "with\ngrad.", "back-\nward", "MiB", "KKT", "actions\noff", "grad.\noff")
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        if (row.n_lambda, row.horizon, row.batch) != (n_contacts, horizon, batch):
            continue
        if row.status not in ("measured", "published"):
            table.add_row(row.solver, f"({row.status})", style="dim")
            continue
        times = (row.forward_s, row.forward_again_s, row.differentiable_s, row.backward_s)
        table.add_row(
            row.solver,
            *("" if t is None else f"{1e3 * t / row.batch:#.3g}" for t in times),
            "" if row.memory_mib is None else f"{row.memory_mib:,.0f}",
            *("" if e is None else f"{e:.0e}" for e in (row.kkt_residual, row.action_error, row.gradient_error)),
        )
    return table


def promises(rows: Sequence[Row]) -> Table:
    """What the project promises of its default solver, and what was measured; "-" where it was not."""
    found = {(row.solver, row.n_lambda, row.horizon, row.batch): row for row in rows if row.status == "measured"}
    table = Table(title="What is promised of the default solver, n_lambda = 2", box=SIMPLE_HEAD)
    for name in ("quantity", "promised", "measured", ""):
        table.add_column(name, justify="left" if name == "quantity" else "right")

    def add(quantity: str, promised: str, measured: float | None, unit: str, kept: bool | None) -> None:
        table.add_row(
            quantity, promised, "-" if measured is None else f"{measured:.3g} {unit}",
            "" if kept is None else "[green]kept" if kept else "[red]not kept",
        )  # fmt: skip

    ours = found.get(("daqp", 2, 10, 128))
    for layer, what in (("cvxpylayers", "1e-12, dense derivative"), ("cvxpylayers-default", "defaults, LSQR")):
        theirs = found.get((layer, 2, 10, 128))
        for kind, least in (("forward", 75), ("backward", 30)):
            name = "differentiable_s" if kind == "forward" else "backward_s"
            ratio = None if None in (ours, theirs) else getattr(theirs, name) / getattr(ours, name)
            quantity = f"CvxpyLayer (Clarabel, {what}) / daqp, {kind}, H = 10, batch 128"
            add(quantity, f">= {least} x", ratio, "x", None if ratio is None else ratio >= least)
    small, large = found.get(("daqp", 2, 10, 64)), found.get(("daqp", 2, 10, 2048))
    growth = None
    if small is not None and large is not None and small.pass_s and large.pass_s:
        growth = (large.pass_s / large.batch) / (small.pass_s / small.batch)
    quantity = "daqp, time of a problem (forward and backward), batch 2048 / batch 64, H = 10"
    add(quantity, "<= 1 x", growth, "x", None if growth is None else growth <= 1.0)
    frugal = found.get(("daqp", 2, 20, 2048))
    memory = None if frugal is None else frugal.memory_mib
    quantity = "daqp, peak memory, forward and backward, H = 20, batch 2048"
    add(quantity, "< 1024 MiB", memory, "MiB", None if memory is None else memory < 1024)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, write, draw and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--solvers", nargs="+", default=[*SOLVERS, *RIVALS], choices=[*SOLVERS, *RIVALS], metavar="NAME"
    )
    parser.add_argument("--batches", nargs="+", type=int, default=BATCHES, metavar="N")
    parser.add_argument("--horizons", nargs="+", type=int, default=HORIZONS, metavar="H")
    parser.add_argument("--contacts", nargs="+", type=int, default=CONTACTS, metavar="N")
    parser.add_argument("--budget", type=float, default=1.0, help="seconds that one pass may be expected to take")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--latency", action="store_true", help="measure a policy's predict instead")
    parser.add_argument("--training", action="store_true", help="measure a training run instead")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the result files")
    parser.add_argument("--picture", type=Path, default=PICTURE)
    args = parser.parse_args(argv)
    if args.threads < 1:
        parser.error(f"--threads must be at least 1, got {args.threads}")
    warnings.filterwarnings("ignore", category=DeprecationWarning)  # cvxpylayers', on NumPy 2
    console = Console()
    torch.set_num_threads(args.threads)
    with threadpool_limits(args.threads):
        if args.latency or args.training:
            console.print(policy_speed.run(args.output / "solver_speed_policy.csv", args.latency, args.training))
            return
        rows = []
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        cells = len(args.contacts) * len(args.horizons) * len(args.batches) * len(args.solvers)
        with Progress(*columns, console=console) as progress:
            bar = progress.add_task("", total=cells + len(args.solvers))
            for row in run_grid(args.solvers, args.contacts, args.horizons, args.batches, args.budget):
                what = f"n_lambda {row.n_lambda}, H {row.horizon}, batch {row.batch}, {row.solver}"
                progress.update(bar, advance=1, description=what)
                rows.append(row)
                if row.solver == args.solvers[-1]:
                    write_rows(args.output / "solver_speed.csv", rows)  # it takes long: what there is can be looked at
            published = []
            for row in run_published(args.solvers, args.budget):
                progress.update(bar, advance=row.status != "published", description=f"published, {row.solver}")
                published.append(row)
    write_rows(args.output / "solver_speed_published.csv", published)
    (args.output / "solver_speed_machine.json").write_text(json.dumps(machine(args.threads), indent=2) + "\n")
    solver_picture.draw(args.picture, rows)
    console.print(summary(rows), summary(published, 0, 20), promises(rows))
    console.print(f"{args.output / 'solver_speed.csv'} and beside it; {args.picture}", soft_wrap=True)


if __name__ == "__main__":
    main()
