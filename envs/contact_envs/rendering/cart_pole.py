"""The cart-pole between its walls."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from contact_envs.plants import CartPoleParameters
from contact_envs.rendering.canvas import (
    CONTACT_FORCE,
    FAINT_INK,
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
)

_GROUND, _RAIL = (226, 230, 235), (120, 130, 142)
_CART, _WHEEL = (52, 73, 94), (30, 41, 54)

_CART_SIZE = (0.26, 0.10)  # m, the cart's body; the rail is under its wheels
_FOAM_DEPTH = 0.22  # m, from a wall's face to the plate that holds it
_DENT_WIDTH = 0.06  # m
_FULL_RED = 0.08  # m, how deep a dent is as red as it gets
_FORCE_ARROW = 0.4  # m, at max_force
_WALL_ARROW = 0.25  # m, at the force of a 5 cm dent


class CartPoleScene:
    """See :class:`~contact_envs.rendering.scene.Scene`."""

    def __init__(self, parameters: CartPoleParameters) -> None:
        self.parameters = parameters
        half_width = max(2.0 * parameters.pole_length, parameters.wall_distance + parameters.pole_length)
        self.canvas = Canvas(half_width, origin_height=0.77)

    def draw_surroundings(self, state: NDArray[np.float64]) -> None:
        _draw_ground(self.canvas)
        _draw_walls(self.canvas, state, self.parameters)

    def draw_plan(self, plan: NDArray[np.float64]) -> None:
        _draw_plan(self.canvas, plan, self.parameters)

    def draw_plant(self, state: NDArray[np.float64], force: float, max_force: float) -> None:
        _draw_cart_pole(self.canvas, state, self.parameters)
        _draw_forces(self.canvas, state, self.parameters, force, max_force)

    def readings(self, state: NDArray[np.float64]) -> tuple[str, str]:
        x, x_dot, theta, theta_dot = (float(value) for value in state)
        return f"x = {x:+.3f} m   {x_dot:+.2f} m/s", f"angle = {theta:+.3f} rad   {theta_dot:+.2f} rad/s"


def _tip(state: NDArray[np.float64], parameters: CartPoleParameters) -> Point:
    return float(parameters.tip_position(state)), parameters.pole_length * math.cos(state[2])


def _draw_ground(canvas: Canvas) -> None:
    edge, rail = canvas.half_width, -0.5 * _CART_SIZE[1] - 0.04
    canvas.box(-edge, -edge, edge, rail, _GROUND)
    canvas.line([(-edge, rail), (edge, rail)], 0.010, _RAIL)
    ticks = math.floor(edge / 0.5)
    for tick in range(-ticks, ticks + 1):
        x = 0.5 * tick
        canvas.line([(x, rail), (x, rail - 0.03)], 0.006, _RAIL)
        canvas.text((x, rail - 0.065), f"{x:g} m" if tick == 0 else f"{x:+g}", 12, FAINT_INK)


def _draw_walls(canvas: Canvas, state: NDArray[np.float64], parameters: CartPoleParameters) -> None:
    tip_x, tip_z = _tip(state, parameters)
    bottom, top = 0.3 * parameters.pole_length, 1.2 * parameters.pole_length
    heights = np.linspace(bottom, top, 121)
    face = parameters.wall_distance + parameters.tip_radius
    for side in (1.0, -1.0):
        depth = max(0.0, side * tip_x - parameters.wall_distance)
        plate = face + max(_FOAM_DEPTH, depth + 0.05)
        dent = depth * np.exp(-(((heights - tip_z) / _DENT_WIDTH) ** 2))
        outline = [(side * (face + float(d)), float(z)) for d, z in zip(dent, heights, strict=True)]
        # In strips, so that the foam reddens where it is pressed.
        for (low, high), squeeze in zip(pairwise(outline), dent, strict=False):
            colour = mixed(FOAM, PRESSED_FOAM, min(1.0, float(squeeze) / _FULL_RED))
            canvas.polygon([low, high, (side * plate, high[1]), (side * plate, low[1])], colour)
        canvas.line(outline, 0.008, FOAM_EDGE)
        left, right = sorted((side * plate, side * (plate + 0.025)))
        canvas.box(left, -0.5 * _CART_SIZE[1] - 0.04, right, top, PLATE)


def _draw_cart_pole(
    canvas: Canvas, state: NDArray[np.float64], parameters: CartPoleParameters, opacity: int = 255
) -> None:
    x, theta = float(state[0]), float(state[2])
    width, height = _CART_SIZE
    for side in (-1.0, 1.0):
        canvas.disc((x + side * 0.3 * width, -0.5 * height - 0.005), 0.035, (*_WHEEL, opacity))
    canvas.box(x - 0.5 * width, -0.5 * height, x + 0.5 * width, 0.5 * height, (*_CART, opacity), corner=0.02)
    tip = _tip(state, parameters)
    centre = (
        x + parameters.mass_centre * math.sin(theta),
        parameters.mass_centre * math.cos(theta),
    )
    canvas.line([(x, 0.0), tip], 0.022, (*LINK, opacity))
    canvas.disc(centre, 0.024, (*LINK, opacity))
    canvas.disc(tip, parameters.tip_radius, (*JOINT, opacity))
    canvas.disc((x, 0.0), 0.017, (*SKY, opacity))


def _draw_plan(canvas: Canvas, plan: NDArray[np.float64], parameters: CartPoleParameters) -> None:
    _draw_cart_pole(canvas, plan[-1], parameters, opacity=70)
    path = [_tip(state, parameters) for state in plan]
    if len(path) > 1:
        canvas.line(path, 0.010, (*PLAN, 150))
    for point in path:
        canvas.disc(point, 0.011, PLAN)


def _draw_forces(
    canvas: Canvas,
    state: NDArray[np.float64],
    parameters: CartPoleParameters,
    force: float,
    max_force: float,
) -> None:
    if force != 0.0:
        side = math.copysign(1.0, force)
        start = (float(state[0]) + side * (0.5 * _CART_SIZE[0] + 0.01), 0.0)
        length = side * max(_FORCE_ARROW * min(1.0, abs(force) / max_force), 0.02)
        canvas.arrow(start, length, FORCE)
        canvas.text((start[0] + 0.5 * length, 0.5 * _CART_SIZE[1] + 0.03), f"{abs(force):.1f} N", 13, FORCE)
    tip_x, tip_z = _tip(state, parameters)
    for side, push in zip((1.0, -1.0), parameters.contact_forces(state), strict=True):
        if push > 0.0:
            length = -side * max(_WALL_ARROW * float(push) / (0.05 * parameters.wall_stiffness), 0.03)
            start = (tip_x - side * (parameters.tip_radius + 0.005), tip_z)
            canvas.arrow(start, length, CONTACT_FORCE)
            canvas.text((start[0] + 0.5 * length, tip_z + 0.06), f"{push:.1f} N", 13, CONTACT_FORCE)
