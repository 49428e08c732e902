"""What vibration does to the body, after ISO 2631-1: its frequency weightings, and what people say of what is left."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadgym.comfort import WEIGHTINGS, check_weighting
from roadgym.parameters import ParameterError, non_negative, number_array, shown

REACTIONS = {  # from which weighted root mean square, m/s^2, and below which; neighbours overlap
    "not uncomfortable": (0.0, 0.315),
    "a little uncomfortable": (0.315, 0.63),
    "fairly uncomfortable": (0.5, 1.0),
    "uncomfortable": (0.8, 1.6),
    "very uncomfortable": (1.25, 2.5),
    "extremely uncomfortable": (2.0, np.inf),
}


def frequency_weighting(frequency: npt.ArrayLike, weighting: str = "Wk") -> npt.NDArray[np.complex128]:
    """The complex gain W(2 pi i f) of a frequency weighting; its absolute value is what the tables of ISO 2631-1 have.

    Those print |W| at the nominal frequencies of one-third octave bands, such as 3.15 Hz, not at the exact 10^(k/10) Hz.

    Args:
        frequency: f >= 0, Hz, any shape.
        weighting: "Wk", of vertical acceleration.

    Returns:
        The gain, 1, in the shape of ``frequency``.

    Raises:
        ParameterError: a negative frequency, or an unknown weighting.
    """
    f = number_array("frequency", frequency)
    if np.any(f < 0):
        raise ParameterError(f"frequency must be at least 0, got {shown(frequency)}")
    check_weighting(weighting)
    return np.asarray(WEIGHTINGS[weighting].gain(2j * np.pi * f))[()]


def comfort_reaction(rms: float) -> tuple[str, ...]:
    """How passengers of public transport call a weighted acceleration, by ISO 2631-1:1997, C.2.3: one or two neighbours.

    Args:
        rms: root mean square of the weighted acceleration, m/s^2: that of all axes, or of the vertical one alone.

    Raises:
        ParameterError: a negative number.
    """
    value = non_negative("rms", rms)
    return tuple(words for words, (low, high) in REACTIONS.items() if low <= value < high)
