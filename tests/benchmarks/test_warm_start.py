"""The comparison of first guesses runs on the same problems, and a plan's flags are moved on by one step."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from benchmarks import warm_start


def test_flags_are_moved_on_block_by_block() -> None:
    """Two steps of one action and two contacts: actions, forces, gaps."""
    flags = np.array([10, 20, 1, 2, 3, 4, 5, 6, 7, 8])
    np.testing.assert_array_equal(warm_start.moved_on(flags, 2, 1, 2), [20, 20, 3, 4, 3, 4, 7, 8, 7, 8])


def test_the_contact_mode_saves_iterations_and_the_table_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warm_start, "ENVIRONMENTS", ("CartPoleSoftWallsPyBullet-v0",))
    monkeypatch.setattr(warm_start, "HORIZONS", (5,))
    path = tmp_path / "warm.csv"
    warm_start.main(["--episodes", "2", "--steps", "10", "--output", str(path)])
    with path.open(newline="") as file:
        rows = {row["guess"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["none", "contact mode", "previous plan"]
    assert {row["problems"] for row in rows.values()} == {"20"}
    assert float(rows["contact mode"]["iterations_mean"]) < float(rows["none"]["iterations_mean"])
