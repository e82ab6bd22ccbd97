"""The global reference finds the cheapest plan of all contact modes, and the controller comes near it."""

from __future__ import annotations

import csv
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

pytest.importorskip("pyscipopt")

from benchmarks import relaxation
from benchmarks.global_optimum import PROVEN, global_optimum
from benchmarks.references import oracle_controller
from contact_envs.dynamics import tip_position
from sb3_mpc_policy import LcsMpc, LinearComplementaritySystem, QuadraticReward
from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import RelaxedProblem
from sb3_mpc_policy.simulation import LcsSimulator

ENVS = ("CartPoleSoftWallsPyBullet-v0", "CartPoleSoftWallsHardPyBullet-v0")
# Pressed against a wall, about to hit one, and in between.
STATES = np.array([[0.30, 0.6, 0.10, 0.4], [0.25, 1.0, 0.10, 1.0], [-0.2, -0.9, -0.21, -1.0], [0.05, 0.1, -0.05, 0.1]])


def problem_of(controller: LcsMpc) -> RelaxedProblem:
    return controller._current_problem()


def cost_of(problem: RelaxedProblem, s0: np.ndarray, actions: np.ndarray) -> float:
    rollout = LcsSimulator(problem.model).under(s0[None], actions[None])
    return float(problem.cost(rollout.states, rollout.actions)[0])


def cheapest_of_all_modes(problem: RelaxedProblem, s0: np.ndarray) -> float:
    """Every mode of every step in turn: with lam_alpha = -F_aa^-1 q_alpha the states are linear in the actions, and
    what is left is a convex problem under linear constraints, for SciPy's SLSQP."""
    A, B, C, d, D, E, F, c = problem.model
    n_x, n_a, n_c = problem.sizes
    H, best = problem.horizon, np.inf
    for modes in product(product([False, True], repeat=n_c), repeat=H):
        # s = S a + o, rows of (G, g): G a + g >= 0
        S, o, constraints = np.zeros((n_x, H * n_a)), s0, []
        trajectory = [(S, o)]
        for k, mode in enumerate(modes):
            take = np.zeros((n_a, H * n_a))
            take[:, k * n_a : (k + 1) * n_a] = np.eye(n_a)
            q, r = D @ S + E @ take, D @ o + c
            on = np.flatnonzero(mode)
            lam, offset = np.zeros((n_c, H * n_a)), np.zeros(n_c)
            if len(on):
                inverse = np.linalg.inv(F[np.ix_(on, on)])
                lam[on], offset[on] = -inverse @ q[on], -inverse @ r[on]
            off = np.flatnonzero(~np.array(mode))
            constraints += [(lam[on], offset[on]), ((q + F @ lam)[off], (r + F @ offset)[off])]
            S, o = A @ S + B @ take + C @ lam, A @ o + d + C @ offset
            trajectory.append((S, o))
        G, g = np.concatenate([m for m, _ in constraints]), np.concatenate([v for _, v in constraints])
        low, high = np.tile(problem.action_low, H), np.tile(problem.action_high, H)

        def cost(a: np.ndarray, path: list = trajectory) -> float:
            states = np.array([S @ a + o for S, o in path])
            return float(problem.cost(states[None], a.reshape(1, H, n_a))[0])

        found = minimize(
            cost, np.zeros(H * n_a), method="SLSQP", bounds=list(zip(low, high, strict=True)),
            constraints={"type": "ineq", "fun": lambda a, G=G, g=g: G @ a + g, "jac": lambda a, G=G: G},
            options={"ftol": 1e-12, "maxiter": 300},
        )  # fmt: skip
        if (G @ found.x + g >= -1e-7).all():
            best = min(best, cost_of(problem, s0, np.clip(found.x, low, high).reshape(H, n_a)))
    return best


@pytest.mark.parametrize("env_id", ENVS)
@pytest.mark.parametrize("horizon", [1, 3])
def test_no_mode_of_the_cart_pole_is_cheaper_than_the_global_optimum(env_id: str, horizon: int) -> None:
    controller = oracle_controller(env_id, horizon=horizon)
    problem = problem_of(controller)
    touched = 0
    for s0 in STATES / controller.lcs.state_scale.numpy():
        found = global_optimum(problem, s0, np.zeros((horizon, 1)))
        assert found.proven
        reference = cheapest_of_all_modes(problem, s0)
        assert found.cost == pytest.approx(reference, rel=PROVEN)
        assert found.bound <= reference * (1.0 + 1e-7)
        assert found.cost == pytest.approx(cost_of(problem, s0, found.actions), rel=1e-12)
        touched += LcsSimulator(problem.model).under(s0[None], found.actions[None]).forces.max() > 0.0
    assert touched >= 1


@pytest.mark.parametrize("seed", range(3))
def test_nor_is_one_of_a_random_model_with_drift_slopes_and_two_actions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n_x, n_a, n_c = 3, 2, 2
    F = rng.normal(size=(n_c, n_c))
    lcs = LinearComplementaritySystem.from_matrices(
        *LcsMatrices(
            np.eye(n_x) + 0.3 * rng.normal(size=(n_x, n_x)), rng.normal(size=(n_x, n_a)), rng.normal(size=(n_x, n_c)),
            0.3 * rng.normal(size=n_x), rng.normal(size=(n_c, n_x)), rng.normal(size=(n_c, n_a)),
            F @ F.T + 0.5 * np.eye(n_c), 0.2 * rng.normal(size=n_c),
        )
    )  # fmt: skip
    reward = QuadraticReward([1.0, 2.0, 3.0], 0.5, [0.3, 0.0, -0.3])
    problem = problem_of(LcsMpc(lcs, reward, [-1.0, -0.5], [1.0, 0.5], horizon=2))
    s0 = rng.normal(size=n_x)
    found = global_optimum(problem, s0, np.zeros((2, n_a)))
    assert found.proven
    assert found.cost == pytest.approx(cheapest_of_all_modes(problem, s0), rel=PROVEN)


def test_a_plan_that_is_already_the_best_is_proven_and_a_bad_one_is_beaten() -> None:
    controller = oracle_controller(ENVS[0], horizon=relaxation.HORIZON)
    problem, s0 = problem_of(controller), STATES[1] / controller.lcs.state_scale.numpy()
    first = global_optimum(problem, s0, np.zeros((problem.horizon, 1)))
    assert first.proven and first.cost < 0.9 * cost_of(problem, s0, np.zeros((problem.horizon, 1)))
    again = global_optimum(problem, s0, first.actions)
    assert again.proven
    assert again.cost == pytest.approx(first.cost, rel=PROVEN)


def test_without_time_nothing_is_proven() -> None:
    controller = oracle_controller(ENVS[0], horizon=relaxation.HORIZON)
    problem, s0 = problem_of(controller), STATES[1] / controller.lcs.state_scale.numpy()
    known = np.zeros((problem.horizon, 1))
    found = global_optimum(problem, s0, known, time_limit=0.0)
    assert not found.proven
    assert found.cost <= cost_of(problem, s0, known) * (1.0 + 1e-12)


@pytest.mark.parametrize(
    ("s0", "known", "message"),
    [
        (np.zeros(3), np.zeros((10, 1)), r"^s0 must have shape \(4,\), got \(3,\)"),
        (np.zeros(4), np.zeros(10), r"^known must have shape \(10, 1\), got \(10,\)"),
        (np.zeros(4), np.full((10, 1), 2.0), r"^known must lie between \[-1\.\] and \[1\.\], got"),
    ],
)
def test_impossible_arguments_are_named(s0: np.ndarray, known: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        global_optimum(problem_of(oracle_controller(ENVS[0], horizon=relaxation.HORIZON)), s0, known)


@pytest.mark.parametrize("env_id", ENVS)
def test_the_controllers_plans_are_near_the_global_optimum(env_id: str) -> None:
    """Within 1 % in the median, and within 10 % in 95 of 100."""
    controller = oracle_controller(env_id, horizon=relaxation.HORIZON)
    states = relaxation.start_states(env_id, 20, seed=3_000_000)
    plan = controller.plan(states)
    found = relaxation.optima(env_id, states, plan.actions, jobs=1)
    assert all(optimum.proven for optimum in found)
    gap = plan.cost / np.array([optimum.cost for optimum in found]) - 1.0
    assert (gap >= -PROVEN).all()
    assert np.median(gap) <= 0.01
    assert np.mean(gap <= 0.10) >= 0.95


# -- the benchmark's own parts --


def test_the_states_are_fixed_and_have_the_walls_among_them() -> None:
    states = relaxation.start_states(ENVS[0], 20)
    assert states.shape == (20, 4)
    np.testing.assert_array_equal(states, relaxation.start_states(ENVS[0], 20))
    assert not np.isclose(states, relaxation.start_states(ENVS[0], 20, seed=1)).any()
    with relaxation.cart_pole(ENVS[0]) as plant:
        distance = np.abs(np.abs(tip_position(states, plant.parameters)) - plant.parameters.wall_distance)
        assert (np.abs(states[:14]) <= plant.reset_range).all()
    assert (distance[8:14] < relaxation.NEAR_WALL).all()


def test_the_benchmark_writes_a_row_a_setting_and_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = [setting for setting in relaxation.SETTINGS if setting.family in ("default", "nominal", "constant penalty")]
    monkeypatch.setattr(relaxation, "SETTINGS", kept)
    threads = torch.get_num_threads()
    output, image = tmp_path / "relaxation.csv", tmp_path / "relaxation.png"
    rows = relaxation.main(["--env", ENVS[0], "--states", "5", "--output", str(output), "--picture", str(image)])
    torch.set_num_threads(threads)
    assert image.stat().st_size > 10_000
    with output.open(newline="") as file:
        written = list(csv.DictReader(file))
    assert [(line["family"], line["setting"]) for line in written] == [(s.family, s.label) for s in kept]
    assert all(int(line["states"]) == int(line["proven"]) == 5 for line in written)
    weak = next(row for row in rows if (row.family, row.setting) == ("constant penalty", "100"))
    assert weak.exact < 1.0 and weak.max_gap > 0.1  # a constant, weak penalty invents forces
