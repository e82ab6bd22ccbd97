"""Least squares through the complementarity problem: eq (12) by Levenberg-Marquardt with variable projection.

    minimise   Σ_i w_i |W x_i + C lam_i − y_i|² + Σ_k ridge_k |W_k|²      lam_i = LCP(F, P z_i)

over the smooth coefficients W, the forces' effect C, the gap rows P = [D E c] and F. For fixed P and F the forces
follow from the complementarity problem and W and C from linear least squares, so only P and F are searched for
(variable projection, Golub and Pereyra 1973, with Kaufman's Gauss-Newton matrix). Their derivative is implicit on the
active set, ``d lam = J (dP z + dF lam)`` with ``J = −F_aa^{-1}``, and J is the same for all data in one mode. So the
Gauss-Newton matrix is a sum over *modes* of small Kronecker products, and its cost hardly grows with the data.

``F = G Gᵀ + kappa diag(G Gᵀ) + S − Sᵀ`` stays a P-matrix that :meth:`LinearComplementaritySystem.from_matrices`
accepts. G is a full matrix and the scales of forces and gaps are free, more parameters than there are degrees of
freedom: that costs nothing here, and descents from random starts end in the global minimum more often.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sb3_mpc_policy.lcp import LcpSolver
from sb3_mpc_policy.lcs import KAPPA

__all__ = ["MOST_CONTACTS", "Contacts", "Data", "Fit", "descend", "evaluate", "normal_equations", "pivoted"]

MOST_CONTACTS = 62  # active sets are told apart by the bits of one integer

# kappa: scaled to a unit diagonal, F's symmetric part has no eigenvalue below _DEFINITE / (1 + _DEFINITE) > KAPPA.
_DEFINITE = 1.01 * KAPPA
_LEAST_DIAGONAL = 1e-9  # of G Gᵀ, whose rows are scaled to one: keeps F definite for every G
_RIDGE = 1e-9  # relative to the data: what they say nothing about is zero
_TOLERANCE = 1e-12  # relative to the gaps' size, as in LcpSolver
_WARM_PIVOTS = 5
_LEAST_DAMPING, _DAMPING = 1e-9, 1e-2
_TRIALS = 8  # of the damping, each four times the one before
_NEGLIGIBLE = 1e-18  # whitened: nothing is left to explain


class Contacts(NamedTuple):
    """What is searched for: gap rows P (n, p), and G (n, n) and S (n, n; its upper triangle counts) of F."""

    P: np.ndarray
    G: np.ndarray
    S: np.ndarray

    @classmethod
    def of(cls, P: np.ndarray, F: np.ndarray) -> Contacts:
        """Gap rows, and the F nearest to a given one of positive diagonal that is allowed."""
        root = np.sqrt(np.diag(F))
        F = F / root / root[:, None]
        values, vectors = np.linalg.eigh((F + F.T) / 2.0 - _DEFINITE / (1.0 + _DEFINITE) * np.eye(len(F)))
        return cls(P / root[:, None], vectors * np.sqrt(np.maximum(values, 0.0)), np.triu(F - F.T, 1) / 2.0)

    @property
    def F(self) -> np.ndarray:
        size = np.square(self.G).sum(axis=1) + _LEAST_DIAGONAL
        skew = np.triu(self.S, 1)
        return self.G @ self.G.T + _DEFINITE * np.diag(size) + skew - skew.T

    def rescaled(self) -> Contacts:
        """The same model with forces and gaps in such units that the rows of G have length one."""
        size = np.sqrt(np.square(self.G).sum(axis=1) + _LEAST_DIAGONAL)[:, None]
        return Contacts(self.P / size, self.G / size, self.S / size / size.T)

    def without(self, row: int) -> Contacts:
        """The model without one of its contacts."""
        keep = np.arange(len(self.P)) != row
        G = np.linalg.qr(self.G[keep].T)[1].T  # square again, G Gᵀ the same
        return Contacts(self.P[keep], G, self.S[np.ix_(keep, keep)])


class Data:
    """The data of a fit, with what does not depend on the contacts computed once.

    :param z: (N, p) what gaps are linear in: state, action and one, all of order one
    :param y: (N, n_x) what is to be explained, of order one
    :param smooth: (N, k) what is linear in the model, ``z`` among it
    :param weights: (N,) >= 0, not all zero; only their ratios count
    :param ridge: (k,) >= 0 on the squared coefficients of ``smooth``
    """

    def __init__(
        self, z: np.ndarray, y: np.ndarray, smooth: np.ndarray, weights: np.ndarray, ridge: np.ndarray
    ) -> None:
        self.z, self.y, self.smooth, self.ridge = z, y, smooth, ridge
        self.weights = weights / weights.sum()
        root = np.sqrt(self.weights)[:, None]
        self.penalty = ridge + _RIDGE * (np.square(root * smooth).sum(axis=0) + 1.0)
        # in this basis of the smooth terms their Gram matrix, penalty included, is the identity
        factor = np.linalg.qr(np.vstack([root * smooth, np.diag(np.sqrt(self.penalty))]))[1]
        self.to_smooth = np.linalg.inv(factor)
        self.basis = smooth @ self.to_smooth
        self.moment = self.basis.T @ (self.weights[:, None] * y)

    def __len__(self) -> int:
        return len(self.z)

    def part(self, index: np.ndarray, weights: np.ndarray) -> Data:
        """Some of the data, with other weights."""
        return Data(self.z[index], self.y[index], self.smooth[index], weights, self.ridge)


@dataclass
class Fit:
    """Contacts with everything that follows from them.

    :param forces: lam (N, n)
    :param C: (n_x, n), and W (k, n_x): the linear coefficients
    :param residual: (N, n_x) prediction minus y
    :param cost: weighted mean of the squared residuals, summed over components
    :param objective: the cost with the ridge's penalty, which descents minimise
    :param converged: whether a descent has ended here
    """

    contacts: Contacts
    F: np.ndarray
    forces: np.ndarray
    C: np.ndarray
    W: np.ndarray
    residual: np.ndarray
    cost: float
    objective: float
    touching: np.ndarray  # (M,) index of the data with any contact
    schur: np.ndarray  # (n, n) Gram matrix of the forces beside the smooth terms
    coupling: np.ndarray  # (k, n) what of the forces the smooth terms' basis explains
    damping: float = _DAMPING
    converged: bool = False

    @property
    def active(self) -> np.ndarray:
        """(N, n) bool: which contacts carry a force."""
        return self.forces > 0.0


def evaluate(data: Data, contacts: Contacts, guess: np.ndarray | None = None) -> Fit:
    """Forces, linear coefficients and cost of given contacts.

    :param guess: (N, n) bool, active sets that may be near those of the solution
    """
    F = contacts.F
    forces = _forces(F, data.z @ contacts.P.T, guess)
    touching = np.flatnonzero((forces > 0.0).any(axis=1))
    some = forces[touching]
    weighted = some * data.weights[touching, None]
    coupling = data.basis[touching].T @ weighted
    gram = some.T @ weighted
    schur = gram - coupling.T @ coupling + np.diag(_RIDGE * np.diag(gram) + 1e-14)
    effect = np.linalg.solve(schur, weighted.T @ data.y[touching] - coupling.T @ data.moment)
    W = data.to_smooth @ (data.moment - coupling @ effect)
    residual = data.smooth @ W - data.y
    residual[touching] += some @ effect
    cost = float(data.weights @ np.square(residual).sum(axis=1))
    objective = cost + float(data.penalty @ np.square(W).sum(axis=1))
    return Fit(contacts, F, forces, effect.T, W, residual, cost, objective, touching, schur, coupling)


def pivoted(contacts: Contacts, swapped: np.ndarray) -> Contacts:
    """The same model with force and gap of some contacts swapped (a principal pivot): a wall seen from behind.

    Then the smooth part of the model is the motion in which those contacts are active.

    :param swapped: (n,) bool
    """
    P, F = contacts.P, contacts.F
    gap_of_force = np.where(swapped[:, None], F, np.eye(len(F)))  # (w_α, z_β) = gap_of_force z + (P_α, 0)
    rows = np.where(swapped[:, None], P, 0.0)
    inverse = np.linalg.inv(gap_of_force)
    # the new gaps (z_α, w_β) in the new forces (w_α, z_β)
    to_gaps = np.where(swapped[:, None], np.eye(len(F)), F)
    return Contacts.of(np.where(swapped[:, None], 0.0, P) - to_gaps @ inverse @ rows, to_gaps @ inverse)


def _forces(F: np.ndarray, q: np.ndarray, guess: np.ndarray | None) -> np.ndarray:
    """LCP(F, q), by a few pivots from guessed active sets where there are any."""
    if guess is None:
        return LcpSolver(F)(q)[0]
    forces = np.zeros_like(q)
    todo = np.flatnonzero(~(q >= 0.0).all(axis=1))
    active = guess[todo]
    tolerance = _TOLERANCE * (1.0 + np.abs(q).max(axis=1, initial=0.0))
    for _ in range(_WARM_PIVOTS):
        if not len(todo):
            return forces
        order, first, patterns = _by_mode(active)
        maps = np.repeat(_implicit_derivative(F, patterns), np.diff(first), axis=0)
        lam = np.empty_like(active, dtype=np.float64)
        lam[order] = np.matmul(maps, q[todo[order], :, None])[..., 0]
        violated = np.where(active, lam, q[todo] + lam @ F.T) < -tolerance[todo, None]
        unsolved = violated.any(axis=1)
        forces[todo[~unsolved]] = np.maximum(lam[~unsolved], 0.0)
        todo, active = todo[unsolved], (active ^ violated)[unsolved]
    forces[todo] = LcpSolver(F)(q[todo])[0]
    return forces


def _by_mode(active: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sort data by mode: their order, where each mode begins and the last ends (n_modes + 1,), its active set."""
    n = active.shape[1]
    code = active @ (1 << np.arange(n, dtype=np.int64))
    order = np.argsort(code, kind="stable")
    first = np.flatnonzero(np.diff(code[order], prepend=-1))
    return order, np.append(first, len(order)), active[order[first]]


def _implicit_derivative(F: np.ndarray, active: np.ndarray) -> np.ndarray:
    """(n_modes, n, n): J = −F_aa^{-1} on each active set, zero elsewhere."""
    both = active[:, :, None] & active[:, None, :]
    return np.where(both, -np.linalg.inv(np.where(both, F, np.eye(len(F)))), 0.0)


def normal_equations(data: Data, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix and gradient of half the objective in the entries of [P F], row by row.

    Contact i's row is (P_i, F_i), because ``d prediction / dP_ij = (C J)_i z_j`` and ``.. / dF_ij = (C J)_i lam_j``.
    What W and C make up for is projected out.

    :return: (n (p + n), n (p + n)) and (n (p + n),)
    """
    n, p = fit.contacts.P.shape
    n_x, k, row = data.y.shape[1], data.smooth.shape[1], p + n
    order, first, patterns = _by_mode(fit.active[fit.touching])
    index, n_modes = fit.touching[order], len(patterns)
    effect = np.matmul(fit.C, _implicit_derivative(fit.F, patterns))  # C J: (n_modes, n_x, n)
    inputs = np.hstack([data.z[index], fit.forces[index]])
    weighted = np.hstack([inputs, data.basis[index], fit.residual[index]]) * data.weights[index, None]
    moments = np.empty((n_modes, row, weighted.shape[1]))
    for mode, (begin, end) in enumerate(pairwise(first)):
        np.matmul(inputs[begin:end].T, weighted[begin:end], out=moments[mode])

    def over_modes(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        return left.reshape(n_modes, -1).T @ right.reshape(n_modes, -1)

    squares = over_modes(np.matmul(effect.transpose(0, 2, 1), effect), moments[:, :, :row])
    matrix = squares.reshape(n, n, row, row).transpose(0, 2, 1, 3).reshape(n * row, n * row)
    with_smooth = over_modes(effect, moments[:, :, row : row + k]).reshape(n_x * n * row, k)
    with_forces = over_modes(effect, moments[:, :, p:row]).reshape(n_x * n * row, n) - with_smooth @ fit.coupling
    beside_smooth = np.linalg.solve(np.linalg.cholesky(fit.schur), with_forces.T).T
    explained = np.hstack([with_smooth, beside_smooth])
    explained = explained.reshape(n_x, n * row, -1).transpose(1, 0, 2).reshape(n * row, -1)
    gradient = np.matmul(moments[:, :, row + k :], effect).sum(axis=0).T.reshape(-1)
    return matrix - explained @ explained.T, gradient


def _rows_by_parameters(contacts: Contacts) -> np.ndarray:
    """d [P F] / d (P, G, S): (n (p + n), n p + n² + n (n − 1) / 2)."""
    n, p = contacts.P.shape
    identity, diagonal = np.eye(n), np.arange(n)
    upper = np.triu_indices(n, 1)
    result = np.zeros((n, p + n, n * p + n * n + len(upper[0])))
    result[:, :p, : n * p] = np.eye(n * p).reshape(n, p, n * p)
    by_G = np.einsum("ac,bd->abcd", identity, contacts.G) + np.einsum("bc,ad->abcd", identity, contacts.G)
    by_G[diagonal, diagonal, diagonal] += 2.0 * _DEFINITE * contacts.G
    result[:, p:, n * p : n * p + n * n] = by_G.reshape(n, n, n * n)
    last = n * p + n * n + np.arange(len(upper[0]))
    result[upper[0], p + upper[1], last] = 1.0
    result[upper[1], p + upper[0], last] = -1.0
    return result.reshape(n * (p + n), -1)


def _moved(contacts: Contacts, step: np.ndarray) -> Contacts:
    n, p = contacts.P.shape
    by_P, by_G, by_S = np.split(step, [n * p, n * p + n * n])
    S = contacts.S.copy()
    S[np.triu_indices(n, 1)] += by_S
    return Contacts(contacts.P + by_P.reshape(n, p), contacts.G + by_G.reshape(n, n), S)


def descend(data: Data, fit: Fit, iterations: int, tolerance: float = 1e-5) -> Fit:
    """Levenberg-Marquardt from a fit: the objective never rises.

    :param tolerance: relative decrease of the objective below which the descent has converged
    """
    for _ in range(iterations):
        if fit.converged:
            return fit
        better = _step(data, fit) if len(fit.touching) and fit.cost > _NEGLIGIBLE else None
        if better is None:
            fit.converged = True
            return fit
        better.converged = fit.objective - better.objective < tolerance * fit.objective
        fit = better
    return fit


def _step(data: Data, fit: Fit) -> Fit | None:
    """One step that lowers the objective, None where none is found."""
    rows, gradient = normal_equations(data, fit)
    chain = _rows_by_parameters(fit.contacts)
    matrix, gradient = chain.T @ rows @ chain, chain.T @ gradient
    diagonal = np.maximum(np.diag(matrix), 0.0)
    diagonal = diagonal + 1e-7 * diagonal.max(initial=0.0) + 1e-15
    damping = fit.damping
    for _ in range(_TRIALS):
        step = np.linalg.solve(matrix + damping * np.diag(diagonal), -gradient)
        try:
            trial = evaluate(data, _moved(fit.contacts, step).rescaled(), fit.active)
        except ArithmeticError:  # so far out that rounding hides that F is a P-matrix: too long a step
            trial = None
        if trial is not None and trial.objective < fit.objective:
            trial.damping = max(damping / 4.0, _LEAST_DAMPING)
            return trial
        damping *= 4.0
    return None
