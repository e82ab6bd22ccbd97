"""Drawing of the pictures of the results page, from numbers that are ready (:mod:`benchmarks.summary`)."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from PIL import Image

from benchmarks.aggregates import Interval
from benchmarks.evaluation import SOLVED
from benchmarks.plots import INK, LEARNED, QUIET, REFERENCES

__all__ = ["Curve", "Dots", "Look", "Panel", "aggregates", "dots", "episodes", "heat_maps", "learning"]

_WIDTH = 8.0  # inches; at 800 pixels a point of type is 1.4 of them
_SOLVED_LABEL = f"{100.0 * SOLVED:.0f} % of the oracle"
_STYLE: Any = {
    "font.size": 10, "axes.edgecolor": QUIET, "text.color": INK, "axes.labelcolor": INK, "axes.titlesize": 10,
    "axes.titleweight": "bold", "xtick.color": INK, "ytick.color": INK, "axes.spines.top": False,
    "axes.spines.right": False, "axes.axisbelow": True,
}  # fmt: skip


class Look(NamedTuple):
    """How a learner is drawn in every picture."""

    label: str
    colour: str
    line: str = "-"
    width: float = 1.5


@contextlib.contextmanager
def _figure(path: Path, height: float) -> Iterator[Figure]:
    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(_WIDTH, height), dpi=150, layout="constrained")
        yield figure
        picture = io.BytesIO()
        figure.savefig(picture, format="png")
    # lines and areas of a few colours: a palette halves the file
    Image.open(picture).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


# -- learning curves --


class Curve(NamedTuple):
    """One learner in one panel."""

    look: Look
    x: np.ndarray
    """(N,)"""
    quartiles: np.ndarray
    """(3, N) of the score."""


class Panel(NamedTuple):
    """Learners in one environment, against one unit of time."""

    title: str
    unit: str
    start: float
    """The time that stands for zero on a logarithmic axis."""
    oracle: float
    lqr: float
    curves: Sequence[Curve]


def learning(path: Path, rows: Sequence[Sequence[Panel]], lowest: float = -0.25) -> None:
    """Draw medians and quartiles of scores, a row of panels for each environment.

    :param path: of the PNG
    :param rows: of panels with the same environment
    :param lowest: lower edge, as a share of the oracle's score; where it is negative, what is lower is drawn on it
    """
    with _figure(path, 0.9 + 2.5 * len(rows)) as figure:
        grid = figure.subplots(len(rows), len(rows[0]), squeeze=False, sharex="col", sharey="row")
        entries: dict[str, Any] = {}
        for axes_of_row, panels in zip(grid, rows, strict=True):
            low, high = _limits(panels, lowest)
            for axes, panel in zip(axes_of_row, panels, strict=True):
                _learning_panel(axes, panel, low)
                entries |= dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
            axes_of_row[0].set_ylim(low, high + 0.06 * (high - low))
            axes_of_row[0].set_ylabel("score")
        columns = len(entries) if len(entries) <= 5 else 4
        figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, frameon=False)


def _limits(panels: Sequence[Panel], lowest: float) -> tuple[float, float]:
    """Scores at the lower edge, no lower than anything is, and at the highest curve or the oracle."""
    quartiles = [curve.quartiles for panel in panels for curve in panel.curves]
    edge = lowest * panels[0].oracle
    low = max(edge, min(0.0, *(float(each.min()) for each in quartiles)))
    return low, max(panels[0].oracle, *(float(each.max()) for each in quartiles))


def _learning_panel(axes: Axes, panel: Panel, low: float) -> None:
    oracle = panel.oracle
    colour, line = REFERENCES["oracle"]
    axes.axhspan(SOLVED * oracle, oracle, color=colour, alpha=0.15, linewidth=0.0, label=_SOLVED_LABEL)
    axes.axhline(oracle, color=colour, linestyle=line, linewidth=1.2, label="oracle")
    if np.isfinite(panel.lqr):
        colour, line = REFERENCES["LQR"]
        axes.axhline(panel.lqr, color=colour, linestyle=line, linewidth=1.2, label="LQR")
    for (label, colour, line, width), x, quartiles in panel.curves:
        first, median, third = np.maximum(quartiles, min(low, 0.0))
        axes.fill_between(x, first, third, color=colour, alpha=0.16, linewidth=0.0)
        axes.plot(x, median, color=colour, linestyle=line, linewidth=width, label=label, zorder=2 + width)
    axes.set_xscale("log")
    axes.set_xlim(left=panel.start)
    axes.xaxis.set_major_locator(LogLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}"))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:,.0f}"))
    axes.set_title(panel.title, loc="left")
    axes.set_xlabel(panel.unit)
    axes.grid(axis="y", color=QUIET, alpha=0.25, linewidth=0.8)


# -- an episode --


def episodes(path: Path, panels: Sequence[str], controllers: Sequence[tuple[Look, np.ndarray, np.ndarray]]) -> None:
    """Draw an episode under several controllers.

    :param path: of the PNG
    :param panels: what is drawn in each
    :param controllers: how each is drawn, (N,) times in seconds, and (n_panels, N) values
    """
    with _figure(path, 2.9) as figure:
        grid = figure.subplots(1, len(panels), squeeze=False)[0]
        for i, (axes, title) in enumerate(zip(grid, panels, strict=True)):
            for look, times, values in controllers:
                axes.plot(
                    times, values[i], color=look.colour, linestyle=look.line, linewidth=look.width, label=look.label
                )
            axes.set_title(title, loc="left")
            axes.set_xlabel("time, s")
            axes.grid(axis="y", color=QUIET, alpha=0.25, linewidth=0.8)
        figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)


# -- a dot a run --


class Dots(NamedTuple):
    """The runs of one row."""

    label: str
    final: np.ndarray
    """(n_seeds,) scores, the oracle's being 1."""
    best: np.ndarray
    """(n_seeds,) the same of the best evaluation."""


def dots(path: Path, rows: Sequence[Dots], lqr: float, lowest: float = 0.5) -> None:
    """Draw where each run ends, and the best of its evaluations.

    :param path: of the PNG
    :param rows: from top to bottom
    :param lqr: LQR's score, the oracle's being 1
    :param lowest: left edge; what is lower is drawn on it
    """
    with _figure(path, 1.2 + 0.24 * len(rows)) as figure:
        axes = figure.subplots()
        span = 1.04 - lowest
        colour, line = REFERENCES["oracle"]
        axes.axvspan(SOLVED, 1.0, color=colour, alpha=0.15, linewidth=0.0, label=_SOLVED_LABEL)
        axes.axvline(1.0, color=colour, linestyle=line, linewidth=1.2, label="oracle")
        if np.isfinite(lqr):
            colour, line = REFERENCES["LQR"]
            axes.axvline(lqr, color=colour, linestyle=line, linewidth=1.2, label="LQR")
        for height, (_, final, best) in enumerate(rows):
            shift = np.linspace(-0.2, 0.2, len(final)) if len(final) > 1 else np.zeros(1)
            best_shown, final_shown = np.maximum(best, lowest), np.maximum(final, lowest)
            axes.hlines(height + shift, final_shown, best_shown, color=LEARNED, alpha=0.35, linewidth=1.0)
            style: dict[str, Any] = {"color": LEARNED, "clip_on": False, "linestyle": "none", "markersize": 4.5}
            for score, there, marker, face in (
                (best_shown, best >= lowest, "o", "white"),
                (final_shown, final >= lowest, "o", LEARNED),
                (final_shown, final < lowest, "<", LEARNED),
            ):
                if there.any():  # matplotlib leaves room for a line of no points
                    axes.plot(score[there], (height + shift)[there], marker, mfc=face, **style)
        axes.set_yticks(range(len(rows)), [row.label for row in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlim(lowest, max(1.04, *(float(row.best.max()) for row in rows)) + 0.01 * span)
        axes.set_xlabel("score, the oracle's being 1")
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="both", color=QUIET, alpha=0.2, linewidth=0.8)
        axes.plot([], [], "o", color=LEARNED, mfc="white", label="best")
        axes.plot([], [], "o", color=LEARNED, label="at the end")
        figure.legend(loc="outside lower center", ncols=5, frameon=False)


# -- several tasks --


def aggregates(
    path: Path,
    means: Mapping[str, Interval],
    profiles: Mapping[str, tuple[np.ndarray, np.ndarray]],
    thresholds: np.ndarray,
    looks: Mapping[str, Look],
) -> None:
    """Draw interquartile means with their intervals, and performance profiles.

    :param path: of the PNG
    :param means: by learner
    :param profiles: by learner: (N,) and its interval, (2, N)
    :param thresholds: (N,) of the profiles
    :param looks: by learner
    """
    with _figure(path, 3.2) as figure:
        left, right = figure.subplots(1, 2)
        for height, (name, (value, low, high)) in enumerate(means.items()):
            look = looks[name]
            left.hlines(height, low, high, color=look.colour, linewidth=7.0, alpha=0.35)
            left.plot(value, height, "o", color=look.colour, markersize=7)
        left.set_yticks(range(len(means)), [looks[name].label for name in means])
        left.set_ylim(len(means) - 0.4, -0.6)
        left.set_xlabel("interquartile mean, the oracle's score being 1")
        left.tick_params(axis="y", length=0)
        left.grid(axis="x", color=QUIET, alpha=0.25, linewidth=0.8)
        for name, (share, (low_share, high_share)) in profiles.items():
            look = looks[name]
            right.fill_between(thresholds, low_share, high_share, color=look.colour, alpha=0.16, linewidth=0.0)
            right.plot(thresholds, share, color=look.colour, linestyle=look.line, linewidth=2.0)
        right.axvline(SOLVED, color=REFERENCES["oracle"][0], linestyle=":", linewidth=1.2)
        right.annotate(" solved", (SOLVED, 0.02), ha="right", color=REFERENCES["oracle"][0])
        right.set_xlim(thresholds[0], thresholds[-1])
        right.set_ylim(0.0, 1.03)
        right.set_xlabel("score, the oracle's being 1")
        right.set_ylabel("share of runs above it")
        right.grid(color=QUIET, alpha=0.25, linewidth=0.8)


# -- controllers under changes --


def heat_maps(path: Path, panels: Mapping[str, tuple[Sequence[str], Sequence[str], np.ndarray]]) -> None:
    """Draw a table of shares, in percent, for each environment, dark where little is left.

    :param path: of the PNG
    :param panels: title -> changes, controllers, and (n_changes, n_controllers) shares, not a number where unknown
    """
    longest = max(len(changes) for changes, _, _ in panels.values())
    colours = matplotlib.colors.LinearSegmentedColormap.from_list("", ["#c8553d", "#f3dcc4", "#d9ebec", LEARNED])
    with _figure(path, 1.1 + 0.29 * longest) as figure:
        widths = [len(controllers) for _, controllers, _ in panels.values()]
        grid = figure.subplots(1, len(panels), squeeze=False, width_ratios=widths)[0]
        for axes, (title, (changes, controllers, shares)) in zip(grid, panels.items(), strict=True):
            axes.imshow(np.clip(shares, 0.0, 1.0), cmap=colours, vmin=0.0, vmax=1.0, aspect="auto")
            for (i, j), share in np.ndenumerate(shares):
                text = "\N{EN DASH}" if np.isnan(share) else "< 0" if share < 0.0 else f"{100.0 * share:.0f}"
                dark = share < 0.15 or share > 0.9
                axes.text(j, i, text, ha="center", va="center", fontsize=9, color="white" if dark else INK)
            axes.set_xticks(range(len(controllers)), [_broken(name) for name in controllers])
            axes.set_yticks(range(len(changes)), changes)
            axes.tick_params(length=0, top=False, labelsize=9)
            axes.spines[:].set_visible(False)
            axes.set_title(title, loc="left")


def _broken(label: str) -> str:
    """A label on several lines, broken where the eye expects it."""
    return label.replace("+ ", "+\n").replace(", ", ",\n").replace("informed ", "informed\n")
