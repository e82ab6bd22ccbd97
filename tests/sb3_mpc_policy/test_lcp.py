"""The complementarity problem has one solution, found exactly, and differentiated exactly."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from sb3_mpc_policy import lcp
from sb3_mpc_policy.lcp import LcpSolver, solve_lcp

SIZES = range(9)
METHODS = {"as chosen": lcp._MAX_TABULATED_CONTACTS, "pivoting": 0, "tabulated": 8}


@pytest.fixture(params=METHODS)
def make_solver(request, monkeypatch):
    """Every way to solve, whatever the size."""
    monkeypatch.setattr(lcp, "_MAX_TABULATED_CONTACTS", METHODS[request.param])
    return LcpSolver


def p_matrix(size: int, seed: int, skew: float = 1.0) -> np.ndarray:
    """Positive definite plus skew: every principal minor is positive."""
    rng = np.random.default_rng(seed)
    G, S = rng.normal(size=(2, size, size))
    return G @ G.T + 0.1 * np.eye(size) + skew * (S - S.T)


def assert_complementary(F: np.ndarray, q: np.ndarray, lam: np.ndarray) -> None:
    size = 1.0 + np.abs(q).max(initial=0.0)
    gap = lam @ F.T + q
    assert lam.min(initial=0.0) >= 0.0
    assert gap.min(initial=0.0) >= -1e-9 * size
    assert np.abs(lam * gap).max(initial=0.0) <= 1e-8 * size**2


@pytest.mark.parametrize("size", SIZES)
def test_the_solution_is_that_of_enumeration(make_solver, enumerate_lcp, size):
    for seed in range(3):
        F = p_matrix(size, seed)
        q = np.random.default_rng(100 + seed).normal(size=(12, size))
        lam, active = make_solver(F)(q)
        assert lam.shape == active.shape == q.shape
        expected = np.array([enumerate_lcp(F, row) for row in q]).reshape(q.shape)
        np.testing.assert_allclose(lam, expected, rtol=1e-8, atol=1e-9)
        np.testing.assert_array_equal(active, expected > 0.0)


@pytest.mark.parametrize("size", [1, 4, 8, 20])
def test_a_symmetric_problem_is_nonnegative_least_squares(make_solver, size):
    """With F = RᵀR, lam minimises |R lam + R^{-T} q| over lam >= 0 (Lawson and Hanson's algorithm, in SciPy)."""
    if size > 8 and make_solver(np.eye(size))._modes is not None:
        pytest.skip("the table would be too large")
    F = p_matrix(size, seed=5, skew=0.0)
    R = np.linalg.cholesky(F).T
    q = np.random.default_rng(6).normal(size=(10, size))
    expected = [nnls(R, -np.linalg.solve(R.T, row))[0] for row in q]
    np.testing.assert_allclose(make_solver(F)(q)[0], expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("size", [3, 8])
def test_a_p_matrix_without_definite_symmetric_part_is_solved_too(make_solver, enumerate_lcp, size):
    """Unit upper triangular with large entries: all principal minors are one, the symmetric part is indefinite."""
    rng = np.random.default_rng(2)
    F = np.eye(size) + np.triu(rng.uniform(-3.0, 3.0, (size, size)), 1)
    assert np.linalg.eigvalsh(F + F.T).min() < 0.0
    q = rng.normal(size=(20, size))
    lam, _ = make_solver(F)(q)
    np.testing.assert_allclose(lam, [enumerate_lcp(F, row) for row in q], rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("size", range(1, 9))
def test_problems_on_the_border_between_modes_are_solved(make_solver, enumerate_lcp, size):
    """Zeros in q, and a q for which a contact carries no force although its gap is closed."""
    F = p_matrix(size, seed=size)
    rng = np.random.default_rng(size)
    sparse = rng.normal(size=(10, size)) * rng.integers(0, 2, (10, size))
    touching = -F @ np.concatenate([np.ones(size // 2), np.zeros(size - size // 2)])
    q = np.vstack([np.zeros(size), sparse, touching])
    lam, _ = make_solver(F)(q)
    np.testing.assert_allclose(lam, [enumerate_lcp(F, row) for row in q], rtol=1e-8, atol=1e-9)
    np.testing.assert_array_equal(lam[0], np.zeros(size))


@pytest.mark.parametrize(
    ("F", "q"),
    [
        ([[1, 0, 3], [-1, 1, 0], [-2, 2, 1]], [-2, 1, 1]),
        ([[1, -2, 2, -2], [1, 1, 3, 0], [0, 0, 1, -3], [2, -3, 3, 1]], [3, -1, 1, 2]),
    ],
)
def test_block_pivoting_that_cycles_is_rescued_by_single_pivots(enumerate_lcp, F, q):
    """P-matrices on which flipping all violated indices at once comes back to where it was."""
    F, q = np.array(F, dtype=float), np.array(q, dtype=float)
    lam, _ = lcp._block_principal_pivoting(F, q[None])
    np.testing.assert_allclose(lam[0], enumerate_lcp(F, q), atol=1e-12)


def test_without_contacts_there_is_nothing_to_solve():
    lam, active = LcpSolver(np.zeros((0, 0)))(np.zeros((7, 0)))
    assert lam.shape == active.shape == (7, 0)
    assert solve_lcp(torch.zeros(0, 0, dtype=torch.float64), torch.zeros(7, 0, dtype=torch.float64)).shape == (7, 0)


@pytest.mark.parametrize("size", [0, 2, 6])
def test_an_empty_batch_is_solved(make_solver, size):
    lam, active = make_solver(p_matrix(size, 0))(np.zeros((0, size)))
    assert lam.shape == active.shape == (0, size)


@pytest.mark.parametrize("size", [2, 6])
def test_large_batches_are_solved_row_by_row(make_solver, size):
    F = p_matrix(size, 3)
    q = np.random.default_rng(4).normal(size=(20_000, size))
    lam, _ = make_solver(F)(q)
    assert_complementary(F, q, lam)
    few = slice(9_990, 10_010)
    np.testing.assert_allclose(make_solver(F)(q[few])[0], lam[few], rtol=1e-10, atol=1e-13)


def test_the_size_of_the_data_does_not_matter(make_solver):
    """Newtons against metres: F of 1e-5 and q of 1e3, and the reverse."""
    F, q = p_matrix(5, 1), np.random.default_rng(1).normal(size=(30, 5))
    reference, _ = make_solver(F)(q)
    for factor_F, factor_q in ((1e-5, 1e3), (1e4, 1e-6)):
        lam, _ = make_solver(factor_F * F)(factor_q * q)
        np.testing.assert_allclose(lam * factor_F / factor_q, reference, rtol=1e-8, atol=1e-9)


def test_pivoting_says_so_where_f_is_not_a_p_matrix():
    with pytest.raises(ArithmeticError, match="F is not a P-matrix"):
        LcpSolver(-np.eye(5))(-np.ones((1, 5)))


@pytest.mark.parametrize("size", [1, 2, 4, 6])
def test_derivative_is_that_of_central_differences(size, central_difference):
    rng = np.random.default_rng(size)
    F, weight = p_matrix(size, size), rng.normal(size=(8, size))
    q = rng.normal(size=(200, size))
    lam, _ = LcpSolver(F)(q)
    # away from the kinks, where lam and gap vanish together
    q = q[np.maximum(lam, lam @ F.T + q).min(axis=1) > 0.02][:8]
    weight = weight[: len(q)]
    forces = LcpSolver(F)(q)[0]
    assert len(q) >= 2
    assert (forces > 0).any()
    assert (forces == 0).any()

    tensors = [torch.tensor(array, requires_grad=True) for array in (F, q)]
    (solve_lcp(*tensors) * torch.as_tensor(weight)).sum().backward()

    def value(F: np.ndarray, q: np.ndarray) -> float:
        return float((LcpSolver(F)(q)[0] * weight).sum())

    for tensor, expected in (
        (tensors[0], central_difference(lambda moved: value(moved, q), F)),
        (tensors[1], central_difference(lambda moved: value(F, moved), q)),
    ):
        error = np.abs(tensor.grad.numpy() - expected).max() / np.abs(expected).max()
        assert error < 1e-6


@pytest.mark.parametrize("size", [1, 3, 6])
def test_torch_agrees_that_the_derivative_is_right(size):
    F = torch.tensor(p_matrix(size, 11), requires_grad=True)
    q = torch.tensor(np.random.default_rng(12).normal(size=(5, size)), requires_grad=True)
    assert torch.autograd.gradcheck(solve_lcp, (F, q), eps=1e-7, atol=1e-6, rtol=1e-5)


def test_an_open_contact_has_no_derivative():
    F, q = (torch.tensor(a, requires_grad=True) for a in (np.eye(2), np.array([[1.0, -2.0]])))
    solve_lcp(F, q).sum().backward()
    np.testing.assert_array_equal(q.grad.numpy(), [[0.0, -1.0]])
    np.testing.assert_array_equal(F.grad.numpy(), [[0.0, 0.0], [0.0, -2.0]])
