"""The picture of the learned gaps beside the true ones.

    python -m benchmarks.gap_picture

Trains on a cart-pole and draws each wall's gap over the cart's position and the pole's angle, all other states and
the action zero: the true model's, which is linearised about upright, and the learned one's. Gaps are in metres along
the cart's position. A wall is drawn with the contact that acts on its side; one without is missing.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from stable_baselines3 import PPO

from benchmarks import runs
from benchmarks.demo import ProgressCallback
from benchmarks.learned_contacts import reading, walls
from benchmarks.plots import INK, LEARNED, QUIET
from benchmarks.references import cart_pole
from contact_envs.plants import CartPoleParameters
from sb3_mpc_policy import MpcLcsPolicy
from sb3_mpc_policy.lcs import LcsMatrices, of_contacts

__all__ = ["Gap", "draw", "gaps", "in_contact"]

X, THETA = CartPoleParameters.POSITIONS
UNITS = ("m", "m/s", "rad", "rad/s")
"""Of the states."""
RANGE = 0.6
"""Of the picture, m and rad, to either side."""
COLOURS = (LEARNED, "#c8553d")
"""Of the right and the left wall."""
_LEVELS = (-0.6, -0.5, -0.4, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3)  # m, on the open side half of the way between the walls


class Gap(NamedTuple):
    """``slope_x x + slope_theta theta + offset``, metres along x: ``slope_x`` is plus or minus one."""

    slope_x: float
    slope_theta: float
    offset: float

    def __call__(self, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return self.slope_x * x + self.slope_theta * theta + self.offset

    def foot(self, level: float) -> tuple[float, float]:
        """The point (x, theta) of a level that is nearest to the origin."""
        share = (level - self.offset) / (self.slope_x**2 + self.slope_theta**2)
        return share * self.slope_x, share * self.slope_theta


def gaps(true: LcsMatrices[np.ndarray], model: LcsMatrices[np.ndarray], scale: np.ndarray) -> list[Gap | None]:
    """For each true wall the gap of the contact in a model that is most like it, None where no contact is.

    :param scale: (n_x,) of the states, to compare what contacts do
    """
    found: list[Gap | None] = []
    contacts = [of_contacts(model, np.array([k])) for k in range(len(model.c))]
    for wall in walls(true):
        stiffness = [reading(wall, walls(contact), scale)[1] for contact in contacts]
        if np.isnan(stiffness).all():  # also where there are no contacts
            found.append(None)
            continue
        best = int(np.nanargmax(stiffness))
        row, offset = model.D[best], model.c[best]
        found.append(Gap(*(float(value / abs(row[X])) for value in (row[X], row[THETA], offset))))
    return found


def in_contact(s: np.ndarray, s_next: np.ndarray, plant: CartPoleParameters) -> np.ndarray:
    """The transitions (N, n_x) that begin or end in contact -> the middle of each (n, n_x)."""
    touching = [(plant.contact_gaps(state) < 0.0).any(axis=1) for state in (s, s_next)]
    return ((s + s_next) / 2.0)[touching[0] | touching[1]]


def draw(
    path: Path,
    plant: CartPoleParameters,
    true: Sequence[Gap | None],
    learned: Sequence[Gap | None],
    touched: np.ndarray,
    title: str,
    subtitle: str,
) -> None:
    """Draw true and learned gaps side by side.

    :param path: of the PNG
    :param plant: for the walls as they are, of which the true gaps are the tangents
    :param true: of the right and the left wall, see :func:`gaps`
    :param learned: likewise
    :param touched: (n, n_x) states in contact that the model was learned from
    :param subtitle: of the learned gaps
    """
    style: Any = {
        "font.size": 10, "axes.edgecolor": QUIET, "text.color": INK, "axes.labelcolor": INK,
        "xtick.color": INK, "ytick.color": INK,
    }  # fmt: skip
    touched = touched[(np.abs(touched[:, [X, THETA]]) <= RANGE).all(axis=1)]
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(10, 5.6), dpi=150, layout="constrained")
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, wall_gaps, name in ((left, true, "true, linearised about upright"), (right, learned, subtitle)):
            _panel(axes, wall_gaps, plant)
            axes.set_title(name, fontsize=10, loc="left")
        dots: Any = {"color": INK, "linestyle": "", "marker": "o", "markersize": 4, "alpha": 0.7, "markeredgewidth": 0}
        right.plot(touched[:, X], touched[:, THETA], **dots)
        left.set_ylabel(r"pole's angle $\theta$, rad")
        handles = [
            *(Patch(facecolor=colour, alpha=0.4, label=f"{side} wall touched") for colour, side in
              zip(COLOURS, ("right", "left"), strict=True)),
            Line2D([], [], color=INK, linewidth=2.5, label="zero of the gap"),
            Line2D([], [], color=INK, linestyle="--", linewidth=1.0, label="wall as it is"),
            Line2D([], [], **dots, label=f"{len(touched)} transitions in contact"),
        ]  # fmt: skip
        figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
        figure.suptitle(title, fontweight="bold")
        path.parent.mkdir(parents=True, exist_ok=True)
        drawn = io.BytesIO()
        figure.savefig(drawn)
    with Image.open(drawn) as picture:  # a palette makes a small file
        picture.convert("RGB").quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def _panel(axes: Axes, wall_gaps: Sequence[Gap | None], plant: CartPoleParameters) -> None:
    x, theta = np.meshgrid(*2 * [np.linspace(-RANGE, RANGE, 121)])
    state = np.zeros((*x.shape, len(plant.STATE)))
    state[..., X], state[..., THETA] = x, theta
    for gap, colour in zip(wall_gaps, COLOURS, strict=True):
        if gap is None:
            continue
        values = gap(x, theta)
        axes.contourf(x, theta, values, levels=[min(values.min(), 0.0) - 1.0, 0.0], colors=[colour], alpha=0.15)
        for levels, width in ((_LEVELS, 0.7), ((0.0,), 2.5)):
            seen = [level for level in levels if values.min() < level < values.max()]
            lines = axes.contour(x, theta, values, seen, colors=[colour], linewidths=width, linestyles="-")
            feet = [gap.foot(level) for level in seen if level]
            inside = [point for point in feet if np.abs(point).max() <= RANGE]
            axes.clabel(lines, fmt=lambda level: f"{level:+.1f} m", fontsize=8, manual=inside)
    exact = plant.contact_gaps(state)
    for k in range(exact.shape[-1]):
        axes.contour(x, theta, exact[..., k], levels=[0.0], colors=[INK], linestyles="--", linewidths=1.0)
    axes.set_aspect("equal")
    axes.set_xlabel("cart's position x, m")
    axes.spines[["top", "right"]].set_visible(False)


# -- the command -----------------------------------------------------------------------------------------------------


def arguments(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="CartPoleSoftWallsHardPyBullet-v0", metavar="ID", help="a cart-pole")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=5_120, help="environment steps of training")
    parser.add_argument("--model", type=Path, metavar="FILE.zip", help="draw this one, and train none")
    parser.add_argument("--output", type=Path, default=Path("docs/images/learned_gaps.png"))
    return parser.parse_args(argv)


def _trained(env_id: str, seed: int, steps: int, console: Console) -> PPO:
    columns = (TextColumn("training"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("training", total=steps)
        return runs.train(env_id, runs.settings_for(env_id, {}), seed, steps, [ProgressCallback(progress, bar, steps)])


def main(argv: Sequence[str] | None = None) -> None:
    """Draw the picture from the command line, and say in words what is learned."""
    args = arguments(argv)
    console = Console()
    with cart_pole(args.env) as env:
        true, plant = LcsMatrices(*env.true_lcs()), env.parameters
    model = PPO.load(args.model, device="cpu") if args.model else _trained(args.env, args.seed, args.steps, console)
    policy = model.policy
    if not isinstance(policy, MpcLcsPolicy):
        raise TypeError(f"--model must name the file of an MpcLcsPolicy, got that of {type(policy).__name__}")
    lcs, data = policy.lcs, policy.store.everything()
    learned = LcsMatrices(*(matrix.detach().cpu().numpy() for matrix in lcs.matrices()))
    scale = lcs.state_scale.cpu().numpy()
    draw(
        args.output,
        plant,
        gaps(true, true, scale),
        gaps(true, learned, scale),
        in_contact(data.s, data.s_next, plant),
        f"Gaps between pole and walls, {args.env}",
        f"learned in {model.num_timesteps:,} steps",
    )
    console.print(lcs.describe(list(zip(plant.STATE, UNITS, strict=True)), [("force", "")]), soft_wrap=True)
    console.print(f"picture in {args.output}")


if __name__ == "__main__":
    main()
