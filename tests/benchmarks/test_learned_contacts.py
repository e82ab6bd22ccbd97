"""Walls are read out of a model as they are in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.learned_contacts import ContactTransitions, Reading, main, reading, walls
from benchmarks.references import contact_env
from benchmarks.runs import read_rows
from sb3_mpc_policy import LinearComplementaritySystem
from sb3_mpc_policy.lcs import LcsMatrices

ENV = "CartPoleSoftWallsHardPyBullet-v0"
SCALE = np.array([0.35, 1.0, 0.3, 1.0])


@pytest.fixture(scope="module")
def true() -> LcsMatrices[np.ndarray]:
    with contact_env(ENV) as plant:
        return LcsMatrices(*plant.true_lcs())


def test_the_true_walls_stand_where_they_were_built(true: LcsMatrices[np.ndarray]) -> None:
    assert sorted(wall.position for wall in walls(true)) == pytest.approx([-0.35, 0.35])


def test_the_effect_is_what_a_step_does_beyond_the_wall(true: LcsMatrices[np.ndarray]) -> None:
    lcs = LinearComplementaritySystem.from_matrices(*true)
    free = LinearComplementaritySystem.from_matrices(*true._replace(C=0.0 * true.C))
    s, a = np.array([[0.36, 0.0, 0.0, 0.0]]), np.zeros((1, 1))
    push = (lcs.step(s, a) - free.step(s, a)).detach().numpy()[0]
    right = max(walls(true), key=lambda wall: wall.position)
    np.testing.assert_allclose(push / 0.01, -right.effect, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("unit", [0.01, 1.0, 30.0])
def test_a_wall_of_half_the_stiffness_reads_a_half_whatever_the_unit_of_gaps(
    true: LcsMatrices[np.ndarray], unit: float
) -> None:
    softer = true._replace(C=0.5 * true.C / unit, D=unit * true.D, E=unit * true.E, c=unit * true.c)
    for wall in walls(true):
        position, stiffness = reading(wall, walls(softer), SCALE)
        assert position == pytest.approx(wall.position)
        assert stiffness == pytest.approx(0.5)


def test_a_wall_that_was_not_found_has_no_reading(true: LcsMatrices[np.ndarray]) -> None:
    left, right = sorted(walls(true), key=lambda wall: wall.position)
    assert np.isnan(reading(left, [right], SCALE)).all()
    assert np.isnan(reading(left, [], SCALE)).all()


def test_a_contact_that_pushes_nothing_is_no_wall(true: LcsMatrices[np.ndarray]) -> None:
    assert walls(true._replace(C=0.0 * true.C)) == []


def test_the_true_model_predicts_contact_better_than_one_without(true: LcsMatrices[np.ndarray]) -> None:
    test = ContactTransitions(ENV)
    assert len(test.s) > 100
    blind = true._replace(C=0.0 * true.C)
    with_contacts, without = (test.error(LinearComplementaritySystem.from_matrices(*model)) for model in (true, blind))
    assert with_contacts < 0.2 * without


def test_runs_leave_evaluations_and_readings(tmp_path: Path) -> None:
    output = tmp_path / "learned.csv"
    run = ["--variant", "tuned", "linear", "--seeds", "0", "--steps", "64", "--episodes", "1"]
    rows, readings = main([*run, "--output", str(output)])
    assert {row.variant for row in rows} == {"tuned", "linear"}
    assert read_rows(output) == sorted(row._replace(seconds=round(row.seconds, 2), score=round(row.score, 2),
                                                    oracle=round(row.oracle, 2)) for row in rows)  # fmt: skip
    assert {line.steps for line in readings} == {0, 64}
    assert (tmp_path / "learned_walls.csv").read_text().splitlines()[0] == ",".join(Reading._fields)
