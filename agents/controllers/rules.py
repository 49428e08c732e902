"""Classical rules: on the motion of body, wheel and suspension, of any car that has the signals.

With one mass the body's velocity is Y', the relative velocity Y' - Z' and the travel Y - Z. Rules on the wheel need a car that
has one of its own; with one mass it follows the road.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from roadgym.parameters import positive, within
from roadgym.task import Task

from .base import Observation, SemiActive

CROSSOVERS = tuple(np.geomspace(0.125, 16.0, 8).tolist())  # in units of w1
SHARES = tuple(np.linspace(0, 1, 9).tolist())
TINY = np.float32(1e-12)  # of a squared relative velocity


def ratio(force: Observation, relative: Observation) -> Observation:
    """``force`` over ``relative``, 0 where that is."""
    return np.asarray(force * relative / np.maximum(relative**2, TINY))


class SkyhookOnOff(SemiActive):
    """D_max where the damper would brake the body, Y' (Y' - Z') > 0, else D_min.

    Source: D. Karnopp, M. J. Crosby and R. A. Harwood, "Vibration control using semi-active force generators",
    J. Eng. Ind. 96, 1974, in its on-off form.
    """

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule."""
        velocity, relative = self.motion(signals)
        return self.on_off(velocity * relative > 0)


class SkyhookContinuous(SemiActive):
    """The force of a damper D_max between the body and the sky, 2 D_max Y', as far as the damper can give it.

    Source: Karnopp, Crosby and Harwood (1974), as for `SkyhookOnOff`.
    """

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """D = D_max Y'/(Y' - Z'), clipped to the range."""
        velocity, relative = self.motion(signals)
        return self.task.damping_range[1] * ratio(velocity, relative)


class GroundhookOnOff(SemiActive):
    """D_max where the damper would brake the wheel, - z_u' (z_s' - z_u') > 0, else D_min.

    Source: M. Valasek, M. Novak, Z. Sika and O. Vaculin, "Extended ground-hook - new concept of semi-active control of truck's
    suspension", Veh. Syst. Dyn. 27, 1997, in its on-off form, with the wheel's absolute velocity.
    """

    seen = ("wheel_velocity", "relative_velocity")

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule."""
        wheel, relative = self.motion(signals)
        return self.on_off(wheel * relative < 0)


class Hybrid(SemiActive):
    """Skyhook and groundhook: ``mixing`` times the damping of the one, and 1 - ``mixing`` times that of the other, each on-off.

    Source: M. Ahmadian and C. A. Pare, "A quarter-car experimental analysis of alternative semiactive control methods",
    J. Intell. Mater. Syst. Struct. 11, 2000, whose mixture is of forces.

    Args:
        task: the task.
        mixing: 1 for skyhook alone, 0 for groundhook.
    """

    seen = ("velocity", "wheel_velocity", "relative_velocity")
    tried = {"mixing": SHARES}  # noqa: RUF012  (of the class, as its base declares; below likewise)

    def __init__(self, task: Task, mixing: float = 0.5) -> None:
        super().__init__(task)
        self.mixing = within("mixing", mixing)

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The mixture."""
        body, wheel, relative = self.motion(signals)
        return self.mixing * self.on_off(body * relative > 0) + (1 - self.mixing) * self.on_off(wheel * relative < 0)


class AccelerationDrivenDamper(SemiActive):
    """ADD: D_max where the damper would reduce the body's acceleration, Y'' (Y' - Z') > 0, else D_min.

    Source: S. M. Savaresi, E. Silani and S. Bittanti, "Acceleration-driven-damper (ADD): an optimal control algorithm for
    comfort-oriented semiactive suspensions", J. Dyn. Syst. Meas. Control 127, 2005.
    """

    seen = ("acceleration", "relative_velocity")

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule."""
        acceleration, relative = self.motion(signals)
        return self.on_off(acceleration * relative > 0)


class MixedSkyhookADD(SemiActive):
    """SH-ADD: skyhook where the body moves slowly, Y''^2 <= a^2 Y'^2, and ADD where it moves fast.

    By default the crossover a is sqrt(2) w1, the frequency at which with one mass no damping amplifies or reduces the road.

    Source: S. M. Savaresi and C. Spelta, "Mixed sky-hook and ADD: approaching the filtering limits of a semi-active
    suspension", J. Dyn. Syst. Meas. Control 129, 2007.

    Args:
        task: the task.
        crossover: a, in units of w1.
    """

    seen = ("acceleration", "velocity", "relative_velocity")
    tried = {"crossover": CROSSOVERS}  # noqa: RUF012

    def __init__(self, task: Task, crossover: float = 2**0.5) -> None:
        super().__init__(task)
        self.crossover = positive("crossover", crossover)

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule."""
        acceleration, velocity, relative = self.motion(signals)
        slow = acceleration**2 <= np.float32(self.crossover**2) * velocity**2
        return self.on_off(np.where(slow, velocity, acceleration) * relative > 0)


class OneSensorMix(SemiActive):
    """SH-ADD with one sensor, on the body alone: D_max where it moves slowly, Y''^2 <= a^2 Y'^2, and D_min where it moves fast.

    Where the body moves slowly a damper mostly brakes it, and where it moves fast most of what a damper does is to shake it.

    Source: S. M. Savaresi and C. Spelta, "A single-sensor control strategy for semi-active suspensions", IEEE Trans. Control
    Syst. Technol. 17, 2009; an accelerometer's integral is the velocity.

    Args:
        task: the task.
        crossover: a, in units of w1.
    """

    seen = ("acceleration", "velocity")
    tried = {"crossover": CROSSOVERS}  # noqa: RUF012

    def __init__(self, task: Task, crossover: float = 2**0.5) -> None:
        super().__init__(task)
        self.crossover = positive("crossover", crossover)

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule."""
        acceleration, velocity = self.motion(signals)
        return self.on_off(acceleration**2 <= np.float32(self.crossover**2) * velocity**2)


class LeastAcceleration(SemiActive):
    """The damping that makes |Y''| least at this instant: 2 D (Y' - Z') = -(Y - Z) where the range allows it."""

    seen = ("travel", "relative_velocity")

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """D = -(Y - Z)/(2 (Y' - Z')), clipped to the range."""
        travel, relative = self.motion(signals)
        return -ratio(travel, relative) / 2


class PowerDrivenDamper(LeastAcceleration):
    """PDD: the suspension takes no power that its damper can give back, c = - k_s r/r', clipped to the range.

    That is `LeastAcceleration`, but where nothing moves: there it is the middle of the range.

    Source: R. Morselli and R. Zanasi, "Control of port Hamiltonian systems by dissipative devices and its application to
    improve the semi-active suspension behaviour", Mechatronics 18, 2008.
    """

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule."""
        _, relative = self.motion(signals)
        return np.where(relative == 0, sum(self.task.damping_range) / 2, super().damping(signals))
