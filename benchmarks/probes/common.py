"""What probes share: how many episodes they score, environments in wrappers, and the learned model."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from benchmarks.references import contact_env
from sb3_mpc_policy import MpcLcsPolicy, hyperparams

__all__ = ["EPISODES", "FEW_EPISODES", "learned_policy", "state_scale", "wrapped"]

EPISODES, FEW_EPISODES = 20, 4


def wrapped(env_id: str, wrapper: type[gym.Wrapper], **kwargs: Any) -> EnvSpec:
    """A registered environment inside a wrapper.

    :param env_id: of the environment
    :param wrapper: a class of a module, not of a function: it is imported by name
    :param kwargs: of the wrapper
    """
    spec = copy.deepcopy(gym.spec(env_id))
    made = WrapperSpec(wrapper.__name__, f"{wrapper.__module__}:{wrapper.__name__}", kwargs)
    spec.additional_wrappers = (*spec.additional_wrappers, made)
    return spec


def state_scale(env_id: str) -> np.ndarray:
    """(n_x,) the size of each state: that of the tuned settings where there are any, else the reset range.

    :param env_id: an environment of ``contact_envs``
    :raises TypeError: it is another
    """
    with contact_env(env_id) as env:
        reset_range = env.reset_range
    try:
        tuned = hyperparams(env_id)["policy_kwargs"]
    except KeyError:
        return reset_range
    return np.asarray(tuned.get("state_scale", reset_range), dtype=np.float64)


def learned_policy(model: BaseAlgorithm) -> MpcLcsPolicy:
    """The policy of a model that has learned an LCS in the environment's own units.

    :raises TypeError: it is another policy
    :raises ValueError: it has learned from normalised observations
    """
    if not isinstance(model.policy, MpcLcsPolicy):
        raise TypeError(f"this probe is for models with an MpcLcsPolicy, got {type(model.policy).__name__}")
    normalisation = model.get_vec_normalize_env()
    if isinstance(normalisation, VecNormalize) and normalisation.norm_obs:
        raise ValueError("this probe is for models in the environment's units, got one of normalised observations")
    return model.policy
