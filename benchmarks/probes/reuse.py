"""What a learned model is worth for another task, without new data: the same model, another cost.

Three tasks, by the plant:

* ``hold``: the cart stays 0.2 m from the middle; the acrobot stays bent, its upper link at 0.05 rad;
* ``lean``: stay leaning on the right wall or stop, starting there, with velocities of up to a fifth of the reset
  range. At rest the contact carries what gravity pulls (:func:`leaning`), and nothing but a contact can: the
  cart-pole's wall holds the pole at 0.1 rad, the acrobot's stop holds the upper link, the lower one upright;
* ``cost``: the environment's own task with other weights, 100 times that of the pole's angle (10 times that of the
  elbow's), 10 times that of the force.

Scores are mean undiscounted returns of the new reward, taken from states and actions. The controller is the policy's,
built anew with the same horizon and penalty; so is the oracle's, with the tuned ones and the true LCS. Beside them
stands LQR of the true LCS without its contacts, for the same cost.

The terminal value is where a task may need more than its cost: the policy's own is that of the model without contacts,
and as far as that can tell, a pole that leans falls. Here it is that of the mode, free or with one contact closed, in
which the model itself can rest at least cost (:func:`regulator_at_rest`).
"""

from __future__ import annotations

import contextlib
import copy
import functools
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from scipy.optimize import brentq
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.evaluation import Controller, Evaluator
from benchmarks.probes import ProbeLine
from benchmarks.probes.common import EPISODES, FEW_EPISODES, learned_policy, wrapped
from benchmarks.references import contact_env, oracle_controller
from contact_envs.plants import AcrobotParameters, CartPoleParameters, Plant
from contact_envs.soft_contact_env import SoftContactEnv
from sb3_mpc_policy import LcsMpc, QuadraticReward
from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.lqr import AffineLqr, affine_lqr
from sb3_mpc_policy.reward import QuadraticCost

__all__ = ["Task", "TaskEnv", "leaning", "probe", "regulator_at_rest", "retarget", "tasks"]

_LEAN = 0.1  # rad, of the pole on the wall
_LEAN_WEIGHT = 400.0  # of the angle's square: standing upright beside the wall costs 4 of the 15 that a step pays
_LEAN_VELOCITY = 0.2  # at the start, as a share of the reset range
_CONSTANT = 15.0


class Task(NamedTuple):
    """Something to do in an environment."""

    name: str
    reward: QuadraticReward
    """With the action in the environment's units."""
    start: np.ndarray | None
    """(n_x,) where episodes start, up to velocities; None for the environment's own starts."""


class TaskEnv(gym.Wrapper):
    """An environment with another reward, and other starts.

    :param env: of ``contact_envs``
    :param reward: what is paid for the state before the step and the action
    :param start: see :class:`Task`
    """

    def __init__(self, env: gym.Env, reward: QuadraticReward, start: np.ndarray | None) -> None:
        super().__init__(env)
        assert env.observation_space.shape and env.action_space.shape
        self.cost = reward.cost(env.observation_space.shape[0], env.action_space.shape[0])
        self.start = start
        self._before = np.zeros(env.observation_space.shape)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if self.start is not None:
            plant = self.unwrapped
            assert isinstance(plant, SoftContactEnv)
            spread = np.zeros_like(self.start)
            moving = list(plant.parameters.VELOCITIES)
            spread[moving] = _LEAN_VELOCITY * plant.reset_range[moving]
            options = {"state": self.start + np.random.default_rng(seed).uniform(-spread, spread)}
        self._before, info = super().reset(seed=seed, options=options)
        return self._before, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = -float(self.cost(self._before, np.asarray(action, dtype=np.float64)))
        self._before, _, terminated, truncated, info = super().step(action)
        return self._before, reward, terminated, truncated, info


# -- tasks --


def leaning(plant: Plant) -> tuple[np.ndarray, float]:
    """A steady state that rests on the right contact: state (n_x,), and the actuator's force that it takes (N, N m).

    The cart-pole's pole leans by ``theta``, and the wall carries it, ``lam = m g l_c tan(theta) / l``; the cart is
    where the wall pushes that hard, and is pushed against it as hard. The acrobot's lower link stands upright, on an
    upper one where ``lam = k (theta_1 - w)`` carries both, without any torque.

    :raises TypeError: no such state is known of the plant
    """
    if isinstance(plant, CartPoleParameters):
        force = plant.pole_mass * plant.gravity * plant.mass_centre * np.tan(_LEAN) / plant.pole_length
        x = plant.wall_distance + force / plant.wall_stiffness - plant.pole_length * np.sin(_LEAN)
        return np.array([x, 0.0, _LEAN, 0.0]), float(force)
    if isinstance(plant, AcrobotParameters):
        moment = plant.gravity * (plant.upper_mass * plant.upper_mass_centre + plant.lower_mass * plant.upper_length)
        angle = brentq(
            lambda theta: plant.limit_stiffness * (theta - plant.limit_angle) - moment * np.sin(theta),
            plant.limit_angle, 2.0 * plant.limit_angle,
        )  # fmt: skip
        return np.array([angle, -angle, 0.0, 0.0]), 0.0
    raise TypeError(f"plant must be a cart-pole or an acrobot, got {plant!r}")


def tasks(env_id: str) -> list[Task]:
    """The new tasks in an environment.

    :raises TypeError: it is not one of ``contact_envs``
    """
    with contact_env(env_id) as env:
        plant, weights, force_weight = env.parameters, env.state_weights, env.action_weight * env.max_force**2
    hold, lean, other = np.zeros_like(weights), weights.copy(), weights.copy()
    if isinstance(plant, CartPoleParameters):
        hold[0] = 0.2
        lean[2], other[2] = _LEAN_WEIGHT, 100.0 * weights[2]
    else:
        assert isinstance(plant, AcrobotParameters)
        # a steady state: the lower link is bent back until the whole is balanced above the shoulder
        upper = plant.upper_mass * plant.upper_mass_centre + plant.lower_mass * plant.upper_length
        back = np.arcsin(upper / (plant.lower_mass * plant.lower_mass_centre) * np.sin(0.05))
        hold[:2] = 0.05, -0.05 - back
        lean[0], other[1] = _LEAN_WEIGHT, 10.0 * weights[1]
    rest, _ = leaning(plant)
    return [
        Task("hold", QuadraticReward(weights, force_weight, hold, _CONSTANT), None),
        Task("lean", QuadraticReward(lean, force_weight, rest, _CONSTANT), rest),
        Task("cost", QuadraticReward(other, 10.0 * force_weight, constant=_CONSTANT), None),
    ]


# -- controllers --


def regulator_at_rest(model: LcsMatrices[np.ndarray], cost: QuadraticCost) -> AffineLqr:
    """The regulator of the mode in which a model can rest at least cost.

    A mode is the free motion, or one contact closed, ``lam = −(D s + E a + c) / F``. Where its regulator comes to rest
    counts only if the contact does push there.

    :param model: eq (5)
    :param cost: in the same coordinates
    """
    A, B, C, d, D, E, F, c = model
    best = affine_lqr(A, B, d, cost.W, cost.w)
    least = _cost_at_rest(A, B, d, best, cost)[0]
    for k in range(len(c)):
        push = C[:, k] / F[k, k]
        closed = A - np.outer(push, D[k]), B - np.outer(push, E[k]), d - push * c[k]
        regulator = affine_lqr(*closed, cost.W, cost.w)
        value, s, a = _cost_at_rest(*closed, regulator, cost)
        if value < least and D[k] @ s + E[k] @ a + c[k] < 0.0:
            best, least = regulator, value
    return best


def _cost_at_rest(
    A: np.ndarray, B: np.ndarray, d: np.ndarray, regulator: AffineLqr, cost: QuadraticCost
) -> tuple[float, np.ndarray, np.ndarray]:
    """What a step costs where the regulator comes to rest, and that state and action; infinity where it does not."""
    _, _, K, k, source = regulator
    nowhere = np.full(len(A), np.nan)
    if source != "riccati":
        return np.inf, nowhere, nowhere[: B.shape[1]]
    s = np.linalg.solve(np.eye(len(A)) - A - B @ K, B @ k + d)
    a = K @ s + k
    return float(cost(s, a)), s, a


def retarget(mpc: LcsMpc, reward: QuadraticReward) -> LcsMpc:
    """A controller for another reward, with the terminal value that goes with it.

    :param mpc: is changed, and returned
    :param reward: with the action in the environment's units
    """
    cost = reward.cost(mpc.lcs.n_states, mpc.lcs.n_actions)
    mpc.set_cost(cost)
    mpc.refresh()
    scale = torch.cat([mpc.lcs.state_scale, mpc.lcs.action_scale]).cpu().numpy()
    scaled = QuadraticCost(cost.W * np.outer(scale, scale), cost.w * scale, cost.w0)
    model = LcsMatrices(*(part.detach().cpu().numpy() for part in mpc.lcs.scaled()))
    regulator = regulator_at_rest(model, scaled)
    mpc.get_buffer("terminal_weight").copy_(torch.as_tensor(regulator.P))
    mpc.get_buffer("terminal_slope").copy_(torch.as_tensor(regulator.p))
    return mpc


def _planner(mpc: LcsMpc) -> Controller:
    def act(observations: np.ndarray) -> np.ndarray:
        return mpc.plan(observations).actions[:, 0]

    return act


def _lqr(env_id: str, reward: QuadraticReward) -> Controller:
    with contact_env(env_id) as env:
        model = env.true_lcs()
    cost = reward.cost(*model.B.shape)
    regulator = affine_lqr(model.A, model.B, model.d, cost.W, cost.w)

    def act(observations: np.ndarray) -> np.ndarray:
        return observations @ regulator.K.T + regulator.k

    return act


# -- the probe --


def _line(env_id: str, task: Task, name: str, controller: Controller, n_episodes: int) -> ProbeLine:
    spec = wrapped(env_id, TaskEnv, reward=task.reward, start=task.start)
    with contextlib.closing(Evaluator(spec, n_episodes)) as evaluator:
        value = evaluator.score(controller)
    return {"task": task.name, "controller": name, "quantity": "score", "value": value}


@functools.cache  # they are the same for every model
def reference_lines(env_id: str, n_episodes: int) -> tuple[ProbeLine, ...]:
    """What the oracle and LQR score in every task."""
    lines = []
    for task in tasks(env_id):
        oracle = _planner(retarget(oracle_controller(env_id), task.reward))
        lines.append(_line(env_id, task, "oracle", oracle, n_episodes))
        lines.append(_line(env_id, task, "lqr", _lqr(env_id, task.reward), n_episodes))
    return tuple(lines)


def probe(model: BaseAlgorithm, env_id: str, *, small: bool = False) -> list[ProbeLine]:
    """Score the learned model, the oracle and LQR in every task: keys ``task`` and ``controller``.

    :param model: with an ``MpcLcsPolicy``; it stays as it is
    :param env_id: the environment it was trained in
    :param small: fewer episodes
    :raises TypeError: the model has another policy, or the environment is not one of ``contact_envs``
    """
    n_episodes = FEW_EPISODES if small else EPISODES
    known = learned_policy(model).mpc
    lines = []
    for task in tasks(env_id):
        mpc = LcsMpc(
            copy.deepcopy(known.lcs), task.reward, known.action_low, known.action_high, horizon=known.horizon,
            penalty=known.penalty, smoothing=known.smoothing, n_iterations=known.n_iterations,
        )  # fmt: skip
        lines.append(_line(env_id, task, "learned", _planner(retarget(mpc, task.reward)), n_episodes))
    return [*lines, *(dict(line) for line in reference_lines(env_id, n_episodes))]
