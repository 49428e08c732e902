"""Counter-based random numbers: Philox4x32-10, and normals from its words.

A word is a pure function of (key, counter), so any step of any episode of any environment can be computed by itself, in any
order, on any thread. The key is hashed from the environment's seed; the counter is (chunk, step, episode, purpose).

Source: J. K. Salmon, M. A. Moraes, R. O. Dror and D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC'11.
Normals by Box and Muller's transformation in single precision from 31 and 32 random bits: up to 6.6 standard deviations. The
error, against double precision from the same words, is absolute: below 2e-6, but for radii below 0.02 (chance 2e-4), where
single precision cannot tell the logarithm's argument from 1, up to 2.5e-4. Relative to the value it is below 1e-6 from one
standard deviation on, and unbounded near zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .compiled import LANES, LaneFunction, compiled, inlined

START, INTERVAL, WARM_UP, SENSOR, SENSOR_BIAS, CAR = range(6)  # purposes: what a word is for

Word = Any  # uint32 in compiled code


@inlined
def philox(c0: Word, c1: Word, c2: Word, c3: Word, k0: Word, k1: Word) -> tuple[Word, Word, Word, Word]:
    """Philox4x32-10: four random words for a counter of four words and a key of two.

    Words are kept in 64 bits and their upper halves left as they fall until the end: every product then is one vector
    instruction, and no shuffles are needed between rounds.
    """
    lower, half = np.uint64(0xFFFFFFFF), np.uint64(32)
    x0, x1, x2, x3 = np.uint64(c0), np.uint64(c1), np.uint64(c2), np.uint64(c3)
    y0, y1 = np.uint64(k0), np.uint64(k1)
    for _ in range(10):
        p0 = np.uint64(0xD2511F53) * (x0 & lower)
        p1 = np.uint64(0xCD9E8D57) * (x2 & lower)
        x0, x1 = (p1 >> half) ^ x1 ^ y0, p1
        x2, x3 = (p0 >> half) ^ x3 ^ y1, p0
        y0 += np.uint64(0x9E3779B9)
        y1 += np.uint64(0xBB67AE85)
    return np.uint32(x0), np.uint32(x1), np.uint32(x2), np.uint32(x3)


@LaneFunction
def fill_words(counters: Any, words: Any, request: Any) -> None:
    """Fill rows of ``words``; all arguments are words. ``counters`` has the rows key, key, episode, step; ``request`` the
    purpose and the number of rows, which is rounded up to a multiple of four.
    """
    purpose = request[0]
    for chunk in range((request[1] + 3) // 4):
        number = np.uint32(chunk)
        base = 4 * LANES * chunk
        for i in range(LANES):
            w0, w1, w2, w3 = philox(
                number, counters[3 * LANES + i], counters[2 * LANES + i], purpose, counters[i], counters[LANES + i]
            )
            words[base + i] = w0
            words[base + LANES + i] = w1
            words[base + 2 * LANES + i] = w2
            words[base + 3 * LANES + i] = w3


@compiled
def uniform(word: Word) -> Any:
    """A number in the open interval (0, 1), double precision, from one word."""
    return (np.float64(word) + 0.5) * 2.0**-32


@compiled
def normal_pair(first: Word, second: Word) -> tuple[Any, Any]:
    """Two independent standard normals (float32) from two words, without calls, branches or tables, so that loops vectorise."""
    # radius sqrt(-2 ln U), U = (n + 1/2) / 2^31: split U into mantissa in [sqrt(1/2), sqrt(2)) and exponent
    numerator = np.float32(np.int32(first >> np.uint32(1))) + np.float32(0.5)
    bits = np.float32(numerator).view(np.int32)
    shifted = np.int32(bits - np.int32(0x3F3504F3))
    exponent = np.int32(shifted >> np.int32(23))
    mantissa = np.int32(np.int32(shifted & np.int32(0x007FFFFF)) + np.int32(0x3F3504F3)).view(np.float32)
    # ln(mantissa) = 2 artanh(t), t = (m - 1)/(m + 1), |t| < 0.172: the series to t^9 is exact to single precision
    t = (mantissa - np.float32(1)) / (mantissa + np.float32(1))
    t2 = t * t
    series = np.float32(2.0 / 9.0)
    series = series * t2 + np.float32(2.0 / 7.0)
    series = series * t2 + np.float32(2.0 / 5.0)
    series = series * t2 + np.float32(2.0 / 3.0)
    series = series * t2 + np.float32(2.0)
    logarithm = series * t + np.float32(np.int32(exponent - np.int32(31))) * np.float32(0.6931471805599453)
    radius = np.sqrt(np.maximum(np.float32(-2.0) * logarithm, np.float32(0.0)))

    # angle pi * a, a in [-1, 1): fold to [-1/2, 1/2], where the Taylor polynomials are exact to single precision
    a = np.float32(np.int32(second)) * np.float32(2.0**-31)
    distance = np.abs(a)
    for_sine = np.copysign(min(distance, np.float32(1.0) - distance), a)
    sine = sine_of_turns(for_sine)
    cosine = sine_of_turns(np.float32(0.5) - distance)
    return radius * cosine, radius * sine


@compiled
def sine_of_turns(a: Any) -> Any:
    """sin(pi a) for |a| <= 1/2, float32: Taylor's polynomial to a^11, error below 1e-7."""
    a2 = a * a
    value = np.float32(-0.007370430945714351)
    value = value * a2 + np.float32(0.08214588661112823)
    value = value * a2 + np.float32(-0.5992645293207921)
    value = value * a2 + np.float32(2.550164039877345)
    value = value * a2 + np.float32(-5.16771278004997)
    value = value * a2 + np.float32(3.141592653589793)
    return value * a


@LaneFunction
def hash_seeds(seeds: Any, words: Any) -> None:
    """Two rows of keys from ``seeds``, which begin with their number."""
    count = np.int64(seeds[0])
    for i in range(count):
        low = np.uint32(seeds[1 + i])
        high = np.uint32(seeds[1 + i] >> np.uint64(32))
        k0, k1, _, _ = philox(low, high, np.uint32(0), np.uint32(0), np.uint32(0x726F6164), np.uint32(0x67796D))
        words[i] = k0
        words[count + i] = k1


def keys_from_seeds(seeds: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint32]:
    """Keys, shape (2, n), from seeds, shape (n,): neighbouring seeds give unrelated keys."""
    keys = np.empty((2, seeds.size), np.uint32)
    counted = np.concatenate([np.array([seeds.size], np.uint64), seeds])
    hash_seeds.entry(np.uint32)(counted.ctypes.data, keys.ctypes.data)
    return keys
