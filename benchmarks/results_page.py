"""Makes docs/results.md and its pictures from the result files, without running anything.

    python -m benchmarks.results_page

The words are those of ``results_page.md``; ``{{table: solve}}`` and ``{{figure: learning}}`` in it stand for entries of
:data:`TABLES` and :data:`FIGURES`. What was not run is said, and left out. So is a file that is damaged, and the
command then ends with status 1.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks import experiments, figures, tables
from benchmarks.aggregates import across_tasks, iqm, profile
from benchmarks.figures import Curve, Dots, Look, Panel
from benchmarks.plots import INK, LEARNED, QUIET
from benchmarks.reading import Results
from benchmarks.store import RESULTS
from benchmarks.summary import Row, curve

TEMPLATE = Path(__file__).with_name("results_page.md")
PAGE = "results.md"
NOTICE = "<!-- Made by `python -m benchmarks.results_page`; the words are in benchmarks/results_page.md. -->\n\n"

# Rows of the table of experiments, by patterns as `benchmarks.run --only` takes them.
EASY = (
    "mpc/easy/*", "mpc-paper/easy/*", "baseline/ppo-defaults/easy/*", "baseline/ppo-tuned-v?/easy/*",
    "baseline/sac/easy/*", "baseline/tqc/easy/*", "baseline/crossq/easy/*",
)  # fmt: skip
PPO_BASELINES = ("baseline/ppo-defaults", "baseline/ppo-tuned-v1", "baseline/ppo-tuned-v0")
CONTACT = ("mpc/hard/*", "mpc/acrobot/*", "baseline/*/hard/*", "baseline/*/acrobot/*")
OLDER = ("learned_contacts", "learned_contacts_linear", "learned_contacts_drake")
LONG = ("mpc-long/*", "baseline/*-long/*")
ABLATION = ("ablation/*",)
ACROSS = {"mpc": ("mpc/*",), "baseline/ppo-defaults": ("baseline/ppo-defaults/*",)}
"""The learners that are compared across tasks, and all of their rows."""

TITLES = {
    "easy/drake": "cart-pole, ±100 N, Drake", "easy/pybullet": "cart-pole, ±100 N, PyBullet",
    "hard/drake": "cart-pole, ±10 N, Drake", "hard/pybullet": "cart-pole, ±10 N, PyBullet",
    "acrobot/drake": "acrobot, Drake", "acrobot/pybullet": "acrobot, PyBullet",
}  # fmt: skip
LOOKS = {
    "mpc": Look("PPO + MPC", LEARNED, width=2.4),
    "mpc-long": Look("PPO + MPC, long", LEARNED, width=2.4),
    "mpc-paper": Look("PPO + MPC, Algorithm 1", "#7b5ea7", width=1.8),
    "baseline/ppo-defaults": Look("PPO, network", INK, width=1.8),
    "baseline/ppo-defaults-long": Look("PPO, network, long", INK, width=1.8),
    "baseline/ppo-tuned-v1": Look("PPO, network, tuned v1", QUIET),
    "baseline/ppo-tuned-v0": Look("PPO, network, tuned v0", QUIET, ":"),
    "baseline/sac": Look("SAC", "#6b8f3a"),
    "baseline/tqc": Look("TQC", "#b0689c"),
    "baseline/crossq": Look("CrossQ", "#3f77b5", "--"),
}
START = {"rollouts": ("training rollouts", 0.5), "steps": ("environment steps", 64.0)}
"""Names of the units of time, and what stands for zero on a logarithmic axis."""


def learner(name: str) -> str:
    """A row's name without its task and engine."""
    return name.rsplit("/", 2)[0]


def task(name: str) -> str:
    """A row's task and engine, ``easy/drake``."""
    return "/".join(name.rsplit("/", 2)[1:])


def look(name: str) -> Look:
    """How a row is drawn."""
    return LOOKS.get(learner(name), Look(name, QUIET))


# -- tables: what they show, or None if nothing of it was run --


def _solve(results: Results) -> str | None:
    rows = results.rows(results.names(EASY))
    return tables.solve(rows) if rows else None


def _ratios(results: Results) -> str | None:
    pairs = {}
    for name in results.names(["mpc/easy/*"]):
        ours = results.row(name)
        if ours is not None:
            baselines = results.rows([f"{baseline}/{task(name)}" for baseline in PPO_BASELINES])
            pairs[TITLES.get(task(name), task(name))] = (ours, baselines)
    return tables.ratios(pairs) if pairs else None


def _contact(results: Results) -> str | None:
    older = [row for row in map(results.older, OLDER) if row is not None]
    rows = [*results.rows(results.names(CONTACT)), *older]
    return tables.solve(rows) if rows else None


def _final(results: Results) -> str | None:
    rows = results.rows(results.names(LONG))
    return tables.final(rows) if rows else None


def _across(results: Results) -> str | None:
    scores = _scores_across(results)
    if not scores:
        return None
    means = {LOOKS[name].label: mean for name, mean in iqm(scores).items()}
    return tables.across(means, {LOOKS[name].label: matrix.shape for name, matrix in scores.items()})


def _scores_across(results: Results) -> dict[str, np.ndarray]:
    """Learner -> (n_seeds, n_tasks), the tasks being those that all of them were run in."""
    known = {name: {task(row.name): row for row in results.rows(results.names(of))} for name, of in ACROSS.items()}
    shared = [each for each in known["mpc"] if all(each in rows for rows in known.values())]
    found = {name: across_tasks([rows[each] for each in shared]) for name, rows in known.items()}
    return {name: scores for name, scores in found.items() if scores is not None}


def _parts(results: Results) -> str | None:
    rows = {_change(row.name): row for row in results.rows(results.names(ABLATION))}
    return tables.parts(rows) if rows else None


def _change(name: str) -> str:
    """What ``ablation/gradient-alpha-10`` changes, in words."""
    label = name.removeprefix("ablation/").replace("1e-", "1e−").replace("-", " ")
    return "as tuned" if label == "none" else label


def _probe(name: str, table: Callable[[Mapping], str]) -> Callable[[Results], str | None]:
    def made(results: Results) -> str | None:
        found = {row: results.probe(row, name) for row in results.probed(name)}
        found = {row: lines for row, lines in found.items() if lines}
        return table(found) if found else None

    return made


def _rival(results: Results) -> str | None:
    lines = results.lines("rivals_pets", seed=int, steps=int, rollouts=int, seconds=float, score=float)
    return tables.rival(lines, results.row("mpc/easy/pybullet")) if lines else None


def _machines(results: Results) -> str | None:
    rows = results.rows([experiment.name for experiment in results.table])
    return tables.machines([run for row in rows for run in row.finished]) if rows else None


# -- figures: whether they were drawn --


def _learning(patterns: Sequence[str], lowest: float) -> Callable[[Results, Path], bool]:
    def draw(results: Results, path: Path) -> bool:
        rows = results.rows(results.names(patterns))
        tasks = dict.fromkeys(task(row.name) for row in rows)
        panels = [[_panel([row for row in rows if task(row.name) == each], unit) for unit in START] for each in tasks]
        if panels:
            figures.learning(path, panels, lowest)
        return bool(panels)

    return draw


def _panel(rows: Sequence[Row], unit: str) -> Panel:
    name, start = START[unit]
    curves = [Curve(look(row.name), *curve(row, unit, start)) for row in rows]
    title = TITLES.get(task(rows[0].name), task(rows[0].name))
    most = max(rows, key=lambda row: row.name.startswith("mpc"))  # scored on most episodes
    return Panel(title, name, start, most.oracle, most.lqr, curves)


def _draw_across(results: Results, path: Path) -> bool:
    scores = _scores_across(results)
    if scores:
        thresholds = np.linspace(0.0, 1.05, 106)
        figures.aggregates(path, iqm(scores), profile(scores, thresholds), thresholds, LOOKS)
    return bool(scores)


def _draw_parts(results: Results, path: Path) -> bool:
    rows = results.rows(results.names(ABLATION))
    if rows:
        shown = [Dots(_change(row.name), row.final / row.oracle, row.best / row.oracle) for row in rows]
        figures.dots(path, shown, rows[0].lqr / rows[0].oracle)
    return bool(rows)


EPISODE = {"state 0": "cart, m", "state 2": "pole's angle, rad", "reward": "reward of a step"}
"""What is drawn of an episode of the cart-pole."""
STEP = 0.01
"""Seconds of a control step."""


def _draw_episode(results: Results, path: Path) -> bool:
    controllers = []
    for row in results.rows(results.probed("episode")):
        lines = results.probe(row.name, "episode") if row.env.startswith("CartPole") else []
        if lines:
            of_first = [line for line in lines if line["seed"] == lines[0]["seed"]]
            found = {name: [line for line in of_first if line["quantity"] == name] for name in EPISODE}
            times = STEP * np.array([line["step"] for line in found["reward"]], dtype=float)
            values = np.array([[line["value"] for line in found[name]] for name in EPISODE], dtype=float)
            controllers.append((look(row.name), times, values))
    if controllers:
        figures.episodes(path, list(EPISODE.values()), controllers)
    return bool(controllers)


def _draw_robustness(results: Results, path: Path) -> bool:
    known = results.lines(
        "robustness_references", env=str, controller=str, change=str, amount=float, quantity=str, value=float
    )
    panels: dict[str, Scores] = {}
    for row in results.rows(results.probed("robustness")):
        lines = results.probe(row.name, "robustness")
        if lines:
            scores = panels.setdefault(row.env, {})
            for line in lines:
                _add(scores, look(row.name).label, line)
    for env, scores in panels.items():
        for line in known:
            if line["env"] == env:
                _add(scores, CONTROLLERS[str(line["controller"])], line)
    titles = {row.env: TITLES.get(task(row.name), row.env) for row in results.rows(results.probed("robustness"))}
    if panels:
        figures.heat_maps(path, {titles[env]: _shares(scores) for env, scores in panels.items()})
    return bool(panels)


Scores = dict[tuple[str, str, float], list[float]]
"""By controller, change and amount; one a seed."""
CONTROLLERS = {"oracle": "oracle", "lqr": "LQR", "informed oracle": "informed oracle"}


def _add(scores: Scores, controller: str, line: Mapping[str, str | float]) -> None:
    if line["quantity"] == "score":
        key = controller, str(line["change"]), float(line["amount"])
        scores.setdefault(key, []).append(float(line["value"]))


def _shares(scores: Scores) -> tuple[list[str], list[str], np.ndarray]:
    """Changes, controllers, and medians over seeds as shares of the oracle's score where nothing is changed."""
    controllers, changes = list(dict.fromkeys(key[0] for key in scores)), list(dict.fromkeys(key[1:] for key in scores))
    whole = np.median(scores.get(("oracle", "nothing", 0.0), [np.nan]))
    shares = [[np.median(scores.get((name, *change), [np.nan])) / whole for name in controllers] for change in changes]
    return [_amount(*change) for change in changes], controllers, np.array(shares)


def _amount(change: str, amount: float) -> str:
    """What is changed, and by how much, in words."""
    if change == "nothing":
        return "no change"
    if "stiffness" in change:
        return f"{change} {amount:,.0f}"
    return {"noise": f"noise {100.0 * amount:.1f} %", "delay": f"delay {amount:.0f} step"}.get(
        change, f"{change} {100.0 * amount:.0f} %"
    )


# -- the page --


class Source(NamedTuple):
    """The rows that something is made of, and the command that runs them."""

    patterns: Sequence[str] = ()
    probe: str = ""
    """In place of patterns: the rows that it is asked of."""
    command: str = ""
    """In place of `benchmarks.run`."""

    def rows(self, results: Results) -> list[str]:
        """Their names."""
        return results.probed(self.probe) if self.probe else results.names(self.patterns)

    def line(self, results: Results) -> str:
        """How it is made, and what is missing."""
        names = self.rows(results)
        only = " ".join(f"'{pattern}'" for pattern in (names if self.probe else self.patterns))
        text = f"`{self.command or f'python -m benchmarks.run --only {only}'}`"
        known = results.rows(names)
        if known:
            seeds = _range([len(row.evaluations) for row in known], "seed")
            text += f", {seeds} of {_range([row.steps for row in known], 'step')}"
        missing = [name for name in names if results.row(name) is None]
        if missing:
            text += ". Not run: " + ", ".join(f"`{name}`" for name in missing)
        return text + "."


def _range(numbers: Sequence[int], unit: str) -> str:
    """The smallest and the largest."""
    low, high = (tables.number(f(numbers)) for f in (min, max))
    return f"{low} {unit}{'s' * (numbers[0] != 1)}" if low == high else f"{low} to {high} {unit}s"


ACROSS_ALL = [pattern for patterns in ACROSS.values() for pattern in patterns]
PETS = "python -m benchmarks.rivals.pets --output benchmarks/results/rivals_pets.csv"

TABLES: dict[str, tuple[Callable[[Results], str | None], Source | None]] = {
    "solve": (_solve, Source(EASY)),
    "ratios": (_ratios, Source(["mpc/easy/*", *(f"{each}/easy/*" for each in PPO_BASELINES)])),
    "contact": (_contact, Source(CONTACT)),
    "final": (_final, Source(LONG)),
    "across": (_across, Source(ACROSS_ALL)),
    "parts": (_parts, Source(ABLATION)),
    "predictions": (_probe("model_quality", tables.predictions), Source(probe="model_quality")),
    "matrices": (_probe("model_quality", tables.matrices), Source(probe="model_quality")),
    "reuse": (_probe("reuse", tables.tasks), Source(probe="reuse")),
    "rival": (_rival, Source(command=PETS)),
    "machines": (_machines, None),
}
"""Name -> what makes it, None where nothing of it was run; and its source, if that is to be said."""

FIGURES: dict[str, tuple[Callable[[Results, Path], bool], str, Source]] = {
    "learning": (_learning(EASY, -0.25), "score against training rollouts and environment steps", Source(EASY)),
    "contact": (_learning(CONTACT, -0.25), "the same where contact decides", Source(CONTACT)),
    "final": (_learning(LONG, 0.9), "score in long runs", Source(LONG)),
    "episode": (_draw_episode, "an episode of two policies", Source(probe="episode")),
    "across": (_draw_across, "interquartile means and performance profiles", Source(ACROSS_ALL)),
    "parts": (_draw_parts, "scores of runs with one change", Source(ABLATION)),
    "robustness": (_draw_robustness, "what is left of the score under changes", Source(probe="robustness")),
}
"""Name -> what draws it, and whether it did; what it shows; its source."""

_PLACEHOLDER = re.compile(r"\{\{(.*?)\}\}")


def page(results: Results, folder: Path, template: str) -> str:
    """The page, its pictures drawn.

    :param results: what there is
    :param folder: where the page will be; pictures go into its ``images/``
    :param template: words with placeholders
    :raises ValueError: an unknown placeholder
    """
    said: list[Source] = []

    def filled(match: re.Match[str]) -> str:
        kind, _, name = match[1].partition(": ")
        if kind == "table" and name in TABLES:
            table, source = TABLES[name]
            made, shown = table(results), source
        elif kind == "figure" and name in FIGURES:
            draw, alt, shown = FIGURES[name]
            path = Path("images") / f"results_{name}.png"
            made = f"![{alt}]({path.as_posix()})" if draw(results, folder / path) else None
        else:
            known = [*(f"table: {each}" for each in TABLES), *(f"figure: {each}" for each in FIGURES)]
            raise ValueError(f"placeholders must be among {', '.join(known)}, got {match[1]!r}")
        parts = [made or "*Not run.*"]
        if shown is not None and shown not in said:  # once, below the first of what is made of it
            parts.append(shown.line(results))
            said.append(shown)
        return "\n\n".join(parts)

    return NOTICE + _PLACEHOLDER.sub(filled, template)


def main(argv: Sequence[str] | None = None) -> int:
    """Make the page from the command line.

    :return: the exit status
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--results", type=Path, default=RESULTS, metavar="DIR",
        help=f"folder of the runs, {RESULTS} without it; what other commands write is looked for in the one above",
    )  # fmt: skip
    parser.add_argument("--output", type=Path, default=Path("docs"), metavar="DIR", help="folder of the page")
    parser.add_argument("--table", type=Path, default=experiments.TABLE, metavar="FILE", help="of experiments")
    args = parser.parse_args(argv)
    try:
        results = Results(args.results, experiments.read_table(args.table))
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    text = page(results, args.output, TEMPLATE.read_text(encoding="utf-8"))
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / PAGE).write_text(text, encoding="utf-8")
    print(f"{args.output / PAGE}")
    for problem in results.problems:
        print(f"left out: {problem}", file=sys.stderr)
    return 1 if results.problems else 0


if __name__ == "__main__":
    sys.exit(main())
