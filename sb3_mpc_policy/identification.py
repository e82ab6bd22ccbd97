"""Identification: the linear complementarity system, eq (5), that explains given transitions best, eq (12).

    minimise   mean_i w_i |(s'_i − f(s_i, a_i) − features_i · beta) / deviation|²

The problem has many local minima, in which some contacts lie where none is needed and others are missing. Each is
reached quickly (:mod:`sb3_mpc_policy.descent`), so the search is global, by *basin hopping* (Wales and Doye 1997):

* a start is a set of gap rows, each the best of a few random hinges for what those before it leave unexplained, as in
  matching pursuit; of a few short descents the best is finished;
* then, as long as it helps, the contact that explains least is taken out, a hinge that explains much of what is left
  takes its place, and the descent is repeated;
* the search ends when what is left looks like noise: errors of neighbouring data have nothing to do with each other
  (the *delta test*, Pi and Peterson 1994) and are distributed as noise is; or when two searches end in one minimum;
* it runs on part of the data, in which those that a linear model does not explain are drawn more often, because
  contacts are rare; the best model is polished on all of them;
* a contact may be swapped for its mirror image, gap for force, without any change in what the model predicts. Of
  these, the one that is open in most of the data is chosen, so that A, B and d are the free motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from sb3_mpc_policy.descent import MOST_CONTACTS, Contacts, Data, Fit, descend, evaluate, pivoted
from sb3_mpc_policy.lcp import LcpSolver
from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.prediction import step_deviation

__all__ = ["Identified", "identify", "select_n_contacts"]

_SHORT, _LONG, _POLISH = 15, 45, 100  # iterations of a descent
_POLISHED = 1e-9  # relative decrease at which the last one ends
_LITTLE_SEARCH = 10  # descents
_POOL = 3  # short descents of which the best is finished
_FEW_HINGES, _MANY_HINGES = 10, 200  # that compete for a place in a start, in a repair
_LEAST_SHARE, _LARGEST_SHARE = 5e-3, 0.9  # of the data that such a hinge touches
_LEAST_PART, _DATA_PER_PARAMETER = 600, 25  # of the data that the search works on
_MOST_PAIRS = 5000  # of neighbours, in which noise is looked for
_DEVIATIONS = 2.0  # within which correlation is chance
_NORMAL = 1.1  # how much more than their median tells the residuals of a good fit may be
_TINY = float(np.finfo(float).tiny)
_EXPLAINED = 1e-12  # share of the variance that counts as nothing
_SAME_MINIMUM = 1.01
_MEDIAN_OF_SQUARE = 0.4549  # of a standard normal variable


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
    part = _informative_part(units.data, int(n_contacts), generator)
    search = _Search(part, int(n_contacts), generator)
    found = search.run(guesses, int(n_starts))
    noise = _Noise(units.data, generator)
    fit = _polished(units.data, found)
    left = int(n_starts) - search.descents
    if part is not units.data and left > 0 and not noise.is_all_of(fit):
        # all data show what a part of them hid
        again = _Search(units.data, int(n_contacts), generator, noise)
        fit = _polished(units.data, again.run([fit.contacts], left))
        search.descents += again.descents
    return units.identified(fit, search.descents, noise)


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

    def identified(self, fit: Fit, n_starts: int, noise: _Noise) -> Identified:
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
        variance = max(fit.cost, _EXPLAINED * n_x)
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


# -- the search --


def _polished(data: Data, found: Fit) -> Fit:
    """A fit to all data, of the equivalent models the one whose contacts are mostly open."""
    fit = evaluate(data, found.contacts)
    opened = evaluate(data, pivoted(fit.contacts, fit.active.mean(axis=0) > 0.5))
    if opened.objective < _SAME_MINIMUM * fit.objective:  # else its F is not among those allowed
        fit = opened
    return descend(data, fit, _POLISH, _POLISHED)


class _Search:
    """Basin hopping for n contacts on given data."""

    def __init__(self, data: Data, n: int, rng: np.random.Generator, noise: _Noise | None = None) -> None:
        self.data, self.n, self.rng = data, n, rng
        self.noise = noise or _Noise(data, rng)
        self.descents = 0

    def run(self, guesses: Sequence[Contacts], most: int) -> Fit:
        """The best of rounds of basin hopping with ``most`` descents altogether."""
        best: Fit | None = None
        while True:
            found = self._round(guesses, most)
            twice = best is not None and found.cost < _SAME_MINIMUM * best.cost < _SAME_MINIMUM**2 * found.cost
            if best is None or found.objective < best.objective:
                best = found
            if twice or self.descents >= most or self._at_floor(best):
                return best
            guesses = ()

    def _round(self, guesses: Sequence[Contacts], most: int) -> Fit:
        pool = [self._descend(self._filled(guess), _SHORT) for guess in guesses[:most]]
        while len(pool) < _POOL and not any(map(self._at_floor, pool)) and (self.descents < most or not pool):
            pool.append(self._descend(self._filled(None), _SHORT))
        fit = descend(self.data, min(pool, key=lambda fit: fit.objective), _LONG)
        failures = 0
        while self.descents < most and failures < max(4, self.n) and not self._at_floor(fit):
            hopped = self._descend(self._repaired(fit), _SHORT + _LONG)
            failures = 0 if hopped.objective < 0.99 * fit.objective else failures + 1
            fit = min(fit, hopped, key=lambda fit: fit.objective)
        return fit

    def _descend(self, contacts: Contacts, iterations: int) -> Fit:
        self.descents += 1
        return descend(self.data, evaluate(self.data, contacts), iterations)

    def _at_floor(self, fit: Fit) -> bool:
        return self.n == 0 or self.noise.is_all_of(fit)

    def _filled(self, guess: Contacts | None) -> Contacts:
        """A guess, with contacts added one by one until there are n."""
        p = self.data.z.shape[1]
        contacts = guess or Contacts(np.zeros((0, p)), np.zeros((0, 0)), np.zeros((0, 0)))
        while len(contacts.P) < self.n:
            hinge = self._hinge(evaluate(self.data, contacts), _FEW_HINGES)
            contacts = _with_row(contacts, hinge)
        return contacts

    def _repaired(self, fit: Fit) -> Contacts:
        """Take a contact out, one that explains little, and let a hinge that explains much take its place."""
        losses = [evaluate(self.data, fit.contacts.without(row)).objective for row in range(self.n)]
        rank = min(int(self.rng.exponential(1.5)), self.n - 1)
        rest = fit.contacts.without(int(np.argsort(losses)[rank]))
        return _with_row(rest, self._hinge(evaluate(self.data, rest), _MANY_HINGES))

    def _hinge(self, fit: Fit, candidates: int) -> np.ndarray:
        """(p,) the gap row, of random ones, whose force explains most of what a fit leaves."""
        z, weights = self.data.z, self.data.weights
        rows = self.rng.normal(size=(candidates, z.shape[1]))
        rows[:, :-1] /= np.maximum(np.linalg.norm(rows[:, :-1], axis=1, keepdims=True), 1e-12)
        along = z[:, :-1] @ rows[:, :-1].T
        share = np.exp(self.rng.uniform(np.log(_LEAST_SHARE), np.log(_LARGEST_SHARE), candidates))
        last = np.minimum((share * len(z)).astype(int), len(z) - 1)
        rows[:, -1] = -np.sort(along, axis=0)[last, np.arange(candidates)]
        forces = np.maximum(-(along + rows[:, -1]), 0.0)
        known = np.hstack([self.data.smooth, fit.forces])
        weighted = known * weights[:, None]
        gram = weighted.T @ known
        gram += 1e-9 * np.diag(np.diag(gram) + 1.0)
        forces = forces - known @ np.linalg.solve(gram, weighted.T @ forces)
        weighted = forces * weights[:, None]
        gain = np.square(weighted.T @ fit.residual).sum(axis=1) / ((weighted * forces).sum(axis=0) + 1e-12)
        return rows[np.argmax(gain)]


def _with_row(contacts: Contacts, row: np.ndarray) -> Contacts:
    """One contact more, of the others' size, that does not act on them."""
    P, G, S = contacts
    n = len(P)
    size = np.median(np.linalg.norm(P[:, :-1], axis=1)) if n else 1.0
    G, S = np.pad(G, (0, 1)), np.pad(S, (0, 1))
    G[n, n] = 1.0
    return Contacts(np.vstack([P, size * row]), G, S)


def _informative_part(data: Data, n_contacts: int, rng: np.random.Generator) -> Data:
    """As much of the data as the search needs. What no contact explains is drawn more often, and counts less."""
    n, p, k, n_x = len(data), data.z.shape[1], data.smooth.shape[1], data.y.shape[1]
    n_parameters = n_x * (k + n_contacts) + n_contacts * (p + 2 * n_contacts)
    enough = max(_LEAST_PART, -(-_DATA_PER_PARAMETER * n_parameters // n_x))
    if enough >= n:
        return data
    free = evaluate(data, Contacts(np.zeros((0, p)), np.zeros((0, 0)), np.zeros((0, 0))))
    surprise = np.sqrt(np.square(free.residual).sum(axis=1) * data.weights)
    chance = 1.0 / n + surprise / max(surprise.sum(), _TINY)
    chance /= chance.sum()
    index = rng.choice(n, enough, replace=False, p=chance)
    return data.part(index, data.weights[index] / chance[index])


# -- the noise --


class _Noise:
    """Tells noise from what a model could still explain.

    Noise at one point says nothing about noise at the next, whereas a missing contact shifts all data around it. That
    is blind to contacts which hardly any data touch; those leave residuals that are too large for their median.
    """

    def __init__(self, data: Data, rng: np.random.Generator) -> None:
        index = rng.permutation(np.flatnonzero(data.weights > 0.0))[:_MOST_PAIRS]
        index = index[np.unique(data.z[index], axis=0, return_index=True)[1]]
        self.first = self.second = index
        if len(index) > 1:
            self.second = index[cKDTree(data.z[index]).query(data.z[index], k=2)[1][:, 1]]
        self.weights = data.weights[index] / data.weights[index].sum()
        self.n_pairs = 1.0 / np.square(self.weights).sum()  # as many as count alike

    def _correlation(self, fit: Fit) -> float:
        """Between the residuals of neighbours, 0 to 1."""
        first, second = fit.residual[self.first], fit.residual[self.second]
        together = self.weights @ (first * second).sum(axis=1)
        return float(np.clip(together / max(self.weights @ np.square(first).sum(axis=1), _TINY), 0.0, 1.0))

    def _from_median(self, fit: Fit) -> float:
        """The cost, were the residuals normally distributed."""
        return float(np.median(np.square(fit.residual[self.first]), axis=0).sum() / _MEDIAN_OF_SQUARE)

    def floor(self, fit: Fit) -> float:
        """The cost that noise alone would leave."""
        return min(fit.cost * (1.0 - self._correlation(fit)), self._from_median(fit))

    def is_all_of(self, fit: Fit) -> bool:
        """Whether the residuals look like nothing but noise."""
        n_x = fit.residual.shape[1]
        if fit.cost <= _EXPLAINED * n_x:
            return True
        uncertain = _DEVIATIONS / np.sqrt(self.n_pairs * n_x)
        return self._correlation(fit) < uncertain and fit.cost < (_NORMAL + uncertain) * self._from_median(fit)
