"""The cart-pole between two soft walls.

The pole is a massless rod of length ``l`` that carries a point mass ``m_p`` at distance ``l_c`` from its
hinge on the cart (mass ``m_c``). Nothing dissipates energy. With the state ``s = (x, x_dot, theta,
theta_dot)``, ``theta = 0`` upright and positive towards +x, the horizontal force ``u`` on the cart and the
wall forces ``lam_right, lam_left >= 0`` on the pole's tip, Lagrange's equations read::

    (m_c + m_p) x_ddot + m_p l_c (cos(theta) theta_ddot - sin(theta) theta_dot^2) = u + f
    m_p l_c cos(theta) x_ddot + m_p l_c^2 theta_ddot - m_p g l_c sin(theta)       = l cos(theta) f

    f = lam_left - lam_right
    lam_right = k max(0,  (x + l sin(theta)) - w)
    lam_left  = k max(0, -(x + l sin(theta)) - w)

This is the system every simulator backend approximates, and what the tests measure them against. Two-element
wall arrays are ordered (right wall at +w, left wall at -w) everywhere.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_envs.plants.base import Linearisation, Plant
from contact_envs.plants.mechanism import Link, Mechanism, TipWalls

__all__ = ["CartPoleParameters"]


@dataclasses.dataclass(frozen=True)
class CartPoleParameters(Plant):
    """Physical constants of the cart-pole, SI units.

    Masses, lengths and the wall distance are those of the public C3 cart-pole example; the wall stiffness is
    the paper's (section IV-A).

    :param cart_mass: kg
    :param pole_mass: kg, concentrated at ``mass_centre``
    :param pole_length: m, from the hinge to the tip, which is what the walls touch
    :param mass_centre: m, from the hinge to the point mass
    :param wall_distance: m, from the origin to each wall: contact starts when the tip's centre is this far
        out
    :param wall_stiffness: N/m
    :param gravity: m/s^2, downwards; zero is allowed
    :param tip_radius: m, radius of the sphere at the tip in the simulators and in pictures. The walls' faces
        stand this much further out, so it does not change the motion.
    :raises TypeError: a value is not a real number
    :raises ValueError: a value is not finite, or not positive
    """

    STATE: ClassVar = ("x", "x_dot", "theta", "theta_dot")
    POSITIONS: ClassVar = (0, 2)
    VELOCITIES: ClassVar = (1, 3)
    MAY_BE_ZERO: ClassVar = ("gravity",)

    cart_mass: float = 0.978
    pole_mass: float = 0.411
    pole_length: float = 0.6
    mass_centre: float = 0.4267
    wall_distance: float = 0.35
    wall_stiffness: float = 700.0
    gravity: float = 9.81
    tip_radius: float = 0.02

    @property
    def contact_stiffness(self) -> float:
        """Of both walls, N/m."""
        return self.wall_stiffness

    def tip_position(self, state: ArrayLike) -> NDArray[np.float64]:
        """Horizontal position of the pole's tip, m.

        :param state: (..., 4)
        :return: (...)
        """
        state = np.asarray(state, dtype=np.float64)
        return state[..., 0] + self.pole_length * np.sin(state[..., 2])

    def contact_gaps(self, state: ArrayLike) -> NDArray[np.float64]:
        """From the tip to the right and the left wall, m: (..., 4) -> (..., 2)."""
        tip = self.tip_position(state)
        return self.wall_distance - np.stack([tip, -tip], axis=-1)

    def equations_of_motion(self, state: ArrayLike, force: ArrayLike) -> NDArray[np.float64]:
        """Time derivative of the state.

        :param state: (..., 4) x (m), x_dot (m/s), theta (rad), theta_dot (rad/s)
        :param force: (...) horizontal force on the cart, N
        :return: (..., 4) d state / dt
        """
        state = np.asarray(state, dtype=np.float64)
        walls = self.contact_forces(state)
        contact = walls[..., 1] - walls[..., 0]
        x_dot, theta, theta_dot = state[..., 1], state[..., 2], state[..., 3]
        sin, cos = np.sin(theta), np.cos(theta)

        total = self.cart_mass + self.pole_mass
        moment = self.pole_mass * self.mass_centre
        inertia = moment * self.mass_centre
        on_x = np.asarray(force) + contact + moment * sin * theta_dot**2
        on_theta = self.gravity * moment * sin + self.pole_length * cos * contact

        determinant = total * inertia - (moment * cos) ** 2
        x_ddot = (inertia * on_x - moment * cos * on_theta) / determinant
        theta_ddot = (total * on_theta - moment * cos * on_x) / determinant
        return np.stack(np.broadcast_arrays(x_dot, x_ddot, theta_dot, theta_ddot), axis=-1)

    def mechanical_energy(self, state: ArrayLike) -> NDArray[np.float64]:
        """Kinetic energy, gravity and what the walls store, J: (..., 4) -> (...)."""
        state = np.asarray(state, dtype=np.float64)
        x_dot, theta, theta_dot = state[..., 1], state[..., 2], state[..., 3]
        moment = self.pole_mass * self.mass_centre
        kinetic = (
            0.5 * (self.cart_mass + self.pole_mass) * x_dot**2
            + moment * np.cos(theta) * x_dot * theta_dot
            + 0.5 * moment * self.mass_centre * theta_dot**2
        )
        gravity = moment * self.gravity * np.cos(theta)
        walls = (self.contact_forces(state) ** 2).sum(axis=-1) / (2.0 * self.wall_stiffness)
        return kinetic + gravity + walls

    def linearisation(self) -> Linearisation:
        """About upright, at rest in the middle."""
        moment, length = self.pole_mass * self.mass_centre, self.pole_length
        return Linearisation(
            mass=np.array([[self.cart_mass + self.pole_mass, moment], [moment, moment * self.mass_centre]]),
            # Columns: x, x_dot, theta, theta_dot, force, right wall, left wall.
            loads=np.array(
                [
                    [0.0, 0.0, 0.0, 0.0, 1.0, -1.0, 1.0],
                    [0.0, 0.0, moment * self.gravity, 0.0, 0.0, -length, length],
                ]
            ),
            gaps=np.array([[-1.0, 0.0, -length, 0.0], [1.0, 0.0, length, 0.0]]),
        )

    def mechanism(self) -> Mechanism:
        """A cart on a rail and a pole on it, both point masses; the walls touch a sphere at the pole's tip."""
        return Mechanism(
            links=(
                Link("cart", "slide", height=0.0, mass=self.cart_mass, mass_centre=0.0),
                Link(
                    "pole",
                    "hinge",
                    height=0.0,
                    mass=self.pole_mass,
                    mass_centre=self.mass_centre,
                    length=self.pole_length,
                ),
            ),
            actuated=0,
            contact=TipWalls(self.pole_length, self.tip_radius, self.wall_distance, self.wall_stiffness),
            gravity=self.gravity,
        )
