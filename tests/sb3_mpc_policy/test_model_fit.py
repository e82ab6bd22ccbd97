"""The direct fit finds the tangent of the dynamics where the controller works."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from sb3_mpc_policy import LinearComplementaritySystem
from sb3_mpc_policy.model_fit import fit_tangent, smooth_fit
from sb3_mpc_policy.transitions import Transitions
from tests.sb3_mpc_policy.toy_environments import fingerprint

STEP = 0.05


def transitions(s: np.ndarray, a: np.ndarray, s_next: np.ndarray) -> Transitions:
    return Transitions(s, a, np.zeros(len(s)), s_next)


def smooth_part(lcs: LinearComplementaritySystem) -> list[np.ndarray]:
    return [matrix.detach().numpy() for matrix in (lcs.A, lcs.B, lcs.d)]


def pendulum(s: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Angle from upright, rad, and angular velocity, rad/s; semi-implicit Euler."""
    velocity = s[:, 1] + STEP * (9.81 * np.sin(s[:, 0]) + 5.0 * a[:, 0])
    return np.stack([s[:, 0] + STEP * velocity, velocity], axis=1)


def pendulum_jacobian(angle: float) -> tuple[np.ndarray, np.ndarray]:
    slope = STEP * 9.81 * np.cos(angle)
    A = np.array([[1.0 + STEP * slope, STEP], [slope, 1.0]])
    return A, np.array([[STEP * STEP * 5.0], [STEP * 5.0]])


def least_squares(s: np.ndarray, a: np.ndarray, s_next: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and B of the plain fit."""
    features = np.hstack([s, a, np.ones((len(s), 1))])
    theta = np.linalg.lstsq(features, s_next, rcond=None)[0].T
    return theta[:, : s.shape[1]], theta[:, s.shape[1] : -1]


@pytest.mark.parametrize("n_contacts", [0, 2])
def test_a_linear_system_is_recovered_exactly_and_the_contacts_stay_as_they_are(n_contacts: int) -> None:
    rng = np.random.default_rng(0)
    A, B, d = rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=3)
    s, a = rng.normal(size=(300, 3)), rng.normal(size=(300, 2))
    lcs = LinearComplementaritySystem(3, 2, n_contacts, [0.5, 2.0, 1.0], [0.3, 1.0])
    with torch.no_grad():
        lcs.c_scaled.fill_(100.0)  # the contacts are far away
    names = ("C_scaled", "D_scaled", "E_scaled", "c_scaled", "F_factor", "F_skew")
    before = [getattr(lcs, name).clone() for name in names]
    residual = fit_tangent(lcs, transitions(s, a, s @ A.T + a @ B.T + d), np.zeros(3))
    for found, truth in zip(smooth_part(lcs), (A, B, d), strict=True):
        np.testing.assert_allclose(found, truth, atol=1e-5)
    assert residual == pytest.approx(1e-3)  # the least it admits to
    assert all(torch.equal(getattr(lcs, name), old) for name, old in zip(names, before, strict=True))


def test_the_smooth_part_is_fitted_beside_the_forces_of_known_contacts() -> None:
    rng = np.random.default_rng(6)
    A, B, d = np.eye(2) + 0.3 * rng.normal(size=(2, 2)), rng.normal(size=(2, 1)), 0.1 * rng.normal(size=2)
    contacts = (rng.normal(size=(2, 1)), np.array([[1.0, 0.2]]), np.array([[0.1]]), np.array([[0.5]]), np.zeros(1))
    C, *gap = contacts
    truth = LinearComplementaritySystem.from_matrices(A, B, C, d, *gap)
    lcs = LinearComplementaritySystem.from_matrices(np.eye(2), np.zeros((2, 1)), C, np.zeros(2), *gap)
    s, a = rng.normal(size=(300, 2)), rng.normal(size=(300, 1))
    touching = (truth.contact_force(s, a).detach().numpy() > 0).mean()
    assert 0.3 < touching < 0.7  # far too many to be taken for outliers
    fit_tangent(lcs, transitions(s, a, truth.step(s, a).detach().numpy()), np.zeros(2))
    for found, true in zip(smooth_part(lcs), (A, B, d), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-5)


def test_the_known_model_is_kept_where_the_data_say_nothing() -> None:
    rng = np.random.default_rng(7)
    A, B, d = np.eye(2) + 0.3 * rng.normal(size=(2, 2)), rng.normal(size=(2, 1)), rng.normal(size=2)
    nothing = (np.zeros((2, 0)), np.zeros((0, 2)), np.zeros((0, 1)), np.zeros((0, 0)), np.zeros(0))
    prior = LinearComplementaritySystem.from_matrices(A, B, nothing[0], d, *nothing[1:])
    s, a = rng.normal(size=(100, 2)), np.zeros((100, 1))
    s[:, 1] = 0.0  # neither the second state nor the action is tried
    moved = A + np.array([[0.2, 0.0], [-0.1, 0.0]])
    for given, expected_A, expected_B in ((prior, moved, B), (None, [[moved[0, 0], 0], [moved[1, 0], 1]], 0 * B)):
        lcs = LinearComplementaritySystem(2, 1)
        fit_tangent(lcs, transitions(s, a, s @ moved.T + d), np.zeros(2), given)
        np.testing.assert_allclose(smooth_part(lcs)[0], expected_A, atol=1e-5)
        np.testing.assert_allclose(smooth_part(lcs)[1], expected_B, atol=1e-5)
    unchanged = (np.array_equal(old, new) for old, new in zip((A, B, d), smooth_part(prior), strict=True))
    assert all(unchanged)


@pytest.mark.parametrize("angle", [0.0, 0.8])
def test_the_jacobian_at_the_target_is_found_in_spite_of_curvature_and_impacts(angle: float) -> None:
    rng = np.random.default_rng(1)
    s = rng.uniform([-2.0, -6.0], [2.0, 6.0], (400, 2))
    a = rng.uniform(-1.0, 1.0, (400, 1))
    s_next = pendulum(s, a)
    hit = rng.random(400) < 0.05
    s_next[hit, 1] += rng.choice([-1.0, 1.0], hit.sum()) * rng.uniform(2.0, 8.0, hit.sum())
    lcs = LinearComplementaritySystem(2, 1, 0, s.std(axis=0), [1.0])
    fit_tangent(lcs, transitions(s, a, s_next), np.array([angle, 0.0]))

    truth = pendulum_jacobian(angle)
    errors = [np.abs(found - true).max() for found, true in zip(smooth_part(lcs)[:2], truth, strict=True)]
    plain = [np.abs(found - true).max() for found, true in zip(least_squares(s, a, s_next), truth, strict=True)]
    assert hit.sum() >= 10
    assert errors[0] < 0.1 * plain[0] and errors[0] < 0.03
    assert errors[1] < 0.2 * plain[1] and errors[1] < 0.03


@pytest.mark.parametrize("seed", range(4))
def test_a_majority_that_leans_on_a_wall_does_not_decide_the_tangent(seed: int) -> None:
    """Three transitions of four are of a pendulum pressed against a spring, and fit one another."""
    rng = np.random.default_rng(seed)
    free = rng.uniform([-0.25, -0.8], [0.25, 0.8], (100, 2))
    leaning = rng.normal([0.55, 0.0], [0.01, 0.1], (300, 2))
    s, a = np.concatenate([free, leaning]), rng.uniform(-1.0, 1.0, (400, 1))
    s_next = pendulum(s, a)
    push = -60.0 * STEP * np.maximum(s[:, 0] - 0.5, 0.0)
    s_next += push[:, None] * [STEP, 1.0]
    lcs = LinearComplementaritySystem(2, 1, 0, [0.2, 0.5], [1.0])
    fit_tangent(lcs, transitions(s, a, s_next), np.zeros(2))
    A, B = pendulum_jacobian(0.0)
    np.testing.assert_allclose(lcs.A.detach(), A, atol=0.002)
    np.testing.assert_allclose(lcs.B.detach(), B, atol=0.002)


def test_the_offset_is_that_of_the_tangent_in_the_units_of_the_environment() -> None:
    rng = np.random.default_rng(2)
    s, a = rng.uniform([0.3, -1.0], [1.3, 1.0], (300, 2)), rng.uniform(-1.0, 1.0, (300, 1))
    lcs = LinearComplementaritySystem(2, 1, 0, [0.4, 1.5], [0.5])
    target = np.array([0.8, 0.0])
    fit_tangent(lcs, transitions(s, a, pendulum(s, a)), target)
    expected = pendulum(target[None], np.zeros((1, 1)))[0]
    np.testing.assert_allclose(lcs.step(target, np.zeros(1)).detach().numpy(), expected, atol=2e-3)


def test_a_target_far_outside_the_data_still_gives_a_fit_of_the_data() -> None:
    rng = np.random.default_rng(3)
    A, B = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[0.0], [0.3]])
    s, a = rng.normal(size=(200, 2)), rng.normal(size=(200, 1))
    lcs = LinearComplementaritySystem(2, 1)
    fit_tangent(lcs, transitions(s, a, s @ A.T + a @ B.T), np.array([1e6, -1e6]))
    np.testing.assert_allclose(smooth_part(lcs)[0], A, atol=1e-2)
    np.testing.assert_allclose(smooth_part(lcs)[1], B, atol=1e-2)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_few_transitions_give_a_finite_model_that_explains_them(n: int) -> None:
    rng = np.random.default_rng(n)
    s, a = rng.normal(size=(n, 2)), rng.normal(size=(n, 1))
    s_next = pendulum(s, a)
    lcs = LinearComplementaritySystem(2, 1)
    assert np.isfinite(fit_tangent(lcs, transitions(s, a, s_next), np.zeros(2)))
    for matrix in smooth_part(lcs):
        assert np.isfinite(matrix).all() and np.abs(matrix).max() < 10.0
    if n == 1:
        np.testing.assert_allclose(lcs.step(s, a).detach().numpy(), s_next, atol=1e-2)


@pytest.mark.parametrize("constant", ["a state", "the action", "everything"])
def test_what_never_changes_gives_a_finite_model(constant: str) -> None:
    rng = np.random.default_rng(4)
    s, a = 0.2 * rng.normal(size=(50, 2)), rng.normal(size=(50, 1))
    if constant in ("a state", "everything"):
        s[:, 0] = 0.2
    if constant in ("the action", "everything"):
        a[:] = 0.2
    s_next = pendulum(s, a)
    if constant == "everything":
        s[:] = s_next[:] = 0.2
    lcs = LinearComplementaritySystem(2, 1)
    assert np.isfinite(fit_tangent(lcs, transitions(s, a, s_next), np.zeros(2)))
    assert all(np.isfinite(matrix).all() for matrix in smooth_part(lcs))
    np.testing.assert_allclose(lcs.step(s, a).detach().numpy(), s_next, atol=0.02)


def test_a_system_of_many_dimensions_is_fitted() -> None:
    rng = np.random.default_rng(5)
    A, B = np.eye(17) + 0.1 * rng.normal(size=(17, 17)), 0.1 * rng.normal(size=(17, 6))
    s, a = rng.normal(size=(1_000, 17)), rng.normal(size=(1_000, 6))
    lcs = LinearComplementaritySystem(17, 6, 2)
    fit_tangent(lcs, transitions(s, a, s @ A.T + a @ B.T), np.zeros(17))
    np.testing.assert_allclose(smooth_part(lcs)[0], A, atol=1e-2)
    np.testing.assert_allclose(smooth_part(lcs)[1], B, atol=1e-2)


# -- what the smooth part leaves: the data that contacts are found in ------------------------------------------


def struck_pendulum(seed: int, n: int = 600) -> tuple[Transitions, np.ndarray]:
    """Transitions of the pendulum, and (n, 2) what blows added to the next state: in one of twenty."""
    rng = np.random.default_rng(seed)
    s, a = rng.uniform([-1.0, -4.0], [1.0, 4.0], (n, 2)), rng.uniform(-1.0, 1.0, (n, 1))
    blows = np.zeros((n, 2))
    hit = rng.random(n) < 0.05
    blows[hit, 1] = rng.choice([-1.0, 1.0], hit.sum()) * rng.uniform(0.5, 8.0, hit.sum())
    return transitions(s, a, pendulum(s, a) + blows), blows


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_a_surprise_is_what_no_smooth_dynamics_explains_and_curvature_is_what_the_tangent_does_not(
    angle: float,
) -> None:
    scale, target = np.array([0.5, 2.0]), np.array([angle, 0.0])
    data, blows = struck_pendulum(0)
    lcs = LinearComplementaritySystem(2, 1, 0, scale, [1.0])
    fit = smooth_fit(lcs, data, target)
    A, B = pendulum_jacobian(angle)
    tangent = pendulum(target[None], np.zeros((1, 1))) + (data.s - target) @ A.T + data.a @ B.T
    np.testing.assert_allclose(fit.surprise * scale, blows, atol=0.02)
    np.testing.assert_allclose(fit.curvature * scale, pendulum(data.s, data.a) - tangent, atol=0.03)
    np.testing.assert_array_equal(fit.centre, target / scale)
    assert fit.theta.shape == (3 + 1 + 6 + 10, 2) and fit.noise < 0.05


def test_the_parts_of_a_smooth_fit_add_up_to_what_happened() -> None:
    scale, prior = np.array([0.5, 2.0]), LinearComplementaritySystem(2, 1, 0, [0.5, 2.0], [3.0])
    data, _ = struck_pendulum(1)
    fit = smooth_fit(copy.deepcopy(prior), data, np.zeros(2), prior)
    expected = prior.step(data.s, data.a).detach().numpy() / scale
    z = np.hstack([data.s / scale - fit.centre, data.a / 3.0, np.ones((len(data.s), 1))])
    linear = expected + z @ fit.theta[:4]
    np.testing.assert_allclose(linear + fit.curvature + fit.surprise, data.s_next / scale, atol=1e-9)


@pytest.mark.parametrize("with_contacts", [True, False])
def test_a_surprise_holds_what_contact_did_whether_or_not_the_model_knows_of_it(with_contacts: bool) -> None:
    rng = np.random.default_rng(6)
    A, B = np.eye(2) + 0.3 * rng.normal(size=(2, 2)), rng.normal(size=(2, 1))
    C, D = rng.normal(size=(2, 1)), np.array([[1.0, 0.2]])
    rest = np.zeros(2), D, np.zeros((1, 1)), np.array([[0.5]]), np.ones(1)
    truth = LinearComplementaritySystem.from_matrices(A, B, C, *rest, state_scale=[0.5, 2.0])
    s, a = rng.normal(size=(600, 2)), rng.normal(size=(600, 1))
    pushed = (truth.contact_force(s, a) @ truth.C.mT).detach().numpy()
    assert 0.05 < pushed.any(axis=1).mean() < 0.25
    before = fingerprint(truth)
    fit = smooth_fit(truth, transitions(s, a, truth.step(s, a).detach().numpy()), np.zeros(2), None, with_contacts)
    # where contact is not known of, curvature takes up a little of it
    np.testing.assert_allclose(fit.surprise * [0.5, 2.0], pushed, atol=1e-4 if with_contacts else 0.05)
    assert fingerprint(truth) == before


def test_without_contacts_those_of_the_model_do_not_matter() -> None:
    data, _ = struck_pendulum(4)
    models = [LinearComplementaritySystem(2, 1, n, [0.5, 2.0]) for n in (0, 2)]
    with torch.no_grad():
        models[1].c_scaled.fill_(-1.0)  # pushes everywhere
    one, two = (smooth_fit(lcs, data, np.zeros(2), None, False) for lcs in models)
    np.testing.assert_array_equal(one.theta, two.theta)
    np.testing.assert_array_equal(one.surprise, two.surprise)


def test_of_very_many_transitions_some_decide_and_all_have_a_surprise() -> None:
    data, blows = struck_pendulum(2, 20_000)
    lcs = LinearComplementaritySystem(2, 1, 0, [0.5, 2.0], [1.0])
    fit = smooth_fit(lcs, data, np.zeros(2))
    assert fit.surprise.shape == fit.curvature.shape == (20_000, 2)
    np.testing.assert_allclose(fit.surprise * [0.5, 2.0], blows, atol=0.02)
    assert np.isfinite(fit_tangent(lcs, data, np.zeros(2)))
    np.testing.assert_allclose(smooth_part(lcs)[0], pendulum_jacobian(0.0)[0], atol=0.01)


def test_the_fit_of_very_many_transitions_neither_uses_nor_touches_the_global_random_state() -> None:
    data, _ = struck_pendulum(3, 6_000)
    found = []
    for seed in (0, 1):
        np.random.seed(seed)  # noqa: NPY002 - the global state is what this is about
        lcs = LinearComplementaritySystem(2, 1)
        torch.manual_seed(seed)
        before = torch.get_rng_state()
        found.append(smooth_fit(lcs, data, np.zeros(2)).theta)
        assert torch.equal(torch.get_rng_state(), before)
    np.testing.assert_array_equal(*found)
