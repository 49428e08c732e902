"""Mean amplitudes in the rotating frame; (20)-(36) of Wedig (2020).

On the road Z = mu cos phi, with noise on the speed (see `roadgym.speed`), the motion is split into amplitudes,

    Y = A cos phi + B sin phi,   X = Y'/w1 = G cos phi + H sin phi,   V = (A, B, G, H),   C = A - i B,

whose means are stationary. E C is the car's transfer function averaged over the line spectrum of exp(i phi), which is known
exactly (see `analysis.phase_noise`). The paper derives moment equations instead and, where the filtered noise Psi multiplies V,
closes them by E(Psi^2 V) = E(Psi^2) E(V).

With white noise in dphi Ito's product rule adds covariations, which the printed (20)-(24) and (33), (34) leave out: the noise
enters the drift of V as -sigma^2/2 and the forcing of G as mu (w1 + D sigma^2), where the paper has +sigma^2/2 and
mu (w1 - D sigma^2). (35), (36) are right with A and x corrected. Low-pass noise is smooth, and (26)-(29) are printed right.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.parameters import ParameterError, within
from roadgym.roads import HarmonicRoad
from roadgym.speed import SpeedNoise, make_speed_noise

from ..checks import ComplexArray, FloatArray, broadcast, one_of, range_array
from ..phase_noise import mean_transfer
from ..response import checked_speed

FORMS = ("exact", "closure", "printed")
ROTATION = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 1.0, 0.0]])  # B of (26)
SLOPE_FORCING = np.array([0.0, 0.0, 0.0, 1.0])  # y of (26)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MomentSystem:
    """Linear equations dm/dt = matrix m + forcing of moments m: E V, or E V followed by E(Psi V) under filtered noise.

    Args:
        matrix: shape (..., 4, 4) or (..., 8, 8); rad/s, and per rad or times rad where Psi enters.
        forcing: shape (..., 4) or (..., 8); m/s, times rad where Psi enters.
    """

    matrix: FloatArray
    forcing: FloatArray

    def stationary(self) -> FloatArray:
        """The moments at rest, m, shape (..., 4) or (..., 8): formal ones where the system is unstable."""
        try:
            moments = np.linalg.solve(self.matrix, -self.forcing[..., np.newaxis])
        except np.linalg.LinAlgError:
            raise ParameterError("damping, speed and intensity must not make the moment equations singular") from None
        return np.asarray(moments[..., 0], dtype=np.float64)


def moment_system(
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None,
    *,
    damping: npt.ArrayLike,
    speed: npt.ArrayLike,
    wavenumber: float = 1.0,
    natural_frequency: float = 1.0,
    amplitude: float = 1.0,
    form: str = "closure",
) -> MomentSystem:
    """Moment equations of the amplitudes under white (24), low-pass (28), (29) and high-pass noise (35), (36); Wedig (2020).

    Without noise and with white noise they are exact; with filtered noise the Gaussian closure (28b), (35b) makes them finite.

    Args:
        speed_noise: noise on the phase, or its name or mapping, or None.
        damping: D > 0, 1, any shape.
        speed: v >= 0, m/s, any shape that broadcasts.
        wavenumber: of the road, rad/m.
        natural_frequency: w1, rad/s.
        amplitude: mu of the road, m.
        form: "closure", with the right signs of Ito's calculus, or "printed".
    """
    road, noise, w1 = _plant(speed_noise, wavenumber, natural_frequency, amplitude)
    wavenumber, amplitude = road.wavenumber, road.amplitude
    damping, speed = broadcast(
        damping=range_array("damping", damping, "constant damping"), speed=checked_speed(speed, road, w1)
    )
    sign = {"closure": -1.0, "printed": 1.0}[one_of("form", form, FORMS[1:])]
    strength = 0.0 if noise is None else noise.intensity**2 / 2  # w_g E Psi^2, where a filter makes Psi
    corner, back, share = (0.0, 0.0, 0.0) if noise is None else noise.rates
    white = share * strength
    turn = wavenumber * speed

    matrix = turn[..., np.newaxis, np.newaxis] * ROTATION
    for i in range(4):
        matrix[..., i, i] = sign * white - (2 * damping * w1 if i >= 2 else 0.0)
    matrix[..., 0, 2] = matrix[..., 1, 3] = w1
    matrix[..., 2, 0] = matrix[..., 3, 1] = -w1
    forcing = np.zeros((*turn.shape, 4))
    forcing[..., 2] = amplitude * (w1 - sign * 2 * damping * white)
    forcing[..., 3] = -amplitude * 2 * damping * turn
    if corner == 0:
        return MomentSystem(matrix=matrix, forcing=forcing)

    full = np.zeros((*turn.shape, 8, 8))
    full[..., :4, :4] = matrix
    full[..., :4, 4:] = back * ROTATION
    full[..., 4:, :4] = strength * ROTATION
    full[..., 4:, 4:] = matrix - corner * np.eye(4)
    coupled = -2 * amplitude * strength * damping[..., np.newaxis] * SLOPE_FORCING
    return MomentSystem(matrix=full, forcing=np.concatenate([forcing, coupled], axis=-1))


def mean_amplitude(
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None,
    *,
    damping: npt.ArrayLike,
    speed: npt.ArrayLike,
    wavenumber: float = 1.0,
    natural_frequency: float = 1.0,
    amplitude: float = 1.0,
    form: str = "exact",
) -> ComplexArray:
    """Stationary mean amplitude E C = E A - i E B of the car on the harmonic road.

    Its modulus is the paper's V_m (Figs. 8-10), and E C = 2 E(Y exp(-i phi)).

    Args:
        speed_noise: noise on the phase, or its name or mapping, or None.
        damping: D > 0, 1, any shape.
        speed: v >= 0, m/s, any shape that broadcasts.
        wavenumber: of the road, rad/m.
        natural_frequency: w1, rad/s.
        amplitude: mu of the road, m.
        form: "exact"; "closure", the Gaussian closure, exact but for filtered noise; or "printed", as the paper prints it,
            formal where its means are unstable. See `moment_system` for the last two.

    Returns:
        E C, m, in the common shape.
    """
    road, noise, w1 = _plant(speed_noise, wavenumber, natural_frequency, amplitude)
    if one_of("form", form, FORMS) != "exact":
        means = moment_system(
            noise,
            damping=damping,
            speed=speed,
            wavenumber=wavenumber,
            natural_frequency=natural_frequency,
            amplitude=amplitude,
            form=form,
        ).stationary()
        return (means[..., 0] - 1j * means[..., 1])[()]
    damping, speed = broadcast(
        damping=range_array("damping", damping, "constant damping"), speed=checked_speed(speed, road, w1)
    )
    return (road.amplitude * mean_transfer(noise, damping, speed * (road.wavenumber / w1), w1))[()]


def _plant(
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None, wavenumber: float, natural_frequency: float, amplitude: float
) -> tuple[HarmonicRoad, SpeedNoise | None, float]:
    """Road, noise and w1, checked."""
    road = HarmonicRoad(amplitude=amplitude, wavenumber=wavenumber)
    noise, w1 = make_speed_noise(speed_noise, road), within("natural_frequency", natural_frequency)
    if noise is not None:
        noise.check_range(w1, driven=False)
    return road, noise, w1
