"""What the sensors of a car make of its signals: noise, bias, quantisation, delay and sampling, each signal by itself.

A sensor takes samples of its signal, the first at the start of an episode. To each it adds a bias that is drawn once an episode
and fresh noise, both Gaussian, and rounds the sum to whole steps of its resolution. It tells a sample ``delay`` later, and goes
on telling it until the next. Without an ``interval`` of its own it samples just in time, for each observation the value a
``delay`` ago; before the first that is the value at the start.

Times are rounded to whole substeps. Noise is a function of (seed, episode, sample, signal) alone: it is the same for every
controller, and whatever else is observed. States, infos and rewards are true values; only observations go through sensors.
"""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from .compiled import LANES
from .component import make_part
from .parameters import ParameterError, check_ratio, shown, within

# A sensor in the integers of its table: where its signal is, as `roadgym.record` codes what is observed; in substeps the period
# from one sample to the next, how long before the start sample 0 would have been due, and the delay; the largest common divisor
# of the period and a control interval; the samples that it remembers; its first row of the block, that of the bias, after which
# those of samples follow; and the key of its noise.
SOURCE, PERIOD, OFFSET, DELAY, COMMON, SLOTS, PLACE, NAME, INTEGERS = range(9)
NOISE, BIAS, RESOLUTION, NUMBERS = range(4)  # and in its numbers, in the unit of observations


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensor:
    """The sensor of one signal: standard deviations of noise and bias, step of quantisation, delay and interval, s."""

    noise: float
    bias: float
    resolution: float
    delay: float
    interval: float

    @property
    def ideal(self) -> bool:
        """Does it tell the signal as it is, at once?"""
        return not any(dataclasses.astuple(self))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensors:
    """The sensors of a car. Each argument is a mapping by name of the signal, or one number for all that are observed.

    The operating point is told as it is.

    Args:
        noise: standard deviation of the noise of a sample.
        bias: standard deviation of a constant that is drawn for each episode.
        resolution: step to whole multiples of which a sample is rounded; 0 for none.
        delay: from a sample until it is told, s.
        interval: from one sample to the next, s; 0 for a sample just in time for each observation.
        unit: that of noise, bias and resolution: "road" for that of observations, standard deviations of the road, or "car" for
            that in which the car tells the signal (`roadgym.task.Task.signal_scale`).

    Raises:
        ParameterError: a number out of its range, or an unknown unit.
    """

    noise: float | Mapping[str, float] = 0.0
    bias: float | Mapping[str, float] = 0.0
    resolution: float | Mapping[str, float] = 0.0
    delay: float | Mapping[str, float] = 0.0
    interval: float | Mapping[str, float] = 0.0
    unit: str = "road"

    def __post_init__(self) -> None:
        for field in dataclasses.fields(Sensor):
            given, what = getattr(self, field.name), f"{field.name} of sensors"
            if not isinstance(given, Mapping):
                object.__setattr__(self, field.name, within(what, given, "sensor"))
                continue
            for name in given:
                if not isinstance(name, str):
                    raise ParameterError(f"{what} must be given by names of signals, got {shown(name)}")
            checked = {name: within(f"{field.name} of the sensor of {name}", value, "sensor") for name, value in given.items()}
            object.__setattr__(self, field.name, checked)
        if not (isinstance(self.unit, str) and self.unit in ("road", "car")):
            raise ParameterError(f'unit of sensors must be "road" or "car", got {shown(self.unit)}')

    def __hash__(self) -> int:
        given = (getattr(self, field.name) for field in dataclasses.fields(self))
        return hash(tuple(tuple(sorted(each.items())) if isinstance(each, dict) else each for each in given))

    @property
    def names(self) -> tuple[str, ...]:
        """The signals that it names, in order."""
        given = (getattr(self, field.name) for field in dataclasses.fields(Sensor))
        return tuple(dict.fromkeys(name for each in given if isinstance(each, Mapping) for name in each))

    def of(self, name: str, scale: float = 1.0) -> Sensor:
        """The sensor of a signal, in the unit of observations.

        Args:
            name: of the signal.
            scale: its `roadgym.task.Task.signal_scale`.

        Raises:
            ParameterError: in that unit a number is out of its range.
        """
        found = {}
        for field in dataclasses.fields(Sensor):
            given = getattr(self, field.name)
            found[field.name] = given.get(name, 0.0) if isinstance(given, Mapping) else given
        if self.unit == "car":
            for part in ("noise", "bias", "resolution"):
                value, found[part] = found[part], found[part] / scale
                what = f"that of the sensor of {name}, in the unit of observations,"
                check_ratio(f"{part} of sensors", value, what, found[part], "sensor")
        return Sensor(**found)

    def check(self, scales: Mapping[str, float], interval: float, substeps: int) -> None:
        """Raise `ParameterError` unless all are of signals that there are, and in their ranges on a plant.

        Args:
            scales: `roadgym.task.Task.signal_scale` of the signals that there are, by name.
            interval: the control interval, s.
            substeps: in a control interval.
        """
        for name in self.names:
            if name not in scales:
                raise ParameterError(f"sensors cannot be of {shown(name)} on this plant; signals: {', '.join(scales)}")
        for name, scale in scales.items():
            sensor = self.of(name, scale)
            for part in ("delay", "interval"):
                value = getattr(sensor, part)
                what = f"the {part} of the sensor of {name} in control intervals"
                check_ratio(f"{part} of sensors", value, what, value / interval, "delay")
            if sensor.interval:
                held = max(1, whole_substeps(sensor.interval, interval, substeps))
                samples = whole_substeps(sensor.delay, interval, substeps) / held
                what = f"the number of samples in the delay of the sensor of {name}"
                check_ratio("interval of sensors", sensor.interval, what, samples, "delay")


def make_sensors(sensors: Any) -> Sensors | None:
    """Sensors from a mapping of their parameters, or as they are; None for ideal ones.

    Raises:
        ParameterError: something else, an unknown parameter, or a value out of range.
    """
    return None if sensors is None else make_part(Sensors, "sensors", sensors)


def whole_substeps(time: float, interval: float, substeps: int) -> int:
    """A time, s, in substeps of a control interval, s."""
    return round(time / interval * substeps)


@dataclasses.dataclass(frozen=True)
class SensorTables:
    """The sensors of a plant for compiled code.

    Attributes:
        integers, numbers: shape (sensors, INTEGERS) and (sensors, NUMBERS).
        rows: of a block that they need.
    """

    integers: npt.NDArray[np.int64]
    numbers: npt.NDArray[np.float64]
    rows: int

    @classmethod
    def of(
        cls, sensors: Mapping[str, Sensor], sources: Mapping[str, int], interval: float, substeps: int, first: int
    ) -> SensorTables:
        """The tables.

        Args:
            sensors: by the name of the observed signal, those that are not ideal.
            sources: where the signals are, by name.
            interval: the control interval, s.
            substeps: in a control interval.
            first: the first row of a block that is theirs.
        """
        integers = np.zeros((len(sensors), INTEGERS), np.int64)
        numbers, place = np.zeros((len(sensors), NUMBERS)), first
        for row, (name, sensor) in enumerate(sensors.items()):
            delay = whole_substeps(sensor.delay, interval, substeps)
            period = max(1, whole_substeps(sensor.interval, interval, substeps)) if sensor.interval else substeps
            offset = 0 if sensor.interval else delay % substeps
            slots = -(-delay // period) + 1
            common = math.gcd(period, substeps)
            integers[row] = sources[name], period, offset, delay, common, slots, place, zlib.crc32(name.encode())
            numbers[row] = sensor.noise, sensor.bias, sensor.resolution
            place += (1 + slots) * LANES
        return cls(integers, numbers, (place - first) // LANES)


def check_delays(delays: Mapping[str, float], control_interval: float, max_episode_steps: int) -> None:
    """Raise `ParameterError` for a delay, s, by what has it, that is as long as an episode."""
    for what, delay in delays.items():
        if delay >= max_episode_steps * control_interval:
            raise ParameterError(
                f"delay of {what} must be shorter than an episode, {max_episode_steps * control_interval:g} s, got {delay:g}"
            )
