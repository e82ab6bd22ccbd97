"""What a physics engine must be told to build a plant: links, joints, and what they touch."""

from __future__ import annotations

import dataclasses
from typing import Literal

__all__ = ["JointStops", "Link", "Mechanism", "TipWalls"]


@dataclasses.dataclass(frozen=True)
class Link:
    """A thin rigid body, on a joint that carries it on the link before it (the first one: on the world).

    In its own frame the joint is at the origin and the body along z; at zero all frames are parallel, z up.

    :param name: also the joint's
    :param joint: "slide" along x, or "hinge" about y (positive: the top moves towards +x)
    :param height: m, where the joint sits on the link before it
    :param mass: kg
    :param mass_centre: m, from the joint
    :param inertia: kg m^2, about the mass centre, at right angles to the body
    :param damping: N s/m or N m s/rad, of the joint
    :param length: m, of the body in pictures; does not change the motion
    """

    name: str
    joint: Literal["slide", "hinge"]
    height: float
    mass: float
    mass_centre: float
    inertia: float = 0.0
    damping: float = 0.0
    length: float = 0.0


@dataclasses.dataclass(frozen=True)
class TipWalls:
    """Two elastic, frictionless walls that stand upright at either side of a sphere on the last link.

    The first joint of the mechanism must be a slide: engines read the walls' push off it.

    :param height: m, of the sphere's centre on the last link
    :param radius: m, of the sphere; the walls' faces stand this much further out than ``distance``
    :param distance: m, from the origin to the sphere's centre when it begins to touch
    :param stiffness: N/m
    """

    height: float
    radius: float
    distance: float
    stiffness: float


@dataclasses.dataclass(frozen=True)
class JointStops:
    """Two elastic stops that push the first joint back where it is further out than an angle.

    :param angle: rad
    :param stiffness: N m/rad
    """

    angle: float
    stiffness: float


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """A chain of links in the x-z plane, without friction.

    :param links: from the world outwards
    :param actuated: index of the joint that the actuator's force or torque acts on
    :param contact: what pushes back
    :param gravity: m/s^2, downwards
    """

    links: tuple[Link, ...]
    actuated: int
    contact: TipWalls | JointStops
    gravity: float
