"""The interactive page of the closed forms: one HTML file that computes everything itself, with neither network nor libraries.

`page.html` takes in `style.css` and, in this order, `theory.js` (the closed forms alone, which node runs too), `words.js`
(numbers and sentences), `plots.js` (the drawings) and `page.js` (the state and the controls).

The page evaluates the same formulas as `analysis.response`, `analysis.optimum`, `analysis.roads`,
`analysis.paper.rotating_frame` and `analysis.paper.stability`, in units of w1 and of the road's standard deviation. Python
tells it the ranges of its parameters, the plants that are defined, what roads without formulas of their own declare of
themselves (`roads`) and the view to begin with, but no result.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from roadgym import MEAN_SQUARES, ROADS, QuarterCar, __version__
from roadgym.files import whole_file
from roadgym.parameters import ParameterError, number, shown
from roadgym.reward import check_weights, divergent_terms
from roadgym.roads import FirstOrderRoad, GaussianRoad, MultiplicativeRoad, Road, make_road
from roadgym.speed import SPEED_NOISES, make_speed_noise

from ..checks import one_of
from ..optimum import COARSE, DISPLACEMENT, FINE, ROUNDS
from ..response import needs_simulation

TEMPLATE = Path(__file__).with_name("page.html")
PARTS = ("style.css", "theory.js", "words.js", "plots.js", "page.js")  # each has its name in a comment of the template
PLACE = "/*DATA*/"  # in the template
SEARCH = {"coarse": COARSE, "fine": FINE, "rounds": ROUNDS}  # of the best damping
OWN_FORMULAS = (FirstOrderRoad, GaussianRoad, MultiplicativeRoad)  # in `theory.js`, with controls for their parameters
NO_NOISE = "none"


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
    }
)


def write(path: str | Path, view: Mapping[str, Any] | None = None) -> Path:
    """Write the page, whole or not at all.

    Args:
        path: the file.
        view: what the page shows at first, over the defaults: ``road`` and ``speed_noise`` by name, ``weights`` by mean square,
            and any of `RANGES`.

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
    known = ("road", "speed_noise", "weights", *RANGES)
    for name in view:
        one_of("name in the view", name, known)
    kind = view.get("road", "multiplicative")
    if isinstance(kind, str) and kind not in ROADS:
        make_road(kind)  # which an installed package may register
    road = make_road(one_of("road", kind, roads()))
    noise = make_speed_noise(one_of("speed_noise", view.get("speed_noise", NO_NOISE), (NO_NOISE, *SPEED_NOISES)), road)
    result: dict[str, Any] = {"road": road.kind, "speed_noise": noise.kind if noise else NO_NOISE}
    for name, allowed in RANGES.items():
        value = number(name, view.get(name, allowed.start))
        if not allowed.low <= value <= allowed.high:
            raise ParameterError(f"{name} must be from {allowed.low:g} to {allowed.high:g}, got {value:g}")
        result[name] = value
    if result["damping_min"] > result["damping_max"]:
        raise ParameterError(
            f"damping_min must not be above damping_max, {result['damping_max']:g}, got {result['damping_min']:g}"
        )
    result["weights"] = check_weights(view.get("weights", DISPLACEMENT), QuarterCar(), road, noise)
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
