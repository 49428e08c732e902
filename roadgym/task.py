"""One description of the task, shared by the single environment, the batch and the training adapter."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from .cars import Car, make_car
from .compiled import LaneFunction
from .moved import moved
from .parameters import ParameterError, check_ratio, non_negative, pair, positive, positive_range, shown, whole, within
from .record import OBSERVED
from .resolution import needed_substeps, strictest_precision
from .reward import asked_signals, check_weights, cost_unit, divergence_cause, divergent_terms
from .roads import Road, make_road
from .sensors import Sensor, Sensors, make_sensors
from .speed import SpeedNoise, make_speed_noise
from .valve import Valve, make_valve
from .variation import Variation, make_variation

if not TYPE_CHECKING:
    __getattr__ = moved(
        __name__,
        LARGEST_ANGLE="roadgym.resolution",
        fastest_rate="roadgym.resolution",
        MEAN_SQUARES="roadgym.cars",
        SIGNALS="roadgym.moved",
    )

SATURATION = 20.0  # standard deviations of the road at which an observed signal saturates
OPERATING_POINT = ("speed", "bandwidth")


@dataclasses.dataclass(frozen=True)
class Task:
    """A plant with its operating range, its action, its reward and its observation; built by `make_task`.

    Attributes:
        road, speed_noise, car: the plant.
        speed: range of mean speeds, m/s, from which each reset draws uniformly.
        bandwidth: range of road bandwidths, 1, likewise; (0, 0) on a road without one.
        damping_range: range of the action D, 1.
        reward: weight in the reward of each mean square as it is told, in the order of `roadgym.cars.Car.mean_squares`.
        signals: names of the observed signals, in order.
        control_interval: time between actions, s.
        substeps: substeps in a control interval.
        warm_up: time driven at ``warm_up_damping`` before an episode begins, s.
        precision: "float32" or "float64", the format of the state.
        sensors: through which the signals are observed; None for ideal ones.
        valve: between the action and the damping in force.
        vary: what of car and valve varies from episode to episode, around these; None for nothing.
    """

    road: Road
    speed_noise: SpeedNoise | None
    car: Car
    speed: tuple[float, float]
    bandwidth: tuple[float, float]
    damping_range: tuple[float, float]
    reward: tuple[float, ...]
    signals: tuple[str, ...]
    control_interval: float
    substeps: int
    warm_up: float
    warm_up_damping: float
    precision: str
    sensors: Sensors | None
    valve: Valve
    vary: Variation | None

    @property
    def ideal_valve(self) -> bool:
        """Is every command in force at once, in every episode?"""
        return self.valve.ideal and not (self.vary is not None and self.vary.varies_valve)

    @property
    def holds_damping(self) -> bool:
        """Does D in force keep its value within each control interval, in every episode?"""
        return self.valve.is_still(self.control_interval) and not (self.vary is not None and self.vary.varies_valve)

    @property
    def cars(self) -> tuple[tuple[Car, float], ...]:
        """The nominal car, and where it varies those at the ends, each with what makes a nominal damping ratio its own."""
        return ((self.car, 1.0),) if self.vary is None else self.vary.cars

    @property
    def reward_by_name(self) -> dict[str, float]:
        """The positive weights of the reward, by mean square as it is told."""
        return {name: weight for name, weight in zip(self.car.mean_squares, self.reward, strict=True) if weight}

    @property
    def weights(self) -> tuple[float, ...]:
        """Weight of each mean square in the reward, where squares are over E Z^2 of the road and times in 1/w1."""
        relative = self.car.unit_factors**2 * (self.road.variance / self.cost_unit)
        return tuple((np.array(self.reward) * relative).tolist())

    @property
    def weights_by_name(self) -> dict[str, float]:
        """The positive ones of `weights`, by mean square."""
        return {name: weight for name, weight in zip(self.car.mean_squares, self.weights, strict=True) if weight}

    @property
    def cost_unit(self) -> float:
        """What the weighted mean squares, as they are told, are divided by to be the cost, minus the reward."""
        return cost_unit(self.car, self.road)

    @property
    def square_units(self) -> npt.NDArray[np.float64]:
        """The mean squares as they are told, where the kernel's are 1, shape (squares,)."""
        return self.road.variance * self.car.unit_factors**2

    @property
    def speed_unit(self) -> float:
        """The speed, m/s, at the frequency ratio 1."""
        return self.car.natural_frequency / self.road.wavenumber

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
        """What to multiply an observation with to get the unit in which the car tells the signal, see `roadgym.cars.Car.units`.

        That is the road's standard deviation for lengths, and in a car that tells all in metres for velocities over w1 and
        accelerations over w1^2 as well. The operating point has scale 1: its entries are nu/(1 + nu) with
        nu = speed * wavenumber / natural_frequency, and 2 delta/(1 + 2 delta).
        """
        return signal_scales(self.car, self.road, self.signals)

    @property
    def real_sensors(self) -> dict[str, Sensor]:
        """The sensors of observed signals that are not ideal, in the unit of observations, by name of the signal."""
        if self.sensors is None:
            return {}
        scales = zip(self.signals, self.signal_scale.tolist(), strict=True)
        found = {name: self.sensors.of(name, scale) for name, scale in scales if name not in OPERATING_POINT}
        return {name: sensor for name, sensor in found.items() if not sensor.ideal}

    def frequency_ratio(self, speed: Any) -> Any:
        """nu = speed * wavenumber / natural_frequency."""
        return speed * self.road.wavenumber / self.car.natural_frequency


def signal_scales(car: Car, road: Road, names: Sequence[str]) -> npt.NDArray[np.float64]:
    """`Task.signal_scale` of the signals of these names."""
    deviation = math.sqrt(road.variance)
    factors = dict(zip(car.mean_squares, car.unit_factors.tolist(), strict=True))
    return np.array([1.0 if name in OPERATING_POINT else deviation * factors.get(name, 1.0) for name in names])


def signals(car: Car) -> tuple[str, ...]:
    """Names of all that can be observed of a plant with this car."""
    return (*car.mean_squares, *OBSERVED)


def _observable(car: Car, road: Road, speed_noise: SpeedNoise | None, bandwidth: tuple[float, float]) -> list[str]:
    """Signals that are numbers on this plant."""
    names = [name for name in signals(car) if name not in divergent_terms(car, road, speed_noise)]
    if not road.has_slope:
        names.remove("slope")
    if bandwidth[1] == 0:
        names.remove("bandwidth")
    return names


def _states(car: Car, observable: Sequence[str]) -> list[str]:
    """The states of car and road that can be observed, which is what is observed by default."""
    return [name for name in (*car.motion.states, "level", "slope") if name in observable]


def observed_states(task: Task) -> tuple[str, ...]:
    """What a task observes where nothing else is asked for: the states of car and road, and the operating point."""
    observable = _observable(task.car, task.road, task.speed_noise, task.bandwidth)
    return (*_states(task.car, observable), *(name for name in OPERATING_POINT if name in observable))


def check_component(component: Road | SpeedNoise | Car, what: str) -> None:
    """Check what a component, which may be somebody's own, says of itself: its lane functions, their rows and words.

    Args:
        component: the component.
        what: "road", "speed noise" or "car".

    Raises:
        ParameterError: what is none of these.
    """
    name = f"the {component.kind} {what}"
    precision = getattr(component, "precision", "float32")
    if not (isinstance(precision, str) and precision in ("float32", "float64")):
        raise ParameterError(f'precision of {name} must be "float32" or "float64", got {shown(precision)}')
    for attribute, of in COUNTED.items():
        if hasattr(component, attribute):
            whole(f"{attribute} of {name}", getattr(component, attribute), low=0, of=of)
    if isinstance(component, Car):
        motion = component.motion
        positive(f"unit_factors of {name}", float(component.unit_factors.min()))
        if whole(f"squared of {name}", component.squared, low=0) > len(motion.signals):
            raise ParameterError(
                f"squared of {name} must be at most its {len(motion.signals)} signals, got {component.squared}"
            )
        if component.rows < len(motion.own.states):
            raise ParameterError(f"rows of {name} must be at least {len(motion.own.states)}, its states, got {component.rows}")
        if not component.decay(1.0) > 0:
            raise ParameterError(f"drift of {name} must be stable with a damper, where its free motion never ends")
    for role in LANE_FUNCTIONS[what]:
        function = getattr(component, role)
        if not isinstance(function, LaneFunction) and not (what == "road" and role == "prepare" and function is None):
            raise ParameterError(f"{role} of {name} must be a LaneFunction, got {shown(function)}")


COUNTED = {"words_per_substep": "words of a component", "rows": "rows of a component", "working_rows": "rows of a component"}
LANE_FUNCTIONS = {"road": ("prepare", "start", "advance"), "speed noise": ("start", "advance"), "car": ("prepare", "advance")}


def check_plant(
    road: Road, speed_noise: SpeedNoise | None, speeds: tuple[float, float], natural_frequency: float, what: str = "speed"
) -> None:
    """Raise `ParameterError` unless the frequency ratios of these ``speeds`` and the speed noise are in their ranges."""
    for speed in speeds:
        check_ratio(
            what,
            speed,
            "nu = speed * wavenumber/natural_frequency",
            speed * road.wavenumber / natural_frequency,
            "frequency ratio",
        )
    if speed_noise is not None:
        speed_noise.check_range(natural_frequency)


class TaskParameters(TypedDict, total=False):
    """What `make_task` takes, for the environments that pass it on."""

    road: str | Mapping[str, Any] | Road
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None
    speed: float | Sequence[float]
    bandwidth: float | Sequence[float] | None
    damping_range: Sequence[float] | None
    reward: Mapping[str, float] | None
    observation: Sequence[str] | None
    observe_operating_point: bool
    car: str | Mapping[str, Any] | Car | None
    natural_frequency: float | None
    control_interval: float | None
    substeps: int | None
    warm_up: float
    warm_up_damping: float | None
    precision: str | None
    sensors: Mapping[str, Any] | Sensors | None
    valve: Mapping[str, Any] | Valve | None
    vary: Mapping[str, Sequence[float]] | None


def make_task(
    *,
    road: str | Mapping[str, Any] | Road = "multiplicative",
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None = None,
    speed: float | Sequence[float] = 1.0,
    bandwidth: float | Sequence[float] | None = None,
    damping_range: Sequence[float] | None = None,
    reward: Mapping[str, float] | None = None,
    observation: Sequence[str] | None = None,
    observe_operating_point: bool = True,
    car: str | Mapping[str, Any] | Car | None = None,
    natural_frequency: float | None = None,
    control_interval: float | None = None,
    substeps: int | None = None,
    warm_up: float = 0.0,
    warm_up_damping: float | None = None,
    precision: str | None = None,
    sensors: Mapping[str, Any] | Sensors | None = None,
    valve: Mapping[str, Any] | Valve | None = None,
    vary: Mapping[str, Sequence[float]] | None = None,
) -> Task:
    """Check every parameter and fill in the defaults.

    Args:
        road: name, mapping with the key "kind", or `Road`.
        speed_noise: the same for `SpeedNoise`; None for a constant speed.
        speed: mean speed, m/s, or a range (low, high) to draw from at each reset.
        bandwidth: road bandwidth, 1, or a range; the road's own by default. The noise intensity follows, so that the road's
            variance stays.
        damping_range: range (low, high) of the damping ratio, 0 < low < high; the car's by default, (0.05, 1) of one mass.
        reward: weight of each mean square, in the units in which the car tells it; the car's by default, {"displacement": 1.0}
            of one mass and {"acceleration": 1.0} of two.
        observation: names of the observed signals; by default the states of the car (displacement and velocity), level and,
            where it exists, slope.
            An empty sequence leaves the operating point alone.
        observe_operating_point: whether "speed" and, where it exists, "bandwidth" are appended to the observed signals where
            they are not among them; if not, only what ``observation`` names is observed.
        car: name, mapping with the key "kind", or `Car`; the car of one mass by default.
        natural_frequency: w1 of the car of one mass, rad/s, 1 by default; in place of ``car``.
        control_interval: time between actions, s; the car's by default, 0.2 / natural_frequency of one mass and 0.005 of two.
        substeps: substeps in a control interval; by default as many as keep the angle of the car, of the road and of the
            speed noise (`fastest_rate`) in a substep at most 0.1 rad, and D times the car's angle at most 0.2; but at least
            two, without which the mean squares are off where D switches (`roadgym.record.interval_weights`); three times as
            many where a valve moves D within an interval. Fewer are less
            exact: the mean squares are of fourth order in the angle, which may be 1 rad at most.
        warm_up: time, s, driven at ``warm_up_damping`` before each episode.
        warm_up_damping: damping ratio of the warm-up; the upper end of ``damping_range`` by default.
        precision: "float32" or "float64"; by default what keeps the mean squares within 1e-4: single precision, but for bounded
            roads that touch their bound, slow roads and cars, and short substeps.
        sensors: `roadgym.Sensors` through which the signals are observed, or a mapping of its arguments; ideal by default.
        valve: `roadgym.Valve` between the action and the damping in force, or a mapping of its arguments; ideal by default.
        vary: bounds (low, high) of fields of the car, such as "sprung_mass", and of the valve, such as "valve.rise_time":
            each episode has its own, told and acted in terms of the nominal ``car``; see `roadgym.variation`.

    Ranges of all of them are in `roadgym.parameters.RANGES`.

    Raises:
        ParameterError: naming the parameter, its value and what is allowed.
    """
    the_road = make_road(road)
    noise = make_speed_noise(speed_noise, the_road)
    the_car = make_car(car, natural_frequency).with_signals(asked_signals(reward, observation))
    check_component(the_road, "road")
    check_component(the_car, "car")
    if noise is not None:
        check_component(noise, "speed noise")
    the_road.check_driven()
    w1 = the_car.natural_frequency
    speeds = positive_range("speed", speed)
    check_plant(the_road, noise, speeds, w1)
    own = getattr(the_road, "bandwidth", None)
    if bandwidth is None:
        bandwidths = (0.0, 0.0) if own is None else positive_range("bandwidth", own, "bandwidth")
    else:
        bandwidths = positive_range("bandwidth", bandwidth, "bandwidth")
        for end in bandwidths:
            the_road.with_bandwidth(end)  # which a road may refuse
    damping_range = the_car.default_damping_range if damping_range is None else damping_range
    damping = pair("damping_range", damping_range, "damping")
    weights = check_weights(the_car.default_reward if reward is None else reward, the_car, the_road, noise)

    observable = _observable(the_car, the_road, noise, bandwidths)
    if observation is None:
        observation = _states(the_car, observable)
    if isinstance(observation, str) or not isinstance(observation, Sequence):
        raise ParameterError(f"observation must be a sequence of signal names, got {shown(observation)}")
    names = list(observation)
    for name in names:
        if name in divergent_terms(the_car, the_road, noise):
            cause = divergence_cause(the_road, noise)
            raise ParameterError(f"the signal {name!r} is infinite on {cause}: observation must not name it")
        if name not in observable:
            raise ParameterError(f"unknown signal {shown(name)} on this plant; known: {', '.join(observable)} (observation)")
        if names.count(name) > 1:
            raise ParameterError(f"observation names the signal {name!r} more than once")
    if not isinstance(observe_operating_point, bool):
        raise ParameterError(f"observe_operating_point must be true or false, got {shown(observe_operating_point)}")
    if observe_operating_point:
        names += [name for name in OPERATING_POINT if name in observable and name not in names]
    if not names:
        raise ParameterError(
            f"observation must name a signal where the operating point is not observed, got {shown(observation)}"
        )

    interval = the_car.default_control_interval if control_interval is None else positive("control_interval", control_interval)
    check_ratio("control_interval", interval, "control_interval * w1", interval * w1, "relative interval")
    warm_up = non_negative("warm_up", warm_up)
    check_ratio("warm_up", warm_up, "warm_up * w1", warm_up * w1, "relative warm-up")
    stiffness = damping[1] if warm_up_damping is None else within("warm_up_damping", warm_up_damping, "damping")
    the_valve = make_valve(valve)
    the_valve.check(interval)
    firmest, still = max(damping[1], stiffness), the_valve.is_still(interval)
    variation = make_variation(vary, the_car, the_valve, interval, the_road, noise)
    cars = ((the_car, 1.0),) if variation is None else variation.cars
    still = still and not (variation is not None and variation.varies_valve)
    for each, _ in cars[1:]:
        check_plant(the_road, noise, speeds, each.natural_frequency)
    number = max(
        needed_substeps(the_road, noise, each, speeds, bandwidths[1], firmer * firmest, interval, substeps, still)
        for each, firmer in cars
    )
    words = the_road.words_per_substep + (0 if noise is None else noise.words_per_substep)
    check_ratio(
        "control_interval",
        interval,
        "the number of random words in it, at this speed and natural_frequency,",
        number * words,
        "words",
    )
    check_ratio(
        "warm_up",
        warm_up,
        "the number of substeps in it, at this speed and natural_frequency,",
        warm_up / interval * number,
        "warm-up substeps",
    )

    the_sensors = make_sensors(sensors)
    if the_sensors is not None:
        known = [name for name in observable if name not in OPERATING_POINT]
        scales = signal_scales(the_car, the_road, known).tolist()
        the_sensors.check(dict(zip(known, scales, strict=True)), interval, number)
    slowest = speeds[0] * the_road.wavenumber / w1
    if bandwidths[0] > 0:
        loss = bandwidths[0] * slowest * interval * w1 / number
        check_ratio(
            "speed",
            speed,
            "bandwidth times the road's angle in a substep, at this natural_frequency and control_interval,",
            loss,
            the_road.loss_range,
        )
    if not (precision is None or (isinstance(precision, str) and precision in ("float32", "float64"))):
        raise ParameterError(f'precision must be "float32" or "float64", got {shown(precision)}')
    if the_road.precision == "float64" and precision == "float32":
        raise ParameterError(f'precision must be "float64" on this {the_road.kind} road, got "float32"')
    if precision is None:
        rate = speeds[0] * the_road.wavenumber
        precision = strictest_precision(the_road, cars, rate, bandwidths, damping, interval / number)
    return Task(
        road=the_road,
        speed_noise=noise,
        car=the_car,
        speed=speeds,
        bandwidth=bandwidths,
        damping_range=damping,
        reward=tuple(weights[name] for name in the_car.mean_squares),
        signals=tuple(names),
        control_interval=interval,
        substeps=number,
        warm_up=warm_up,
        warm_up_damping=stiffness,
        precision=precision,
        sensors=the_sensors,
        valve=the_valve,
        vary=variation,
    )
