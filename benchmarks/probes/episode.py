"""One scored episode, step by step: what a policy does, where its score says only how well.

Every second step, to keep the file small; states in the units of the observation, the action as the environment takes
it, the reward of that step and the return up to and with it.
"""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.evaluation import RESET_SEEDS, Controller, controller_of
from benchmarks.probes import ProbeLine

__all__ = ["EPISODE", "lines", "probe"]

EPISODE = 15
"""Of the scored episodes the one in which, on the cart-pole with 100 N, LQR and a neural policy differ most."""
_EVERY = 2


def probe(model: BaseAlgorithm, env_id: str, *, small: bool = False) -> list[ProbeLine]:
    """The episode under the deterministic policy of a model.

    :param small: only its first steps
    """
    return lines(controller_of(model), env_id, most=20 if small else None)


def lines(controller: Controller, env_id: str, most: int | None = None) -> list[ProbeLine]:
    """The episode under any controller; keys ``step`` and, as the quantity, ``state i``, ``action i``, ``reward``
    and ``return``.

    :param most: steps at most
    """
    found: list[ProbeLine] = []
    total, step, over = 0.0, 0, False
    with contextlib.closing(gym.make(env_id)) as env:
        space = env.action_space
        assert isinstance(space, gym.spaces.Box)
        s, _ = env.reset(seed=RESET_SEEDS[EPISODE])
        while not over and (most is None or step < most):
            a = np.clip(controller(s[None])[0], space.low, space.high).astype(space.dtype)
            s_next, reward, terminated, truncated, _ = env.step(a)
            total += float(reward)
            over = terminated or truncated
            if step % _EVERY == 0 or over:
                values = {f"state {i}": float(s[i]) for i in range(len(s))}
                values |= {f"action {i}": float(a[i]) for i in range(len(a))}
                values |= {"reward": float(reward), "return": total}
                found += [{"step": step, "quantity": name, "value": round(v, 5)} for name, v in values.items()]
            s, step = s_next, step + 1
    return found
