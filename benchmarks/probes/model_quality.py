"""How good a learned model is: what it predicts, and how its matrices compare with the true ones.

*Predictions*, of the learned and of the true LCS: root mean square error after 1 and after 10 steps, in free motion and
in contact (at least one of the steps touches), each component in units of the standard deviation of what it changes by
in that time and motion; 1 is what the mean change would do. The data are episodes of their own, of LQR with noise.
Where a link leans by more than 0.3 rad, the true LCS, linearised about upright, is no reference, and is not asked.

*Matrices*: the error of the learned one relative to the true one (Frobenius norms), state scaled as in the tuned
settings. A and B are compared by what they do in one step, so A without the identity; d, zero in truth, is relative to
B, a full action. Contacts have no order, and forces and gaps no unit, so that of each true contact are compared:

* ``D``, ``E``, ``c``: of the gap ``D s + E a + c`` divided by the norm of D. D and E are then relative to a unit
  vector, c, the distance, to the true one;
* ``effect``: ``C_k D_k / F_kk``, what the closed contact does to the next state for each unit of the state.

Its counterpart is the learned contact whose ``C_k (D_k, E_k, c_k) / F_kk`` is nearest, if that is nearer than zero is;
each serves once. A contact without one has an effect's error of 1 and no other, and a learned contact that moves
something and is nobody's counterpart is counted as spurious.
"""

from __future__ import annotations

import contextlib
import functools
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.probes import ProbeLine
from benchmarks.probes.common import learned_policy, state_scale
from benchmarks.references import contact_env, lqr
from contact_envs.plants import AcrobotParameters
from sb3_mpc_policy import LinearComplementaritySystem
from sb3_mpc_policy.lcs import LcsMatrices

__all__ = ["Windows", "matrix_lines", "prediction_lines", "probe", "windows"]

TEST_SEEDS = range(2_000_000, 2_000_100)
FEW_SEEDS = TEST_SEEDS[:20]
STEPS = (1, 10)
_NOISE = 0.3  # standard deviation of LQR's actions
_EPISODE_STEPS = 100
_UPRIGHT = 0.3  # rad


class Windows(NamedTuple):
    """Stretches of ``n`` steps out of test episodes."""

    s: np.ndarray
    """(N, n_x) where they begin"""
    a: np.ndarray
    """(N, n, n_a)"""
    s_end: np.ndarray
    """(N, n_x)"""

    def error(self, model: LinearComplementaritySystem) -> float:
        """Root mean square error of a model's predictions."""
        s = torch.as_tensor(self.s)
        with torch.no_grad():
            for i in range(self.a.shape[1]):
                s = model.step(s, self.a[:, i])
        deviation = (self.s_end - self.s).std(axis=0)
        return float(np.sqrt(np.square((s.cpu().numpy() - self.s_end) / deviation).mean()))


class _Episode(NamedTuple):
    s: np.ndarray
    """(T+1, n_x)"""
    a: np.ndarray
    """(T, n_a)"""
    touches: np.ndarray
    """(T,)"""


# -- test data --


@functools.cache  # they are the same for every model
def windows(env_id: str, few: bool = False) -> dict[tuple[str, int], Windows]:
    """The test data by motion ("free" or "contact") and number of steps; without those of which there is none.

    :param env_id: an environment of ``contact_envs``
    :param few: a fifth of the episodes
    """
    with contact_env(env_id) as env:
        is_acrobot = isinstance(env.parameters, AcrobotParameters)
    episodes = _episodes(env_id, FEW_SEEDS if few else TEST_SEEDS)
    result = {}
    for n in STEPS:
        found: dict[str, list[tuple[np.ndarray, ...]]] = {"free": [], "contact": []}
        for s, a, touches in episodes:
            lean = np.cumsum(s[:, :2], axis=1) if is_acrobot else s[:, 2:3]
            upright = (np.abs(lean) <= _UPRIGHT).all(axis=1)
            for t in range(0, len(a) - n + 1, n):
                if upright[t : t + n].all():
                    motion = "contact" if touches[t : t + n].any() else "free"
                    found[motion].append((s[t], a[t : t + n], s[t + n]))
        for motion, rows in found.items():
            if len(rows) > 1:
                result[motion, n] = Windows(*(np.array(part) for part in zip(*rows, strict=True)))
    return result


def _episodes(env_id: str, seeds: range) -> list[_Episode]:
    regulator = lqr(env_id)
    rng = np.random.default_rng(0)
    result = []
    with contextlib.closing(gym.make(env_id)) as env:
        for seed in seeds:
            states, actions, touches = [env.reset(seed=seed)[0]], [], []
            for _ in range(_EPISODE_STEPS):
                action = np.clip(regulator(states[-1][None])[0] + _NOISE * rng.normal(size=1), -1.0, 1.0)
                s, _, terminated, truncated, info = env.step(action.astype(np.float32))
                states.append(s)
                actions.append(action)
                touches.append(bool(np.any(info[env.unwrapped.CONTACT_FORCES])))  # type: ignore[attr-defined]
                if terminated or truncated:
                    break
            result.append(_Episode(np.array(states), np.array(actions), np.array(touches)))
    return result


def prediction_lines(lcs: LinearComplementaritySystem, name: str, env_id: str, few: bool = False) -> list[ProbeLine]:
    """Errors of a model's predictions.

    :param lcs: the model
    :param name: what it is called in the lines
    :param env_id: see :func:`windows`
    :param few: see :func:`windows`
    """
    return [
        {"model": name, "motion": motion, "steps": n, "quantity": "error", "value": test.error(lcs)}
        for (motion, n), test in windows(env_id, few).items()
    ]


# -- matrices --


def matrix_lines(
    learned: LcsMatrices[np.ndarray], true: LcsMatrices[np.ndarray], scale: np.ndarray, action_scale: np.ndarray
) -> list[ProbeLine]:
    """Errors of a model's matrices.

    :param learned: environment units
    :param true: environment units
    :param scale: (n_x,) of the states
    :param action_scale: (n_a,)
    """
    learned, true = (_scaled(model, scale, action_scale) for model in (learned, true))
    full_action = float(np.linalg.norm(true.B))
    errors = {
        "A": _distance(learned.A, true.A) / float(np.linalg.norm(true.A - np.eye(len(true.A)))),
        "B": _distance(learned.B, true.B) / full_action,
        "d": _distance(learned.d, true.d) / full_action,
    }
    lines = [_matrix_line(matrix, "", value) for matrix, value in errors.items()]

    moving = learned.C.any(axis=0)
    counterpart = _counterparts(learned, true, np.flatnonzero(moving & learned.D.any(axis=1)))
    for k in range(len(true.c)):
        errors = {"effect": 1.0}
        if k in counterpart:
            mine, right = _gap(learned, counterpart[k]), _gap(true, k)
            effects = _effect(learned, counterpart[k]), _effect(true, k)
            n_x = len(true.A)
            errors = {
                "D": _distance(mine[:n_x], right[:n_x]),
                "E": _distance(mine[n_x:-1], right[n_x:-1]),
                "c": abs(mine[-1] - right[-1]) / abs(right[-1]),
                "effect": _distance(*effects) / float(np.linalg.norm(effects[1])),
            }
        lines += [_matrix_line(matrix, str(k), value) for matrix, value in errors.items()]
    spurious = float(moving.sum() - len(counterpart))
    return [*lines, {"model": "learned", "quantity": "spurious contacts", "value": spurious}]


def _matrix_line(matrix: str, contact: str, value: float) -> ProbeLine:
    return {"model": "learned", "matrix": matrix, "contact": contact, "quantity": "error", "value": float(value)}


def _scaled(model: LcsMatrices[np.ndarray], s: np.ndarray, a: np.ndarray) -> LcsMatrices[np.ndarray]:
    A, B, C, d, D, E, F, c = model
    return LcsMatrices(A * s / s[:, None], B * a / s[:, None], C / s[:, None], d / s, D * s, E * a, F, c)


def _counterparts(
    learned: LcsMatrices[np.ndarray], true: LcsMatrices[np.ndarray], eligible: np.ndarray
) -> dict[int, int]:
    """Index of a true contact -> index of the learned one that is its counterpart."""
    mine = [_whole(learned, k) for k in eligible]
    distances = np.array(
        [
            [_distance(one, right) / np.linalg.norm(right) for one in mine]
            for right in (_whole(true, k) for k in range(len(true.c)))
        ]
    )
    if not distances.size:
        return {}
    # to take one that is further away than zero is no better than to have none
    rows, columns = linear_sum_assignment(np.minimum(distances, 1.0))
    return {int(k): int(eligible[i]) for k, i in zip(rows, columns, strict=True) if distances[k, i] < 1.0}


def _row(model: LcsMatrices[np.ndarray], k: int) -> np.ndarray:
    return np.concatenate([model.D[k], model.E[k], model.c[k : k + 1]])


def _gap(model: LcsMatrices[np.ndarray], k: int) -> np.ndarray:
    return _row(model, k) / np.linalg.norm(model.D[k])


def _whole(model: LcsMatrices[np.ndarray], k: int) -> np.ndarray:
    return np.outer(model.C[:, k], _row(model, k)) / model.F[k, k]


def _effect(model: LcsMatrices[np.ndarray], k: int) -> np.ndarray:
    return np.outer(model.C[:, k], model.D[k]) / model.F[k, k]


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one - other))


# -- the probe --


@functools.cache
def _true_lines(env_id: str, few: bool) -> tuple[ProbeLine, ...]:
    with contact_env(env_id) as env:
        true = LinearComplementaritySystem.from_matrices(*env.true_lcs())
    return tuple(prediction_lines(true, "true", env_id, few))


def probe(model: BaseAlgorithm, env_id: str, *, small: bool = False) -> list[ProbeLine]:
    """Errors of the learned model: keys ``model``, ``motion`` and ``steps``, or ``matrix`` and ``contact``.

    :param model: with an ``MpcLcsPolicy``
    :param env_id: the environment it was trained in
    :param small: less test data
    :raises TypeError: the model has another policy, or the environment is not one of ``contact_envs``
    """
    lcs = learned_policy(model).lcs
    with contact_env(env_id) as env:
        true = LcsMatrices(*env.true_lcs())
    learned = LcsMatrices(*(part.detach().cpu().numpy() for part in lcs.matrices()))
    return [
        *prediction_lines(lcs, "learned", env_id, small),
        *(dict(line) for line in _true_lines(env_id, small)),
        *matrix_lines(learned, true, state_scale(env_id), np.ones(true.B.shape[1])),
    ]
