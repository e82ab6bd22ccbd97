"""What the environments, the simulators and the reference computations ask of a plant."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_envs._validation import non_negative, positive
from contact_envs.plants.mechanism import Mechanism

__all__ = ["Linearisation", "Plant"]


class Linearisation(NamedTuple):
    """The equations of motion to first order about upright: ``mass @ accelerations = loads @ (s, u, lam)``.

    With n_q joints, n_x = 2 n_q states and n_lambda contacts: mass (n_q, n_q), loads (n_q, n_x + 1 + n_lambda),
    and gaps (n_lambda, n_x), the derivative of the gaps with respect to the state.
    """

    mass: NDArray[np.float64]
    loads: NDArray[np.float64]
    gaps: NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Plant(ABC):
    """Physical constants of a mechanism, SI units, and what follows from them.

    A plant has one actuator, and contacts that push one way: each is a spring whose force is
    ``contact_stiffness`` times the penetration, and zero without. "Force" means the generalised force, in N
    for a joint that slides, in N m for a hinge. A sub-class is a frozen dataclass of numbers; each must be
    positive, or not negative where ``MAY_BE_ZERO`` names it.

    :raises TypeError: a value is not a real number
    :raises ValueError: a value is not finite, or not positive
    """

    STATE: ClassVar[tuple[str, ...]]
    """Names of the state's components, in order."""
    POSITIONS: ClassVar[tuple[int, ...]]
    """Where the joints' positions stand in the state, in the order of the mechanism's links."""
    VELOCITIES: ClassVar[tuple[int, ...]]
    """Where the joints' velocities stand in the state."""
    MAY_BE_ZERO: ClassVar[tuple[str, ...]]

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            check = non_negative if field.name in self.MAY_BE_ZERO else positive
            object.__setattr__(self, field.name, check(field.name, getattr(self, field.name)))

    @property
    @abstractmethod
    def contact_stiffness(self) -> float:
        """Of every contact's spring: N/m, or N m/rad where gaps are angles."""

    @abstractmethod
    def contact_gaps(self, state: ArrayLike) -> NDArray[np.float64]:
        """How far each contact is from touching; below zero: how deep it is.

        :param state: (..., n_x)
        :return: (..., n_lambda) m, or rad
        """

    def contact_forces(self, state: ArrayLike) -> NDArray[np.float64]:
        """How hard each contact pushes: a one-sided spring, zero without contact.

        :param state: (..., n_x)
        :return: (..., n_lambda) N or N m, >= 0
        """
        return self.contact_stiffness * np.maximum(-self.contact_gaps(state), 0.0)

    @abstractmethod
    def equations_of_motion(self, state: ArrayLike, force: ArrayLike) -> NDArray[np.float64]:
        """Time derivative of the state.

        :param state: (..., n_x)
        :param force: (...) the actuator's, N or N m
        :return: (..., n_x) d state / dt
        """

    @abstractmethod
    def mechanical_energy(self, state: ArrayLike) -> NDArray[np.float64]:
        """Kinetic energy, gravity and what the contacts store, J: constant while nothing drives or brakes.

        :param state: (..., n_x)
        :return: (...)
        """

    @abstractmethod
    def linearisation(self) -> Linearisation:
        """About the upright position at rest, where nothing touches."""

    @abstractmethod
    def mechanism(self) -> Mechanism:
        """What a physics engine is to build."""
