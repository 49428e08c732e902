"""What the picture of a drive says, and on which scales: of a car in SI units in mm, N and km/h, else as theory counts.

A `Gauges` of a task holds all in which the two differ; `roadgym.rendering` draws what it says.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .plant import Plant
from .reward import divergent_terms
from .task import Task

if TYPE_CHECKING:
    from .rendering import History

FRAMES_PER_SECOND = 60
STEPS_SHOWN = 258  # control intervals in the traces, 2 pixels each
PIXELS_PER_RADIAN = 40.0  # of the road's angle wavenumber * distance, where that is what theory counts
PIXELS_PER_METRE = 20.0  # of the road: at 20 m/s and 5 ms to an interval it runs as the traces do
ROAD_REACH = 56  # pixels from the road's mean level to the largest height
LOAD = "wheel_load"
SHOWN = ("acceleration", LOAD)  # signals of a car in SI units that are told


@dataclasses.dataclass(frozen=True)
class Band:
    """Where a trace over time lies.

    Args:
        zero: row of the value zero, pixels from the top.
        reach: pixels from there to the largest value.
    """

    zero: int
    reach: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gauges:
    """The units and scales of the pictures of ``task``.

    Attributes:
        in_si: is all told in SI units?
        unit: that of heights.
        height: how many of it are a standard deviation of the road.
        pixels_per_radian: of the road's angle wavenumber * distance.
        signals: names of the car's signals that are told in figures or have a trace.
        heights, reward: where these traces lie.
        load: where the trace of the force on the road lies, with its mean at zero; None where there is none.
    """

    task: Task
    in_si: bool
    unit: str
    height: float
    pixels_per_radian: float
    signals: tuple[str, ...]
    heights: Band
    reward: Band
    load: Band | None

    @classmethod
    def of(cls, task: Task) -> Gauges:
        """Those of a car in SI units, or those in standard deviations of the road and in 1/w1."""
        if task.car.cost_unit is None:
            return cls(
                task=task,
                in_si=False,
                unit="σ",
                height=1.0,
                pixels_per_radian=PIXELS_PER_RADIAN,
                signals=(),
                heights=Band(508, 44),
                reward=Band(568, 40),
                load=None,
            )
        rough = divergent_terms(task.car, task.road, task.speed_noise)
        signals = tuple(name for name in SHOWN if name in task.car.mean_squares and name not in rough)
        loaded = LOAD in signals and task.car.static_load is not None
        return cls(
            task=task,
            in_si=True,
            unit="mm",
            height=1e3 * math.sqrt(task.road.variance),
            pixels_per_radian=PIXELS_PER_METRE / task.road.wavenumber,
            signals=signals,
            heights=Band(482, 26) if loaded else Band(508, 44),
            reward=Band(585, 30) if loaded else Band(568, 40),
            load=Band(542, 28) if loaded else None,
        )

    def readings(self, history: History, every: int) -> dict[str, str]:
        """What the picture says in words and figures, in order; ``every`` is the number of control intervals a picture."""
        task, metre = self.task, 1 / self.task.road.wavenumber
        speed, deviation = history.speed * task.car.natural_frequency * metre, math.sqrt(task.road.variance)
        called = "mean speed" if task.speed_noise else "speed"
        bandwidth = {"bandwidth δ": f"{history.bandwidth:.3g}"} if history.bandwidth else {}
        driven, far = history.steps * task.control_interval, history.path[-1][0] * metre
        pace = FRAMES_PER_SECOND * every * task.control_interval
        frames = f"{FRAMES_PER_SECOND} steps/s" if every == 1 else f"1 step in {every}"
        if not self.in_si:
            return {
                called: f"{speed:.3g} m/s",
                "frequency ratio ν": f"{history.speed:.3g}",
                **bandwidth,
                "σ of the road": f"{deviation:.3g} m",
                "cost": self.cost,
                "driven": f"{driven:.1f} s, {far:.1f} m",
                "shown": f"{frames}, {pace:.3g} × real time",
            }
        up, units = ROAD_REACH / history.limit / self.height, task.car.motion.signals
        off = f"{100 * history.lifted / max(history.steps, 1):.1f} % of the time"
        return {
            called: f"{3.6 * speed:.3g} km/h",
            **bandwidth,
            "σ of the road": f"{1e3 * deviation:.3g} mm",
            "cost": self.cost,
            "damping": self.damping(history.damping),
            **{name: f"{signed(value, 2)} {units[name].unit}" for name, value in history.signals.items() if name != LOAD},
            **({"off the road": off} if self.load else {}),
            "driven": f"{driven:.1f} s, {far:.0f} m",
            "scale": f"{self.pixels_per_radian / metre:.2g} px a metre, {up:.2g} px a mm up",
            "shown": f"{frames}, {pace:.2g} × real time",
        }

    @property
    def static_load(self) -> float:
        """The mean of the force on the road, N; 0 where the car does not tell it."""
        return self.task.car.static_load or 0.0

    def height_text(self, height: float) -> str:
        """A height, in standard deviations of the road."""
        return f"{signed(height * self.height, 1 if self.in_si else 2)} {self.unit}"

    @property
    def zero(self) -> str:
        """The height 0 beside an axis; it names the unit where the others do not."""
        return f"0 {self.unit}" if self.in_si else "0"

    def tick_text(self, height: float) -> str:
        """A height in `unit` beside an axis."""
        return f"{height:g}{'' if self.in_si else ' σ'}".replace("-", "−")

    @property
    def load_tick(self) -> str:
        """The mean of the force on the road beside an axis."""
        load = self.static_load
        return f"{load / 1e3:.2g} kN" if load >= 1e3 else f"{load:.2g} N"

    def load_text(self, load: float) -> str:
        """The force on the road, of what it is above its mean, N."""
        places = max(0, 2 - math.floor(math.log10(self.static_load)))
        return f"{signed(self.static_load + load, places)} N"

    @property
    def cost(self) -> str:
        """The cost as a formula."""
        symbols = {name: f"{signal.symbol}²" for name, signal in self.task.car.motion.signals.items()}
        return " + ".join(
            symbols[name] if weight == 1 else f"{weight:g} {symbols[name]}" for name, weight in self.task.reward_by_name.items()
        )

    def damping(self, ratio: float) -> str:
        """A damping ratio D as the scale has it: as N s/m, where the car knows them."""
        unit = self.task.car.damping_unit
        return f"{ratio:g}" if unit is None else f"{ratio * unit:.4g} N s/m"


def signed(value: float, places: int) -> str:
    """A number with a minus sign of its own, and none before a zero."""
    return f"{round(value, places) + 0.0:.{places}f}".replace("-", "−")


def signals_now(plant: Plant, car: int, names: Sequence[str], damping: float) -> dict[str, float]:
    """Signals of one of the cars in their units, at the damping ratio ``damping``.

    Args:
        plant: a batch of cars.
        car: which of them.
        names: of signals that contain no white noise on this plant and have no filter.
        damping: D, 1.
    """
    motion = plant.task.car.motion.own
    known = list(motion.signals)
    rate = plant.row("rate")[car] * plant.row("slope")[car]
    values = np.array([*(plant.row(name)[car] for name in (*motion.states, "level")), rate, 0.0], float)
    values[-1] = 2 * damping * (motion.rows[known.index(motion.relative)] @ values)
    units = dict(zip(plant.task.car.mean_squares, np.sqrt(plant.task.square_units), strict=True))
    return {name: float(motion.rows[known.index(name)] @ values * units[name]) for name in names}
