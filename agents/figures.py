"""The pictures of a comparison: cost over speed, and how an agent uses the damper."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from roadgym.vector import QuarterCarVectorEnv

from .controllers import optimum, theoretical_cost
from .training import stream_seed

if TYPE_CHECKING:
    from .comparison import Comparison
    from .evaluation import Predictor

# Okabe and Ito's colours, told apart by readers with any colour vision, each with a mark of its own
STYLES: dict[str, dict[str, Any]] = {
    "agent": {"color": "#D55E00", "marker": "o", "zorder": 5},
    "analytic_optimum": {"color": "#0072B2", "marker": "s"},
    "d_min": {"color": "#999999", "marker": "v"},
    "d_max": {"color": "#000000", "marker": "^"},
    "skyhook": {"color": "#009E73", "marker": "D"},
}
LABELS = {
    "agent": "agent",
    "analytic_optimum": "best constant $D$",
    "d_min": "$D_{\\min}$",
    "d_max": "$D_{\\max}$",
    "skyhook": "on-off skyhook",
}


def save_figure(figure: Figure, path: Path) -> None:
    """Write the figure whole or not at all."""
    FigureCanvasAgg(figure)
    part = path.with_name(f"part-{path.name}")
    try:
        figure.savefig(part, dpi=150)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def draw_cost_over_speed(comparison: Comparison, path: Path) -> None:
    """Measured costs with error bars over the frequency ratio, and theory's curves for the constant dampings."""
    task = comparison.task
    bandwidths = sorted({point.bandwidth for point in comparison.points})
    figure = Figure(figsize=(5.2 * len(bandwidths) + 0.6, 4.6), layout="constrained")
    axes = figure.subplots(1, len(bandwidths), sharey=True, squeeze=False)[0]
    speeds = sorted({point.speed for point in comparison.points})
    fine = np.linspace(speeds[0], speeds[-1], 80)
    for axis, bandwidth in zip(axes, bandwidths, strict=True):
        for name in comparison.controllers:
            rows = [comparison.row(name, point) for point in comparison.points if point.bandwidth == bandwidth]
            rows.sort(key=lambda row: row.point.speed)
            style = STYLES.get(name, {"marker": "x"})
            ratios = [task.frequency_ratio(row.point.speed) for row in rows]
            axis.errorbar(
                ratios,
                [row.cost for row in rows],
                [2 * row.standard_error for row in rows],
                linestyle="none" if rows[0].theory is not None else "--",
                linewidth=1.2,
                markersize=5,
                capsize=2,
                label=LABELS.get(name, name),
                **style,
            )
            if rows[0].theory is not None:
                low, high = task.damping_range
                constant = {"d_min": low, "d_max": high}
                curve = [
                    optimum(task, speed, bandwidth).cost
                    if name == "analytic_optimum"
                    else theoretical_cost(task, constant[name], speed, bandwidth)
                    for speed in fine.tolist()
                ]
                axis.plot(task.frequency_ratio(fine), curve, color=style["color"], linewidth=1.2)
        axis.set_yscale("log")
        axis.set_xlabel("frequency ratio $\\nu = v\\Omega/\\omega_1$")
        axis.set_title(f"bandwidth $\\delta = {bandwidth:g}$" if bandwidth else task.road.kind)
        axis.grid(visible=True, which="both", linewidth=0.3)
    axes[0].set_ylabel("cost: weighted mean square over $E\\,Z^2$")
    axes[0].legend(
        title="marks: driven, ± 2 standard errors\nlines: theory (dashed: a guide to the eye)", fontsize=8, title_fontsize=8
    )
    save_figure(figure, path)


def draw_policy(agent: Predictor, comparison: Comparison, path: Path) -> None:
    """The damping that the agent chooses over the states that it meets, at three speeds.

    Upper row: over the velocities of the body and of the suspension, where skyhook switches on the axes. Lower row: over the
    displacement and the travel.
    """
    task = comparison.task
    bandwidth = comparison.points[0].bandwidth
    speeds = sorted({point.speed for point in comparison.points})
    shown = [speeds[0], speeds[len(speeds) // 2], speeds[-1]] if len(speeds) > 3 else speeds
    figure = Figure(figsize=(3.5 * len(shown) + 1.0, 6.8), layout="constrained")
    axes = figure.subplots(2, len(shown), squeeze=False)
    low, high = task.damping_range
    mesh: Any = None
    number, steps, skipped = 512, 150, 100
    position = {name: i for i, name in enumerate(task.signals)}
    for column, speed in enumerate(shown):
        envs = QuarterCarVectorEnv(number, max_episode_steps=None, **comparison.configuration["environment"])
        options = {"speed": speed} | ({"bandwidth": bandwidth} if bandwidth else {})
        observations, _ = envs.reset(seed=stream_seed(comparison.configuration["seed"], 2), options=options)
        seen, chosen = [], []
        for step in range(skipped + steps):
            damping, _ = agent.predict(observations)
            if step >= skipped:
                seen.append(observations)
                chosen.append(damping[:, 0])
            observations = envs.step(damping)[0]
        states = np.concatenate(seen)
        values = np.concatenate(chosen)
        signal = {name: states[:, i] for name, i in position.items()}
        relative = signal["velocity"] - task.frequency_ratio(speed) * signal["slope"]
        pairs = [(signal["velocity"], relative), (signal["displacement"], signal["displacement"] - signal["level"])]
        for row, (x, y) in enumerate(pairs):
            axis = axes[row, column]
            width, height = (np.quantile(np.abs(v), 0.995) for v in (x, y))
            mesh = axis.hexbin(
                x,
                y,
                values,
                gridsize=28,
                extent=(-width, width, -height, height),
                vmin=low,
                vmax=high,
                cmap="cividis",
                mincnt=3,
            )
            axis.set_xlim(-width, width)
            axis.set_ylim(-height, height)
            axis.axhline(0, color="white", linewidth=0.8)
            axis.axvline(0, color="white", linewidth=0.8)
        axes[0, column].set_title(
            f"$\\nu = {task.frequency_ratio(speed):g}$" + (f", $\\delta = {bandwidth:g}$" if bandwidth else "")
        )
        axes[0, column].set_xlabel("body velocity $\\dot Y/(\\omega_1 \\sigma_Z)$")
        axes[1, column].set_xlabel("displacement $Y/\\sigma_Z$")
    axes[0, 0].set_ylabel("relative velocity $(\\dot Y - \\dot Z)/(\\omega_1 \\sigma_Z)$")
    axes[1, 0].set_ylabel("travel $(Y - Z)/\\sigma_Z$")
    figure.colorbar(mesh, ax=axes, label="mean damping ratio $D$ that the agent chooses", shrink=0.8)
    save_figure(figure, path)
