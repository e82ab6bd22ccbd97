"""The table of what contact is worth says what it measures."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from benchmarks import contact_matters
from benchmarks.references import contact_env


def test_the_table_holds_both_scores_and_contact_decides_on_the_acrobot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contact_matters, "CASES", [(contact_matters.ACROBOT, {"reset_range": (0.1, 0.1, 0.2, 0.2)})])
    contact_matters.main(["--episodes", "4", "--output", str(tmp_path / "table.csv")])
    with (tmp_path / "table.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["env"] == contact_matters.ACROBOT
    assert row["changed"] == "reset_range=(0.1, 0.1, 0.2, 0.2)"
    assert float(row["lqr"]) < 0.5 * float(row["oracle"])
    assert float(row["oracle_lowest"]) > 0.75 * 6_000  # it falls in no episode


def test_a_changed_environment_leaves_the_registered_one_alone() -> None:
    spec = contact_matters.changed(contact_matters.ACROBOT, {"max_torque": 3.0})
    with contact_env(spec) as env, contact_env(contact_matters.ACROBOT) as registered:
        assert (env.max_force, registered.max_force) == (3.0, 10.0)
