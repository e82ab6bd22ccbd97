"""The rivals solve the same problems, and the benchmark says what it measured and what it did not."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import policy_speed, solver_speed
from benchmarks.policy_speed import Stopwatch, TimedSolver
from benchmarks.rivals import RIVALS, Rival, missing_package
from benchmarks.rivals.base import ForwardRival
from benchmarks.solver_problems import Problems, cart_pole_lcs, cart_pole_problems, published_problems
from benchmarks.solver_speed import Row
from benchmarks.solver_timing import gradient, measure, peak_memory, reference
from contact_envs.dynamics import true_lcs
from sb3_mpc_policy import LinearComplementaritySystem
from sb3_mpc_policy.solvers import kkt_residual, make_solver

# cvxpylayers' own, on NumPy 2
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

# Of an action in [-1, 1]. Where the cost is flat an action is known to the root of a tolerance of 1e-8 only; the layer
# solves a cone programme, at that tolerance, and qpth goes on to the end.
ACTION_ERROR = {"qpth": 1e-6, "proxqp": 1e-4, "proxqp-warm": 1e-4}
DEFAULT_ACTION_ERROR = 1e-2
INSTALLED = [
    pytest.param(name, marks=pytest.mark.skipif(missing_package(name) is not None, reason="not installed"))
    for name in RIVALS
]


def small_problems(n_contacts: int) -> Problems:
    """A few of each kind: no contacts, the environment's walls, more walls, more inputs."""
    return published_problems(6, horizon=8) if n_contacts < 0 else cart_pole_problems(n_contacts, 8, 6)


# -- the problems --


def test_two_contacts_are_the_environments_own_walls():
    for ours, theirs in zip(cart_pole_lcs(2), true_lcs(None, 0.01, 10.0), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("n_contacts", [0, 2, 4])
def test_walls_out_of_reach_change_nothing(n_contacts):
    """The models with more walls move as those with fewer, where none of the further walls is touched."""
    fewer, more = (LinearComplementaritySystem.from_matrices(*cart_pole_lcs(n)) for n in (n_contacts, 8))
    rng = np.random.default_rng(0)
    s, a = rng.uniform(-0.3, 0.3, (200, 4)), rng.uniform(-1.0, 1.0, (200, 1))
    forces = more.contact_force(s, a).detach().numpy()
    clear = (forces[:, n_contacts:] == 0.0).all(axis=1)
    assert clear.sum() > 20 and (not n_contacts or forces[clear, :n_contacts].any())
    np.testing.assert_allclose(more.step(s, a).detach()[clear], fewer.step(s, a).detach()[clear], atol=1e-12)


@pytest.mark.parametrize("n_contacts", [1, -2, 10])
def test_walls_come_in_pairs(n_contacts):
    with pytest.raises(ValueError, match="n_contacts"):
        cart_pole_lcs(n_contacts)


def test_the_problems_are_hard_enough():
    """Contacts closed and open, bounds hit and not: else the active-set method has nothing to do."""
    for n_contacts in (2, 4, 8):
        problems = cart_pole_problems(n_contacts, 10, 64)
        found = make_solver("daqp").solve(*problems)
        assert (found.forces > 1e-6).any(axis=(0, 1)).all()
        assert 0.1 < (np.abs(found.actions) > 1 - 1e-9).mean() < 0.9
    found = make_solver("daqp").solve(*published_problems(64))
    assert 0.01 < (np.abs(found.actions) > 1 - 1e-9).mean() < 0.9


# -- the rivals --


@pytest.mark.parametrize("n_contacts", [-1, 0, 2, 4])
@pytest.mark.parametrize("name", INSTALLED)
def test_a_rival_finds_the_plan_of_the_active_set_method(name, n_contacts):
    problems = small_problems(n_contacts)
    found = RIVALS[name].make().solve(*problems)
    expected = make_solver("daqp").solve(*problems)
    assert found.solved.all()
    tolerance = ACTION_ERROR.get(name, DEFAULT_ACTION_ERROR)
    np.testing.assert_allclose(found.actions, expected.actions, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(found.states, expected.states, rtol=0.0, atol=100 * tolerance)
    np.testing.assert_allclose(found.gaps, expected.gaps, rtol=0.0, atol=100 * tolerance)
    assert kkt_residual(*problems, found).max() < 1e-3


@pytest.mark.parametrize("name", INSTALLED)
def test_a_rivals_multipliers_are_those_of_the_problem_without_states(name):
    problems = cart_pole_problems(4, 8, 6)
    found = RIVALS[name].make().solve(*problems)
    if found.multipliers is None:
        pytest.skip("it gives none")
    expected = make_solver("daqp").solve(*problems).multipliers
    np.testing.assert_allclose(found.multipliers, expected, rtol=0.0, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("name", INSTALLED)
def test_a_rival_solves_for_the_model_it_is_given_last(name):
    solver = RIVALS[name].make()
    first, second = cart_pole_problems(2, 8, 4), cart_pole_problems(2, 8, 4)
    changed = second.problem.model._replace(A=second.problem.model.A * 1.05)
    second = second._replace(problem=dataclasses.replace(second.problem, model=changed))
    solver.solve(*first)
    found = solver.solve(*second).actions
    np.testing.assert_allclose(
        found, make_solver("daqp").solve(*second).actions, atol=ACTION_ERROR.get(name, DEFAULT_ACTION_ERROR)
    )
    assert np.abs(found - make_solver("daqp").solve(*first).actions).max() > 0.1


@pytest.mark.parametrize("n_contacts", [-1, 0, 2])
@pytest.mark.parametrize("name", INSTALLED)
def test_a_rivals_differentiable_actions_are_its_plan(name, n_contacts):
    problems = small_problems(n_contacts)
    solver = RIVALS[name].make()
    solution = solver.solve(*problems)
    model, s0 = problems.tensors()
    arguments = (problems.problem, model, s0, problems.weights, solution)
    if isinstance(solver, ForwardRival):
        with pytest.raises(NotImplementedError, match=type(solver).__name__):
            solver.differentiable_actions(*arguments)
    else:
        actions = solver.differentiable_actions(*arguments).detach().numpy()
        np.testing.assert_allclose(actions, solution.actions, atol=1e-5)


def test_qpth_and_the_active_set_method_have_the_same_gradient():
    """Two derivations that share no code: qpth's, of a problem condensed in torch, and ours."""
    pytest.importorskip("qpth")
    for n_contacts in (-1, 0, 2):
        problems = small_problems(n_contacts)
        known, solver = reference(problems), RIVALS["qpth"].make()
        assert known is not None
        found, _, _ = gradient(problems, solver, solver.solve(*problems))
        assert np.linalg.norm(found - known.gradient) < 1e-3 * np.linalg.norm(known.gradient)


# -- one measurement --


def test_a_measurement_of_the_reference_finds_it_exact():
    problems = cart_pole_problems(2, 5, 8)
    found = measure("daqp", problems, 0.05, reference(problems))
    assert found.forward.least <= found.forward.median and found.forward.repeats >= 1
    assert found.differentiable is not None and found.differentiable.median >= found.forward.median
    assert found.failures == 0
    assert found.kkt_residual < 1e-10 and found.action_error < 1e-10 and found.gradient_error < 1e-10


def test_errors_are_relative_to_what_is_known():
    problems = cart_pole_problems(2, 5, 8)
    known = reference(problems)
    off = known._replace(actions=known.actions + 0.5, gradient=3.0 * known.gradient)
    found = measure("daqp", problems, 0.01, off)
    assert found.action_error == pytest.approx(0.5)
    assert found.gradient_error == pytest.approx(2.0 / 3.0)


def test_memory_is_that_of_the_batch():
    """At least the numbers of the solution; a batch of one adds next to nothing."""
    small, large = (peak_memory("daqp", cart_pole_problems(2, 20, batch)) for batch in (1, 4096))
    assert small is not None and large is not None
    solution = make_solver("daqp").solve(*cart_pole_problems(2, 20, 1))
    numbers = 4096 * sum(getattr(solution, name).size for name in ("actions", "states", "forces", "gaps"))
    assert large > numbers * 8 / 2**20
    assert small < 0.5 * large


# -- the benchmark --


def test_the_benchmark_writes_every_cell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    solver_speed.main(
        f"--solvers daqp torch clarabel --batches 1 4 --horizons 3 5 --contacts 0 2 --output {tmp_path} "
        f"--picture {tmp_path / 'speed.png'}".split()
    )
    rows = solver_speed.read_rows(tmp_path / "solver_speed.csv")
    cells = [(row.n_lambda, row.horizon, row.batch, row.solver) for row in rows]
    assert cells == [
        (n, h, b, s) for n in (0, 2) for h in (3, 5) for b in (1, 4) for s in ("daqp", "torch", "clarabel")
    ]
    for row in rows:
        assert row.status == "measured" and row.failures == 0
        assert row.forward_s > 0.0 and row.kkt_residual < 1e-4 and row.action_error < 1e-2
        assert (row.backward_s is None) == (row.solver == "clarabel")
    published = solver_speed.read_rows(tmp_path / "solver_speed_published.csv")
    assert [row.solver for row in published] == ["daqp", "torch", "clarabel", "acados"]
    assert published[-1].status == "published" and "i7-8665U" in published[-1].note
    assert published[0].memory_mib > 0.0
    described = json.loads((tmp_path / "solver_speed_machine.json").read_text())
    assert described["threads"] == 1 and described["packages"]["daqp"] and described["processor"]
    with Image.open(tmp_path / "speed.png") as picture:
        assert picture.width > 1000
    assert (tmp_path / "speed.png").stat().st_size < 300_000
    assert "peak memory" in capsys.readouterr().out


def test_a_rival_that_is_not_installed_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RIVALS, "elsewhere", Rival(RIVALS["clarabel"].make, "a_module_that_nobody_has"))
    rows = list(solver_speed.run_grid(["elsewhere"], [0], [3], [1], budget=1.0))
    assert [row.status for row in rows] == ["not installed"]
    assert "a_module_that_nobody_has" in rows[0].note and rows[0].forward_s is None


def test_a_rival_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(ForwardRival):
        def solve(self, problem, s0, weights):
            raise ArithmeticError("singular")

    monkeypatch.setitem(RIVALS, "broken", Rival(Broken, "numpy"))
    rows = list(solver_speed.run_grid(["broken", "clarabel"], [0], [3], [1], budget=1.0))
    assert [row.status for row in rows] == ["failed", "measured"]
    assert rows[0].note == "ArithmeticError: singular"


def test_what_would_take_too_long_is_not_run_and_says_so() -> None:
    """Once a batch is over the budget, so are all larger ones, and longer horizons with them."""
    rows = list(solver_speed.run_grid(["daqp"], [0], [3, 5], [1, 8, 64], budget=1e-6))
    assert [row.status for row in rows] == ["measured"] + ["not run"] * 5
    assert all("1e-06 s" in row.note for row in rows[1:])


def test_files_are_read_as_they_were_written(tmp_path: Path) -> None:
    rows = [
        Row("cart-pole", "daqp", 2, 10, 128, "measured", 0.0025, 0.002, 7, 0.001, 0.003, 0.002, 0.001, 7, 3.5),
        Row("cart-pole", "qpth", 2, 10, 128, "not installed", note="no module qpth"),
    ]  # fmt: skip
    solver_speed.write_rows(tmp_path / "rows.csv", rows)
    assert solver_speed.read_rows(tmp_path / "rows.csv") == rows


def verdicts(rows: list[Row]) -> list[tuple[str, str]]:
    """(measured, kept or not) of the promises, in their order."""
    columns = [list(column.cells) for column in solver_speed.promises(rows).columns]
    return list(zip(columns[2], columns[3], strict=True))


def test_promises_are_judged_by_the_rows() -> None:
    def row(solver: str, horizon: int, batch: int, forward: float, backward: float, memory: float | None = None) -> Row:
        return Row(
            "cart-pole", solver, 2, horizon, batch, "measured", forward_s=forward, differentiable_s=forward,
            backward_s=backward, memory_mib=memory,
        )  # fmt: skip

    rows = [
        row("daqp", 10, 64, 0.5, 0.5), row("daqp", 10, 128, 1.0, 1.0), row("daqp", 10, 2048, 8.0, 8.0),
        row("daqp", 20, 2048, 9.0, 9.0, 1025.0), row("cvxpylayers", 10, 128, 75.0, 29.0),
    ]  # fmt: skip
    assert verdicts(rows) == [
        ("75 x", "[green]kept"), ("29 x", "[red]not kept"), ("-", ""), ("-", ""), ("0.5 x", "[green]kept"),
        ("1.02e+03 MiB", "[red]not kept"),
    ]  # fmt: skip
    assert verdicts([]) == [("-", "")] * 6


# -- in the policy --


def test_latency_is_that_of_as_many_states_as_asked_for() -> None:
    lines = {line.quantity: line.value for line in policy_speed.latency("CartPoleSoftWallsPyBullet-v0", 30, 7)}
    assert lines["states, H = 7"] == 30
    assert 0.0 < lines["p50, H = 7"] <= lines["p99, H = 7"] <= lines["longest, H = 7"]


def test_the_parts_of_a_training_run_add_up() -> None:
    lines = {line.quantity: line.value for line in policy_speed.training("CartPoleSoftWallsPyBullet-v0", 64)}
    parts = ("controller, forward", "controller, backward", "prediction loss, forward", "model fit", "simulator")
    assert all(lines[part] > 0.0 for part in parts)
    assert lines["total"] == pytest.approx(sum(lines[part] for part in parts) + lines["all else"])
    assert lines["all else"] > 0.0
    controller = lines["controller, forward"] + lines["controller, backward"]
    assert lines["controller's share"] == pytest.approx(controller / lines["total"])
    assert lines["controller, of which in the solver"] < lines["controller, forward"]


def test_a_timed_solver_has_the_gradient_of_the_solver() -> None:
    problems = cart_pole_problems(2, 5, 6)
    solver, stopwatch = make_solver("daqp"), Stopwatch()
    timed = TimedSolver(solver, stopwatch)
    solution = timed.solve(*problems)
    expected, _, _ = gradient(problems, solver, solution)
    found, _, _ = gradient(problems, timed, solution)
    np.testing.assert_array_equal(found, expected)
    assert set(stopwatch.seconds) == {"controller, of which in the solver", "controller, backward"}


def test_what_is_not_measured_again_stays_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "policy.csv"
    monkeypatch.setattr(policy_speed, "LATENCY_ENVS", ("CartPoleSoftWallsPyBullet-v0",))
    monkeypatch.setattr(
        policy_speed, "training", lambda env_id, steps: [policy_speed.Line("training", "e", "q", 2, "s")]
    )
    policy_speed.run(path, with_latency=False, with_training=True)
    policy_speed.run(path, with_latency=True, with_training=False, n_states=5)
    with path.open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["measurement"] for line in lines] == ["latency"] * 8 + ["training"]
    assert lines[-1]["value"] == "2.0"
