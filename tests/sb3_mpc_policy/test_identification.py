"""Identification finds the system that made the data, and says so where the data do not determine one."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_mpc_policy.descent import Contacts, Data, descend, evaluate, normal_equations, pivoted
from sb3_mpc_policy.descent import _rows_by_parameters as rows_by_parameters
from sb3_mpc_policy.identification import Identified, identify, select_n_contacts
from sb3_mpc_policy.lcp import LcpSolver
from sb3_mpc_policy.lcs import LcsMatrices, LinearComplementaritySystem

Samples = tuple[np.ndarray, np.ndarray, np.ndarray]


def random_system(seed: int, n_lambda: int, n_x: int = 3, n_a: int = 1) -> LcsMatrices[np.ndarray]:
    """As in Learning-LCS: entries in ±1, F positive definite but not symmetric."""
    rng = np.random.default_rng(seed)
    shapes = [(n_x, n_x), (n_x, n_a), (n_x, n_lambda), (n_x,), (n_lambda, n_x), (n_lambda, n_a)]
    A, B, C, d, D, E = (rng.uniform(-1.0, 1.0, shape) for shape in shapes)
    G, S = rng.uniform(-1.0, 1.0, (2, n_lambda, n_lambda))
    F = G @ G.T + S - S.T + 0.5 * np.eye(n_lambda)
    return LcsMatrices(A, B, C, d, D, E, F, rng.uniform(-1.0, 1.0, n_lambda))


def forces(system: LcsMatrices[np.ndarray], s: np.ndarray, a: np.ndarray) -> np.ndarray:
    return LcpSolver(system.F)(s @ system.D.T + a @ system.E.T + system.c)[0]


def sample(system: LcsMatrices[np.ndarray], seed: int, size: int, noise: float = 0.0) -> Samples:
    rng = np.random.default_rng(1000 + seed)
    n_x, n_a = system.B.shape
    s, a = rng.uniform(-10.0, 10.0, (size, n_x)), rng.uniform(-5.0, 5.0, (size, n_a))
    s_next = s @ system.A.T + a @ system.B.T + forces(system, s, a) @ system.C.T + system.d
    return s, a, s_next + noise * rng.normal(size=s_next.shape)


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.square(error).mean()))


def test_error(found: Identified, system: LcsMatrices[np.ndarray], seed: int = 99) -> float:
    """Root mean square on data that were not fitted."""
    s, a, s_next = sample(system, seed, 1000)
    return rms(found.predict(s, a) - s_next)


test_error.__test__ = False  # type: ignore[attr-defined]


# -- what it finds --


@pytest.mark.parametrize("n_lambda", range(5))
@pytest.mark.parametrize("seed", range(3))
def test_data_without_noise_are_predicted_exactly_and_told_apart_by_mode(n_lambda, seed):
    system = random_system(seed, n_lambda)
    found = identify(*sample(system, seed, 2000), n_lambda, rng=seed)
    assert test_error(found, system) < 1e-5
    # contacts may be listed in any order, and which of the sides of its kink a contact is active on is free
    s, a, _ = sample(system, 98, 1000)
    bits = 1 << np.arange(n_lambda)
    true, mine = ((forces(one, s, a) > 1e-4) @ bits for one in (system, found.matrices))
    together = np.stack([true, mine], axis=1)
    pairs, counts = np.unique(together, axis=0, return_counts=True)
    common = pairs[counts >= 3]
    assert len(np.unique(common[:, 0])) == len(np.unique(common[:, 1])) == len(common)
    assert counts[counts >= 3].sum() >= 0.98 * len(s)


@pytest.mark.parametrize("n_lambda", [2, 8])
def test_noise_is_averaged_out_and_its_size_estimated(n_lambda):
    system = random_system(5, n_lambda)
    s, a, s_next = sample(system, 5, 3000, noise=0.05)
    found = identify(s, a, s_next, n_lambda, deviation=np.full(3, 0.05), rng=0)
    assert test_error(found, system) < 0.01
    assert found.cost == pytest.approx(3.0, rel=0.1)  # one for each component
    assert found.noise_floor == pytest.approx(3.0, rel=0.1)
    assert found.looks_like_noise


def test_a_wall_that_few_data_touch_is_found():
    """Contact in some 2 % of the data: a stiff spring behind s_0 > 2 that pushes s_1."""
    rng = np.random.default_rng(0)
    s, a = rng.normal(size=(4000, 2)), rng.normal(size=(4000, 1))
    push = np.maximum(s[:, 0] - 2.0, 0.0)
    s_next = s + 0.1 * np.stack([s[:, 1], a[:, 0]], axis=1) - 5.0 * push[:, None] * [0.0, 1.0]
    assert 0.01 < (push > 0).mean() < 0.03
    found = identify(s, a, s_next + 1e-3 * rng.normal(size=s.shape), 1, rng=0)
    D, E, c = found.matrices.D[0], found.matrices.E[0], found.matrices.c[0]
    np.testing.assert_allclose(np.array([D[1], E[0], c]) / D[0], [0.0, 0.0, -2.0], atol=0.01)
    # the force is −(D s + c), so its effect on s_1 is −C D_0 per unit of depth
    np.testing.assert_allclose(found.matrices.C[:, 0] * -D[0], [0.0, -5.0], atol=0.05)
    assert found.active_share == pytest.approx((push > 0).mean(), abs=0.002)


def test_a_model_that_lacks_contacts_shows_in_the_noise_floor():
    system = random_system(2, 3)
    found = identify(*sample(system, 2, 2000), 2, n_starts=8, rng=0)
    assert found.noise_floor < 0.7 * found.cost
    assert not found.looks_like_noise


@pytest.mark.parametrize("n_lambda", [0, 1, 3])
def test_as_many_contacts_are_chosen_as_there_are(n_lambda):
    system = random_system(7, n_lambda)
    found = select_n_contacts(*sample(system, 7, 2000, noise=0.02), max_contacts=5, rng=0)
    assert found.n_contacts == n_lambda
    assert test_error(found, system) < 0.02


def test_the_same_seed_gives_the_same_model():
    data = sample(random_system(1, 2), 1, 800, noise=0.1)
    first, second = (identify(*data, 2, rng=3) for _ in range(2))
    for one, other in zip(first.matrices, second.matrices, strict=True):
        np.testing.assert_array_equal(one, other)


# -- coordinates and scales --


@pytest.mark.parametrize("n_lambda", [0, 1, 4])
def test_the_model_class_takes_the_result(n_lambda):
    system = random_system(3, n_lambda)
    found = identify(*sample(system, 3, 1500, noise=0.01), n_lambda, rng=0)
    s, a, _ = sample(system, 97, 200)
    for scales in ({}, {"state_scale": [0.1, 10.0, 3.0], "action_scale": [7.0]}):
        lcs = LinearComplementaritySystem.from_matrices(*found.matrices, **scales)
        np.testing.assert_allclose(lcs.step(s, a).detach().numpy(), found.predict(s, a), atol=1e-8)
    np.testing.assert_array_equal(np.diag(found.matrices.F), np.ones(n_lambda))


def test_a_nearly_rigid_system_is_found_in_a_form_that_the_model_class_takes():
    """The true F is so nearly singular that it is not accepted itself."""
    system = random_system(4, 2)
    system = system._replace(F=np.array([[1.0, 0.9999], [0.9999, 1.0]]))
    with pytest.raises(ValueError, match="positive definite"):
        LinearComplementaritySystem.from_matrices(*system)
    found = identify(*sample(system, 4, 2000), 2, rng=0)
    LinearComplementaritySystem.from_matrices(*found.matrices)
    assert test_error(found, system) < 0.05 * rms(sample(system, 99, 1000)[2])


def test_units_and_origin_do_not_matter():
    system = random_system(6, 2)
    s, a, s_next = sample(system, 6, 1500, noise=0.01)
    plain = identify(s, a, s_next, 2, rng=0)
    size, shift = np.array([1e3, 1e-3, 1.0]), np.array([5.0, 0.0, -100.0])
    moved = identify(s * size + shift, 100.0 * a - 3.0, s_next * size + shift, 2, rng=0)
    np.testing.assert_allclose(
        (moved.predict(s * size + shift, 100.0 * a - 3.0) - shift) / size, plain.predict(s, a), atol=1e-3
    )


# -- weights, features, starts --


def test_data_of_no_weight_do_not_matter():
    system = random_system(8, 2)
    s, a, s_next = sample(system, 8, 1500)
    weights = np.ones(1500)
    weights[::5], s_next[::5] = 0.0, 1e3
    found = identify(s, a, s_next, 2, weights=weights, deviation=np.ones(3), rng=0)
    assert test_error(found, system) < 1e-5


def test_few_data_of_weight_among_many_are_enough():
    system = random_system(8, 0)
    s, a, s_next = sample(system, 8, 3000)
    weights = np.zeros(3000)
    weights[-20:], s_next[:-20] = 1.0, 0.0
    found = identify(s, a, s_next, 2, weights=weights, deviation=np.ones(3), rng=0)
    np.testing.assert_allclose(found.predict(s[-20:], a[-20:]), s_next[-20:], atol=1e-5)


def test_a_weight_of_two_is_the_data_twice():
    s, a, s_next = sample(random_system(9, 0), 9, 60, noise=1.0)
    weights = np.where(np.arange(60) < 20, 2.0, 1.0)
    weighted = identify(s, a, s_next, 0, weights=weights, deviation=np.ones(3))
    repeated = identify(*(np.vstack([part, part[:20]]) for part in (s, a, s_next)), 0, deviation=np.ones(3))
    for one, other in zip(weighted.matrices, repeated.matrices, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    assert weighted.cost == pytest.approx(repeated.cost)


def test_features_take_up_curvature_and_stay_out_of_the_contacts():
    system = random_system(10, 1)
    s, a, s_next = sample(system, 10, 1500)
    features = np.stack([s[:, 0] ** 2, s[:, 1] ** 3, np.zeros(len(s))], axis=1)
    beta = np.array([[0.1, 0.0, 0.0], [0.0, -0.02, 0.0], [0.2, 0.01, 0.0]])
    found = identify(s, a, s_next + features @ beta.T, 1, features=features, rng=0)
    np.testing.assert_allclose(found.feature_coefficients, beta, atol=1e-6)
    np.testing.assert_allclose(found.predict(s, a, features), s_next + features @ beta.T, atol=1e-4)
    assert test_error(found, system) < 1e-4


def test_a_ridge_makes_features_small():
    s, a, s_next = sample(random_system(10, 0), 10, 300)
    features = s[:, :1] ** 2
    s_next = s_next + features
    size = [
        np.abs(identify(s, a, s_next, 0, features=features, feature_ridge=ridge).feature_coefficients).max()
        for ridge in (0.0, 1.0, 1e6)
    ]
    assert size[0] == pytest.approx(1.0, rel=1e-6)
    assert size[0] > 1.5 * size[1] > 1e3 * size[2]


def test_a_good_start_needs_one_descent():
    system = random_system(11, 4)
    rows = np.hstack([system.D, system.E, system.c[:, None]])
    moved = rows + 0.02 * np.random.default_rng(0).normal(size=rows.shape)
    found = identify(*sample(system, 11, 1500), 4, start=[(moved, system.F)], rng=0, n_starts=1)
    assert found.n_starts == 1
    assert test_error(found, system) < 1e-5


def test_a_start_may_lack_contacts():
    system = random_system(12, 2)
    rows = np.hstack([system.D, system.E, system.c[:, None]])
    found = identify(*sample(system, 12, 1500), 2, start=[(rows[:1], system.F[:1, :1])], rng=0)
    assert test_error(found, system) < 1e-5


def test_the_number_of_descents_is_kept_to():
    data = sample(random_system(13, 4), 13, 800)
    start = [(np.ones((1, 5)), np.eye(1))] * 3
    assert identify(*data, 1, start=start, n_starts=2, rng=0).n_starts == 2
    assert identify(*data, 1, n_starts=5, rng=0).n_starts <= 5


# -- odd data --


def odd_data() -> dict[str, tuple[Samples, int]]:
    s, a, s_next = sample(random_system(14, 2), 14, 400, noise=0.01)
    constant = np.full((400, 1), 3.0)
    return {
        "one transition": ((s[:1], a[:1], s_next[:1]), 2),
        "fewer data than parameters": ((s[:7], a[:7], s_next[:7]), 4),
        "constant columns": ((np.hstack([s, constant]), 0.0 * a, np.hstack([s_next, constant])), 2),
        "one row many times": (tuple(np.repeat(part[:1], 50, axis=0) for part in (s, a, s_next)), 2),
        "rows twice": (tuple(np.repeat(part, 2, axis=0) for part in (s, a, s_next)), 2),
        "no contact": ((s, a, s + 0.1 * a), 3),
        "nothing moves": ((s, a, s), 2),
        "an outlier": ((s, a, np.where(np.arange(400)[:, None] == 7, 1e6, s_next)), 2),
        "large numbers": ((1e8 * s, a, 1e8 * s_next), 2),
        "small numbers": ((1e-8 * s, a, 1e-8 * s_next), 2),
        "collinear columns": ((np.hstack([s, s[:, :1]]), a, np.hstack([s_next, s_next[:, :1]])), 2),
    }


@pytest.mark.parametrize("name", odd_data())
def test_odd_data_give_a_finite_model_that_the_model_class_takes(name):
    data, n_lambda = odd_data()[name]
    found = identify(*data, n_lambda, n_starts=6, rng=0)
    LinearComplementaritySystem.from_matrices(*found.matrices)
    assert np.isfinite(found.predict(*data[:2])).all()
    assert np.isfinite([found.cost, found.noise_floor, found.bic]).all()
    assert found.cost <= identify(*data, 0).cost + 1e-9
    assert found.active.shape == (n_lambda,)


def test_what_the_data_do_not_show_stays_as_it_is():
    s, a, s_next = sample(random_system(15, 0), 15, 200)
    s[:, 2], s_next[:, 2], a[:] = 4.0, 4.0, 1.0
    matrices = identify(s, a, s_next, 0).matrices
    np.testing.assert_allclose(matrices.A[:, 2], [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(matrices.A[2], [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(matrices.B, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"s": np.zeros((4, 3, 1))}, "s must have shape"),
        ({"s": np.zeros((0, 3)), "a": np.zeros((0, 1)), "s_next": np.zeros((0, 3))}, "s must have at least one row"),
        ({"a": np.zeros((3, 1))}, r"a must have shape \(4, any\), got \(3, 1\)"),
        ({"s_next": np.zeros((4, 2))}, r"s_next must have shape \(4, 3\)"),
        ({"s": np.full((4, 3), np.nan)}, "s must be finite"),
        ({"n_contacts": -1}, "n_contacts must be an integer from 0 to 62, got -1"),
        ({"n_contacts": 1.5}, "n_contacts must be an integer"),
        ({"n_starts": 0}, "n_starts must be an integer >= 1, got 0"),
        ({"features": np.zeros((3, 1))}, "features must have shape"),
        ({"feature_ridge": -1.0}, "feature_ridge must be finite and >= 0"),
        ({"weights": np.zeros(4)}, "weights must be non-negative and not all zero"),
        ({"weights": -np.ones(4)}, "weights must be non-negative"),
        ({"deviation": np.zeros(3)}, "deviation must be positive"),
        ({"start": [(np.ones((1, 4)), np.eye(1))]}, "start's gap rows must have shape"),
        ({"start": [(np.ones((1, 5)), np.eye(2))]}, "start's F must have shape"),
        ({"start": [(np.ones((3, 5)), np.eye(3))]}, "start must have at most n_contacts = 2 gap rows"),
        ({"start": [(np.ones((1, 5)), -np.eye(1))]}, "start's F must have a positive diagonal"),
    ],
)
def test_a_wrong_argument_is_named(change, message):
    arguments = {"s": np.zeros((4, 3)), "a": np.zeros((4, 1)), "s_next": np.zeros((4, 3)), "n_contacts": 2}
    with pytest.raises(ValueError, match=message):
        identify(**(arguments | change))


def test_choosing_among_no_numbers_of_contacts_is_an_error():
    with pytest.raises(ValueError, match="max_contacts must be an integer from 0 to 62, got -1"):
        select_n_contacts(np.zeros((4, 1)), np.zeros((4, 1)), np.zeros((4, 1)), -1)


# -- the descent --


def problem(n: int, seed: int = 0) -> tuple[Data, Contacts]:
    rng = np.random.default_rng(seed)
    z = np.hstack([rng.normal(size=(80, 3)), np.ones((80, 1))])
    smooth = np.hstack([z, z[:, :1] ** 2])
    ridge = np.array([0.0, 0.0, 0.0, 0.0, 0.3])
    data = Data(z, rng.normal(size=(80, 2)), smooth, rng.uniform(0.5, 2.0, 80), ridge)
    return data, Contacts(rng.normal(size=(n, 4)), rng.normal(size=(n, n)), rng.normal(size=(n, n)))


def parameters(contacts: Contacts) -> np.ndarray:
    upper = np.triu_indices(len(contacts.P), 1)
    return np.concatenate([contacts.P.ravel(), contacts.G.ravel(), contacts.S[upper]])


def contacts_of(theta: np.ndarray, n: int, p: int = 4) -> Contacts:
    S = np.zeros((n, n))
    S[np.triu_indices(n, 1)] = theta[n * p + n * n :]
    return Contacts(theta[: n * p].reshape(n, p), theta[n * p : n * p + n * n].reshape(n, n), S)


@pytest.mark.parametrize("n", [1, 3, 5])
def test_the_gradient_is_that_of_central_differences(n, central_difference):
    data, contacts = problem(n)
    fit = evaluate(data, contacts)
    assert fit.active.any() and not fit.active.all()
    gradient = rows_by_parameters(contacts).T @ normal_equations(data, fit)[1]
    expected = central_difference(
        lambda theta: evaluate(data, contacts_of(theta, n)).objective / 2.0, parameters(contacts)
    )
    # the ridge of 1e-9 that keeps forces apart is no part of the objective
    np.testing.assert_allclose(gradient, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("n", [1, 3])
def test_the_gauss_newton_matrix_is_that_of_residuals_beside_the_linear_terms(n):
    """Differences of the residuals at fixed W and C, with what lies in the span of the linear terms taken off."""
    data, contacts = problem(n)
    fit = evaluate(data, contacts)
    root, theta, step = np.sqrt(data.weights), parameters(contacts), 1e-6

    def force_effect(moved: np.ndarray) -> np.ndarray:
        now = contacts_of(moved, n)
        return LcpSolver(now.F)(data.z @ now.P.T)[0] @ fit.C.T

    columns = [force_effect(theta + step * unit) - force_effect(theta - step * unit) for unit in np.eye(len(theta))]
    jacobian = np.stack(columns, axis=-1) / (2.0 * step) * root[:, None, None]
    penalty = np.hstack([np.diag(np.sqrt(data.ridge)), np.zeros((5, n))])
    linear = np.vstack([root[:, None] * np.hstack([data.smooth, fit.forces]), penalty])
    matrix = 0.0
    for component in range(2):
        rows = np.vstack([jacobian[:, component], np.zeros((5, len(theta)))])
        beside = rows - linear @ np.linalg.lstsq(linear, rows, rcond=None)[0]
        matrix = matrix + beside.T @ beside
    chain = rows_by_parameters(contacts)
    found = chain.T @ normal_equations(data, fit)[0] @ chain
    np.testing.assert_allclose(found, matrix, atol=1e-6 * np.abs(matrix).max())


def test_linear_terms_are_those_of_least_squares():
    data, contacts = problem(3)
    fit = evaluate(data, contacts)
    root = np.sqrt(data.weights)[:, None]
    penalty = np.hstack([np.diag(np.sqrt(data.ridge)), np.zeros((5, 3))])
    linear = np.vstack([root * np.hstack([data.smooth, LcpSolver(contacts.F)(data.z @ contacts.P.T)[0]]), penalty])
    expected = np.linalg.lstsq(linear, np.vstack([root * data.y, np.zeros((5, 2))]), rcond=None)[0]
    np.testing.assert_allclose(np.vstack([fit.W, fit.C.T]), expected, atol=1e-6)


@pytest.mark.parametrize("n", [1, 3, 6])
def test_guessed_active_sets_do_not_change_the_forces(n):
    data, contacts = problem(n)
    expected = evaluate(data, contacts).forces
    for seed in range(3):
        guess = np.random.default_rng(seed).integers(0, 2, expected.shape).astype(bool)
        np.testing.assert_allclose(evaluate(data, contacts, guess).forces, expected, atol=1e-9)


@pytest.mark.parametrize("swapped", [[False] * 4, [True] * 4, [True, False, False, True]])
def test_a_contact_seen_from_behind_predicts_the_same(swapped):
    data, contacts = problem(4)
    fit = evaluate(data, contacts)
    mirrored = evaluate(data, pivoted(contacts, np.array(swapped)))
    np.testing.assert_allclose(mirrored.residual, fit.residual, atol=1e-6)
    np.testing.assert_array_equal(mirrored.active, fit.active ^ swapped)


def test_a_descent_never_rises():
    data, contacts = problem(3)
    fit, last = evaluate(data, contacts), np.inf
    for _ in range(20):
        assert fit.objective <= last
        last = fit.objective
        fit = descend(data, fit, 1)
    assert fit.objective < 0.95 * evaluate(data, contacts).objective


def test_other_units_of_force_and_gap_change_nothing():
    data, contacts = problem(4)
    contacts = contacts._replace(G=contacts.G * [[1.0], [10.0], [0.1], [3.0]])
    fit, rescaled = evaluate(data, contacts), evaluate(data, contacts.rescaled())
    np.testing.assert_allclose(rescaled.residual, fit.residual, atol=1e-6)
    smaller = contacts.without(1)
    keep = [0, 2, 3]
    np.testing.assert_allclose(smaller.F, contacts.F[np.ix_(keep, keep)], atol=1e-12)
