"""How far the controller's plans are from the global optimum of eq (6), and what the distance costs in time.

    python -m benchmarks.relaxation

The controller that knows the true model (:func:`benchmarks.references.oracle_controller`) plans from each of
:func:`start_states` with its default settings and with others. The gap of a plan is its cost, when the LCS itself is
simulated under its actions, relative to the cost of the proven optimum (:mod:`benchmarks.global_optimum`), minus one.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import torch
from joblib import Parallel, delayed
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from benchmarks.global_optimum import PROVEN, GlobalOptimum, global_optimum
from benchmarks.plots import INK, LEARNED, QUIET, REFERENCES
from benchmarks.references import cart_pole, lqr, oracle_controller
from contact_envs.dynamics import tip_position
from sb3_mpc_policy import LcsMpc
from sb3_mpc_policy.problem import RelaxedProblem
from sb3_mpc_policy.simulation import LcsRollout

SEED = 2_000_000
"""Of the states, and of the first episode they are taken from: none that training, scores or tuning use."""

NEAR_WALL = 0.05
"""m between tip and wall, on either side of it."""

HORIZON = 10
"""Of every controller here. Each further step multiplies the modes that a proof of optimality has to rule out."""

LATEST_VISIT = 50
"""Control steps of an episode within which a state is taken from it."""

EXACT = 1e-9
"""Product of force and gap, scaled coordinates, up to which a plan counts as exactly complementary."""


class ConstantPenalty(LcsMpc):
    """The same penalty in every pass."""

    def _penalty(self, problem: RelaxedProblem, number: int) -> float:
        return super()._penalty(problem, 0)


class ZeroNominal(LcsMpc):
    """The first nominal is no action at all."""

    def _first_nominal(self, problem: RelaxedProblem, s0: np.ndarray, previous: np.ndarray | None) -> LcsRollout:
        return self._simulator.under(s0, np.zeros((len(s0), problem.horizon, problem.sizes[1])))


class Setting(NamedTuple):
    """A controller to be measured: what it is compared with, what is said of it, its class and its arguments."""

    family: str
    label: str
    controller: type[LcsMpc] = LcsMpc
    arguments: Mapping[str, Any] = {}


SETTINGS = [
    Setting("default", "default"),
    *(Setting("passes", f"{n}", arguments={"n_iterations": n}) for n in (1, 2, 3, 4, 8)),
    *(Setting("first penalty", f"{p:g}", arguments={"penalty": p}) for p in (10.0, 30.0, 300.0, 1e3, 1e4)),
    *(Setting("smoothing", f"{e:g}", arguments={"smoothing": e}) for e in (1e-8, 1e-6, 1e-4)),
    *(Setting("constant penalty", f"{p:g}", ConstantPenalty, {"penalty": p}) for p in (1e2, 1e3, 1e4, 1e5)),
    Setting("nominal", "zero", ZeroNominal),
]


class Row(NamedTuple):
    """One line of the result file. Gaps are fractions of the optimum's cost."""

    env: str
    family: str
    setting: str
    median_gap: float
    p95_gap: float
    max_gap: float
    ms_per_plan: float
    exact: float
    """Share of plans that are exactly complementary."""
    states: int
    in_contact: int
    """States whose optimal plan touches a wall."""
    proven: int
    """States whose optimum is proven."""


def start_states(env_id: str, n: int, seed: int = SEED) -> np.ndarray:
    """(n, n_x) states to plan from, the same for the same arguments.

    Two fifths are the environment's own starts; three tenths are starts with the tip within :data:`NEAR_WALL` of a
    wall, in front of it or in it; the rest are visited by the linear-quadratic regulator, each in an episode of its
    own, at a random one of the first :data:`LATEST_VISIT` steps (or where the episode ends).

    :param env_id: see :func:`benchmarks.references.cart_pole`
    """
    rng = np.random.default_rng(seed)
    regulator = lqr(env_id)
    n_near, n_visited = 3 * n // 10, 3 * n // 10
    with cart_pole(env_id) as plant:
        wide = plant.reset_range
        states = list(rng.uniform(-wide, wide, (n - n_near - n_visited, len(wide))))
        while len(states) < n - n_visited:
            state = rng.uniform(-wide, wide)
            if abs(abs(tip_position(state, plant.parameters)) - plant.parameters.wall_distance) < NEAR_WALL:
                states.append(state)
        for episode in range(n_visited):
            state, _ = plant.reset(seed=seed + episode)
            for _ in range(rng.integers(1, LATEST_VISIT + 1)):
                action = np.clip(regulator(state[None])[0], -1.0, 1.0).astype(np.float32)
                state, _, terminated, _, _ = plant.step(action)
                if terminated:
                    break
            states.append(state)
    return np.array(states)


def controller(env_id: str, setting: Setting) -> LcsMpc:
    """The oracle's controller with one setting changed."""
    result = oracle_controller(env_id, horizon=HORIZON, **setting.arguments)
    result.__class__ = setting.controller  # a class with the same attributes
    return result


def optima(env_id: str, states: np.ndarray, known: np.ndarray, jobs: int) -> list[GlobalOptimum]:
    """The global optimum from each state.

    :param states: (N, n_x), environment units
    :param known: (N, H, n_a) a good plan from each, environment units
    :param jobs: processes
    """
    plain = oracle_controller(env_id, horizon=HORIZON)
    problem = plain._current_problem()
    s0 = states / plain.lcs.state_scale.numpy()
    inside = np.clip(known / plain.lcs.action_scale.numpy(), problem.action_low, problem.action_high)  # of rounding
    tasks = (delayed(global_optimum)(problem, s, plan) for s, plan in zip(s0, inside, strict=True))
    return list(Parallel(n_jobs=jobs)(tasks))


def measure(env_id: str, n_states: int, jobs: int, repeats: int = 5) -> list[Row]:
    """Every setting in one environment.

    Times are of the processor, on one thread, for all states in one batch: the least of ``repeats``.
    """
    states = start_states(env_id, n_states)
    plans, seconds = [], []
    for setting in SETTINGS:
        mpc = controller(env_id, setting)
        mpc.plan(states[:1])  # builds what is kept between plans
        times = []
        for _ in range(repeats):
            begun = time.process_time()
            plan = mpc.plan(states)
            times.append(time.process_time() - begun)
        plans.append(plan)
        seconds.append(min(times))
    best = np.argmin([plan.cost for plan in plans], axis=0)
    found = optima(env_id, states, np.array([plans[j].actions[i] for i, j in enumerate(best)]), jobs)

    plain = oracle_controller(env_id, horizon=HORIZON)
    plain._current_problem()
    s0 = states / plain.lcs.state_scale.numpy()
    touched = (plain._simulator.under(s0, np.array([optimum.actions for optimum in found])).forces > 0.0).any(
        axis=(1, 2)
    )
    cost = np.array([optimum.cost for optimum in found])
    rows = []
    for setting, plan, taken in zip(SETTINGS, plans, seconds, strict=True):
        gap = np.maximum(plan.cost / cost - 1.0, 0.0)  # below zero by rounding only
        rows.append(
            Row(
                env_id, setting.family, setting.label, float(np.median(gap)), float(np.percentile(gap, 95)),
                float(gap.max()), 1e3 * taken / n_states, float(np.mean(plan.complementarity <= EXACT)), n_states,
                int(touched.sum()), sum(optimum.proven for optimum in found),
            )
        )  # fmt: skip
    return rows


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write the result file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        for row in rows:
            writer.writerow([f"{entry:.4g}" if isinstance(entry, float) else entry for entry in row])


def table_of(rows: Sequence[Row]) -> Table:
    """One environment's rows for the terminal."""
    first = rows[0]
    title = f"{first.env}: {first.proven} of {first.states} optima proven, {first.in_contact} touch a wall"
    table = Table(title=title, box=SIMPLE_HEAD)
    table.add_column("setting", no_wrap=True)
    for name in ("median", "95 %", "largest", "ms a plan", "exact"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            row.family if row.family == row.setting else f"{row.family} {row.setting}",
            *(f"{gap:.2%}" for gap in (row.median_gap, row.p95_gap, row.max_gap)),
            f"{row.ms_per_plan:.3f}", f"{row.exact:.0%}",
        )  # fmt: skip
    return table


# -- the picture --

TARGETS = {"95th percentile": 0.10, "median": 0.01}
COLOURS = {
    "passes": LEARNED,
    "first penalty": "#6a5d9e",
    "smoothing": REFERENCES["LQR"][0],
    "constant penalty": REFERENCES["oracle"][0],
    "nominal": QUIET,
}


def picture(path: Path, rows: Sequence[Row]) -> None:
    """Gap against time per plan, a panel an environment. Gaps below what is proven are drawn on the lower edge."""
    style: Any = {"font.size": 10, "axes.edgecolor": QUIET, "text.color": INK, "axes.labelcolor": INK}
    envs = list(dict.fromkeys(row.env for row in rows))
    with matplotlib.rc_context(style | {"xtick.color": INK, "ytick.color": INK}):
        figure = Figure(figsize=(11, 5.2), dpi=130, layout="constrained")
        panels = figure.subplots(1, len(envs), sharey=True, squeeze=False)[0]
        for axes, env_id in zip(panels, envs, strict=True):
            _panel(axes, [row for row in rows if row.env == env_id])
            axes.set_title(env_id)
            axes.set_xlabel("ms a plan, one thread, in one batch")
        panels[0].set_ylabel("cost above the global optimum")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)


def _panel(axes: Axes, rows: Sequence[Row]) -> None:
    for name, target in TARGETS.items():
        line = "-" if name == "median" else "--"
        axes.axhline(target, color=QUIET, linestyle=line, linewidth=1.0, label=f"target of the {name}")
    axes.plot([], [], "o", color=INK, label="95th percentile")
    axes.plot([], [], "o", color=INK, markerfacecolor="none", label="median")
    for family, colour in COLOURS.items():
        mine = [row for row in rows if row.family == family]
        x = [row.ms_per_plan for row in mine]
        high, low = (np.maximum([getattr(row, name) for row in mine], PROVEN) for name in ("p95_gap", "median_gap"))
        axes.vlines(x, low, high, color=colour, linewidth=0.8, alpha=0.35)
        axes.plot(x, low, "o", color=colour, markersize=6, markerfacecolor="none")
        axes.plot(x, high, "o", color=colour, markersize=6, label=family)
        for row, y in zip(mine, high, strict=True):
            axes.annotate(
                row.setting, (row.ms_per_plan, y), (2, 6), textcoords="offset points", fontsize=8, color=colour,
                rotation=55, rotation_mode="anchor",
            )  # fmt: skip
    default = next(row for row in rows if row.family == "default")
    for gap, fill in ((default.median_gap, "none"), (default.p95_gap, INK)):
        axes.plot(
            default.ms_per_plan, max(gap, PROVEN), "*", color=INK, markersize=15, markerfacecolor=fill, zorder=5,
            label="default settings" if fill == INK else None, clip_on=False,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(PROVEN / 1.5, 60.0)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
    axes.xaxis.set_major_locator(FixedLocator([0.02, 0.05, 0.1, 0.2, 0.5, 1.0]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=QUIET, alpha=0.2, linewidth=0.8)


def main(argv: Sequence[str] | None = None) -> list[Row]:
    """Measure, print the tables, write the result file and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["CartPoleSoftWalls-v0", "CartPoleSoftWallsHard-v0"], metavar="ID")
    parser.add_argument("--states", type=int, default=200, help="of each environment")
    parser.add_argument("--jobs", type=int, default=1, help="global optima at a time, one thread each")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/relaxation.csv"))
    parser.add_argument("--picture", type=Path, default=Path("docs/images/relaxation.png"))
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    console = Console()
    rows: list[Row] = []
    for env_id in args.env:
        rows += (mine := measure(env_id, args.states, args.jobs))
        console.print(table_of(mine))
    write_rows(args.output, rows)
    picture(args.picture, rows)
    console.print(f"{args.output}, {args.picture}")
    return rows


if __name__ == "__main__":
    main()
