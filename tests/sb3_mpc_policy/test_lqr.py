"""The regulator solves Bellman's equation, and says so where there is no solution."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from sb3_mpc_policy.lqr import AffineLqr, affine_lqr


def problem(seed: int, n_x: int = 3, n_a: int = 2, affine: bool = True) -> tuple[np.ndarray, ...]:
    """A random controllable system, open-loop unstable, with a coupled cost; slopes and drift where affine."""
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(n_x, n_x)), rng.normal(size=(n_x, n_a))
    A *= 1.2 / np.abs(np.linalg.eigvals(A)).max()
    G = rng.normal(size=(n_x + n_a, n_x + n_a))
    W = G @ G.T + 0.1 * np.eye(n_x + n_a)
    return A, B, affine * rng.normal(size=n_x), W, affine * rng.normal(size=n_x + n_a)


def stage_cost(W: np.ndarray, w: np.ndarray, s: np.ndarray, a: np.ndarray) -> np.ndarray:
    z = np.concatenate([s, a], axis=-1)
    return np.einsum("...i,ij,...j", z, W, z) + z @ w


def cost_to_go(lqr: AffineLqr, s: np.ndarray) -> np.ndarray:
    return np.einsum("...i,ij,...j", s, lqr.P, s) + s @ lqr.p


@pytest.mark.parametrize("seed", range(5))
def test_without_drift_and_slope_it_is_the_riccati_equation(seed):
    A, B, d, W, w = problem(seed, affine=False)
    lqr = affine_lqr(A, B, d, W, w)
    P = solve_discrete_are(A, B, W[:3, :3], W[3:, 3:], s=W[:3, 3:])
    assert lqr.source == "riccati"
    np.testing.assert_allclose(lqr.P, P, rtol=1e-9)
    K = -np.linalg.solve(W[3:, 3:] + B.T @ P @ B, B.T @ P @ A + W[3:, :3])
    np.testing.assert_allclose(lqr.K, K, rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(lqr.p, np.zeros(3))
    np.testing.assert_array_equal(lqr.k, np.zeros(2))


@pytest.mark.parametrize("seed", range(5))
def test_the_action_is_the_best_one_and_bellmans_equation_holds(seed):
    """cost + V(next) - V(s) is the same number at every state, and no other action makes it smaller."""
    A, B, d, W, w = problem(seed)
    lqr = affine_lqr(A, B, d, W, w)
    assert lqr.source == "riccati"
    rng = np.random.default_rng(9)
    s = rng.normal(size=(50, 3))

    def right_side(a: np.ndarray) -> np.ndarray:
        return stage_cost(W, w, s, a) + cost_to_go(lqr, s @ A.T + a @ B.T + d)

    a = s @ lqr.K.T + lqr.k
    average = right_side(a) - cost_to_go(lqr, s)
    np.testing.assert_allclose(average, average[0], rtol=0, atol=1e-7 * np.abs(lqr.P).max())
    for _ in range(10):
        assert (right_side(a + 0.1 * rng.normal(size=a.shape)) > right_side(a)).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_affine_part_is_the_limit_of_the_finite_horizon(seed):
    """All 40 steps at once, no recursion: the first action, and differences of the cost."""
    A, B, d, W, w = problem(seed, 2, 1)
    lqr = affine_lqr(A, B, d, W, w)
    H, n_x, n_a = 40, 2, 1
    starts = np.random.default_rng(1).normal(size=(4, n_x))

    # s_k = M_k U + A^k s_0 + m_k with U the stacked actions
    M, free, offset = np.zeros((n_x, H * n_a)), np.eye(n_x), np.zeros(n_x)
    Q, slope, slope_s0 = np.zeros((H * n_a, H * n_a)), np.zeros(H * n_a), np.zeros((H * n_a, n_x))
    constant = np.zeros(len(starts))
    for k in range(H):
        z, z_free = np.vstack([M, np.zeros((n_a, H * n_a))]), np.vstack([free, np.zeros((n_a, n_x))])
        z[n_x, k] = 1.0
        z_offset = np.concatenate([offset, np.zeros(n_a)])
        Q += z.T @ W @ z
        slope += z.T @ (2.0 * W @ z_offset + w)
        slope_s0 += 2.0 * z.T @ W @ z_free
        rest = starts @ z_free.T + z_offset
        constant += np.einsum("ni,ij,nj->n", rest, W, rest) + rest @ w
        M = A @ M
        M[:, k : k + 1] += B
        free, offset = A @ free, A @ offset + d
    # the terminal cost of the limit, so that a short horizon is enough
    Q += M.T @ lqr.P @ M
    slope += M.T @ (2.0 * lqr.P @ offset + lqr.p)
    slope_s0 += 2.0 * M.T @ lqr.P @ free
    constant += cost_to_go(lqr, starts @ free.T + offset)

    linear = starts @ slope_s0.T + slope
    U = np.linalg.solve(-2.0 * Q, linear.T).T
    np.testing.assert_allclose(U[:, 0], (starts @ lqr.K.T + lqr.k)[:, 0], rtol=1e-6, atol=1e-7)
    cost = constant + 0.5 * (U * linear).sum(axis=1)
    np.testing.assert_allclose(np.diff(cost), np.diff(cost_to_go(lqr, starts)), rtol=1e-6, atol=1e-7)


def test_a_reward_with_a_target_is_driven_to_it():
    """A double integrator with cost |s - target|²: the closed loop rests at the target."""
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
    target = np.array([2.0, 0.0])
    W = np.diag([1.0, 0.1, 0.01])
    lqr = affine_lqr(A, B, np.zeros(2), W, np.append(-2.0 * W[:2, :2] @ target, 0.0))
    s = np.array([-3.0, 1.0])
    for _ in range(500):
        s = A @ s + B @ (lqr.K @ s + lqr.k)
    np.testing.assert_allclose(s, target, atol=1e-8)


def test_the_slope_is_finite_where_the_drift_cannot_be_cancelled():
    """Any feedback rests away from the target; the average cost is positive, its differences are finite."""
    A, B, d = np.diag([0.9, 0.5]), np.array([[0.0], [1.0]]), np.array([1.0, 0.0])
    lqr = affine_lqr(A, B, d, np.eye(3), np.zeros(3))
    assert lqr.source == "riccati"
    np.testing.assert_allclose(lqr.P[0, 0], 1.0 / (1.0 - 0.81))  # Σ 0.9^{2k}
    np.testing.assert_allclose(lqr.p[0], 2 * 0.9 * lqr.P[0, 0] * 1.0 / (1.0 - 0.9))


@pytest.mark.parametrize(
    ("A", "B", "source"),
    [
        (np.eye(2), np.zeros((2, 1)), "finite horizon"),  # a fresh model
        (np.array([[1.0, 0.01], [0.0, 1.0]]), np.zeros((2, 1)), "finite horizon"),
        (1.1 * np.eye(2), np.zeros((2, 1)), "finite horizon"),
        (np.diag([1.05, 0.5]), np.array([[1e-12], [1.0]]), "finite horizon"),
        (np.diag([1.5, 0.5]), np.array([[0.0], [1.0]]), "stage cost"),  # 1.5^100 says nothing
        (np.diag([1e4, 0.5]), np.array([[0.0], [1.0]]), "stage cost"),
        (np.diag([1e200, 0.5]), np.array([[0.0], [1.0]]), "stage cost"),
        (np.diag([np.inf, 0.5]), np.array([[0.0], [1.0]]), "stage cost"),
        (np.full((2, 2), np.nan), np.array([[0.0], [1.0]]), "stage cost"),
    ],
)
def test_without_a_solution_there_is_a_finite_stand_in_that_says_so(A, B, source):
    lqr = affine_lqr(A, B, np.array([0.1, -0.1]), np.eye(3), np.ones(3))
    assert lqr.source == source
    for part in lqr[:4]:
        assert np.isfinite(part).all()
    assert lqr.P.shape == (2, 2)
    assert lqr.p.shape == (2,)
    assert lqr.K.shape == (1, 2)
    assert lqr.k.shape == (1,)
    np.testing.assert_array_equal(lqr.P, lqr.P.T)
    assert np.linalg.eigvalsh(lqr.P).min() > 0.0


def test_the_finite_horizon_is_fifty_steps_and_the_step_at_hand():
    """With no action worth taking, the cost to go is the sum of the drifting state's own."""
    lqr = affine_lqr(np.eye(1), np.zeros((1, 1)), np.array([0.5]), np.eye(2), np.zeros(2))
    s = np.array([[1.0], [3.0]])
    path = s + 0.5 * np.arange(51)
    np.testing.assert_allclose(np.diff(cost_to_go(lqr, s)), np.diff((path**2).sum(axis=1)))
    np.testing.assert_array_equal(lqr.K, [[0.0]])


def test_the_stage_cost_stands_in_last():
    W, w = np.diag([2.0, 3.0, 1.0]), np.array([1.0, -1.0, 5.0])
    lqr = affine_lqr(np.full((2, 2), np.nan), np.ones((2, 1)), np.zeros(2), W, w)
    np.testing.assert_array_equal(lqr.P, W[:2, :2])
    np.testing.assert_array_equal(lqr.p, w[:2])
    np.testing.assert_array_equal(lqr.K, np.zeros((1, 2)))
    np.testing.assert_array_equal(lqr.k, np.zeros(1))
