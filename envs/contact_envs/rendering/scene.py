"""What a plant's picture is made of."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from contact_envs.rendering.canvas import Canvas

__all__ = ["Scene"]


class Scene(Protocol):
    """Draws one kind of plant on a canvas, from the back to the front."""

    canvas: Canvas

    def draw_surroundings(self, state: NDArray[np.float64]) -> None:
        """What the plant touches; ``state`` is (4,)."""

    def draw_plan(self, plan: NDArray[np.float64]) -> None:
        """The path of the tip through ``plan``, (H+1, 4), and the plant where it ends."""

    def draw_plant(self, state: NDArray[np.float64], force: float, max_force: float) -> None:
        """The plant in ``state``, (4,), and arrows for the actuator's force and the contacts', N or N m."""

    def readings(self, state: NDArray[np.float64]) -> tuple[str, str]:
        """Two lines of numbers."""
