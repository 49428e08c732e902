"""Figures 11-14 of Wedig (2020): angles of the free motion, rotation numbers, and the stability map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.installation import needs

from ..checks import FloatArray
from .drawing import BLACK, BLUE, GREEN, PRINTED, SPEED_LABEL, STABLE, STYLE, VERMILION, Drawing, Report, Table, panels
from .stability import critical_noise, rotation_numbers

with needs("report"):
    from matplotlib.figure import Figure


def stability_angles(damping: float, share: complex, time: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles (Delta, Psi) of (38), (39) along the exact solution: Delta = arg y - arg x and tan Psi = |x/y| for the complex
    free motion y = e^(a t) + share e^(b t), x = y', of the car with the roots a, b; D other than 1, time in units of 1/w1.
    """
    root = np.emath.sqrt((damping - 1) * (damping + 1))
    slow, fast = np.exp((root - damping) * time), share * np.exp((-root - damping) * time)
    y, x = slow + fast, (root - damping) * slow + (-root - damping) * fast
    return np.angle(y / x), np.arctan2(np.abs(x), np.abs(y))


def _draw_angles(axis: Any, angle: FloatArray, stability: FloatArray, **style: Any) -> None:
    """A path in the plane of both angles and its mirror image (Delta + pi, -Psi), cut where Delta wraps."""
    for shift, sign in ((0.0, 1.0), (math.pi, -1.0)):
        x = (angle + shift + math.pi) % (2 * math.pi) - math.pi
        x[np.abs(np.diff(x, append=x[-1])) > math.pi] = np.nan
        axis.plot(x, sign * stability, **style)
        middle = len(x) // 2
        if np.isfinite(x[middle : middle + 2]).all():
            ends = [(x[k], sign * stability[k]) for k in (middle, middle + 1)]
            arrow = {"arrowstyle": "-|>", "color": style["color"], "linewidth": 0.8}
            axis.annotate("", xy=ends[1], xytext=ends[0], arrowprops=arrow)


def _angle_axes() -> tuple[Figure, Any]:
    figure, [[axis]] = panels(width=6.4, height=4.6)
    ticks = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    axis.set_xticks(math.pi * ticks, ["$-\\pi$", "$-\\pi/2$", "0", "$\\pi/2$", "$\\pi$"])
    axis.set_yticks(math.pi / 2 * ticks, ["$-\\pi/2$", "$-\\pi/4$", "0", "$\\pi/4$", "$\\pi/2$"])
    axis.set(xlim=(-math.pi, math.pi), ylim=(-math.pi / 2, math.pi / 2))
    axis.set(xlabel="difference angle $\\Delta$ (rad)", ylabel="stability angle $\\Psi$ (rad)")
    return figure, axis


def _angle_table(paths: Sequence[tuple[FloatArray, FloatArray, FloatArray]]) -> Table:
    time, angle, stability = (np.concatenate(part) for part in zip(*paths, strict=True))
    number = np.repeat(np.arange(len(paths)), [len(path[0]) for path in paths])
    return {
        "path": number,
        "time (1/natural frequency)": time,
        "difference angle (rad)": angle,
        "stability angle (rad)": stability,
    }


def figure_11(full: bool = False, report: Report | None = None) -> Drawing:
    """Angles of (38), (39) at D = 0.5: neutral closed orbits about four centres, one orbit for each start."""
    figure, axis = _angle_axes()
    damping = 0.5
    own = math.sqrt(1 - damping**2)
    time = np.linspace(0, math.pi / own, 801)
    paths = []
    for share in (0.1, 0.25, 0.45, 0.7, 0.9):
        for turned in (False, True):  # the other mode is the larger one: the mirror image in Delta
            angle, stability = stability_angles(damping, complex(1 / share if turned else share), time)
            paths.append((time, angle, stability))
            _draw_angles(axis, angle, stability, color=BLUE, linewidth=1.1)
    for sign in (1, -1):
        for centre in (math.pi - math.acos(damping), math.acos(damping) - math.pi):
            place = centre if sign > 0 else centre - math.copysign(math.pi, centre)
            axis.plot(place, sign * math.pi / 4, "o", color=VERMILION, markersize=6, zorder=3)
    axis.plot([], [], color=BLUE, label="closed orbits")
    axis.plot([], [], "o", color=VERMILION, label="centres, $\\Psi = \\pm\\pi/4$, $\\cos\\Delta = \\mp D$")
    figure.legend(loc="outside upper center", ncols=2)
    return Drawing(figure, {"": _angle_table(paths)})


def figure_12(full: bool = False, report: Report | None = None) -> Drawing:
    """Angles of (38), (39) at D = 1.5: every path ends in the fixed point of the slow root."""
    figure, axis = _angle_axes()
    damping = 1.5
    root = math.sqrt(damping**2 - 1)
    time = np.linspace(-3.0, 3.0, 1201)
    paths = []
    for turn in (0.03, 0.12, 0.25, 0.4, 0.6, 0.85):
        for side in (1, -1):
            angle, stability = stability_angles(damping, complex(np.exp(1j * math.pi * side * turn)), time)
            paths.append((time, angle, stability))
            _draw_angles(axis, angle, stability, color=BLUE, linewidth=1.1)
    for rate, mark, label in ((damping - root, "o", "stable fixed points"), (damping + root, "s", "unstable fixed points")):
        height = math.atan(rate)
        axis.plot(
            [math.pi, -math.pi, 0],
            [height, height, -height],
            mark,
            color=VERMILION if mark == "o" else BLACK,
            clip_on=False,
            linestyle="none",
            markersize=7,
            zorder=3,
            label=f"{label}, $\\sin 2\\Psi = \\pm 1/D$",
        )
    axis.plot([], [], color=BLUE, label="paths")
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    return Drawing(figure, {"": _angle_table(paths)})


def figure_13(full: bool = False, report: Report | None = None) -> Drawing:
    """Rotation numbers (42), (43) over the speed, D = 0, 0.9 and 1."""
    figure, [[axis]] = panels()
    speed = np.linspace(0.0, 2.0, 201)
    columns: dict[str, npt.ArrayLike] = {"frequency ratio (1)": speed}
    for damping, color, line in ((0.0, VERMILION, "-"), (0.9, GREEN, (0, (5, 1.5))), (1.0, BLACK, "-.")):
        for name, values in zip(("upper", "lower"), rotation_numbers(damping, speed=speed), strict=True):
            columns[f"{name} at D={damping:g} (1)"] = values
            label = f"$D = {damping:g}$" if name == "upper" else None
            axis.plot(speed, values, color=color, linestyle=line, label=label, **STYLE)
            axis.plot(speed, -values, color=color, linestyle=line, linewidth=0.7, alpha=0.7)
    axis.plot([], [], color="#7F7F7F", linewidth=0.7, label="reversed sense")
    axis.set(xlim=(0, 2), ylim=(-3.1, 3.1), xlabel=SPEED_LABEL, ylabel="rotation numbers $\\rho/\\omega_1$ (1)")
    figure.legend(loc="outside upper center", ncols=4)
    return Drawing(figure, {"": columns})


def figure_14(full: bool = False, report: Report | None = None) -> Drawing:
    """Stability map over the damping: printed bounds, where in truth noise never takes stability away."""
    figure, [[axis]] = panels()
    damping = np.linspace(0.0, 1.5, 301)
    columns: dict[str, npt.ArrayLike] = {"damping (1)": damping}
    axis.axvspan(0, 1.5, color=GREEN, alpha=0.18, linewidth=0, label=STABLE)
    for sense, words, color, line in (
        ("almost_sure", "almost surely", VERMILION, PRINTED),
        ("mean", "in mean", BLUE, (0, (6, 1.2, 1, 1.2))),
    ):
        for form in ("ito", "printed"):
            columns[f"{form}, {sense} (1)"] = critical_noise(damping, sense=sense, form=form)
        axis.plot(
            damping, columns[f"printed, {sense} (1)"], color=color, linestyle=line, label=f"printed bound, {words}", **STYLE
        )
    axis.set(xlim=(0, 1.5), ylim=(0, 2.6), xlabel="damping ratio $D$ (1)", ylabel="critical noise $\\sigma^2/\\omega_1$ (1)")
    axis.legend(loc="upper left", fontsize=8)
    return Drawing(figure, {"": columns})
