"""Bounded road with multiplicative noise, (7), (8) of Wedig (2020):

    dZ = v W U dt,   dU = -v W (2 delta U + Z) dt + V sigma sqrt(v) dB,   V^2 = 1 - Z^2/z0^2 - U^2/u0^2.

Here W = wavenumber. On the circle z0 = u0 = r0 the density is p ~ (1 - (z^2 + u^2) / r0^2)^(alpha - 1) with
alpha = 2 delta W r0^2 / sigma^2 (11).

Scheme: rotate, kick, rotate. Split the generator into the rotation dZ = U dt, dU = -Z dt and the rest, which moves U alone.
At fixed Z the rest is a Jacobi diffusion of x = U / sqrt(r0^2 - Z^2) with density ~ (1 - x^2)^(alpha - 1), the law of one
coordinate of a uniform point on a sphere of dimension 2 alpha. Both parts keep the density (11), and so does each step here:

- alpha >= 1/2: a random walk on that sphere, x -> g x + sqrt(1 - g^2) sqrt(1 - x^2) c, c one coordinate of a random direction
  in the tangent space, density ~ (1 - c^2)^(alpha - 3/2). That it keeps the law for any real 2 alpha >= 1 is the product
  formula of the Gegenbauer polynomials (T. Koornwinder, "Jacobi polynomials II", SIAM J. Math. Anal. 5, 1974). c comes from a
  table of its quantiles, scaled so that E c^2 = 1/(2 alpha) exactly. The step's cosine g takes one of two values at random,
  whose mean and mean square are those of Brownian motion on the sphere; with one value, polynomials of second and higher
  degree would relax too fast, in first order of the angle a substep (`kick_cosines`).
- alpha < 1/2, where there is no such sphere: a Gaussian step in the space around the sphere, projected back on it,
  (x, w) -> (x + eta N, eta^2 chi'^2) with w = 1 - x^2 and chi'^2 noncentral chi-square of 2 alpha degrees of freedom and
  noncentrality w / eta^2; then x -> x / sqrt(x^2 + w). By symmetry it keeps the law too, and E x' = g(eta) x.

The kick comes at one of two instants, the Gauss-Legendre points of the substep, chosen at random. The three free numbers
(both rotations and g) are set so that the conditional mean of (Z, U) over a substep is that of the equation. So for every
alpha > 0, at any substep, the stationary law is the exact one (to the table's interpolation: below 2e-4 in the distribution
function, as seen with 10^7 roads), Z^2 + U^2 <= r0^2 always, and the autocovariance of the samples is exact at every lag.
Approximate, of second weak order in the angle a substep: how fast higher moments relax, which a feedback can see. The
increments are not Gaussian, so no convergence along a given Brownian path is claimed.

On an ellipse z0 != u0 the drift carries the path outside, where V^2 is taken as max(V^2, 0): there U only decays. The same
three steps then split the equation symmetrically, with an error of second order in the angle; (11) and (12) do not hold, and
the variance is found by simulation, see `MultiplicativeRoad.variance`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import BANDWIDTH, COEFFICIENT, LANES, LEVEL, LEVEL_EXCESS, SLOPE, TURN, LaneFunction, compiled, like
from ..linear import ShapingFilter
from ..noise import normal_pair, philox, uniform
from ..parameters import ParameterError, check_ratio, within
from . import iso8608
from .base import Road, check_fields
from .gaussian import oscillator, second_order_filter
from .kicks import CELLS, CHANCES, LARGEST_ROOT, direction_quantiles, far_chance, kick_cosines, projection_curve

# the cosine g of a kick and its sine, for each of its two values; a small shape has the first pair alone: mean of g, and eta
FAR_KEEP, FAR_KICK = COEFFICIENT, COEFFICIENT + LANES
NEAR_KEEP, NEAR_KICK = COEFFICIENT + 2 * LANES, COEFFICIENT + 3 * LANES
SHORT_COSINE, SHORT_SINE = COEFFICIENT + 4 * LANES, COEFFICIENT + 5 * LANES
LONG_COSINE, LONG_SINE = COEFFICIENT + 6 * LANES, COEFFICIENT + 7 * LANES
CELL = COEFFICIENT + 8 * LANES  # of this substep only, two rows: begin and width of the cell of each lane, one after the other

# the table: u0^2, u0^2/z0^2, 1/r0^2 (0 on an ellipse, which the path leaves), the shape, how many kicks in CHANCES are far,
# then the knots of a curve, and once more each with the distance to the next, since a look-up of both is one load
SQUARE_CHORD, CHORD_RATIO, INVERSE_BOUND, SHAPE, FAR, CURVE = 0, 1, 2, 3, 4, 5
PAIRS = CURVE + CELLS + 1
LEAST_KEEP = 1e-9
LARGE_NONCENTRALITY = 1e4  # above it chi'^2 is taken for the square of a shifted normal, whose error is below 1 over it


@compiled
def rotations(angle: Any, bandwidth: Any) -> tuple[float, float, float]:
    """(short rotation, long rotation, g): R(short) diag(1, g) R(long), averaged with its mirror image, is the exact mean."""
    a, b, d = oscillator(angle, bandwidth)
    keep = math.sqrt((a + d) * (a + d) + 4.0 * b * b) - 1.0
    total = math.atan2(2.0 * b, a + d)
    difference = math.acos(min((a - d) / (1.0 - keep), 1.0)) if keep < 1.0 else 0.0
    # from delta times the angle of ln 2 on g is below zero, which no kick has: the road then forgets less than it should
    return 0.5 * (total - difference), 0.5 * (total + difference), max(keep, LEAST_KEEP)


@LaneFunction
def prepare(lane: Any, words: Any, table: Any) -> None:
    """Both rotations and the kick, in double precision."""
    shape = np.float64(table[SHAPE])
    short, long, keep = rotations(np.float64(lane[TURN]), np.float64(lane[BANDWIDTH]))
    lane[SHORT_COSINE], lane[SHORT_SINE] = math.cos(short), math.sin(short)
    lane[LONG_COSINE], lane[LONG_SINE] = math.cos(long), math.sin(long)
    if shape < 0.5:
        place = min(math.sqrt(-math.log(keep)) / LARGEST_ROOT, 1.0) * CELLS
        cell = min(int(place), CELLS - 1)
        low, high = np.float64(table[CURVE + cell]), np.float64(table[CURVE + cell + 1])
        lane[FAR_KEEP], lane[FAR_KICK] = keep, low + (place - cell) * (high - low)
    else:
        far, near = kick_cosines(keep, shape, np.float64(table[FAR]))
        lane[FAR_KEEP], lane[FAR_KICK] = far, math.sqrt((1.0 - far) * (1.0 + far))
        lane[NEAR_KEEP], lane[NEAR_KICK] = near, math.sqrt((1.0 - near) * (1.0 + near))


@LaneFunction
def start(lane: Any, words: Any, table: Any) -> None:
    """The stationary law (11) on a circle: 1 - r^2/r0^2 = W^(1/alpha) with W uniform, and a uniform direction.

    On an ellipse the same law, stretched; the road warms up from it.
    """
    inverse_bound = np.float64(table[INVERSE_BOUND])
    square = 1.0 / inverse_bound if inverse_bound > 0.0 else np.float64(table[SQUARE_CHORD])
    free = uniform(words[0]) ** (1.0 / np.float64(table[SHAPE]))
    radius = math.sqrt(square * (1.0 - free))
    angle = 2.0 * math.pi * uniform(words[LANES])
    lane[LEVEL] = radius * math.cos(angle) / math.sqrt(table[CHORD_RATIO])
    lane[SLOPE] = radius * math.sin(angle)


@LaneFunction
def advance(lanes: Any, words: Any, table: Any) -> None:
    """Rotate, kick on the sphere, rotate; shapes alpha >= 1/2."""
    zero, half, one, three_halves = like(lanes, 0.0), like(lanes, 0.5), like(lanes, 1.0), like(lanes, 1.5)
    twelfth = like(lanes, 1.0 / 12.0)
    fraction_unit = like(lanes, 2.0**-16)
    square_chord, chord_ratio, inverse_bound = table[SQUARE_CHORD], table[CHORD_RATIO], table[INVERSE_BOUND]
    far_below = np.int32(table[FAR])
    # The look-up has a loop of its own and does nothing else, since it is the one part that does not vectorise. Of a word, the
    # top bit chooses the instant of the kick, the next its sign, nine the cell of the table, sixteen the place in the cell,
    # and the last five whether it goes far.
    for i in range(LANES):
        place = 2 * np.int64((words[i] >> np.uint32(21)) & np.uint32(CELLS - 1))
        begin, width = table[PAIRS + place], table[PAIRS + place + 1]
        lanes[CELL + 2 * i] = begin
        lanes[CELL + 2 * i + 1] = width
    for i in range(LANES):
        word = words[i]
        early = np.int32(word) < np.int32(0)
        sign = like(lanes, np.int32(np.int32((word >> np.uint32(29)) & np.uint32(2)) - np.int32(1)))
        place = like(lanes, np.int32((word >> np.uint32(5)) & np.uint32(0xFFFF))) * fraction_unit
        far = np.int32(word & np.uint32(CHANCES - 1)) < far_below
        direction = sign * (lanes[CELL + 2 * i] + place * lanes[CELL + 2 * i + 1])

        short_cosine, short_sine = lanes[SHORT_COSINE + i], lanes[SHORT_SINE + i]
        long_cosine, long_sine = lanes[LONG_COSINE + i], lanes[LONG_SINE + i]
        first_cosine = short_cosine if early else long_cosine
        first_sine = short_sine if early else long_sine
        last_cosine = long_cosine if early else short_cosine
        last_sine = long_sine if early else short_sine

        old_u = lanes[SLOPE + i]
        z = first_cosine * lanes[LEVEL + i] + first_sine * old_u
        u = first_cosine * old_u - first_sine * lanes[LEVEL + i]
        free = max(square_chord - chord_ratio * z * z - u * u, zero)
        far_keep, far_kick = lanes[FAR_KEEP + i], lanes[FAR_KICK + i]
        near_keep, near_kick = lanes[NEAR_KEEP + i], lanes[NEAR_KICK + i]
        keep = far_keep if far else near_keep
        kick = far_kick if far else near_kick
        u = keep * u + kick * direction * np.sqrt(free)
        new_z = last_cosine * z + last_sine * u
        new_u = last_cosine * u - last_sine * z
        # rounding can leave the circle by a few units in the last place: one Newton step back, exact to their square
        inside = min(three_halves - half * (new_z * new_z + new_u * new_u) * inverse_bound, one)
        new_u = new_u * inside
        lanes[LEVEL + i] = new_z * inside
        lanes[SLOPE + i] = new_u
        lanes[LEVEL_EXCESS + i] = lanes[TURN + i] * (old_u - new_u) * twelfth


@compiled
def gamma_variate(shape: Any, key0: Any, key1: Any, counter: Any) -> tuple[float, Any]:
    """(Gamma variate of ``shape`` >= 1, next counter): G. Marsaglia and W. W. Tsang, ACM Trans. Math. Softw. 26, 2000."""
    d = shape - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)
    while True:
        w0, w1, w2, _ = philox(counter, np.uint32(0), np.uint32(0), np.uint32(0), key0, key1)
        counter = np.uint32(counter + np.uint32(1))
        normal = np.float64(normal_pair(w0, w1)[0])
        v = (1.0 + c * normal) ** 3
        if v > 0.0 and math.log(uniform(w2)) < 0.5 * normal * normal + d - d * v + d * math.log(v):
            return d * v, counter


@compiled
def noncentral_chi_square(shape: Any, noncentrality: Any, key0: Any, key1: Any) -> Any:
    """Noncentral chi-square of 2 ``shape`` degrees of freedom: a Poisson mixture of Gamma variates, for any shape > 0."""
    if noncentrality > LARGE_NONCENTRALITY:
        w0, w1, _, _ = philox(np.uint32(0), np.uint32(0), np.uint32(0), np.uint32(1), key0, key1)
        return (np.float64(normal_pair(w0, w1)[0]) + math.sqrt(noncentrality + 2.0 * shape - 1.0)) ** 2
    count = 0.0
    left = 0.5 * noncentrality
    counter = np.uint32(0)
    while left > 0.0:  # a Poisson variate by inversion, in parts whose exp(-mean) does not vanish
        mean = min(left, 500.0)
        left -= mean
        w0, w1, _, _ = philox(counter, np.uint32(0), np.uint32(0), np.uint32(1), key0, key1)
        counter = np.uint32(counter + np.uint32(1))
        remaining = uniform(w0) + np.float64(w1) * 2.0**-64
        probability = math.exp(-mean)
        last = mean + 40.0 * math.sqrt(mean) + 40.0  # beyond it lies less than one unit in the last place of 1
        n = 0.0
        while remaining > probability and n < last:
            remaining -= probability
            n += 1.0
            probability *= mean / n
        count += n
    w0, w1, _, _ = philox(counter, np.uint32(0), np.uint32(0), np.uint32(2), key0, key1)
    # Gamma(k) = Gamma(k + 1) W^(1/k) holds for every k > 0 and keeps the shape at 1 or above
    total = shape + count
    variate, _ = gamma_variate(total + 1.0, key0, key1, np.uint32(0))
    return 2.0 * variate * uniform(w0) ** (1.0 / total)


@LaneFunction
def advance_small_shape(lanes: Any, words: Any, table: Any) -> None:
    """Rotate, step around the sphere and project, rotate; shapes alpha < 1/2."""
    shape = np.float64(table[SHAPE])
    square_chord, chord_ratio = np.float64(table[SQUARE_CHORD]), np.float64(table[CHORD_RATIO])
    inverse_bound = np.float64(table[INVERSE_BOUND])
    for i in range(LANES):
        key0, key1 = words[i], words[LANES + i]
        w0, w1, w2, _ = philox(np.uint32(0), np.uint32(0), np.uint32(0), np.uint32(3), key0, key1)
        early = np.int32(w2) < np.int32(0)
        first_cosine = np.float64(lanes[SHORT_COSINE + i] if early else lanes[LONG_COSINE + i])
        first_sine = np.float64(lanes[SHORT_SINE + i] if early else lanes[LONG_SINE + i])
        last_cosine = np.float64(lanes[LONG_COSINE + i] if early else lanes[SHORT_COSINE + i])
        last_sine = np.float64(lanes[LONG_SINE + i] if early else lanes[SHORT_SINE + i])
        eta = np.float64(lanes[FAR_KICK + i])

        old_z, old_u = np.float64(lanes[LEVEL + i]), np.float64(lanes[SLOPE + i])
        z = first_cosine * old_z + first_sine * old_u
        u = first_cosine * old_u - first_sine * old_z
        half_chord = math.sqrt(max(square_chord - chord_ratio * z * z, 1e-300))
        x = u / half_chord
        if abs(x) >= 1.0 or eta == 0.0:  # on the bound, or outside an ellipse, or standing still: no noise
            u *= np.float64(lanes[FAR_KEEP + i])
        else:
            x_new = x + eta * np.float64(normal_pair(w0, w1)[0])
            free = eta * eta * noncentral_chi_square(shape, (1.0 - x * x) / (eta * eta), key0, key1)
            u = half_chord * x_new / math.sqrt(x_new * x_new + free)
        new_z = last_cosine * z + last_sine * u
        new_u = last_cosine * u - last_sine * z
        inside = min(1.5 - 0.5 * (new_z * new_z + new_u * new_u) * inverse_bound, 1.0)
        lanes[LEVEL + i] = new_z * inside
        lanes[SLOPE + i] = new_u * inside
        lanes[LEVEL_EXCESS + i] = lanes[TURN + i] * (old_u - new_u) / 12.0


@functools.cache
def ellipse_variance(ratio: float, shape: float, bandwidth: float, error: float = 0.002) -> tuple[float, float]:
    """(E Z^2 / z0^2, its standard error) on an ellipse with u0/z0 = ``ratio``, by simulation to the relative ``error``.

    Independent roads are driven at a substep of 0.05 rad until the standard error of their time averages is small enough; the
    bias of that substep is smaller still.
    """
    from ..plant import Plant
    from ..task import make_task

    lanes, interval, substeps = 16384, 1.0, 20
    plant = Plant(make_task(road=_UnitEllipse(ratio, shape, bandwidth), control_interval=interval, substeps=substeps), lanes)
    plant.start(np.arange(lanes, dtype=np.uint64))
    actions = np.full(lanes, 0.5, np.float32)
    for _ in range(math.ceil(5 / bandwidth)):  # exp(-2 delta angle) below 1e-4
        plant.step(actions)
    total, steps = np.zeros(lanes), 0
    while True:
        for _ in range(math.ceil(1 / bandwidth)):
            plant.step(actions)
            total += plant.row("level").astype(float) ** 2
            steps += 1
        mean = total.mean() / steps
        spread = total.std(ddof=1) / steps / math.sqrt(lanes)
        if spread <= error * mean:
            return float(mean), float(spread)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MultiplicativeRoad(Road):
    """Bounded road with multiplicative noise within Z^2/level_bound^2 + U^2/slope_bound^2 <= 1; equations (7), (8), (11), (12).

    Args:
        bandwidth: damping ratio delta of the road filter, 1.
        noise_intensity: sigma, m^(1/2).
        level_bound: semi-axis z0, m.
        slope_bound: semi-axis u0, m; None for level_bound, the circle. On any other ellipse the noise is clipped,
            V^2 -> max(V^2, 0), the path leaves the ellipse now and then, and (11), (12) do not hold.
        wavenumber: centre frequency Omega, rad/m.
    """

    kind: str = dataclasses.field(default="multiplicative", init=False)
    bandwidth: float = 0.1
    noise_intensity: float = math.sqrt(0.1)
    level_bound: float = 1.0
    slope_bound: float | None = None

    constructors = {"iso_class": "from_iso8608", "shape": "from_shape"}  # noqa: RUF012 - of the class, as its base declares
    prepare = prepare
    start = start

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, bandwidth="constant bandwidth", noise_intensity="noise_intensity", level_bound="length")
        if self.slope_bound is not None:
            check_fields(self, slope_bound="length")
        shapes = "constant shape" if self.is_circle else "ellipse shape"
        check_ratio("noise_intensity", self.noise_intensity, "the shape alpha", self.shape, shapes)
        if self.slope_bound is not None and not self.is_circle:
            check_ratio("slope_bound", self.slope_bound, "u0/z0", self.slope_bound / self.level_bound, "axes ratio")
            within("bandwidth on an ellipse", self.bandwidth, "ellipse bandwidth")

    @classmethod
    def from_iso8608(
        cls,
        iso_class: str | float,
        *,
        shape: float = 2.0,
        lowest_frequency: float = iso8608.LOWEST,
        highest_frequency: float = iso8608.HIGHEST,
    ) -> MultiplicativeRoad:
        """A bounded road with the spectrum of a class of ISO 8608 between two corners; see `roadgym.roads.iso8608`.

        Args:
            iso_class: "A" to "H", or the density G(n0) in m^3.
            shape: alpha of its density (11): the larger, the nearer to Gaussian and the wider the bound.
            lowest_frequency, highest_frequency: corners of the spectrum, cycles/m.
        """
        wavenumber, bandwidth, ratio = iso8608.corners(lowest_frequency, highest_frequency)
        variance = iso8608.strength(iso_class) * ratio / (4 * bandwidth * wavenumber)
        bound = math.sqrt(2 * (within("shape", shape, "constant shape") + 1) * variance)  # (12)
        return cls.from_shape(shape=shape, bandwidth=bandwidth, level_bound=bound, wavenumber=wavenumber)

    @classmethod
    def from_shape(
        cls, *, shape: float, bandwidth: float = 0.1, level_bound: float = 1.0, wavenumber: float = 1.0
    ) -> MultiplicativeRoad:
        """The road on a circle whose density (11) has the shape alpha: sigma^2 = 2 delta Omega r0^2 / alpha."""
        shape, level_bound = within("shape", shape, "constant shape"), within("level_bound", level_bound, "length")
        square = (
            2 * within("bandwidth", bandwidth, "constant bandwidth") * within("wavenumber", wavenumber) * level_bound**2 / shape
        )
        return cls(bandwidth=bandwidth, noise_intensity=math.sqrt(square), level_bound=level_bound, wavenumber=wavenumber)

    @property
    def is_circle(self) -> bool:
        """Are both semi-axes equal, so that the law is known?"""
        return self.slope_bound in (None, self.level_bound)

    @property
    def shape(self) -> float:
        """alpha = 2 delta Omega u0^2 / sigma^2 (11), rounded to 12 digits, so that it survives `from_shape`.

        On an ellipse it is the shape of the law of U at a fixed Z.
        """
        bound = self.level_bound if self.slope_bound is None else self.slope_bound
        return float(f"{2 * self.bandwidth * self.wavenumber * bound**2 / self.noise_intensity**2:.12g}")

    @property
    def variance(self) -> float:
        """E Z^2 = E U^2, m^2: r0^2 / (2 (alpha + 1)) (12) on a circle; on an ellipse by simulation (seconds, once)."""
        if self.is_circle:
            return self.level_bound**2 / (2 * (self.shape + 1))
        return self.level_bound**2 * ellipse_variance(*self._ellipse)[0]

    @property
    def variance_standard_error(self) -> float:
        """Standard error of the variance, m^2: 0 on a circle, 0.2 % of the variance or less on an ellipse."""
        return 0.0 if self.is_circle else self.level_bound**2 * ellipse_variance(*self._ellipse)[1]

    @property
    def _ellipse(self) -> tuple[float, float, float]:
        assert self.slope_bound is not None
        return self.slope_bound / self.level_bound, self.shape, self.bandwidth

    @property
    def precision(self) -> str:
        """Below alpha = 1 the path touches the bound, and 1 - r^2/r0^2 needs more digits than single precision has."""
        return "float64" if self.shape < 1 else "float32"

    def check_driven(self) -> None:
        """The table of the scheme is right for a range of shapes."""
        check_ratio("noise_intensity", self.noise_intensity, "the shape alpha", self.shape, "shape")

    largest_loss = 0.6  # of a step whose kick has the right mean

    @property
    def loss_range(self) -> str:  # type: ignore[override]
        """The scheme for small shapes takes the longer, the less is lost in a substep."""
        return "loss at small shapes" if self.shape < 0.5 else "loss"

    @property
    def advance(self) -> LaneFunction:  # type: ignore[override]
        """One substep; the scheme depends on the shape."""
        return advance_small_shape if self.shape < 0.5 else advance

    @property
    def words_per_substep(self) -> int:  # type: ignore[override]
        """One, or two for the small shapes, which make a key of them."""
        return 2 if self.shape < 0.5 else 1

    def table(self) -> npt.NDArray[np.float64]:
        """The bounds in standard deviations, the shape, and the curve of the scheme."""
        square_chord, ratio = 2 * (self.shape + 1), 1.0
        if not self.is_circle:
            assert self.slope_bound is not None
            square_chord, ratio = self.slope_bound**2 / self.variance, (self.slope_bound / self.level_bound) ** 2
        # four units in the last place inside the circle, so that what is stored never lies outside
        bound = square_chord * (1 - 4 * float(np.finfo(self.precision).eps))
        curve = projection_curve(self.shape) if self.shape < 0.5 else direction_quantiles(self.shape)
        constants = [square_chord, ratio, 1 / bound if self.is_circle else 0.0, self.shape, far_chance(self.shape)]
        pairs = np.stack([curve[:-1], np.diff(curve)], axis=1)
        return np.concatenate([constants, curve, pairs.ravel()])

    def shaping_filter(self, bandwidth: npt.ArrayLike | None = None) -> ShapingFilter:
        """Equations (7), (8); on an ellipse the second moments alone are known, over the variance that there is."""
        return second_order_filter(
            self.bandwidth if bandwidth is None else bandwidth, 1 / self.shape if self.is_circle else None
        )

    def with_bandwidth(self, bandwidth: float) -> MultiplicativeRoad:
        """The same road with another bandwidth, and the same shape and variance; circles only."""
        bandwidth = within("bandwidth", bandwidth, "constant bandwidth")
        if not self.is_circle:
            if bandwidth == self.bandwidth:
                return self
            raise ParameterError(
                f"bandwidth cannot be replaced on an ellipse, whose level and slope bound fix another variance for each: "
                f"it must be the road's own, {self.bandwidth:g}, got {bandwidth:g}"
            )
        scale = math.sqrt(bandwidth / self.bandwidth)
        return dataclasses.replace(self, bandwidth=bandwidth, noise_intensity=self.noise_intensity * scale)


class _UnitEllipse(MultiplicativeRoad):
    """A road on an ellipse in units of z0, whatever its variance, to find the latter."""

    def __init__(self, ratio: float, shape: float, bandwidth: float) -> None:
        super().__init__(
            bandwidth=bandwidth, level_bound=1.0, slope_bound=ratio, noise_intensity=math.sqrt(2 * bandwidth * ratio**2 / shape)
        )

    variance = 1.0
