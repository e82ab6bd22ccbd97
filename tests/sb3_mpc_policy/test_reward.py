"""A known reward is what it says; an unknown one is the best concave quadratic for what was observed."""

from __future__ import annotations

import warnings

import cvxpy as cp
import numpy as np
import pytest

from sb3_mpc_policy.reward import QuadraticCost, QuadraticReward, fit_cost, flat_cost, is_flat


def symmetric(seed: int, size: int, least: float) -> np.ndarray:
    """A random symmetric matrix with the given least eigenvalue."""
    G = np.random.default_rng(seed).normal(size=(size, size))
    return G @ G.T + (least - np.linalg.eigvalsh(G @ G.T)[0]) * np.eye(size)


# -- known -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("Q", "R", "target"),
    [
        (np.array([1.0, 2.0, 0.0]), 0.5, None),
        (symmetric(0, 3, 0.1), np.array([0.5, 2.0]), [1.0, -2.0, 3.0]),
        (symmetric(1, 3, 0.0), symmetric(2, 2, 0.0), (0.0, 1.0, 0.0)),
        ([1, 2, 3], 0, [1, 1, 1]),
    ],
)
def test_the_cost_is_the_negative_of_the_reward_as_written(Q, R, target):
    cost = QuadraticReward(Q, R, target, constant=15.0).cost(3, 2)
    rng = np.random.default_rng(3)
    for s, a in zip(rng.normal(size=(10, 3)), rng.normal(size=(10, 2)), strict=True):
        off = s - (np.zeros(3) if target is None else target)
        state_part = off @ (np.diag(Q) if np.ndim(Q) == 1 else Q) @ off
        action_part = a @ (np.diag(np.broadcast_to(R, 2)) if np.ndim(R) < 2 else R) @ a
        np.testing.assert_allclose(cost(s, a), -(15.0 - state_part - action_part), rtol=1e-10, atol=1e-10)


def test_the_cost_takes_batches_of_any_shape():
    cost = QuadraticReward([1.0, 2.0], 0.5, [1.0, 0.0]).cost(2, 1)
    s, a = np.random.default_rng(0).normal(size=(4, 5, 2)), np.ones((4, 5, 1))
    values = cost(s, a)
    assert values.shape == (4, 5)
    np.testing.assert_allclose(values[2, 3], cost(s[2, 3], a[2, 3]))


def test_a_weight_for_all_actions_is_shared_by_them():
    one, many = QuadraticReward([1.0], 0.5).cost(1, 3), QuadraticReward([1.0], [0.5] * 3).cost(1, 3)
    np.testing.assert_array_equal(one.W, many.W)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"state_weight": [1.0, -1.0]}, r"^state_weight must not be negative"),
        ({"action_weight": -0.1}, r"^action_weight must not be negative"),
        ({"state_weight": [1.0, np.nan]}, r"^state_weight must be finite"),
        ({"action_weight": np.inf}, r"^action_weight must be finite"),
        ({"state_weight": [[1.0, 2.0], [2.0, 1.0]]}, r"^state_weight must be positive semidefinite.*-1"),
        ({"state_weight": [[1.0, 2.0], [0.0, 5.0]]}, r"^state_weight must be symmetric"),
        ({"state_weight": np.ones((2, 3))}, r"^state_weight must be a vector of weights or a square matrix.*\(2, 3\)"),
        ({"state_weight": []}, r"^state_weight must be a vector of weights or a square matrix"),
        ({"action_weight": np.ones((1, 1, 1))}, r"^action_weight must be a vector of weights or a square matrix"),
        ({"target": [1.0]}, r"^target must be 2 finite numbers, one a state"),
        ({"target": [1.0, np.inf]}, r"^target must be 2 finite numbers, one a state"),
        ({"constant": np.nan}, r"^constant must be finite"),
    ],
)
def test_an_impossible_reward_is_refused_where_it_is_made(arguments, message):
    with pytest.raises(ValueError, match=message):
        QuadraticReward(**({"state_weight": [1.0, 1.0], "action_weight": 1.0} | arguments))


def test_weights_that_do_not_fit_the_system_are_named():
    with pytest.raises(ValueError, match=r"^state_weight must be for 3 states"):
        QuadraticReward([1.0, 1.0], 1.0).cost(3, 1)
    with pytest.raises(ValueError, match=r"^action_weight must be for 3 actions"):
        QuadraticReward([1.0, 1.0], [1.0, 1.0]).cost(2, 3)
    with pytest.raises(ValueError, match=r"^action_weight must be for 2 actions"):
        QuadraticReward([1.0, 1.0], [1.0]).cost(2, 2)


# -- learned -----------------------------------------------------------------------------------------------------------


def observations(seed: int, n: int, n_x: int, n_a: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States and actions of unequal sizes, and the scales that say so."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-1, 1, n_x + n_a)
    return rng.normal(size=(n, n_x)) * scale[:n_x], rng.normal(size=(n, n_a)) * scale[n_x:], scale


@pytest.mark.parametrize("size", [(1, 1), (4, 1), (6, 3)])
def test_a_concave_quadratic_is_recovered(size):
    s, a, scale = observations(0, 500, *size)
    n_z = sum(size)
    W = symmetric(1, n_z, 0.05) / np.outer(scale, scale)
    true = QuadraticCost(W, np.random.default_rng(2).normal(size=n_z) / scale, -15.0)
    cost, error = fit_cost(s, a, -true(s, a), scale[: size[0]], scale[size[0] :])
    assert error < 1e-9
    np.testing.assert_allclose(cost.W * np.outer(scale, scale), W * np.outer(scale, scale), rtol=0, atol=2e-4)
    np.testing.assert_allclose(cost(s, a), true(s, a), atol=1e-3)


def test_the_cart_poles_reward_is_recovered_although_its_angles_cost_little():
    """20 x² beside 0.1 theta², over the ranges of the first falls."""
    rng = np.random.default_rng(0)
    s = rng.normal(size=(200, 4)) * [0.2, 1.0, 0.4, 2.0]
    a = rng.normal(size=(200, 1)) * 0.3
    known = QuadraticReward([20.0, 20.0, 0.1, 0.1], 10.0, constant=15.0).cost(4, 1)
    cost, error = fit_cost(s, a, -known(s, a), s.std(axis=0), np.ones(1))
    assert error < 1e-8
    np.testing.assert_allclose(np.diag(cost.W), np.diag(known.W), rtol=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_a_reward_that_is_not_concave_gets_the_nearest_concave_one(seed):
    """The same least squares over positive semidefinite W, solved by CVXPY."""
    n_x, n_a = 2, 1
    s, a, scale = observations(seed, 150, n_x, n_a)
    rng = np.random.default_rng(50 + seed)
    z = np.hstack([s, a]) / scale
    G = symmetric(seed, 3, -1.5)
    reward = -np.einsum("ni,ij,nj->n", z, G, z) + z @ rng.normal(size=3) + 0.3 * rng.normal(size=150) + 4.0
    cost, error = fit_cost(s, a, reward, scale[:n_x], scale[n_x:])
    assert np.linalg.eigvalsh(cost.W).min() > -1e-9 * np.abs(cost.W).max()

    W, w, w0 = cp.Variable((3, 3), PSD=True), cp.Variable(3), cp.Variable()
    pairs = np.einsum("ni,nj->nij", z, z).reshape(150, 9)
    residual = pairs @ cp.vec(W, order="C") + z @ w + w0 + reward
    best = cp.Problem(cp.Minimize(cp.sum_squares(residual) / 150)).solve(solver=cp.CLARABEL) / reward.var()
    assert best > 0.01  # it is not concave
    assert best - 1e-7 <= error <= best * 1.001
    np.testing.assert_allclose(cost.W * np.outer(scale, scale), W.value, atol=2e-2 * np.abs(W.value).max())
    np.testing.assert_allclose(error * reward.var(), np.mean((cost(s, a) + reward) ** 2), rtol=1e-6)


def test_a_reward_with_a_peak_is_explained_by_a_quadratic_around_it():
    """Not a quadratic at all; the least cost is near where the reward is largest."""
    rng = np.random.default_rng(0)
    s, a = rng.uniform(-2, 2, (400, 1)), rng.uniform(-1, 1, (400, 1))
    cost, error = fit_cost(s, a, np.exp(-((s[:, 0] - 0.7) ** 2)) - 0.1 * np.abs(a[:, 0]), np.ones(1), np.ones(1))
    least = np.linalg.solve(-2.0 * cost.W, cost.w)
    np.testing.assert_allclose(least, [0.7, 0.0], atol=0.35)
    assert 0.0 < error < 0.5


@pytest.mark.parametrize("size", [(30, 2), (30, 3), (40, 5)])
def test_many_components_are_fitted_on_the_diagonal(size):
    """Up to 32 of (s, a) the whole matrix is fitted, and above it no coupling is."""
    n_z = sum(size)
    s, a, scale = observations(0, 1500, *size)
    weights = np.random.default_rng(1).uniform(0.1, 2.0, n_z) / scale**2
    true = QuadraticCost(np.diag(weights), np.ones(n_z) / scale, 3.0)
    cost, error = fit_cost(s, a, -true(s, a), scale[: size[0]], scale[size[0] :])
    assert error < 1e-6
    np.testing.assert_allclose(np.diag(cost.W) * scale**2, weights * scale**2, rtol=1e-2, atol=1e-2)
    diagonal_only = np.count_nonzero(cost.W) <= n_z
    assert diagonal_only == (n_z > 32)


def test_the_diagonal_fit_is_concave_too():
    s, a, scale = observations(0, 400, 35, 1)
    reward = (s[:, 0] / scale[0]) ** 2 - (s[:, 1] / scale[1]) ** 2  # convex in the first state
    cost, error = fit_cost(s, a, reward, scale[:35], scale[35:])
    assert (np.diag(cost.W) >= 0.0).all()
    assert cost.W[0, 0] * scale[0] ** 2 < 1e-3
    np.testing.assert_allclose(cost.W[1, 1] * scale[1] ** 2, 1.0, atol=0.1)
    assert error > 0.1


def test_fewer_observations_than_weights_still_give_a_concave_cost():
    s, a, scale = observations(0, 5, 6, 2)
    reward = np.random.default_rng(0).normal(size=5)
    cost, error = fit_cost(s, a, reward, scale[:6], scale[6:])
    assert np.isfinite(cost.W).all()
    assert np.linalg.eigvalsh(cost.W).min() > -1e-9 * np.abs(cost.W).max()
    assert np.isfinite(error)


@pytest.mark.parametrize("value", [0.0, 1.0, -1e6])
def test_from_a_flat_reward_nothing_is_learned(value):
    """As on tasks that pay for every step survived."""
    s, a, scale = observations(0, 50, 2, 1)
    reward = np.full(50, value) * (1.0 + 1e-12 * np.arange(50))
    assert is_flat(reward)
    cost, error = fit_cost(s, a, reward, scale[:2], scale[2:])
    assert error == 1.0
    np.testing.assert_array_equal(cost.W, flat_cost(scale[:2], scale[2:]).W)
    assert not is_flat(reward + 1e-3 * max(1.0, abs(value)) * s[:, 0])


@pytest.mark.parametrize("size", [1e-4, 1e5])
def test_the_size_of_the_reward_does_not_matter(size):
    s, a, scale = observations(0, 200, 3, 1)
    reward = -((s / scale[:3]) ** 2).sum(axis=1) - (a[:, 0] / scale[3]) ** 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cost, error = fit_cost(s, a, size * reward, scale[:3], scale[3:])
    assert error < 1e-8
    np.testing.assert_allclose(np.diag(cost.W) * scale**2 / size, np.ones(4), rtol=1e-3)


def test_the_flat_cost_is_the_distance_from_the_origin_in_scales():
    cost = flat_cost(np.array([2.0, 0.1]), np.array([10.0]))
    assert cost(np.array([2.0, 0.0]), np.zeros(1)) == pytest.approx(1.0)
    assert cost(np.array([2.0, 0.2]), np.array([10.0])) == pytest.approx(6.0)


@pytest.mark.parametrize("weight", ["heavy", [[1.0, 2.0], [3.0]], None, {}])
def test_a_weight_that_is_no_array_is_named(weight):
    with pytest.raises(ValueError, match=r"^state_weight must be"):
        QuadraticReward(weight, 1.0)
    with pytest.raises(ValueError, match=r"^action_weight must be"):
        QuadraticReward([1.0], weight)
