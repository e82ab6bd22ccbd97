"""A bitmap with shapes in metres, and the colours of everything that is drawn on it."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

try:
    from PIL import Image, ImageDraw, ImageFont
except ImportError as error:
    raise ImportError("drawing needs Pillow: pip install pillow") from error

WIDTH, HEIGHT = 720, 400  # pixels
_OVERSAMPLING = 2  # drawn this many times larger and scaled down: Pillow does not smooth edges itself

Colour = tuple[int, ...]
Point = tuple[float, float]

SKY = (247, 249, 251)
INK, FAINT_INK = (44, 52, 64), (138, 147, 158)
LINK, JOINT = (196, 98, 45), (150, 62, 22)
FOAM, PRESSED_FOAM, FOAM_EDGE = (247, 203, 77), (231, 76, 60), (176, 138, 40)
PLATE = (160, 168, 178)
FORCE, CONTACT_FORCE, PLAN = (41, 121, 201), (192, 40, 45), (14, 140, 120)


class Canvas:
    """Shapes in metres (x to the right, z up) on a bitmap, the origin in the middle of its width.

    :param half_width: m, from the origin to the left and right edge
    :param origin_height: of the origin below the upper edge, as a fraction of the bitmap's height
    """

    def __init__(self, half_width: float, origin_height: float) -> None:
        self.half_width = half_width
        self._scale = 0.5 * WIDTH * _OVERSAMPLING / half_width
        self._origin = (0.5 * WIDTH * _OVERSAMPLING, origin_height * HEIGHT * _OVERSAMPLING)
        self._image = Image.new("RGB", (WIDTH * _OVERSAMPLING, HEIGHT * _OVERSAMPLING), SKY)
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

    def arc_arrow(self, centre: Point, radius: float, start: float, sweep: float, fill: Colour) -> None:
        """An arrow along a circle; angles from upright, positive to the right, rad."""
        head = math.copysign(min(0.06 / radius, abs(sweep)), sweep)
        end, neck = start + sweep, start + sweep - head
        self.line([on_circle(centre, radius, float(a)) for a in np.linspace(start, neck, 24)], 0.020, fill)
        corners = [on_circle(centre, radius + out, neck) for out in (0.032, -0.032)]
        self.polygon([on_circle(centre, radius, end), *corners], fill)

    def text(self, position: Point, text: str, size: int, fill: Colour, anchor: str = "mm") -> None:
        self._draw.text(self._at(position), text, fill=fill, font=_font(size * _OVERSAMPLING), anchor=anchor)

    def caption(self, x: float, y: float, text: str, size: int, fill: Colour, anchor: str) -> None:
        """Text placed in pixels of the finished picture."""
        position = (x * _OVERSAMPLING, y * _OVERSAMPLING)
        self._draw.text(position, text, fill=fill, font=_font(size * _OVERSAMPLING), anchor=anchor)


def on_circle(centre: Point, radius: float, angle: float) -> Point:
    """A point this far from a centre; the angle from upright, positive to the right, rad."""
    return centre[0] + radius * math.sin(angle), centre[1] + radius * math.cos(angle)


def mixed(first: Colour, second: Colour, share: float) -> Colour:
    """From the first colour (share 0) to the second (1)."""
    return tuple(round(a + share * (b - a)) for a, b in zip(first, second, strict=True))


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
