"""The search for the contacts that explain data best: basin hopping (Wales and Doye 1997) over quick descents.

In a local minimum of eq (12) some contacts lie where none is needed and others are missing.

* A start is a set of gap rows, each the best of a few random hinges for what those before it leave unexplained, as in
  matching pursuit; of a few short descents the best is finished.
* Then, as long as it helps, a contact that explains little is taken out, a hinge that explains much of what is left
  takes its place, and the descent is repeated.
* The search ends when what is left looks like noise, or when two searches end in one minimum.
* It runs on part of the data, in which those that a linear model does not explain are drawn more often, because
  contacts are rare; the best model is polished on all of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from sb3_mpc_policy.descent import Contacts, Data, Fit, descend, evaluate, pivoted

__all__ = ["EXPLAINED", "Noise", "Search", "informative_part", "polished"]

_SHORT, _LONG, _POLISH = 15, 45, 100  # iterations of a descent
_POLISHED = 1e-9  # relative decrease at which the last one ends
_POOL = 3  # short descents of which the best is finished
_FEW_HINGES, _MANY_HINGES = 10, 200  # that compete for a place in a start, in a repair
_LEAST_SHARE, _LARGEST_SHARE = 5e-3, 0.9  # of the data that such a hinge touches
_LEAST_PART, _DATA_PER_PARAMETER = 600, 25  # of the data that the search works on
_MOST_PAIRS = 5000  # of neighbours, in which noise is looked for
_DEVIATIONS = 2.0  # within which correlation is chance
_NORMAL = 1.1  # how much more than their median tells the residuals of a good fit may be
_TINY = float(np.finfo(float).tiny)
EXPLAINED = 1e-12  # share of the variance that counts as nothing
_SAME_MINIMUM = 1.01
_MEDIAN_OF_SQUARE = 0.4549  # of a standard normal variable


def polished(data: Data, found: Fit) -> Fit:
    """A fit to all data, of the equivalent models the one whose contacts are mostly open."""
    fit = evaluate(data, found.contacts)
    opened = evaluate(data, pivoted(fit.contacts, fit.active.mean(axis=0) > 0.5))
    if opened.objective < _SAME_MINIMUM * fit.objective:  # else its F is not among those allowed
        fit = opened
    return descend(data, fit, _POLISH, _POLISHED)


class Search:
    """Basin hopping.

    :param data: to fit
    :param n: number of contacts
    :param noise: in these data, if it is known already
    """

    def __init__(self, data: Data, n: int, rng: np.random.Generator, noise: Noise | None = None) -> None:
        self.data, self.n, self.rng = data, n, rng
        self.noise = noise or Noise(data, rng)
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


def informative_part(data: Data, n_contacts: int, rng: np.random.Generator) -> Data:
    """As much of the data as the search needs. What no contact explains is drawn more often, and counts less."""
    p, k, n_x = data.z.shape[1], data.smooth.shape[1], data.y.shape[1]
    counting = data.weights > 0.0
    n_parameters = n_x * (k + n_contacts) + n_contacts * (p + 2 * n_contacts)
    enough = max(_LEAST_PART, -(-_DATA_PER_PARAMETER * n_parameters // n_x))
    if enough >= counting.sum():
        return data
    free = evaluate(data, Contacts(np.zeros((0, p)), np.zeros((0, 0)), np.zeros((0, 0))))
    surprise = np.sqrt(np.square(free.residual).sum(axis=1) * data.weights)
    chance = counting / counting.sum() + surprise / max(surprise.sum(), _TINY)
    chance /= chance.sum()
    index = rng.choice(len(data), enough, replace=False, p=chance)
    return data.part(index, data.weights[index] / chance[index])


class Noise:
    """Tells noise from what a model could still explain.

    Noise at one point says nothing about noise at the next, whereas a missing contact shifts all data around it (the
    *delta test*, Pi and Peterson 1994). That is blind to contacts which hardly any data touch; those leave residuals
    that are too large for their median.
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
        if fit.cost <= EXPLAINED * n_x:
            return True
        uncertain = _DEVIATIONS / np.sqrt(self.n_pairs * n_x)
        return self._correlation(fit) < uncertain and fit.cost < (_NORMAL + uncertain) * self._from_median(fit)
