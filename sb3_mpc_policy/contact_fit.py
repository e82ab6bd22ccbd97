"""Fitting the contacts C, D, E, F and c directly between rollouts: hinges through what the tangent fit leaves.

Contact shows in one transition of a hundred, and there the error of a smooth model is a hundred times larger. The
curvature terms of :mod:`sb3_mpc_policy.model_fit` take up what is smooth, so that what remains is contact, and
:mod:`sb3_mpc_policy.hinges` finds the walls in it. Two things keep far away data from spoiling them, where neither
the gap nor the force is linear any more, and where a pole that leans on a wall may stay for half an episode:

* transitions count by how nearly linear the smooth dynamics is around them, which the size of the curvature terms
  tells. Distance alone does not: a blow turns a pole fast, and it is no less linear for that;
* what the curvature terms do not take up is noise, and is measured: it grows with the curvature.

Contacts without evidence do nothing: ``C = 0``. As long as the smooth model has hardly more data than coefficients its
surprises are none, and no contact is looked for.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import median_filter

from sb3_mpc_policy.hinges import Hinges, Surprises, find_hinges
from sb3_mpc_policy.lcs import KAPPA, LinearComplementaritySystem
from sb3_mpc_policy.model_fit import median_deviation, smooth_fit
from sb3_mpc_policy.transitions import Transitions

__all__ = ["fit_contacts"]

_BENT = 0.02  # curvature terms of this size, in typical steps, make a transition count a quarter
_LEAST_NOISE = 0.02  # in typical steps
_MEDIANS = 2.0  # noise, in medians of what is left of transitions like this one
_PER_TERM = 4  # transitions, for each term of the smooth model, from which on it can be surprised
_LEAST_WINDOW, _WINDOWS = 31, 20  # transitions that are alike: a twentieth of all, at least so many


@torch.no_grad()
def fit_contacts(
    lcs: LinearComplementaritySystem,
    data: Transitions,
    target: np.ndarray,
    prior: LinearComplementaritySystem | None = None,
) -> int:
    """Fit C, D, E, F and c of eq (5) where the controller works.

    :param lcs: changed in place
    :param data: N >= 1 transitions
    :param target: (n_x,) the state the controller tries to reach, environment units
    :param prior: model whose contacts are kept where no transition has touched them, without what couples them in F
    :return: number of contacts in use
    """
    smooth = smooth_fit(lcs, data, target, prior, with_contacts=False)
    x, u = data.s / lcs.state_scale.cpu().numpy(), data.a / lcs.action_scale.cpu().numpy()
    step = (data.s_next - data.s) / lcs.state_scale.cpu().numpy()
    unit = median_deviation(step)
    z = np.hstack([x, u, np.ones((len(x), 1))])
    bent = np.linalg.norm(smooth.curvature / unit, axis=1)
    near = (1.0 + np.square(bent / _BENT)) ** -2
    noise = np.maximum(_noise(bent, np.linalg.norm(smooth.surprise / unit, axis=1)), _LEAST_NOISE)
    drift = np.concatenate([np.sqrt(near @ np.square(step) / near.sum()), u.std(axis=0), [0.0]])
    untested = _untested(lcs, data, prior)
    rng = np.random.default_rng(len(data.s))  # not the global one, which the training has
    surprises = Surprises(z, smooth.surprise / unit, near, noise, drift, unit, rng)
    start, most = _hinges(lcs, unit), lcs.n_contacts - untested.n
    none = Hinges.none(lcs.n_states, z.shape[1])
    enough = len(x) >= _PER_TERM * len(smooth.theta)
    found = find_hinges(surprises, most, start if start.n <= most else none) if enough else none
    _assign(lcs, untested.plus(found.C * unit[:, None], found.P))
    return untested.n + found.n


def _noise(bent: np.ndarray, surprise: np.ndarray) -> np.ndarray:
    """(N,) what the smooth part leaves of transitions without contact that are like each of these.

    It grows with the curvature. Where contact is so frequent that the median does not see past it, what holds for
    transitions of more curvature holds there too.
    """
    order, window = np.argsort(bent), max(_LEAST_WINDOW, len(bent) // _WINDOWS)
    local, half = median_filter(surprise[order], window, mode="nearest"), window // 2
    if len(order) > 2 * half:  # at the ends the window stays inside: no transition counts twice
        local[:half], local[-half:] = local[half], local[-half - 1]
    noise = np.empty(len(order))
    noise[order] = _MEDIANS * np.minimum.accumulate(local[::-1])[::-1]
    return noise


def _untested(lcs: LinearComplementaritySystem, data: Transitions, prior: LinearComplementaritySystem | None) -> Hinges:
    """The contacts of the prior that no transition has touched, scaled coordinates."""
    if prior is None:
        return Hinges.none(lcs.n_states, lcs.n_states + lcs.n_actions + 1)
    known = _hinges(prior, np.ones(lcs.n_states))
    forces = prior.contact_force(data.s, data.a).cpu().numpy()[:, _acting(prior)]
    idle = np.flatnonzero(~(forces > 0.0).any(axis=0))
    return Hinges(known.C[:, idle], known.P[idle])


def _acting(lcs: LinearComplementaritySystem) -> np.ndarray:
    """(n_lambda,) bool: the contacts that do something, and whose gap something moves."""
    C, D, E = (part.detach().cpu().numpy() for part in (lcs.C_scaled, lcs.D_scaled, lcs.E_scaled))
    return np.logical_and(C.any(axis=0), np.hstack([D, E]).any(axis=1))


def _hinges(lcs: LinearComplementaritySystem, unit: np.ndarray) -> Hinges:
    """The contacts of a model that act, each as if it were alone."""
    _, _, C, _, D, E, F, c = (part.detach().cpu().numpy() for part in lcs.scaled())
    rows = np.hstack([D, E, c[:, None]]) / np.diag(F)[:, None]
    acting = _acting(lcs)
    return Hinges(C[:, acting] / unit[:, None], rows[acting])


def _assign(lcs: LinearComplementaritySystem, hinges: Hinges) -> None:
    """Gaps in scaled coordinates whose slope is one; contacts that are not needed are open everywhere and push none."""
    n, n_x = hinges.n, lcs.n_states
    size = np.linalg.norm(hinges.P[:, :-1], axis=1)
    C, P = np.zeros((n_x, lcs.n_contacts)), np.zeros((lcs.n_contacts, hinges.P.shape[1]))
    C[:, :n], P[:n] = hinges.C * size, hinges.P / size[:, None]
    P[n:, -1] = 1.0
    identity = np.eye(lcs.n_contacts)
    for parameter, value in (
        (lcs.C_scaled, C),
        (lcs.D_scaled, P[:, :n_x]),
        (lcs.E_scaled, P[:, n_x:-1]),
        (lcs.c_scaled, P[:, -1]),
        (lcs.F_factor, np.sqrt(1.0 - KAPPA) * identity),
        (lcs.F_skew, 0.0 * identity),
        (lcs.force_scale, np.ones(lcs.n_contacts)),
        (lcs.gap_scale, np.ones(lcs.n_contacts)),
    ):
        parameter.copy_(torch.as_tensor(value))
