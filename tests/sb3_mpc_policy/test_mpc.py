"""The controller: the relaxation of eq (6) and its derivative, in the environment's units, and what happens when it
fails."""

from __future__ import annotations

import copy
import pickle
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from contact_envs.dynamics import true_lcs
from sb3_mpc_policy.lcs import LcsMatrices, LinearComplementaritySystem
from sb3_mpc_policy.mpc import LcsMpc, MpcPlan, complementarity_weights
from sb3_mpc_policy.reward import QuadraticReward
from sb3_mpc_policy.simulation import LcsSimulator
from sb3_mpc_policy.solvers import SOLVERS
from sb3_mpc_policy.terminal_value import QuadraticCritic

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

REWARD = QuadraticReward([20.0, 20.0, 0.1, 0.1], 10.0, constant=15.0)
# In free motion, then pressed against each wall, then about to hit one.
STATES = np.array([
    [0.05, 0.1, -0.05, 0.1], [0.30, 0.6, 0.10, 0.4], [-0.30, -0.8, -0.1, -0.5], [0.25, 1.0, 0.02, 1.0],
])  # fmt: skip


@pytest.fixture
def make(cart_pole):
    """``(**arguments)``: a controller of the true cart-pole."""

    def controller(lcs: LinearComplementaritySystem | None = None, **arguments) -> LcsMpc:
        lcs = cart_pole() if lcs is None else lcs
        low, high = arguments.pop("low", [-1.0]), arguments.pop("high", [1.0])
        return LcsMpc(lcs, arguments.pop("reward", REWARD), low, high, **arguments)

    return controller


def environment_model(controller: LcsMpc) -> LcsMatrices[np.ndarray]:
    return LcsMatrices(*(matrix.detach().numpy() for matrix in controller.lcs.matrices()))


def rollout(controller: LcsMpc, s0: np.ndarray, actions: np.ndarray):
    """The LCS itself under the actions, environment units."""
    model = environment_model(controller)
    return LcsSimulator(model).under(s0, actions)


def assert_same_plan(one: MpcPlan, other: MpcPlan, tolerance: float = 1e-7) -> None:
    for field in fields(MpcPlan):
        first, second = getattr(one, field.name), getattr(other, field.name)
        if field.name == "status":
            np.testing.assert_array_equal(first, second)
        else:
            size = 1.0 + np.abs(second).max(initial=0.0)
            np.testing.assert_allclose(first, second, rtol=0, atol=tolerance * size, err_msg=field.name)


# -- the relaxation's weights -----------------------------------------------------------------------------------------


def test_without_smoothing_the_weights_name_the_mode():
    """All penalty on the gap in contact, and on the force (in units of gap) out of it."""
    forces, gaps = np.array([[[3.0, 0.0]]]), np.array([[[0.0, 0.2]]])
    weights = complementarity_weights(forces, gaps, np.array([2.0, 5.0]), penalty=100.0, smoothing=0.0)
    np.testing.assert_array_equal(weights.gap, [[[100.0, 0.0]]])
    np.testing.assert_array_equal(weights.force, [[[0.0, 500.0]]])


def test_where_force_and_gap_both_vanish_the_weights_are_shared():
    weights = complementarity_weights(np.zeros((1, 1, 1)), np.zeros((1, 1, 1)), np.array([4.0]), 10.0, 0.0)
    assert weights.gap.item() == 5.0
    assert weights.force.item() == 20.0


@pytest.mark.parametrize("smoothing", [0.0, 1e-6, 1e-2, 1.0])
def test_the_weights_share_the_penalty_and_belong_to_a_smoothed_nominal(smoothing):
    rng = np.random.default_rng(0)
    in_contact = rng.random((5, 4, 3)) < 0.5
    forces, gaps = np.where(in_contact, rng.random((5, 4, 3)), 0.0), np.where(in_contact, 0.0, rng.random((5, 4, 3)))
    stiffness = np.array([0.5, 1.0, 3.0])
    weights = complementarity_weights(forces, gaps, stiffness, 7.0, smoothing)
    np.testing.assert_allclose(weights.gap + weights.force / stiffness, np.full((5, 4, 3), 7.0))
    assert min(weights.gap.min(), weights.force.min()) >= 0.0
    # l = F_ii lam and phi with the nominal's difference and the product epsilon; the gap's weight is l's share
    u = forces * stiffness - gaps
    total = np.sqrt(u**2 + 4 * smoothing)
    l, phi = weights.gap / 7.0 * total, weights.force / stiffness / 7.0 * total  # noqa: E741
    np.testing.assert_allclose(l - phi, u, atol=1e-12)
    np.testing.assert_allclose(l * phi, np.full(u.shape, smoothing), atol=1e-12)


def test_smoothing_makes_the_weights_a_smooth_function_of_the_nominal():
    """From a gap of 2 to a force of 2: a step without smoothing, a slope with it; the limit is the step."""
    u = np.linspace(-2.0, 2.0, 401)[None, :, None]
    forces, gaps = np.maximum(u, 0.0), np.maximum(-u, 0.0)

    def jump(smoothing: float) -> float:
        return float(
            np.abs(np.diff(complementarity_weights(forces, gaps, np.ones(1), 1.0, smoothing).gap[0, :, 0])).max()
        )

    assert jump(0.0) >= 0.5 - 1e-12
    assert jump(0.1) < 0.02
    far = np.abs(u[0, :, 0]) > 0.1
    sharp = complementarity_weights(forces, gaps, np.ones(1), 1.0, 0.0).gap[0, far, 0]
    nearly = complementarity_weights(forces, gaps, np.ones(1), 1.0, 1e-9).gap[0, far, 0]
    np.testing.assert_allclose(nearly, sharp, atol=1e-6)


# -- the plan ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_plan_has_the_documented_shapes(make, solver):
    controller = make(horizon=4, solver=solver)
    for states, n in ((STATES, 4), (STATES[0], 1), (STATES[:1], 1)):
        plan = controller.plan(states)
        assert plan.actions.shape == (n, 4, 1)
        assert plan.states.shape == (n, 5, 4)
        assert plan.contact_forces.shape == plan.gaps.shape == (n, 4, 2)
        assert plan.cost.shape == plan.complementarity.shape == plan.status.shape == (n,)
        assert (plan.status == "solved").all()
        np.testing.assert_allclose(plan.states[:, 0], np.atleast_2d(states), atol=1e-9)


def test_where_the_relaxation_is_exact_the_plan_is_what_the_model_does(make):
    """In contact, with the reported forces, gaps and cost. A weaker penalty on the last state is not exact."""
    controller = make(n_iterations=2)
    plan = controller.plan(STATES)
    exact = plan.complementarity < 1e-9
    np.testing.assert_array_equal(exact, [True, True, True, False])
    assert (make().plan(STATES).complementarity < 1e-9).all()
    assert (plan.contact_forces[1:3] > 1.0).any(axis=(1, 2)).all()  # newtons
    real = rollout(controller, STATES, plan.actions)
    np.testing.assert_allclose(plan.states[exact], real.states[exact], atol=1e-7)
    np.testing.assert_allclose(plan.contact_forces[exact], real.forces[exact], atol=1e-4)
    np.testing.assert_allclose(plan.gaps[exact], real.gaps[exact], atol=1e-7)
    assert np.abs(plan.states[~exact] - real.states[~exact]).max() > 1e-4  # and where it is not, it is not


def test_a_weak_penalty_invents_forces_and_says_so(make):
    controller = make(penalty=1e-3, n_iterations=1)
    plan = controller.plan(STATES)
    assert plan.complementarity.max() > 1e-3
    assert np.abs(plan.states - rollout(controller, STATES, plan.actions).states).max() > 1e-2


def test_the_cost_is_the_return_lost_when_the_model_follows_the_plan(make):
    controller = make(terminal_value="none", penalty=1.0)  # a plan that is not exact
    plan = controller.plan(STATES)
    real = rollout(controller, STATES, plan.actions)
    stage = (real.states[:, :-1] ** 2 @ np.array([20.0, 20.0, 0.1, 0.1])).sum(axis=1) + 10.0 * (plan.actions**2).sum(
        (1, 2)
    )
    np.testing.assert_allclose(plan.cost, stage, rtol=1e-4)


def test_no_other_action_found_by_search_is_better_in_free_motion(make):
    """The whole problem by shooting, with SciPy's bounded quasi-Newton; contacts stay open."""
    controller = make(horizon=5, low=[-0.01], high=[0.01])
    s0 = np.array([[0.05, 0.02, -0.02, 0.05]])
    plan = controller.plan(s0)

    def cost(actions: np.ndarray) -> float:
        real = rollout(controller, s0, actions.reshape(1, 5, 1))
        states = real.states[0] / controller.lcs.state_scale.numpy()
        P, p = controller.terminal_weight.numpy(), controller.terminal_slope.numpy()
        stage = (real.states[0, :-1] ** 2 @ np.array([20.0, 20.0, 0.1, 0.1])).sum() + 10.0 * (actions**2).sum()
        return stage + states[-1] @ P @ states[-1] + p @ states[-1]

    best = minimize(cost, np.zeros(5), bounds=[(-0.01, 0.01)] * 5, options={"ftol": 1e-15, "gtol": 1e-10})
    assert np.isclose(np.abs(plan.actions), 0.01).any()
    np.testing.assert_allclose(plan.cost[0], best.fun, rtol=1e-5)
    np.testing.assert_allclose(plan.actions[0, :, 0], best.x, atol=1e-3)


def test_in_contact_the_plan_beats_the_regulator_and_a_search_from_it(make):
    """Eq (6) with its complementarity, by derivative-free search over two actions from the regulator's."""
    controller = make(horizon=2, terminal_value="none", reward=QuadraticReward([20.0, 20.0, 0.1, 0.1], 0.1))
    for s0 in STATES[1:3, None]:
        plan = controller.plan(s0)
        assert (plan.contact_forces > 1.0).any()

        def cost(actions: np.ndarray, s0: np.ndarray = s0) -> float:
            clipped = np.clip(actions, -1.0, 1.0).reshape(1, 2, 1)
            states = rollout(controller, s0, clipped).states[0, :-1]
            return float((states**2 @ np.array([20.0, 20.0, 0.1, 0.1])).sum() + 0.1 * (clipped**2).sum())

        best = min(minimize(cost, [x, y], method="Nelder-Mead").fun for x in (-0.5, 0.5) for y in (-0.5, 0.5))
        assert plan.cost[0] <= best + 1e-3 * abs(best)


@pytest.mark.parametrize("bounds", [([-0.02], [0.5]), ([-np.inf], [0.1]), ([-np.inf], [np.inf])])
def test_the_plan_respects_the_bounds_in_environment_units(make, cart_pole, bounds):
    lcs = LinearComplementaritySystem.from_matrices(*true_lcs(), state_scale=[0.35, 1.0, 0.3, 1.0], action_scale=[7.0])
    low, high = bounds
    plan = make(lcs, low=low, high=high).plan(np.vstack([STATES, -STATES]))
    assert (plan.actions >= np.array(low) - 1e-9).all()
    assert (plan.actions <= np.array(high) + 1e-9).all()
    for limit in (low[0], high[0]):
        assert not np.isfinite(limit) or np.isclose(plan.actions, limit, rtol=0, atol=1e-9).any()


@pytest.mark.parametrize("n_contacts", [0, 2])
def test_a_horizon_of_one_step(random_model, n_contacts):
    """Minimise r(s0, a) + V(s1) over one action: a parabola, cut at the bounds."""
    controller = LcsMpc(random_model(3, 2, 1, n_contacts), None, [-0.5], [0.5], horizon=1)
    s0 = np.random.default_rng(0).normal(size=(5, 2))
    plan = controller.plan(s0)
    grid = np.linspace(-0.5, 0.5, 2001)
    for i in range(5):
        real = rollout(controller, np.repeat(s0[i : i + 1], len(grid), axis=0), grid[:, None, None])
        scaled = real.states[:, 1] / controller.lcs.state_scale.numpy()
        P, p = controller.terminal_weight.numpy(), controller.terminal_slope.numpy()
        cost = (
            (grid / controller.lcs.action_scale.item()) ** 2 + np.einsum("ni,ij,nj->n", scaled, P, scaled) + scaled @ p
        )
        assert abs(grid[cost.argmin()] - plan.actions[i, 0, 0]) < 2e-3


def test_without_contacts_and_bounds_the_controller_is_the_regulator(random_model):
    controller = LcsMpc(
        random_model(4, 3, 2, 0), QuadraticReward([1.0, 2.0, 3.0], 1.0, [0.5, 0.0, -0.5]), [-np.inf] * 2, [np.inf] * 2
    )
    assert controller.refresh() == "riccati"
    s0 = np.random.default_rng(0).normal(size=(6, 3))
    plan = controller.plan(s0)
    scaled = plan.states[:, :-1] / controller.lcs.state_scale.numpy()
    expected = scaled @ controller.feedback_gain.numpy().T + controller.feedback_offset.numpy()
    np.testing.assert_allclose(plan.actions / controller.lcs.action_scale.numpy(), expected, atol=1e-4)


# -- the relaxation loop ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("penalty", [1.0, 30.0, 1000.0])
def test_another_pass_never_makes_the_plan_worse_for_the_model_itself(make, penalty):
    rng = np.random.default_rng(0)
    s0 = rng.uniform(-1, 1, (60, 4)) * [0.35, 1.0, 0.3, 1.0]
    costs = [make(penalty=penalty, n_iterations=n).plan(s0).cost for n in (1, 2, 3, 5)]
    for fewer, more in pairwise(costs):
        assert (more <= fewer + 1e-9 * np.abs(fewer)).all()
    if penalty < 1000.0:
        assert (costs[-1] < 0.999 * costs[0]).any()


def test_the_previous_plan_competes_for_the_first_nominal(make):
    """A previous plan that is better than the regulator's changes what comes out, one that is worse does not."""
    s0 = np.random.default_rng(0).uniform(-1, 1, (60, 4)) * [0.35, 1.0, 0.3, 1.0]
    controller = make(n_iterations=1)
    good, fresh = make(n_iterations=8).plan(s0), controller.plan(s0)
    earlier = np.concatenate([good.actions[:, :1], good.actions[:, :-1]], axis=1)  # shifted by a step it is good's
    warm = controller.plan(s0, previous=replace(good, actions=earlier))
    assert (warm.cost < 0.999 * fresh.cost).any()
    exact = warm.complementarity < 1e-9
    assert exact.any()
    assert (warm.cost[exact] <= good.cost[exact] * (1.0 + 1e-6)).all()
    bad = controller.plan(s0, previous=replace(good, actions=np.full_like(good.actions, 1.0)))
    assert_same_plan(bad, fresh)


def test_a_previous_plan_of_another_shape_is_refused(make):
    controller = make(horizon=5)
    for wrong in (controller.plan(STATES[:2]), make(horizon=4).plan(STATES)):
        with pytest.raises(ValueError, match=r"^previous must hold actions of shape \(4, 5, 1\)"):
            controller.plan(STATES, previous=wrong)


def test_a_batch_is_planned_state_by_state(make):
    controller = make()
    together = controller.plan(STATES)
    for i, state in enumerate(STATES):
        np.testing.assert_allclose(controller.plan(state).actions[0], together.actions[i], atol=1e-8)
    np.testing.assert_allclose(controller.plan(STATES[::-1]).actions, together.actions[::-1], atol=1e-8)


def test_where_a_contact_only_touches_the_next_pass_tries_the_other_mode(make):
    """A pole that moves towards a wall: pressed into it sooner and harder, it comes back sooner. The passes in which
    the penalty no longer grows find that, one step of contact after the other."""
    s0 = np.array([[0.18, 0.3, 0.2, -0.1]])
    costs, touched = [], []
    for n_iterations in (3, 4, 5, 6, 7, 8):
        plan = make(n_iterations=n_iterations).plan(s0)
        costs.append(plan.cost[0])
        touched.append(int((plan.contact_forces[0] > 1e-6).any(axis=1).sum()))
    assert costs[-1] < 0.5 * costs[0]
    assert touched == sorted(touched) and touched[-1] > touched[0]


# -- units and symmetries ---------------------------------------------------------------------------------------------


def test_the_plan_does_not_depend_on_the_units_of_state_and_action(make, cart_pole):
    """Millimetres and degrees, and an action in percent; the scales follow the units."""
    matrices = true_lcs()
    u, v = np.array([1e3, 1e3, 57.3, 57.3]), np.array([100.0])
    scale = np.array([0.35, 1.0, 0.3, 1.0])
    other = LinearComplementaritySystem.from_matrices(
        A=matrices.A * u[:, None] / u, B=matrices.B * u[:, None] / v, C=matrices.C * u[:, None], d=matrices.d * u,
        D=matrices.D / u, E=matrices.E / v, F=matrices.F, c=matrices.c, state_scale=scale * u, action_scale=v,
    )  # fmt: skip
    reward = QuadraticReward(np.array([20.0, 20.0, 0.1, 0.1]) / u**2, 10.0 / v**2)
    plain = make().plan(STATES)
    converted = make(other, reward=reward, low=-v, high=v).plan(STATES * u)
    assert (plain.contact_forces > 1.0).any()
    assert_same_plan(replace(converted, actions=converted.actions / v, states=converted.states / u), plain, 1e-6)


def test_the_order_of_the_contacts_does_not_matter(random_model):
    order = np.array([2, 0, 3, 1])
    matrices = LcsMatrices(*(m.detach().numpy() for m in random_model(5, 3, 2, 4).matrices()))
    permuted = matrices._replace(
        C=matrices.C[:, order], D=matrices.D[order], E=matrices.E[order], F=matrices.F[np.ix_(order, order)],
        c=matrices.c[order],
    )  # fmt: skip
    s0 = np.random.default_rng(0).normal(size=(10, 3))
    plans = [
        LcsMpc(LinearComplementaritySystem.from_matrices(*m), None, [-1.0] * 2, [1.0] * 2, horizon=5).plan(s0)
        for m in (matrices, permuted)
    ]
    assert (plans[0].contact_forces > 1e-3).any()
    back = np.argsort(order)
    plain = replace(plans[1], contact_forces=plans[1].contact_forces[..., back], gaps=plans[1].gaps[..., back])
    assert_same_plan(plain, plans[0], 1e-6)


def test_the_mirror_image_of_the_cart_pole_is_controlled_by_the_mirror_image(make):
    controller = make()
    plan, mirrored = controller.plan(STATES), controller.plan(-STATES)
    assert (plan.contact_forces > 1.0).any()
    swapped = replace(
        mirrored, actions=-mirrored.actions, states=-mirrored.states, gaps=mirrored.gaps[..., ::-1],
        contact_forces=mirrored.contact_forces[..., ::-1],
    )  # fmt: skip
    assert_same_plan(swapped, plan, 1e-7)


# -- the derivative of the mean action --------------------------------------------------------------------------------


def mean_action_gradients(controller: LcsMpc, s0: np.ndarray, weight: np.ndarray) -> dict[str, np.ndarray]:
    start = torch.tensor(s0, requires_grad=True)
    controller.zero_grad()
    (controller(start) * torch.as_tensor(weight)).sum().backward()
    found = {}
    for name, parameter in controller.named_parameters():
        gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        found[name] = gradient.numpy().copy()
    return found | {"s0": start.grad.numpy()}


@pytest.mark.parametrize("n_contacts", [0, 2])
@pytest.mark.parametrize("bound", [0.5, np.inf])
def test_the_mean_actions_derivative_end_to_end(
    random_model, parameter_gradients, central_difference, n_contacts, bound
):
    """Through units, nominal and relaxation. Without smoothing the weights are locally constant, so that differences
    of ``forward`` are those with weights frozen."""
    controller = LcsMpc(random_model(4, 3, 2, n_contacts), None, [-bound] * 2, [bound] * 2, horizon=6, smoothing=0.0)
    rng = np.random.default_rng(0)
    s0 = rng.normal(size=(12, 3)) * np.linspace(0.05, 1.0, 12)[:, None]
    plan = controller.plan(s0)
    if n_contacts:
        assert (plan.contact_forces[:, 0] > 1e-2).any()
    first_at_bound = np.isclose(np.abs(plan.actions[:, 0]), bound)
    assert first_at_bound.any() == np.isfinite(bound)
    assert not first_at_bound.all()
    weight = rng.normal(size=(12, 2))

    @torch.no_grad()
    def value(s: np.ndarray = s0) -> float:
        return float((controller(torch.as_tensor(s)).numpy() * weight).sum())

    expected = parameter_gradients(controller, value, 1e-6) | {"s0": central_difference(value, s0, 1e-6)}
    found = mean_action_gradients(controller, s0, weight)
    assert set(found) == set(expected)
    assert np.abs(found["lcs.A_scaled"]).max() > 1e-4
    for name, reference in expected.items():
        error = np.abs(found[name] - reference).max(initial=0.0)
        assert error <= 1e-4 * max(np.abs(reference).max(initial=0.0), 1e-2), name


@pytest.mark.parametrize(("solver", "of_plan", "of_gradient"), [("torch", 1e-8, 1e-8), ("cvxpylayers", 1e-4, 1e-2)])
def test_the_solvers_agree_on_the_cart_poles_plan_and_derivative(make, solver, of_plan, of_gradient):
    """Walls, bounds and the default penalty. The layer's derivative is good to about 1e-3 here."""
    plans, found = [], []
    for name in (solver, "daqp"):
        controller = make(solver=name, horizon=5)
        plans.append(controller.plan(STATES))
        found.append(mean_action_gradients(controller, STATES[:2], np.ones((2, 1))))
    assert_same_plan(*plans, of_plan)
    for name, reference in found[1].items():
        size = np.abs(reference).max(initial=1e-2)
        np.testing.assert_allclose(found[0][name], reference, rtol=0, atol=of_gradient * size, err_msg=name)


def test_the_mean_action_is_the_first_of_the_plan_in_the_policys_dtype(make):
    matrices = true_lcs()
    lcs = LinearComplementaritySystem.from_matrices(*matrices, state_scale=[0.35, 1.0, 0.3, 1.0], action_scale=[7.0])
    controller = make(lcs)
    for dtype in (torch.float32, torch.float64):
        mean = controller(torch.as_tensor(STATES, dtype=dtype))
        assert mean.dtype == dtype
        np.testing.assert_allclose(mean.detach(), controller.plan(STATES).actions[:, 0], atol=1e-5)
    with torch.no_grad():
        assert not controller(torch.as_tensor(STATES)).requires_grad


# -- failure ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def failing(make, monkeypatch):
    """A controller whose solver fails on the states with index 1 and 3, and leaves rubbish behind."""
    controller = make()
    solve = controller.solver.solve
    bad = STATES[1::2] / controller.lcs.state_scale.numpy()

    def fails(problem, s0, weights):
        solution = solve(problem, s0, weights)
        failed = np.isclose(s0[:, None], bad).all(axis=2).any(axis=1)
        for values in (solution.actions, solution.states, solution.forces, solution.gaps, solution.multipliers):
            values[failed] = np.nan
        solution.solved[failed] = False
        return solution

    monkeypatch.setattr(controller.solver, "solve", fails)
    return controller


def test_where_the_solver_fails_the_regulators_plan_stands_in(make, failing):
    plan, healthy = failing.plan(STATES), make().plan(STATES)
    np.testing.assert_array_equal(plan.status, ["solved", "fallback", "solved", "fallback"])
    for field in fields(MpcPlan):
        if field.name != "status":
            assert np.isfinite(getattr(plan, field.name)).all(), field.name
    np.testing.assert_allclose(plan.actions[::2], healthy.actions[::2], atol=1e-9)
    assert (np.abs(plan.actions) <= 1.0).all()
    # the regulator's actions along its own simulation of the model, clipped
    s = plan.states[1::2, :-1] / failing.lcs.state_scale.numpy()
    expected = np.clip(s @ failing.feedback_gain.numpy().T + failing.feedback_offset.numpy(), -1.0, 1.0)
    np.testing.assert_allclose(plan.actions[1::2], expected, atol=1e-9)
    np.testing.assert_allclose(plan.states, rollout(failing, STATES, plan.actions).states, atol=1e-7)


def test_a_failed_solve_is_counted_and_has_no_gradient(failing):
    s = torch.tensor(STATES, requires_grad=True)
    mean = failing(s)
    assert torch.isfinite(mean).all()
    assert failing.statistics.plans == 4
    assert failing.statistics.failed == 2
    mean.sum().backward()
    assert not s.grad[1::2].any()
    assert s.grad[::2].any(dim=1).all()
    assert all(torch.isfinite(parameter.grad).all() for parameter in failing.parameters() if parameter.grad is not None)


def test_when_every_solve_fails_there_is_no_gradient_at_all(make, monkeypatch):
    controller = make()
    solve = controller.solver.solve

    def fails(*arguments):
        solution = solve(*arguments)
        solution.solved[:] = False
        return solution

    monkeypatch.setattr(controller.solver, "solve", fails)
    mean = controller(torch.tensor(STATES, requires_grad=True))
    assert torch.isfinite(mean).all()
    assert not mean.requires_grad
    assert (controller.plan(STATES).status == "fallback").all()


def test_a_model_that_is_not_finite_still_gives_a_finite_action(make):
    controller = make()
    with torch.no_grad():
        controller.lcs.A_scaled[0, 0] = np.nan
    controller.refresh()
    with torch.no_grad():
        mean = controller(torch.as_tensor(STATES))
    assert torch.isfinite(mean).all()
    assert (mean.abs() <= 1.0).all()
    assert controller.statistics.failed == 4
    assert np.isfinite(controller.plan(STATES).actions).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_observation_that_is_not_finite_is_named(make, bad):
    controller, states = make(), STATES.copy()
    states[2, 1] = bad
    with pytest.raises(ValueError, match=r"^observations must be finite, got \[-0\.3"):
        controller.plan(states)
    with pytest.raises(ValueError, match=r"^observations must be finite"):
        controller(torch.as_tensor(states))


def test_states_of_the_wrong_shape_are_named(make):
    for states in (np.zeros(3), np.zeros((2, 5)), np.zeros((1, 2, 4))):
        with pytest.raises(ValueError, match=r"^states must have shape \(N, 4\), got"):
            make().plan(states)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0}, r"^horizon must be an integer >= 1, got 0"),
        ({"horizon": 2.5}, r"^horizon must be an integer >= 1, got 2\.5"),
        ({"n_iterations": 0}, r"^n_iterations must be an integer >= 1, got 0"),
        ({"penalty": 0.0}, r"^penalty must be a finite number > 0, got 0\.0"),
        ({"penalty": np.inf}, r"^penalty must be a finite number > 0, got inf"),
        ({"smoothing": -1e-9}, r"^smoothing must be a finite number >= 0, got -1e-09"),
        ({"smoothing": np.nan}, r"^smoothing must be a finite number >= 0, got nan"),
        ({"terminal_value": "lqr"}, r"^terminal_value must be one of \['critic', 'none', 'riccati'\], got 'lqr'"),
        ({"solver": "osqp"}, r"^solver must be 'auto' or one of \['cvxpylayers', 'daqp', 'torch'\], got 'osqp'"),
        ({"low": [1.0], "high": [1.0]}, r"^action_low and action_high must be 1 numbers with low < high"),
        ({"low": [np.nan]}, r"^action_low and action_high must be 1 numbers with low < high"),
        ({"low": [-1.0, -1.0], "high": [1.0, 1.0]}, r"^action_low and action_high must be 1 numbers"),
        ({"reward": QuadraticReward([1.0], 1.0)}, r"^state_weight must be for 4 states"),
    ],
)
def test_impossible_arguments_are_named(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


# -- what changes between plans ---------------------------------------------------------------------------------------


def test_a_changed_model_cost_or_scale_changes_the_next_plan(make, cart_pole):
    """Nothing is kept that belongs to the model before; each change equals a controller made anew."""
    controller = make()
    controller.plan(STATES)

    def same_as_new() -> None:
        new = make(copy.deepcopy(controller.lcs))
        new.cost_weight.copy_(controller.cost_weight), new.cost_slope.copy_(controller.cost_slope)
        new.refresh(), controller.refresh()
        assert_same_plan(controller.plan(STATES), new.plan(STATES), 1e-9)

    with torch.no_grad():
        controller.lcs.B_scaled.mul_(0.8)
    same_as_new()
    controller.set_cost(QuadraticReward([5.0, 1.0, 1.0, 0.1], 1.0, [0.1, 0.0, 0.0, 0.0]).cost(4, 1))
    same_as_new()
    controller.lcs.set_scales([0.5, 2.0, 0.3, 1.0], [3.0])
    same_as_new()


def test_new_scales_reach_the_problem_where_nothing_else_changed(make):
    controller = make(terminal_value="none")
    controller.plan(STATES)
    controller.lcs.set_scales(action_scale=[4.0])
    assert np.abs(controller.plan(STATES).actions).max() <= 1.0 + 1e-9


def test_the_terminal_value_is_the_critics_once_there_is_one(make):
    controller = make(terminal_value="critic")
    assert not controller.terminal_weight.any()
    critic = QuadraticCritic(controller.lcs.state_scale)
    controller.refresh(critic, reward_scale=3.0)
    np.testing.assert_allclose(controller.terminal_weight, 3.0 * np.eye(4))
    with torch.no_grad():
        critic.factor.mul_(2.0)
    np.testing.assert_allclose(controller.terminal_weight, 3.0 * np.eye(4))  # constant until the next refresh
    controller.refresh(critic, reward_scale=3.0)
    np.testing.assert_allclose(controller.terminal_weight, 12.0 * np.eye(4))


def test_the_target_is_where_the_reward_is_largest(make):
    reward = QuadraticReward([1.0, 2.0, 3.0, 4.0], 1.0, [0.1, -0.2, 0.3, 0.0])
    np.testing.assert_allclose(make(reward=reward).target(), [0.1, -0.2, 0.3, 0.0], atol=1e-9)
    np.testing.assert_allclose(make(reward=None).target(), np.zeros(4), atol=1e-12)


def test_statistics_count_plans_contacts_and_time(make):
    controller = make()
    controller(torch.as_tensor(STATES)), controller(torch.as_tensor(STATES[:1]))
    counts = controller.statistics
    assert counts.plans == 5
    assert counts.failed == 0
    assert counts.in_contact == 3
    np.testing.assert_allclose(counts.complementarity, controller.plan(STATES).complementarity.max(), rtol=1e-6)
    assert counts.seconds > 0.0


# -- saving -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_saved_controller_plans_identically(make, solver):
    controller = make(solver=solver, horizon=3)
    with torch.no_grad():
        controller.lcs.B_scaled.mul_(1.1)
    controller.set_cost(QuadraticReward([1.0, 2.0, 3.0, 4.0], 1.0).cost(4, 1))
    controller.refresh()
    plan = controller.plan(STATES)
    other = make(LinearComplementaritySystem(4, 1, 2), solver=solver, horizon=3, reward=None)
    other.plan(STATES)
    other.load_state_dict(controller.state_dict())
    assert_same_plan(other.plan(STATES), plan, 1e-12 if solver == "daqp" else 1e-7)


def test_the_layers_buffers_stay_out_of_the_state_dict(make):
    controller = make(solver="cvxpylayers", horizon=2)
    before = set(controller.state_dict())
    controller.plan(STATES)
    assert set(controller.state_dict()) == before == set(make().state_dict())
    assert not [module for module in controller.modules() if "Cvxpy" in type(module).__name__]


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
def test_a_used_controller_can_be_copied_and_pickled(make, solver, duplicate):
    controller = make(solver=solver, horizon=2)
    plan = controller.plan(STATES)
    twin = duplicate(controller)
    assert_same_plan(twin.plan(STATES), plan, 1e-9)
    with torch.no_grad():
        twin.lcs.B_scaled.mul_(2.0)
    assert np.abs(twin.plan(STATES).actions - plan.actions).max() > 1e-3
    assert_same_plan(controller.plan(STATES), plan, 1e-9)  # and it is a copy
