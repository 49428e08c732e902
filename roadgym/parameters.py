"""Checks of parameters, with messages that name the parameter, the value and what is allowed; and the ranges of all of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt


class ParameterError(ValueError):
    """A parameter outside its range, of the wrong kind, or in a combination that is not defined."""


class PlantError(ArithmeticError):
    """A number of the plant is not finite: a component of one's own, or the range of a parameter, lets it grow without end."""


@dataclasses.dataclass(frozen=True)
class Range:
    """What a number may be: ``low`` to ``high``, both included; ``meaning`` tells the quantity, its symbol and its unit."""

    low: float
    high: float
    meaning: str


# Within these ranges the numbers are right and the work is bounded; beyond them a value is refused. Where the physics knows
# only ratios, so do they: a speed may be anything whose frequency ratio is in its range.
RANGES: Mapping[str, Range] = MappingProxyType(
    {
        # the car, and units
        "natural_frequency": Range(1e-6, 1e6, "w1 of the car, rad/s"),
        "damping": Range(1e-3, 100.0, "damping ratio D of a plant that is driven, 1"),
        "constant damping": Range(1e-6, 1e6, "damping ratio D in closed forms, 1"),
        "free damping": Range(0.0, 1e12, "damping ratio D of the free motion, 1"),
        "mass": Range(1e-6, 1e9, "of the body and of the wheel, kg"),
        "rate": Range(1e-12, 1e15, "of a spring and of a tyre, N/m"),
        "damping coefficient": Range(1e-9, 1e12, "c of the damper, N s/m"),
        "tyre_damping": Range(0.0, 1e12, "c_t of the tyre, N s/m"),
        # roads
        "wavenumber": Range(1e-6, 1e6, "Omega of a road, rad/m"),
        "length": Range(1e-6, 1e6, "amplitude mu and bounds z0, u0 of a road, m"),
        "roughness": Range(1e-9, 1.0, "G(n0) of ISO 8608, m^3"),
        "noise_intensity": Range(1e-9, 1e9, "sigma of a road, m^(1/2), and of a speed noise, rad/s^(1/2)"),
        "variance": Range(1e-14, 1e14, "E Z^2 of a road, m^2"),
        "bandwidth": Range(1e-4, 100.0, "damping ratio delta of the filter of a road that is driven, 1"),
        "constant bandwidth": Range(1e-15, 1e6, "delta of a road in closed forms, 1"),
        "shape": Range(0.02, 1e4, "alpha = 2 delta Omega u0^2/sigma^2 of a bounded road that is driven, 1"),
        "constant shape": Range(1e-12, 1e12, "alpha in closed forms, 1"),
        "corner ratio": Range(1.0, 100.0, "second over first corner of a road, 1"),
        "waviness": Range(1.5, 3.5, "w of a road whose spectral density falls with the power w of the frequency, 1"),
        "band ratio": Range(2.0, 1e4, "highest frequency of the band of such a road, or that of its break, over the lowest, 1"),
        "axes ratio": Range(0.2, 5.0, "u0/z0 of an ellipse, 1"),
        "ellipse bandwidth": Range(0.05, 10.0, "delta on an ellipse, whose variance is found by simulation, 1"),
        "ellipse shape": Range(0.3, 100.0, "alpha on an ellipse, 1"),
        "profile points": Range(16, 1_000_000, "heights of a measured profile"),
        "profile spacing": Range(1e-3, 10.0, "distance between two of them, m"),
        "profile distance": Range(-1e9, 1e9, "distance of a point of such a profile in a file, m"),
        "profile height": Range(-1e4, 1e4, "height of a point of such a profile in a file, m"),
        # the operating point
        "frequency ratio": Range(1e-9, 1e4, "nu = speed * wavenumber/natural_frequency of a plant that is driven, 1"),
        "any speed": Range(0.0, 1e30, "speed, m/s; what counts is the frequency ratio"),
        "moving speed": Range(1e-30, 1e30, "speed, m/s, above zero; likewise"),
        "any frequency ratio": Range(0.0, 1e4, "nu of a simulation of the paper's equations, 1"),
        "linear frequency ratio": Range(1e-3, 1e3, "nu in mean squares of a road that has a filter and no closed form, 1"),
        "constant frequency ratio": Range(0.0, 1e6, "nu in closed forms, 1"),
        "relative intensity": Range(1e-6, 10.0, "sigma/sqrt(w1) of a speed noise, on a plant that is driven, rad"),
        "constant relative intensity": Range(1e-12, 1e6, "the same in closed forms"),
        "relative corner": Range(1e-4, 1e3, "w_g/w1 of a speed noise, on a plant that is driven, 1"),
        "constant relative corner": Range(1e-20, 1e20, "the same in closed forms"),
        "corner_frequency": Range(1e-20, 1e20, "w_g of a speed noise, rad/s"),
        "free intensity": Range(0.0, 1e6, "sigma of the noise on the free motion, rad/s^(1/2)"),
        # the task
        "weight": Range(1e-12, 1e12, "weight of a mean square in the reward, or 0; 1"),
        "relative interval": Range(1e-4, 1e3, "control_interval * w1, 1"),
        "substeps": Range(1, 20_000, "substeps in a control interval"),
        "substep": Range(
            0.0, 1.0, "largest angle of car and road, and half of D times that of the car, in a substep that is given; rad"
        ),
        "loss": Range(1e-10, 100.0, "delta times the road's angle in a substep, 1"),
        "loss at small shapes": Range(1e-5, 100.0, "the same on a bounded road of alpha < 1/2, whose scheme is slow below"),
        "sampled angle": Range(1e-9, 1e4, "the road's angle between two points of a profile, rad"),
        "words": Range(0, 200_000, "random words of a car in a control interval"),
        "words of a component": Range(0, 64, "random words of a road or of a speed noise in a substep"),
        "rows of a component": Range(0, 256, "numbers that a road keeps for each car, or a car in an interval"),
        "sensor": Range(0.0, 1e9, "noise, bias and resolution of a sensor, in its unit, and its delay and interval, s"),
        "delay": Range(
            0.0, 1e3, "delay of a sensor or a valve, and interval of a sensor, in control intervals; and in samples"
        ),
        "valve time": Range(0.0, 1e9, "delay of a valve, and its time constants, s"),
        "valve rate": Range(1e-9, 1e12, "largest rate of a valve, damping ratio a second, 1/s"),
        "varied fields": Range(1, 10, "fields of car and valve that vary from episode to episode"),
        "relative warm-up": Range(0.0, 1e6, "warm_up * w1, 1"),
        "warm-up substeps": Range(0, 10_000_000, "substeps in the warm-up"),
        "num_envs": Range(1, 2**24, "environments in a batch"),
        "max_episode_steps": Range(1, 2**31 - 1, "steps in an episode"),
        "threads": Range(1, 1024, "threads"),
        "seed": Range(0, 2**64 - 1, "seed"),
        # filters and controllers
        "hypotheses": Range(1, 50, "speeds, and bandwidths, among which a bank of Kalman filters weighs"),
        "mixing": Range(0.0, 1.0, "share of one rule, or of one value, in a mixture of two; 1"),
        # theory and simulation
        "array size": Range(0, 10_000_000, "entries of an array, and of the common shape of several"),
        "array entry": Range(-1e50, 1e50, "level, slope and frequency in closed forms"),
        "lag": Range(0.0, 1e50, "lag of an autocovariance, s"),
        "angular rate": Range(1e-12, 1e12, "speed * wavenumber of a spectral density, rad/s"),
        "lines": Range(1, 4_000_000, "lines of the spectrum of a profile that move a car, at one speed"),
        "operating points": Range(0, 100_000, "operating points whose best damping is asked for together"),
        "driven points": Range(0, 1_000, "operating points that are simulated together"),
        "relative_error": Range(1e-4, 1.0, "standard error over the mean, or tolerance, of what is simulated"),
        "work": Range(0, 2e11, "substeps or steps of all lanes of a simulation, together"),
        "series": Range(0, 2e8, "terms of the series of low-pass noise, of all operating points together"),
        "lanes": Range(1, 2**20, "independent paths of a simulation"),
        "samples": Range(1, 10**11, "steps of an Euler-Maruyama simulation, at one speed"),
        "time_step": Range(1e-7, 0.05, "w1 dt of an Euler-Maruyama simulation, 1"),
        "stability intervals": Range(1, 200_000, "intervals between which free motions are made orthogonal"),
        "Euler step": Range(0.0, 1.0, "time_step over the longest that is stable, 1"),
        "cells": Range(1, 100_000, "cells of a histogram"),
        "levels": Range(2, 10_000, "levels of a discrete action"),
        "frame_stack": Range(1, 1_000, "observations that are seen together"),
    }
)


def shown(value: Any) -> str:
    """``value`` for a message: its representation, shortened, and its type where it has none."""
    try:
        text = repr(value)
    except Exception:  # whatever a foreign object's representation may raise
        return f"an object of the type {type(value).__name__}"
    return text if len(text) <= 200 else f"{text[:160]}... ({type(value).__name__})"


def number(name: str, value: Any) -> float:
    """``value`` as a finite float; a numeral, as a command line or a file gives it, is a number too."""
    if isinstance(value, float):  # also NumPy's own
        result = float(value)
    elif isinstance(value, (bool, np.bool_, bytes, bytearray, np.ma.MaskedArray)) or (
        isinstance(value, (np.ndarray, np.generic)) and (value.ndim or value.dtype.kind not in "iufU")
    ):
        raise ParameterError(f"{name} must be a number, got {shown(value)}")
    else:
        try:
            result = float(value)
        except OverflowError:
            raise ParameterError(f"{name} must be finite, got {shown(value)}") from None
        except Exception:  # whatever a foreign object may raise
            raise ParameterError(f"{name} must be a number, got {shown(value)}") from None
    if not math.isfinite(result):
        raise ParameterError(f"{name} must be finite, got {shown(value)}")
    return result


def positive(name: str, value: Any) -> float:
    """``value`` as a finite float above zero."""
    result = number(name, value)
    if result <= 0:
        raise ParameterError(f"{name} must be positive, got {shown(value)}")
    return result


def non_negative(name: str, value: Any) -> float:
    """``value`` as a finite float, zero or above."""
    result = number(name, value)
    if result < 0:
        raise ParameterError(f"{name} must not be negative, got {shown(value)}")
    return result


def within(name: str, value: Any, of: str | None = None) -> float:
    """``value`` as a float in the range of `RANGES` that ``of`` names, by default ``name`` itself."""
    allowed = RANGES[of or name]
    result = positive(name, value) if allowed.low > 0 else number(name, value)
    if allowed.low <= result <= allowed.high:
        return result
    if allowed.low == 0 and result < 0:
        raise ParameterError(f"{name} must not be negative, got {shown(value)}")
    raise ParameterError(f"{name} must lie within [{allowed.low:g}, {allowed.high:g}], got {shown(value)}")


def check_ratio(name: str, value: Any, what: str, ratio: float, of: str) -> None:
    """Raise unless the dimensionless ``ratio``, ``what`` in words, in which ``name`` enters, is in the range ``of``."""
    allowed = RANGES[of]
    if not allowed.low <= ratio <= allowed.high:
        raise ParameterError(
            f"{name} must be such that {what} lies within [{allowed.low:g}, {allowed.high:g}], where {shown(value)} makes it "
            f"{ratio:g}"
        )


def positive_range(name: str, value: Any, of: str | None = None) -> tuple[float, float]:
    """``(low, high)`` with 0 < low <= high, from a pair or from one number; both in the range that ``of`` names, if given."""

    def check(what: str, end: Any) -> float:
        return positive(what, end) if of is None else within(what, end, of)

    if not _listed(value):
        single = check(name, value)
        return single, single
    if len(value) != 2:
        raise ParameterError(f"{name} must be one number or a pair (low, high), got {shown(value)}")
    low, high = check(f"{name}, low end,", value[0]), check(f"{name}, high end,", value[1])
    if low > high:
        raise ParameterError(f"{name} must be a pair (low, high) with low <= high, got {shown(value)}")
    return low, high


def pair(name: str, value: Any, of: str) -> tuple[float, float]:
    """``(low, high)`` with low < high, from a pair, both in the range that ``of`` names."""
    low, high = positive_range(name, value, of) if _listed(value) and len(value) == 2 else (0.0, 0.0)
    if low == high:
        raise ParameterError(f"{name} must be a pair (low, high) with low < high, got {shown(value)}")
    return low, high


def _listed(value: Any) -> bool:
    """Is it a sequence of its own entries, or an array of some?"""
    listed = isinstance(value, Sequence) and not isinstance(value, (str, bytes, bytearray))
    return listed or (type(value) is np.ndarray and value.ndim > 0)


def whole(name: str, value: Any, *, low: int = 1, of: str | None = None) -> int:
    """``value`` as an integer, at least ``low``, and in the range of `RANGES` that ``of`` names, if given."""
    if isinstance(value, (bool, np.bool_, np.ma.MaskedArray)) or not hasattr(value, "__index__"):
        raise ParameterError(f"{name} must be an integer, got {shown(value)}")
    try:
        result = int(value.__index__())
    except Exception:  # an array has the method, and a foreign object may raise what it likes
        raise ParameterError(f"{name} must be an integer, got {shown(value)}") from None
    least = low if of is None else max(low, int(RANGES[of].low))
    if result < least:
        raise ParameterError(f"{name} must be at least {least}, got {shown(value)}")
    if of is not None and result > RANGES[of].high:
        raise ParameterError(f"{name} must be at most {int(RANGES[of].high)}, got {shown(value)}")
    return result


def number_array(name: str, value: Any) -> npt.NDArray[np.float64]:
    """``value``, a number or an array of any shape, as a float array without NaN or infinity."""
    masked = isinstance(value, np.ma.MaskedArray)
    try:
        array = np.asarray(None if masked else value)
    except Exception:  # ragged, too large, or a foreign object that raises what it likes
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise ParameterError(f"{name} must be a number or an array of numbers, got {shown(value)}")
    if array.size > RANGES["array size"].high:
        raise ParameterError(f"{name} must have at most {RANGES['array size'].high:.0f} entries, got {array.size}")
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused
        result = array.astype(np.float64)
    if not np.isfinite(result).all():
        raise ParameterError(f"{name} must be finite, got {result[~np.isfinite(result)].flat[0]}")
    return result


def single_precision(name: str, value: Any, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """``value`` as a finite float32 array of ``shape`` that compiled code can take: in one piece, aligned, writeable.

    An array that is all this already is returned as it is.
    """
    array: npt.NDArray[np.float32] = value
    if type(array) is not np.ndarray or array.dtype != np.float32 or not array.flags.carray:
        masked = isinstance(value, np.ma.MaskedArray)
        try:
            array = np.asarray(None if masked else value)
        except Exception:  # ragged, or a foreign object that raises what it likes
            array = np.asarray(None)
        if array.dtype.kind not in "iuf":
            raise ParameterError(f"{name} must be finite numbers of the shape {shape}, got {shown(value)}")
        with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused
            array = np.require(array, np.float32, ["C", "A", "W"])
    if array.shape != shape:
        raise ParameterError(f"{name} must have the shape {shape}, got {array.shape}")
    return array
