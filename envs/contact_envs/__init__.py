"""Gymnasium environments in which contact decides, with Drake and PyBullet behind one interface.

Importing the package registers the environments and nothing more: a simulator is imported when an environment
that uses it is made.
"""

from __future__ import annotations

from typing import Any

from gymnasium.envs.registration import register, registry

__all__ = ["ENV_IDS"]

_CART_POLE = "contact_envs.cart_pole_soft_walls:CartPoleSoftWallsEnv"
_ACROBOT = "contact_envs.acrobot_soft_limits:AcrobotSoftLimitsEnv"
_MAX_EPISODE_STEPS = 400

# A tenth of the force, and starts that are further out.
_HARD: dict[str, Any] = {"max_force": 10.0, "reset_range": (0.35, 1.0, 0.30, 1.0)}

_ENVIRONMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    "CartPoleSoftWalls-v0": (_CART_POLE, {"simulator": "drake"}),
    "CartPoleSoftWallsDrake-v0": (_CART_POLE, {"simulator": "drake"}),
    "CartPoleSoftWallsPyBullet-v0": (_CART_POLE, {"simulator": "pybullet"}),
    "CartPoleSoftWallsHard-v0": (_CART_POLE, {"simulator": "drake", **_HARD}),
    "CartPoleSoftWallsHardDrake-v0": (_CART_POLE, {"simulator": "drake", **_HARD}),
    "CartPoleSoftWallsHardPyBullet-v0": (_CART_POLE, {"simulator": "pybullet", **_HARD}),
    "AcrobotSoftLimits-v0": (_ACROBOT, {"simulator": "drake"}),
    "AcrobotSoftLimitsDrake-v0": (_ACROBOT, {"simulator": "drake"}),
    "AcrobotSoftLimitsPyBullet-v0": (_ACROBOT, {"simulator": "pybullet"}),
}

ENV_IDS = tuple(_ENVIRONMENTS)
"""The registered environment ids."""

for _id, (_entry_point, _kwargs) in _ENVIRONMENTS.items():
    if _id not in registry:
        register(_id, entry_point=_entry_point, max_episode_steps=_MAX_EPISODE_STEPS, kwargs=_kwargs)
