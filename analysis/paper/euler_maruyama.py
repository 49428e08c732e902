"""Euler-Maruyama, as in the paper: N steps of w1 dt = 10^-3. It is theory's witness for the rotating frame and its stability.

`simulate` steps one of these systems, in units of time 1/w1, with nu = wavenumber v/w1, s = sigma/w1^(1/2) and the corner
g = w_g/w1,

    original   the equations of the plant: phase (18), (25) or (30), road (2), (4) or (7), (8), and the car (19) as
               dY = X dt, dQ = -(2 D X + Y - Z) dt, X = Q + 2 D Z, which needs no derivative of the road;
    ito        the amplitudes (20)-(23) with the covariations of Ito's calculus, n = -s^2/2;
    printed    the same as printed, n = +s^2/2:
                   dA = (n A - nu B + G) dt - s B dW
                   dB = (n B + nu A + H) dt + s A dW
                   dG = ((n - 2 D) G - A - nu H + mu (1 - 2 D n)) dt - s H dW
                   dH = ((n - 2 D) H - B + nu G - 2 D mu nu) dt + s (G - 2 D mu) dW

On the harmonic road the original equations are driven by mu cos phi and by mu sin phi at once. With Y and Y^ for the two
responses, A = Y cos phi + Y^ sin phi and B = Y sin phi - Y^ cos phi are the very processes of (20), (21), pathwise.

Every lane is an independent path, so each is a batch of its own for standard errors. Noise is counter-based: results depend on
the seed, and not on threads. Steps are first order in the weak sense; `simulate(..., bias=True)` measures what that costs by
driving the same noise through steps twice as long. Equation numbers are those of Wedig (2020).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.cars import MEAN_SQUARES, QuarterCar
from roadgym.compiled import LANES, LaneFunction
from roadgym.noise import fill_words, keys_from_seeds
from roadgym.parameters import ParameterError, check_ratio, number, shown, whole, within
from roadgym.processors import usual_threads
from roadgym.reward import divergent_terms
from roadgym.roads import FirstOrderRoad, GaussianRoad, HarmonicRoad, MultiplicativeRoad, Road, make_road
from roadgym.speed import SpeedNoise, WhiteSpeedNoise, make_speed_noise

from ..checks import FloatArray, check_size, one_of, range_array
from ..driven import SETTLED, lane_seeds, standard_errors
from ..phase_noise import slowest_decay
from .steps import CHUNK, EULER_SIZE, OBSERVATIONS, STATE, march, step_amplitudes, step_random_road, step_waves


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate:
    """A mean from simulation.

    Attributes:
        value: the mean.
        standard_error: of the value, from independent lanes.
        bias: what the time step adds to the value, to first order in it; None if not asked for.
        without_bias: the value less its bias, which has less noise than the two would have apart; None likewise.
    """

    value: float
    standard_error: float
    bias: Estimate | None = None
    without_bias: Estimate | None = None

    def distance(self, expected: float) -> float:
        """The value less what is ``expected``, in standard errors."""
        difference = self.value - expected
        return difference / self.standard_error if self.standard_error > 0 else math.copysign(math.inf, difference)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulation:
    """Stationary means at one speed.

    Attributes:
        speed: v, m/s.
        first, second: means of A and B, m; on a random road of Z and U.
        first_square, second_square: their mean squares, m^2.
        amplitude: |E C| = (E(A)^2 + E(B)^2)^(1/2), the paper's V_m, m.
        mean_squares: E Y^2 and its companions by name, m^2; infinite where they diverge. Under phase noise they are averages
            over the phase too.
        edges: of the cells of the histograms, m, shape (cells + 1,).
        first_density, second_density: histograms of A and B, or of Z and U, 1/m, shape (cells,); what lies beyond the edges
            is missing from their integral.
        samples: how many entered each mean.
    """

    speed: float
    first: Estimate
    second: Estimate
    first_square: Estimate
    second_square: Estimate
    amplitude: Estimate
    mean_squares: Mapping[str, Estimate]
    edges: FloatArray
    first_density: FloatArray
    second_density: FloatArray
    samples: int


FORMS = ("original", "ito", "printed")


@dataclasses.dataclass(frozen=True)
class System:
    """What `march` steps.

    Attributes:
        step: one step of a block.
        table: its constants for a step h.
        noises: how many drive it.
        spread: of Psi at the start, rad.
        memory: how long the start is remembered, in units of 1/w1.
        longest_step: h beyond which steps of twice that, which measure the bias, may diverge.
    """

    step: LaneFunction
    table: Callable[[float], FloatArray]
    noises: int
    spread: float
    memory: float
    longest_step: float


def _strength(speed_noise: SpeedNoise | None, natural_frequency: float) -> float:
    return 0.0 if speed_noise is None else speed_noise.intensity / math.sqrt(natural_frequency)


def amplitude_system(mu: float, strength: float, damping: float, ratio: float, form: str) -> System:
    """(20)-(23), as printed or with Ito's signs."""
    sign = 1.0 if form == "printed" else -1.0
    square = strength**2
    rate = float(slowest_decay(np.asarray(damping))) - (square if form == "printed" else 0.0)  # of the length of (A, B, G, H)
    return System(
        step_amplitudes,
        lambda h: np.array(
            [h, 2 * damping, ratio, 0.0, strength * math.sqrt(h), sign * square / 2, mu * (1 - sign * damping * square), mu]
        ),
        1,
        0.0,
        1 / rate if rate > 0 else math.inf,
        # a step h of Euler's turns a rotation r into a growth h r^2/2, and noise adds h s^4/8
        rate / ((1 + ratio + 2 * damping) ** 2 + square**2) if rate > 0 else math.inf,
    )


def make_system(
    road: Road, speed_noise: SpeedNoise | None, damping: float, speed: float, natural_frequency: float, form: str
) -> System:
    """What ``form`` asks for at a speed, m/s; a ParameterError where it is not defined or has no stationary means."""
    ratio = speed * road.wavenumber / natural_frequency
    strength = _strength(speed_noise, natural_frequency)
    if one_of("form", form, FORMS) != "original":
        if not isinstance(road, HarmonicRoad) or not (speed_noise is None or isinstance(speed_noise, WhiteSpeedNoise)):
            raise ParameterError(f"form must be original but for the harmonic road with white speed noise or none, got {form}")
        system = amplitude_system(road.amplitude, strength, damping, ratio, form)
        if math.isinf(system.memory):
            limit = math.sqrt(natural_frequency * float(slowest_decay(np.asarray(damping))))
            raise ParameterError(
                f"intensity must be below {limit:g} at damping {damping:g}, where the printed amplitudes diverge, got "
                f"{strength * math.sqrt(natural_frequency):g}"
            )
        return system
    corner = pull = white = 0.0
    if speed_noise is not None:
        corner, pull, white = speed_noise.rates
        corner, pull = corner / natural_frequency, pull / natural_frequency
    spread = strength / math.sqrt(2 * corner) if corner else 0.0
    slowest = float(slowest_decay(np.asarray(damping)))
    memory = 1 / slowest
    # Euler's steps amplify a free motion of the car unless h < D/2 and h < 1/(2 D); the phase may turn by 0.5 rad a step
    longest = min(damping / 2, 0.5 / damping, 0.5 / max(corner, 1e-9))
    noise_rate = max(strength**2 / 0.025 if white else 0.0, 10 * abs(pull) * spread)
    if isinstance(road, HarmonicRoad):
        feed = strength if corner else 0.0
        return System(
            step_waves,
            lambda h: np.array(
                [h, 2 * damping, ratio, corner, pull, white * strength * math.sqrt(h), feed * math.sqrt(h), road.amplitude]
            ),
            1,
            spread,
            memory,
            min(longest, 1 / max(2 * ratio, noise_rate, 1e-9)),
        )
    limits = (0.0, 0.0)
    if isinstance(road, FirstOrderRoad):
        kick, loss, road_memory = road.noise_intensity, -1.0, 1 / ratio
        road_step = 0.5
    elif isinstance(road, (GaussianRoad, MultiplicativeRoad)):
        kick, loss = road.noise_intensity, 2 * road.bandwidth
        road_step = min(road.bandwidth / 2, 0.5 / road.bandwidth)
        road_memory = 1 / (float(slowest_decay(np.asarray(road.bandwidth))) * ratio)
        if isinstance(road, MultiplicativeRoad):
            limits = (road.level_bound**-2, (road.slope_bound or road.level_bound) ** -2)
    else:
        raise ParameterError(f"road must be of a kind whose equations are known here, got a {road.kind} road")
    return System(
        step_random_road,
        lambda h: np.array(
            [
                *(h, 2 * damping, ratio, corner, pull, 0.0, strength * math.sqrt(h)),
                *(kick * math.sqrt(h / road.wavenumber), loss, *limits),
            ]
        ),
        1 if speed_noise is None else 2,
        spread,
        max(memory, road_memory),
        min(longest, road_step / (ratio + 3 * abs(pull) * spread)),
    )


def simulate(
    road: str | Mapping[str, Any] | Road,
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None = None,
    *,
    damping: float,
    speed: npt.ArrayLike,
    natural_frequency: float = 1.0,
    form: str = "original",
    samples: int = 20_000_000,
    time_step: float = 1e-3,
    lanes: int = LANES,
    histogram: tuple[float, float, int] | None = None,
    bias: bool = False,
    seed: int = 0,
    threads: int | None = None,
    report: Callable[[int, int], None] | None = None,
) -> list[Simulation]:
    """Euler-Maruyama at the paper's scale (Fig. 7): means, mean squares and histograms at each speed, with standard errors.

    Lanes start at rest, and what they remember of that is skipped. See the module's docstring for the equations.

    Args:
        road: a road, or its name or mapping.
        speed_noise: noise on the speed, or its name or mapping, or None.
        damping: D > 0, 1.
        speed: speeds v >= 0, m/s, a number or several, above zero on random roads; each has noise of its own.
        natural_frequency: w1, rad/s.
        form: "original", the equations of the plant; "ito" or "printed", the amplitudes (20)-(23) under white noise.
        samples: N, steps at each speed, shared out between the lanes.
        time_step: w1 dt, 1.
        lanes: independent paths at each speed, a multiple of 64.
        histogram: first edge, last edge, m, and number of cells; by default none.
        bias: measure the bias of the time step, for about 60 % more work.
        seed: fixes the noise.
        threads: how many; results do not depend on it. By default one a processor.
        report: called as ``report(blocks done, blocks in all)``.

    Returns:
        One `Simulation` for each speed.

    Raises:
        ParameterError: a value out of range, a system without stationary means, or fewer samples than lanes.
    """
    road = make_road(road)
    speed_noise = make_speed_noise(speed_noise, road)
    damping, w1 = within("damping", damping), within("natural_frequency", natural_frequency)
    speeds = range_array("speed", speed, "any speed" if isinstance(road, HarmonicRoad) else "moving speed").reshape(-1).tolist()
    check_size("speeds", "speed", len(speeds), "driven points")
    for value in speeds:
        ratio = value * road.wavenumber / w1
        check_ratio("speed", value, "nu = speed * wavenumber/natural_frequency", ratio, "any frequency ratio")
    if speed_noise is not None:
        speed_noise.check_range(w1)
    h = within("time_step", time_step)
    if whole("lanes", lanes, of="lanes") % LANES:
        raise ParameterError(f"lanes must be a multiple of {LANES}, got {lanes}")
    if whole("samples", samples, of="samples") < CHUNK * lanes:
        raise ParameterError(f"samples must be at least {CHUNK * lanes} for {lanes} lanes, got {samples}")
    whole("seed", seed, low=0, of="seed")
    low, high, cells = _histogram(histogram)
    if threads is not None:
        whole("threads", threads, of="threads")

    systems = [make_system(road, speed_noise, damping, value, w1, form) for value in speeds]
    for system in systems:
        check_ratio(
            "time_step",
            h,
            "it over the longest that is stable at this damping and speed",
            h / system.longest_step,
            "Euler step",
        )
        work = samples + SETTLED * system.memory / h * lanes
        check_size("steps of all lanes", "samples, lanes and time_step", work * len(speeds), "work")
    blocks = lanes // LANES
    chunks = math.ceil(samples / lanes / CHUNK)
    seeds = np.random.SeedSequence(seed)
    keys = keys_from_seeds(lane_seeds(seeds, len(speeds) * lanes)).reshape(2, len(speeds), blocks, LANES)
    starts = np.random.default_rng(seeds).standard_normal((len(speeds), blocks, LANES))

    def drive(place: int, block: int, merged: int) -> tuple[FloatArray, npt.NDArray[np.int64]]:
        """Means over time of the observed rows of one block, shape (rows, LANES), and its histograms."""
        system = systems[place]
        rows = np.zeros(EULER_SIZE)
        if system.step is not step_amplitudes:
            rows[STATE + 2 * LANES : STATE + 3 * LANES] = system.spread * starts[place, block]
        if system.step is step_waves:
            rows[STATE : STATE + LANES] = 1.0  # phase 0
        counters = np.concatenate([*keys[:, place, block], np.zeros(2 * LANES, np.uint32)])
        addresses = np.array([fill_words.address(np.uint32), system.step.address(np.float64)])
        skipped = math.ceil(SETTLED * system.memory / h / CHUNK)
        sums, none = np.zeros(OBSERVATIONS * LANES), np.zeros((2, 0), np.int64)
        counts = np.zeros((2, cells + 2 if cells and merged == 1 else 0), np.int64)
        settings = rows, counters, system.table(merged * h), addresses, system.noises, merged
        scale = cells / (high - low)
        march(*settings, 0, skipped, np.zeros(0), none, low, scale)
        march(*settings, skipped, skipped + chunks, sums, counts, low, scale)
        return sums.reshape(OBSERVATIONS, LANES) * (merged / (chunks * CHUNK)), counts

    merges = (1, 2) if bias else (1,)
    jobs = list(itertools.product(range(len(speeds)), range(blocks), merges))
    found = in_threads(drive, jobs, threads, report)
    divergent = divergent_terms(QuarterCar(), road, speed_noise)
    results = []
    for place, value in enumerate(speeds):
        fine, coarse = (
            np.concatenate([found[place, block, merged][0] for block in range(blocks)], axis=1) if merged in merges else None
            for merged in (1, 2)
        )
        assert fine is not None
        counts = sum(found[place, block, 1][1] for block in range(blocks))
        results.append(_summary(value, fine, coarse, np.asarray(counts), (low, high, cells), divergent, chunks * CHUNK * lanes))
    return results


def _histogram(value: Any) -> tuple[float, float, int]:
    """Low edge, high edge and number of cells; no cells for None."""
    if value is None:
        return 0.0, 1.0, 0
    if not isinstance(value, Sequence) or isinstance(value, (str, bytes)) or len(value) != 3:
        raise ParameterError(f"histogram must be (low, high, cells), got {shown(value)}")
    low, high = number("histogram, low edge,", value[0]), number("histogram, high edge,", value[1])
    if low >= high:
        raise ParameterError(f"histogram must be (low, high, cells) with low < high, got {shown(value)}")
    return low, high, whole("histogram, number of cells,", value[2], of="cells")


def in_threads(
    function: Callable[..., Any],
    jobs: Sequence[tuple[Any, ...]],
    threads: int | None,
    report: Callable[[int, int], None] | None,
) -> dict[tuple[Any, ...], Any]:
    """Results of ``function(*job)``, by job; compiled code runs without the interpreter's lock."""
    results: dict[tuple[Any, ...], Any] = {jobs[0]: function(*jobs[0])} if jobs else {}  # compiles, once
    with ThreadPoolExecutor(threads or usual_threads()) as pool:
        pending: dict[Future[Any], tuple[Any, ...]] = {pool.submit(function, *job): job for job in jobs[1:]}
        try:
            while pending:
                for future in wait(pending, return_when=FIRST_COMPLETED)[0]:
                    results[pending.pop(future)] = future.result()
                    if report:
                        report(len(results), len(jobs))
        except BaseException:  # an interrupt too: what has not begun is given up
            pool.shutdown(cancel_futures=True)
            raise
    return results


def estimate(fine: FloatArray, coarse: FloatArray | None) -> Estimate:
    """From the figures of each lane at the step h and at 2 h: value(h) = value(0) + c h, value(2 h) = value(0) + 2 c h."""

    def mean(figures: FloatArray, **fields: Estimate) -> Estimate:
        return Estimate(value=float(figures.mean()), standard_error=float(standard_errors(figures)), **fields)

    if coarse is None:
        return mean(fine)
    return mean(fine, bias=mean(coarse - fine), without_bias=mean(2 * fine - coarse))


def _summary(
    speed: float,
    fine: FloatArray,
    coarse: FloatArray | None,
    counts: npt.NDArray[np.int64],
    histogram: tuple[float, float, int],
    divergent: tuple[str, ...],
    samples: int,
) -> Simulation:
    """Estimates from the means of each lane, shape (rows, lanes), at the step and at twice the step."""

    def combined(weights: FloatArray) -> Estimate:
        """Of a linear combination of rows."""
        return estimate(weights @ fine, None if coarse is None else weights @ coarse)

    rows = [combined(row) for row in np.eye(OBSERVATIONS)]
    mean = np.hypot(rows[0].value, rows[1].value)
    direction = np.zeros(OBSERVATIONS)
    direction[:2] = np.array([rows[0].value, rows[1].value]) / (mean or 1.0)  # to first order, |E C| moves along E C
    squares = {
        name: Estimate(value=math.inf, standard_error=0.0) if name in divergent else row
        for name, row in zip(MEAN_SQUARES, rows[2:7], strict=True)
    }
    low, high, cells = histogram
    edges = np.linspace(low, high, cells + 1) if cells else np.zeros(0)
    densities = counts[:, 1:-1] / samples * (cells / (high - low))
    return Simulation(
        speed=speed,
        first=rows[0],
        second=rows[1],
        first_square=rows[7],
        second_square=rows[8],
        amplitude=combined(direction),
        mean_squares=squares,
        edges=edges,
        first_density=densities[0],
        second_density=densities[1],
        samples=samples,
    )
