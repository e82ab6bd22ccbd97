"""Physics engines behind one interface. A new one is a new file and a line in ``SIMULATORS``."""

from __future__ import annotations

import importlib

from contact_envs.simulators.base import Simulator

__all__ = ["SIMULATORS", "Simulator", "simulator_class"]

SIMULATORS = {
    "drake": "contact_envs.simulators.drake:DrakeSimulator",
    "pybullet": "contact_envs.simulators.pybullet:PyBulletSimulator",
}
"""Name -> "module:class". Modules are imported on first use, so that only the engine in use must be
installed."""


def simulator_class(name: str) -> type[Simulator]:
    """The engine called ``name``.

    :param name: a key of ``SIMULATORS``
    :raises ValueError: there is no such engine
    :raises ImportError: its package is not installed; the message says how to install it
    """
    if name not in SIMULATORS:
        raise ValueError(f"simulator must be one of {sorted(SIMULATORS)}, got {name!r}")
    module, attribute = SIMULATORS[name].split(":")
    return getattr(importlib.import_module(module), attribute)
