"""Pictures of a training run: its learning curve, and an episode with the plans that were made in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from benchmarks.evaluation import SOLVED, Evaluation
from benchmarks.references import contact_env

INK, QUIET, LEARNED = "#23323d", "#8a97a0", "#0f7b8a"
REFERENCES = {"oracle": ("#c8553d", "-"), "LQR": ("#e0a458", "--"), "untrained": (QUIET, ":")}
"""Colour and line of each reference."""


def learning_curve(path: Path, evaluations: Sequence[Evaluation], references: Mapping[str, float], title: str) -> None:
    """Draw the score against training rollouts and against environment steps.

    Scores far below zero, as a fallen pole's can be, are drawn on the lower edge as triangles.

    :param path: of the PNG
    :param references: scores of "oracle" and any other of :data:`REFERENCES`
    """
    style: Any = {"font.size": 10, "axes.edgecolor": QUIET, "text.color": INK, "axes.labelcolor": INK}
    with matplotlib.rc_context(style | {"xtick.color": INK, "ytick.color": INK}):
        figure = Figure(figsize=(10, 4.4), dpi=150, layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        oracle = references["oracle"]
        scores = np.array([e.score for e in evaluations])
        low = max(min(scores.min(), *references.values(), 0.0), -0.25 * oracle) - 0.04 * oracle
        for axes, unit, label in (
            (left, [e.rollouts for e in evaluations], "training rollouts"),
            (right, [e.steps for e in evaluations], "environment steps"),
        ):
            _curve(axes, np.array(unit), scores, references, low)
            axes.set_xlabel(label)
        left.set_ylim(low, 1.06 * max(scores.max(), oracle))
        left.set_ylabel("return of the deterministic policy")
        handles, labels = left.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
        figure.suptitle(title, fontweight="bold")
        figure.savefig(path)


def _curve(axes: Axes, x: np.ndarray, scores: np.ndarray, references: Mapping[str, float], low: float) -> None:
    oracle = references["oracle"]
    label = f"at least {SOLVED:.0%} of the oracle"
    axes.axhspan(SOLVED * oracle, oracle, color=REFERENCES["oracle"][0], alpha=0.12, linewidth=0.0, label=label)
    for name, score in references.items():
        colour, line = REFERENCES[name]
        axes.axhline(score, color=colour, linestyle=line, linewidth=1.4, label=f"{name} {score:,.0f}")
    axes.plot(x, np.maximum(scores, low), color=LEARNED, linewidth=2.0, marker="o", markersize=4, label="PPO + MPC")
    off = scores < low
    if off.any():
        axes.plot(x[off], np.full(off.sum(), low), "v", color=LEARNED, markersize=8, clip_on=False)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=QUIET, alpha=0.25, linewidth=0.8)
    axes.yaxis.set_major_formatter("{x:,.0f}")


def rollout_animation(
    path: Path,
    env_id: str,
    plan: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    reset_seed: int,
    *,
    steps: int = 160,
    steps_per_frame: int = 2,
    milliseconds_per_frame: int = 50,
    width: int = 480,
) -> None:
    """Animate the beginning of an episode, each picture with the plan that was made in its state.

    By default two control steps, 20 ms, are shown for 50 ms: most of the motion is over in half a second.

    :param path: of the GIF
    :param plan: observation (n_x,) -> first action (n_a,) and planned states (H+1, n_x)
    :param reset_seed: of the episode
    :param steps: at most so many control steps
    :param width: of the pictures, pixels
    """
    frames = []
    with contact_env(env_id) as plant:
        observation, _ = plant.reset(seed=reset_seed)
        for step in range(steps):
            action, states = plan(observation)
            if step % steps_per_frame == 0:
                frames.append(_picture(plant.draw(plan_states=states), width))
            observation, _, terminated, _, _ = plant.step(action)
            if terminated:
                break
    # One palette for all pictures, from a few of them: nothing flickers, and unchanged pixels cost nothing.
    sample = np.concatenate([np.asarray(frame) for frame in frames[:: max(1, len(frames) // 8)]])
    palette = Image.fromarray(sample).quantize(96)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    indexed[0].save(
        path, save_all=True, append_images=indexed[1:], duration=milliseconds_per_frame, loop=0, optimize=True
    )


def _picture(pixels: np.ndarray, width: int) -> Image.Image:
    picture = Image.fromarray(pixels)
    return picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
