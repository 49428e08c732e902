"""What theory says of the plant: densities and spectra of the roads, mean squares and mean amplitudes of the car at constant
damping, its stability, and the best constant damping; and simulation at the paper's scale, as theory's witness.

After W. V. Wedig, "Applied in Non-Linear Vehicle Road Dynamics", ENOC 2020, cited as Wedig (2020). Where its print and its
derivation disagree, results follow the derivation, and form="printed" gives the print.

Damping, speed and bandwidth may be arrays; results have their common shape, and are NumPy scalars for numbers.
"""

from __future__ import annotations

from .certification import Certificate, certify
from .feedback import OptimalFeedback, Refinement, optimal_feedback
from .optimum import Optimum, optimal_damping
from .response import MeanSquares, covariance, mean_squares
from .roads import density, marginal_density, spectral_density
from .rotating_frame import MomentSystem, mean_amplitude, moment_system
from .simulation import Estimate, Simulation, Stability, simulate, simulate_stability
from .stability import critical_noise, lyapunov_exponents, rotation_numbers

__all__ = [
    "Certificate",
    "Estimate",
    "MeanSquares",
    "MomentSystem",
    "OptimalFeedback",
    "Optimum",
    "Refinement",
    "Simulation",
    "Stability",
    "certify",
    "covariance",
    "critical_noise",
    "density",
    "lyapunov_exponents",
    "marginal_density",
    "mean_amplitude",
    "mean_squares",
    "moment_system",
    "optimal_damping",
    "optimal_feedback",
    "rotation_numbers",
    "simulate",
    "simulate_stability",
    "spectral_density",
]
