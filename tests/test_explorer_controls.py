"""The interactive page in a browser: its numbers are Python's, and controls, address and pointer do what they say."""

import dataclasses
import json

import pytest
from explorer_page import SEE, browse, components, cost, needs_browser, optimum, ratios, shown

import analysis
import roadgym
from analysis import explorer
from roadgym import MEAN_SQUARES, ROADS, SPEED_NOISES


def as_point(view):
    """The parameters that the controls show."""
    point = {name: view["inputs"][name] for name in explorer.RANGES}
    weights = {name: view["inputs"][name] for name in MEAN_SQUARES}
    return {**point, "weights": weights, "road": view["road"], "speed_noise": view["speed_noise"]}


@needs_browser
def test_controls_show_pythons_numbers(tmp_path):
    moves = [
        ("damping", "range", 90),
        ("road", "radio", "harmonic"),
        ("speed_noise", "radio", "white"),
        ("intensity", "range", 49),
        ("frequency_ratio", "range", 87),
        ("speed_noise", "radio", "low_pass"),
        ("corner_frequency", "range", 33),
        ("acceleration", "number", 0.4),
        ("frequency_ratio", "number", 2.345),
        ("speed_noise", "radio", "high_pass"),
        ("acceleration", "number", 0),
        ("velocity", "number", 2),
        ("damping_min", "number", 0.3),
        ("road", "radio", "gaussian"),
        ("bandwidth", "range", 200),
        ("damping_max", "number", 0.1),
        ("road", "radio", "first_order"),
        ("damping_max", "number", 2),
        ("road", "radio", "two_corner"),
        ("road", "radio", "multiplicative"),
        ("shape", "range", 20),
        ("frequency_ratio", "range", 0),
        ("frequency_ratio", "number", 99),
        ("speed_noise", "radio", "low_pass"),
    ]
    views = browse(
        tmp_path, f"{SEE} const views = []; for (const m of {json.dumps(moves)}) views.push(move(...m)); return views;"
    )
    pictures = set()
    for step, view in zip(moves, views, strict=True):
        point = as_point(view)
        road, noise = components(point)
        numbers = view["numbers"]
        pictures.add(view["drawn"])
        assert (f"σ/√ω1 = {point['intensity']:g}" in view["summary"]) == (noise is not None), step
        second_order = point["road"] in ("gaussian", "multiplicative")
        assert ("bandwidth" in view["controls"], "shape" in view["controls"]) == (second_order, road.kind == "multiplicative")
        infinite = explorer.plants()[point["road"]][point["speed_noise"]]["divergent"]
        assert numbers["density_at_zero"] == shown(float(analysis.marginal_density(road, 0.0))), step
        if point["road"] == "harmonic":
            amplitude = abs(analysis.mean_amplitude(noise, damping=point["damping"], speed=point["frequency_ratio"]))
            assert numbers["mean_amplitude"] == shown(amplitude), step
            exponents = analysis.lyapunov_exponents(point["damping"])
            assert numbers["almost_sure"] == ", ".join(map(shown, exponents)), step
            rotations = analysis.rotation_numbers(point["damping"], speed=point["frequency_ratio"])
            assert numbers["rotation_numbers"] == ", ".join(map(shown, rotations)), step
        if point["road"] != "harmonic" and noise is not None:
            assert {numbers[name] for name in (*MEAN_SQUARES, "cost", "best_damping", "best_cost")} == {"–"}
            assert "no closed form" in view["notice"]
            assert view["plots"] == ["density"]
            continue
        expected = ratios(point, road, noise, point["damping"])
        for name in MEAN_SQUARES:
            assert numbers[name] == shown(float(expected[name])), (step, name)
        if any(point["weights"][name] for name in infinite):
            assert numbers["cost"] == "infinite", step
            assert numbers["best_damping"] == "–", step
            assert "Infinite on this plant" in view["notice"], step
            continue
        assert view["notice"] == "", step
        best = optimum(point, road, noise)
        assert numbers["cost"] == shown(cost(point, expected)), step
        assert numbers["best_cost"] == shown(best.cost), step
        assert numbers["best_damping"] in {shown(best.damping * (1 + shift)) for shift in (-1e-7, 0, 1e-7)}, step
        assert numbers["cost"] in view["summary"]
        assert ("amplitude-over-speed" in view["plots"]) == (point["road"] == "harmonic"), step
        assert ("spectra" in view["plots"]) == (point["road"] != "harmonic" and point["frequency_ratio"] > 0), step

        run = {}
        exec(view["python"], run)
        assert shown(run["squares"].displacement / run["road"].variance) == numbers["displacement"], step
        assert shown(run["best"].cost) == numbers["best_cost"], step
        if point["road"] == "harmonic":
            assert shown(abs(run["mean"])) == numbers["mean_amplitude"], step

    assert len(pictures) > 15
    seen = [as_point(view) for view in views]
    assert seen[0]["damping"] == pytest.approx(0.01 * 200 ** (90 / 240), rel=5e-3)
    assert seen[-2]["frequency_ratio"] == explorer.RANGES["frequency_ratio"].high  # 99 is out of range
    assert (seen[15]["damping_min"], seen[15]["damping_max"]) == (0.1, 0.1)  # the bounds push each other
    assert seen[13]["speed_noise"] == "none"  # high-pass noise is not defined on the Gaussian road
    assert views[13]["disabled"] == ["white", "high_pass"]


class Washboard(roadgym.LinearRoad):
    """A road of a reader, of 2 rad/m, under an odd name."""

    variance = 0.25

    def matrices(self):
        return [[0, 1, 0], [-1, -0.1, 1], [0, 0, -3]], [[0], [0], [1]], [1, 0, 0]


@needs_browser
def test_page_shows_a_road_of_ones_own(tmp_path):
    name = "wash_board </script>&"
    fields = [("kind", str, dataclasses.field(default=name, init=False)), ("wavenumber", float, 2.0)]
    roadgym.register("road", name, dataclasses.make_dataclass("Own", fields, bases=(Washboard,), frozen=True, kw_only=True))
    try:
        view = browse(tmp_path, f"{SEE} return see();", {"road": name, "frequency_ratio": 1.2})
        run = {}
        exec(view["python"], run)
        squares = analysis.mean_squares(name, damping=0.2, speed=0.6)
    finally:
        del ROADS[name]
    assert view["summary"].startswith("Wash board </script>& road (linear filter of order 3), no speed noise. At ν = 1.2")
    for term in MEAN_SQUARES:
        assert view["numbers"][term] == shown(float(squares[term]) / 0.25)
        assert shown(run["squares"][term] / run["road"].variance) == view["numbers"][term]
    assert view["plots"] == ["cost-over-speed", "best-over-speed", "cost-over-damping", "spectra", "density"]
    assert not {"bandwidth", "shape"} & set(view["controls"])


@needs_browser
def test_address_and_pointer(tmp_path):
    view = {"road": "gaussian", "damping": 0.37, "weights": {"velocity": 1.0}}
    wait = "await new Promise((resolve) => setTimeout(resolve, 400));"
    drag = """
    const drag = (id, part) => {
      const svg = document.getElementById(id), box = svg.getBoundingClientRect();
      const at = {clientX: box.left + part * box.width, clientY: box.top + 30, buttons: 1, bubbles: true, pointerId: 1};
      svg.setPointerCapture = () => {};
      svg.dispatchEvent(new PointerEvent("pointerdown", at));
      return see();
    };"""
    first = browse(
        tmp_path,
        f"{SEE} {drag} const views = [see(), drag('cost-over-speed', 0.75), drag('cost-over-damping', 0.999)];"
        f"{wait} return {{views, address: location.hash.slice(1)}};",
        view,
    )
    start, middle, end = map(as_point, first["views"])
    assert {name: start[name] for name in ("road", "damping")} == {"road": "gaussian", "damping": 0.37}
    assert start["weights"]["velocity"] == 1.0
    assert start["weights"]["displacement"] == 0.0
    assert 2.5 < middle["frequency_ratio"] < 3.2
    assert end["damping"] == explorer.RANGES["damping"].high

    others = [
        "speed_noise=high_pass&road=harmonic",
        "road=toString&damping=abc&shape=&bandwidth=1e9&speed_noise=white&valueOf=1",
    ]
    again, turned, odd = browse(
        tmp_path,
        f"""{SEE} const views = [see()];
        for (const address of {json.dumps(others)}) {{ location.hash = address; {wait} views.push(see()); }}
        return views;""",
        address=first["address"],
    )
    assert as_point(again) == end
    assert again["numbers"] == first["views"][-1]["numbers"]
    assert (turned["road"], turned["speed_noise"]) == ("harmonic", "high_pass")
    plain = {name: value for name, value in explorer.make_view({}).items() if name not in ("car", "iso_class", "si_weights")}
    assert as_point(odd) == plain | {"bandwidth": explorer.RANGES["bandwidth"].high}


@needs_browser
def test_controls_have_names_and_plants_are_those_of_python(tmp_path):
    found = browse(
        tmp_path,
        """const inputs = [...document.querySelectorAll("input")];
        const values = (name) => [...document.getElementsByName(name)].map((e) => e.value);
        const refused = [];
        try { window.roadgym.evaluate({road: "gaussian", speed_noise: "white"}); }
        catch (error) { refused.push(error.message); }
        return {roads: values("road"), noises: values("speed_noise"), refused,
                nameless: inputs.filter((e) => !e.labels.length && !e.getAttribute("aria-label")).length,
                labels: [...document.querySelectorAll("svg.plot")].filter((e) => e.clientHeight > 0)
                        .map((e) => e.getAttribute("aria-label"))};""",
        {"road": "harmonic", "speed_noise": "white"},
    )
    assert found["roads"] == list(explorer.roads())
    assert found["noises"] == ["none", *SPEED_NOISES]
    assert found["refused"] == ["white speed noise is not defined on a gaussian road"]
    assert found["nameless"] == 0
    assert len(found["labels"]) == 5
    assert all(found["labels"])


@needs_browser
@pytest.mark.parametrize("width", [320, 500, 870])
def test_nothing_runs_off_its_card_and_a_phone_shows_a_plot_first(width, tmp_path):
    moves = [("road", "harmonic"), ("speed_noise", "high_pass"), ("road", "gaussian"), ("speed_noise", "low_pass")]
    moves += [("car", "two_mass"), ("iso_class", "H"), ("named", "golden_car")]
    views = browse(
        tmp_path,
        f"""{SEE} const look = () => {{
          const edges = (element) => element.getBoundingClientRect();
          const words = (card) => [...card.querySelectorAll("svg text, :not(svg *)")].filter((e) => edges(e).width > 0);
          const cards = [...document.querySelectorAll(".card")].filter((card) => edges(card).height > 0);
          const off = cards.flatMap((card) => words(card).filter((e) => edges(e).right > edges(card).right + 0.5
                                                                   || edges(e).left < edges(card).left - 0.5));
          const outside = cards.filter((card) => edges(card).right > innerWidth);
          const first = cards.reduce((a, b) => (edges(b).top < edges(a).top ? b : a));
          return {{off: [...off, ...outside].map((e) => e.outerHTML), first: first.tagName, width: innerWidth}};
        }};
        const views = [look()];
        for (const [name, value] of {json.dumps(moves)}) {{ move(name, "radio", value); views.push(look()); }}
        return views;""",
        width=width,
    )
    for view in views:
        assert view == {"off": [], "first": "FIGURE" if width < 860 else "FORM", "width": width}
