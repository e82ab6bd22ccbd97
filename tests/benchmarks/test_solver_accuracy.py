"""The table of failures and accuracy says what it measures, and on a few problems meets the targets."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import solver_accuracy
from benchmarks.solver_accuracy import Row, gradient, row, structures
from benchmarks.solver_problems import Problems, cart_pole_problems
from sb3_mpc_policy.solvers import make_solver

# cvxpylayers' own, on NumPy 2
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Row], Path]:
    path = tmp_path_factory.mktemp("results") / "solver_accuracy.csv"
    arguments = ["--models", "45", "--states", "90", "--layers", "2", "--output", str(path)]
    return solver_accuracy.main(arguments), path


def test_no_solver_fails_and_every_solution_meets_the_optimality_conditions(results) -> None:
    rows, _ = results
    for family in ("training", "random"):
        for solver in ("auto", "torch"):
            mine = {one.quantity: one for one in rows if (one.family, one.solver) == (family, solver)}
            assert mine["failed"].problems >= 90
            assert mine["failed"].above == 0
            assert mine["kkt residual"].above == 0


def test_actions_and_gradients_are_those_of_the_references(results) -> None:
    rows, _ = results
    for solver in ("auto", "torch"):
        mine = {one.quantity: one for one in rows if (one.family, one.solver) == ("random", solver)}
        actions, derivative = mine["actions against the quadratic programme"], mine["gradient against differences"]
        assert (actions.problems, actions.above) == (45, 0)
        assert derivative.problems >= 40
        assert derivative.above == 0
    left_out = sum(one.above for one in rows if one.quantity.startswith("excluded"))
    assert derivative.problems + left_out == 45


def test_the_file_holds_the_rows(results) -> None:
    rows, path = results
    with path.open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["quantity"] for line in lines] == [one.quantity for one in rows]
    assert [int(line["above"]) for line in lines] == [one.above for one in rows]


def test_a_row_counts_what_is_above_its_limit_and_what_is_no_number() -> None:
    found = row("random", "daqp", "actions against another", [0.0, 1e-7, 1e-5, np.nan])
    assert (found.problems, found.above, found.share) == (4, 2, 0.5)
    assert found.median == 1e-7 or found.median == 1e-5
    assert found.largest == np.inf
    assert row("random", "daqp", "failed", np.array([False, True, False])).above == 1
    assert row("random", "daqp", "gradient of nothing", []).problems == 0


def test_random_models_come_in_every_number_of_contacts_and_a_wide_range_of_horizons() -> None:
    every = list(structures(1000, seed=0))
    assert len(every) == 1000
    assert {one.n_lambda for one in every} == set(range(9))
    assert {one.n_x for one in every} == set(range(2, 7))
    assert {one.n_a for one in every} == {1, 2, 3}
    assert min(one.horizon for one in every) <= 2 and max(one.horizon for one in every) >= 19


def test_a_wrong_derivative_is_seen() -> None:
    """One part in a thousand of one matrix."""
    problems = cart_pole_problems(n_contacts=2, horizon=5, batch=1)
    problems = Problems(problems.problem, 0.01 * np.ones((1, 4)), problems.weights)
    solver = make_solver("daqp")
    solution = solver.solve(*problems)
    cotangent = np.ones(solution.actions.shape)
    right = gradient(problems, solver, solution, cotangent)
    wrong = right | {"A": right["A"] * 1.001}
    rng = np.random.default_rng(0)
    errors = solver_accuracy._errors(problems, solution, cotangent, {"daqp": right, "wrong": wrong}, rng)
    assert errors is not None
    assert errors["daqp"] < 1e-6
    assert errors["wrong"] > 1e-4


def test_the_quadratic_programme_is_the_problem_and_not_one_beside_it() -> None:
    problems = cart_pole_problems(n_contacts=2, horizon=5, batch=1)
    solution = make_solver("torch").solve(*problems)
    statement = solver_accuracy.relaxed_problem(problems.problem)
    found = solver_accuracy.quadratic_programme(statement, problems)
    np.testing.assert_allclose(found, solution.actions[0], rtol=0, atol=1e-7)
    heavier = replace(problems.problem, stage_weight=2.0 * problems.problem.stage_weight)
    other = solver_accuracy.quadratic_programme(statement, problems._replace(problem=heavier))
    assert np.abs(other - found).max() > 1e-3
