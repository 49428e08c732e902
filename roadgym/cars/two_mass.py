"""The quarter car of two masses: a body on a spring and a damper, a wheel on the tyre's spring.

    m_s z_s'' = - k_s (z_s - z_u) - c (z_s' - z_u')
    m_u z_u'' =   k_s (z_s - z_u) + c (z_s' - z_u') - k_t (z_u - z)

With w1^2 = k_s/m_s, D = c/(2 sqrt(k_s m_s)), mu = m_u/m_s, kappa = k_t/k_s, and times in 1/w1 only mu, kappa and D are left.

Source: D. Hrovat, "Survey of advanced suspension developments and related optimal control applications", Automatica 33, 1997.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import TYPE_CHECKING

import numpy as np

from ..linear import Motion, Signal
from ..parameters import positive
from .linear import LinearCar

if TYPE_CHECKING:  # it loads pygame, which only those need who ask for pictures
    from ..drawing import Canvas


@functools.cache
def motion_of(mass_ratio: float, stiffness_ratio: float) -> Motion:
    """The equations for mu = m_u/m_s and kappa = k_t/k_s."""
    share, tyre = 1 / mass_ratio, stiffness_ratio / mass_ratio
    return Motion(
        states=("displacement", "wheel_displacement", "velocity", "wheel_velocity"),
        drift=np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1, 1, 0, 0], [share, -share - tyre, 0, 0]], float),
        level_entry=np.array([0.0, 0.0, 0.0, tyre]),
        slope_entry=np.zeros(4),
        force_entry=np.array([0.0, 0.0, 1.0, -share]),
        follows=np.array([1.0, 1.0, 0.0, 0.0]),
        signals={
            "displacement": Signal({"displacement": 1.0}, "y"),
            "velocity": Signal({"velocity": 1.0}, "ẏ"),
            "acceleration": Signal({"displacement": -1.0, "wheel_displacement": 1.0, "damper_force": -1.0}, "ÿ"),
            "travel": Signal({"displacement": 1.0, "wheel_displacement": -1.0}, "(y−w)"),
            "relative_velocity": Signal({"velocity": 1.0, "wheel_velocity": -1.0}, "(ẏ−ẇ)"),
            "wheel_displacement": Signal({"wheel_displacement": 1.0}, "w"),
            "wheel_velocity": Signal({"wheel_velocity": 1.0}, "ẇ"),
            "tyre_deflection": Signal({"wheel_displacement": 1.0, "level": -1.0}, "(w−z)"),
            "wheel_load": Signal({"wheel_displacement": stiffness_ratio, "level": -stiffness_ratio}, "F"),
        },
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoMassCar(LinearCar):
    """A body on a spring and a damper, on a wheel that bounces on its tyre.

    Its signals are, in metres, velocities over w1 and accelerations over w1^2: displacement, velocity and acceleration of the
    body, wheel_displacement and wheel_velocity, travel z_s - z_u with its rate relative_velocity, tyre_deflection z_u - z, and
    wheel_load, the dynamic load of the tyre over spring_rate.

    The default is that of T. Butsuen, The Design of Semi-Active Suspensions for Automotive Vehicles, MIT, 1989.

    Args:
        sprung_mass, unsprung_mass: m_s of the body and m_u of the wheel, kg.
        spring_rate, tyre_rate: k_s and k_t, N/m.
    """

    kind: str = dataclasses.field(default="two_mass", init=False)
    sprung_mass: float = 240.0
    unsprung_mass: float = 36.0
    spring_rate: float = 16e3
    tyre_rate: float = 160e3

    def __post_init__(self) -> None:
        for name in ("sprung_mass", "unsprung_mass", "spring_rate", "tyre_rate"):
            object.__setattr__(self, name, positive(name, getattr(self, name)))

    @property
    def natural_frequency(self) -> float:
        """w1 = sqrt(spring_rate/sprung_mass), rad/s."""
        return math.sqrt(self.spring_rate / self.sprung_mass)

    @property
    def motion(self) -> Motion:
        """The equations above."""
        return motion_of(self.unsprung_mass / self.sprung_mass, self.tyre_rate / self.spring_rate)

    def draw(self, canvas: Canvas) -> None:
        """Draw the car; the wheel sinks into the road, and leaves it, as the tyre is pressed and let go."""
        from ..drawing import body_on_wheel

        body_on_wheel(canvas, canvas.heights[1])
