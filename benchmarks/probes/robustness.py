"""What a controller scores where the environment is not the one it was made for.

    python -m benchmarks.probes.robustness --env CartPoleSoftWallsHardPyBullet-v0

The controller is used as it is; it is told of nothing, and learns nothing. One thing differs at a time:

* masses and lengths, 0.7 and 1.3 times what they were; the distance of a link's mass centre changes with its length;
* the contacts' stiffness, about a third and about three times what it was (N/m, N m/rad);
* Gaussian noise on every observation, its standard deviation a share of the state scale (of the tuned settings, else
  the reset range). The reward is still that of the true state;
* a delay: an action acts so many control steps later than it is chosen, the first of an episode after none at all.

The command measures controllers that know the model: the oracle and LQR, which know the one before the change, and the
"informed oracle", which knows the model after it, where it is the model that changes.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import dataclasses
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.contact_matters import ACROBOT, changed
from benchmarks.evaluation import Controller, Evaluator, controller_of
from benchmarks.probes import ProbeLine
from benchmarks.probes.common import EPISODES, FEW_EPISODES, state_scale, wrapped
from benchmarks.references import contact_env, lqr, oracle
from contact_envs.plants import AcrobotParameters, CartPoleParameters, Plant

__all__ = ["Change", "DelayedActions", "NoisyObservations", "changes", "probe", "scores"]

ENVS = ["CartPoleSoftWallsPyBullet-v0", "CartPoleSoftWallsHardPyBullet-v0", ACROBOT]

FACTORS = (0.7, 1.3)
NOISE = (0.002, 0.005, 0.01)
DELAY = (1,)
# What a factor changes: fields of the plant, each by the given power of the factor.
FACTORS_OF: dict[type[Plant], dict[str, dict[str, int]]] = {
    CartPoleParameters: {
        "pole mass": {"pole_mass": 1},
        "pole length": {"pole_length": 1, "mass_centre": 1},
    },
    AcrobotParameters: {
        "upper mass": {"upper_mass": 1, "upper_inertia": 1},
        "lower mass": {"lower_mass": 1, "lower_inertia": 1},
        "upper length": {"upper_length": 1, "upper_mass_centre": 1, "upper_inertia": 2},
        "lower length": {"lower_length": 1, "lower_mass_centre": 1, "lower_inertia": 2},
    },
}
# What it is called, the field, and its values.
STIFFNESS_OF: dict[type[Plant], tuple[str, str, tuple[float, ...]]] = {
    CartPoleParameters: ("wall stiffness", "wall_stiffness", (200.0, 2000.0)),
    AcrobotParameters: ("limit stiffness", "limit_stiffness", (100.0, 1000.0)),
}


class NoisyObservations(gym.ObservationWrapper):
    """Adds independent Gaussian noise to every observation, the same in every episode of one reset seed.

    :param env: with a Box of observations
    :param deviation: (n_x,) standard deviations
    """

    def __init__(self, env: gym.Env, deviation: Sequence[float]) -> None:
        super().__init__(env)
        self.deviation = np.asarray(deviation, dtype=np.float64)
        self._rng = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._rng = np.random.default_rng([seed, 1])  # not the numbers that the start is drawn from
        return super().reset(seed=seed, options=options)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return observation + self.deviation * self._rng.normal(size=observation.shape)


class DelayedActions(gym.Wrapper):
    """Applies each action some steps later; until the first one's turn comes, the action is zero.

    :param env: with a Box of actions
    :param steps: >= 0
    """

    def __init__(self, env: gym.Env, steps: int) -> None:
        super().__init__(env)
        self.steps = steps
        self._waiting: deque[np.ndarray] = deque()

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        space = self.action_space
        assert isinstance(space, gym.spaces.Box)
        self._waiting = deque([np.zeros(space.shape, space.dtype)] * self.steps)
        return super().reset(**kwargs)

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._waiting.append(action)
        return super().step(self._waiting.popleft())


class Change(NamedTuple):
    """One way in which an environment differs."""

    change: str
    amount: float
    spec: EnvSpec
    """Of the environment as changed."""
    of_model: bool
    """Whether its equations of motion, and so its true LCS, are others."""


def changes(env_id: str) -> list[Change]:
    """Every change that is tried, the first one none.

    :param env_id: an environment of ``contact_envs``
    :raises TypeError: another environment
    """
    with contact_env(env_id) as env:
        plant = env.parameters
    result = [Change("nothing", 0.0, changed(env_id, {}), False)]
    for name, fields in FACTORS_OF[type(plant)].items():
        for factor in FACTORS:
            others = {field: getattr(plant, field) * factor**power for field, power in fields.items()}
            result.append(_with_plant(env_id, name, factor, dataclasses.replace(plant, **others)))
    name, field, values = STIFFNESS_OF[type(plant)]
    for value in values:
        result.append(_with_plant(env_id, name, value, dataclasses.replace(plant, **{field: value})))
    scale = state_scale(env_id)
    for share in NOISE:
        result.append(_wrapped(env_id, "noise", share, NoisyObservations, deviation=share * scale))
    for steps in DELAY:
        result.append(_wrapped(env_id, "delay", steps, DelayedActions, steps=steps))
    return result


def _with_plant(env_id: str, name: str, amount: float, plant: Plant) -> Change:
    return Change(name, amount, changed(env_id, {"parameters": plant}), True)


def _wrapped(env_id: str, name: str, amount: float, wrapper: type[gym.Wrapper], **kwargs: Any) -> Change:
    return Change(name, float(amount), wrapped(env_id, wrapper, **kwargs), False)


def _score(controller: Controller, change: Change, n_episodes: int) -> ProbeLine:
    with contextlib.closing(Evaluator(change.spec, n_episodes)) as evaluator:
        value = evaluator.score(controller)
    return {"change": change.change, "amount": change.amount, "quantity": "score", "value": value}


def scores(controller: Controller, env_id: str, n_episodes: int = EPISODES, small: bool = False) -> list[ProbeLine]:
    """Score one controller under every change.

    :param controller: see :data:`~benchmarks.evaluation.Controller`
    :param env_id: see :func:`changes`
    :param n_episodes: see :class:`~benchmarks.evaluation.Evaluator`
    :param small: only the last amount of each change
    """
    tried = changes(env_id)
    if small:
        tried = list({change.change: change for change in tried}.values())
    return [_score(controller, change, n_episodes) for change in tried]


def informed_scores(env_id: str, n_episodes: int = EPISODES) -> list[ProbeLine]:
    """Score, for every change of the model, the oracle that knows of it."""
    return [_score(oracle(change.spec), change, n_episodes) for change in changes(env_id) if change.of_model]


def probe(model: BaseAlgorithm, env_id: str, *, small: bool = False) -> list[ProbeLine]:
    """Score a trained model under every change: keys ``change`` and ``amount``.

    :param model: any Stable-Baselines3 model
    :param env_id: the environment it was trained in
    :param small: fewer episodes, and one amount of each change
    """
    return scores(controller_of(model), env_id, FEW_EPISODES if small else EPISODES, small)


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table of the controllers that know the model, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=ENVS)
    parser.add_argument("--episodes", type=int, default=EPISODES, help="scored episodes")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/robustness_references.csv"))
    args = parser.parse_args(argv)
    lines: list[ProbeLine] = []
    for env_id in args.env:
        for name, rows in (
            ("oracle", scores(oracle(env_id), env_id, args.episodes)),
            ("lqr", scores(lqr(env_id), env_id, args.episodes)),
            ("informed oracle", informed_scores(env_id, args.episodes)),
        ):
            for row in rows:
                lines.append({"env": env_id, "controller": name, **row, "value": round(float(row["value"]), 1)})
                print(*lines[-1].values(), sep="  ", flush=True)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


if __name__ == "__main__":
    main()
