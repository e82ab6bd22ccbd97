"""The mechanisms of the environments as mathematics: NumPy only. A new one is a new file."""

from __future__ import annotations

from contact_envs.plants.acrobot import AcrobotParameters
from contact_envs.plants.base import Linearisation, Plant
from contact_envs.plants.cart_pole import CartPoleParameters
from contact_envs.plants.mechanism import JointStops, Link, Mechanism, TipWalls

__all__ = [
    "AcrobotParameters",
    "CartPoleParameters",
    "JointStops",
    "Linearisation",
    "Link",
    "Mechanism",
    "Plant",
    "TipWalls",
]
