"""The quarter car, (1), (13), (19) of Wedig (2020): Y'' + 2 D w1 (Y' - Z') + w1^2 (Y - Z) = 0.

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
from typing import Any

import numpy as np

from .compiled import compiled, like
from .linear import Motion
from .parameters import positive

# q = (Y, X); each signal as (row of q, of Z, of dZ/dt, of the damper's force F_D = 2 D (X - dZ/dt))
MOTION = Motion(
    states=("displacement", "velocity"),
    drift=np.array([[0.0, 1.0], [-1.0, 0.0]]),
    level_entry=np.array([0.0, 1.0]),
    slope_entry=np.array([0.0, 0.0]),
    force_entry=np.array([0.0, 1.0]),
    follows=np.array([1.0, 0.0]),
    signals={
        "displacement": (np.array([1.0, 0.0]), 0.0, 0.0, 0.0),
        "velocity": (np.array([0.0, 1.0]), 0.0, 0.0, 0.0),
        "acceleration": (np.array([-1.0, 0.0]), 1.0, 0.0, -1.0),
        "travel": (np.array([1.0, 0.0]), -1.0, 0.0, 0.0),
        "relative_velocity": (np.array([0.0, 1.0]), 0.0, -1.0, 0.0),
    },
)
MEAN_SQUARES = tuple(MOTION.signals)


@dataclasses.dataclass(frozen=True, kw_only=True)
class QuarterCar:
    """A car body on a spring and a damper.

    Args:
        natural_frequency: undamped natural frequency w1, rad/s; 1 is the paper's dimensionless time.
    """

    natural_frequency: float = 1.0

    def __post_init__(self) -> None:
        positive("natural_frequency", self.natural_frequency)

    @property
    def motion(self) -> Motion:
        """Its equations, (13), in units of time 1/natural_frequency."""
        return MOTION


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
