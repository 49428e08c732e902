"""The counter-based generator: known answers, laws, independence."""

import numpy as np
import pytest
from numba import njit
from scipy import stats

from roadgym.compiled import LANES
from roadgym.noise import fill_words, keys_from_seeds, normal_pair, philox, uniform


# Known answers of Random123 for philox4x32-10, ten rounds.
@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ((0,) * 4, (0,) * 2, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_published_words(counter, key, expected):
    @njit
    def words(counter, key):
        return philox(counter[0], counter[1], counter[2], counter[3], key[0], key[1])

    assert words(np.array(counter, np.uint32), np.array(key, np.uint32)) == expected


@njit
def draw_normals(keys, steps):
    out = np.empty((keys.shape[1], steps, 4), np.float32)
    for i in range(keys.shape[1]):
        for step in range(steps):
            w = philox(np.uint32(0), np.uint32(step), np.uint32(0), np.uint32(1), keys[0, i], keys[1, i])
            out[i, step, 0], out[i, step, 1] = normal_pair(w[0], w[1])
            out[i, step, 2], out[i, step, 3] = normal_pair(w[2], w[3])
    return out


@pytest.fixture(scope="module")
def normals():
    return draw_normals(keys_from_seeds(np.arange(1000, dtype=np.uint64)), 1000).astype(float)


def test_normals_follow_the_normal_law(normals):
    sample = normals.reshape(-1)  # 4e6 numbers
    assert stats.kstest(sample, "norm").pvalue > 1e-3
    n = sample.size
    # standard errors of the first four moments of a standard normal: 1, sqrt 2, sqrt 15, sqrt 96 over sqrt n
    for power, expected, spread in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        assert abs(np.mean(sample**power) - expected) < 4 * np.sqrt(spread / n)


@njit(nogil=True)
def fill_normals(out, first):
    for i in range(0, out.size, 4):
        w = philox(np.uint32(0), np.uint32(first + i), np.uint32(3), np.uint32(1), np.uint32(7), np.uint32(8))
        out[i], out[i + 1] = normal_pair(w[0], w[1])
        out[i + 2], out[i + 3] = normal_pair(w[2], w[3])


def test_hundred_million_normals_follow_the_law_into_the_tails():
    part, parts, cells = 4_000_000, 25, 4096
    n = part * parts
    edges = stats.norm.ppf(np.linspace(0, 1, cells + 1))
    counts, beyond = np.zeros(cells), {4.5: 0, 5.0: 0, 5.5: 0}
    out = np.empty(part, np.float32)
    for k in range(parts):
        fill_normals(out, k * part)
        counts += np.histogram(out, edges)[0]
        for limit in beyond:
            beyond[limit] += int(np.sum(np.abs(out) > limit))
    # Kolmogorov's statistic at the edges is at most the one over all points: its bound for p = 1e-3 is 1.95/sqrt(n)
    assert np.max(np.abs(np.cumsum(counts) / n - np.arange(1, cells + 1) / cells)) < 1.95 / np.sqrt(n)
    assert stats.chisquare(counts).pvalue > 1e-3
    for limit, count in beyond.items():
        expected = n * 2 * stats.norm.sf(limit)
        assert stats.poisson.sf(count - 1, expected) > 1e-3
        assert stats.poisson.cdf(count, expected) > 1e-3


def test_largest_normal():

    @njit
    def largest():
        return normal_pair(np.uint32(0), np.uint32(0))[0]

    assert 6.5 < largest() < 6.7


def test_normals_are_independent_across_environments_steps_and_words(normals):
    limit = 4 / np.sqrt(normals.size * 3 / 4)
    assert abs(np.mean(normals[1:] * normals[:-1])) < limit
    assert abs(np.mean(normals[:, 1:] * normals[:, :-1])) < limit
    assert abs(np.mean(normals[..., 1:] * normals[..., :-1])) < limit
    # squares too: Box and Muller's pairs share a radius only if something is wrong
    squares = normals**2 - 1
    assert abs(np.mean(squares[..., 1:] * squares[..., :-1])) < 2 * limit


def test_episodes_and_purposes_are_independent():
    @njit
    def draw(n):
        out = np.empty((n, 3, 2), np.float32)
        for i in range(n):
            for k, (episode, purpose) in enumerate(((0, 1), (1, 1), (0, 2))):
                w = philox(np.uint32(0), np.uint32(i), np.uint32(episode), np.uint32(purpose), np.uint32(5), np.uint32(6))
                out[i, k, 0], out[i, k, 1] = normal_pair(w[0], w[1])
        return out

    n = 500_000
    sample = draw(n).astype(float)
    first, episode, purpose = sample[:, 0], sample[:, 1], sample[:, 2]
    for other in (episode, purpose):
        for power in (1, 2):
            products = (first**power - (power == 2)) * (other**power - (power == 2))
            assert abs(products.mean()) < 4 * products.std() / np.sqrt(2 * n)
            assert not np.array_equal(first, other)


def test_normal_pair_is_accurate():
    @njit
    def pairs(first, second):
        out = np.empty((first.size, 2), np.float32)
        for i in range(first.size):
            out[i, 0], out[i, 1] = normal_pair(first[i], second[i])
        return out

    generator = np.random.default_rng(1)
    first, second = generator.integers(2**32, size=(2, 100_000), dtype=np.uint32)
    u = ((first >> 1) + 0.5) / 2**31
    radius, angle = np.sqrt(-2 * np.log(u)), np.pi * second.astype(np.int32) / 2**31
    exact = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    # U is rounded to single precision, which moves -2 ln U by 2^-23 and so the radius by 2^-24/radius; all else is relative
    allowed = 2.0**-24 / radius + 1e-6 * radius
    assert np.all(np.abs(pairs(first, second) - exact) < 2 * allowed[:, None])


def test_uniform_stays_inside_the_open_interval():
    @njit
    def ends():
        return uniform(np.uint32(0)), uniform(np.uint32(0xFFFFFFFF))

    low, high = ends()
    assert 0 < low < 1e-9
    assert 1 - 1e-9 < high < 1


def test_rows_of_words_are_philox_of_the_counters():
    @njit
    def words_of(chunk, step, episode, purpose, key0, key1):
        return philox(np.uint32(chunk), np.uint32(step), np.uint32(episode), np.uint32(purpose), key0, key1)

    @njit
    def fill(counters, words, request):
        rows(counters, words, request)

    rows = njit(fill_words.function)
    counters = np.zeros(5 * LANES, np.uint32)
    counters[: 2 * LANES] = keys_from_seeds(np.arange(LANES, dtype=np.uint64)).reshape(-1)
    counters[2 * LANES :] = np.repeat([7, 11, 0], LANES)
    words = np.zeros(8 * LANES, np.uint32)
    fill(counters, words, np.array([2, 5], np.uint32))
    for lane in (0, 1, 63):
        for chunk in (0, 1):
            expected = words_of(chunk, 11, 7, 2, counters[lane], counters[LANES + lane])
            assert tuple(words.reshape(8, LANES)[4 * chunk : 4 * chunk + 4, lane]) == expected


def test_neighbouring_seeds_have_unrelated_keys():
    keys = keys_from_seeds(np.arange(100_000, dtype=np.uint64))
    together = keys[0].astype(np.uint64) << np.uint64(32) | keys[1]
    assert len(np.unique(together)) == keys.shape[1]
    bits = np.unpackbits((keys[:, 1:] ^ keys[:, :-1]).view(np.uint8))
    assert abs(bits.mean() - 0.5) < 4 * 0.5 / np.sqrt(bits.size)
