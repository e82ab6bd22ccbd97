"""Contacts found in what a smooth model leaves unexplained: few transitions, each a large surprise.

With ``F = I`` the contact term of eq (5) is a sum of *hinges*: contact k pushes along ``C_k`` with ``max(0, −P_k z)``,
``z = (s, a, 1)`` and ``P = [D E c]`` (Breiman 1993, "Hinging hyperplanes"). Given the surprises r of a smooth model,

    minimise   Σ_i near_i  log(1 + |C lam_i − r_i|² / size_i²)  +  Σ_k |P_k · drift|²          lam_i = max(0, −P z_i)

* ``size_i`` is a share of the surprise itself beside the noise: a light touch says as much about where a wall stands as
  a blow, and the blows of a fall, larger by orders of magnitude, do not drown the others;
* the logarithm (a Cauchy loss) gives up on what no hinge explains, such as contacts far from where the model is to
  hold, which a linear gap does not describe;
* ``near`` counts transitions by how nearly linear the dynamics is around them (contact_fit.py);
* ``drift`` is how much each of z changes in a step. It makes gaps depend on what changes slowly, positions, where a
  handful of contacts leave it open, and fades as data arrive.

Hinges are added one by one while they are worth it, each the best of several descents (Levenberg-Marquardt on all
hinges together) that start from a few neighbouring surprises of like direction, as in random sample consensus.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["Hinges", "Surprises", "find_hinges"]

_SHARE = 0.1  # of a surprise that a good explanation may leave
_LOUD = 10.0  # noise levels from which on a transition is a surprise
_WORTH = 3.0  # hinges explain as much as this many surprises that only they touch ...
_WORTH_KEEPING = 1.0  # ... and those of the last fit as much as this many
_SUDDEN = 0.5  # share of a surprise that its force may change by within a step
_LEAST_NEAR = 1e-3  # the least that a surprise counts from which a hinge may be learned
_STARTS, _SHORT, _LONG = 8, 10, 60
_NEIGHBOURS = (4, 40)  # surprises that a start is regressed on
_LIKE = 0.8  # cosine between surprises of like direction
_MOST_QUIET, _MOST_LOUD = 2000, 1000  # transitions that take part
_CONVERGED = 1e-5
_TRIALS = 8  # of the damping, each four times the one before


class Hinges(NamedTuple):
    """C (n_x, n) of unit columns, and gap rows P (n, p): together they push ``C max(0, −P z)``."""

    C: np.ndarray
    P: np.ndarray

    @classmethod
    def none(cls, n_x: int, p: int) -> Hinges:
        return cls(np.zeros((n_x, 0)), np.zeros((0, p)))

    @property
    def n(self) -> int:
        return len(self.P)

    def forces(self, z: np.ndarray) -> np.ndarray:
        """(N, n)"""
        return np.maximum(-(z @ self.P.T), 0.0)

    def push(self, z: np.ndarray) -> np.ndarray:
        """(N, n_x)"""
        return self.forces(z) @ self.C.T

    def normalised(self) -> Hinges:
        """The same push with unit columns of C."""
        size = np.maximum(np.linalg.norm(self.C, axis=0), 1e-300)
        return Hinges(self.C / size, self.P * size[:, None])

    def plus(self, C: np.ndarray, P: np.ndarray) -> Hinges:
        """With more of them."""
        return Hinges(np.column_stack([self.C, C]), np.vstack([self.P, P]))

    def without(self, k: int) -> Hinges:
        """With one less."""
        keep = np.arange(self.n) != k
        return Hinges(self.C[:, keep], self.P[keep])

    def absorbed(self, k: int) -> Hinges:
        """With one less, whose part the one that pushes most like it takes over, if any does."""
        rest, like = self.without(k), self.without(k).C.T @ self.C[:, k]
        if not len(like) or like.max() < _LIKE:
            return rest
        P, j = rest.P.copy(), int(like.argmax())
        P[j] += like[j] * self.P[k]
        return Hinges(rest.C, P)


class _Fit(NamedTuple):
    hinges: Hinges
    forces: np.ndarray
    residual: np.ndarray  # (N, n_x) push minus surprise
    excess: np.ndarray  # (N,) squared, in units of what may be left
    cost: float


class Surprises:
    """What a smooth model leaves, as the data of a search for hinges.

    :param z: (N, p) state, action and one, of order one
    :param surprise: (N, n_x) what happened minus what the smooth model says, in units of a typical step
    :param near: (N,) > 0, how much each transition counts
    :param noise: (N,) > 0, what is left of a transition that the smooth model explains
    :param drift: (p,) >= 0, how much each of z changes in a step
    :param unit: (n_x,) of a surprise, in units of the state in z
    """

    def __init__(
        self,
        z: np.ndarray,
        surprise: np.ndarray,
        near: np.ndarray,
        noise: np.ndarray,
        drift: np.ndarray,
        unit: np.ndarray,
        rng: np.random.Generator,
    ) -> None:
        size = np.linalg.norm(surprise, axis=1)
        loud = np.flatnonzero(size > _LOUD * noise)
        quiet = np.flatnonzero(size <= _LOUD * noise)
        near = near.copy()
        # all surprises count, as long as they are few; the others say where no contact is, and some are enough
        if len(loud) > _MOST_LOUD:
            near[loud] *= len(loud) / _MOST_LOUD
            loud = rng.choice(loud, _MOST_LOUD, replace=False)
        if len(quiet) > _MOST_QUIET:
            near[quiet] *= len(quiet) / _MOST_QUIET
            quiet = rng.choice(quiet, _MOST_QUIET, replace=False)
        index = np.concatenate([loud, quiet])
        self.z, self.r, self.near = z[index], surprise[index], near[index]
        self.size = size[index]
        self.loud = np.arange(len(loud))
        self.variance = np.square(noise[index]) + np.square(_SHARE * self.size)
        typical = float(np.median(self.size[self.loud])) if len(loud) else 1.0
        self.prior = drift / (_SUDDEN * typical)
        self.spread = self.z[self.loud].std(axis=0) + 1e-9 if len(loud) else np.ones(z.shape[1])
        self.unit, self.rng = unit, rng

    def evaluate(self, hinges: Hinges) -> _Fit:
        forces = hinges.forces(self.z)
        residual = forces @ hinges.C.T - self.r
        excess = np.square(residual).sum(axis=1) / self.variance
        cost = self.near @ np.log1p(excess) + np.square(hinges.P * self.prior).sum()
        return _Fit(hinges, forces, residual, excess, float(cost))

    def descend(self, fit: _Fit, iterations: int) -> _Fit:
        """Levenberg-Marquardt on C and P together, Cauchy weights renewed in each step. The cost never rises."""
        damping = 1e-3
        for _ in range(iterations):
            if fit.hinges.n == 0:
                return fit
            matrix, gradient = self._normal_equations(fit)
            diagonal = np.diag(matrix) + 1e-9 * np.diag(matrix).max() + 1e-15
            better = None
            for _ in range(_TRIALS):
                step = np.linalg.solve(matrix + damping * np.diag(diagonal), -gradient).reshape(fit.hinges.n, -1)
                moved = Hinges(
                    fit.hinges.C + step[:, : len(fit.hinges.C)].T, fit.hinges.P + step[:, len(fit.hinges.C) :]
                )
                trial = self.evaluate(moved.normalised())
                if trial.cost < fit.cost:
                    better = trial
                    break
                damping *= 4.0
            if better is None:
                return fit
            done = fit.cost - better.cost < _CONVERGED * fit.cost
            fit, damping = better, max(damping / 4.0, 1e-9)
            if done:
                return fit
        return fit

    def _normal_equations(self, fit: _Fit) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton matrix and gradient in (C_k, P_k), contact by contact."""
        C, P = fit.hinges
        (n_x, n), p = C.shape, P.shape[1]
        touched = (fit.forces > 0.0).any(axis=1)
        forces, z = fit.forces[touched], self.z[touched]
        root = np.sqrt(self.near[touched] / (self.variance[touched] * (1.0 + fit.excess[touched])))
        # d residual / d C_jk = force_k in component j; d residual / d P_k = −C_k z where k is active
        jacobian = np.zeros((len(z), n_x, n, n_x + p))
        component = np.arange(n_x)
        jacobian[:, component, :, component] = forces
        slope = np.where(forces[:, :, None] > 0.0, -z[:, None, :], 0.0)
        jacobian[:, :, :, n_x:] = C[None, :, :, None] * slope[:, None]
        flat = (jacobian * root[:, None, None, None]).reshape(-1, n * (n_x + p))
        matrix = flat.T @ flat
        gradient = flat.T @ (fit.residual[touched] * root[:, None]).ravel()
        prior = np.tile(np.concatenate([np.zeros(n_x), np.square(self.prior)]), n)
        matrix[np.diag_indices_from(matrix)] += prior
        gradient += prior * np.hstack([C.T, P]).ravel()
        return matrix, gradient

    def propose(self, fit: _Fit) -> Hinges | None:
        """A hinge through a few neighbouring surprises of like direction, of those that are not explained."""
        left = -fit.residual[self.loud]
        size = np.linalg.norm(left, axis=1)
        missed = np.flatnonzero(size > 0.5 * self.size[self.loud])
        if not len(missed):
            return None
        left, size, index = left[missed], size[missed], self.loud[missed]
        first = self.rng.choice(len(index), p=self.near[index] / self.near[index].sum())
        direction = left[first] / size[first]
        like = np.flatnonzero(left @ direction > _LIKE * size)
        apart = np.square((self.z[index[like]] - self.z[index[first]]) / self.spread).sum(axis=1)
        like = like[np.argsort(apart)[: self.rng.integers(*_NEIGHBOURS)]]
        z, amount = self.z[index[like]], left[like] @ direction
        weighted = z * (self.near[index[like]] / self.variance[index[like]])[:, None]
        ridge = np.square(self.prior) + 1e-12
        row = -np.linalg.solve(weighted.T @ z + np.diag(ridge), weighted.T @ amount)
        return Hinges(direction[:, None], row[None])

    def without(self, fit: _Fit, k: int, iterations: int) -> _Fit:
        """The best fit of the others than hinge k."""
        fits = (self.evaluate(fit.hinges.without(k)), self.evaluate(fit.hinges.absorbed(k)))
        return min((self.descend(one, iterations) for one in fits), key=lambda one: one.cost)

    def is_worth_it(self, fit: _Fit, k: int, worth: float = _WORTH) -> bool:
        """Whether hinge k opens the gap it acts in, and explains surprises near enough that the others do not.

        :param worth: as many of them, at least
        """
        C, P = fit.hinges
        touched = self.loud[fit.forces[self.loud, k] > 0.0]
        nearest = self.near[touched].max(initial=0.0)
        if nearest < _LEAST_NEAR or P[k, : len(C)] @ (self.unit * C[:, k]) <= 0.0:
            return False
        rest = self.without(fit, k, _SHORT)
        gain = np.maximum(np.log1p(rest.excess) - np.log1p(fit.excess), 0.0)[touched].sum()
        return bool(gain > worth * np.log1p(_SHARE**-2.0) / 2.0 and rest.cost > fit.cost)


def find_hinges(surprises: Surprises, most: int, start: Hinges) -> Hinges:
    """The hinges that explain surprises best.

    :param most: number of hinges at most
    :param start: those of the last fit, at most as many: tried first, and kept with less evidence than new ones need,
        since a controller that knows a wall stays away from it
    """
    found = []
    for hinges in (start.normalised(), Hinges.none(len(start.C), start.P.shape[1])):
        begin = _pruned(surprises, surprises.descend(surprises.evaluate(hinges), _LONG))
        found.append(_pruned(surprises, _grown(surprises, begin, most)))
    return _kept(surprises, min(found, key=lambda fit: fit.cost), start.normalised(), most).hinges


def _kept(surprises: Surprises, fit: _Fit, before: Hinges, most: int) -> _Fit:
    """With those from before that still explain something."""
    for C, P in zip(before.C.T, before.P, strict=True):
        if fit.hinges.n == most:
            break
        trial = surprises.descend(surprises.evaluate(fit.hinges.plus(C[:, None], P[None])), _LONG)
        if trial.cost < fit.cost and surprises.is_worth_it(trial, trial.hinges.n - 1, _WORTH_KEEPING):
            fit = trial
    return fit


def _grown(surprises: Surprises, fit: _Fit, most: int) -> _Fit:
    while fit.hinges.n < most:
        best: _Fit | None = None
        for _ in range(_STARTS):
            hinge = surprises.propose(fit)
            if hinge is None:
                return fit
            trial = surprises.descend(surprises.evaluate(fit.hinges.plus(*hinge)), _SHORT)
            if best is None or trial.cost < best.cost:
                best = trial
        assert best is not None
        best = surprises.descend(best, _LONG)
        if not surprises.is_worth_it(best, best.hinges.n - 1):
            return fit
        fit = best
    return fit


def _pruned(surprises: Surprises, fit: _Fit) -> _Fit:
    k = 0
    while k < fit.hinges.n:
        if surprises.is_worth_it(fit, k):
            k += 1
        else:
            fit, k = surprises.without(fit, k, _LONG), 0
    return fit
