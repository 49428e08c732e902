"""The interactive page in a browser, its closed forms in node, and what Python says in their place."""

import html
import json
import math
import os
import re
import shutil
import subprocess

import pytest

import analysis
import roadgym
from analysis import explorer
from roadgym import MEAN_SQUARES, ROADS

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
BROWSER = os.environ.get("ROADGYM_BROWSER") or next(filter(None, map(shutil.which, BROWSERS)), None)
NO_BROWSER = BROWSER is None and os.environ.get("ROADGYM_REQUIRE_BROWSER") != "1"
needs_browser = pytest.mark.skipif(
    NO_BROWSER,
    reason=f"no browser: none of {', '.join(BROWSERS)} is on the path, and ROADGYM_BROWSER is not set",
)
NODE = shutil.which("node")
needs_javascript = pytest.mark.skipif(NODE is None and NO_BROWSER, reason="neither node nor a browser is on the path")

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
          controls: [...document.querySelectorAll(".control")].map((e) => e.dataset.name).filter((name) => visible(name)),
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
    theory = "".join(explorer.TEMPLATE.with_name(name).read_text(encoding="utf-8") for name in ("theory.js", "two_mass.js"))
    known = {
        "plants": explorer.plants(),
        "roads": explorer.roads(),
        "search": explorer.SEARCH,
        "iso": explorer.iso_classes(),
    }
    path.write_text(
        f"""{theory}
        const known = {json.dumps(known)};
        const work = (evaluate) => {{ {script} }};
        const result = work((point) => (point.car === "two_mass" ? evaluateTwoMass : evaluate)(point, known));
        console.log(JSON.stringify(result, (key, value) => (value === Infinity ? "Infinity" : value)));""",
        encoding="utf-8",
    )
    return json.loads(subprocess.run([NODE, path], capture_output=True, check=True, text=True, timeout=300).stdout)


def components(point):
    """The road, of variance 1, and the speed noise of the page's parameters."""
    name, noise = point["road"], point["speed_noise"]
    given = {
        "harmonic": lambda: roadgym.HarmonicRoad(amplitude=math.sqrt(2)),
        "first_order": lambda: roadgym.FirstOrderRoad(noise_intensity=math.sqrt(2)),
        "gaussian": lambda: roadgym.GaussianRoad(
            bandwidth=point["bandwidth"], noise_intensity=math.sqrt(4 * point["bandwidth"])
        ),
        "multiplicative": lambda: roadgym.MultiplicativeRoad.from_shape(
            shape=point["shape"], bandwidth=point["bandwidth"], level_bound=math.sqrt(2 * (point["shape"] + 1))
        ),
        "two_corner": lambda: roadgym.TwoCornerRoad(deviation=1.0),
        "power_law": lambda: roadgym.PowerLawRoad(deviation=1.0),
    }
    road = given.get(name, ROADS.get(name))()
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
