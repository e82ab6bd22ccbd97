"""Models and states at which something degenerates: the result is a plan with a finite subgradient, or the fallback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
import torch

from sb3_mpc_policy import LcsMpc, LinearComplementaritySystem, QuadraticReward
from sb3_mpc_policy.lcp import solve_lcp
from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem, relaxed_problem
from sb3_mpc_policy.simulation import LcsSimulator, LinearFeedback
from sb3_mpc_policy.solvers import Solution, daqp, kkt_residual, make_solver
from sb3_mpc_policy.solvers.condensed import CondensedProblem
from tests.sb3_mpc_policy.toy_environments import box_env, small_ppo

SOLVERS = ["daqp", "torch"]
N_X = 3
Values = dict[str, np.ndarray]


def ordinary(n_contacts: int) -> Values:
    """Parameters of a model at which nothing degenerates."""
    rng = np.random.default_rng(0)
    push = rng.normal(size=(n_contacts, N_X))
    push /= np.linalg.norm(push, axis=1, keepdims=True)
    return {
        "A_scaled": np.eye(N_X) + 0.1 * rng.normal(size=(N_X, N_X)),
        "B_scaled": 0.5 * rng.normal(size=(N_X, 1)),
        "C_scaled": 0.3 * push.T,
        "d_scaled": 0.05 * rng.normal(size=N_X),
        "D_scaled": push,
        "E_scaled": 0.1 * rng.normal(size=(n_contacts, 1)),
        "c_scaled": rng.uniform(0.2, 0.6, n_contacts),
        "F_factor": np.eye(n_contacts) + 0.2 * rng.normal(size=(n_contacts, n_contacts)),
        "F_skew": 0.2 * rng.normal(size=(n_contacts, n_contacts)),
    }


def zero(*names: str) -> Callable[[Values], Values]:
    return lambda values: {name: 0.0 * values[name] for name in names}


def everywhere(number: float) -> Callable[[Values], Values]:
    return lambda values: {name: np.full_like(value, number) for name, value in values.items()}


def times(factor: float, *names: str) -> Callable[[Values], Values]:
    return lambda values: {name: factor * values[name] for name in names or values}


def twice_the_first_contact(values: Values) -> Values:
    """Two contacts that are one: without kappa, F is singular and a force may be shared at will."""
    rows = {name: np.tile(values[name][:1], (2, 1)) for name in ("D_scaled", "E_scaled")}
    columns = {"C_scaled": np.tile(values["C_scaled"][:, :1], 2), "c_scaled": np.tile(values["c_scaled"][:1], 2)}
    return rows | columns | {"F_factor": np.array([[1.0, 0.0], [1.0, 0.0]]), "F_skew": np.zeros((2, 2))}


def spectral_radius(radius: float) -> Callable[[Values], Values]:
    def change(values: Values) -> Values:
        A = values["A_scaled"]
        return {"A_scaled": A * radius / np.abs(np.linalg.eigvals(A)).max()}

    return change


@dataclass(frozen=True)
class Degenerate:
    """What is changed, and what the controller is to make of it: "solved", "fallback", or either, by state."""

    change: Callable[[Values], Values] = field(default=lambda values: {})
    outcome: str = "solved"
    n_contacts: int = 2
    horizon: int = 10
    low: float = -1.0
    high: float = 1.0
    size: float = 1.0  # of the states

    def lcs(self) -> LinearComplementaritySystem:
        lcs = LinearComplementaritySystem(N_X, 1, self.n_contacts)
        values = ordinary(self.n_contacts)
        with torch.no_grad():
            for name, value in (values | self.change(values)).items():
                getattr(lcs, name).copy_(torch.as_tensor(value))
        return lcs

    def states(self, n: int = 12) -> np.ndarray:
        rng = np.random.default_rng(1)
        return self.size * rng.normal(size=(n, N_X))

    def controller(self, solver: str, lcs: LinearComplementaritySystem | None = None) -> LcsMpc:
        """Every solution of it is held to the optimality conditions."""
        reward, (low, high) = QuadraticReward([1.0, 1.0, 0.1], 0.1), np.array([[self.low], [self.high]])
        return LcsMpc(lcs or self.lcs(), reward, low, high, self.horizon, solver=solver, check=True)


CASES = {
    "one contact twice": Degenerate(twice_the_first_contact),
    "F at its least eigenvalues": Degenerate(zero("F_factor", "F_skew")),
    "F of rank one and large": Degenerate(lambda values: {"F_factor": np.full((2, 2), 30.0)}),
    "F by a random factor of 1e4": Degenerate(times(1e4, "F_factor"), outcome="either"),
    "F skew": Degenerate(lambda values: {"F_skew": 1e3 * np.ones((2, 2)).cumsum(axis=1)}, outcome="either"),
    "no push": Degenerate(zero("C_scaled")),
    "gaps that nothing moves": Degenerate(zero("D_scaled", "E_scaled")),
    "gaps that nothing moves, closed": Degenerate(
        lambda values: zero("D_scaled", "E_scaled")(values) | {"c_scaled": -values["c_scaled"]}
    ),
    "gaps at zero that nothing moves": Degenerate(zero("D_scaled", "E_scaled", "c_scaled")),
    "walls through the origin": Degenerate(zero("c_scaled")),
    "no effect of the action": Degenerate(zero("B_scaled")),
    "no effect of the action, on gaps neither": Degenerate(zero("B_scaled", "E_scaled")),
    "nothing at all": Degenerate(everywhere(0.0)),
    "unstable": Degenerate(spectral_radius(1.5)),
    "unstable, without end": Degenerate(spectral_radius(3.0), outcome="fallback", horizon=40),
    "tiny bounds": Degenerate(low=-1e-6, high=1e-6),
    "no bounds": Degenerate(low=-np.inf, high=np.inf),
    "one bound": Degenerate(low=-np.inf),
    "large states": Degenerate(size=1e6),
    "small states": Degenerate(size=1e-9),
    "states at the origin": Degenerate(size=0.0),
    "B of 1e8": Degenerate(times(1e8, "B_scaled"), outcome="either"),
    "C of 1e8": Degenerate(times(1e8, "C_scaled"), outcome="either"),
    "D of 1e8": Degenerate(times(1e8, "D_scaled"), outcome="either"),
    "everything 1e8": Degenerate(everywhere(1e8), outcome="fallback"),
    "everything -1e8": Degenerate(everywhere(-1e8), outcome="fallback"),
    "everything times 1e8": Degenerate(times(1e8), outcome="fallback"),
    "everything 1e8, many contacts": Degenerate(everywhere(1e8), outcome="fallback", n_contacts=8),
}
SOLVED = [name for name, case in CASES.items() if case.outcome == "solved"]

# -- the controller ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", CASES)
def test_a_plan_is_solved_or_the_fallback_and_always_finite(name, solver):
    case = CASES[name]
    plan = case.controller(solver).plan(case.states())
    accepted = {"solved", "fallback"} if case.outcome == "either" else {case.outcome}
    assert set(plan.status) <= accepted
    for part in (plan.actions, plan.states, plan.contact_forces, plan.gaps, plan.cost, plan.complementarity):
        assert np.isfinite(part).all()
    slack = 1e-9
    assert (plan.actions >= case.low - slack).all() and (plan.actions <= case.high + slack).all()


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", CASES)
def test_the_mean_action_has_a_finite_gradient_and_that_of_a_fallback_is_zero(name, solver):
    case = CASES[name]
    lcs = case.lcs()
    controller = case.controller(solver, lcs)
    s = torch.tensor(case.states(), requires_grad=True)
    nothing = 0.0 * (s.sum() + sum(parameter.sum() for parameter in lcs.parameters()))  # all may be fallbacks
    (controller(s).sum() + nothing).backward()
    for parameter in (s, *lcs.parameters()):
        assert parameter.grad.isfinite().all()
    fallback = case.controller(solver, lcs).plan(case.states()).status == "fallback"
    assert not s.grad[fallback].any()
    if fallback.all():
        assert not any(parameter.grad.any() for parameter in lcs.parameters())


@pytest.mark.parametrize("name", SOLVED)
def test_both_solvers_plan_the_same(name):
    """The problem is strictly convex whatever the model: there is one plan."""
    case = CASES[name]
    plans = [case.controller(solver).plan(case.states()) for solver in SOLVERS]
    np.testing.assert_allclose(plans[0].actions, plans[1].actions, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_unstable_model_over_a_long_horizon_is_solved_or_the_fallback(solver):
    """1.5^40 squared is beyond double precision, so that few of these can be solved with the states eliminated."""
    case = Degenerate(spectral_radius(1.5), horizon=40)
    controller = case.controller(solver)
    plan = controller.plan(case.states(2))
    assert np.isfinite(plan.actions).all()
    assert set(plan.status) <= {"solved", "fallback"}


@pytest.mark.parametrize("solver", ["auto", *SOLVERS])
def test_a_model_that_overflows_within_the_horizon_is_unsolved_without_a_warning(solver):
    problem, _ = on_a_line()
    steps = np.ones((1, 40, 1))
    model = problem.model._replace(A=np.array([[1e10]]))
    exploding = replace(problem, model=model, horizon=40)
    s0 = np.array([[-1.0]])
    assert not make_solver(solver).solve(exploding, s0, ComplementarityWeights(steps, steps)).solved.any()
    feedback = LinearFeedback(np.array([[-0.5]]), np.zeros(1), problem.action_low, problem.action_high)
    simulator = LcsSimulator(model, feedback)
    for rollout in (simulator.under(s0, 0.1 * steps), simulator.regulated(s0, 40)):
        assert not np.isfinite(rollout.states[:, -1]).any()


# -- training ---------------------------------------------------------------------------------------------------------

IN_TRAINING: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name, case in CASES.items() if np.isfinite(case.low)),
    *((name, dict(model_fit="contacts")) for name, case in CASES.items() if np.isfinite(case.low)),
    ("one contact twice", dict(solver="torch")),
    ("everything 1e8", dict(solver="torch")),
    ("everything 1e8, many contacts", dict(prediction_loss="violation")),
    ("unstable, without end", dict(prediction_loss="violation")),
    ("everything times 1e8", dict(model_fit="least_squares")),
    ("everything 1e8", dict(terminal_value="critic")),
]


@pytest.mark.parametrize(("name", "arguments"), IN_TRAINING, ids=str)
def test_stock_ppo_trains_through_it_and_every_parameter_stays_finite(name, arguments):
    case = CASES[name]
    reward = dict(state_weight=[1.0, 1.0, 0.1], action_weight=0.1)
    settings = dict(model_fit="gradient", horizon=case.horizon, initial_lcs=case.lcs(), reward=reward) | arguments
    model = small_ppo(box_env(N_X, 1, bound=case.high), n_epochs=1, **settings).learn(64)
    assert model._n_updates == 2
    for parameter in model.policy.parameters():
        assert parameter.isfinite().all()


# -- edges ------------------------------------------------------------------------------------------------------------


def on_a_line(weights: tuple[float, float] = (50.0, 0.0)) -> tuple[RelaxedProblem, ComplementarityWeights]:
    """A mass in one dimension before a soft wall at 0.3, three steps: all edges are single states."""
    model = LcsMatrices(*map(np.array, ([[1.1]], [[0.5]], [[-0.4]], [0.02], [[-1.0]], [[-0.1]], [[0.5]], [0.3])))
    problem = RelaxedProblem(
        model, np.diag([1.0, 0.1]), np.zeros(2), np.eye(1), np.zeros(1), np.array([-0.6]), np.array([0.8]), 3, 1e-4
    )
    return problem, ComplementarityWeights(np.full((1, 3, 1), weights[0]), np.full((1, 3, 1), weights[1]))


def active_at(solution: Solution) -> np.ndarray:
    return np.abs(solution.multipliers[0]) > 1e-7


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("weights", [(50.0, 0.0), (0.0, 50.0), (0.2, 0.2)])
def test_on_the_edge_of_two_modes_the_derivative_is_a_one_sided_one(solver, weights):
    problem, w = on_a_line(weights)
    exact, instance = make_solver("daqp"), make_solver(solver)

    def solve(s: float) -> Solution:
        return exact.solve(problem, np.array([[s]]), w)

    edges = []
    grid = np.linspace(-2.0, 2.0, 200)
    for left, right in pairwise(grid):
        before = active_at(solve(left))
        if (before == active_at(solve(right))).all():
            continue
        for _ in range(60):
            middle = (left + right) / 2
            left, right = (middle, right) if (active_at(solve(middle)) == before).all() else (left, middle)
        edges += [left, right]
    assert len(edges) >= 4
    for edge in edges:
        solution = instance.solve(problem, np.array([[edge]]), w)
        assert solution.solved.all()
        s0 = torch.tensor([[edge]], requires_grad=True)
        model = LcsMatrices(*(torch.tensor(matrix, requires_grad=True) for matrix in problem.model))
        actions = instance.differentiable_actions(problem, model, s0, w, solution)
        actions[0, 0, 0].backward()
        here = solution.actions[0, 0, 0]
        one_sided = [(solve(edge + step).actions[0, 0, 0] - here) / step for step in (-1e-5, 1e-5)]
        assert np.abs(np.array(one_sided) - s0.grad.item()).min() < 1e-4, (edge, one_sided, s0.grad)
        assert all(matrix.grad.isfinite().all() for matrix in model)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_gap_and_its_force_may_both_be_held_at_zero(solver):
    """The state touches the wall and no action moves the gap: force and gap then are one and the same constraint."""
    problem, w = on_a_line((0.5, 0.5))
    problem = replace(problem, model=problem.model._replace(E=np.zeros((1, 1))))
    s0 = np.array([[0.3]])
    instance = make_solver(solver)
    solution = instance.solve(problem, s0, w)
    assert solution.solved.all()
    assert kkt_residual(problem, s0, w, solution).max() < 1e-9
    assert max(abs(solution.forces[0, 0, 0]), abs(solution.gaps[0, 0, 0])) < 1e-9
    start = torch.tensor(s0, requires_grad=True)
    model = LcsMatrices(*(torch.tensor(matrix, requires_grad=True) for matrix in problem.model))
    instance.differentiable_actions(problem, model, start, w, solution).sum().backward()
    assert all(leaf.grad.isfinite().all() for leaf in (start, *model))


# -- digits -----------------------------------------------------------------------------------------------------------


def unstable(n: int = 6) -> tuple[RelaxedProblem, np.ndarray, ComplementarityWeights]:
    """Spectral radius 1.7 over 20 steps: with the states eliminated, the problem's condition is beyond 1e12."""
    rng = np.random.default_rng(3)
    n_x, n_a, n_c, horizon = 4, 2, 4, 20
    A = np.eye(n_x) + 0.15 * rng.normal(size=(n_x, n_x))
    A *= 1.7 / np.abs(np.linalg.eigvals(A)).max()
    push = rng.normal(size=(n_c, n_x))
    model = LcsMatrices(
        A, 0.5 * rng.normal(size=(n_x, n_a)), 0.3 * push.T, 0.05 * rng.normal(size=n_x),
        push, 0.1 * rng.normal(size=(n_c, n_a)), np.eye(n_c), rng.uniform(0.2, 0.6, n_c),
    )  # fmt: skip
    problem = RelaxedProblem(
        model, np.diag([1.0] * n_x + [0.1] * n_a), np.zeros(n_x + n_a), np.eye(n_x), np.zeros(n_x),
        np.full(n_a, -0.7), np.full(n_a, 0.7), horizon, 1e-4,
    )  # fmt: skip
    weights = ComplementarityWeights(np.zeros((n, horizon, n_c)), np.full((n, horizon, n_c), 10.0))
    return problem, 0.5 * rng.normal(size=(n, n_x)), weights


@pytest.mark.parametrize("solver", ["auto", *SOLVERS])
def test_an_ill_conditioned_problem_is_solved_to_the_digits_of_one_whose_states_are_kept(solver):
    """Or, by the active-set method alone, said to be unsolved."""
    problem, s0, weights = unstable()
    assert CondensedProblem(problem).condition > 1e12
    solution = make_solver(solver).solve(problem, s0, weights)
    assert solution.solved.all() if solver != "daqp" else solution.solved.any()
    statement = relaxed_problem(problem)
    values = dict(zip("ABCdDEFc", problem.model, strict=True)) | {
        "W_sqrt": np.sqrt(problem.stage_weight), "w": problem.stage_slope,
        "P_sqrt": np.eye(4), "p": problem.terminal_slope, "w_phi": weights.gap[0], "w_lam": weights.force[0],
    }  # fmt: skip
    for name, value in values.items():
        statement.parameters[name].value = value
    for i in np.flatnonzero(solution.solved):
        statement.parameters["s0"].value = s0[i]
        statement.problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
        np.testing.assert_allclose(solution.actions[i], statement.variables["a"].value, rtol=0, atol=5e-6)


def test_what_the_active_set_method_does_not_solve_the_automatic_choice_hands_over(monkeypatch):
    problem, w = on_a_line()
    s0, weights = np.linspace(-1.0, 1.0, 9)[:, None], ComplementarityWeights(*(np.tile(x, (9, 1, 1)) for x in w))
    expected = make_solver("daqp").solve(problem, s0, weights)
    automatic = make_solver("auto")
    once = daqp._Workspace._attempt
    spoiled = (3, 7)
    monkeypatch.setattr(
        daqp._Workspace, "_attempt", lambda self, attempt, batch, i: i not in spoiled and once(self, attempt, batch, i)
    )
    solution = automatic.solve(problem, s0, weights)
    assert automatic.handed_over == len(spoiled)
    assert solution.solved.all()
    np.testing.assert_allclose(solution.actions, expected.actions, rtol=0, atol=1e-9)


def test_a_retry_is_counted_and_loses_no_digits(monkeypatch):
    problem, w = on_a_line()
    s0, weights = np.linspace(-1.0, 1.0, 9)[:, None], ComplementarityWeights(*(np.tile(x, (9, 1, 1)) for x in w))
    plain = make_solver("daqp")
    expected = plain.solve(problem, s0, weights)
    assert plain.retries == 0
    once = daqp._Workspace._attempt
    monkeypatch.setattr(
        daqp._Workspace, "_attempt", lambda self, attempt, *rest: attempt != "plain" and once(self, attempt, *rest)
    )
    proximal = make_solver("daqp")
    solution = proximal.solve(problem, s0, weights)
    assert proximal.retries == 9
    assert solution.solved.all()
    np.testing.assert_allclose(solution.actions, expected.actions, rtol=0, atol=1e-12)


# -- the complementarity problem --------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, 4, 6, 8])
def test_a_contact_matrix_that_rounding_makes_singular_still_has_a_solution_and_a_derivative(n):
    """Ones of 1e16 beside the 1e-3 that makes the matrix regular."""
    F = torch.tensor(1e16 * np.ones((n, n)) + 1e-3 * np.eye(n), requires_grad=True)
    q = torch.tensor(np.random.default_rng(0).normal(size=(20, n)), requires_grad=True)
    lam = solve_lcp(F, q)
    gap = (lam @ F.mT + q).detach()
    assert lam.min() >= 0.0
    assert gap.min() > -1e-6
    assert torch.minimum(lam.detach() * 1e16, gap).abs().max() < 1e-6
    lam.sum().backward()
    assert F.grad.isfinite().all() and q.grad.isfinite().all()
