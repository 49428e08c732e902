"""What theory says of the plant: densities and spectra of the roads, mean squares and mean amplitudes of the car at constant
damping, its stability, and the best constant damping; and simulation at the paper's scale, as theory's witness.

After W. V. Wedig, "Applied in Non-Linear Vehicle Road Dynamics", ENOC 2020, cited as Wedig (2020). Where its print and its
derivation disagree, results follow the derivation, and form="printed" gives the print: `analysis.paper` has what is the paper's
own, its figures and its errata among them.

Damping, speed and bandwidth may be arrays; results have their common shape, and are NumPy scalars for numbers.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .bounds import LowerBound, lower_bound
from .certificate import Certificate
from .certification import certify
from .comfort import comfort_reaction, frequency_weighting
from .feedback import Feedback, OptimalFeedback, Refinement, WhiteRoadFeedback, optimal_feedback
from .identification import Identified, identify
from .optimum import Optimum, optimal_damping
from .paper.euler_maruyama import Estimate, Simulation, simulate
from .paper.exponents import Stability, simulate_stability
from .paper.rotating_frame import MomentSystem, mean_amplitude, moment_system
from .paper.stability import critical_noise, lyapunov_exponents, rotation_numbers
from .profile_certificate import ProfileCertificate, certify_profile
from .response import MeanSquares, covariance, mean_squares
from .roads import density, marginal_density, spectral_density
from .roughness import RoughnessFit, expected_iri, fit_iso8608, international_roughness_index
from .spectra import ProfileSpectrum, profile_spectrum

__all__ = [
    "Certificate",
    "Estimate",
    "Feedback",
    "Identified",
    "LowerBound",
    "MeanSquares",
    "MomentSystem",
    "OptimalFeedback",
    "Optimum",
    "ProfileCertificate",
    "ProfileSpectrum",
    "Refinement",
    "RoughnessFit",
    "Simulation",
    "Stability",
    "WhiteRoadFeedback",
    "certify",
    "certify_profile",
    "comfort_reaction",
    "covariance",
    "critical_noise",
    "density",
    "expected_iri",
    "fit_iso8608",
    "frequency_weighting",
    "identify",
    "international_roughness_index",
    "lower_bound",
    "lyapunov_exponents",
    "marginal_density",
    "mean_amplitude",
    "mean_squares",
    "moment_system",
    "optimal_damping",
    "optimal_feedback",
    "profile_spectrum",
    "rotation_numbers",
    "simulate",
    "simulate_stability",
    "spectral_density",
]

__distribution__ = "roadgym"  # by which roadgym tells this package from others of its name

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Modules at their former places, which warn, and which importing this package used to bring along."""
        if name in ("rotating_frame", "simulation", "stability"):
            return importlib.import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
