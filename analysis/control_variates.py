"""Control variates: constant dampings over the same roads, whose mean squares theory knows exactly.

What an episode costs depends on its road's luck, and what a constant damping costs on the same road tells most of that luck.
With x_i the costs of a few constant dampings in episode i less their exact means, and c_i the cost of a controller, the mean of

    c_i - b_i . x_i

has the same expectation as that of c_i and a far smaller error, if b_i are the coefficients of the regression of c on x (P.
Glasserman, Monte Carlo Methods in Financial Engineering, 2003, section 4.1). Coefficients from the same episodes would bias the
mean to first order in 1/episodes. Here b_i is found without episode i, so b_i and x_i are independent and the mean is unbiased,
whatever the law of the costs. The values so adjusted are uncorrelated to first order in 1/episodes, and scatter by what the
errors of b_i add: their standard error is that of a mean.

On a road whose rate is white noise the controller's own drive has figures of known mean, whatever the rule: the balances and
the power of `analysis.identities`. There they tell more than constant dampings, as the road gives all its power to the damper,
and serve beside them. On smooth roads they add nothing, and do not serve.

What the exact means must be worth:

- *Start.* When free motions have fallen by exp(-SETTLED), which one mass takes SETTLED/(D natural_frequency) for, a start at
  rest has left less than 1e-5 of any mean square over 100/w1 or more, on every road; weaker dampings do not serve.
- *Scheme.* The plant's own mean squares are within 1e-4 of theory for constant D <= 1; stronger dampings do not serve. Dampings
  that say nearly the same could have large coefficients of either sign, which would blow that bias up; so the regression has a
  penalty that weighs b_i times the bias against the noise, and leaves alone what has no more noise than bias. The adjusted mean
  is good to about 1e-4, however small its standard error is.
- *Theory.* Only exact mean squares serve: none under noise on the speed of a random road, none on an ellipse, whose variance,
  the unit of all costs, is itself simulated, and none of cars that differ from episode to episode.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from roadgym.cars import Car
from roadgym.parameters import RANGES
from roadgym.task import Task

from .checks import FloatArray
from .identities import Identity, identities
from .response import has_closed_form, mean_squares, needs_simulation

MOST = 4  # control variates at once; more take out nothing more
SAMPLES_EACH = 8  # episodes for each: the error of the coefficients then adds a fifth at most to the variance left
SETTLED = 12.0  # amplitudes that a start leaves have fallen by exp(-12)
HIGHEST = 1.0  # largest damping ratio for which the scheme's bias is below 1e-4
BIAS = 1e-4  # relative, of the scheme


def least_transient(task: Task) -> float:
    """Time from a start at rest, s, after which at least the upper third of the damping range serves; 0 where nothing would."""
    low, high = task.damping_range
    return 1.5 * SETTLED / (task.car.decay(min(high, HIGHEST)) * task.car.natural_frequency) if low < HIGHEST else 0.0


def control_dampings(task: Task, transient: float, samples: int) -> tuple[float, ...]:
    """Constant damping ratios that serve as control variates for ``samples`` episodes, each measured after ``transient`` s.

    They lie inside the range, not at its ends: where the best constant damping is an end, it is not its own control variate,
    and theory still checks what is driven. Empty where none serves; see the module's docstring.
    """
    low, high = task.damping_range
    high = min(high, HIGHEST)
    simulated = needs_simulation(task.road, task.speed_noise, task.car) or task.road.variance_standard_error > 0
    simulated = simulated or task.vary is not None
    if not has_closed_form(task.road, task.car):
        known = RANGES["linear frequency ratio"]
        simulated = simulated or not all(known.low <= task.frequency_ratio(speed) <= known.high for speed in task.speed)
    if simulated or transient <= 0 or low >= high:
        return ()
    low = _least_damping(task.car, SETTLED / (transient * task.car.natural_frequency), low, high)
    if low >= high:
        return ()
    count = max(min(MOST, samples // SAMPLES_EACH), 1)
    single = np.geomspace(low, high, 2 * count + 1)[1::2].astype(np.float32).astype(float)  # as the plant takes them
    settled = dict.fromkeys(task.valve.settled(single, task.damping_range).tolist())
    return tuple(damping for damping in settled if low <= damping <= high)


def _least_damping(car: Car, decay: float, low: float, high: float) -> float:
    """The least D within [low, high] from which on the car's free motion decays so fast, in units of w1; ``high`` if none."""
    if car.decay(high) < decay:
        return high
    if car.decay(low) >= decay:
        return low
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if car.decay(middle) >= decay else (middle, high)
    return high


def expected_squares(task: Task, dampings: tuple[float, ...], speed: float, bandwidth: float = 0.0) -> FloatArray:
    """Exact mean squares, as told over the task's `cost_unit`, at constant dampings, shape (squares, dampings).

    Args:
        task: the plant.
        dampings: damping ratios, 1.
        speed, bandwidth: the operating point, m/s and 1; bandwidth 0 on a road without one.
    """
    found = mean_squares(
        task.road,
        task.speed_noise,
        damping=np.array(dampings),
        speed=speed,
        car=task.car,
        bandwidth=bandwidth or None,
    )
    return np.array(list(found.values())) / task.cost_unit


def balances(task: Task, constants: int, samples: int) -> list[Identity]:
    """The identities that serve as control variates for ``samples`` episodes, beside as many ``constants``; see above."""
    road = task.road.shaping_filter()
    if road is None or task.road.has_slope or task.speed_noise is not None:
        return []
    found = identities(road, task.car.motion.own, float(task.frequency_ratio(task.speed[0])))
    return found[: max(samples // SAMPLES_EACH - constants, 0)]


def adjust(samples: FloatArray, controls: FloatArray, means: FloatArray, sizes: FloatArray | None = None) -> FloatArray:
    """``samples``, shape (n,), less what ``controls``, shape (k, n), with the exact ``means``, shape (k,), tell of their luck.

    The mean of the result estimates the mean of the samples without bias; see the module's docstring. The scheme's bias is
    relative to ``sizes``, shape (k,): the means, or the sum of its terms where a mean is zero.
    """
    count, number = len(samples), len(means)
    deviations = controls - means[:, None]
    # least squares of the samples, with rows beneath that ask for small coefficients
    design = np.zeros((count + number, 1 + number))
    design[:count, 0], design[:count, 1:] = 1, deviations.T
    design[count:, 1:] = np.diag(count * BIAS * (means if sizes is None else sizes))
    scale = np.linalg.norm(design, axis=0)
    q, r = np.linalg.qr(design / scale)
    deviations = deviations / scale[1:, None]
    q = q[:count]
    projected = samples @ q
    # taking sample i out changes the coefficients by (X'X)^-1 x_i times its residual over 1 - leverage
    residual = (samples - q @ projected) / (1 - (q * q).sum(axis=1))
    slopes = solve_triangular(r, projected)[1:]
    change = solve_triangular(r, q.T)[1:]
    adjusted: FloatArray = samples - slopes @ deviations + residual * (change * deviations).sum(axis=0)
    return adjusted
