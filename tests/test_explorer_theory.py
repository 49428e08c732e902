"""The closed forms of the interactive page are those of Python, in node or a browser."""

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
from explorer_page import components, cost, evaluate, needs_javascript, optimum, ratios

import analysis
import roadgym
from analysis import explorer
from roadgym import MEAN_SQUARES, ROADS


def rounding_of_damping(point, road, noise, best, rounding):
    """Relative distance from the best damping within which rounding hides how the cost rises; infinite where it is flat."""
    h = 0.01
    left, middle, right = cost(point, ratios(point, road, noise, best * np.exp([-h, 0.0, h])))
    curvature = (left - 2 * middle + right) / (h * h * middle)
    return math.sqrt(rounding / curvature) if curvature > 1e-9 else math.inf


def sample_points(roads):
    """Random points all over the sliders, and their corners, for every plant on these roads."""
    rng = np.random.default_rng(20)
    ranges = explorer.RANGES

    def draw(allowed):
        if allowed.logarithmic:
            return math.exp(rng.uniform(math.log(allowed.low), math.log(allowed.high)))
        return rng.uniform(allowed.low, allowed.high)

    points = []
    plants = [(road, noise, plant) for road in roads for noise, plant in explorer.plants()[road].items()]
    for road, noise, plant in plants:
        infinite = plant["divergent"]
        for _ in range(20):
            point = {name: float(f"{draw(allowed):.10g}") for name, allowed in ranges.items()}
            point["damping_min"], point["damping_max"] = sorted((point["damping_min"], point["damping_max"]))
            point["weights"] = {name: float(rng.choice([0, 0.5, 1])) * (name not in infinite) for name in MEAN_SQUARES}
            point["weights"]["velocity"] += not any(point["weights"].values())
            points.append({"road": road, "speed_noise": noise, **point})
        used = ["damping"] + ["bandwidth"] * (road in ("gaussian", "multiplicative")) + ["shape"] * (road == "multiplicative")
        used += ["intensity"] * (noise != "none") + ["corner_frequency"] * (noise in ("low_pass", "high_pass"))
        ends = [(ranges[name].low, ranges[name].high) for name in used]
        # on a filter without closed form Python refuses rest, and has eight digits at the lowest speeds
        slowest = (0.01,) if "filter" in explorer.roads()[road] else (0.0, 0.001)
        for *corner, ratio in itertools.product(*ends, (*slowest, 0.99, 4.0)):
            point = {name: allowed.start for name, allowed in ranges.items()} | dict(zip(used, corner, strict=True))
            point |= {
                "damping_min": 0.01,
                "damping_max": 2.0,
                "weights": dict.fromkeys(MEAN_SQUARES, 0.0) | {"displacement": 1.0},
            }
            points.append({"road": road, "speed_noise": noise, **point, "frequency_ratio": ratio})
    return points


def compare(points, folder):
    """Hold every number of the page at these points against Python's."""
    levels = [0.0, 0.5, -0.9, 0.999, 1.1]  # of the bound, or of three standard deviations
    frequencies = [0.0, 0.7, 1.0, 5.0]
    answers = evaluate(
        folder,
        f"""return {json.dumps(points)}.map((point) => {{
          const found = evaluate(point);
          const end = Math.min(found.level_bound, 3);
          return {{...found, density: {levels}.map((part) => found.marginal_density(part * end)),
                   spectrum: {frequencies}.map(found.spectral_density)}};
        }});""",
    )
    assert len(answers) == len(points)
    declared = explorer.roads()

    def same(found, expected):
        assert np.asarray(found, float) == pytest.approx(np.asarray(expected, float), rel=1e-9, abs=0), point

    for point, found in zip(points, answers, strict=True):
        road, noise = components(point)
        ratio = point["frequency_ratio"]
        if road.lines is not None and len(road.lines) > 1:
            assert [found["level_bound"], *found["density"]] == [None] * 6
        else:
            bound = {"harmonic": math.sqrt(2), "multiplicative": math.sqrt(2 * (point["shape"] + 1))}.get(road.kind, math.inf)
            same(found["level_bound"], bound)
            inside = bound < math.inf
            where = [part * min(bound, 3.0) for part in levels[: 4 if inside and bound <= 3 else 5]]
            same(found["density"][: len(where)], analysis.marginal_density(road, where))
            assert found["density"][4] == 0 or bound > 3.3
        if road.lines is None and noise is None and ratio > 0:
            same(found["spectrum"], analysis.spectral_density(road, frequencies, speed=ratio))
        else:
            assert found["spectrum"] == [None] * len(frequencies)

        if road.kind == "harmonic":
            same(found["mean_amplitude"], abs(analysis.mean_amplitude(noise, damping=point["damping"], speed=ratio)))
            stability = found["stability"]
            same(stability["almost_sure"], analysis.lyapunov_exponents(point["damping"]))
            same(stability["rotation_numbers"], analysis.rotation_numbers(point["damping"], speed=ratio))
            if point["speed_noise"] in ("none", "white"):
                intensity = point["intensity"] if noise else 0.0
                same(stability["mean"], analysis.lyapunov_exponents(point["damping"], intensity=intensity, sense="mean"))
            else:
                assert stability["mean"] is None
        else:
            assert found["mean_amplitude"] is found["stability"] is None

        if noise is not None and not road.takes_phase_noise:  # Python simulates
            assert found["mean_squares"] is found["cost"] is found["optimum"] is None
            continue
        expected = ratios(point, road, noise, point["damping"])
        same([found["mean_squares"][name] for name in MEAN_SQUARES], [expected[name] for name in MEAN_SQUARES])
        same(found["cost"], cost(point, expected))
        best = optimum(point, road, noise)
        same(found["optimum"]["cost"], best.cost)
        same(cost(point, ratios(point, road, noise, found["optimum"]["damping"])), best.cost)
        rounding = 1e-12 if "filter" in declared[point["road"]] else 64 * np.finfo(float).eps
        tolerance = rounding_of_damping(point, road, noise, float(best.damping), rounding)
        assert abs(found["optimum"]["damping"] / best.damping - 1) <= tolerance, point


@needs_javascript
def test_page_computes_what_python_computes(tmp_path):
    points = sample_points(explorer.roads())
    assert len(points) > 400
    compare(points, tmp_path)


class OwnRoad(roadgym.LinearRoad):
    """Random matrices of unit scale."""

    variance = 1.0

    def matrices(self):
        rng = np.random.default_rng(7 + self.order)
        drift = rng.normal(size=(self.order, self.order))
        drift -= (np.linalg.eigvals(drift).real.max() + 0.2) * np.eye(self.order)
        noise, level = rng.normal(size=(self.order, 2)), rng.normal(size=self.order)
        if self.has_slope:
            noise[0], level[1:] = 0.0, 0.0
        return drift, noise, level


class TwoWaves(roadgym.Road):
    """Theory is all that is known of it."""

    variance = 1.0
    lines = ((0.7, 1.0), (0.3, 1.7))
    takes_phase_noise = True


class Unknown(roadgym.Road):
    """Not even theory is."""

    variance = 1.0


def own_road(name, base, **attributes):
    """A dataclass of that kind."""
    kind = dataclasses.field(default=name, init=False)
    made = dataclasses.make_dataclass(
        name, [("kind", str, kind)], bases=(base,), namespace=attributes, frozen=True, kw_only=True
    )
    return made


@pytest.fixture
def own_roads():
    """Registered roads of a reader, by kind."""
    roads = [own_road(f"order_{order}", OwnRoad, order=order, has_slope=True) for order in (2, 3, 4)]
    roads += [own_road(f"rough_{order}", OwnRoad, order=order, has_slope=False) for order in (1, 3, 4)]
    roads += [own_road("two_waves", TwoWaves), own_road("unknown", Unknown)]
    for road in roads:
        roadgym.register("road", road.__name__, road)
    yield {road.__name__: road for road in roads}
    for road in roads:
        del ROADS[road.__name__]


@needs_javascript
def test_roads_of_ones_own_are_picked_up(own_roads, tmp_path):
    known = [name for name in own_roads if name != "unknown"]
    assert list(explorer.roads())[-len(known) :] == known
    compare(sample_points(known), tmp_path)


@needs_javascript
def test_at_rest_the_car_is_as_high_as_the_road(own_roads, tmp_path):
    point = explorer.make_view({"frequency_ratio": 0.0})
    points = [{**point, "road": road} for road in explorer.roads()]
    for found in evaluate(tmp_path, f"return {json.dumps(points)}.map(evaluate);"):
        expected = dict.fromkeys(MEAN_SQUARES, 0.0) | {"displacement": 1.0}
        assert found["mean_squares"] == pytest.approx(expected, abs=1e-12)
        assert found["optimum"]["damping"] == point["damping_min"]


def test_road_without_default_parameters_is_left_out():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Needy(roadgym.GaussianRoad):
        kind: str = dataclasses.field(default="needy", init=False)
        age: float

    roadgym.register("road", "needy", Needy)
    try:
        assert "needy" not in explorer.roads()
    finally:
        del ROADS["needy"]
