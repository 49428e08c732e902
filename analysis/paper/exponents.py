"""Lyapunov exponents and rotation numbers of the amplitudes by Euler-Maruyama, for `analysis.paper.stability` to meet."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import numpy.typing as npt

from roadgym.compiled import LANES
from roadgym.noise import fill_words, keys_from_seeds
from roadgym.parameters import ParameterError, check_ratio, whole, within

from ..checks import FloatArray, check_size, one_of
from ..driven import lane_seeds
from .euler_maruyama import FORMS, Estimate, amplitude_system, estimate, in_threads
from .steps import CHUNK, EULER_SIZE, STATE, march, step_amplitudes, step_waves


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stability:
    """Exponents and rotation numbers of the amplitudes, from simulation; `analysis.paper.stability` says what they should be.

    Attributes:
        top, second: Lyapunov exponents, almost sure, 1/s.
        mean: top exponent of the means, 1/s.
        upper, lower: rotation numbers, rad/s.
    """

    top: Estimate
    second: Estimate
    mean: Estimate
    upper: Estimate
    lower: Estimate


def simulate_stability(
    damping: float,
    *,
    intensity: float,
    speed: float = 1.0,
    wavenumber: float = 1.0,
    natural_frequency: float = 1.0,
    form: str = "original",
    samples: int = 4_000_000,
    time_step: float = 1e-3,
    lanes: int = 2 * LANES,
    seed: int = 0,
    threads: int | None = None,
) -> Stability:
    """Lyapunov exponents and rotation numbers (41)-(45) of the amplitudes without road, under white speed noise.

    Each lane carries two free motions over the same noise, made orthogonal now and then. The first is one of the two modes of
    the car, which the noise turns but does not mix: so all its relative increments are alike, and the mean of those of C gives
    the exponent of the means. Values are free of the first-order bias of the time step, by steps twice as long over the same
    noise; what is left of it, (w1 dt)^2, is part of the standard errors.

    Args:
        damping: D > 0, 1.
        intensity: sigma > 0, rad/s^(1/2).
        speed: v >= 0, m/s.
        wavenumber: of the road, rad/m.
        natural_frequency: w1, rad/s.
        form: "original", phase and car (18), (19); "ito" or "printed", the amplitudes (20)-(23).
        samples: steps, shared out between the lanes.
        time_step: w1 dt, 1.
        lanes: independent paths, a multiple of 128.
        seed: fixes the noise.
        threads: how many; results do not depend on it.
    """
    one_of("form", form, FORMS)
    if threads is not None:
        whole("threads", threads, of="threads")
    damping, w1 = within("damping", damping), within("natural_frequency", natural_frequency)
    ratio = within("speed", speed, "any speed") * within("wavenumber", wavenumber) / w1
    check_ratio("speed", speed, "nu = speed * wavenumber/natural_frequency", ratio, "any frequency ratio")
    strength = within("intensity", intensity, "noise_intensity") / math.sqrt(w1)
    check_ratio("intensity", intensity, "sigma/sqrt(w1)", strength, "relative intensity")
    h = within("time_step", time_step)
    turn = (ratio + 1 + 2 * damping) ** 2 + strength**4
    check_ratio(
        "time_step",
        h,
        "it over the longest that is stable at this damping and speed",
        h * max(turn, 40 * strength**2),
        "Euler step",
    )
    if whole("lanes", lanes, of="lanes") % (2 * LANES):
        raise ParameterError(f"lanes must be a multiple of {2 * LANES}, got {lanes}")
    whole("seed", seed, low=0, of="seed")
    chunk = CHUNK * h
    # per interval the amplitudes turn by less than half a turn, and the noise by five standard deviations less
    per_interval = max(1, int(min(0.5 / (ratio + 1 + 2 * damping), 0.1 / strength**2) / chunk))
    per_window = max(1, round(1 / (per_interval * chunk)))
    windows = whole("samples", samples, of="samples") // (lanes * CHUNK * per_interval * per_window)
    if windows < 1:
        raise ParameterError(f"samples must be at least {lanes * CHUNK * per_interval * per_window}, got {samples}")
    check_size("intervals", "samples over lanes, and time_step", windows * per_window, "stability intervals")
    original = form == "original"
    address = (step_waves if original else step_amplitudes).address(np.float64)
    addresses = np.array([fill_words.address(np.uint32), address])
    keys = keys_from_seeds(lane_seeds(np.random.SeedSequence(seed), lanes)).reshape(2, -1, LANES)
    root = np.emath.sqrt((damping - 1) * (damping + 1))  # modes x = (-D +- root) y
    slow = 1 / (damping + root) if damping >= 1 else damping - root  # without cancellation

    def table(step: float) -> FloatArray:
        if original:
            return np.array([step, 2 * damping, ratio, 0.0, 0.0, strength * math.sqrt(step), 0.0, 0.0])
        return amplitude_system(0.0, strength, damping, ratio, form).table(step)

    # complex motion y = Y + i Y^ and x in the rows of either system, which has C = A - i B
    rows = [STATE + row * LANES for row in ((3, 5, 4, 6) if original else (0, 1, 2, 3))]
    sign = 1 if original else -1

    def drive(block: int, merged: int) -> tuple[npt.NDArray[np.complex128], FloatArray]:
        """Relative increments of C of the first motion, logarithmic ones of the second; shape (intervals, LANES) each."""
        counters = np.concatenate([*keys[:, block], np.zeros(2 * LANES, np.uint32)])
        own = -slow if block % 2 else -slow.conjugate()
        motions = np.array([[1.0, own], [-np.conjugate(own), 1.0]], np.complex128) / np.hypot(1.0, abs(own))
        motions = np.repeat(motions[..., np.newaxis], LANES, axis=2)  # motion, (y, x), lane
        states = np.zeros((2, EULER_SIZE))
        if original:
            states[:, STATE : STATE + LANES] = 1.0
        intervals = windows * per_window
        increments, logarithms = np.empty((intervals, LANES), np.complex128), np.empty((intervals, LANES))
        settings = table(merged * h), addresses, 1, merged
        nothing = np.zeros(0), np.zeros((2, 0), np.int64), 0.0, 1.0
        for k in range(intervals):
            before = _rotating(motions[0, 0], states[0], original)
            for state, motion in zip(states, motions, strict=True):
                for part, row in enumerate(rows):
                    imaginary, place = part % 2, part // 2
                    state[row : row + LANES] = sign * motion[place].imag if imaginary else motion[place].real
                march(state, counters, *settings, k * per_interval, (k + 1) * per_interval, *nothing)
                motion[0] = state[rows[0] : rows[0] + LANES] + sign * 1j * state[rows[1] : rows[1] + LANES]
                motion[1] = state[rows[2] : rows[2] + LANES] + sign * 1j * state[rows[3] : rows[3] + LANES]
            increments[k] = _rotating(motions[0, 0], states[0], original) / before
            motions[0] /= np.linalg.norm(motions[0], axis=0)
            motions[1] -= np.sum(motions[0].conj() * motions[1], axis=0) * motions[0]
            length = np.linalg.norm(motions[1], axis=0)
            logarithms[k] = np.log(length)
            motions[1] /= length
        return increments, logarithms

    blocks = lanes // LANES
    found = in_threads(drive, list(itertools.product(range(blocks), (1, 2))), threads, None)
    interval = per_interval * chunk
    remainder = (h * max(1.0, 2 * damping)) ** 2

    def figures(merged: int) -> dict[str, FloatArray]:
        """Figures of each lane, in units of w1."""
        result: dict[str, list[FloatArray]] = {name: [] for name in ("top", "second", "mean", "upper", "lower")}
        for block in range(blocks):
            increments, logarithms = found[block, merged]
            steps = windows * per_window * interval
            result["top"].append(np.log(np.abs(increments)).sum(axis=0) / steps)
            result["second"].append(logarithms.sum(axis=0) / steps)
            result["lower" if block % 2 else "upper"].append(-np.angle(increments).sum(axis=0) / steps)
        for side in range(2):  # the two modes turn differently, so each has a mean of its own
            own = [found[block, merged][0].reshape(windows, per_window, LANES) for block in range(side, blocks, 2)]
            factors = np.concatenate([part.prod(axis=1).mean(axis=0) for part in own])
            mean = factors.mean()
            # the logarithm of the mean, to first order in what a lane is off it
            result["mean"].append((math.log(abs(mean)) + (factors / mean).real - 1) / (per_window * interval))
        return {name: w1 * np.concatenate(parts) for name, parts in result.items()}

    fine, coarse = figures(1), figures(2)
    estimates = {}
    for name in fine:
        result = estimate(fine[name], coarse[name])
        assert result.without_bias is not None
        value, error = result.without_bias.value, result.without_bias.standard_error
        estimates[name] = Estimate(value=value, standard_error=math.hypot(error, w1 * remainder), bias=result.bias)
    return Stability(**estimates)


def _rotating(motion: npt.NDArray[np.complex128], state: FloatArray, original: bool) -> npt.NDArray[np.complex128]:
    """C from the first component of a motion: exp(-i phi) (Y + i Y^) in the original equations, else as it is."""
    if not original:
        return motion.copy()
    return np.asarray(motion * (state[STATE : STATE + LANES] - 1j * state[STATE + LANES : STATE + 2 * LANES]))
