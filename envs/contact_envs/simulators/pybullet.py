"""A plant in PyBullet: a multibody in reduced coordinates with spring contact."""

from __future__ import annotations

import ctypes
import math
import os
import sys
import weakref

import numpy as np
from numpy.typing import NDArray

from contact_envs.plants import JointStops, Link, Plant, TipWalls
from contact_envs.simulators.base import Simulator

try:
    import pybullet
except ImportError as error:
    raise ImportError(
        "simulator='pybullet' needs PyBullet: pip install pybullet, or pip install 'sb3-mpc-policy[pybullet]'"
    ) from error

# Bullet combines the stiffnesses of the two bodies like springs in series: k1 k2 / (k1 + k2). The wall is to
# be the only spring, so the tip is this many times stiffer.
TIP_STIFFNESS_RATIO = 1e12

# Bullet cuts joint velocities off at 100 (m/s, rad/s) unless told otherwise.
MAX_JOINT_VELOCITY = 1e9

CART_COLOUR = (0.17, 0.24, 0.31, 1.0)
POLE_COLOUR = (0.80, 0.36, 0.20, 1.0)
WALL_COLOUR = (0.95, 0.77, 0.20, 0.7)

ROD_RADIUS = 0.008  # m, in the window

_JOINTS = {
    "slide": (pybullet.JOINT_PRISMATIC, [1.0, 0.0, 0.0]),
    "hinge": (pybullet.JOINT_REVOLUTE, [0.0, 1.0, 0.0]),
}


class PyBulletSimulator(Simulator):
    """See :class:`Simulator`. Each one has a physics server of its own."""

    def __init__(self, parameters: Plant, physics_step: float, substeps: int, viewer: bool = False) -> None:
        super().__init__(parameters, physics_step, substeps, viewer)
        mechanism = parameters.mechanism()
        self._client = _open_window() if viewer else pybullet.connect(pybullet.DIRECT)
        # Also for a simulator that nobody closed: a process has a limited number of servers.
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self._client)
        pybullet.setGravity(0.0, 0.0, -mechanism.gravity, physicsClientId=self._client)
        # Without warm starts, so that no contact of the last episode can reach into the next one.
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=physics_step,
            warmStartingFactor=0.0,
            physicsClientId=self._client,
        )
        self._actuated = mechanism.actuated
        self._contact: _Walls | _Stops
        if isinstance(mechanism.contact, TipWalls):
            self._contact = _Walls(mechanism.contact, viewer, self._client)
            self._body = _add_chain(mechanism.links, viewer, self._client, self._contact.sphere)
            self._contact.touch(self._body, len(mechanism.links) - 1)
        else:
            self._body = _add_chain(mechanism.links, viewer, self._client)
            self._contact = _Stops(mechanism.contact, self._body, self._client)
        self._joints = tuple(range(len(mechanism.links)))

    def reset(self, state: NDArray[np.float64]) -> None:
        positions, velocities = state[[*self.parameters.POSITIONS]], state[[*self.parameters.VELOCITIES]]
        for joint, position, velocity in zip(self._joints, positions.tolist(), velocities.tolist(), strict=True):
            pybullet.resetJointState(self._body, joint, position, velocity, physicsClientId=self._client)

    def step(self, force: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        client, body, contact = self._client, self._body, self._contact
        total = np.zeros(2)
        for _ in range(self.substeps):
            pybullet.setJointMotorControl2(
                body, self._actuated, pybullet.TORQUE_CONTROL, force=force, physicsClientId=client
            )
            contact.before_step(total)
            pybullet.stepSimulation(physicsClientId=client)
            contact.after_step(total)
        state = np.empty(2 * len(self._joints))
        joint_states = pybullet.getJointStates(body, self._joints, physicsClientId=client)
        state[[*self.parameters.POSITIONS]] = [joint[0] for joint in joint_states]
        state[[*self.parameters.VELOCITIES]] = [joint[1] for joint in joint_states]
        return state, total / self.substeps

    def show(self) -> None:
        """PyBullet's window draws by itself."""

    def close(self) -> None:
        self._disconnect()


def _open_window() -> int:
    """A server with a window.

    :raises RuntimeError: there is no display; PyBullet itself would end the process
    """
    if sys.platform.startswith("linux") and not _x_display_opens():
        raise RuntimeError(
            "render_mode='human' needs a display for PyBullet's window, but none can be opened "
            f"(DISPLAY={os.environ.get('DISPLAY')!r}): use render_mode='rgb_array', or simulator='drake', "
            "which shows itself in a browser"
        )
    return pybullet.connect(pybullet.GUI)


def _x_display_opens() -> bool:
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:  # no X library: PyBullet could not open a window either
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    display = x11.XOpenDisplay(None)
    if display is None:
        return False
    x11.XCloseDisplay(display)
    return True


class _Walls:
    """The engine's own contact between a sphere on the last link and two fixed half-spaces."""

    def __init__(self, walls: TipWalls, visible: bool, client: int) -> None:
        self._client = client
        self._stiffness = walls.stiffness
        self._faces = [_add_wall(walls, side, visible, client) for side in (1.0, -1.0)]
        self.sphere = pybullet.createCollisionShape(
            pybullet.GEOM_SPHERE,
            radius=walls.radius,
            collisionFramePosition=[0.0, 0.0, walls.height],
            physicsClientId=client,
        )
        self._body = -1

    def touch(self, body: int, link: int) -> None:
        """Take the link that carries the sphere for what the walls push."""
        self._body = body
        _make_elastic(body, link, self._stiffness * TIP_STIFFNESS_RATIO, self._client)

    def before_step(self, total: NDArray[np.float64]) -> None:
        """The engine finds the forces itself."""

    def after_step(self, total: NDArray[np.float64]) -> None:
        """Add what the walls pushed with in the last physics step."""
        for contact in pybullet.getContactPoints(self._body, physicsClientId=self._client):
            total[self._faces.index(contact[2])] += contact[9]


class _Stops:
    """One-sided springs on the first joint, from its angle where a physics step begins."""

    def __init__(self, stops: JointStops, body: int, client: int) -> None:
        self._stops, self._body, self._client = stops, body, client

    def before_step(self, total: NDArray[np.float64]) -> None:
        """Push the joint back if it is out of range, and add that to the total."""
        angle = pybullet.getJointState(self._body, 0, physicsClientId=self._client)[0]
        depth = abs(angle) - self._stops.angle
        if depth > 0.0:
            torque = self._stops.stiffness * depth
            total[0 if angle > 0.0 else 1] += torque
            pybullet.setJointMotorControl2(
                self._body,
                0,
                pybullet.TORQUE_CONTROL,
                force=-math.copysign(torque, angle),
                physicsClientId=self._client,
            )

    def after_step(self, total: NDArray[np.float64]) -> None:
        """Nothing: the engine knows of no contact here."""


def _add_wall(walls: TipWalls, side: float, visible: bool, client: int) -> int:
    """A fixed half-space whose face the tip's sphere touches when its centre is at the wall."""
    shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, planeNormal=[-side, 0.0, 0.0], physicsClientId=client)
    look = -1
    if visible:
        look = pybullet.createVisualShape(
            pybullet.GEOM_BOX,
            halfExtents=[0.05, 0.15, 0.3],
            visualFramePosition=[side * 0.05, 0.0, walls.height],
            rgbaColor=WALL_COLOUR,
            physicsClientId=client,
        )
    wall = pybullet.createMultiBody(
        baseCollisionShapeIndex=shape,
        baseVisualShapeIndex=look,
        basePosition=[side * (walls.distance + walls.radius), 0.0, 0.0],
        physicsClientId=client,
    )
    _make_elastic(wall, -1, walls.stiffness, client)
    return wall


def _look(link: Link, client: int) -> int:
    """What the window shows of a link; nothing here touches the physics."""
    if link.joint == "slide":
        return pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=[0.12, 0.08, 0.05], rgbaColor=CART_COLOUR, physicsClientId=client
        )
    return pybullet.createVisualShape(
        pybullet.GEOM_CYLINDER,
        radius=ROD_RADIUS,
        length=link.length,
        visualFramePosition=[0.0, 0.0, 0.5 * link.length],
        rgbaColor=POLE_COLOUR,
        physicsClientId=client,
    )


def _add_chain(links: tuple[Link, ...], visible: bool, client: int, last_shape: int = -1) -> int:
    """The links on their joints, the first one's on the world; only the last one has a collision shape."""
    joints = [_JOINTS[link.joint] for link in links]
    upright = [[0.0, 0.0, 0.0, 1.0]] * len(links)
    centres = [[0.0, 0.0, link.mass_centre] for link in links]
    body = pybullet.createMultiBody(
        baseMass=0.0,
        linkMasses=[link.mass for link in links],
        linkCollisionShapeIndices=[-1] * (len(links) - 1) + [last_shape],
        linkVisualShapeIndices=[_look(link, client) if visible else -1 for link in links],
        linkPositions=[[0.0, 0.0, link.height] for link in links],
        linkOrientations=upright,
        linkInertialFramePositions=centres,
        linkInertialFrameOrientations=upright,
        linkParentIndices=list(range(len(links))),
        linkJointTypes=[kind for kind, _ in joints],
        linkJointAxis=[axis for _, axis in joints],
        physicsClientId=client,
    )
    for index, link in enumerate(links):
        pybullet.changeDynamics(
            body,
            index,
            linearDamping=0.0,
            angularDamping=0.0,
            maxJointVelocity=MAX_JOINT_VELOCITY,
            physicsClientId=client,
        )
        # Without this a link would have the inertia of its shape. In a call of its own, because PyBullet
        # 3.2.7 forgets both when maxJointVelocity comes along.
        across = [link.inertia, link.inertia, 0.0]
        pybullet.changeDynamics(
            body, index, localInertiaDiagonal=across, jointDamping=link.damping, physicsClientId=client
        )
        # PyBullet brakes every joint with a velocity motor unless told otherwise.
        pybullet.setJointMotorControl2(body, index, pybullet.VELOCITY_CONTROL, force=0.0, physicsClientId=client)
    return body


def _make_elastic(body: int, link: int, stiffness: float, client: int) -> None:
    """A spring without damping or friction. Bullet takes it for one only if both bodies have a stiffness."""
    pybullet.changeDynamics(
        body,
        link,
        contactStiffness=stiffness,
        contactDamping=0.0,
        lateralFriction=0.0,
        spinningFriction=0.0,
        rollingFriction=0.0,
        restitution=0.0,
        physicsClientId=client,
    )
