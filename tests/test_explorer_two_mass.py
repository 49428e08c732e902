"""The page's car of two masses: its theory is that of Python, in node and in a browser, and its controls do what they say."""

import json
import math

import numpy as np
import pytest
from explorer_page import SEE, browse, evaluate, needs_browser, needs_javascript, shown

import analysis
import roadgym
from analysis import explorer
from roadgym.cars import make_car

CAR = roadgym.TwoMassCar()
FACTORS = {"acceleration": 1, "velocity": 1, "wheel_velocity": 1, "relative_velocity": 1, "wheel_load": 1}  # others are in mm


def car_of(point):
    return roadgym.TwoMassCar(**{name: point[name] for name in explorer.PARAMETERS})


def plant_of(point):
    road = f"iso_{point['iso_class'].lower()}"
    return {"road": road, "car": car_of(point), "speed": point["kilometres_per_hour"] / 3.6}


def weights_of(point):
    return {name: point["si_weights"][f"si_{name}"] for name in CAR.mean_squares}


def optimum(point):
    bounds = (point["damping_min"], point["damping_max"])
    return analysis.optimal_damping(**plant_of(point), weights=weights_of(point), bounds=bounds)


def sample_points():
    """Random points all over the sliders, on roads of every class, and the named cars."""
    rng = np.random.default_rng(31)
    points = [{**explorer.make_view({"car": name}), "iso_class": "E"} for name in explorer.cars()]
    for number in range(48):
        point = {"car": "two_mass", "iso_class": "ABCDEFGH"[number % 8]}
        for name, allowed in explorer.RANGES.items():
            ends = (math.log(allowed.low), math.log(allowed.high)) if allowed.logarithmic else (allowed.low, allowed.high)
            value = rng.uniform(*ends)
            point[name] = float(f"{math.exp(value) if allowed.logarithmic else value:.6g}")
        point["unsprung_mass"] = max(0.1, float(f"{point['sprung_mass'] * rng.uniform(0.05, 0.3):.6g}"))
        point["tyre_rate"] = max(200.0, float(f"{point['spring_rate'] * rng.uniform(3, 20):.6g}"))
        point["damping_min"], point["damping_max"] = sorted((point["damping_min"], point["damping_max"]))
        scale = {"acceleration": 1.0, "travel": 300.0, "tyre_deflection": 1e4, "wheel_load": 1e-6, "velocity": 3.0}
        point["si_weights"] = {f"si_{name}": float(rng.choice([0, 0.5, 1])) * scale.get(name, 0.0) for name in CAR.mean_squares}
        point["si_weights"]["si_relative_velocity"] = 0.1
        points.append(point)
    return points


@needs_javascript
def test_page_computes_what_python_computes(tmp_path):
    points = sample_points()
    answers = evaluate(tmp_path, f"return {json.dumps(points)}.map(evaluate);")
    for point, found in zip(points, answers, strict=True):
        car, plant = car_of(point), plant_of(point)
        squares = analysis.mean_squares(**plant, damping=point["damping"])
        expected = {name: float(squares[name]) for name in car.mean_squares}
        assert found["mean_squares"] == pytest.approx(expected, rel=1e-9), point
        cost = sum(weight * expected[name] for name, weight in weights_of(point).items())
        assert found["cost"] == pytest.approx(cost, rel=1e-9)
        best = optimum(point)
        assert found["optimum"]["cost"] == pytest.approx(float(best.cost), rel=1e-9), point
        assert found["optimum"]["damping"] == pytest.approx(float(best.damping), rel=1e-4), point
        assert found["damping_unit"] == pytest.approx(float(car.damping_coefficient(1.0)), rel=1e-12)
        assert found["static_load"] == pytest.approx(car.static_load, rel=1e-12)
        frequencies = np.sort(np.abs(np.linalg.eigvals(car.motion.drift)))[::2] * car.natural_frequency / (2 * math.pi)
        assert found["frequencies"] == pytest.approx(frequencies.tolist(), rel=1e-6)


@needs_javascript
def test_closed_forms_of_white_velocity(tmp_path):
    """D. Hrovat 1997: what the page draws, where the waves of more than 100 m that the road lacks hardly matter."""
    point = {**explorer.make_view({"car": "two_mass"}), "iso_class": "C"}
    (found,) = evaluate(tmp_path, f"return [{json.dumps(point)}].map(evaluate);")
    c, m_s, total = float(CAR.damping_coefficient(point["damping"])), CAR.sprung_mass, CAR.sprung_mass + CAR.unsprung_mass
    strength = 2 * math.pi**2 * 0.1**2 * 256e-6 * 20
    k_s, k_t = CAR.spring_rate, CAR.tyre_rate
    assert found["mean_squares"]["acceleration"] == pytest.approx(
        strength * (c**2 * k_t + k_s**2 * total) / (2 * c * m_s**2), rel=0.02
    )
    assert found["mean_squares"]["relative_velocity"] == pytest.approx(strength * k_t / (2 * c), rel=0.01)


def test_named_cars_are_those_of_the_environment():
    for name, values in explorer.cars().items():
        car = make_car(name)
        assert car_of(values) == roadgym.TwoMassCar(**{key: getattr(car, key) for key in explorer.PARAMETERS})
        assert (values["damping_min"], values["damping_max"]) == pytest.approx(car.default_damping_range, rel=5e-3)
        for key, value in values.items():
            assert explorer.RANGES[key].low <= value <= explorer.RANGES[key].high, (name, key)


def as_point(view):
    """What the controls show."""
    point = {name: view["inputs"][name] for name in explorer.RANGES}
    weights = {f"si_{name}": view["inputs"][f"si_{name}"] for name in CAR.mean_squares}
    return {**point, "car": view["car"], "iso_class": view["iso_class"], "si_weights": weights}


@needs_browser
def test_controls_show_pythons_numbers(tmp_path):
    moves = [
        ("car", "radio", "two_mass"),
        ("named", "radio", "renault_megane"),
        ("iso_class", "radio", "E"),
        ("kilometres_per_hour", "number", 110),
        ("coefficient", "number", 1500),
        ("si_tyre_deflection", "number", 25000),
        ("sprung_mass", "range", 200),
        ("tyre_rate", "number", 1e9),
        ("damping", "range", 150),
        ("si_acceleration", "number", 0),
        ("si_tyre_deflection", "number", 0),
        ("named", "radio", "golden_car"),
        ("si_travel", "number", 2),
    ]
    views = browse(
        tmp_path,
        f"{SEE} const views = []; for (const m of {json.dumps(moves)}) views.push({{...move(...m)}}); "
        "const back = move('car', 'radio', 'one_mass'); return [...views, back];",
    )
    for step, view in zip(moves, views, strict=False):
        point, numbers = as_point(view), view["numbers"]
        car = car_of(point)
        squares = analysis.mean_squares(**plant_of(point), damping=point["damping"])
        for name in car.mean_squares:
            root = FACTORS.get(name, 1000) * math.sqrt(float(squares[name]))
            assert numbers[f"si_{name}"] == shown(root), (step, name)
        assert view["inputs"]["coefficient"] == pytest.approx(car.damping_coefficient(point["damping"]), rel=1e-5)
        share = math.sqrt(float(squares.wheel_load)) / car.static_load
        assert numbers["load_share"] == shown(share), step
        assert f"class {point['iso_class']} at {point['kilometres_per_hour']:g} km/h" in view["summary"]
        assert ("kilometres_per_hour" in view["controls"], "frequency_ratio" in view["controls"]) == (True, False)
        if not any(point["si_weights"].values()):
            assert numbers["si_best_damping"] == "–"
            assert "si-cost-over-damping" not in view["plots"]
            continue
        best = optimum(point)
        assert numbers["si_best_cost"] == shown(float(best.cost)), step
        assert numbers["si_best_damping"] in {shown(float(best.damping) * (1 + shift)) for shift in (-1e-6, 0, 1e-6)}, step
        assert "si-cost-over-damping" in view["plots"]
        run = {}
        exec(view["python"], run)
        assert shown(float(run["best"].cost)) == numbers["si_best_cost"], step
        assert shown(math.sqrt(float(run["squares"].acceleration))) == numbers["si_acceleration"], step
    seen = [as_point(view) for view in views[:-1]]
    assert seen[1]["spring_rate"] == 29.5e3
    assert seen[2]["iso_class"] == "E"
    assert seen[4]["damping"] == pytest.approx(float(car_of(seen[4]).damping_ratio(1500.0)))
    assert seen[7]["tyre_rate"] == explorer.RANGES["tyre_rate"].high
    assert seen[11]["tyre_rate"] == 653.0
    assert [views[k]["named"] for k in (0, 1, 11)] == ["two_mass", "renault_megane", "golden_car"]
    assert "named" not in views[6]  # no car of a name has that mass
    assert views[0]["plots"] == [
        "acceleration-over-damping",
        "travel-over-damping",
        "load-over-damping",
        "load-over-acceleration",
        "travel-over-acceleration",
        "si-cost-over-damping",
    ]
    assert views[-1]["plots"][0] == "cost-over-speed"
    assert "kilometres_per_hour" not in views[-1]["controls"]


@needs_browser
def test_address_and_pointer(tmp_path):
    view = {"car": "savaresi", "road": "iso_d", "weights": {"wheel_load": 1e-6}, "damping": 0.25}
    drag = """
    const svg = document.getElementById("load-over-damping"), box = svg.getBoundingClientRect();
    svg.setPointerCapture = () => {};
    const at = {clientX: box.left + 0.7 * box.width, clientY: box.top + 30, buttons: 1, bubbles: true, pointerId: 1};
    svg.dispatchEvent(new PointerEvent("pointerdown", at));"""
    wait = "await new Promise((resolve) => setTimeout(resolve, 400));"
    views, address = browse(
        tmp_path,
        f"{SEE} const views = [see()]; {drag} views.push(see()); {wait} return [views, location.hash.slice(1)];",
        view,
    )
    start, dragged = map(as_point, views)
    assert start == {name: value for name, value in explorer.make_view(view).items() if name in start}
    assert 0.3 < dragged["damping"] < 0.45
    again = browse(tmp_path, f"{SEE} return see();", address=address)
    assert as_point(again) == dragged
    assert again["numbers"] == views[-1]["numbers"]
