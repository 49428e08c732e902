"""The interactive page says what Python says: its closed forms in node or a browser, its numbers and controls in a browser."""

import html
import itertools
import json
import math
import os
import re
import shutil
import subprocess
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest

import analysis
import roadgym
from agents.cli import main
from analysis import explorer
from roadgym import MEAN_SQUARES, SPEED_NOISES, ParameterError

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
BROWSER = os.environ.get("ROADGYM_BROWSER") or next(filter(None, map(shutil.which, BROWSERS)), None)
NO_BROWSER = BROWSER is None and os.environ.get("ROADGYM_REQUIRE_BROWSER") != "1"
needs_browser = pytest.mark.skipif(
    NO_BROWSER,
    reason=f"no browser: none of {', '.join(BROWSERS)} is on the path, and ROADGYM_BROWSER is not set",
)
NODE = shutil.which("node")
ROADS = [road.kind for road in explorer.ROADS]  # those whose closed forms the page knows
PLANTS = [(road, noise) for road in ROADS for noise in ("none", *SPEED_NOISES)]
DEFINED = [(road, noise) for road, noise in PLANTS if road == "harmonic" or noise in ("none", "low_pass")]


def browse(folder, script, view=None, address="", width=1280):
    """What ``script``, the body of an asynchronous function in the page, returns; the page is ``width`` pixels wide, in a
    frame, since windows have a least width."""
    assert BROWSER is not None, "ROADGYM_REQUIRE_BROWSER is 1, and there is no browser"
    page = explorer.write(folder / "explorer.html", view)
    runner = f"""<script>(async () => {{
      const work = async () => {{ {script} }};
      let result;
      try {{ result = await work(); }} catch (error) {{ result = {{error: String(error.stack)}}; }}
      parent.postMessage(JSON.stringify(result, (key, value) => (value === Infinity ? "Infinity" : value)), "*");
    }})();</script></body>"""
    page.write_text(page.read_text(encoding="utf-8").replace("</body>", runner), encoding="utf-8")
    frame = folder / "frame.html"
    frame.write_text(
        f"""<pre id="output"></pre>
        <script>onmessage = ({{data}}) => {{ document.getElementById("output").textContent = data; }};</script>
        <iframe style="width: {width}px; height: 800px; border: 0" src="{page.name}#{html.escape(address)}"></iframe>""",
        encoding="utf-8",
    )
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=100000",
        f"--user-data-dir={folder / 'profile'}",
    ]
    done = subprocess.run([BROWSER, *options, "--dump-dom", frame.as_uri()], capture_output=True, text=True, timeout=300)
    found = re.search(r'<pre id="output">(.+?)</pre>', done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:]
    result = json.loads(html.unescape(found[1]))
    assert not isinstance(result, dict) or "error" not in result, result["error"]
    return result


def evaluate(folder, script):
    """What ``script``, the body of a function given `evaluate`, returns: with the closed forms alone in node, or in a page."""
    if NODE is None:
        return browse(folder, f"const evaluate = window.roadgym.evaluate; {script}")
    path = folder / "script.js"
    path.write_text(
        f"""const theory = require({str(explorer.TEMPLATE.with_name("theory.js"))!r});
        const known = {{plants: {json.dumps(explorer.plants())}, search: {json.dumps(explorer.SEARCH)}}};
        const work = (evaluate) => {{ {script} }};
        const result = work((point) => theory.evaluate(point, known));
        console.log(JSON.stringify(result, (key, value) => (value === Infinity ? "Infinity" : value)));""",
        encoding="utf-8",
    )
    return json.loads(subprocess.run([NODE, path], capture_output=True, check=True, text=True, timeout=300).stdout)


def components(point):
    """The road, of variance 1, and the speed noise of the page's parameters."""
    name, noise = point["road"], point["speed_noise"]
    road = {
        "harmonic": lambda: roadgym.HarmonicRoad(amplitude=math.sqrt(2)),
        "first_order": lambda: roadgym.FirstOrderRoad(noise_intensity=math.sqrt(2)),
        "gaussian": lambda: roadgym.GaussianRoad(
            bandwidth=point["bandwidth"], noise_intensity=math.sqrt(4 * point["bandwidth"])
        ),
        "multiplicative": lambda: roadgym.MultiplicativeRoad.from_shape(
            shape=point["shape"], bandwidth=point["bandwidth"], level_bound=math.sqrt(2 * (point["shape"] + 1))
        ),
    }[name]()
    parameters = {"intensity": point["intensity"]}
    if noise in ("low_pass", "high_pass"):
        parameters["corner_frequency"] = point["corner_frequency"]
    return road, None if noise == "none" else {"kind": noise, **parameters}


def optimum(point, road, noise):
    return analysis.optimal_damping(
        road,
        noise,
        speed=point["frequency_ratio"],
        weights=point["weights"],
        bounds=(point["damping_min"], point["damping_max"]),
    )


def ratios(point, road, noise, damping):
    squares = analysis.mean_squares(road, noise, damping=damping, speed=point["frequency_ratio"])
    return {name: getattr(squares, name) / road.variance for name in MEAN_SQUARES}


def cost(point, values):
    return sum(weight * values[name] for name, weight in point["weights"].items() if weight)


def rounding_of_damping(point, road, noise, best):
    """Relative distance from the best damping within which rounding hides how the cost rises; infinite where it is flat."""
    h = 0.01
    left, middle, right = cost(point, ratios(point, road, noise, best * np.exp([-h, 0.0, h])))
    curvature = (left - 2 * middle + right) / (h * h * middle)
    return math.sqrt(64 * np.finfo(float).eps / curvature) if curvature > 1e-9 else math.inf


def sample_points():
    """Random points all over the sliders, and their corners, for every plant."""
    rng = np.random.default_rng(20)
    ranges = explorer.RANGES

    def draw(allowed):
        if allowed.logarithmic:
            return math.exp(rng.uniform(math.log(allowed.low), math.log(allowed.high)))
        return rng.uniform(allowed.low, allowed.high)

    points = []
    for road, noise in DEFINED:
        infinite = explorer.plants()[road][noise]["divergent"]
        for _ in range(20):
            point = {name: float(f"{draw(allowed):.10g}") for name, allowed in ranges.items()}
            point["damping_min"], point["damping_max"] = sorted((point["damping_min"], point["damping_max"]))
            point["weights"] = {name: float(rng.choice([0, 0.5, 1])) * (name not in infinite) for name in MEAN_SQUARES}
            point["weights"]["velocity"] += not any(point["weights"].values())
            points.append({"road": road, "speed_noise": noise, **point})
        used = ["damping"] + ["bandwidth"] * (road in ("gaussian", "multiplicative")) + ["shape"] * (road == "multiplicative")
        used += ["intensity"] * (noise != "none") + ["corner_frequency"] * (noise in ("low_pass", "high_pass"))
        ends = [(ranges[name].low, ranges[name].high) for name in used]
        for *corner, ratio in itertools.product(*ends, (0.0, 0.001, 0.99, 4.0)):
            point = {name: allowed.start for name, allowed in ranges.items()} | dict(zip(used, corner, strict=True))
            point |= {
                "damping_min": 0.01,
                "damping_max": 2.0,
                "weights": dict.fromkeys(MEAN_SQUARES, 0.0) | {"displacement": 1.0},
            }
            points.append({"road": road, "speed_noise": noise, **point, "frequency_ratio": ratio})
    return points


@pytest.mark.skipif(NODE is None and NO_BROWSER, reason="neither node nor a browser is on the path")
def test_page_computes_what_python_computes(tmp_path):
    points = sample_points()
    levels = [0.0, 0.5, -0.9, 0.999, 1.1]  # of the bound, or of three standard deviations
    frequencies = [0.0, 0.7, 1.0, 5.0]
    answers = evaluate(
        tmp_path,
        f"""return {json.dumps(points)}.map((point) => {{
          const found = evaluate(point);
          const end = Math.min(found.level_bound, 3);
          return {{...found, density: {levels}.map((part) => found.marginal_density(part * end)),
                   spectrum: {frequencies}.map(found.spectral_density)}};
        }});""",
    )
    assert len(answers) == len(points) > 400

    def same(found, expected):
        assert np.asarray(found, float) == pytest.approx(np.asarray(expected, float), rel=1e-9, abs=0), point

    for point, found in zip(points, answers, strict=True):
        road, noise = components(point)
        ratio = point["frequency_ratio"]
        bound = {"harmonic": math.sqrt(2), "multiplicative": math.sqrt(2 * (point["shape"] + 1))}.get(road.kind, math.inf)
        same(found["level_bound"], bound)
        inside = bound < math.inf
        where = [part * min(bound, 3.0) for part in levels[: 4 if inside and bound <= 3 else 5]]
        same(found["density"][: len(where)], analysis.marginal_density(road, where))
        assert found["density"][4] == 0 or bound > 3.3
        if road.kind != "harmonic" and noise is None and ratio > 0:
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

        if road.kind != "harmonic" and noise is not None:  # Python simulates
            assert found["mean_squares"] is found["cost"] is found["optimum"] is None
            continue
        expected = ratios(point, road, noise, point["damping"])
        same([found["mean_squares"][name] for name in MEAN_SQUARES], [expected[name] for name in MEAN_SQUARES])
        same(found["cost"], cost(point, expected))
        best = optimum(point, road, noise)
        same(found["optimum"]["cost"], best.cost)
        same(cost(point, ratios(point, road, noise, found["optimum"]["damping"])), best.cost)
        tolerance = rounding_of_damping(point, road, noise, float(best.damping))
        assert abs(found["optimum"]["damping"] / best.damping - 1) <= tolerance, point


def shown(value):
    """A number as the page shows it: five significant digits."""
    if value is None:
        return "–"
    if math.isinf(value):
        return "infinite"
    if value == 0:
        return "0"
    digits, exponent = f"{abs(value):.4e}".split("e")
    raised = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    plain = f"{abs(value):#.5g}".rstrip(".")
    return ("−" if value < 0 else "") + (f"{digits} · 10{raised}" if abs(int(exponent)) > 4 else plain)


# what a user sees, and how one moves the controls
SEE = """
const see = () => {
  const all = (selector, pair) => Object.fromEntries([...document.querySelectorAll(selector)].map(pair));
  const numbers = all("[data-number]", (e) => [e.dataset.number, e.textContent]);
  const inputs = all("input[type=number]", (e) => [e.name, Number(e.value)]);
  const chosen = all("input[type=radio]:checked", (e) => [e.name, e.value]);
  const visible = (id) => document.getElementById(id).getBoundingClientRect().height > 0;
  return {numbers, inputs, ...chosen, python: document.getElementById("python").textContent,
          notice: visible("notice") ? document.getElementById("notice").textContent : "",
          plots: [...document.querySelectorAll("svg.plot")].filter((svg) => visible(svg.id)).map((svg) => svg.id),
          disabled: [...document.querySelectorAll("input:disabled")].map((e) => e.value),
          summary: document.getElementById("summary").textContent, drawn: document.getElementById("cost-over-speed").innerHTML};
};
const move = (name, type, value) => {
  const element = [...document.getElementsByName(name)].find((e) => e.type === type && (type !== "radio" || e.value === value));
  if (type === "radio") element.click(); else {
    element.value = value;
    element.dispatchEvent(new Event("input", {bubbles: true}));
    element.dispatchEvent(new Event("change", {bubbles: true}));
  }
  return see();
};
"""


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
    assert as_point(odd) == explorer.make_view({}) | {"bandwidth": explorer.RANGES["bandwidth"].high}


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
                labels: [...document.querySelectorAll("svg.plot")].map((e) => e.getAttribute("aria-label"))};""",
        {"road": "harmonic", "speed_noise": "white"},
    )
    assert found["roads"] == list(ROADS)
    assert found["noises"] == ["none", *SPEED_NOISES]
    assert found["refused"] == ["white speed noise is not defined on a gaussian road"]
    assert found["nameless"] == 0
    assert all(found["labels"][:4])


@needs_browser
@pytest.mark.parametrize("width", [320, 500, 870])
def test_nothing_runs_off_its_card_and_a_phone_shows_a_plot_first(width, tmp_path):
    moves = [("road", "harmonic"), ("speed_noise", "high_pass"), ("road", "gaussian"), ("speed_noise", "low_pass")]
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


def test_page_is_one_file_and_loads_nothing(tmp_path):
    text = explorer.write(tmp_path / "page.html").read_text(encoding="utf-8")
    assert not re.findall(r"/\*\S+\*/", text)  # places of the parts and the data
    for name in explorer.PARTS:
        assert explorer.TEMPLATE.with_name(name).read_text(encoding="utf-8").strip() in text
    assert not re.findall(r"""https?:|@import|url\((?!#)|\bsrc=|\bfetch\(|href="(?!data:)""", text)
    assert roadgym.__version__ in text
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_every_part_of_the_page_is_installed():
    project = Path(__file__).parents[1] / "pyproject.toml"
    setuptools = tomllib.loads(project.read_text(encoding="utf-8"))["tool"]["setuptools"]
    assert explorer.__name__ in setuptools["packages"]
    for name in (explorer.TEMPLATE.name, *explorer.PARTS):
        assert any(fnmatch(name, pattern) for pattern in setuptools["package-data"][explorer.__name__]), name


def test_plants_are_those_that_are_defined():
    found = explorer.plants()
    assert [(road, noise) for road, noise in PLANTS if noise in found[road]] == DEFINED
    assert found["harmonic"]["high_pass"] == {"simulated": False, "divergent": ("acceleration", "relative_velocity")}
    assert found["gaussian"]["low_pass"]["simulated"]


@pytest.mark.parametrize(
    ("view", "message"),
    [
        ({"damping": 5.0}, r"damping must be from 0.01 to 2, got 5"),
        ({"damping": float("nan")}, r"damping must be finite"),
        ({"road": "gravel"}, r"road must be one of harmonic, .*'gravel'"),
        ({"speed_noise": "pink"}, r"speed_noise must be one of none, white, .*'pink'"),
        ({"road": "gaussian", "speed_noise": "white"}, r"white speed noise is defined on the harmonic road only"),
        ({"speed": 1.0}, r"name in the view must be one of road, .*'speed'"),
        ({"damping_min": 0.5, "damping_max": 0.2}, r"damping_min must not be above damping_max, 0.2, got 0.5"),
        ({"road": "first_order", "weights": {"acceleration": 1}}, r"mean square of acceleration is infinite"),
    ],
)
def test_bad_view_is_refused(view, message, tmp_path):
    with pytest.raises(ParameterError, match=message):
        explorer.write(tmp_path / "page.html", view)
    assert not list(tmp_path.iterdir())


def test_unwritable_file_is_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "folder", tmp_path / "nowhere" / "page.html"):
        with pytest.raises(ParameterError, match="cannot write"):
            explorer.write(path)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_command(tmp_path, capsys):
    path = tmp_path / "page.html"
    arguments = "--road harmonic --speed-noise white --value damping 0.3 --value intensity 0.5 --weights velocity=2"
    assert main(["explore", "--output", str(path), *arguments.split()]) == 0
    assert capsys.readouterr().out == f"{path}\n"
    data = json.loads(re.search(r'id="data">(.*?)</script>', path.read_text(encoding="utf-8"))[1])
    given = {"road": "harmonic", "speed_noise": "white", "damping": 0.3, "intensity": 0.5, "weights": {"velocity": 2.0}}
    assert data["view"] == explorer.make_view(given)
    assert main(["explore", "--output", str(path), "--value", "damping", "9"]) == 2
    assert "damping must be from" in capsys.readouterr().err
