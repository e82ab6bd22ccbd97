"""Tuned settings for the registered environments, read from ``hyperparams/ppo.yml`` (RL Zoo's form)."""

from __future__ import annotations

from importlib import resources
from typing import Any

import yaml
from stable_baselines3.common.utils import LinearSchedule

__all__ = ["hyperparams"]

# Entries of RL Zoo's form that are not arguments of PPO.
_FOR_THE_ZOO = ("policy", "n_timesteps", "n_envs", "normalize", "env_wrapper", "callback")
_SCHEDULES = ("learning_rate", "clip_range")


def hyperparams(env_id: str) -> dict[str, Any]:
    """Keyword arguments for ``PPO("MpcLcsPolicy", env_id, **hyperparams(env_id))``.

    :param env_id: a registered environment, such as "CartPoleSoftWalls-v0"
    :raise KeyError: for an environment without tuned settings
    """
    text = (resources.files("sb3_mpc_policy") / "hyperparams" / "ppo.yml").read_text(encoding="utf-8")
    table: dict[str, dict[str, Any]] = yaml.safe_load(text)
    if env_id not in table:
        known = sorted(name for name in table if name[0].isupper())
        raise KeyError(f"no hyperparameters for env_id {env_id!r}; there are some for {known}")
    settings = {name: value for name, value in table[env_id].items() if name not in _FOR_THE_ZOO}
    for name in _SCHEDULES:
        value = settings.get(name)
        if isinstance(value, str) and value.startswith("lin_"):
            settings[name] = LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0)
    if isinstance(settings.get("policy_kwargs"), str):
        # the zoo's form is a Python expression; dict(...) with literals is all that is needed, and the file is ours
        settings["policy_kwargs"] = eval(settings["policy_kwargs"], {"__builtins__": {}}, {"dict": dict})
    return settings
