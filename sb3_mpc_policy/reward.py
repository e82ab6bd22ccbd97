"""The stage cost of eq (6): a quadratic reward the user knows, or one fitted to the rewards observed.

Both come down to ``-r(s, a) = zᵀ W z + wᵀ z + w0`` with ``z = (s, a)`` and ``W`` positive semidefinite, so that the
controller's problem is convex.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import lsq_linear

__all__ = ["QuadraticCost", "QuadraticReward", "fit_cost", "flat_cost", "is_flat"]

# Above this many components of (s, a) only a diagonal W is fitted: a full one has their square of parameters.
_LARGEST_FULL_FIT = 32
_RIDGE = 1e-6


class QuadraticCost(NamedTuple):
    """``cost(s, a) = zᵀ W z + wᵀ z + w0``, z = (s, a): W (n_z, n_z) symmetric, w (n_z,), w0 a number."""

    W: np.ndarray
    w: np.ndarray
    w0: float

    def __call__(self, s: np.ndarray, a: np.ndarray) -> np.ndarray:
        """s: (..., n_x), a: (..., n_a) -> (...)"""
        z = np.concatenate([s, a], axis=-1)
        return np.einsum("...i,ij,...j->...", z, self.W, z) + z @ self.w + self.w0


@dataclass(frozen=True)
class QuadraticReward:
    """A known reward ``constant − (s − target)ᵀ Q (s − target) − aᵀ R a``, environment units.

    :param state_weight: Q, (n_x,) the diagonal or (n_x, n_x) symmetric positive semidefinite
    :param action_weight: R, a number, (n_a,) the diagonal, or (n_a, n_a) symmetric positive semidefinite
    :param target: (n_x,) the state where the reward is largest; the origin where None
    :param constant: reward at the target; does not change the controller
    :raise ValueError: for a negative, indefinite, non-finite or wrongly shaped weight
    """

    state_weight: ArrayLike
    action_weight: ArrayLike
    target: ArrayLike | None = None
    constant: float = 0.0

    def __post_init__(self) -> None:
        Q, R = (_weight(name, getattr(self, name)) for name in ("state_weight", "action_weight"))
        if self.target is not None:
            target = np.asarray(self.target, dtype=np.float64)
            if target.shape != (len(Q),) or not np.isfinite(target).all():
                raise ValueError(f"target must be {len(Q)} finite numbers, one a state, got {self.target!r}")
        if not np.isfinite(self.constant):
            raise ValueError(f"constant must be finite, got {self.constant!r}")
        del R

    def cost(self, n_states: int, n_actions: int) -> QuadraticCost:
        """The negative reward as a quadratic in (s, a).

        :raise ValueError: where the weights do not fit the numbers of states and actions
        """
        Q, R = _weight("state_weight", self.state_weight), _weight("action_weight", self.action_weight)
        if len(Q) != n_states:
            raise ValueError(f"state_weight must be for {n_states} states, got shape {np.shape(self.state_weight)}")
        if len(R) == 1 and np.ndim(self.action_weight) == 0:
            R = np.eye(n_actions) * R
        if len(R) != n_actions:
            raise ValueError(f"action_weight must be for {n_actions} actions, got shape {np.shape(self.action_weight)}")
        target = np.zeros(n_states) if self.target is None else np.asarray(self.target, dtype=np.float64)
        W = np.zeros((n_states + n_actions,) * 2)
        W[:n_states, :n_states], W[n_states:, n_states:] = Q, R
        w = np.concatenate([-2.0 * Q @ target, np.zeros(n_actions)])
        return QuadraticCost(W, w, float(target @ Q @ target - self.constant))


def _weight(name: str, value: ArrayLike) -> np.ndarray:
    """A symmetric positive semidefinite matrix from a number, a diagonal or a matrix."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a number, a vector of weights or a matrix, got {value!r}") from error
    if array.ndim > 2 or array.size == 0 or (array.ndim == 2 and array.shape[0] != array.shape[1]):
        raise ValueError(f"{name} must be a vector of weights or a square matrix, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {value!r}")
    if array.ndim < 2:
        if (array < 0).any():
            raise ValueError(f"{name} must not be negative, got {value!r}")
        return np.diag(np.atleast_1d(array))
    if not np.allclose(array, array.T):
        raise ValueError(f"{name} must be symmetric, got {value!r}")
    least = np.linalg.eigvalsh(array).min()
    if least < -1e-9 * np.abs(array).max():
        raise ValueError(f"{name} must be positive semidefinite, got an eigenvalue of {least:.3g}")
    return (array + array.T) / 2


def flat_cost(state_scale: np.ndarray, action_scale: np.ndarray) -> QuadraticCost:
    """What is minimised while nothing is known of the reward: the distance from the origin, in scaled units."""
    scale = np.concatenate([state_scale, action_scale])
    return QuadraticCost(np.diag(1.0 / scale**2), np.zeros(len(scale)), 0.0)


def is_flat(reward: np.ndarray) -> bool:
    """Whether the rewards (N,) are all the same up to rounding, so that nothing can be learned from them."""
    return float(reward.std()) <= 1e-8 * max(1.0, abs(float(reward.mean())))


def fit_cost(
    s: np.ndarray, a: np.ndarray, reward: np.ndarray, state_scale: np.ndarray, action_scale: np.ndarray
) -> tuple[QuadraticCost, float]:
    """Fit the concave quadratic that explains the observed rewards best, in the least-squares sense.

    A convex problem: ordinary least squares where its answer is concave, else projected onto the positive
    semidefinite cone by accelerated projected gradient.

    :param s: (N, n_x)
    :param a: (N, n_a)
    :param reward: (N,)
    :param state_scale: (n_x,), for conditioning
    :param action_scale: (n_a,)
    :return: the cost, and the mean squared error relative to the variance of the reward (0 is a perfect fit); for a
        flat reward :func:`flat_cost` and 1
    """
    scale = np.concatenate([state_scale, action_scale])
    centre, spread = float(reward.mean()), float(reward.std())
    if is_flat(reward):
        return flat_cost(state_scale, action_scale), 1.0
    z = np.concatenate([s, a], axis=1) / scale
    y = -(reward - centre) / spread
    W, w, w0 = _fit_full(z, y) if z.shape[1] <= _LARGEST_FULL_FIT else _fit_diagonal(z, y)
    residual = np.einsum("ni,ij,nj->n", z, W, z) + z @ w + w0 - y
    cost = QuadraticCost(spread * W / np.outer(scale, scale), spread * w / scale, spread * w0 - centre)
    return cost, float(np.mean(residual**2))


def _fit_full(z: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    n, n_z = z.shape
    features = np.hstack([np.einsum("ni,nj->nij", z, z).reshape(n, -1), z, np.ones((n, 1))])
    size = np.sqrt(np.mean(features**2, axis=0)) + 1e-12
    # one scale for all of W keeps the projection onto the cone a projection
    size[: n_z * n_z] = size[: n_z * n_z].max()
    features = features / size
    # exact where the reward is a quadratic: a ridge here would bias the weights of components that cost little
    theta = np.linalg.lstsq(features, y, rcond=1e-12)[0]

    def project(point: np.ndarray) -> np.ndarray:
        matrix = point[: n_z * n_z].reshape(n_z, n_z)
        values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
        clipped = (vectors * np.maximum(values, 0.0)) @ vectors.T
        return np.concatenate([clipped.ravel(), point[n_z * n_z :]])

    if np.allclose(project(theta), theta, rtol=0.0, atol=1e-7 * np.abs(theta).max()):
        theta = project(theta)
    else:
        gram = features.T @ features / n + _RIDGE * np.eye(features.shape[1])
        target = features.T @ y / n
        step = 1.0 / np.linalg.eigvalsh(gram)[-1]
        theta = ahead = project(theta)
        momentum = 1.0
        for _ in range(2_000):
            moved = project(ahead - step * (gram @ ahead - target))
            following = (1.0 + np.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
            ahead = moved + (momentum - 1.0) / following * (moved - theta)
            if np.abs(moved - theta).max() < 1e-10:
                theta = moved
                break
            theta, momentum = moved, following
    theta = theta / size
    W = theta[: n_z * n_z].reshape(n_z, n_z)
    return (W + W.T) / 2, theta[n_z * n_z : -1], float(theta[-1])


def _fit_diagonal(z: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    n, n_z = z.shape
    features = np.hstack([z**2, z, np.ones((n, 1))])
    ridge = np.sqrt(_RIDGE * n) * np.eye(features.shape[1])
    lower = np.concatenate([np.zeros(n_z), np.full(n_z + 1, -np.inf)])
    result = lsq_linear(np.vstack([features, ridge]), np.concatenate([y, np.zeros(len(ridge))]), (lower, np.inf))
    return np.diag(result.x[:n_z]), result.x[n_z:-1], float(result.x[-1])
