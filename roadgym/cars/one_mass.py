"""The quarter car of one mass, (1), (13), (19) of Wedig (2020): Y'' + 2 D w1 (Y' - Z') + w1^2 (Y - Z) = 0.

Scheme, in units of time 1/w1, with X = Y'/w1. Over a substep of length h the level is taken as the straight line between its
ends, raised by its mean excess m over that line, which the road supplies. Relative to such a road the car is in free decay:

    k = (Z1 - Z0)/h - 2 D m,    (Y - Z0 - m, X - k)  ->  Phi(D, h) (Y - Z0 - m, X - k),    then  Z1 + m and k added back.

(The terms 2 D m are the impulses that the steps +m and -m of the level give to the velocity.) So the force on the car has the
right integral and the right first moment over the substep, and no derivative of the road enters: the scheme serves roads whose
slope is white noise as well. Y and Y' are continuous when D changes. With the exact area of a smooth road the stationary mean
squares converge as h^4.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..comfort import WEIGHTED, check_weighting, weighted
from ..compiled import (
    DAMPING,
    INVERSE_SUBSTEP,
    LANES,
    LEVEL,
    LEVEL_EXCESS,
    RATE,
    SHARE,
    SLOPE,
    SUBSTEP,
    WORK,
    LaneFunction,
    compiled,
    inlined,
    like,
)
from ..linear import Motion, Signal
from ..parameters import positive
from .base import Car

MOTION = Motion(
    states=("displacement", "velocity"),
    drift=np.array([[0.0, 1.0], [-1.0, 0.0]]),
    level_entry=np.array([0.0, 1.0]),
    slope_entry=np.array([0.0, 0.0]),
    force_entry=np.array([0.0, 1.0]),
    follows=np.array([1.0, 0.0]),
    signals={
        "displacement": Signal({"displacement": 1.0}, "y"),
        "velocity": Signal({"velocity": 1.0}, "ẏ"),
        "acceleration": Signal({"displacement": -1.0, "level": 1.0, "damper_force": -1.0}, "ÿ"),
        "travel": Signal({"displacement": 1.0, "level": -1.0}, "(y−z)"),
        "relative_velocity": Signal({"velocity": 1.0, "level_rate": -1.0}, "(ẏ−ż)"),
    },
)
MEAN_SQUARES = tuple(MOTION.signals)

DISPLACEMENT, VELOCITY = 0 * LANES, 1 * LANES  # the states Y and X
SQUARES = WORK  # of the signals above, one row each
PREVIOUS_LEVEL = SQUARES + len(MEAN_SQUARES) * LANES
DECAY_11, DECAY_12, DECAY_22 = PREVIOUS_LEVEL + LANES, PREVIOUS_LEVEL + 2 * LANES, PREVIOUS_LEVEL + 3 * LANES


@compiled
def free_decay(damping: Any, interval: Any, reference: Any) -> tuple[Any, Any, Any]:
    """(Phi11, Phi12, Phi22) of Phi = exp(interval [[0, 1], [-1, -2 D]]); Phi21 = -Phi12.

    Power series in (D^2 - 1) interval^2 and D interval, smooth through critical damping and free of calls. Their remainders
    are below single precision for D interval <= 1, which the choice of the substep ensures.
    """
    square = (damping * damping - like(reference, 1.0)) * interval * interval
    cosine = like(reference, 1.0 / 3628800.0)
    cosine = cosine * square + like(reference, 1.0 / 40320.0)
    cosine = cosine * square + like(reference, 1.0 / 720.0)
    cosine = cosine * square + like(reference, 1.0 / 24.0)
    cosine = cosine * square + like(reference, 0.5)
    cosine = cosine * square + like(reference, 1.0)
    sine = like(reference, 1.0 / 39916800.0)
    sine = sine * square + like(reference, 1.0 / 362880.0)
    sine = sine * square + like(reference, 1.0 / 5040.0)
    sine = sine * square + like(reference, 1.0 / 120.0)
    sine = sine * square + like(reference, 1.0 / 6.0)
    sine = sine * square + like(reference, 1.0)
    sine = sine * interval
    # exp(-x) = exp(-x/8)^8
    eighth = damping * interval * like(reference, -0.125)
    decay = like(reference, 1.0 / 5040.0)
    decay = decay * eighth + like(reference, 1.0 / 720.0)
    decay = decay * eighth + like(reference, 1.0 / 120.0)
    decay = decay * eighth + like(reference, 1.0 / 24.0)
    decay = decay * eighth + like(reference, 1.0 / 6.0)
    decay = decay * eighth + like(reference, 0.5)
    decay = decay * eighth + like(reference, 1.0)
    decay = decay * eighth + like(reference, 1.0)
    decay = decay * decay
    decay = decay * decay
    decay = decay * decay
    return decay * (cosine + damping * sine), decay * sine, decay * (cosine - damping * sine)


@inlined
def squares(y: Any, x: Any, z: Any, slope: Any, resistance: Any) -> tuple[Any, Any, Any, Any, Any]:
    """The squares at an instant, in the order of MEAN_SQUARES; ``slope`` is that in time."""
    travel, relative = y - z, x - slope
    acceleration = resistance * relative + travel
    return y * y, x * x, acceleration * acceleration, travel * travel, relative * relative


@LaneFunction
def prepare(lanes: Any, car: Any, work: Any, table: Any) -> None:
    """Free decay over a substep at the damping of each lane, and the squares now."""
    interval, share, two = work[SUBSTEP], work[SHARE], like(lanes, 2.0)
    for i in range(LANES):
        phi_11, phi_12, phi_22 = free_decay(work[DAMPING + i], interval, lanes)
        work[DECAY_11 + i] = phi_11
        work[DECAY_12 + i] = phi_12
        work[DECAY_22 + i] = phi_22
        z, slope = lanes[LEVEL + i], lanes[RATE + i] * lanes[SLOPE + i]
        work[PREVIOUS_LEVEL + i] = z
        yy, xx, aa, tt, rr = squares(car[DISPLACEMENT + i], car[VELOCITY + i], z, slope, two * work[DAMPING + i])
        work[SQUARES + i] = share * yy
        work[SQUARES + LANES + i] = share * xx
        work[SQUARES + 2 * LANES + i] = share * aa
        work[SQUARES + 3 * LANES + i] = share * tt
        work[SQUARES + 4 * LANES + i] = share * rr


@LaneFunction
def advance(lanes: Any, car: Any, work: Any, table: Any) -> None:
    """One substep; adds the squares at its end to the means over the interval."""
    rate, share, two = work[INVERSE_SUBSTEP], work[SHARE], like(lanes, 2.0)
    for i in range(LANES):
        resistance = two * work[DAMPING + i]
        old_z, z, excess = work[PREVIOUS_LEVEL + i], lanes[LEVEL + i], lanes[LEVEL_EXCESS + i]
        k = (z - old_z) * rate - resistance * excess
        r = car[DISPLACEMENT + i] - old_z - excess
        p = car[VELOCITY + i] - k
        y = work[DECAY_11 + i] * r + work[DECAY_12 + i] * p + z + excess
        x = work[DECAY_22 + i] * p - work[DECAY_12 + i] * r + k
        car[DISPLACEMENT + i] = y
        car[VELOCITY + i] = x
        work[PREVIOUS_LEVEL + i] = z
        yy, xx, aa, tt, rr = squares(y, x, z, lanes[RATE + i] * lanes[SLOPE + i], resistance)
        work[SQUARES + i] += share * yy
        work[SQUARES + LANES + i] += share * xx
        work[SQUARES + 2 * LANES + i] += share * aa
        work[SQUARES + 3 * LANES + i] += share * tt
        work[SQUARES + 4 * LANES + i] += share * rr


@dataclasses.dataclass(frozen=True, kw_only=True)
class QuarterCar(Car):
    """A body on a spring and a damper that stand on the road: one mass, no wheel.

    Args:
        natural_frequency: undamped natural frequency w1, rad/s; 1 is the paper's dimensionless time.
        weighting: "Wk" to tell weighted_acceleration too, through that filter of ISO 2631-1 (`roadgym.comfort`).
    """

    kind: str = dataclasses.field(default="one_mass", init=False)
    natural_frequency: float = 1.0
    weighting: str | None = None

    optional: ClassVar[Mapping[str, Mapping[str, Any]]] = WEIGHTED
    is_its_motion: ClassVar[bool] = True
    time_powers: ClassVar[Mapping[str, int]] = {
        "velocity": 1,
        "acceleration": 2,
        "relative_velocity": 1,
        "weighted_acceleration": 2,
    }
    squared = len(MEAN_SQUARES)
    working_rows = 4
    prepare = prepare
    advance = advance

    def __post_init__(self) -> None:
        object.__setattr__(self, "natural_frequency", positive("natural_frequency", self.natural_frequency))
        if self.weighting is not None:
            check_weighting(self.weighting)

    @property
    def motion(self) -> Motion:
        """Its equations, (13)."""
        return weighted(MOTION, self.weighting, self.natural_frequency)
