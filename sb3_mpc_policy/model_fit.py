"""Fitting the smooth part of the model directly between rollouts, beside the gradient of eq (16).

The controller works in a small region around its target, the first data come from falls far outside it, and a linear
model fitted to all of them predicts well and controls badly: the pendulum's curvature and the walls' blows end up in
A and B. So the fit looks for the *tangent* at the target, by robust local polynomial regression:

* each transition counts by its distance from the target, exp(−½ |(s − target) / (w scale)|²), w = 2;
* quadratic and cubic terms in (s, a) take part in the regression and are dropped from the result: curvature goes to
  them and not to A and B. A ridge gives them the prior of being small in scaled coordinates;
* what the contacts of the current model explain is taken off first; transitions that still do not fit, unmodelled
  contacts above all, are outliers: Cauchy weights, iteratively reweighted;
* outliers may be the majority, of a pole that leans on a wall for an episode, and fit one another. The reweighting
  therefore starts close to the target, w = 1/2, and widens: what fits there is what the tangent is.

The contacts C, D, E, F and c are fitted to what this leaves (contact_fit.py), or left to the gradient of eq (16).
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from math import comb
from typing import NamedTuple

import numpy as np
import torch

from sb3_mpc_policy.lcs import LinearComplementaritySystem
from sb3_mpc_policy.transitions import Transitions

__all__ = ["MODEL_FITS", "fit_tangent"]

# "contacts" fits the whole model, "least_squares" A, B and d; "gradient" is the paper's Algorithm 1: nothing but
# eq (16) changes the model.
MODEL_FITS = ("contacts", "least_squares", "gradient")

_WIDTHS = (0.5, 0.7, 1.0, 1.4, 2.0)  # of the region, in state scales, one after the other
_DEGREES = (2, 3)  # of the terms that take up curvature ...
_MOST_TERMS = 300  # ... left out where there would be more of them than this
_LINEAR_RIDGE = 1e-6
_CURVATURE_RIDGE = 1e-3
_ENOUGH = 4000  # transitions that the regression takes, at random, of more
_REWEIGHTINGS, _BEFORE = 30, 4  # with the last width, and with each of those before
_SETTLED = 1e-5  # relative change of the coefficients at which reweighting ends
_INLIERS = 0.4  # share of the data that is taken for undisturbed
_LEAST_RESIDUAL = 1e-3  # whitened: no data are trusted beyond this


@torch.no_grad()
def fit_tangent(
    lcs: LinearComplementaritySystem,
    data: Transitions,
    target: np.ndarray,
    prior: LinearComplementaritySystem | None = None,
) -> float:
    """Fit A, B and d of eq (5a) where the controller works, beside the contact forces of the current C, D, E, F and c.

    :param lcs: changed in place
    :param data: N >= 1 transitions
    :param target: (n_x,) the state the controller tries to reach, environment units
    :param prior: model to keep to where the data say nothing; ``s' = s`` where None
    :return: scale of the whitened residuals of the transitions that are not outliers
    """
    smooth = smooth_fit(lcs, data, target, prior)
    n_x, n_a = lcs.n_states, lcs.n_actions
    slope, offset = smooth.theta[:n_x].T, smooth.theta[n_x + n_a]
    expected_A, expected_B, expected_d = _expected(lcs, prior)
    for parameter, value in (
        (lcs.A_scaled, expected_A + slope),
        (lcs.B_scaled, expected_B + smooth.theta[n_x : n_x + n_a].T),
        (lcs.d_scaled, expected_d + offset - slope @ smooth.centre),
    ):
        parameter.copy_(torch.as_tensor(value))
    return smooth.noise


class SmoothFit(NamedTuple):
    """What the smooth part of a model makes of transitions, scaled coordinates."""

    theta: np.ndarray
    """(n_features, n_x) coefficients of (s, a, 1, curvature), the state counted from ``centre``"""
    centre: np.ndarray
    """(n_x,) where the tangent is taken"""
    surprise: np.ndarray
    """(N, n_x) next state minus the smooth part's: contact, and what no model explains"""
    curvature: np.ndarray
    """(N, n_x) what the quadratic and cubic terms add to the next state"""
    noise: float
    """size of what is left of transitions that are not outliers, in units of ``deviation``"""


@torch.no_grad()
def smooth_fit(
    lcs: LinearComplementaritySystem,
    data: Transitions,
    target: np.ndarray,
    prior: LinearComplementaritySystem | None = None,
    with_contacts: bool = True,
) -> SmoothFit:
    """The regression behind :func:`fit_tangent`, which has the arguments.

    :param with_contacts: False to leave contact to what the regression does not explain
    """
    scale, action_scale = lcs.state_scale.cpu().numpy(), lcs.action_scale.cpu().numpy()
    # a target that a learned reward puts far outside the data would leave no data to fit
    centre = np.clip(target, *np.quantile(data.s, [0.05, 0.95], axis=0)) / scale
    x, u = data.s / scale, data.a / action_scale
    expected_A, expected_B, expected_d = _expected(lcs, prior)
    push = np.zeros_like(x)
    if with_contacts:
        push = (lcs.contact_force(data.s, data.a) / lcs.force_scale @ lcs.scaled().C.mT).cpu().numpy()
    unexpected = data.s_next / scale - push - (x @ expected_A.T + u @ expected_B.T + expected_d)
    theta, residual, curvature, noise = _robust_regression(x - centre, u, unexpected)
    return SmoothFit(theta, centre, residual + push, curvature, noise)


def _expected(
    lcs: LinearComplementaritySystem, prior: LinearComplementaritySystem | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and d of the prior, scaled coordinates."""
    if prior is None:
        return np.eye(lcs.n_states), np.zeros((lcs.n_states, lcs.n_actions)), np.zeros(lcs.n_states)
    known = prior.scaled()
    A, B, d = (part.detach().cpu().numpy() for part in (known.A, known.B, known.d))
    return A, B, d


def _robust_regression(x: np.ndarray, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Coefficients (n_features, n_x) of y in (x, u, 1, curvature), residuals, what curvature adds, residuals' scale."""
    z = np.hstack([x, u])
    n, n_z = z.shape
    everything = np.hstack([z, np.ones((n, 1)), *_curvature(z)])
    ridge = np.full(everything.shape[1], _CURVATURE_RIDGE)
    ridge[: n_z + 1] = _LINEAR_RIDGE
    deviation = median_deviation(y)
    some = np.arange(n) if n <= _ENOUGH else np.random.default_rng(n).choice(n, _ENOUGH, replace=False)
    features, whitened = everything[some], y[some] / deviation
    distance = np.square(x[some]).sum(axis=1)
    trust, theta = np.ones(len(some)), np.zeros((features.shape[1], y.shape[1]))
    for width in _WIDTHS:
        near = np.exp(-0.5 * (distance - distance.min()) / width**2)
        for _ in range(_REWEIGHTINGS if width == _WIDTHS[-1] else _BEFORE):
            last = theta
            weighted = features * (near * trust)[:, None]
            gram = weighted.T @ features + np.diag(ridge)
            theta = np.linalg.solve(gram, weighted.T @ whitened)
            # a transition that decides the fit alone has no residual: undo its leverage
            leverage = (features * np.linalg.solve(gram, weighted.T).T).sum(axis=1)
            error = np.linalg.norm(whitened - features @ theta, axis=1) / np.sqrt(np.maximum(1.0 - leverage, 1e-3))
            size = max(1.5 * _quantile(error, near, _INLIERS), _LEAST_RESIDUAL)
            if np.abs(theta - last).max() < _SETTLED * np.abs(theta).max():
                break
            trust = 1.0 / (1.0 + np.square(error / size))
    theta = theta * deviation
    return theta, y - everything @ theta, everything[:, n_z + 1 :] @ theta[n_z + 1 :], size


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """The value that so large a share of the weight is at or below."""
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, share * below[-1])])


def _curvature(z: np.ndarray) -> list[np.ndarray]:
    """The monomials of each degree in the columns of z, as long as there are not too many of them."""
    n_z, terms = z.shape[1], []
    for degree in _DEGREES:
        if comb(n_z + degree - 1, degree) <= _MOST_TERMS:
            chosen = combinations_with_replacement(range(n_z), degree)
            terms.append(np.stack([z[:, index].prod(axis=1) for index in map(list, chosen)], axis=1))
    return terms


def median_deviation(y: np.ndarray) -> np.ndarray:
    """(n_x,) robust standard deviation; falls back to the ordinary one, then to one, for constant components."""
    robust = 1.4826 * np.median(np.abs(y - np.median(y, axis=0)), axis=0)
    ordinary = y.std(axis=0)
    deviation = np.where(robust > 1e-3 * ordinary, robust, ordinary)
    return np.where(deviation > 1e-12, deviation, 1.0)
