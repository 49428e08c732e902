"""What cars are drawn with, and how those of one and of two masses look; `roadgym.cars.Car.draw` chooses."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from .installation import needs

with needs("render"):
    import pygame

Colour = tuple[int, int, int]

PAPER, INK, GREY, BODY = (255, 255, 255), (45, 45, 45), (110, 110, 110), (0, 114, 178)
WHEEL, HUB, BRIDGE = 22.0, 23.5, 52.0  # the wheel's radius; its hub and the bridge under the spring, above the road; pixels
TYRE_HUB, TYRE_BRIDGE = 31.0, 76.0  # the same above the foot of a wheel with a tyre
TYRE_PRESSED, BULGE = 10.0, 0.35  # how far it is pressed at rest at most, pixels; how much broader it gets, over that
GAP, BODY_WIDTH, BODY_HEIGHT = 140.0, 148.0, 46.0  # from bridge to body at rest; the body's size


@dataclasses.dataclass(kw_only=True)
class Canvas:
    """A place to draw a car on, in pixels from its left and its top, ``scale`` times as fine.

    Attributes:
        surface: what is drawn on, ``scale`` times as large.
        middle: the upright line of the car.
        contact: where the wheel touches the road.
        heights: where the mean level, moved by as much as each of the car's masses, lies; the body first. A mass is drawn at a
            constant distance above.
        damper: colour of the damper.
        rolled: angle that the wheel has turned, rad.
        metre: of height, pixels.
    """

    surface: pygame.Surface
    scale: int
    middle: float
    contact: float
    heights: Sequence[float]
    damper: Colour
    rolled: float
    metre: float

    def box(self, colour: Colour, left: float, top: float, width: float, height: float, radius: float = 0.0) -> None:
        """A rectangle with round corners."""
        where = [round(self.scale * value) for value in (left, top, width, height)]
        pygame.draw.rect(self.surface, colour, where, border_radius=round(self.scale * radius))

    def disc(self, colour: Colour, x: float, y: float, radius: float) -> None:
        """A disc."""
        pygame.draw.circle(self.surface, colour, (round(self.scale * x), round(self.scale * y)), round(self.scale * radius))

    def spring(self, x: float, top: float, bottom: float, turns: int = 7) -> None:
        """A coil spring, lighter where it goes behind."""
        each = 24
        turn = np.linspace(0, turns, turns * each + 1)
        coil = np.stack([x + 16 * np.sin(2 * np.pi * turn), bottom + (top - bottom) * turn / turns], axis=1)
        strand = np.rint(self.scale * coil).tolist()
        pygame.draw.lines(self.surface, (165, 165, 165), False, strand, 2 * self.scale)
        for k in range(turns):
            front = strand[each * k + each // 4 : each * k + 3 * each // 4 + 1]
            pygame.draw.lines(self.surface, INK, False, front, 3 * self.scale)


def body_on_wheel(canvas: Canvas, foot: float) -> None:
    """A body on a spring and a damper, on a wheel whose lowest point is at ``foot``."""
    bridge, hub = foot - BRIDGE, foot - HUB
    body_on_bridge(canvas, bridge, strut=66)
    canvas.box(INK, canvas.middle - 3, bridge, 6, BRIDGE - HUB)
    canvas.box(INK, canvas.middle - 54, bridge - 3, 108, 6, 3)
    canvas.disc(INK, canvas.middle, hub, WHEEL)
    rim(canvas, hub, 13)


def body_on_tyre(canvas: Canvas, pressed: float) -> None:
    """A body on a spring and a damper, on a wheel with a tyre.

    The tyre is round but for its foot, which is flat on the road. On the scale of the heights it is as far from being round as
    it is pressed, up to `TYRE_PRESSED` at rest: on a smooth road, drawn large, it stretches a little before it leaves the road.

    Args:
        canvas: where; the heights are those of body and wheel.
        pressed: how far its weight presses the tyre, m.
    """
    middle, bridge, hub = canvas.middle, canvas.heights[1] - TYRE_BRIDGE, canvas.heights[1] - TYRE_HUB
    body_on_bridge(canvas, bridge, strut=52)
    canvas.box(INK, middle - 3, bridge, 6, TYRE_BRIDGE - TYRE_HUB)
    canvas.box(INK, middle - 54, bridge - 3, 108, 6, 3)
    free = TYRE_HUB + min(pressed * canvas.metre, TYRE_PRESSED)
    room = canvas.contact - hub
    turn = np.linspace(0, 2 * np.pi, 181)
    x, y = free * np.sin(turn), free * np.cos(turn)
    loaded = canvas.contact - canvas.heights[1] < pressed * canvas.metre
    if loaded:
        y = np.minimum(np.where(y > 0, max(room / free, 1.0), 1.0) * y, room)
        x *= 1 + BULGE * max(1 - room / free, 0.0) * (1 + np.cos(turn))
    outline = np.rint(canvas.scale * np.stack([middle + x, hub + y], axis=1)).tolist()
    pygame.draw.polygon(canvas.surface, INK, outline)
    rim(canvas, hub, 19)


def body_on_bridge(canvas: Canvas, bridge: float, *, strut: float) -> None:
    """A body on a spring and a damper, which stand on a bridge; the lower tube of the damper is ``strut`` high."""
    middle, bottom = canvas.middle, canvas.heights[0] - BRIDGE - GAP
    canvas.spring(middle - 30, bottom, bridge)
    canvas.box(GREY, middle + 28, bottom, 5, bridge - bottom)
    canvas.box(INK, middle + 18, bridge - strut, 25, strut, 4)
    canvas.box(canvas.damper, middle + 20, bridge - strut + 2, 21, strut - 4, 2.5)
    canvas.box(BODY, middle - BODY_WIDTH / 2, bottom - BODY_HEIGHT, BODY_WIDTH, BODY_HEIGHT, 10)
    canvas.box(PAPER, middle - BODY_WIDTH / 2 + 8, bottom - BODY_HEIGHT / 2 - 1, 16, 2)
    canvas.box(PAPER, middle + BODY_WIDTH / 2 - 24, bottom - BODY_HEIGHT / 2 - 1, 16, 2)


def rim(canvas: Canvas, hub: float, radius: float) -> None:
    """The rim of a wheel about its hub, and a spot that shows how it turns."""
    middle, spot = canvas.middle, radius - 4
    canvas.disc((214, 214, 214), middle, hub, radius)
    canvas.disc(INK, middle + spot * math.cos(canvas.rolled), hub + spot * math.sin(canvas.rolled), 2)
    canvas.disc(INK, middle, hub, 4)
