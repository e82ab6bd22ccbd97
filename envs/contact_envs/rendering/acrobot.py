"""The acrobot between the stops at its shoulder."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from contact_envs.plants import AcrobotParameters
from contact_envs.rendering.canvas import (
    CONTACT_FORCE,
    FOAM,
    FOAM_EDGE,
    FORCE,
    JOINT,
    LINK,
    PLAN,
    PLATE,
    PRESSED_FOAM,
    SKY,
    Canvas,
    Point,
    mixed,
    on_circle,
)

_LINK_WIDTH = 0.035  # m
_FOAM_ANGLE = 0.35  # rad, from a stop's face to the plate that holds it
_FULL_RED = 0.08  # rad, how far a stop is pressed when it is as red as it gets
_FORCE_ARROW = 2.0  # rad, at max_force
_STOP_ARROW = 1.0  # rad, at the torque of a stop that is pressed by 0.05 rad


class AcrobotScene:
    """See :class:`~contact_envs.rendering.scene.Scene`."""

    def __init__(self, parameters: AcrobotParameters) -> None:
        self.parameters = parameters
        self._reach = parameters.upper_length + parameters.lower_length
        self._foam_radius = 0.55 * parameters.upper_length
        self.canvas = Canvas(1.15 * self._reach, origin_height=0.9)

    def draw_surroundings(self, state: NDArray[np.float64]) -> None:
        """The stops: a sector of foam at either side, pressed in as far as the link stands in it."""
        half_a_link = math.asin(min(1.0, 0.5 * _LINK_WIDTH / self._foam_radius))
        for side in (1.0, -1.0):
            depth = max(0.0, side * float(state[0]) - self.parameters.limit_angle)
            face = self.parameters.limit_angle + depth + half_a_link
            plate = max(self.parameters.limit_angle + half_a_link + _FOAM_ANGLE, face + 0.1)
            colour = mixed(FOAM, PRESSED_FOAM, min(1.0, depth / _FULL_RED))
            rim = [self._on_foam(side * float(angle)) for angle in np.linspace(face, plate, 24)]
            self.canvas.polygon([(0.0, 0.0), *rim], colour)
            self.canvas.line([(0.0, 0.0), rim[0]], 0.010, FOAM_EDGE)
            self.canvas.line([(0.0, 0.0), rim[-1]], 0.025, PLATE)
        self.canvas.box(-0.12, -0.10, 0.12, 0.0, PLATE, corner=0.03)

    def draw_plan(self, plan: NDArray[np.float64]) -> None:
        self._draw_links(plan[-1], opacity=70)
        path = [self._end(state) for state in plan]
        if len(path) > 1:
            self.canvas.line(path, 0.014, (*PLAN, 150))
        for point in path:
            self.canvas.disc(point, 0.014, PLAN)

    def draw_plant(self, state: NDArray[np.float64], force: float, max_force: float) -> None:
        self._draw_links(state)
        if force != 0.0:
            elbow, lean = self._elbow(state), float(state[0] + state[1])
            sweep = math.copysign(max(_FORCE_ARROW * min(1.0, abs(force) / max_force), 0.3), force)
            self.canvas.arc_arrow(elbow, 0.14, lean - 0.5 * sweep, sweep, FORCE)
            self.canvas.text(on_circle(elbow, 0.30, 0.5 * math.pi), f"{abs(force):.1f} N m", 13, FORCE)
        for side, push in zip((1.0, -1.0), self.parameters.contact_forces(state), strict=True):
            if push > 0.0:
                relative = float(push) / (0.05 * self.parameters.limit_stiffness)
                sweep = -side * max(_STOP_ARROW * min(2.0, relative), 0.3)
                radius = self._foam_radius + 0.05
                self.canvas.arc_arrow((0.0, 0.0), radius, float(state[0]), sweep, CONTACT_FORCE)
                label = on_circle((0.0, 0.0), radius + 0.2, -side * 1.2)
                self.canvas.text(label, f"{push:.1f} N m", 13, CONTACT_FORCE)

    def readings(self, state: NDArray[np.float64]) -> tuple[str, str]:
        upper, lower, upper_dot, lower_dot = (float(value) for value in state)
        return (
            f"shoulder = {upper:+.3f} rad   {upper_dot:+.2f} rad/s",
            f"elbow = {lower:+.3f} rad   {lower_dot:+.2f} rad/s",
        )

    def _draw_links(self, state: NDArray[np.float64], opacity: int = 255) -> None:
        elbow, end = self._elbow(state), self._end(state)
        self.canvas.line([(0.0, 0.0), elbow], _LINK_WIDTH, (*LINK, opacity))
        self.canvas.line([elbow, end], 0.7 * _LINK_WIDTH, (*LINK, opacity))
        lower_centre = on_circle(elbow, self.parameters.lower_mass_centre, float(state[0] + state[1]))
        upper_centre = on_circle((0.0, 0.0), self.parameters.upper_mass_centre, float(state[0]))
        for centre, mass in ((upper_centre, self.parameters.upper_mass), (lower_centre, self.parameters.lower_mass)):
            share = mass / (self.parameters.upper_mass + self.parameters.lower_mass)
            self.canvas.disc(centre, 0.06 * math.sqrt(share), (*JOINT, opacity))
        for joint in ((0.0, 0.0), elbow):
            self.canvas.disc(joint, 0.020, (*SKY, opacity))

    def _elbow(self, state: NDArray[np.float64]) -> Point:
        return on_circle((0.0, 0.0), self.parameters.upper_length, float(state[0]))

    def _end(self, state: NDArray[np.float64]) -> Point:
        return on_circle(self._elbow(state), self.parameters.lower_length, float(state[0] + state[1]))

    def _on_foam(self, angle: float) -> Point:
        return on_circle((0.0, 0.0), self._foam_radius, angle)
