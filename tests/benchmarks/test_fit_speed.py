"""Fits are timed once a rollout."""

from __future__ import annotations

import csv
from pathlib import Path

from benchmarks.fit_speed import HEADER, main


def test_each_rollout_has_a_line(tmp_path: Path) -> None:
    output = tmp_path / "fit_speed.csv"
    lines = main(["--steps", "192", "--output", str(output)])
    assert [line[2] for line in lines] == [64, 128, 192]
    assert all(float(str(line[3])) > 0.0 for line in lines)
    with output.open(newline="") as file:
        assert next(csv.reader(file)) == HEADER
