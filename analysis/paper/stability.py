"""Lyapunov exponents, rotation numbers and critical noise of the amplitudes in the rotating frame; (37)-(45) of Wedig (2020).

The phase has white noise of intensity sigma, dphi = wavenumber v dt + sigma dW, and Y = A cos phi + B sin phi. Unforced, the
amplitudes are the car's free motion seen from a rotating frame, so their length decays as it does, whatever the noise. The
printed drift lacks the covariations d[A, cos phi] and d[B, sin phi] of Ito's calculus; form="printed" is what follows from it:

    sense           form="ito"              form="printed"
    almost_sure     exponents of the car    the same + sigma^2
    mean            the same - sigma^2/2    the same + sigma^2/2

Exponents of the car are -D w1, twice, for D <= 1 and -w1 (D -+ sqrt(D^2 - 1)) beyond; in the frame each is double again.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadgym.parameters import within

from ..checks import FloatArray, broadcast, one_of, range_array
from ..phase_noise import slowest_decay

# sigma^2 enters the exponents with this factor, by sense and form
NOISE_FACTOR = {
    "almost_sure": {"ito": 0.0, "printed": 1.0},
    "mean": {"ito": -0.5, "printed": 0.5},
}


def lyapunov_exponents(
    damping: npt.ArrayLike,
    *,
    intensity: npt.ArrayLike = 0.0,
    natural_frequency: float = 1.0,
    sense: str = "almost_sure",
    form: str = "ito",
) -> tuple[FloatArray, FloatArray]:
    """Lyapunov exponents of the amplitudes under white speed noise; (41)-(43), and (44), (45) in mean, of Wedig (2020).

    Args:
        damping: D >= 0, 1, any shape.
        intensity: sigma >= 0 of the phase noise, rad/s^(1/2), any shape that broadcasts.
        natural_frequency: w1, rad/s.
        sense: "almost_sure", of the paths, or "mean", of the expected amplitudes.
        form: "ito", the right ones, or "printed", those of the paper.

    Returns:
        Top and second exponent, 1/s, in the common shape; equal for D <= 1.
    """
    damping, intensity = broadcast(
        damping=range_array("damping", damping, "free damping"), intensity=range_array("intensity", intensity, "free intensity")
    )
    noise = _noise_factor(sense, form) * intensity**2
    w1 = within("natural_frequency", natural_frequency)
    slow = slowest_decay(damping)
    return noise - w1 * slow, noise - w1 * (2 * damping - slow)


def rotation_numbers(
    damping: npt.ArrayLike, *, speed: npt.ArrayLike, wavenumber: float = 1.0, natural_frequency: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Mean rates of rotation of the amplitudes, wavenumber v +- w1 sqrt(1 - D^2), for any noise; (42), (43) of Wedig (2020).

    Args:
        damping: D >= 0, 1, any shape.
        speed: v >= 0, m/s, any shape that broadcasts.
        wavenumber: of the road, rad/m.
        natural_frequency: w1, rad/s.

    Returns:
        The upper and the lower one, rad/s, in the common shape; equal for D >= 1.
    """
    damping, speed = broadcast(
        damping=range_array("damping", damping, "free damping"), speed=range_array("speed", speed, "any speed")
    )
    turn = within("wavenumber", wavenumber) * speed
    own = within("natural_frequency", natural_frequency) * np.sqrt(np.maximum((1 - damping) * (1 + damping), 0.0))
    return turn + own, turn - own


def critical_noise(
    damping: npt.ArrayLike, *, natural_frequency: float = 1.0, sense: str = "almost_sure", form: str = "ito"
) -> FloatArray:
    """Noise sigma^2 beyond which the amplitudes are unstable: the stability map, Fig. 14 of Wedig (2020).

    Args:
        damping: D >= 0, 1, any shape.
        natural_frequency: w1, rad/s.
        sense: "almost_sure" or "mean".
        form: "ito" or "printed".

    Returns:
        Critical sigma^2, rad^2/s, in the shape of ``damping``; infinite where stability is never lost. In the form "ito" that
        is everywhere but at D = 0 almost surely, where the amplitudes are neutral under any noise and the answer is 0.
    """
    damping = range_array("damping", damping, "free damping")
    factor = _noise_factor(sense, form)
    w1 = within("natural_frequency", natural_frequency)
    if factor > 0:
        return w1 * slowest_decay(damping) / factor
    return np.where((damping > 0) | (factor < 0), np.inf, 0.0)[()]


def _noise_factor(sense: str, form: str) -> float:
    by_form = NOISE_FACTOR[one_of("sense", sense, NOISE_FACTOR)]
    return by_form[one_of("form", form, by_form)]
