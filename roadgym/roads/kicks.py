"""Tables of the laws by which the bounded road is kicked; `roadgym.roads.multiplicative` says what for."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..cache import remembered
from ..compiled import compiled

CELLS = 512
CHANCES = 32  # kicks are far in some of them
LARGEST_ROOT = 2.0  # end of the curve eta over sqrt(-ln g), for shapes below 1/2


@functools.cache
def direction_quantiles(shape: float) -> npt.NDArray[np.float64]:
    """CELLS + 1 quantiles of |c|, density ~ (1 - c^2)^(shape - 3/2), scaled so that E c^2 of the chords is 1/(2 shape)."""
    return np.ones(CELLS + 1) if shape == 0.5 else remembered(_direction_quantiles, shape)


def _direction_quantiles(shape: float) -> npt.NDArray[np.float64]:
    from scipy.special import betaincinv

    quantiles = np.sqrt(betaincinv(0.5, shape - 0.5, np.linspace(0.0, 1.0, CELLS + 1)))
    low = quantiles[:-1]
    # the last cell holds the whole tail: end it where its share of E c^2 is right, not at c = 1
    others = np.mean((low[:-1] ** 2 + low[:-1] * low[1:] + low[1:] ** 2) / 3) * (CELLS - 1) / CELLS
    share = 3 * CELLS * (0.5 / shape - others)
    last = low[-1]
    quantiles[-1] = min((math.sqrt(4 * share - 3 * last * last) - last) / 2 if share > 3 * last * last else last, 1.0)
    chords = np.mean((quantiles[:-1] ** 2 + quantiles[:-1] * quantiles[1:] + quantiles[1:] ** 2) / 3)
    scaled: npt.NDArray[np.float64] = np.minimum(quantiles * math.sqrt(0.5 / shape / chords), 1.0)
    return scaled


@functools.cache
def projection_curve(shape: float) -> npt.NDArray[np.float64]:
    """CELLS + 1 values of eta at equidistant sqrt(-ln g) in [0, LARGEST_ROOT].

    g(eta) is the mean cosine between a unit vector and its projected Gaussian neighbour in n = 2 shape + 1 dimensions:
    Gamma((n + 1)/2) / Gamma(n/2 + 1) * k / sqrt(2) * 1F1(1/2; n/2 + 1; -k^2/2), k = 1/eta
    (K. V. Mardia and P. E. Jupp, Directional Statistics, 2000, sec. 9.3.2).
    """
    from scipy.special import gammaln, hyp1f1

    n = 2 * shape + 1
    eta = np.concatenate([[0.0], np.geomspace(1e-4, 30.0, 6000)])
    k = 1 / eta[1:]
    g = np.exp(gammaln((n + 1) / 2) - gammaln(n / 2 + 1)) * k / math.sqrt(2) * hyp1f1(0.5, n / 2 + 1, -(k**2) / 2)
    root = np.concatenate([[0.0], np.sqrt(-np.log(g))])
    curve: npt.NDArray[np.float64] = np.interp(np.linspace(0.0, LARGEST_ROOT, CELLS + 1), root, eta)
    return curve


@compiled
def kick_cosines(keep: Any, shape: Any, far: Any) -> tuple[float, float]:
    """(far, near) values of the cosine g of a kick, of which the first comes ``far`` times in CHANCES.

    Brownian motion on a sphere of dimension 2 alpha lets the Gegenbauer polynomial of degree k decay at a rate proportional to
    k (k + 2 alpha - 1). So where the mean of g is ``keep``, its mean square is (1 + 2 alpha keep^(2 + 1/alpha))/(2 alpha + 1),
    which the two values have. In small steps 1 - g is a Gamma variate of shape alpha: with the chance of `far_chance` its third
    moment nearly holds too.
    """
    decay = math.log(keep)
    variance = keep * keep * (math.expm1(-2.0 * decay) + 2.0 * shape * math.expm1(decay / shape)) / (2.0 * shape + 1.0)
    odds = math.sqrt(far / (CHANCES - far))
    # both values stay within [-1, 1], whatever the step
    spread = min(math.sqrt(max(variance, 0.0)), (1.0 + keep) * odds, (1.0 - keep) / odds)
    return keep - spread / odds, keep + spread * odds


def far_chance(shape: float) -> int:
    """How many kicks in CHANCES are far: the weight of the larger node of Gauss's rule for a Gamma law, rounded."""
    return max(1, round(CHANCES * (1 - 1 / math.sqrt(shape + 1)) / 2))
