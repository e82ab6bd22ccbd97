"""The model is eq (5) in the environment's units, whatever the scales, and its derivative is exact."""

from __future__ import annotations

from itertools import chain, combinations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from contact_envs.dynamics import CartPoleParameters, integrate, true_lcs
from sb3_mpc_policy.lcs import KAPPA, LcsMatrices, LinearComplementaritySystem


def arrays(lcs: LinearComplementaritySystem) -> LcsMatrices[np.ndarray]:
    """In environment units."""
    return LcsMatrices(*(matrix.detach().numpy() for matrix in lcs.matrices()))


def random_matrices(seed: int, n_x: int, n_a: int, n_c: int) -> LcsMatrices[np.ndarray]:
    """Environment units that differ by orders of magnitude; F definite, neither symmetric nor well scaled."""
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-2, 2, n_c)
    G, S = rng.normal(size=(2, n_c, n_c))
    F = G @ G.T + 0.3 * np.eye(n_c) + S - S.T
    return LcsMatrices(
        rng.normal(size=(n_x, n_x)),
        rng.normal(size=(n_x, n_a)),
        rng.normal(size=(n_x, n_c)) * 100.0,
        rng.normal(size=n_x),
        rng.normal(size=(n_c, n_x)) * units[:, None],
        rng.normal(size=(n_c, n_a)) * units[:, None],
        F * np.outer(units, units),
        rng.normal(size=n_c) * units,
    )


def step_by_enumeration(model: LcsMatrices[np.ndarray], s, a, enumerate_lcp) -> tuple[np.ndarray, np.ndarray]:
    A, B, C, d, D, E, F, c = model
    lam = enumerate_lcp(F, D @ s + E @ a + c)
    return A @ s + B @ a + C @ lam + d, lam


# -- the step ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_contacts", [0, 1, 2, 3, 6])
@pytest.mark.parametrize("n_actions", [1, 2])
def test_step_and_force_are_eq_5(random_model, enumerate_lcp, n_contacts, n_actions):
    lcs = random_model(n_contacts, 3, n_actions, n_contacts)
    rng = np.random.default_rng(1)
    s, a = rng.normal(size=(20, 3)), rng.normal(size=(20, n_actions))
    expected = [step_by_enumeration(arrays(lcs), *pair, enumerate_lcp) for pair in zip(s, a, strict=True)]
    after, force = lcs.step(s, a).detach().numpy(), lcs.contact_force(s, a).detach().numpy()
    np.testing.assert_allclose(after, [pair[0] for pair in expected], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(force, [pair[1] for pair in expected], rtol=1e-8, atol=1e-9)
    if n_contacts:
        assert (force > 0).any()
        assert (force == 0).any()


def test_one_state_gives_one_next_state(random_model):
    lcs = random_model(0)
    s, a = torch.randn(5, 3), torch.randn(5, 1)
    together, forces = lcs.step(s, a), lcs.contact_force(s, a)
    assert together.dtype == forces.dtype == torch.float64
    assert together.shape == (5, 3)
    assert forces.shape == (5, 2)
    for i in range(5):
        alone = lcs.step(s[i].numpy(), a[i].numpy())
        assert alone.shape == (3,)
        assert lcs.contact_force(s[i], a[i]).shape == (2,)
        torch.testing.assert_close(alone, together[i], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(lcs.contact_force(s[i], a[i]), forces[i], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("s", "a", "name"),
    [
        (np.zeros(2), np.zeros(1), "s"),
        (np.zeros((4, 2)), np.zeros((4, 1)), "s"),
        (np.zeros((1, 4, 3)), np.zeros((4, 1)), "s"),
        (np.zeros(3), np.zeros(2), "a"),
        (np.float64(0.0), np.zeros(1), "s"),
        (np.zeros(3), np.float64(0.0), "a"),
        (np.zeros((4, 3)), np.zeros((5, 1)), "a"),
        (np.zeros(3), np.zeros((4, 1)), "a"),
        (np.zeros((4, 3)), np.zeros(1), "a"),
    ],
)
def test_states_and_actions_of_the_wrong_shape_are_named(random_model, s, a, name):
    lcs = random_model(0)
    for method in (lcs.step, lcs.contact_force):
        with pytest.raises(ValueError, match=rf"^{name} must have"):
            method(s, a)


# -- parameters and units ------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    sizes=st.tuples(st.integers(1, 4), st.integers(1, 3), st.integers(0, 4)),
    log_scales=st.lists(st.floats(-3, 3), min_size=7, max_size=7),
)
def test_matrices_given_in_environment_units_come_back_whatever_the_scales(seed, sizes, log_scales):
    given_matrices = random_matrices(seed, *sizes)
    scales = 10.0 ** np.array(log_scales)
    lcs = LinearComplementaritySystem.from_matrices(*given_matrices, scales[: sizes[0]], scales[4 : 4 + sizes[1]])
    for name, expected in given_matrices._asdict().items():
        found = getattr(lcs, name).detach().numpy()
        np.testing.assert_allclose(
            found, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max(initial=0.0), err_msg=name
        )


def test_gaps_and_forces_are_of_order_one_in_scaled_coordinates():
    lcs = LinearComplementaritySystem.from_matrices(*true_lcs(), state_scale=[0.35, 1.0, 0.3, 1.0])
    np.testing.assert_allclose(torch.diag(lcs.F_scaled).detach(), np.ones(2), rtol=1e-9)
    np.testing.assert_allclose(torch.hstack([lcs.D_scaled, lcs.E_scaled]).norm(dim=1).detach(), np.ones(2), rtol=1e-9)


def test_a_gap_that_no_state_moves_is_taken_over():
    matrices = random_matrices(0, 2, 1, 2)
    matrices.D[0], matrices.E[0] = 0.0, 0.0
    lcs = LinearComplementaritySystem.from_matrices(*matrices)
    np.testing.assert_allclose(lcs.D.detach(), matrices.D, atol=1e-12)


@pytest.mark.parametrize("n_contacts", [0, 2])
def test_scales_change_the_parameters_and_not_the_model(n_contacts):
    matrices = random_matrices(3, 3, 2, n_contacts)
    plain = LinearComplementaritySystem.from_matrices(*matrices)
    scaled = LinearComplementaritySystem.from_matrices(*matrices, [1e-2, 5.0, 300.0], [0.1, 20.0])
    rng = np.random.default_rng(0)
    s, a = rng.normal(size=(30, 3)), rng.normal(size=(30, 2))
    torch.testing.assert_close(scaled.step(s, a), plain.step(s, a), rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(scaled.contact_force(s, a), plain.contact_force(s, a), rtol=1e-6, atol=1e-7)
    assert not torch.allclose(scaled.A_scaled, plain.A_scaled)
    # and the step in scaled coordinates is the same step
    state, action = torch.as_tensor(s) / scaled.state_scale, torch.as_tensor(a) / scaled.action_scale
    torch.testing.assert_close(scaled.step_scaled(state, action) * scaled.state_scale, scaled.step(s, a))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 5), log_size=st.floats(-3, 2))
def test_every_value_of_the_parameters_gives_a_p_matrix(seed, n, log_size):
    lcs = LinearComplementaritySystem(2, 1, n)
    rng = np.random.default_rng(seed)
    with torch.no_grad():
        for parameter in (lcs.F_factor, lcs.F_skew):
            parameter.copy_(torch.as_tensor(10.0**log_size * rng.normal(size=(n, n))))
        lcs.F_factor[0] = 0.0  # singular without kappa
    F = lcs.F_scaled.detach().numpy()
    assert np.linalg.eigvalsh((F + F.T) / 2).min() > 0.99 * KAPPA
    for rows in chain.from_iterable(combinations(range(n), size) for size in range(1, n + 1)):
        assert np.linalg.det(F[np.ix_(rows, rows)]) > 0.0


def test_a_fresh_model_stands_still_with_its_contacts_open():
    lcs = LinearComplementaritySystem(4, 2, 3, state_scale=np.array([0.1, 1.0, 10.0, 1.0]))
    for _ in range(3):
        np.testing.assert_array_equal(lcs.step(np.zeros(4), np.zeros(2)).detach(), np.zeros(4))
        np.testing.assert_array_equal(lcs.contact_force(np.zeros(4), np.zeros(2)).detach(), np.zeros(3))


def test_the_scales_are_saved_and_not_learned():
    lcs = LinearComplementaritySystem.from_matrices(*true_lcs(), state_scale=[0.35, 1.0, 0.3, 1.0], action_scale=[2.0])
    assert not any("scale" in name and "scaled" not in name for name, _ in lcs.named_parameters())
    other = LinearComplementaritySystem(4, 1, 2)
    other.load_state_dict(lcs.state_dict())
    s, a = np.array([0.34, 0.1, 0.05, 0.2]), np.array([0.1])
    torch.testing.assert_close(other.step(s, a), lcs.step(s, a), rtol=0, atol=0)
    torch.testing.assert_close(other.contact_force(s, a), lcs.contact_force(s, a), rtol=0, atol=0)


# -- the derivative ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("touching", [True, False])
@pytest.mark.parametrize("n_contacts", [0, 1, 2, 6])
def test_derivative_of_the_step_is_that_of_central_differences(random_model, parameter_gradients, n_contacts, touching):
    if n_contacts == 0 and touching:
        pytest.skip("nothing to touch")
    lcs = random_model(20 + n_contacts, 3, 2, n_contacts)
    if not touching:
        with torch.no_grad():
            lcs.c_scaled += 4.0
    rng = np.random.default_rng(5)
    s, a = rng.normal(size=(400, 3)), rng.normal(size=(400, 2))
    force = lcs.contact_force(s, a).detach().numpy()
    _, _, _, _, D, E, F, c = arrays(lcs)
    gap = s @ D.T + a @ E.T + force @ F.T + c
    away = np.maximum(force, gap).min(axis=1, initial=np.inf) > 0.02  # from a change of mode
    chosen = away & (force.any(axis=1) == touching)
    assert chosen.sum() >= 3
    s, a = torch.as_tensor(s[chosen][:5]), torch.as_tensor(a[chosen][:5])
    weight = torch.as_tensor(rng.normal(size=tuple(s.shape)))

    def value() -> torch.Tensor:
        return (lcs.step(s, a) * weight).sum()

    lcs.zero_grad()
    value().backward()
    for name, expected in parameter_gradients(lcs, lambda: value().item()).items():
        gradient = dict(lcs.named_parameters())[name].grad
        found = np.zeros_like(expected) if gradient is None else gradient.numpy()
        error = np.abs(found - expected).max(initial=0.0)
        assert error <= 1e-6 * max(1.0, np.abs(expected).max(initial=0.0)), name
        if name[0] in "CDEFc":
            assert np.any(expected) == (touching and not (name == "F_skew" and n_contacts == 1)), name

    s.requires_grad_(), a.requires_grad_()
    assert torch.autograd.gradcheck(lcs.step, (s, a), eps=1e-6, atol=1e-6)


def test_contact_force_is_differentiable(random_model, parameter_gradients):
    lcs = random_model(1)
    with torch.no_grad():
        lcs.c_scaled -= 1.0
    rng = np.random.default_rng(2)
    s, a = rng.normal(size=(30, 3)), rng.normal(size=(30, 1))
    assert (lcs.contact_force(s, a) > 0).all(dim=1).any()  # both contacts at once
    lcs.contact_force(s, a).square().sum().backward()
    expected = parameter_gradients(lcs, lambda: lcs.contact_force(s, a).square().sum().item())
    for name in ("D_scaled", "E_scaled", "F_factor", "F_skew", "c_scaled"):
        assert np.any(expected[name])
        np.testing.assert_allclose(getattr(lcs, name).grad, expected[name], rtol=1e-5, atol=1e-6, err_msg=name)


# -- the cart-pole ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [[0.1, 0.2, 0.05, -0.3], [0.345, 0.3, 0.02, 0.2], [-0.33, -0.2, -0.05, -0.5]])
def test_the_cart_pole_moves_as_the_integrated_equations_say(cart_pole, start):
    """A step of 1 ms, in which the wall's force hardly changes; the walls' forces have the right sign and side."""
    lcs = cart_pole(control_step=0.001, action_scale=100.0)
    after = lcs.step(np.array(start), np.array([0.05])).detach().numpy()
    exact = integrate(np.array(start), 5.0, 0.001)
    change = np.abs(exact - start).max()
    assert np.abs(after - exact).max() < 0.03 * change
    force = lcs.contact_force(np.array(start), np.array([0.05])).detach().numpy()
    penetration = abs(start[0] + 0.6 * np.sin(start[2])) - 0.35
    pressed = 0 if start[0] > 0 else 1
    expected = CartPoleParameters().wall_stiffness * max(penetration, 0.0)
    np.testing.assert_allclose(force[pressed], expected, rtol=0.05)
    assert force[1 - pressed] == 0.0


# -- errors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_states": 0}, r"^n_states must be an integer >= 1, got 0"),
        ({"n_actions": 1.5}, r"^n_actions must be an integer >= 1, got 1\.5"),
        ({"n_contacts": -1}, r"^n_contacts must be an integer >= 0, got -1"),
        ({"state_scale": [1.0]}, r"^state_scale must be 2 finite positive numbers"),
        ({"state_scale": [1.0, 0.0]}, r"^state_scale must be 2 finite positive numbers"),
        ({"state_scale": [1.0, np.nan]}, r"^state_scale must be 2 finite positive numbers"),
        ({"action_scale": [-1.0]}, r"^action_scale must be 1 finite positive numbers"),
        ({"action_scale": [np.inf]}, r"^action_scale must be 1 finite positive numbers"),
    ],
)
def test_impossible_sizes_and_scales_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        LinearComplementaritySystem(**({"n_states": 2, "n_actions": 1} | arguments))


@pytest.mark.parametrize("name", LcsMatrices._fields)
def test_a_matrix_of_the_wrong_shape_or_not_finite_is_named(name):
    matrices = random_matrices(0, 3, 2, 2)._asdict()
    wrong = matrices | {name: np.zeros(np.add(matrices[name].shape, 1))}
    # the sizes are read off A, B and c, so that another matrix is then the one that does not fit
    blamed = {"A": "[AB]", "B": "[BE]", "c": "[CDEFc]"}.get(name, name)
    with pytest.raises(ValueError, match=rf"^{blamed} must have shape"):
        LinearComplementaritySystem.from_matrices(**wrong)
    bad = matrices[name].copy()
    bad.flat[0] = np.inf
    with pytest.raises(ValueError, match=rf"^{name} must be finite"):
        LinearComplementaritySystem.from_matrices(**(matrices | {name: bad}))


def test_a_vector_in_place_of_a_matrix_is_named():
    matrices = random_matrices(0, 1, 1, 0)._asdict() | {"B": np.ones(1)}
    with pytest.raises(ValueError, match="A and B must be matrices"):
        LinearComplementaritySystem.from_matrices(**matrices)


@pytest.mark.parametrize("F", [[[0.0, 1.0], [-1.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]]])
def test_an_f_that_is_not_definite_is_refused(F):
    matrices = random_matrices(0, 3, 2, 2)._asdict() | {"F": np.array(F)}
    with pytest.raises(ValueError, match=r"^F must have a positive definite symmetric part"):
        LinearComplementaritySystem.from_matrices(**matrices)


def test_whether_f_is_accepted_does_not_depend_on_units():
    """Contacts whose gaps are in metres and in millimetres."""
    F = np.array([[1.0, 0.9], [0.9, 1.0]])
    units = np.diag([1.0, 1000.0])
    for scale in (1e-2, 1.0, 1e2):
        for gap_units in (np.eye(2), units):
            matrices = random_matrices(0, 2, 1, 2)._asdict() | {"D": gap_units, "F": gap_units @ F @ gap_units}
            lcs = LinearComplementaritySystem.from_matrices(**matrices, state_scale=[1.0, scale])
            np.testing.assert_allclose(lcs.F.detach(), gap_units @ F @ gap_units, rtol=1e-9)
