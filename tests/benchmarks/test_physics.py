"""The table of the engines' errors says what it measures."""

from __future__ import annotations

import csv
from pathlib import Path

from benchmarks import physics


def test_the_table_has_every_case_and_errors_that_fall_with_the_step(tmp_path: Path) -> None:
    physics.main(["--output", str(tmp_path / "physics.csv")])
    with (tmp_path / "physics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(physics.CASES) * len(physics.PHYSICS_STEPS) * 3
    for plant, case in physics.CASES:
        for engine in ("drake", "pybullet"):
            run = plant, case, engine, "exact"
            mine = [row for row in rows if (row["plant"], row["case"], row["engine"], row["against"]) == run]
            steps = [float(row["physics_step"]) for row in mine]
            errors = [float(row["velocity_2"]) for row in mine]
            assert steps == sorted(steps, reverse=True)
            assert errors == sorted(errors, reverse=True) and errors[-1] > 0.0
