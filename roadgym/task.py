"""One description of the task, shared by the single environment, the batch and the training adapter."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from .car import MEAN_SQUARES, QuarterCar
from .kernel import SIGNALS
from .parameters import ParameterError, non_negative, number, positive, positive_range, whole
from .reward import check_weights, divergent_terms
from .roads import Road, make_road
from .speed import SpeedNoise, make_speed_noise

SATURATION = 20.0  # standard deviations of the road at which an observed signal saturates
LARGEST_ANGLE = 0.1  # largest angle, rad, of the car and of the road in a substep
OPERATING_POINT = ("speed", "bandwidth")


@dataclasses.dataclass(frozen=True)
class Task:
    """A plant with its operating range, its action, its reward and its observation; built by `make_task`.

    Attributes:
        road, speed_noise, car: the plant.
        speed: range of mean speeds, m/s, from which each reset draws uniformly.
        bandwidth: range of road bandwidths, 1, likewise; (0, 0) on a road without one.
        damping_range: range of the action D, 1.
        weights: weight of each mean square in the reward, in the order of `car.MEAN_SQUARES`.
        signals: names of the observed signals, in order.
        control_interval: time between actions, s.
        substeps: substeps in a control interval.
        warm_up: time driven at ``warm_up_damping`` before an episode begins, s.
        precision: "float32" or "float64", the format of the state.
    """

    road: Road
    speed_noise: SpeedNoise | None
    car: QuarterCar
    speed: tuple[float, float]
    bandwidth: tuple[float, float]
    damping_range: tuple[float, float]
    weights: tuple[float, ...]
    signals: tuple[str, ...]
    control_interval: float
    substeps: int
    warm_up: float
    warm_up_damping: float
    precision: str

    @property
    def weights_by_name(self) -> dict[str, float]:
        """The positive weights of the reward, by mean square."""
        return {name: weight for name, weight in zip(MEAN_SQUARES, self.weights, strict=True) if weight}

    @property
    def action_space(self) -> spaces.Box[np.float32]:
        """The damping ratio D, shape (1,), float32."""
        low, high = self.damping_range
        return spaces.Box(np.float32(low), np.float32(high), (1,), np.float32)

    @property
    def observation_space(self) -> spaces.Box[np.float32]:
        """One number a signal, float32: ± SATURATION, and [0, 1] for the operating point."""
        high = [1.0 if name in OPERATING_POINT else SATURATION for name in self.signals]
        low = [0.0 if name in OPERATING_POINT else -SATURATION for name in self.signals]
        return spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)

    @property
    def signal_scale(self) -> npt.NDArray[np.float64]:
        """What to multiply an observation with to get metres: the road's standard deviation.

        In this scale velocities are over w1 and accelerations over w1^2. The operating point has scale 1: its entries are
        nu/(1 + nu) with nu = speed * wavenumber / natural_frequency, and 2 delta/(1 + 2 delta).
        """
        deviation = math.sqrt(self.road.variance)
        return np.array([1.0 if name in OPERATING_POINT else deviation for name in self.signals])

    def frequency_ratio(self, speed: Any) -> Any:
        """nu = speed * wavenumber / natural_frequency."""
        return speed * self.road.wavenumber / self.car.natural_frequency


def _observable(road: Road, speed_noise: SpeedNoise | None, bandwidth: tuple[float, float]) -> list[str]:
    """Signals that are numbers on this plant."""
    names = [name for name in SIGNALS if name not in divergent_terms(road, speed_noise)]
    if not road.has_slope:
        names.remove("slope")
    if bandwidth[1] == 0:
        names.remove("bandwidth")
    return names


def fastest_rate(road: Road, speed_noise: SpeedNoise | None, car: QuarterCar, speed: float) -> float:
    """Largest angular rate, rad/s, that a substep must resolve: of the car, of the road at ``speed``, and of low-pass noise.

    On random roads a noise whose standard deviation is more than a quarter of the speed stops the car now and then. The angle
    of a substep is then cut at zero, and the substep must follow the noise: two of its standard deviations and three times its
    corner frequency keep the mean squares within 0.5 %.
    """
    rate = speed * road.wavenumber
    fastest = max(rate, car.natural_frequency)
    if speed_noise is not None and speed_noise.smooth and road.kind != "harmonic":
        corner = speed_noise.rates[0]
        deviation = speed_noise.intensity * math.sqrt(corner / 2)
        if deviation > rate / 4:
            fastest = max(fastest, rate + 2 * deviation, 3 * corner)
    return fastest


class TaskParameters(TypedDict, total=False):
    """What `make_task` takes, for the environments that pass it on."""

    road: str | Mapping[str, Any] | Road
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None
    speed: float | Sequence[float]
    bandwidth: float | Sequence[float] | None
    damping_range: Sequence[float]
    reward: Mapping[str, float] | None
    observation: Sequence[str] | None
    observe_operating_point: bool
    natural_frequency: float
    control_interval: float | None
    substeps: int | None
    warm_up: float
    warm_up_damping: float | None
    precision: str | None


def make_task(
    *,
    road: str | Mapping[str, Any] | Road = "multiplicative",
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None = None,
    speed: float | Sequence[float] = 1.0,
    bandwidth: float | Sequence[float] | None = None,
    damping_range: Sequence[float] = (0.05, 1.0),
    reward: Mapping[str, float] | None = None,
    observation: Sequence[str] | None = None,
    observe_operating_point: bool = True,
    natural_frequency: float = 1.0,
    control_interval: float | None = None,
    substeps: int | None = None,
    warm_up: float = 0.0,
    warm_up_damping: float | None = None,
    precision: str | None = None,
) -> Task:
    """Check every parameter and fill in the defaults.

    Args:
        road: name, mapping with the key "kind", or `Road`.
        speed_noise: the same for `SpeedNoise`; None for a constant speed.
        speed: mean speed, m/s, or a range (low, high) to draw from at each reset.
        bandwidth: road bandwidth, 1, or a range; the road's own by default. The noise intensity follows, so that the road's
            variance stays.
        damping_range: range (low, high) of the damping ratio, 0 < low < high.
        reward: weight of each mean square; {"displacement": 1.0} by default.
        observation: names of the observed signals; by default displacement, velocity, level and, where it exists, slope.
            An empty sequence leaves the operating point alone.
        observe_operating_point: whether "speed" and, where it exists, "bandwidth" are appended to the observed signals where
            they are not among them; if not, only what ``observation`` names is observed.
        natural_frequency: w1 of the car, rad/s.
        control_interval: time between actions, s; 0.2 / natural_frequency by default.
        substeps: substeps in a control interval; by default as many as keep the angle of the car, of the road and of the
            speed noise (`fastest_rate`) in a substep at most 0.1 rad, and D times the car's angle at most 1, but at least two,
            without which the mean squares are off where D switches (`roadgym.kernel.interval_weights`).
        warm_up: time, s, driven at ``warm_up_damping`` before each episode.
        warm_up_damping: damping ratio of the warm-up; the upper end of ``damping_range`` by default.
        precision: "float32" or "float64"; by default what the road needs.

    Raises:
        ParameterError: naming the parameter, its value and what is allowed.
    """
    the_road = make_road(road)
    noise = make_speed_noise(speed_noise, the_road)
    car = QuarterCar(natural_frequency=natural_frequency)
    speeds = positive_range("speed", speed)
    own = getattr(the_road, "bandwidth", None)
    if bandwidth is None:
        bandwidths = (own, own) if own is not None else (0.0, 0.0)
    else:
        the_road = the_road.with_bandwidth(positive_range("bandwidth", bandwidth)[0]) if own is None else the_road
        bandwidths = positive_range("bandwidth", bandwidth)
    damping = positive_range("damping_range", damping_range)
    if damping[0] == damping[1]:
        raise ParameterError(f"damping_range must be a pair (low, high) with low < high, got {damping_range!r}")
    weights = check_weights({"displacement": 1.0} if reward is None else reward, the_road, noise)

    observable = _observable(the_road, noise, bandwidths)
    if observation is None:
        observation = [name for name in ("displacement", "velocity", "level", "slope") if name in observable]
    if isinstance(observation, str) or not isinstance(observation, Sequence):
        raise ParameterError(f"observation must be a sequence of signal names, got {observation!r}")
    names = list(observation)
    for name in names:
        if name not in observable:
            raise ParameterError(f"unknown signal {name!r} on this plant; known: {', '.join(observable)}")
        if names.count(name) > 1:
            raise ParameterError(f"observation names the signal {name!r} more than once")
    if not isinstance(observe_operating_point, bool):
        raise ParameterError(f"observe_operating_point must be true or false, got {observe_operating_point!r}")
    if observe_operating_point:
        names += [name for name in OPERATING_POINT if name in observable and name not in names]
    if not names:
        raise ParameterError(f"observation must name a signal where the operating point is not observed, got {observation!r}")

    w1 = car.natural_frequency
    interval = 0.2 / w1 if control_interval is None else positive("control_interval", control_interval)
    # the slowest speed is the one that noise stops most easily, the fastest turns the road the fastest
    angle = interval * max(fastest_rate(the_road, noise, car, end) for end in speeds)
    needed = max(math.ceil(angle / LARGEST_ANGLE - 1e-9), math.ceil(damping[1] * interval * w1))
    if the_road.precision == "float64" and precision == "float32":
        raise ParameterError(f'precision must be "float64" on this {the_road.kind} road, got "float32"')
    if precision not in (None, "float32", "float64"):
        raise ParameterError(f'precision must be "float32" or "float64", got {precision!r}')
    stiffness = positive("warm_up_damping", damping[1] if warm_up_damping is None else warm_up_damping)
    return Task(
        road=the_road,
        speed_noise=noise,
        car=car,
        speed=speeds,
        bandwidth=bandwidths,
        damping_range=damping,
        weights=tuple(weights[name] for name in MEAN_SQUARES),
        signals=tuple(names),
        control_interval=interval,
        substeps=max(needed, 2) if substeps is None else whole("substeps", substeps),
        warm_up=non_negative("warm_up", number("warm_up", warm_up)),
        warm_up_damping=stiffness,
        precision=the_road.precision if precision is None else precision,
    )
