"""The picture of the solvers' speed: time of a problem against batch, horizon and contacts."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from PIL import Image

from benchmarks.plots import INK, LEARNED, QUIET

if TYPE_CHECKING:
    from benchmarks.solver_speed import Row

__all__ = ["draw", "shows"]

N_LAMBDA, HORIZON, BATCH = 2, 10, 128
"""Where the other two are fixed."""
STYLES: dict[str, tuple[str, str, str]] = {
    "daqp": (LEARNED, "-", "o"),
    "torch": ("#3f5fb0", "-", "s"),
    "cvxpylayers": ("#c8553d", "-", "D"),
    "cvxpylayers-default": ("#c8553d", ":", "D"),
    "moreau": ("#e0a458", "-", "v"),
    "qpth": ("#8d5a97", "-", "^"),
    "clarabel": ("#7a6a58", "--", "P"),
    "piqp": ("#6a994e", "--", "X"),
    "piqp-multistage": ("#6a994e", "-", "X"),
    "proxqp": (QUIET, "-", "d"),
    "proxqp-warm": (QUIET, ":", "d"),
}
"""Colour, line and marker."""
WIDTHS = {"daqp": (3.2, 8.0), "torch": (1.8, 5.0)}
"""Width and size of marker of our own; the first shows under the second, with which it shares its backward pass."""


def shows(n_lambda: int, horizon: int, batch: int) -> bool:
    """Whether these problems are in the picture: at most one of the three differs from :data:`N_LAMBDA` and so on."""
    return (n_lambda != N_LAMBDA) + (horizon != HORIZON) + (batch != BATCH) <= 1


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Milliseconds for one problem, on logarithmic axes.

    :param path: of the PNG
    :param rows: of the grid; what was not measured leaves a gap
    """
    style: Any = {
        "font.size": 10, "axes.edgecolor": QUIET, "text.color": INK, "axes.labelcolor": INK,
        "xtick.color": INK, "ytick.color": INK,
    }  # fmt: skip
    measured = [row for row in rows if row.status == "measured"]
    panels: tuple[tuple[str, Callable[[Row], bool], str, str], ...] = (
        (rf"forward, $H$ = {HORIZON}, $n_\lambda$ = {N_LAMBDA}",
         lambda row: (row.n_lambda, row.horizon) == (N_LAMBDA, HORIZON), "batch", "forward_s"),
        (rf"backward, $H$ = {HORIZON}, $n_\lambda$ = {N_LAMBDA}",
         lambda row: (row.n_lambda, row.horizon) == (N_LAMBDA, HORIZON), "batch", "backward_s"),
        (rf"forward, batch {BATCH}, $n_\lambda$ = {N_LAMBDA}",
         lambda row: (row.n_lambda, row.batch) == (N_LAMBDA, BATCH), "horizon", "forward_s"),
        (rf"forward, batch {BATCH}, $H$ = {HORIZON}",
         lambda row: (row.horizon, row.batch) == (HORIZON, BATCH), "n_lambda", "forward_s"),
    )  # fmt: skip
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(10, 8), dpi=150, layout="constrained")
        all_axes = figure.subplots(2, 2, sharey=True).ravel()
        for axes, (title, chosen, against, value) in zip(all_axes, panels, strict=True):
            _panel(axes, [row for row in measured if chosen(row)], against, value)
            axes.set_title(title, fontsize=10, loc="left")
        for axes in all_axes[::2]:
            axes.set_ylabel("milliseconds for one problem")
        handles, labels = all_axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
        figure.suptitle(
            "Time to solve the controller's problem, and to differentiate it, on one thread", fontweight="bold"
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        drawn = io.BytesIO()
        figure.savefig(drawn)
    with Image.open(drawn) as picture:  # a palette makes a small file
        picture.convert("RGB").quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def _panel(axes: Axes, rows: Sequence[Row], against: str, value: str) -> None:
    ticks = sorted({getattr(row, against) for row in rows})
    for solver, (colour, line, marker) in STYLES.items():
        points = sorted((getattr(r, against), getattr(r, value), r.batch) for r in rows if r.solver == solver)
        points = [point for point in points if point[1] is not None]
        if not points:
            continue
        width, size = WIDTHS.get(solver, (1.2, 4.5))
        axes.plot(
            [at for at, _, _ in points], [1e3 * seconds / batch for _, seconds, batch in points], line, color=colour,
            marker=marker, markersize=size, linewidth=width, label=solver, zorder=3 if solver in WIDTHS else 2,
        )  # fmt: skip
    axes.set_yscale("log")
    if against == "n_lambda":
        axes.set_xlabel(r"contacts $n_\lambda$")
    else:
        axes.set_xscale("log", base=2)
        axes.set_xlabel({"batch": "batch", "horizon": "horizon $H$"}[against])
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color=QUIET, alpha=0.25, linewidth=0.8)
