"""The cart-pole in PyBullet: a multibody in reduced coordinates with spring contact."""

from __future__ import annotations

import ctypes
import os
import sys
import weakref

import numpy as np
from numpy.typing import NDArray

from contact_envs.dynamics import CartPoleParameters
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

CART, POLE = 0, 1  # joints, and the links they carry


class PyBulletSimulator(Simulator):
    """See :class:`Simulator`. Each one has a physics server of its own."""

    def __init__(
        self, parameters: CartPoleParameters, physics_step: float, substeps: int, viewer: bool = False
    ) -> None:
        super().__init__(parameters, physics_step, substeps, viewer)
        self._client = _open_window() if viewer else pybullet.connect(pybullet.DIRECT)
        # Also for a simulator that nobody closed: a process has a limited number of servers.
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self._client)
        pybullet.setGravity(0.0, 0.0, -parameters.gravity, physicsClientId=self._client)
        # Without warm starts, so that no contact of the last episode can reach into the next one.
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=physics_step,
            warmStartingFactor=0.0,
            physicsClientId=self._client,
        )
        self._walls = [_add_wall(parameters, side, viewer, self._client) for side in (1.0, -1.0)]
        self._cart_pole = _add_cart_pole(parameters, viewer, self._client)

    def reset(self, state: NDArray[np.float64]) -> None:
        x, x_dot, theta, theta_dot = state.tolist()
        pybullet.resetJointState(self._cart_pole, CART, x, x_dot, physicsClientId=self._client)
        pybullet.resetJointState(self._cart_pole, POLE, theta, theta_dot, physicsClientId=self._client)

    def step(self, force: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        client, body = self._client, self._cart_pole
        total = [0.0, 0.0]
        for _ in range(self.substeps):
            pybullet.setJointMotorControl2(body, CART, pybullet.TORQUE_CONTROL, force=force, physicsClientId=client)
            pybullet.stepSimulation(physicsClientId=client)
            for contact in pybullet.getContactPoints(body, physicsClientId=client):
                total[self._walls.index(contact[2])] += contact[9]
        (x, x_dot, *_), (theta, theta_dot, *_) = pybullet.getJointStates(body, (CART, POLE), physicsClientId=client)
        return np.array([x, x_dot, theta, theta_dot]), np.array(total) / self.substeps

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


def _add_wall(parameters: CartPoleParameters, side: float, visible: bool, client: int) -> int:
    """A fixed half-space whose face the tip's sphere touches when its centre is at the wall."""
    shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, planeNormal=[-side, 0.0, 0.0], physicsClientId=client)
    look = -1
    if visible:
        look = pybullet.createVisualShape(
            pybullet.GEOM_BOX,
            halfExtents=[0.05, 0.15, 0.3],
            visualFramePosition=[side * 0.05, 0.0, parameters.pole_length],
            rgbaColor=WALL_COLOUR,
            physicsClientId=client,
        )
    face = side * (parameters.wall_distance + parameters.tip_radius)
    wall = pybullet.createMultiBody(
        baseCollisionShapeIndex=shape,
        baseVisualShapeIndex=look,
        basePosition=[face, 0.0, 0.0],
        physicsClientId=client,
    )
    _make_elastic(wall, -1, parameters.wall_stiffness, client)
    return wall


def _cart_pole_looks(parameters: CartPoleParameters, client: int) -> list[int]:
    """What the window shows of the cart and the pole; nothing here touches the physics."""
    cart = pybullet.createVisualShape(
        pybullet.GEOM_BOX, halfExtents=[0.12, 0.08, 0.05], rgbaColor=CART_COLOUR, physicsClientId=client
    )
    pole = pybullet.createVisualShape(
        pybullet.GEOM_CYLINDER,
        radius=0.4 * parameters.tip_radius,
        length=parameters.pole_length,
        visualFramePosition=[0.0, 0.0, 0.5 * parameters.pole_length],
        rgbaColor=POLE_COLOUR,
        physicsClientId=client,
    )
    return [cart, pole]


def _add_cart_pole(parameters: CartPoleParameters, visible: bool, client: int) -> int:
    """Cart on a rail along x, pole on a hinge about y, both point masses, and the tip's sphere."""
    tip = pybullet.createCollisionShape(
        pybullet.GEOM_SPHERE,
        radius=parameters.tip_radius,
        collisionFramePosition=[0.0, 0.0, parameters.pole_length],
        physicsClientId=client,
    )
    centre = [0.0, 0.0, parameters.mass_centre]
    origin, upright = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
    body = pybullet.createMultiBody(
        baseMass=0.0,
        linkMasses=[parameters.cart_mass, parameters.pole_mass],
        linkCollisionShapeIndices=[-1, tip],
        linkVisualShapeIndices=_cart_pole_looks(parameters, client) if visible else [-1, -1],
        linkPositions=[origin, origin],
        linkOrientations=[upright, upright],
        linkInertialFramePositions=[origin, centre],
        linkInertialFrameOrientations=[upright, upright],
        linkParentIndices=[0, 1],
        linkJointTypes=[pybullet.JOINT_PRISMATIC, pybullet.JOINT_REVOLUTE],
        linkJointAxis=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        physicsClientId=client,
    )
    for link in (CART, POLE):
        pybullet.changeDynamics(
            body,
            link,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            maxJointVelocity=MAX_JOINT_VELOCITY,
            physicsClientId=client,
        )
        # Point masses: without this the pole would have the inertia of its sphere. In a call of its own,
        # because PyBullet 3.2.7 forgets it when maxJointVelocity comes along.
        pybullet.changeDynamics(body, link, localInertiaDiagonal=[0.0, 0.0, 0.0], physicsClientId=client)
    for joint in (CART, POLE):  # PyBullet brakes every joint with a velocity motor unless told otherwise
        pybullet.setJointMotorControl2(body, joint, pybullet.VELOCITY_CONTROL, force=0.0, physicsClientId=client)
    _make_elastic(body, POLE, parameters.wall_stiffness * TIP_STIFFNESS_RATIO, client)
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
