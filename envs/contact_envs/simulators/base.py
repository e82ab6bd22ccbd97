"""What the environment asks of a physics engine."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from contact_envs.dynamics import CartPoleParameters


class Simulator(ABC):
    """A cart-pole between two soft walls inside a physics engine.

    The contact is the engine's own: a sphere at the pole's tip against a compliant wall. Only that pair
    collides, and neither friction nor damping acts anywhere.

    A simulator is a function of the last ``reset`` and the forces since: the same calls give the same
    numbers, bit for bit, whatever ran before. Several simulators in one process do not disturb each other.

    :param parameters: of the plant
    :param physics_step: s, the engine's own time step
    :param substeps: physics steps in a control step
    :param viewer: open the engine's own window (see :meth:`show`)
    """

    def __init__(
        self, parameters: CartPoleParameters, physics_step: float, substeps: int, viewer: bool = False
    ) -> None:
        self.parameters = parameters
        self.physics_step = physics_step
        self.substeps = substeps
        self.viewer = viewer

    @abstractmethod
    def reset(self, state: NDArray[np.float64]) -> None:
        """Start from a state.

        :param state: (4,) x, x_dot, theta, theta_dot; SI units
        """

    @abstractmethod
    def step(self, force: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Advance by one control step under a constant force.

        :param force: horizontal force on the cart, N
        :return: the state (4,) at the end, and the forces (2,) of the right and left wall on the tip in N, as
            the engine's contact solver found them, averaged over the control step; both >= 0
        """

    @abstractmethod
    def show(self) -> None:
        """Bring the engine's window up to date; only with ``viewer=True``."""

    @abstractmethod
    def close(self) -> None:
        """Give back what the engine holds. Closing twice is harmless."""
