"""Settings by name, result files, and what the summary makes of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import console, runs
from benchmarks.runs import Row

ENV_ID = "CartPoleSoftWallsPyBullet-v0"


def rows(variant: str, seed: int, *scores: float) -> list[Row]:
    """A run with these scores, one evaluation every 128 steps and 3 episodes, against an oracle of 1000."""
    return [Row(ENV_ID, variant, seed, 128 * i, 3 * i, 0.5 * i, s, 1000.0) for i, s in enumerate(scores)]


def test_assignments_become_nested_settings() -> None:
    changes = runs.parsed_changes(["learning_rate=1e-3", "policy_kwargs.horizon=20", "policy_kwargs.solver=daqp"])
    assert changes == {"learning_rate": 1e-3, "policy_kwargs": {"horizon": 20, "solver": "daqp"}}


@pytest.mark.parametrize("assignment", ["horizon", "=3", "policy_kwargs.=3"])
def test_an_assignment_without_a_name_or_value_is_refused(assignment: str) -> None:
    with pytest.raises(ValueError, match="name=value"):
        runs.parsed_changes([assignment])


def test_changes_are_merged_key_by_key_and_leave_the_original_alone() -> None:
    settings = {"n_steps": 64, "policy_kwargs": {"horizon": 10, "n_contacts": 2}}
    changed = runs.changed(settings, {"policy_kwargs": {"n_contacts": 0}, "seed": 1})
    assert changed == {"n_steps": 64, "policy_kwargs": {"horizon": 10, "n_contacts": 0}, "seed": 1}
    assert settings["policy_kwargs"]["n_contacts"] == 2


def test_tuned_settings_are_for_the_mpc_policy_only() -> None:
    assert runs.settings_for(ENV_ID, {"policy": "MlpPolicy"}) == {"device": "cpu", "policy": "MlpPolicy"}
    tuned = runs.settings_for(ENV_ID, {})
    assert tuned["policy"] == "MpcLcsPolicy" and "n_steps" in tuned


def test_a_result_file_reads_back_as_it_was_written(tmp_path: Path) -> None:
    written = rows("tuned", 1, 10.0, 960.25) + rows("tuned", 0, -12_345.5)
    runs.write_rows(tmp_path / "new" / "runs.csv", written)
    assert runs.read_rows(tmp_path / "new" / "runs.csv") == sorted(written)


def test_verdicts_judge_each_run_by_itself() -> None:
    verdicts = console.verdicts(rows("a", 0, 0, 960, 940, 910) + rows("a", 1, 990, 100, 990) + rows("b", 0, 0, 500))
    assert verdicts[ENV_ID, "a", 0] == console.Verdict(3, 128, 0.5, True, 910, 910)
    assert verdicts[ENV_ID, "a", 1] == console.Verdict(0, 0, 0.0, False, 990, 100)
    assert verdicts[ENV_ID, "b", 0] == console.Verdict(None, None, None, False, 500, None)


def test_an_unsolved_run_counts_as_later_than_every_solved_one() -> None:
    """Rollouts to solve of 3, 6 and never: the median is 6, not the 4.5 of those that made it."""
    table = console.summary(rows("a", 0, 0, 990) + rows("a", 1, 0, 0, 990) + rows("a", 2, 0, 0, 0))
    cells = {column.header: list(column.cells)[-1] for column in table.columns}
    assert cells["seed"] == "median"
    assert cells["solved"] == "2/3"
    assert cells["rollouts"] == "6"
