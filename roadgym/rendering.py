"""Pictures of a drive: what is remembered of it, how it is drawn, and the window that shows it.

The picture is a recorder. The wheel is its pen: it stands at one place, and the road, which it alone knows, moves to the left
behind it, exactly as far as the car travelled; ahead of the wheel nothing is drawn, because nothing is known. Below, on the
same upright line, end the traces over time of the body, of the road under the wheel and of the reward.

Heights are in standard deviations of the road, on the same scale for body, road and traces. It zooms out, and slowly in again,
so that everything fits: the body never leaves the picture. Each control interval is one frame, so at 60 frames a second the
drive runs ``60 * control_interval`` times as fast as real time, which the picture states.

A car in SI units is told in them, see `roadgym.gauges`: heights are in mm, and where the car has a tyre, a trace has the force
of the wheel on the road. It is red below zero, where a real wheel leaves the road; the tyre of the plant pulls it back.
"""

from __future__ import annotations

import collections
import importlib.metadata
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .drawing import BODY, BODY_HEIGHT, BODY_WIDTH, BRIDGE, GAP, GREY, INK, PAPER, WHEEL, Canvas, Colour
from .gauges import FRAMES_PER_SECOND, LOAD, ROAD_REACH, STEPS_SHOWN, Gauges, signals_now, signed
from .installation import needs
from .plant import Interval, Plant
from .task import Task

with needs("render"):
    import pygame

Floats = npt.NDArray[np.floating[Any]]

WIDTH, HEIGHT = 800, 640  # of the picture, pixels; multiples of 16, as video encoders like them

# Okabe and Ito's colours, told apart by readers with any colour vision
HAIRLINE, ROAD, GROUND = (225, 225, 225), (70, 66, 60), (236, 232, 224)
REWARD, REWARD_AREA = (0, 158, 115), (204, 236, 227)
FORCE = (150, 70, 120)  # of the wheel on the road
SOFT, MEDIUM, FIRM = (240, 228, 66), (230, 159, 0), (213, 94, 0)  # the damper at D_min, in the middle, at D_max

# places in the picture, pixels from the left and from the top
LEFT, NOW, COLUMN = 48, 564, 676  # where road and traces begin and end, the wheel standing at the end; the column of figures
ROAD_ZERO, GROUND_BOTTOM = 352, 432  # mean level, where the ground ends
BAR_TOP, BAR_WIDTH, BAR_HEIGHT = 124, 14, 136  # scale of the damping ratio
CAR_LEFT, CAR_WIDTH = NOW - 80, 160  # the columns that the car may cover
CAR_HEIGHT = int(BODY_HEIGHT + GAP + BRIDGE) + 2 * ROAD_REACH + 2  # the most rows that it can cover

SMOOTHING = 3  # the car is drawn this much larger and scaled down, which smooths its edges
TYPICAL = 3.0  # standard deviations of the road that the scale shows at least
ZOOM = 0.98  # how fast the scale returns, a step
POINTS = 4096  # of the road that are remembered at most


class History:
    """What a picture shows of the episode that has just begun on ``plant``, of one of its cars.

    Everything is in the kernel's units: lengths in standard deviations of the road, distances as the road's angle
    wavenumber * distance, rad.

    Attributes:
        path: (angle travelled, level) at the ends of the substeps, as far back as a picture shows; fewer where the car is so
            slow that they would lie within a quarter of a pixel.
        heights: those of the car's masses now, the body's first.
        trace: height of the body, level and reward at the ends of the last steps, shape (steps, 3); no reward (0) at the start.
        signals: those that are told in figures, now, in their units.
        loads: the force on the road at the ends of the last steps, less its mean, N, shape (steps,); where it has no trace, 0.
        damping: D in force at the end of the last step.
        steps: since the episode began.
        cost: sum of minus the rewards since then.
        lifted: after how many of these steps the force on the road was none.
        limit: largest height on the scale.
        reward_limit: largest cost of a step on its scale.
        load_limit: largest force, above or below its mean, on its scale; at least the mean itself.
    """

    def __init__(self, plant: Plant, car: int = 0) -> None:
        self._plant, self._car, self._gauges = plant, car, Gauges.of(plant.task)
        motion = plant.task.car.motion
        heights = [state for state, height in zip(motion.states, motion.follows, strict=True) if height]
        self._heights = heights or list(motion.states[:1])
        self.path = collections.deque([(0.0, self._now("level"))], maxlen=POINTS)
        self.trace: Floats = np.zeros((0, 3))
        self.signals: dict[str, float] = {}
        self.loads: Floats = np.zeros(0)
        self.damping = plant.task.damping_range[0]
        self.steps, self.cost, self.lifted = 0, 0.0, 0
        self.limit, self.reward_limit, self.load_limit = TYPICAL, 1.0, 0.0
        self._remember(0.0)

    def step(self, actions: npt.NDArray[np.float32]) -> Interval:
        """`Plant.step`, remembered: how the road went, and how far the car came where its speed is noise."""
        interval, angle, level = self._plant.trace(actions)
        self.note(interval, angle, level)
        return interval

    def note(self, interval: Interval, angle: npt.NDArray[Any], level: npt.NDArray[Any]) -> None:
        """Remember what `Plant.trace` tells of a step in which the car went on with its episode."""
        scale = self._gauges.pixels_per_radian
        reward, self.damping = float(interval.reward[self._car]), float(interval.damping[self._car])
        if not self._plant.task.ideal_valve:
            self.damping = self._now("damping")
        for turn, end in zip(angle[:, self._car].tolist(), level[:, self._car].tolist(), strict=True):
            here = self.path[-1][0] + turn
            if len(self.path) > 1 and abs(self.path[-1][0] - self.path[-2][0]) < 0.25 / scale:
                self.path.pop()
            self.path.append((here, end))
        while len(self.path) > 2 and self.path[1][0] < self.path[-1][0] - (NOW - LEFT) / scale:
            self.path.popleft()

        self.steps += 1
        self.cost -= reward
        self._remember(reward)
        self.lifted += self.off_the_road

    def _now(self, name: str) -> float:
        return float(self._plant.row(name)[self._car])

    def _remember(self, reward: float) -> None:
        self.heights = [self._now(name) for name in self._heights]
        level = self._now("level")
        shown, gauges = STEPS_SHOWN + 1, self._gauges
        self.trace = np.vstack([self.trace, (self.heights[0], level, reward)])[-shown:]
        self.signals = signals_now(self._plant, self._car, gauges.signals, self.damping) if gauges.signals else {}
        self.loads = np.append(self.loads, -self.signals[LOAD] if gauges.load else 0.0)[-shown:]
        highest = max(abs(level) for _, level in self.path)
        self.limit = max(TYPICAL, highest, float(np.abs(self.trace[:, :2]).max()), ZOOM * self.limit)
        self.reward_limit = max(1.0, -float(self.trace[:, 2].min()), ZOOM * self.reward_limit)
        self.load_limit = max(gauges.static_load, float(np.abs(self.loads).max()), ZOOM * self.load_limit)

    @property
    def off_the_road(self) -> bool:
        """Is the force of the wheel on the road none, or does the tyre of the plant pull?"""
        return self._gauges.load is not None and float(self.loads[-1]) <= -self._gauges.static_load

    @property
    def speed(self) -> float:
        """Frequency ratio nu of this episode."""
        return self._now("speed")

    @property
    def bandwidth(self) -> float:
        """Bandwidth of the road in this episode; 0 on a road without one."""
        return self._now("bandwidth")


def share_scales(histories: Sequence[History]) -> None:
    """Give pictures that stand side by side the same scales."""
    for name in ("limit", "reward_limit", "load_limit"):
        largest = max(getattr(history, name) for history in histories)
        for history in histories:
            setattr(history, name, largest)


def nice(value: float) -> float:
    """The largest of ..., 0.1, 0.2, 0.5, 1, 2, 5, 10, ... that is not above ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1, 2, 5) if step * power <= value)


def damper_colour(share: float) -> Colour:
    """Colour of the damper where D is this share of the way from D_min to D_max."""
    low, high, part = (SOFT, MEDIUM, 2 * share) if share < 0.5 else (MEDIUM, FIRM, 2 * share - 1)
    red, green, blue = (round(a + (b - a) * part) for a, b in zip(low, high, strict=True))
    return red, green, blue


def typeface(size: int, *, bold: bool) -> pygame.font.Font:
    """The sans serif among matplotlib's files, which has the Greek letters; where it is missing, pygame's own."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    try:
        distribution = importlib.metadata.distribution("matplotlib")
        file = Path(str(distribution.locate_file(f"matplotlib/mpl-data/fonts/ttf/{name}")))
    except importlib.metadata.PackageNotFoundError:
        file = Path()
    pygame.font.init()
    return pygame.font.Font(file if file.is_file() else None, size)


class Picture:
    """Draws the history of a car on ``task``."""

    def __init__(self, task: Task) -> None:
        self.task, self.gauges = task, Gauges.of(task)
        self._fonts: dict[tuple[int, bool], pygame.font.Font] = {}
        self._pixels = np.full((HEIGHT, WIDTH, 3), PAPER, np.uint8)
        self._page = pygame.image.frombuffer(self._pixels.data, (WIDTH, HEIGHT), "RGB")  # the same memory, for pygame's drawing
        self._car = pygame.Surface((SMOOTHING * CAR_WIDTH, SMOOTHING * CAR_HEIGHT), pygame.SRCALPHA, 32)
        self._small_car = pygame.Surface((CAR_WIDTH, CAR_HEIGHT), pygame.SRCALPHA, 32)
        self._draw_background()
        self._background = self._pixels.copy()

    def draw(self, history: History, title: str, every: int = 1) -> npt.NDArray[np.uint8]:
        """The picture now as red, green and blue, shape (HEIGHT, WIDTH, 3); the next one replaces it.

        Args:
            history: of the drive.
            title: above it.
            every: how many control intervals pass from one picture to the next, which it tells.
        """
        self._pixels[:] = self._background
        self._draw_scales(history)
        self._draw_road(history)
        self._draw_traces(history)
        self._draw_car(history)
        self._draw_damping(history)
        self._draw_text(history, title, every)
        return self._pixels

    # strokes on the page

    def _text(
        self, text: str, x: float, y: float, size: int = 12, colour: Colour = INK, *, bold: bool = False, align: float = 0.0
    ) -> None:
        """Write with the middle of the line at ``y``; it begins at ``x`` with ``align`` 0 and ends there with 1."""
        try:
            words = self._font(size, bold).render(text, True, colour)
        except pygame.error:  # somebody else's `pygame.quit` took the fonts away
            self._fonts.clear()
            words = self._font(size, bold).render(text, True, colour)
        self._page.blit(words, (round(x - align * words.get_width()), round(y - words.get_height() / 2)))

    def _font(self, size: int, bold: bool) -> pygame.font.Font:
        if (size, bold) not in self._fonts:
            self._fonts[size, bold] = typeface(size, bold=bold)
        return self._fonts[size, bold]

    def _dot(self, x: float, y: float, radius: float, colour: Colour) -> None:
        """A smooth disc."""
        size = np.arange(int(2 * radius + 4))
        rows, columns = int(y - radius - 1) + size[:, None], int(x - radius - 1) + size
        self._blend(rows, columns, radius + 0.5 - np.hypot(rows + 0.5 - y, columns + 0.5 - x), colour)

    def _curve(self, x: Floats, y: Floats, width: float, colour: Colour, area: Colour | None = None, base: int = 0) -> None:
        """A smooth curve through points with increasing ``x``, and the area from it to the row ``base``."""
        columns = np.arange(math.ceil(x[0] - 0.5), math.floor(x[-1] + 0.5))
        if not len(columns):
            return
        near = np.interp(columns + np.linspace(-0.5, 1.5, 5)[:, None], x, y)  # the curve in each column, and half one beside it
        low, high = near.min(axis=0), near.max(axis=0)
        if area:
            begin, end = min(math.floor(low.min()), base), max(math.ceil(high.max()), base)
            rows = np.arange(begin, end)[:, None]
            inside = (rows >= np.minimum(low, base)) & (rows < np.maximum(high, base))
            np.copyto(self._pixels[begin:end, columns[0] : columns[-1] + 1], np.array(area, np.uint8), where=inside[..., None])
        top = np.floor(low - 0.5 * width - 0.5).astype(int)
        rows = top + np.arange(int((high - low).max() + width + 3))[:, None]
        inner_low, inner_high = near[1:4].min(axis=0), near[1:4].max(axis=0)
        away = np.abs(rows + 0.5 - (inner_low + inner_high) / 2) / np.hypot(1.0, inner_high - inner_low)  # across the line
        beyond = np.maximum(low - rows - 0.5, rows + 0.5 - high)  # past the tip of a peak
        self._blend(rows, columns, 0.5 * width + 0.5 - np.maximum(away, beyond), colour)

    def _blend(self, rows: npt.NDArray[Any], columns: npt.NDArray[Any], cover: Floats, colour: Colour) -> None:
        """Lay ``colour`` over these pixels where ``cover`` is 1 or more, and a share of it down to 0."""
        share = np.clip(128 * cover, 0, 128).astype(np.int16)[..., None]
        old = self._pixels[rows, columns]
        self._pixels[rows, columns] = old + ((np.array(colour, np.int16) - old) * share >> 7)

    # parts of the picture

    def _draw_background(self) -> None:
        """What never changes."""
        task = self.task
        for y, zero in (
            (ROAD_ZERO, self.gauges.zero),
            (self.gauges.heights.zero, self.gauges.zero),
            (self.gauges.reward.zero, "0"),
        ):
            self._tick(y, zero)
        if self.gauges.load:
            self._tick(self.gauges.load.zero, self.gauges.load_tick)
        span = STEPS_SHOWN * task.control_interval
        spacing = nice(span / 4)
        for k in range(math.floor(span / spacing) + 1):
            x = NOW - k * spacing / span * (NOW - LEFT)
            self._text(f"−{k * spacing:g} s" if k else "now", x, HEIGHT - 14, 11, GREY, align=0.5)

        kind = f"{task.road.kind.replace('_', '-')} road"
        noise = f", {task.speed_noise.kind.replace('_', '-')} speed noise" if task.speed_noise else ""
        self._text(kind + noise, LEFT, 47, 13, GREY)
        self._text("mean cost so far", WIDTH - 24, 47, 13, GREY, align=1)
        middle, half = ROAD_ZERO - BRIDGE - GAP - BODY_HEIGHT / 2, BODY_WIDTH / 2
        for side in (-1, 1):
            pygame.draw.line(self._page, GREY, (NOW + side * (half + 4), middle), (NOW + side * (half + 24), middle))
        self._text("rest", NOW - half - 5, middle - 9, 11, GREY, align=1)
        low, high = task.damping_range
        self._text("damping D", COLUMN, 84, 12, GREY)
        self._text(f"{self.gauges.damping(high)} firm", COLUMN, BAR_TOP - 17, 11, GREY)
        self._text(f"{self.gauges.damping(low)} soft", COLUMN, BAR_TOP + BAR_HEIGHT + 16, 11, GREY)
        for row in range(BAR_HEIGHT):
            colour = damper_colour(1 - row / (BAR_HEIGHT - 1))
            pygame.draw.line(self._page, colour, (COLUMN, BAR_TOP + row), (COLUMN + BAR_WIDTH - 1, BAR_TOP + row))

    def _tick(self, y: float, name: str) -> None:
        """A line across a trace, and what it stands for."""
        pygame.draw.line(self._page, HAIRLINE, (LEFT, round(y)), (NOW, round(y)))
        self._text(name, LEFT - 6, round(y), 11, GREY, align=1)

    def _draw_scales(self, history: History) -> None:
        gauges = self.gauges
        tick = nice(0.9 * history.limit * gauges.height)
        for sign, name in ((1, gauges.tick_text(tick)), (-1, gauges.tick_text(-tick))):
            for zero, reach in ((ROAD_ZERO, ROAD_REACH), (gauges.heights.zero, gauges.heights.reach)):
                self._tick(zero - sign * tick / gauges.height * reach / history.limit, name)
        tick = nice(0.9 * history.reward_limit)
        self._tick(gauges.reward.zero + tick * gauges.reward.reach / history.reward_limit, f"−{tick:g}")
        if gauges.load:
            below = gauges.static_load * gauges.load.reach / history.load_limit
            far = below > 14  # from the line of the mean
            self._tick(gauges.load.zero + below, "0" if far else "")
            self._text("lift-off" if far else "", NOW + 18, gauges.load.zero + below, 11, FIRM)

    def _draw_road(self, history: History) -> None:
        """The road as far as the car knows it, with its milestones."""
        # where noise drove the car back, it knows some road ahead
        angle, level = np.array(sorted(history.path)).T
        here = history.path[-1][0]
        x = NOW + (angle - here) * self.gauges.pixels_per_radian
        y = ROAD_ZERO - level * ROAD_REACH / history.limit
        begin, end = max(x[0], LEFT), min(x[-1], COLUMN - 8)
        shown = np.concatenate([[begin], x[(x > begin) & (x < end)], [end]])
        self._curve(shown, np.interp(shown, x, y), 2.2, ROAD, GROUND, GROUND_BOTTOM)
        metre = self.gauges.pixels_per_radian * self.task.road.wavenumber
        for row in range(
            self.gauges.reward.zero + self.gauges.reward.reach, math.ceil(np.interp(NOW, x, y)) + 2, -4
        ):  # the line "now"
            pygame.draw.line(self._page, HAIRLINE, (NOW, row), (NOW, row - 2))
        if end < NOW + 1:
            for row, text in enumerate(("the road ahead", "is not known yet")):
                self._text(text, NOW + 44, GROUND_BOTTOM - 36 + 16 * row, 11, (150, 150, 150))
        spacing = nice(200 / metre)
        position = here / self.task.road.wavenumber
        for k in range(math.ceil((position - (NOW - begin) / metre) / spacing), math.floor(position / spacing) + 1):
            mark = NOW + (k * spacing - position) * metre
            pygame.draw.line(self._page, GREY, (round(mark), GROUND_BOTTOM - 5), (round(mark), GROUND_BOTTOM))
            self._text(f"{k * spacing:g} m", mark, GROUND_BOTTOM + 10, 11, GREY, align=0.5)

    def _draw_traces(self, history: History) -> None:
        trace = history.trace
        gauges = self.gauges
        x = NOW - (NOW - LEFT) / STEPS_SHOWN * np.arange(len(trace))[::-1]
        reward = gauges.reward.zero - trace[:, 2] * gauges.reward.reach / history.reward_limit
        height = gauges.heights.zero - trace[:, :2] * gauges.heights.reach / history.limit
        self._curve(x, reward, 1.5, REWARD, REWARD_AREA, gauges.reward.zero)
        if gauges.load:
            force = gauges.load.zero - history.loads * gauges.load.reach / history.load_limit
            none = gauges.load.zero + gauges.static_load * gauges.load.reach / history.load_limit
            self._curve(x, np.maximum(force, none), 1.0, FIRM, FIRM, round(none))
            self._curve(x, force, 1.5, FORCE)
            self._dot(NOW, force[-1], 3.0, FORCE)
        self._curve(x, height[:, 1], 1.8, ROAD)
        self._curve(x, height[:, 0], 1.8, BODY)
        self._dot(NOW, reward[-1], 3.0, REWARD)
        self._dot(NOW, height[-1, 1], 3.5, ROAD)
        self._dot(NOW, height[-1, 0], 3.5, BODY)

    def _draw_car(self, history: History) -> None:
        height = ROAD_REACH / history.limit
        contact = ROAD_ZERO - history.trace[-1, 1] * height
        bodies = [ROAD_ZERO - value * height for value in history.heights]
        top = math.floor(bodies[0] - BRIDGE - GAP - BODY_HEIGHT)
        rows = math.ceil(contact) - top
        canvas = Canvas(
            surface=self._car.subsurface((0, 0, SMOOTHING * CAR_WIDTH, SMOOTHING * rows)),
            scale=SMOOTHING,
            middle=NOW - CAR_LEFT,
            contact=contact - top,
            heights=[body - top for body in bodies],
            damper=damper_colour(self._share(history)),
            rolled=history.path[-1][0] * self.gauges.pixels_per_radian / WHEEL,
            metre=height / math.sqrt(self.task.road.variance),
        )
        canvas.surface.fill((0, 0, 0, 0))
        self.task.car.draw(canvas)
        # all is opaque on nothing, so averaged colours come out multiplied by their share
        small_car = self._small_car.subsurface((0, 0, CAR_WIDTH, rows))
        pygame.transform.smoothscale(canvas.surface, (CAR_WIDTH, rows), small_car)
        self._page.blit(small_car, (CAR_LEFT, top), special_flags=pygame.BLEND_PREMULTIPLIED)

    def _share(self, history: History) -> float:
        """Where the damping lies between D_min and D_max."""
        low, high = self.task.damping_range
        return min(max((history.damping - low) / (high - low), 0.0), 1.0)

    def _draw_damping(self, history: History) -> None:
        y = BAR_TOP + (1 - self._share(history)) * (BAR_HEIGHT - 1)
        x = COLUMN + BAR_WIDTH + 3
        pygame.draw.polygon(self._page, INK, [(x, y), (x + 7, y - 5), (x + 7, y + 5)])
        self._text(f"{history.damping:.2f}", x + 12, y, 13, bold=True)

    def _draw_text(self, history: History, title: str, every: int) -> None:
        gauges, (body, road, reward) = self.gauges, history.trace[-1]
        self._text(title, LEFT, 24, 20, bold=True)
        self._text(f"{history.cost / history.steps:.3f}" if history.steps else "–", WIDTH - 24, 24, 20, bold=True, align=1)
        for row, (name, value) in enumerate(gauges.readings(history, every).items()):
            self._text(name, LEFT, 84 + 20 * row, 12, GREY)
            self._text(value, LEFT + 122, 84 + 20 * row, 12)
        figures = [
            (gauges.heights.zero - 10, BODY, "body y", gauges.height_text(body)),
            (gauges.heights.zero + 10, ROAD, "road z", gauges.height_text(road)),
            (gauges.reward.zero + gauges.reward.reach // 2, REWARD, "reward", signed(reward, 2)),
        ]
        if gauges.load:
            colour, name = (FIRM, "lift-off") if history.off_the_road else (FORCE, "wheel load")
            figures.append((gauges.load.zero, colour, name, gauges.load_text(history.loads[-1])))
        for y, colour, name, value in figures:
            self._text(name, NOW + 18, y, 13, colour)
            self._text(value, WIDTH - 24, y, 13, colour, bold=True, align=1)


class Window:
    """A window on the screen, for `FRAMES_PER_SECOND` pictures a second; smaller than these where the screen is small."""

    def __init__(self, width: int, height: int) -> None:
        pygame.display.init()
        wide, high = pygame.display.get_desktop_sizes()[0]
        share = min(1.0, 0.95 * wide / width, 0.9 * high / height)
        self._screen = pygame.display.set_mode((round(share * width), round(share * height)))
        pygame.display.set_caption("roadgym")
        self._clock = pygame.time.Clock()

    def show(self, pixels: npt.NDArray[np.uint8]) -> None:
        """Show red, green and blue, shape (height, width, 3), when the next frame's turn has come."""
        picture = pygame.image.frombuffer(np.ascontiguousarray(pixels).data, pixels.shape[1::-1], "RGB")
        if picture.get_size() != self._screen.get_size():
            picture = pygame.transform.smoothscale(picture, self._screen.get_size())
        self._screen.blit(picture, (0, 0))
        pygame.event.pump()
        self._clock.tick(FRAMES_PER_SECOND)
        pygame.display.flip()

    def close(self) -> None:
        """Take the window away."""
        pygame.display.quit()
