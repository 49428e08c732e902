"""The quarter car of two masses: a body on a spring and a damper, a wheel on the spring and the damper of its tyre.

    m_s z_s'' = - k_s (z_s - z_u) - c (z_s' - z_u')
    m_u z_u'' =   k_s (z_s - z_u) + c (z_s' - z_u') - k_t (z_u - z) - c_t (z_u' - z')

With w1^2 = k_s/m_s, D = c/(2 sqrt(k_s m_s)), mu = m_u/m_s, kappa = k_t/k_s, D_t = c_t/(2 sqrt(k_s m_s)), and times in 1/w1 only
mu, kappa, D_t and D are left.

Source: D. Hrovat, "Survey of advanced suspension developments and related optimal control applications", Automatica 33, 1997.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from ..comfort import WEIGHTED, check_weighting, weighted
from ..linear import Motion, Signal
from ..parameters import number_array, pair, positive, within
from .linear import LinearCar

if TYPE_CHECKING:  # it loads pygame, which only those need who ask for pictures
    from ..drawing import Canvas

GRAVITY = 9.81  # m/s^2
RANGE_OF = {  # in `roadgym.parameters.RANGES`, by parameter
    "sprung_mass": "mass",
    "unsprung_mass": "mass",
    "spring_rate": "rate",
    "tyre_rate": "rate",
    "tyre_damping": "tyre_damping",
}


@functools.lru_cache(maxsize=256)
def motion_of(mass_ratio: float, stiffness_ratio: float, tyre_damping: float) -> Motion:
    """The equations for mu = m_u/m_s, kappa = k_t/k_s and D_t = c_t/(2 sqrt(k_s m_s))."""
    share, tyre, resistance = 1 / mass_ratio, stiffness_ratio / mass_ratio, 2 * tyre_damping / mass_ratio
    load = {"wheel_displacement": stiffness_ratio, "level": -stiffness_ratio}
    if tyre_damping:
        load |= {"wheel_velocity": 2 * tyre_damping, "level_rate": -2 * tyre_damping}
    return Motion(
        states=("displacement", "wheel_displacement", "velocity", "wheel_velocity"),
        drift=np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1, 1, 0, 0], [share, -share - tyre, 0, -resistance]], float),
        level_entry=np.array([0.0, 0.0, 0.0, tyre]),
        slope_entry=np.array([0.0, 0.0, 0.0, resistance]),
        force_entry=np.array([0.0, 0.0, 1.0, -share]),
        follows=np.array([1.0, 1.0, 0.0, 0.0]),
        signals={
            "displacement": Signal({"displacement": 1.0}, "y"),
            "velocity": Signal({"velocity": 1.0}, "ẏ", "m/s"),
            "acceleration": Signal({"displacement": -1.0, "wheel_displacement": 1.0, "damper_force": -1.0}, "ÿ", "m/s²"),
            "travel": Signal({"displacement": 1.0, "wheel_displacement": -1.0}, "(y−w)"),
            "relative_velocity": Signal({"velocity": 1.0, "wheel_velocity": -1.0}, "(ẏ−ẇ)", "m/s"),
            "wheel_displacement": Signal({"wheel_displacement": 1.0}, "w"),
            "wheel_velocity": Signal({"wheel_velocity": 1.0}, "ẇ", "m/s"),
            "tyre_deflection": Signal({"wheel_displacement": 1.0, "level": -1.0}, "(w−z)"),
            "wheel_load": Signal(load, "F", "N"),
        },
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoMassCar(LinearCar):
    """A body on a spring and a damper, on a wheel that bounces on its tyre.

    Its signals are told in SI units: displacement, velocity and acceleration of the body, wheel_displacement and
    wheel_velocity, travel z_s - z_u with its rate relative_velocity, tyre_deflection z_u - z, and wheel_load, by which the
    force of the tyre on the wheel falls below its mean. The cost is the weighted sum of their mean squares as it is, so roads
    of different roughness compare. With a damper in the tyre wheel_load is infinite where the road's slope is white noise.

    The default is that of T. Butsuen, The Design of Semi-Active Suspensions for Automotive Vehicles, MIT, 1989.

    Args:
        sprung_mass, unsprung_mass: m_s of the body and m_u of the wheel, kg.
        spring_rate, tyre_rate: k_s and k_t, N/m.
        tyre_damping: c_t, N s/m.
        damping_coefficients: smallest and largest c of the damper, N s/m: the range of the action where none is given.
        weighting: "Wk" to tell weighted_acceleration too, through that filter of ISO 2631-1 (`roadgym.comfort`).
    """

    kind: str = dataclasses.field(default="two_mass", init=False)
    sprung_mass: float = 240.0
    unsprung_mass: float = 36.0
    spring_rate: float = 16e3
    tyre_rate: float = 160e3
    tyre_damping: float = 0.0
    damping_coefficients: tuple[float, float] = (300.0, 4000.0)
    weighting: str | None = None

    optional: ClassVar[Mapping[str, Mapping[str, Any]]] = WEIGHTED
    evaluated: ClassVar[tuple[str, ...]] = tuple(WEIGHTED)
    constructors = {"mass_ratio": "from_ratios"}  # noqa: RUF012  (as of the class above)
    cost_unit: ClassVar[float | None] = 1.0
    default_reward: ClassVar[Mapping[str, float]] = {"acceleration": 1.0}
    usual_plant: ClassVar[Mapping[str, Any]] = {"road": "iso_c", "speed": (15.0, 25.0)}
    starts_on_road: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name, of in RANGE_OF.items():
            object.__setattr__(self, name, within(name, getattr(self, name), of))
        ends = pair("damping_coefficients", self.damping_coefficients, "damping coefficient")
        object.__setattr__(self, "damping_coefficients", ends)
        if self.weighting is not None:
            check_weighting(self.weighting)

    @classmethod
    def from_ratios(
        cls,
        *,
        mass_ratio: float,
        stiffness_ratio: float,
        natural_frequency: float,
        damping_range: tuple[float, float] = (0.05, 1.0),
        sprung_mass: float = 1.0,
    ) -> TwoMassCar:
        """A car by what its motion depends on.

        Args:
            mass_ratio: mu = unsprung_mass/sprung_mass, 1.
            stiffness_ratio: kappa = tyre_rate/spring_rate, 1.
            natural_frequency: w1 of the body, rad/s.
            damping_range: smallest and largest damping ratio D, 1.
            sprung_mass: m_s, kg; by default forces are per kilogram of it.
        """
        mass, w1 = within("sprung_mass", sprung_mass, "mass"), within("natural_frequency", natural_frequency)
        low, high = pair("damping_range", damping_range, "damping")
        return cls(
            sprung_mass=mass,
            unsprung_mass=positive("mass_ratio", mass_ratio) * mass,
            spring_rate=w1**2 * mass,
            tyre_rate=positive("stiffness_ratio", stiffness_ratio) * w1**2 * mass,
            damping_coefficients=(2 * low * w1 * mass, 2 * high * w1 * mass),
        )

    @property
    def natural_frequency(self) -> float:
        """w1 = sqrt(spring_rate/sprung_mass), rad/s."""
        return math.sqrt(self.spring_rate / self.sprung_mass)

    @property
    def motion(self) -> Motion:
        """The equations above."""
        mass_ratio, stiffness_ratio = self.unsprung_mass / self.sprung_mass, self.tyre_rate / self.spring_rate
        own = motion_of(mass_ratio, stiffness_ratio, float(self.damping_ratio(self.tyre_damping)))
        return weighted(own, self.weighting, self.natural_frequency)

    @property
    def units(self) -> Mapping[str, float]:
        """Those of every car, and newtons: forces of the equations are over spring_rate."""
        return {**super().units, "N": self.spring_rate}

    @property
    def default_damping_range(self) -> tuple[float, float]:
        """That of the damper, as damping ratios."""
        low, high = self.damping_coefficients
        return float(self.damping_ratio(low)), float(self.damping_ratio(high))

    @property
    def default_control_interval(self) -> float:
        """5 ms, as of the controllers of such cars."""
        return 0.005

    @property
    def static_load(self) -> float:
        """Weight of both masses, N."""
        return GRAVITY * (self.sprung_mass + self.unsprung_mass)

    @property
    def damping_unit(self) -> float:
        """2 sqrt(k_s m_s), N s/m."""
        return 2 * math.sqrt(self.spring_rate * self.sprung_mass)

    def damping_coefficient(self, damping_ratio: npt.ArrayLike) -> Any:
        """c = 2 D sqrt(k_s m_s), N s/m, of damping ratios D, 1, in their shape.

        Raises:
            ParameterError: no finite numbers.
        """
        return number_array("damping_ratio", damping_ratio)[()] * self.damping_unit

    def damping_ratio(self, damping_coefficient: npt.ArrayLike) -> Any:
        """D = c/(2 sqrt(k_s m_s)), 1, of damping coefficients c, N s/m, in their shape.

        Raises:
            ParameterError: no finite numbers.
        """
        return number_array("damping_coefficient", damping_coefficient)[()] / self.damping_unit

    def draw(self, canvas: Canvas) -> None:
        """Draw the car; its tyre is flat where it is pressed, and round where the wheel has left the road."""
        from ..drawing import body_on_tyre

        body_on_tyre(canvas, pressed=self.static_load / self.tyre_rate)


PRESETS: Mapping[str, Mapping[str, Any]] = {
    # S. M. Savaresi and C. Spelta, "Mixed sky-hook and ADD", J. Dyn. Syst. Meas. Control 129, 2007
    "savaresi": {
        "kind": "two_mass",
        "sprung_mass": 400.0,
        "unsprung_mass": 50.0,
        "spring_rate": 20e3,
        "tyre_rate": 250e3,
        "damping_coefficients": [300.0, 3900.0],
    },
    # front of a Renault Mégane Coupé: C. Poussot-Vassal et al., "Survey and performance evaluation on some automotive
    # semi-active suspension control methods", Annual Reviews in Control 36, 2012
    "renault_megane": {
        "kind": "two_mass",
        "sprung_mass": 315.0,
        "unsprung_mass": 37.5,
        "spring_rate": 29.5e3,
        "tyre_rate": 208e3,
    },
    # the car of the International Roughness Index, per kilogram of its body; its own damper has c = 6 N s/m: M. W. Sayers, "On
    # the calculation of International Roughness Index from longitudinal road profile", Transp. Research Record 1501, 1995
    "golden_car": {
        "kind": "two_mass",
        "sprung_mass": 1.0,
        "unsprung_mass": 0.15,
        "spring_rate": 63.3,
        "tyre_rate": 653.0,
        "damping_coefficients": [1.0, 16.0],
    },
}
