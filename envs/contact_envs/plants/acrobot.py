"""The acrobot with soft joint limits.

Two links in a vertical plane: the upper one (as in *upper arm*) hangs on a shoulder that is fixed and free to
turn, the lower one on an elbow with a motor. The state is ``s = (theta_1, theta_2, theta_1_dot,
theta_2_dot)``: the upper link's angle from upright, the lower link's relative to the upper one's, both
positive towards +x; zero is both links balanced upright. With masses ``m_i``, distances ``l_ci`` from the
joint to the mass centre, inertias ``I_i`` about it, the upper link's length ``l_1`` and the joints' damping
``b``, the motor's torque ``u`` and the stops' torques ``lam_right, lam_left >= 0``, Lagrange's equations
read::

    M(q) q_ddot + C(q, q_dot) q_dot - G(q) + b q_dot = (f, u)

    M = [[J_1 + J_2 + m_2 l_1^2 + 2 h cos(theta_2), J_2 + h cos(theta_2)],    J_i = I_i + m_i l_ci^2
         [J_2 + h cos(theta_2),                     J_2                 ]]    h   = m_2 l_1 l_c2
    C q_dot = h sin(theta_2) (-2 theta_1_dot theta_2_dot - theta_2_dot^2, theta_1_dot^2)
    G = g ((m_1 l_c1 + m_2 l_1) sin(theta_1) + m_2 l_c2 sin(theta_1 + theta_2), m_2 l_c2 sin(theta_1 + theta_2))

    f = lam_left - lam_right
    lam_right = k max(0,  theta_1 - w)
    lam_left  = k max(0, -theta_1 - w)

The stops are at the shoulder, which has no motor: they are what the acrobot can lean on. Two-element arrays of
the stops are ordered (right stop at +w, left stop at -w) everywhere.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_envs.plants.base import Linearisation, Plant
from contact_envs.plants.mechanism import JointStops, Link, Mechanism

__all__ = ["AcrobotParameters"]


@dataclasses.dataclass(frozen=True)
class AcrobotParameters(Plant):
    """Physical constants of the acrobot, SI units.

    Masses, lengths, the limits' joint and their angle are those of the acrobot with soft joint limits of
    Aydinoglu, Preciado and Posa, "Contact-aware controller design for complementarity systems" (ICRA 2020),
    as in its published code, which has point masses at the links' ends and no damping. Its stiffness of
    1 N m/rad holds up nothing (gravity alone is 17 N m/rad); here the stops are stiff.

    :param upper_mass: kg
    :param upper_length: m, from the shoulder to the elbow
    :param upper_mass_centre: m, from the shoulder
    :param upper_inertia: kg m^2, about the mass centre; zero is allowed
    :param lower_mass: kg
    :param lower_length: m, from the elbow to the end, for pictures: it does not change the motion
    :param lower_mass_centre: m, from the elbow
    :param lower_inertia: kg m^2, about the mass centre; zero is allowed
    :param damping: N m s/rad, viscous, of either joint; zero is allowed
    :param limit_angle: rad, of the upper link, where each stop begins to push
    :param limit_stiffness: N m/rad
    :param gravity: m/s^2, downwards; zero is allowed
    :raises TypeError: a value is not a real number
    :raises ValueError: a value is not finite, or not positive
    """

    STATE: ClassVar = ("theta_1", "theta_2", "theta_1_dot", "theta_2_dot")
    POSITIONS: ClassVar = (0, 1)
    VELOCITIES: ClassVar = (2, 3)
    MAY_BE_ZERO: ClassVar = ("upper_inertia", "lower_inertia", "damping", "gravity")

    upper_mass: float = 0.5
    upper_length: float = 0.5
    upper_mass_centre: float = 0.5
    upper_inertia: float = 0.0
    lower_mass: float = 1.0
    lower_length: float = 1.0
    lower_mass_centre: float = 1.0
    lower_inertia: float = 0.0
    damping: float = 0.0
    limit_angle: float = 0.2
    limit_stiffness: float = 300.0
    gravity: float = 9.81

    @property
    def contact_stiffness(self) -> float:
        """Of both stops, N m/rad."""
        return self.limit_stiffness

    def contact_gaps(self, state: ArrayLike) -> NDArray[np.float64]:
        """From the upper link to the right and the left stop, rad: (..., 4) -> (..., 2)."""
        shoulder = np.asarray(state, dtype=np.float64)[..., 0]
        return self.limit_angle - np.stack([shoulder, -shoulder], axis=-1)

    def equations_of_motion(self, state: ArrayLike, force: ArrayLike) -> NDArray[np.float64]:
        """Time derivative of the state.

        :param state: (..., 4) theta_1, theta_2 (rad), theta_1_dot, theta_2_dot (rad/s)
        :param force: (...) the motor's torque on the lower link, N m
        :return: (..., 4) d state / dt
        """
        state = np.asarray(state, dtype=np.float64)
        stops = self.contact_forces(state)
        theta_2, dot_1, dot_2 = state[..., 1], state[..., 2], state[..., 3]
        sin, cos = np.sin(theta_2), np.cos(theta_2)

        coupling = self.lower_mass * self.upper_length * self.lower_mass_centre
        on_upper, on_lower = self._gravity_torques(state)
        on_upper = on_upper + stops[..., 1] - stops[..., 0] - self.damping * dot_1
        on_upper = on_upper + coupling * sin * (2.0 * dot_1 * dot_2 + dot_2**2)
        on_lower = on_lower + np.asarray(force) - self.damping * dot_2 - coupling * sin * dot_1**2

        upper, both, lower = self._inertias(cos)
        determinant = upper * lower - both**2
        ddot_1 = (lower * on_upper - both * on_lower) / determinant
        ddot_2 = (upper * on_lower - both * on_upper) / determinant
        return np.stack(np.broadcast_arrays(dot_1, dot_2, ddot_1, ddot_2), axis=-1)

    def mechanical_energy(self, state: ArrayLike) -> NDArray[np.float64]:
        """Kinetic energy, gravity and what the stops store, J: (..., 4) -> (...)."""
        state = np.asarray(state, dtype=np.float64)
        theta_1, theta_2, dot_1, dot_2 = np.moveaxis(state, -1, 0)
        upper, both, lower = self._inertias(np.cos(theta_2))
        kinetic = 0.5 * upper * dot_1**2 + both * dot_1 * dot_2 + 0.5 * lower * dot_2**2
        on_upper, on_lower = self._moments()
        gravity = self.gravity * (on_upper * np.cos(theta_1) + on_lower * np.cos(theta_1 + theta_2))
        stops = (self.contact_forces(state) ** 2).sum(axis=-1) / (2.0 * self.limit_stiffness)
        return kinetic + gravity + stops

    def linearisation(self) -> Linearisation:
        """About both links upright, at rest."""
        upper, both, lower = (float(entry) for entry in self._inertias(np.ones(())))
        on_upper, on_lower = (self.gravity * moment for moment in self._moments())
        return Linearisation(
            mass=np.array([[upper, both], [both, lower]]),
            # Columns: theta_1, theta_2, theta_1_dot, theta_2_dot, torque, right stop, left stop.
            loads=np.array(
                [
                    [on_upper + on_lower, on_lower, -self.damping, 0.0, 0.0, -1.0, 1.0],
                    [on_lower, on_lower, 0.0, -self.damping, 1.0, 0.0, 0.0],
                ]
            ),
            gaps=np.array([[-1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]),
        )

    def mechanism(self) -> Mechanism:
        """Two rods on hinges; the stops act on the first."""
        return Mechanism(
            links=(
                Link(
                    "upper",
                    "hinge",
                    height=0.0,
                    mass=self.upper_mass,
                    mass_centre=self.upper_mass_centre,
                    inertia=self.upper_inertia,
                    damping=self.damping,
                    length=self.upper_length,
                ),
                Link(
                    "lower",
                    "hinge",
                    height=self.upper_length,
                    mass=self.lower_mass,
                    mass_centre=self.lower_mass_centre,
                    inertia=self.lower_inertia,
                    damping=self.damping,
                    length=self.lower_length,
                ),
            ),
            actuated=1,
            contact=JointStops(self.limit_angle, self.limit_stiffness),
            gravity=self.gravity,
        )

    def _inertias(self, cos: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """M_11, M_12 and M_22 of the mass matrix, for the cosine of theta_2."""
        upper = self.upper_inertia + self.upper_mass * self.upper_mass_centre**2
        lower = self.lower_inertia + self.lower_mass * self.lower_mass_centre**2
        coupling = self.lower_mass * self.upper_length * self.lower_mass_centre * cos
        carried = self.lower_mass * self.upper_length**2
        return upper + lower + carried + 2.0 * coupling, lower + coupling, lower + 0.0 * cos

    def _moments(self) -> tuple[float, float]:
        """Mass times height above the shoulder, of what turns with the upper link and with the lower one, kg m."""
        carried = self.upper_mass * self.upper_mass_centre + self.lower_mass * self.upper_length
        return carried, self.lower_mass * self.lower_mass_centre

    def _gravity_torques(self, state: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """About the shoulder and about the elbow, N m."""
        on_upper, on_lower = self._moments()
        of_lower = self.gravity * on_lower * np.sin(state[..., 0] + state[..., 1])
        return self.gravity * on_upper * np.sin(state[..., 0]) + of_lower, of_lower
