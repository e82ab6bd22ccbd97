"""The demo leaves what it promises."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from stable_baselines3 import PPO

from benchmarks import demo
from benchmarks.evaluation import RESET_SEEDS, Evaluation
from benchmarks.plots import learning_curve

ENV_ID = "CartPoleSoftWallsPyBullet-v0"


@pytest.mark.slow
def test_the_demo_leaves_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo.main(f"--env {ENV_ID} --steps 128 --output {tmp_path / 'demo'}".split())
    files = {file.name for file in (tmp_path / "demo").iterdir()}
    assert files == {"learning_curve.png", "rollout.gif", "scores.csv", "mpc.zip"}
    with (tmp_path / "demo" / "scores.csv").open() as file:
        scores = {line["controller"]: float(line["score"]) for line in csv.DictReader(file)}
    assert list(scores) == ["oracle", "LQR", "untrained", "learned"]
    with Image.open(tmp_path / "demo" / "rollout.gif") as picture:
        assert picture.n_frames > 1
    assert (tmp_path / "demo" / "rollout.gif").stat().st_size < 2_000_000
    assert PPO.load(tmp_path / "demo" / "mpc.zip").policy.plan(np.zeros(4)).actions.shape[0] == 1
    assert "learning_curve.png" in capsys.readouterr().out


def test_the_animated_episode_is_one_of_the_scored_ones() -> None:
    assert demo.liveliest_episode(ENV_ID) in RESET_SEEDS


@pytest.mark.parametrize("scores", [[700, 5_700, 5_750], [-9_000, -40_000, 5_000]], ids=["good", "off the scale"])
def test_learning_curve_fills_its_picture(tmp_path: Path, scores: list[float]) -> None:
    """Both panels have room: the darkest columns, the two vertical axes, are half a picture apart."""
    evaluations = [Evaluation(128 * i, i, 1.0, score) for i, score in enumerate(scores)]
    learning_curve(tmp_path / "curve.png", evaluations, {"oracle": 5_780.0, "untrained": scores[0]}, "title")
    with Image.open(tmp_path / "curve.png") as picture:
        grey = np.asarray(picture.convert("L"))
    axes = np.flatnonzero((grey[100:500] < 200).mean(axis=0) > 0.95)
    assert len(axes) and 0.4 < (axes.max() - axes.min()) / grey.shape[1] < 0.6
