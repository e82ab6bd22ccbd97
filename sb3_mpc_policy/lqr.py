"""Linear-quadratic regulation of the contact-free part of the model: nominal feedback and Riccati terminal value.

For ``s' = A s + B a + d`` and stage cost ``zᵀ W z + wᵀ z``, ``z = (s, a)``, the undiscounted cost to go is
``V(s) = sᵀ P s + pᵀ s + const`` and the best action ``a = K s + k``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

__all__ = ["AffineLqr", "affine_lqr"]

# Horizon of the recursion that stands in where the algebraic Riccati equation has no stabilising solution.
_FALLBACK_HORIZON = 50
# A cost to go this much larger than the stage cost is that of a mode no action reaches.
_LARGEST_GROWTH = 1e8


class AffineLqr(NamedTuple):
    """Cost to go ``sᵀ P s + pᵀ s`` and feedback ``a = K s + k``; ``source`` says how they were found.

    P (n_x, n_x), p (n_x,), K (n_a, n_x), k (n_a,); source is "riccati", "finite horizon" or "stage cost".
    """

    P: np.ndarray
    p: np.ndarray
    K: np.ndarray
    k: np.ndarray
    source: str


def affine_lqr(A: np.ndarray, B: np.ndarray, d: np.ndarray, W: np.ndarray, w: np.ndarray) -> AffineLqr:
    """Solve the regulator; where it has no solution fall back to a finite horizon, then to the stage cost alone.

    :param A: (n_x, n_x)
    :param B: (n_x, n_a)
    :param d: (n_x,)
    :param W: (n_x + n_a, n_x + n_a) symmetric positive semidefinite, its action block positive definite
    :param w: (n_x + n_a,)
    """
    for source, solve in (("riccati", _algebraic), ("finite horizon", _finite_horizon)):
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # a model that explodes is what the fallbacks are for
                P, p, K, k = solve(A, B, d, W, w)
        except (np.linalg.LinAlgError, ValueError):  # SciPy raises either where no solution exists
            continue
        usable = all(np.isfinite(part).all() for part in (P, p, K, k))
        if usable and np.abs(P).max() < _LARGEST_GROWTH * np.abs(W).max():
            return AffineLqr(P, p, K, k, source)
    n_x, n_a = B.shape
    return AffineLqr(W[:n_x, :n_x].copy(), w[:n_x].copy(), np.zeros((n_a, n_x)), np.zeros(n_a), "stage cost")


def _algebraic(
    A: np.ndarray, B: np.ndarray, d: np.ndarray, W: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    n_x = len(A)
    Q, N, R = W[:n_x, :n_x], W[:n_x, n_x:], W[n_x:, n_x:]
    P = solve_discrete_are(A, B, Q, R, s=N)
    P = (P + P.T) / 2
    M = R + B.T @ P @ B
    K = -np.linalg.solve(M, B.T @ P @ A + N.T)
    closed_loop = A + B @ K
    if np.abs(np.linalg.eigvals(closed_loop)).max() >= 1.0:
        raise np.linalg.LinAlgError("the closed loop is not stable")
    # p solves  p = w_s + Kᵀ w_a + (A + B K)ᵀ (p + 2 P d)
    p = np.linalg.solve(np.eye(n_x) - closed_loop.T, w[:n_x] + K.T @ w[n_x:] + 2.0 * closed_loop.T @ P @ d)
    k = -np.linalg.solve(M, B.T @ (P @ d + 0.5 * p) + 0.5 * w[n_x:])
    return P, p, K, k


def _finite_horizon(
    A: np.ndarray, B: np.ndarray, d: np.ndarray, W: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    n_x = len(A)
    Q, N, R = W[:n_x, :n_x], W[:n_x, n_x:], W[n_x:, n_x:]
    P, p = Q, w[:n_x]
    K, k = np.zeros((B.shape[1], n_x)), np.zeros(B.shape[1])
    for _ in range(_FALLBACK_HORIZON):
        M = R + B.T @ P @ B
        K = -np.linalg.solve(M, B.T @ P @ A + N.T)
        k = -np.linalg.solve(M, B.T @ (P @ d + 0.5 * p) + 0.5 * w[n_x:])
        closed_loop = A + B @ K
        p = w[:n_x] + K.T @ w[n_x:] + closed_loop.T @ (p + 2.0 * P @ d)
        P = Q + A.T @ P @ A + (A.T @ P @ B + N) @ K
        P = (P + P.T) / 2
    return P, p, K, k
