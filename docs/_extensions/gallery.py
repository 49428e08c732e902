"""Draws what the pages show: the paper's figures, three of our own, a certificate, and the errata in numbers.

It is done before the pages are read, into ``_generated``, and not again until the sources change. The interactive page goes
into the build.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from sphinx.application import Sphinx

import analysis
import roadgym
from agents.controllers import make_controller
from agents.evaluation import evaluate
from agents.figure_style import save_figure
from agents.names import title as name_shown
from agents.records import write_atomically
from analysis import explorer
from analysis.paper import errata, figures
from roadgym.task import make_task

ROOT = Path(__file__).parents[2]
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"


def write(folder: Path) -> None:
    """Write everything into ``folder``, if the sources have changed since the last time."""
    packages = (ROOT / "roadgym", ROOT / "analysis", ROOT / "agents" / "controllers")
    sources = [Path(__file__), *(path for package in packages for path in sorted(package.rglob("*.py")))]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    folder.mkdir(exist_ok=True)
    stamp = folder / "digest"
    if stamp.exists() and stamp.read_text() == digest:
        return
    figures.write(folder)
    draw_roads(folder / "roads.png")
    draw_cost_over_damping(folder / "cost_over_damping.png")
    draw_comfort_and_grip(folder / "comfort_and_grip.png")
    write_atomically(folder / "certificate.md", certificate_table())
    write_atomically(folder / "errata.md", errata_table())
    write_atomically(stamp, digest)


def draw_roads(path: Path) -> None:
    """The level of each road over the distance, all from the environment itself."""
    bounded = roadgym.MultiplicativeRoad
    noise = roadgym.LowPassSpeedNoise(intensity=0.6, corner_frequency=0.3)
    cases: list[tuple[str, Any, Any]] = [
        ("harmonic", "harmonic", None),
        ("harmonic, low-pass speed noise", "harmonic", noise),
        ("first order", "first_order", None),
        ("Gaussian, $\\delta = 0.1$", "gaussian", None),
        ("multiplicative, $\\delta = 0.1$, $\\alpha = 2$", bounded.from_shape(shape=2.0), None),
        ("multiplicative, $\\delta = 0.1$, $\\alpha = 1/2$", bounded.from_shape(shape=0.5), None),
    ]
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True, sharey=True)
    for axis, (title, road, speed_noise) in zip(axes.flat, cases, strict=True):
        env = gym.make(roadgym.ENVIRONMENT_ID, road=road, speed_noise=speed_noise, control_interval=0.1, max_episode_steps=1000)
        env.reset(seed=4)
        place = env.unwrapped.signal_names.index("level")
        level = [env.step(np.array([0.3], np.float32))[0][place] for _ in range(800)]
        axis.plot(np.arange(1, 801) * 0.1 / (2 * np.pi), level, color=BLUE, linewidth=1.0)
        plant_road = env.unwrapped.task.road
        if isinstance(plant_road, bounded):
            for side in (1, -1):
                axis.axhline(side * plant_road.level_bound / plant_road.variance**0.5, color=VERMILION, linewidth=1.0)
        axis.set_title(title, fontsize=10)
        axis.grid(visible=True, linewidth=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("mean distance over wavelength $vt\\,\\Omega/2\\pi$")
    for axis in axes[:, 0]:
        axis.set_ylabel("level $Z/\\sigma_Z$")
    axes[0, 0].set(xlim=(0, 800 * 0.1 / (2 * np.pi)), ylim=(-3.4, 3.4))
    save_figure(figure, path)


def draw_cost_over_damping(path: Path) -> None:
    """Cost of constant dampings: theory's curves, the optimum on them, and what the environment paid."""
    road = roadgym.MultiplicativeRoad.from_shape(shape=2.0, bandwidth=0.1)
    cars, skipped, steps = 2048, 500, 500
    fine, driven = np.geomspace(0.05, 1.0, 200), np.geomspace(0.06, 0.9, 7)
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axis = figure.subplots()
    for speed, color, line in ((1.0, VERMILION, "-"), (1.5, BLUE, "--"), (2.0, GREEN, "-.")):
        curve = analysis.mean_squares(road, damping=fine, speed=speed).displacement / road.variance
        axis.plot(fine, curve, color=color, linestyle=line, label=f"$\\nu = {speed:g}$")
        best = analysis.optimal_damping(road, speed=speed)
        axis.plot(best.damping, best.cost, marker="*", markersize=13, color=color, clip_on=False, linestyle="none", zorder=4)
        envs = gym.make_vec(roadgym.ENVIRONMENT_ID, num_envs=cars, max_episode_steps=None, road=road, speed=speed)
        for damping in driven:
            envs.reset(seed=7)
            action = np.full((cars, 1), damping, np.float32)
            costs = np.zeros(cars)
            for step in range(skipped + steps):
                rewards = envs.step(action)[1]
                costs -= rewards if step >= skipped else 0.0
            costs /= steps
            axis.errorbar(damping, costs.mean(), 2 * costs.std(ddof=1) / cars**0.5, color=color, marker="o", ms=4, capsize=2)
    axis.set(xscale="log", yscale="log", xlabel="damping ratio $D$", ylabel="cost $E\\,Y^2/E\\,Z^2$", xlim=(0.05, 1.0))
    axis.set_xticks([0.05, 0.1, 0.2, 0.5, 1.0], ["0.05", "0.1", "0.2", "0.5", "1"])
    axis.set_yticks([0.5, 1, 2, 5, 10], ["0.5", "1", "2", "5", "10"])
    axis.minorticks_off()
    axis.grid(visible=True, linewidth=0.3)
    axis.legend(title="line: theory (16); ★: optimum\nmarks: driven, ± 2 standard errors", fontsize=9, title_fontsize=8)
    save_figure(figure, path)


def draw_comfort_and_grip(path: Path) -> None:
    """The car of two masses on a road of class C: constant dampings by theory, and what they and controllers drive."""
    environment = {"car": "two_mass", "road": "iso_c", "speed": 20.0, "reward": {"acceleration": 1.0, "tyre_deflection": 3e4}}
    task = make_task(**environment)
    names = {
        "skyhook": "D",
        "groundhook": "s",
        "hybrid": "P",
        "power_driven": "^",
        "clipped_lqr": "v",
        "mixed_lookahead": "X",
    }
    drivers: dict[str, Any] = {name: make_controller(name, task) for name in names}
    driven = evaluate(drivers, environment=environment, speeds=[20.0], episodes=128, duration=10.0)

    def place(squares: Any) -> tuple[Any, Any, Any]:
        return np.sqrt(squares["acceleration"]), np.sqrt(squares["wheel_load"]), 1e3 * np.sqrt(squares["travel"])

    fine, marked = np.geomspace(*task.damping_range, 200), np.array([0.1, 0.2, 0.3, 0.5, 0.7, 1.0])
    curve, dots = (
        place(analysis.mean_squares(task.road, damping=damping, speed=20.0, car=task.car)) for damping in (fine, marked)
    )
    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
    for axis, across, label in zip(figure.subplots(1, 2), (1, 2), ("wheel load, N", "travel, mm"), strict=True):
        axis.plot(curve[0], curve[across], color=BLUE, linewidth=1.4, label="constant $D$: theory")
        axis.plot(dots[0], dots[across], ".", color=BLUE)
        for damping, x, y in zip(marked.tolist(), dots[0], dots[across], strict=True):
            axis.annotate(f"{damping:g}", (x, y), (5, 3), textcoords="offset points", fontsize=8, color=BLUE)
        for (name, marker), color in zip(
            names.items(), (GREEN, "#CC79A7", "#E69F00", "#56B4E9", "#000000", VERMILION), strict=True
        ):
            found = dict(zip(driven[name].names, driven[name].mean_squares[:, 0].tolist(), strict=True))
            here = place(found)
            axis.plot(here[0], here[across], marker, color=color, label=name_shown(name), markersize=7)
        axis.set(xlabel="acceleration, m/s²", ylabel=label)
        axis.grid(visible=True, linewidth=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    save_figure(figure, path)


def certificate_table() -> str:
    """The lines of a certificate; a bound is exact and has no error."""
    rows = [("figure", "measured", "expected", "standard error", "distance", "verdict")]
    for line in analysis.certify("multiplicative", speed=1.5).lines:
        errors = ("exact", "")
        if line.standard_error is not None and line.distance is not None:
            errors = (f"{line.standard_error:.2g}", f"{line.distance:.2f}")
        verdict = "pass" if line.passed else "FAIL"
        rows.append((line.name, f"{line.measured:.5g}", f"{line.expected:.5g}", *errors, verdict))
    return markdown(rows)


def errata_table() -> str:
    """Every entry with the numbers of both formulas and of the evidence, a table for each kind."""
    checks = errata.run()
    tables = []
    for kind, heading in errata.KINDS.items():
        rows = [("erratum", "quantity", "printed", "right", "evidence", "printed off", "right off")]
        for check in checks:
            if check.kind == kind:
                off = (check.off(value) for value in (check.printed, check.right))
                formulas = (f"{check.printed:.4g}", f"{check.right:.4g}")
                rows.append((f"`{check.name}`", check.quantity, *formulas, check.found_text(), *off))
        tables.append(f"### {heading}, in numbers\n\n{markdown(rows)}")
    return "\n".join(tables)


def markdown(rows: list[tuple[str, ...]]) -> str:
    """A table, its first row the head; `|` is a sign here."""
    rule = tuple("---" for _ in rows[0])
    lines = [" | ".join(cell.replace("|", "\\|") for cell in row) for row in (rows[0], rule, *rows[1:])]
    return "".join(f"| {line} |\n" for line in lines)


def setup(app: Sphinx) -> dict[str, bool]:
    """Draw before the pages are read."""
    app.connect("builder-inited", lambda app: write(Path(app.srcdir) / "_generated"))
    app.connect("build-finished", lambda app, error: explorer.write(Path(app.outdir) / "explorer.html"))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
