"""Every solver gives the solution of the relaxed problem (6), and its derivative, on every family of problems."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from functools import cache
from itertools import product, zip_longest

import cvxpy as cp
import numpy as np
import pytest
import torch

from sb3_mpc_policy.lcs import LcsMatrices, LinearComplementaritySystem
from sb3_mpc_policy.lqr import affine_lqr
from sb3_mpc_policy.mpc import complementarity_weights
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem, relaxed_problem
from sb3_mpc_policy.simulation import LcsSimulator, LinearFeedback
from sb3_mpc_policy.solvers import SOLVERS, CheckedSolver, Solution, auto, daqp, kkt_residual, make_solver
from sb3_mpc_policy.solvers.auto import choose

# cvxpylayers' own, on NumPy 2
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

N_X = 3
# Of the actions. The layer solves a cone programme, in which they are known to the root of its tolerance only.
TOLERANCE = {"daqp": 1e-5, "torch": 1e-5, "cvxpylayers": 1e-4}
# n_lambda, n_a, H, bounded
FAMILIES = list(product([0, 1, 2, 4], [1, 2], [1, 5, 10], [True, False]))
SOLVED_BY = [pytest.param(*pair, id="-".join(map(str, pair))) for pair in product(SOLVERS, FAMILIES)]


@dataclass(frozen=True)
class Case:
    """A batch of relaxed problems around a model whose every matrix is away from zero."""

    lcs: LinearComplementaritySystem
    problem: RelaxedProblem
    s0: np.ndarray
    weights: ComplementarityWeights

    def __getitem__(self, index: np.ndarray) -> Case:
        some = ComplementarityWeights(self.weights.gap[index], self.weights.force[index])
        return replace(self, s0=self.s0[index], weights=some)


def numpy_model(lcs: LinearComplementaritySystem) -> LcsMatrices[np.ndarray]:
    return LcsMatrices(*(matrix.detach().numpy().copy() for matrix in lcs.scaled()))


@cache
def make_case(family: tuple[int, int, int, bool], n: int = 6) -> Case:
    """As many states free, in contact, and at their bounds under the regulator as there are of each."""
    n_c, n_a, horizon, bounded = family
    rng = np.random.default_rng([n_c, n_a, horizon, bounded])
    lcs = LinearComplementaritySystem(N_X, n_a, n_c)
    push = rng.normal(size=(n_c, N_X))
    push /= np.linalg.norm(push, axis=1, keepdims=True)
    with torch.no_grad():
        for parameter, value in (
            (lcs.A_scaled, np.eye(N_X) + 0.15 * rng.normal(size=(N_X, N_X))),
            (lcs.B_scaled, 0.5 * rng.normal(size=(N_X, n_a))),
            (lcs.C_scaled, 0.3 * push.T + 0.05 * rng.normal(size=(N_X, n_c))),
            (lcs.d_scaled, 0.05 * rng.normal(size=N_X)),
            (lcs.D_scaled, push),
            (lcs.E_scaled, 0.1 * rng.normal(size=(n_c, n_a))),
            (lcs.c_scaled, rng.uniform(0.2, 0.6, n_c)),
            (lcs.F_factor, np.eye(n_c) + 0.2 * rng.normal(size=(n_c, n_c))),
            (lcs.F_skew, 0.2 * rng.normal(size=(n_c, n_c))),
        ):
            parameter.copy_(torch.as_tensor(value))
    G = rng.normal(size=(N_X + n_a, N_X + n_a))
    stage_weight = G @ G.T / (N_X + n_a) + 0.1 * np.eye(N_X + n_a)
    stage_slope = 0.2 * rng.normal(size=N_X + n_a)
    model = numpy_model(lcs)
    lqr = affine_lqr(model.A, model.B, model.d, stage_weight, stage_slope)
    T = rng.normal(size=(N_X, N_X))
    terminal_weight, terminal_slope = T @ T.T, 0.2 * rng.normal(size=N_X)
    bound = np.full(n_a, (0.4 if horizon > 1 else 0.15) if bounded else np.inf)
    problem = RelaxedProblem(
        model, stage_weight, stage_slope, terminal_weight, terminal_slope, -bound, 1.5 * bound, horizon,
        force_weight=1e-4 * np.trace(stage_weight),
    )  # fmt: skip
    candidates = rng.normal(size=(30 * n, N_X)) * rng.uniform(0.1, 1.5, (30 * n, 1))
    bounds = problem.action_low, problem.action_high
    simulator = LcsSimulator(model, LinearFeedback(lqr.K, lqr.k, *bounds))
    rollout = simulator.regulated(candidates, horizon)
    touching = rollout.forces.any(axis=(1, 2))
    limited = ((rollout.actions == bounds[0]) | (rollout.actions == bounds[1])).any(axis=(1, 2))
    groups = [np.flatnonzero((touching == t) & (limited == m)) for t, m in product([False, True], repeat=2)]
    in_turn = [i for some in zip_longest(*groups) for i in some if i is not None]
    s0 = candidates[in_turn[:n]]
    nominal = simulator.regulated(s0, horizon)
    weights = complementarity_weights(nominal.forces, nominal.gaps, np.diag(model.F), 50.0, 1e-3)
    return Case(lcs, problem, s0, weights)


@cache
def solve_in_cvxpy(family: tuple[int, int, int, bool]) -> np.ndarray:
    """The actions (N, H, n_a), from a statement of eq (6), relaxed, that shares no code with the package's own.

    The gap is an expression and not a variable, the weights enter as quadratic forms.
    """
    case = make_case(family)
    p, H = case.problem, case.problem.horizon
    A, B, C, d, D, E, F, c = p.model
    s, a = cp.Variable((H + 1, N_X)), cp.Variable((H, B.shape[1]))
    lam = cp.Variable((H, max(len(c), 1)), nonneg=True)
    if not len(c):  # a contact that does nothing, which CVXPY wants in place of none
        C, D, E, F, c = np.zeros((N_X, 1)), np.zeros((1, N_X)), np.zeros((1, B.shape[1])), np.eye(1), np.zeros(1)
    start = cp.Parameter(N_X)
    w_phi, w_lam = cp.Parameter((H, len(c)), nonneg=True), cp.Parameter((H, len(c)), nonneg=True)
    z = cp.hstack([s[:-1], a])
    phi = s[:-1] @ D.T + a @ E.T + lam @ F.T + np.tile(c, (H, 1))
    cost = cp.quad_form(s[H], cp.psd_wrap(p.terminal_weight)) + p.terminal_slope @ s[H]
    cost += sum(cp.quad_form(z[k], cp.psd_wrap(p.stage_weight)) + p.stage_slope @ z[k] for k in range(H))
    cost += cp.sum(cp.multiply(w_phi, phi)) + cp.sum(cp.multiply(w_lam, lam)) + p.force_weight * cp.sum_squares(lam)
    constraints = [s[0] == start, s[1:] == s[:-1] @ A.T + a @ B.T + lam @ C.T + np.tile(d, (H, 1)), phi >= 0]
    if np.isfinite(p.action_low).all():
        constraints += [a >= np.tile(p.action_low, (H, 1)), a <= np.tile(p.action_high, (H, 1))]
    statement = cp.Problem(cp.Minimize(cost), constraints)
    found = []
    for i in range(len(case.s0)):
        start.value = case.s0[i]
        w_phi.value = case.weights.gap[i] if case.weights.gap.size else np.zeros((H, 1))
        w_lam.value = case.weights.force[i] if case.weights.force.size else np.zeros((H, 1))
        statement.solve(solver=cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
        assert statement.status == cp.OPTIMAL
        found.append(a.value)
    return np.array(found)


def at_bound(case: Case, solution: Solution) -> np.ndarray:
    """(N, H, n_a)"""
    low, high = case.problem.action_low, case.problem.action_high
    return (solution.actions < low + 1e-7) | (solution.actions > high - 1e-7)


# -- the solution -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("solver", "family"), SOLVED_BY)
def test_actions_are_those_of_the_problem_stated_and_solved_in_cvxpy(solver, family):
    case = make_case(family)
    solution = make_solver(solver).solve(case.problem, case.s0, case.weights)
    assert solution.solved.all()
    np.testing.assert_allclose(solution.actions, solve_in_cvxpy(family), rtol=TOLERANCE[solver], atol=TOLERANCE[solver])


@pytest.mark.parametrize(("solver", "family"), SOLVED_BY)
def test_states_forces_and_gaps_belong_to_the_actions(solver, family):
    """Primal feasibility: the dynamics, the gaps, the signs and the bounds."""
    case = make_case(family)
    A, B, C, d, D, E, F, c = case.problem.model
    found = make_solver(solver).solve(case.problem, case.s0, case.weights)
    now = found.states[:, :-1]
    np.testing.assert_allclose(found.states[:, 0], case.s0, atol=1e-7)
    following = now @ A.T + found.actions @ B.T + found.forces @ C.T + d
    np.testing.assert_allclose(found.states[:, 1:], following, atol=1e-6)
    gaps = now @ D.T + found.actions @ E.T + found.forces @ F.T + c
    np.testing.assert_allclose(found.gaps, gaps, atol=1e-6)
    assert found.gaps.min(initial=0.0) > -1e-6
    assert found.forces.min(initial=0.0) > -1e-6
    assert (found.actions >= case.problem.action_low - 1e-6).all()
    assert (found.actions <= case.problem.action_high + 1e-6).all()


def test_the_families_hold_what_they_are_meant_to():
    """Contacts closed and open, bounds hit and not, in every family that can have them."""
    for family in FAMILIES:
        case = make_case(family)
        solution = make_solver("daqp").solve(case.problem, case.s0, case.weights)
        if family[0]:
            assert (solution.forces > 1e-3).any(), family
            assert (solution.gaps > 1e-3).any(), family
        hits = at_bound(case, solution)
        assert hits.any() == family[3], family
        assert not hits.all(), family


@pytest.mark.parametrize(("solver", "family"), list(product(["daqp", "torch"], FAMILIES)), ids=str)
def test_the_solution_meets_the_optimality_conditions(solver, family):
    case = make_case(family, n=40)
    solution = make_solver(solver).solve(case.problem, case.s0, case.weights)
    assert solution.solved.all()
    assert kkt_residual(case.problem, case.s0, case.weights, solution).max() < 1e-8


@pytest.mark.parametrize("family", [(2, 1, 5, True), (4, 2, 10, True), (0, 2, 5, True)])
def test_the_optimality_check_can_fail(family):
    """On actions, forces, multipliers and data that are a little off."""
    case = make_case(family)
    exact = make_solver("daqp").solve(case.problem, case.s0, case.weights)

    def residual(**changed: np.ndarray) -> float:
        return float(kkt_residual(case.problem, case.s0, case.weights, replace(exact, **changed)).min())

    assert residual(actions=exact.actions + 1e-3) > 1e-5
    assert residual(multipliers=exact.multipliers + 1e-3) > 1e-5
    assert kkt_residual(case.problem, case.s0 + 1e-3, case.weights, exact).min() > 1e-6
    if family[0]:
        assert residual(forces=exact.forces + 1e-3) > 1e-5
        heavier = ComplementarityWeights(case.weights.gap + 1e-2, case.weights.force)
        assert kkt_residual(case.problem, case.s0, heavier, exact).min() > 1e-6
    at_limit = at_bound(case, exact).any(axis=(1, 2))
    wrong_sign = kkt_residual(case.problem, case.s0, case.weights, replace(exact, multipliers=-exact.multipliers))
    assert at_limit.any()
    assert wrong_sign[at_limit].min() > 1e-5
    outside = np.where(at_bound(case, exact), exact.actions * 1.01, exact.actions)
    assert kkt_residual(case.problem, case.s0, case.weights, replace(exact, actions=outside))[at_limit].min() > 1e-5


def test_the_optimality_check_sees_a_multiplier_of_the_wrong_sign_alone():
    """Less weight on the gaps and as much more multiplier: stationary, feasible, and not a minimum."""
    case = make_case((2, 1, 5, True))
    exact = make_solver("daqp").solve(case.problem, case.s0, case.weights)
    more = exact.multipliers.copy()
    more[:, -10:] -= np.where(exact.gaps.reshape(6, -1) < 1e-9, 2.0 * more[:, -10:], 0.0)
    less = case.weights.gap + (exact.multipliers - more)[:, -10:].reshape(6, 5, 2)
    residual = kkt_residual(
        case.problem, case.s0, ComplementarityWeights(less, case.weights.force), replace(exact, multipliers=more)
    )
    pressed = (exact.multipliers[:, -10:] < -1e-3).any(axis=1)
    assert pressed.any()
    assert residual[pressed].min() > 1e-6
    assert residual[~pressed].max(initial=0.0) < 1e-4


@pytest.mark.parametrize("side", ["action_low", "action_high"])
def test_the_optimality_check_sees_an_action_out_of_bounds_alone(side):
    """The unbounded solution, held against bounds that it does not keep to."""
    case = make_case((0, 1, 5, False))
    exact = make_solver("daqp").solve(case.problem, case.s0, case.weights)
    limit = np.median(exact.actions, axis=(0, 1))
    tighter = replace(case.problem, **{side: limit})
    residual = kkt_residual(tighter, case.s0, case.weights, exact)
    outside = ((exact.actions - limit) * (1.0 if side == "action_high" else -1.0)).max(axis=(1, 2))
    assert (outside > 1e-2).any()
    assert residual[outside > 1e-2].min() > 1e-5


@pytest.mark.parametrize("family", [(0, 1, 1, True), (2, 1, 5, True), (4, 2, 10, True)])
def test_a_solution_without_multipliers_is_checked_with_those_that_fit(family):
    case = make_case(family)
    exact = replace(make_solver("daqp").solve(case.problem, case.s0, case.weights), multipliers=None)
    assert kkt_residual(case.problem, case.s0, case.weights, exact).max() < 1e-9
    off = replace(exact, actions=exact.actions + 1e-3)
    assert kkt_residual(case.problem, case.s0, case.weights, off).min() > 1e-5


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_checked_solver_rejects_what_is_no_solution(solver, monkeypatch):
    case = make_case((2, 1, 5, True))
    checked = CheckedSolver(make_solver(solver))
    right = checked.solve(case.problem, case.s0, case.weights)
    assert right.solved.all()
    assert 0.0 < checked.largest_residual < 1e-6
    none = case[np.arange(0)]
    assert checked.solve(none.problem, none.s0, none.weights).solved.shape == (0,)

    def wrong(*arguments):
        solution = make_solver(solver).solve(*arguments)
        solution.actions[2] += 1e-2
        solution.actions[3] = np.nan
        solution.solved[4] = False
        return solution

    monkeypatch.setattr(checked.solver, "solve", wrong)
    after = checked.solve(case.problem, case.s0, case.weights)
    np.testing.assert_array_equal(after.solved, [True, True, False, False, False, True])


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_problem_is_solved_the_same_whatever_its_company(solver):
    case = make_case((2, 1, 5, True))
    together = make_solver(solver)
    solution = together.solve(case.problem, case.s0, case.weights)
    order = np.array([3, 0, 5, 1, 4, 2])
    shuffled = together.solve(case.problem, case[order].s0, case[order].weights)
    np.testing.assert_allclose(shuffled.actions, solution.actions[order], rtol=0, atol=1e-7)
    alone = make_solver(solver).solve(case.problem, case[[4]].s0, case[[4]].weights)
    np.testing.assert_allclose(alone.actions[0], solution.actions[4], rtol=0, atol=1e-7)
    none = case[np.arange(0)]
    assert together.solve(none.problem, none.s0, none.weights).actions.shape == (0, 5, 1)


@pytest.mark.parametrize("solver", SOLVERS)
def test_one_solver_serves_one_problem_after_another(solver):
    """Whatever is kept between calls is not kept for another model, size or bound."""
    one, other = make_case((2, 1, 5, True)), make_case((1, 2, 1, True))
    wider = replace(one, problem=replace(one.problem, action_low=np.array([-0.1]), action_high=np.array([0.1])))
    stiffer = replace(one, problem=replace(one.problem, stage_weight=5.0 * one.problem.stage_weight))
    kept = make_solver(solver)
    for case in (one, other, one, wider, stiffer, one):
        found = kept.solve(case.problem, case.s0, case.weights)
        fresh = make_solver(solver).solve(case.problem, case.s0, case.weights)
        np.testing.assert_allclose(found.actions, fresh.actions, rtol=0, atol=1e-7)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_state_without_solution_fails_alone(solver):
    case = make_case((2, 1, 5, True))
    s0 = case.s0.copy()
    s0[2] = np.nan
    solution = make_solver(solver).solve(case.problem, s0, case.weights)
    np.testing.assert_array_equal(solution.solved, np.arange(6) != 2)
    rest = np.arange(6) != 2
    np.testing.assert_allclose(
        solution.actions[rest], solve_in_cvxpy((2, 1, 5, True))[rest], rtol=0, atol=TOLERANCE[solver]
    )


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_model_that_is_not_finite_fails_everywhere(solver):
    case = make_case((2, 1, 5, True))
    for name in LcsMatrices._fields:
        matrix = np.array(getattr(case.problem.model, name))
        matrix.flat[0] = np.nan
        broken = replace(case.problem, model=case.problem.model._replace(**{name: matrix}))
        assert not make_solver(solver).solve(broken, case.s0, case.weights).solved.any(), name


@pytest.mark.parametrize("name", ["daqp", "torch"])
def test_a_problem_that_is_not_convex_fails_and_harms_no_other(name):
    case = make_case((2, 1, 5, True))
    concave = replace(case.problem, stage_weight=-case.problem.stage_weight, terminal_weight=np.zeros((N_X, N_X)))
    solver = make_solver(name)
    for _ in range(2):
        assert not solver.solve(concave, case.s0, case.weights).solved.any()
    assert solver.solve(case.problem, case.s0, case.weights).solved.all()


@pytest.mark.parametrize("family", [(2, 1, 10, True), (4, 2, 10, True)])
def test_the_proximal_form_that_stands_by_finds_the_same_solution(family, monkeypatch):
    case = make_case(family)
    tried = []
    once = daqp._Workspace._attempt

    def fails_at_first(self, attempt, *rest):
        tried.append(attempt)
        return once(self, attempt, *rest) and attempt != "plain"

    monkeypatch.setattr(daqp._Workspace, "_attempt", fails_at_first)
    solution = make_solver("daqp").solve(case.problem, case.s0, case.weights)
    assert tried == ["plain", "proximal"] * len(case.s0)
    assert solution.solved.all()
    np.testing.assert_allclose(solution.actions, solve_in_cvxpy(family), rtol=0, atol=1e-5)


# -- the derivative ---------------------------------------------------------------------------------------------------


def strict(case: Case, solution: Solution, margin: float = 1e-3) -> np.ndarray:
    """(N,) True where no constraint is about to become active or inactive."""
    n, n_x = len(case.s0), solution.actions[0].size + solution.forces[0].size
    bound, gap = np.abs(solution.multipliers[:, :n_x]), np.abs(solution.multipliers[:, n_x:])
    low, high = case.problem.action_low, case.problem.action_high
    slack = np.minimum(solution.actions - low, high - solution.actions).reshape(n, -1)
    x_slack = np.concatenate([slack, solution.forces.reshape(n, -1)], axis=1)
    gap_slack = solution.gaps.reshape(n, -1)
    sharp = [np.maximum(bound, x_slack), np.maximum(gap, gap_slack)]
    return np.concatenate(sharp, axis=1).min(axis=1) > margin


def gradients(solver: str, case: Case, weight: np.ndarray) -> dict[str, np.ndarray]:
    """Of ``Σ weight · actions`` with respect to every parameter of the LCS, and to s0."""
    instance = make_solver(solver)
    solution = instance.solve(case.problem, case.s0, case.weights)
    start = torch.tensor(case.s0, requires_grad=True)
    case.lcs.zero_grad()
    actions = instance.differentiable_actions(case.problem, case.lcs.scaled(), start, case.weights, solution)
    np.testing.assert_allclose(actions.detach(), solution.actions, rtol=0, atol=1e-6)
    (actions * torch.as_tensor(weight)).sum().backward()
    found = {}
    for name, parameter in case.lcs.named_parameters():
        gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        found[name] = gradient.numpy().copy()
    return found | {"s0": start.grad.numpy()}


def differences(case: Case, weight: np.ndarray, parameter_gradients, central_difference) -> dict[str, np.ndarray]:
    """The same by central differences of DAQP's solution; the relaxation's weights stay."""

    def value(s0: np.ndarray) -> float:
        problem = replace(case.problem, model=numpy_model(case.lcs))
        return float((make_solver("daqp").solve(problem, s0, case.weights).actions * weight).sum())

    result = parameter_gradients(case.lcs, lambda: value(case.s0), 1e-5)
    return result | {"s0": central_difference(value, case.s0, 1e-5)}


def assert_close(found: dict[str, np.ndarray], expected: dict[str, np.ndarray], tolerance: float) -> None:
    for name, reference in expected.items():
        error = np.abs(found[name] - reference).max(initial=0.0)
        assert error <= tolerance * max(np.abs(reference).max(initial=0.0), 1e-2), name


SITUATIONS = ["free", "in contact", "at a bound", "first action at its bound", "both"]


def pick(family: tuple[int, int, int, bool], situation: str) -> tuple[Case, Solution]:
    """Up to three problems of the family that are in the situation, away from changes of mode."""
    case = make_case(family, n=600)
    solution = make_solver("daqp").solve(case.problem, case.s0, case.weights)
    touching, limited = (solution.forces > 1e-3).any(axis=(1, 2)), at_bound(case, solution).any(axis=(1, 2))
    first = at_bound(case, solution)[:, 0].all(axis=1)
    chosen = {
        "free": ~touching & ~limited,
        "in contact": touching & ~limited,
        "at a bound": ~touching & limited & ~first,
        "first action at its bound": first,
        "both": touching & limited & ~first,
    }[situation]
    index = np.flatnonzero(chosen & strict(case, solution))[:3]
    assert len(index), "no such state in this family"
    return case[index], solution[index]


GRADIENT_FAMILIES = [
    (0, 1, 5, True),
    (1, 1, 1, True),
    (1, 1, 10, True),
    (2, 1, 5, True),
    (2, 2, 5, True),
    (4, 2, 10, False),
]


def can_occur(family: tuple[int, int, int, bool], situation: str) -> bool:
    touching, limited = situation in ("in contact", "both"), situation not in ("free", "in contact")
    alone = family[1:3] == (1, 1) and situation in ("at a bound", "both")  # one action: it is the first
    return not (touching and family[0] == 0) and not (limited and not family[3]) and not alone


GRADIENT_CASES = [pair for pair in product(GRADIENT_FAMILIES, SITUATIONS) if can_occur(*pair)]


@pytest.mark.parametrize(("family", "situation"), GRADIENT_CASES, ids=str)
def test_the_derivative_of_the_mean_action_is_that_of_central_differences(
    family, situation, parameter_gradients, central_difference
):
    case, solution = pick(family, situation)
    assert (solution.forces > 1e-3).any() or situation not in ("in contact", "both")
    assert at_bound(case, solution).any() == (situation not in ("free", "in contact"))
    weight = np.zeros(solution.actions.shape)
    weight[:, 0] = np.random.default_rng(0).normal(size=weight[:, 0].shape)
    found = gradients("daqp", case, weight)
    expected = differences(case, weight, parameter_gradients, central_difference)
    assert_close(found, expected, 1e-4)
    if situation == "first action at its bound":
        assert not any(gradient.any() for gradient in found.values())
    else:
        assert np.abs(found["B_scaled"]).max() > 1e-3
    if situation == "in contact":
        assert max(np.abs(found[name]).max() for name in ("C_scaled", "D_scaled", "F_factor", "c_scaled")) > 1e-3


@pytest.mark.parametrize("family", GRADIENT_FAMILIES, ids=str)
def test_the_derivative_of_the_whole_plan_is_that_of_central_differences(
    family, parameter_gradients, central_difference
):
    case = make_case(family, n=600)
    index = np.flatnonzero(strict(case, make_solver("daqp").solve(case.problem, case.s0, case.weights)))[:20]
    case = case[index]
    weight = np.random.default_rng(1).normal(size=(len(index), family[2], family[1]))
    expected = differences(case, weight, parameter_gradients, central_difference)
    assert len(index) >= 5
    assert_close(gradients("daqp", case, weight), expected, 1e-4)


# diffcp's dense derivative solves the whole cone programme's linear system, whose condition is far worse.
LOOSER = 1e-3


@pytest.mark.parametrize(
    ("family", "situation"), [((2, 1, 5, True), s) for s in SITUATIONS] + [((0, 2, 5, True), "free")]
)
def test_the_cvxpy_layer_agrees_on_the_derivative(family, situation):
    case, solution = pick(family, situation)
    weight = np.random.default_rng(0).normal(size=solution.actions.shape)
    assert_close(gradients("cvxpylayers", case, weight), gradients("daqp", case, weight), LOOSER)


# -- the statement and the interface ----------------------------------------------------------------------------------


@pytest.mark.parametrize("n_c", [0, 2])
def test_the_statement_is_disciplined_in_its_parameters(n_c):
    statement = relaxed_problem(make_case((n_c, 2, 5, True)).problem)
    assert statement.problem.is_dcp(dpp=True)
    assert set(statement.parameters) >= {"A", "B", "d", "s0", "W_sqrt", "w", "P_sqrt", "p"}
    assert ("C" in statement.parameters) == bool(n_c)


def test_the_cost_is_that_of_eq_6():
    case = make_case((2, 2, 5, True))
    p = case.problem
    found = make_solver("daqp").solve(p, case.s0, case.weights)
    for i in range(len(case.s0)):
        total = found.states[i, -1] @ p.terminal_weight @ found.states[i, -1] + p.terminal_slope @ found.states[i, -1]
        for k in range(5):
            z = np.concatenate([found.states[i, k], found.actions[i, k]])
            total += z @ p.stage_weight @ z + p.stage_slope @ z
        np.testing.assert_allclose(p.cost(found.states, found.actions)[i], total, rtol=1e-10)


def test_an_unknown_solver_is_named_with_those_there_are():
    there_are = r"\['cvxpylayers', 'daqp', 'torch'\]"
    with pytest.raises(ValueError, match=rf"^solver must be 'auto' or one of {there_are}, got 'osqp'"):
        make_solver("osqp")


def test_the_table_of_choices_has_a_solver_for_every_batch():
    for device, batch, contacts in product(["cpu", "cuda", "mps"], [1, 63, 64, 2047, 10**6], [0, 20, 320, 640, 10**4]):
        assert choose(device, batch, contacts) in SOLVERS
    assert choose("cuda", 10**6, 20) == "torch"
    assert choose("cpu", 10**6, 20) == "daqp"


def test_long_horizons_with_many_contacts_go_to_the_stage_wise_method():
    assert choose("cpu", 128, 319) == choose("cpu", 63, 320) == "daqp"
    assert choose("cpu", 64, 320) == choose("cpu", 1, 640) == "torch"


def test_the_automatic_choice_solves_and_differentiates_like_the_solver_it_stands_for(monkeypatch):
    case = make_case((2, 1, 5, True))
    weight = np.ones((6, 5, 1))
    expected = gradients("daqp", case, weight)
    for name in ("daqp", "torch"):
        monkeypatch.setattr(auto, "choose", lambda *_, name=name: name)
        assert_close(gradients("auto", case, weight), expected, 1e-8)


def test_daqp_gives_the_same_on_any_number_of_threads():
    case = make_case((4, 2, 10, True), n=80)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = make_solver("daqp").solve(case.problem, case.s0, case.weights)
        torch.set_num_threads(3)
        three = make_solver("daqp").solve(case.problem, case.s0, case.weights)
    finally:
        torch.set_num_threads(threads)
    assert three.solved.all()
    np.testing.assert_allclose(three.actions, one.actions, rtol=0, atol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_used_solver_can_be_pickled(solver):
    case = make_case((2, 1, 5, True))
    used = make_solver(solver)
    before = used.solve(case.problem, case.s0, case.weights)
    again = pickle.loads(pickle.dumps(used)).solve(case.problem, case.s0, case.weights)
    np.testing.assert_allclose(again.actions, before.actions, rtol=0, atol=1e-9)


def test_solutions_are_taken_apart_and_put_together():
    case = make_case((2, 1, 5, True))
    solution = make_solver("daqp").solve(case.problem, case.s0, case.weights)
    other = make_solver("daqp").solve(case.problem, -case.s0, case.weights)
    index = np.array([1, 3])
    expected = {name: np.array(getattr(solution, name)) for name in solution.__dataclass_fields__}
    solution.replace(index, other[index])
    for name, before in expected.items():
        after = getattr(solution, name)
        np.testing.assert_array_equal(after[index], getattr(other, name)[index])
        np.testing.assert_array_equal(np.delete(after, index, axis=0), np.delete(before, index, axis=0))
