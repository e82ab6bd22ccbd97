"""What the environment asks of a physics engine."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from contact_envs.plants import Plant


class Simulator(ABC):
    """A plant inside a physics engine, built from its :meth:`~contact_envs.plants.Plant.mechanism`.

    Walls are the engine's own contact: a sphere at the last link's tip against a compliant wall, the only
    pair that collides. A joint's stops are a spring's torque, computed by the engine's blocks or next to it
    from the state at the beginning of each physics step: an engine's own joint limits are as hard as its time
    step allows, not as soft as one asks for. There is no friction anywhere.

    A simulator is a function of the last ``reset`` and the forces since: the same calls give the same
    numbers, bit for bit, whatever ran before. Several simulators in one process do not disturb each other.

    :param parameters: of the plant
    :param physics_step: s, the engine's own time step
    :param substeps: physics steps in a control step
    :param viewer: open the engine's own window (see :meth:`show`)
    """

    def __init__(self, parameters: Plant, physics_step: float, substeps: int, viewer: bool = False) -> None:
        self.parameters = parameters
        self.physics_step = physics_step
        self.substeps = substeps
        self.viewer = viewer

    @abstractmethod
    def reset(self, state: NDArray[np.float64]) -> None:
        """Start from a state.

        :param state: (4,) in the plant's order, SI units
        """

    @abstractmethod
    def step(self, force: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Advance by one control step under a constant force.

        :param force: of the actuator, N or N m
        :return: the state (4,) at the end, and the forces (2,) of the right and the left contact in N or N m,
            as they acted in the engine, averaged over the control step; both >= 0
        """

    @abstractmethod
    def show(self) -> None:
        """Bring the engine's window up to date; only with ``viewer=True``."""

    @abstractmethod
    def close(self) -> None:
        """Give back what the engine holds. Closing twice is harmless."""
