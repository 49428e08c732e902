"""The interactive page of the closed forms: one HTML file that computes everything itself, with neither network nor libraries.

`page.html` takes in `style.css` and, in this order, `theory.js` and `two_mass.js` (theory alone, which node runs too),
`words.js` (numbers and sentences), `plots.js` and `two_mass_plots.js` (drawings) and `page.js` (the state and the controls).

The page evaluates the same formulas as `analysis.response`, `analysis.optimum`, `analysis.roads`,
`analysis.paper.rotating_frame` and `analysis.paper.stability`, in units of w1 and of the road's standard deviation; and what
`roadgym.linear` says of the car of two masses on roads of ISO 8608, in SI units. Python tells it the ranges of its parameters,
the plants that are defined, what roads without formulas of their own declare of themselves (`roads`), the named cars of two
masses (`cars`) and the view to begin with, but no result.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from roadgym import MEAN_SQUARES, ROADS, QuarterCar, TwoMassCar, __version__
from roadgym.cars import Car, make_car
from roadgym.cars.two_mass import PRESETS
from roadgym.files import whole_file
from roadgym.parameters import ParameterError, number, shown
from roadgym.reward import check_weights, divergent_terms
from roadgym.roads import FirstOrderRoad, GaussianRoad, MultiplicativeRoad, Road, iso8608, make_road
from roadgym.speed import SPEED_NOISES, SpeedNoise, make_speed_noise

from ..checks import one_of
from ..optimum import COARSE, DISPLACEMENT, FINE, ROUNDS
from ..response import needs_simulation

TEMPLATE = Path(__file__).with_name("page.html")
PARTS = (
    "style.css",
    "theory.js",
    "two_mass.js",
    "words.js",
    "plots.js",
    "two_mass_plots.js",
    "page.js",
)  # each has its name in a comment of the template
PLACE = "/*DATA*/"  # in the template
SEARCH = {"coarse": COARSE, "fine": FINE, "rounds": ROUNDS}  # of the best damping
OWN_FORMULAS = (FirstOrderRoad, GaussianRoad, MultiplicativeRoad)  # in `theory.js`, with controls for their parameters
NO_NOISE = "none"
ONE_MASS, TWO_MASS = "one_mass", "two_mass"
PARAMETERS = ("sprung_mass", "unsprung_mass", "spring_rate", "tyre_rate")  # of the car of two masses
# by the car that the page shows: what of `RANGES` belongs to the other one alone
OF_THE_OTHER = {
    ONE_MASS: (*PARAMETERS, "kilometres_per_hour"),
    TWO_MASS: ("frequency_ratio", "bandwidth", "shape", "intensity", "corner_frequency"),
}


@dataclasses.dataclass(frozen=True)
class Range:
    """What a parameter of the page may be.

    Args:
        low: its least value.
        high: its greatest value.
        start: its value in the page as written by default.
        steps: of the slider, from end to end.
        logarithmic: are they even in the logarithm?
    """

    low: float
    high: float
    start: float
    steps: int = 240
    logarithmic: bool = True


RANGES: Mapping[str, Range] = MappingProxyType(
    {
        "damping": Range(0.01, 2.0, 0.2),
        "frequency_ratio": Range(0.0, 4.0, 1.0, steps=400, logarithmic=False),  # nu = v Omega/w1
        "bandwidth": Range(0.01, 1.0, 0.1),
        "shape": Range(0.1, 10.0, 2.0),  # alpha of (11)
        "intensity": Range(0.01, 1.5, 0.3, steps=149, logarithmic=False),  # sigma/sqrt(w1)
        "corner_frequency": Range(0.01, 10.0, 1.0),  # w_g/w1
        "damping_min": Range(0.01, 2.0, 0.05),
        "damping_max": Range(0.01, 2.0, 1.0),
        "sprung_mass": Range(1.0, 1000.0, 240.0),  # kg
        "unsprung_mass": Range(0.1, 200.0, 36.0),  # kg
        "spring_rate": Range(20.0, 100e3, 16e3),  # N/m
        "tyre_rate": Range(200.0, 1e6, 160e3),  # N/m
        "kilometres_per_hour": Range(5.0, 250.0, 72.0, steps=245, logarithmic=False),
    }
)


def write(path: str | Path, view: Mapping[str, Any] | None = None) -> Path:
    """Write the page, whole or not at all.

    Args:
        path: the file.
        view: what the page shows at first, over the defaults: ``car``, ``road`` and ``speed_noise`` by name, ``weights`` by
            mean square, and any of `RANGES` that the car has. A car of two masses begins with its own masses, rates and range
            of damping.

    Returns:
        The file.

    Raises:
        ParameterError: a value out of range, or a file that cannot be written.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise ParameterError(f"path must name a file, got {shown(path)}")
    data = {
        "version": __version__,
        "mean_squares": MEAN_SQUARES,
        "roads": roads(),
        "plants": plants(),
        "iso": iso_classes(),
        "cars": cars(),
        "signals": TwoMassCar().mean_squares,
        "ranges": {name: dataclasses.asdict(value) for name, value in RANGES.items()},
        "search": SEARCH,
        "view": make_view({} if view is None else view),
    }
    text = TEMPLATE.read_text(encoding="utf-8")
    for name in PARTS:
        text = text.replace(f"/*{name}*/", TEMPLATE.with_name(name).read_text(encoding="utf-8").rstrip("\n"))
    text = text.replace(PLACE, json.dumps(data).replace("<", "\\u003c"))  # a road's name may be anything
    target = Path(path)
    try:
        with whole_file(target) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ParameterError(f"cannot write {str(target)!r}: {error.strerror or error}") from None
    return target


def make_view(view: Mapping[str, Any]) -> dict[str, Any]:
    """A whole view from the given part of it, checked; see `write`.

    Raises:
        ParameterError: an unknown name, a plant that is not defined, or a value out of range.
    """
    if not isinstance(view, Mapping):
        raise ParameterError(f"view must be a mapping, got {shown(view)}")
    car = one_of("car", view.get("car", ONE_MASS), (ONE_MASS, *cars()))
    kind = ONE_MASS if car == ONE_MASS else TWO_MASS
    own = [name for name in RANGES if name not in OF_THE_OTHER[kind]]
    for name in view:
        one_of(f"name in the view of the {kind} car", name, ("car", "road", "speed_noise", "weights", *own))
    one, two = (view, {}) if car == ONE_MASS else ({}, view)
    result = {"car": kind, **one_mass_view(one), **two_mass_view(two)}
    starts = {name: allowed.start for name, allowed in RANGES.items()} | cars().get(car, {})
    for name, allowed in RANGES.items():
        value = number(name, view.get(name, starts[name]))
        if not allowed.low <= value <= allowed.high:
            raise ParameterError(f"{name} must be from {allowed.low:g} to {allowed.high:g}, got {value:g}")
        result[name] = value
    if result["damping_min"] > result["damping_max"]:
        raise ParameterError(
            f"damping_min must not be above damping_max, {result['damping_max']:g}, got {result['damping_min']:g}"
        )
    return result


def one_mass_view(view: Mapping[str, Any]) -> dict[str, Any]:
    """Road, speed noise and weights of the car of one mass."""
    kind = view.get("road", "multiplicative")
    if isinstance(kind, str) and kind not in ROADS:
        make_road(kind)  # which an installed package may register
    road = make_road(one_of("road", kind, roads()))
    noise = make_speed_noise(one_of("speed_noise", view.get("speed_noise", NO_NOISE), (NO_NOISE, *SPEED_NOISES)), road)
    weights = shown_weights(view.get("weights", DISPLACEMENT), QuarterCar(), road, noise)
    return {"road": road.kind, "speed_noise": noise.kind if noise else NO_NOISE, "weights": weights}


def two_mass_view(view: Mapping[str, Any]) -> dict[str, Any]:
    """Class of the road and weights of the car of two masses."""
    roads = {f"iso_{name.lower()}": name for name in iso8608.MEANS}
    name = one_of("road", view.get("road", "iso_c"), roads)
    one_of("speed_noise", view.get("speed_noise", NO_NOISE), (NO_NOISE,))
    weights = shown_weights(view.get("weights", TwoMassCar.default_reward), TwoMassCar(), make_road(name), None)
    return {"iso_class": roads[name], "si_weights": {f"si_{term}": weight for term, weight in weights.items()}}


def shown_weights(weights: Any, car: Car, road: Road, noise: SpeedNoise | None) -> dict[str, float]:
    """The weights by mean square, checked; the page knows those that a car always tells."""
    for name in weights if isinstance(weights, Mapping) else ():
        one_of("name in weights", name, car.mean_squares)
    return check_weights(weights, car, road, noise)


def iso_classes() -> dict[str, Any]:
    """What makes the roads of ISO 8608: the strength of each class, m, and the wavenumber of their corner, rad/m."""
    return {
        "strengths": {name: iso8608.strength(name) for name in iso8608.MEANS},
        "wavenumber": 2 * math.pi * iso8608.LOWEST,
    }


def cars() -> dict[str, dict[str, float]]:
    """By name, the cars of two masses: their parameters, and the range of their damper as damping ratios."""
    result = {}
    for name in (TWO_MASS, *PRESETS):
        car = make_car(name)
        low, high = car.default_damping_range
        result[name] = {parameter: getattr(car, parameter) for parameter in PARAMETERS}
        result[name] |= {"damping_min": float(f"{low:.3g}"), "damping_max": float(f"{high:.3g}")}
    return result


def roads() -> dict[str, dict[str, Any]]:
    """By kind, what each registered road that the page can show declares of itself, at its default parameters.

    Its ``lines`` or its ``filter`` (see `roadgym.roads.Road`), and nothing where the page has formulas of its own. A road with
    neither is left out, and so is one that has no default parameters.
    """
    result = {kind: declaration(road()) for kind, road in ROADS.items() if has_defaults(road)}
    return {kind: declared for kind, declared in result.items() if declared is not None}


def has_defaults(road: type[Road]) -> bool:
    """Can such a road be made without parameters?"""
    fields = [field for field in dataclasses.fields(road) if field.init]
    return not any(field.default is field.default_factory is dataclasses.MISSING for field in fields)


def declaration(road: Road) -> dict[str, Any] | None:
    """What `roads` has of a road; None where the page cannot show it."""
    if type(road) in OWN_FORMULAS:
        return {}
    if road.lines is not None:
        return {"lines": np.array(road.lines, float).tolist()}
    road_filter = road.shaping_filter()
    if road_filter is None or not road_filter.noise.any():
        return None
    matrices = {name: getattr(road_filter, name).tolist() for name in ("drift", "noise", "level", "covariance")}
    poles = np.linalg.eigvals(road_filter.drift)
    return {
        "filter": {
            **matrices,
            "gaussian": road_filter.flatness == 0,
            "rough": bool(np.any(road_filter.level @ road_filter.noise)),
            "poles": [(-pole.real, pole.imag) for pole in poles.tolist() if pole.imag >= 0],  # where lines need more points
        }
    }


def plants() -> dict[str, dict[str, dict[str, Any]]]:
    """By road and speed noise, where it is defined there: is there only simulation, and which mean squares are infinite?"""
    result: dict[str, dict[str, dict[str, Any]]] = {}
    car = QuarterCar()
    for kind in roads():
        road = make_road(kind)
        result[kind] = {}
        for name in (NO_NOISE, *SPEED_NOISES):
            try:
                noise = make_speed_noise(name, road)
            except ParameterError:
                continue
            result[kind][name] = {
                "simulated": needs_simulation(road, noise, car),
                "divergent": divergent_terms(car, road, noise),
            }
    return result
