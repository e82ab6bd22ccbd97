"""Identification: the linear complementarity system, eq (5), that explains given transitions best, eq (12).

    minimise   mean_i w_i |(s'_i − f(s_i, a_i) − features_i · beta) / deviation|²

The problem has many local minima. :mod:`sb3_mpc_policy.descent` reaches each quickly, and
:mod:`sb3_mpc_policy.basin_hopping` goes from one to the next until what is left looks like noise. Here the data are
brought into units in which that works, and the result back into the caller's.

A contact may be swapped for its mirror image, gap for force, without any change in what the model predicts. Of these
the one that is open in most of the data is chosen, so that A, B and d are the free motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_mpc_policy.basin_hopping import EXPLAINED, Noise, Search, informative_part, polished
from sb3_mpc_policy.descent import MOST_CONTACTS, Contacts, Data, Fit
from sb3_mpc_policy.lcp import LcpSolver
from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.prediction import step_deviation

__all__ = ["Identified", "identify", "select_n_contacts"]

_LITTLE_SEARCH = 10  # descents


class Identified(NamedTuple):
    """What :func:`identify` found, in the coordinates of its arguments.

    ``matrices`` has a unit diagonal in F, whose symmetric part is positive definite, so that
    :meth:`LinearComplementaritySystem.from_matrices` accepts it. Forces have the unit of gaps.
    """

    matrices: LcsMatrices[np.ndarray]
    feature_coefficients: np.ndarray
    """(n_x, n_features)"""
    cost: float
    """weighted mean of the squared errors, each in units of ``deviation``, summed over components"""
    noise_floor: float
    """estimate of the cost that noise alone would leave; far below ``cost`` where the model is not the right one"""
    looks_like_noise: bool
    """whether nothing but noise seems to be left"""
    n_starts: int
    """descents made"""
    n_parameters: int
    """degrees of freedom of the model, features included; more than ``n_x`` times the data are not determined"""
    active_share: np.ndarray
    """(n_lambda,) share of the data in which each contact carries a force"""
    bic: float
    """Bayesian information criterion, for models of the same data: smaller is better"""

    @property
    def n_contacts(self) -> int:
        """n_lambda"""
        return len(self.matrices.c)

    @property
    def active(self) -> np.ndarray:
        """(n_lambda,) bool: which contacts carry a force in any of the data."""
        return self.active_share > 0.0

    def predict(self, s: np.ndarray, a: np.ndarray, features: np.ndarray | None = None) -> np.ndarray:
        """The next state (5a), with what the features add. s: (N, n_x), a: (N, n_a) -> (N, n_x)."""
        A, B, C, d, D, E, F, c = self.matrices
        lam, _ = LcpSolver(F)(s @ D.T + a @ E.T + c)
        extra = 0.0 if features is None else features @ self.feature_coefficients.T
        return s @ A.T + a @ B.T + lam @ C.T + d + extra


def identify(
    s: np.ndarray,
    a: np.ndarray,
    s_next: np.ndarray,
    n_contacts: int,
    *,
    features: np.ndarray | None = None,
    feature_ridge: float = 0.0,
    weights: np.ndarray | None = None,
    deviation: np.ndarray | None = None,
    start: Sequence[tuple[np.ndarray, np.ndarray]] = (),
    n_starts: int = 60,
    rng: np.random.Generator | int | None = None,
) -> Identified:
    """Fit an LCS to transitions. What the data do not determine keeps to ``s' = s`` and to contacts without effect.

    :param s: (N, n_x) states, N >= 1, in whichever coordinates the model shall have
    :param a: (N, n_a) actions
    :param s_next: (N, n_x) next states
    :param n_contacts: n_lambda, 0 to 62
    :param features: (N, n_features) terms that take part in the regression of the next state only, such as curvature
    :param feature_ridge: >= 0, penalty on the squared coefficients of the features, features and errors taken in units
        of their root mean square and of ``deviation``
    :param weights: (N,) >= 0, how much each transition counts; ones where None
    :param deviation: (n_x,) > 0, size of an error in each component; that of a step in the data where None
    :param start: guesses to try first: gap rows [D E c] (n, n_x + n_a + 1) and F (n, n), n <= n_contacts; missing
        contacts are added
    :param n_starts: >= 1, descents at most. Fewer are made where nothing is left to gain
    :param rng: random generator or seed
    :raise ValueError: for an argument of the wrong shape or with numbers that are not finite, naming it
    """
    if isinstance(n_starts, bool) or int(n_starts) != n_starts or n_starts < 1:
        raise ValueError(f"n_starts must be an integer >= 1, got {n_starts!r}")
    if isinstance(n_contacts, bool) or int(n_contacts) != n_contacts or not 0 <= n_contacts <= MOST_CONTACTS:
        raise ValueError(f"n_contacts must be an integer from 0 to {MOST_CONTACTS}, got {n_contacts!r}")
    units = _Units.of(s, a, s_next, features, feature_ridge, weights, deviation)
    guesses = [units.contacts(rows, F, int(n_contacts)) for rows, F in start]
    generator = np.random.default_rng(rng)
    part = informative_part(units.data, int(n_contacts), generator)
    search = Search(part, int(n_contacts), generator)
    fit = polished(units.data, search.run(guesses, int(n_starts)))
    made, noise = search.descents, Noise(units.data, generator)
    if part is not units.data and made < n_starts and not noise.is_all_of(fit):
        # all data may show what a part of them hid
        search = Search(units.data, int(n_contacts), generator, noise)
        fit = polished(units.data, search.run([fit.contacts], int(n_starts) - made))
        made += search.descents
    return units.identified(fit, made, noise)


def select_n_contacts(
    s: np.ndarray,
    a: np.ndarray,
    s_next: np.ndarray,
    max_contacts: int = 8,
    *,
    features: np.ndarray | None = None,
    feature_ridge: float = 0.0,
    weights: np.ndarray | None = None,
    deviation: np.ndarray | None = None,
    n_starts: int = 60,
    rng: np.random.Generator | int | None = None,
) -> Identified:
    """Fit an LCS with as many contacts as the data ask for: the least Bayesian information criterion.

    Contacts are added one by one with little search, each fit starting from the one before, until what is left looks
    like noise or two more contacts did not pay. Then they are taken out one by one, with all the search there is, as
    long as that pays.

    :param max_contacts: n_lambda at most, 0 to 62
    :return: the best, ``n_contacts`` of it; other arguments are those of :func:`identify`
    :raise ValueError: as :func:`identify` does
    """
    if isinstance(max_contacts, bool) or int(max_contacts) != max_contacts or not 0 <= max_contacts <= MOST_CONTACTS:
        raise ValueError(f"max_contacts must be an integer from 0 to {MOST_CONTACTS}, got {max_contacts!r}")
    generator = np.random.default_rng(rng)

    def fit(n_contacts: int, most: int, start: Identified | None = None) -> Identified:
        guess = [] if start is None else [(_gap_rows(start.matrices), start.matrices.F)]
        return identify(
            s, a, s_next, n_contacts,
            features=features, feature_ridge=feature_ridge, weights=weights, deviation=deviation,
            start=guess, n_starts=most, rng=generator,
        )  # fmt: skip

    best = last = fit(0, 1)
    while not last.looks_like_noise and last.n_contacts < min(max_contacts, best.n_contacts + 2):
        last = fit(last.n_contacts + 1, min(n_starts, _LITTLE_SEARCH), last)
        best = min(best, last, key=lambda found: found.bic)
    while best.n_contacts > 0:
        fewer = fit(best.n_contacts - 1, n_starts)
        if fewer.bic > best.bic:
            break
        best = fewer
    return best


def _gap_rows(matrices: LcsMatrices[np.ndarray]) -> np.ndarray:
    return np.hstack([matrices.D, matrices.E, matrices.c[:, None]])


class _Units(NamedTuple):
    """The caller's coordinates, and the data in those of the search: centred, and of order one."""

    data: Data
    mean: np.ndarray
    """(n_x + n_a,) of states and actions, and their size"""
    size: np.ndarray
    feature_size: np.ndarray
    deviation: np.ndarray
    n_x: int

    @classmethod
    def of(
        cls,
        s: np.ndarray,
        a: np.ndarray,
        s_next: np.ndarray,
        features: np.ndarray | None,
        feature_ridge: float,
        weights: np.ndarray | None,
        deviation: np.ndarray | None,
    ) -> _Units:
        s = _checked("s", s, (None, None))
        n, n_x = s.shape
        if n == 0:
            raise ValueError("s must have at least one row, got none")
        a = _checked("a", a, (n, None))
        s_next = _checked("s_next", s_next, (n, n_x))
        extra = np.zeros((n, 0)) if features is None else _checked("features", features, (n, None))
        weight = np.ones(n) if weights is None else _checked("weights", weights, (n,))
        if (weight < 0).any() or not weight.any():
            raise ValueError("weights must be non-negative and not all zero")
        if not np.isfinite(feature_ridge) or feature_ridge < 0:
            raise ValueError(f"feature_ridge must be finite and >= 0, got {feature_ridge!r}")
        unit = step_deviation(s, s_next) if deviation is None else _checked("deviation", deviation, (n_x,))
        if (unit <= 0).any():
            raise ValueError(f"deviation must be positive, got {unit}")
        weight = weight / weight.max()
        inputs = np.hstack([s, a])
        mean = weight @ inputs / weight.sum()
        size = _or_one(np.sqrt(weight @ np.square(inputs - mean) / weight.sum()), np.abs(mean))
        feature_size = _or_one(np.sqrt(weight @ np.square(extra) / weight.sum()), 0.0)
        z = np.hstack([(inputs - mean) / size, np.ones((n, 1))])
        ridge = np.concatenate([np.zeros(z.shape[1]), np.full(extra.shape[1], float(feature_ridge))])
        data = Data(z, (s_next - s) / unit, np.hstack([z, extra / feature_size]), weight, ridge)
        return cls(data, mean, size, feature_size, unit, n_x)

    def contacts(self, rows: np.ndarray, F: np.ndarray, most: int) -> Contacts:
        """A guess in the caller's coordinates, in those of the search, F brought to the nearest that is allowed."""
        rows = _checked("start's gap rows", rows, (None, len(self.mean) + 1))
        F = _checked("start's F", F, (len(rows), len(rows)))
        if len(rows) > most:
            raise ValueError(f"start must have at most n_contacts = {most} gap rows, got {len(rows)}")
        diagonal = np.diag(F)
        if (diagonal <= 0).any():
            raise ValueError(f"start's F must have a positive diagonal, got {diagonal}")
        P = np.hstack([rows[:, :-1] * self.size, rows[:, -1:] + rows[:, :-1] @ self.mean[:, None]])
        return Contacts.of(P, F)

    def identified(self, fit: Fit, n_starts: int, noise: Noise) -> Identified:
        """A fit in the caller's coordinates, forces and gaps scaled to a unit diagonal of F."""
        n_x, n_z, n = self.n_x, len(self.mean), len(fit.F)
        root = np.sqrt(np.diag(fit.F))
        smooth = self.deviation[:, None] * fit.W.T
        slope, rows = smooth[:, :n_z] / self.size, fit.contacts.P / root[:, None]
        directions = rows[:, :-1] / self.size
        F = fit.F / root / root[:, None]
        np.fill_diagonal(F, 1.0)
        matrices = LcsMatrices(
            A=np.eye(n_x) + slope[:, :n_x],
            B=slope[:, n_x:],
            C=self.deviation[:, None] * fit.C / root,
            d=smooth[:, n_z] - slope @ self.mean,
            D=directions[:, :n_x],
            E=directions[:, n_x:],
            F=F,
            c=rows[:, -1] - directions @ self.mean,
        )
        # each contact's force and gap have a scale of their own that changes nothing
        n_parameters = n_x * fit.W.shape[0] + n_x * n + n * (n_z + 1) + n * n - 2 * n
        weights = self.data.weights
        n_data = n_x / np.square(weights).sum()  # as many as count alike
        variance = max(fit.cost, EXPLAINED * n_x)
        return Identified(
            matrices,
            smooth[:, n_z + 1 :] / self.feature_size,
            fit.cost,
            noise.floor(fit),
            noise.is_all_of(fit),
            n_starts,
            n_parameters,
            fit.active.mean(axis=0),
            float(n_data * np.log(variance) + n_parameters * np.log(n_data)),
        )


def _checked(name: str, value: np.ndarray, shape: tuple[int | None, ...]) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} must have shape ({wanted}), got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite")
    return array


def _or_one(size: np.ndarray, magnitude: np.ndarray | float) -> np.ndarray:
    """Sizes, one for columns that are constant but for rounding."""
    return np.where(size > 1e-12 * (1.0 + magnitude), size, 1.0)
