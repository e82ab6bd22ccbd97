"""Pictures of the cart-pole, drawn from its state alone: no display, no simulator, the same for every
engine."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_envs.dynamics import CartPoleParameters, tip_position, wall_forces

try:
    from PIL import Image, ImageDraw, ImageFont
except ImportError as error:
    raise ImportError("drawing needs Pillow: pip install pillow") from error

__all__ = ["HEIGHT", "WIDTH", "draw_scene"]

WIDTH, HEIGHT = 720, 400  # pixels
_OVERSAMPLING = 2  # drawn this many times larger and scaled down: Pillow does not smooth edges itself

Colour = tuple[int, ...]
Point = tuple[float, float]

_SKY, _GROUND, _RAIL = (247, 249, 251), (226, 230, 235), (120, 130, 142)
_INK, _FAINT_INK = (44, 52, 64), (138, 147, 158)
_CART, _WHEEL, _POLE, _TIP = (52, 73, 94), (30, 41, 54), (196, 98, 45), (150, 62, 22)
_FOAM, _PRESSED_FOAM, _FOAM_EDGE = (247, 203, 77), (231, 76, 60), (176, 138, 40)
_PLATE = (160, 168, 178)
_FORCE, _WALL_FORCE, _PLAN = (41, 121, 201), (192, 40, 45), (14, 140, 120)

_CART_SIZE = (0.26, 0.10)  # m, the cart's body; the rail is under its wheels
_FOAM_DEPTH = 0.22  # m, from a wall's face to the plate that holds it
_DENT_WIDTH = 0.06  # m
_FULL_RED = 0.08  # m, how deep a dent is as red as it gets
_FORCE_ARROW = 0.4  # m, at max_force
_WALL_ARROW = 0.25  # m, at the force of a 5 cm dent


def draw_scene(
    state: ArrayLike,
    parameters: CartPoleParameters,
    force: float,
    max_force: float,
    time: float,
    plan_states: ArrayLike | None = None,
) -> NDArray[np.uint8]:
    """Draw one state, the forces that act in it, and, if given, a plan for what follows.

    The walls' forces are those of their springs in this state. A plan is drawn as the path of the pole's tip,
    with the cart and the pole where it ends.

    :param state: (4,)
    :param parameters: of the plant
    :param force: N on the cart
    :param max_force: N, what the force's arrow is relative to
    :param time: s since the start of the episode
    :param plan_states: (H+1, 4) or None
    :return: (HEIGHT, WIDTH, 3)
    :raises ValueError: ``state`` or ``plan_states`` has the wrong shape or is not finite
    """
    state = _checked_states("state", state, ndim=1)
    plan = None if plan_states is None else _checked_states("plan_states", plan_states, ndim=2)
    canvas = _Canvas(parameters)
    _draw_ground(canvas)
    _draw_walls(canvas, state, parameters)
    if plan is not None:
        _draw_plan(canvas, plan, parameters)
    _draw_cart_pole(canvas, state, parameters)
    _draw_forces(canvas, state, parameters, force, max_force)
    _draw_readings(canvas, state, time)
    return canvas.pixels()


class _Canvas:
    """Shapes in metres (x to the right, z up, origin at the hinge of a cart in the middle) on a bitmap."""

    def __init__(self, parameters: CartPoleParameters) -> None:
        self.half_width = max(2.0 * parameters.pole_length, parameters.wall_distance + parameters.pole_length)
        self._scale = 0.5 * WIDTH * _OVERSAMPLING / self.half_width
        self._origin = (0.5 * WIDTH * _OVERSAMPLING, 0.77 * HEIGHT * _OVERSAMPLING)
        self._image = Image.new("RGB", (WIDTH * _OVERSAMPLING, HEIGHT * _OVERSAMPLING), _SKY)
        self._draw = ImageDraw.Draw(self._image, "RGBA")

    def pixels(self) -> NDArray[np.uint8]:
        return np.array(self._image.resize((WIDTH, HEIGHT), Image.Resampling.BOX))

    def _at(self, point: Point) -> Point:
        return self._origin[0] + self._scale * point[0], self._origin[1] - self._scale * point[1]

    def polygon(self, points: list[Point], fill: Colour) -> None:
        self._draw.polygon([self._at(point) for point in points], fill=fill)

    def box(self, left: float, bottom: float, right: float, top: float, fill: Colour, corner: float = 0.0) -> None:
        self._draw.rounded_rectangle(
            [self._at((left, top)), self._at((right, bottom))], radius=corner * self._scale, fill=fill
        )

    def line(self, points: list[Point], width: float, fill: Colour) -> None:
        self._draw.line(
            [self._at(point) for point in points], fill=fill, width=round(width * self._scale), joint="curve"
        )

    def disc(self, centre: Point, radius: float, fill: Colour) -> None:
        x, y = self._at(centre)
        r = radius * self._scale
        self._draw.ellipse([x - r, y - r, x + r, y + r], fill=fill)

    def arrow(self, start: Point, length: float, fill: Colour) -> None:
        """A horizontal arrow; a negative length points to the left."""
        head = math.copysign(min(0.045, abs(length)), length)
        end, neck = start[0] + length, start[0] + length - head
        self.line([start, (neck, start[1])], 0.016, fill)
        self.polygon([(end, start[1]), (neck, start[1] + 0.026), (neck, start[1] - 0.026)], fill)

    def text(self, position: Point, text: str, size: int, fill: Colour, anchor: str = "mm") -> None:
        self._draw.text(self._at(position), text, fill=fill, font=_font(size * _OVERSAMPLING), anchor=anchor)

    def caption(self, x: float, y: float, text: str, size: int, fill: Colour, anchor: str) -> None:
        """Text placed in pixels of the finished picture."""
        position = (x * _OVERSAMPLING, y * _OVERSAMPLING)
        self._draw.text(position, text, fill=fill, font=_font(size * _OVERSAMPLING), anchor=anchor)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _checked_states(name: str, states: ArrayLike, ndim: int) -> NDArray[np.float64]:
    values = np.asarray(states, dtype=np.float64)
    if values.ndim != ndim or values.shape[-1] != 4 or values.size == 0 or not np.isfinite(values).all():
        accepted = "(4,)" if ndim == 1 else "(H+1, 4)"
        raise ValueError(f"{name} must be finite, shape {accepted}, got shape {values.shape}: {states!r}")
    return values


def _tip(state: NDArray[np.float64], parameters: CartPoleParameters) -> Point:
    return float(tip_position(state, parameters)), parameters.pole_length * math.cos(state[2])


def _draw_ground(canvas: _Canvas) -> None:
    edge, rail = canvas.half_width, -0.5 * _CART_SIZE[1] - 0.04
    canvas.box(-edge, -edge, edge, rail, _GROUND)
    canvas.line([(-edge, rail), (edge, rail)], 0.010, _RAIL)
    ticks = math.floor(edge / 0.5)
    for tick in range(-ticks, ticks + 1):
        x = 0.5 * tick
        canvas.line([(x, rail), (x, rail - 0.03)], 0.006, _RAIL)
        canvas.text((x, rail - 0.065), f"{x:g} m" if tick == 0 else f"{x:+g}", 12, _FAINT_INK)


def _draw_walls(canvas: _Canvas, state: NDArray[np.float64], parameters: CartPoleParameters) -> None:
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
            colour = _mixed(_FOAM, _PRESSED_FOAM, min(1.0, float(squeeze) / _FULL_RED))
            canvas.polygon([low, high, (side * plate, high[1]), (side * plate, low[1])], colour)
        canvas.line(outline, 0.008, _FOAM_EDGE)
        left, right = sorted((side * plate, side * (plate + 0.025)))
        canvas.box(left, -0.5 * _CART_SIZE[1] - 0.04, right, top, _PLATE)


def _draw_cart_pole(
    canvas: _Canvas, state: NDArray[np.float64], parameters: CartPoleParameters, opacity: int = 255
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
    canvas.line([(x, 0.0), tip], 0.022, (*_POLE, opacity))
    canvas.disc(centre, 0.024, (*_POLE, opacity))
    canvas.disc(tip, parameters.tip_radius, (*_TIP, opacity))
    canvas.disc((x, 0.0), 0.017, (*_SKY, opacity))


def _draw_plan(canvas: _Canvas, plan: NDArray[np.float64], parameters: CartPoleParameters) -> None:
    _draw_cart_pole(canvas, plan[-1], parameters, opacity=70)
    path = [_tip(state, parameters) for state in plan]
    if len(path) > 1:
        canvas.line(path, 0.010, (*_PLAN, 150))
    for point in path:
        canvas.disc(point, 0.011, _PLAN)


def _draw_forces(
    canvas: _Canvas,
    state: NDArray[np.float64],
    parameters: CartPoleParameters,
    force: float,
    max_force: float,
) -> None:
    if force != 0.0:
        side = math.copysign(1.0, force)
        start = (float(state[0]) + side * (0.5 * _CART_SIZE[0] + 0.01), 0.0)
        length = side * max(_FORCE_ARROW * min(1.0, abs(force) / max_force), 0.02)
        canvas.arrow(start, length, _FORCE)
        canvas.text((start[0] + 0.5 * length, 0.5 * _CART_SIZE[1] + 0.03), f"{abs(force):.1f} N", 13, _FORCE)
    tip_x, tip_z = _tip(state, parameters)
    for side, push in zip((1.0, -1.0), wall_forces(state, parameters), strict=True):
        if push > 0.0:
            length = -side * max(_WALL_ARROW * float(push) / (0.05 * parameters.wall_stiffness), 0.03)
            start = (tip_x - side * (parameters.tip_radius + 0.005), tip_z)
            canvas.arrow(start, length, _WALL_FORCE)
            canvas.text((start[0] + 0.5 * length, tip_z + 0.06), f"{push:.1f} N", 13, _WALL_FORCE)


def _draw_readings(canvas: _Canvas, state: NDArray[np.float64], time: float) -> None:
    x, x_dot, theta, theta_dot = (float(value) for value in state)
    canvas.caption(16, 14, f"t = {time:.2f} s", 18, _INK, "la")
    canvas.caption(WIDTH - 16, 14, f"x = {x:+.3f} m   {x_dot:+.2f} m/s", 13, _FAINT_INK, "ra")
    canvas.caption(WIDTH - 16, 33, f"angle = {theta:+.3f} rad   {theta_dot:+.2f} rad/s", 13, _FAINT_INK, "ra")


def _mixed(first: Colour, second: Colour, share: float) -> Colour:
    return tuple(round(a + share * (b - a)) for a, b in zip(first, second, strict=True))
