"""The former place of `analysis.driven`, `analysis.paper.euler_maruyama` and `analysis.paper.exponents`."""
# ruff: noqa: F403

import warnings

from .driven import *
from .paper.euler_maruyama import *
from .paper.exponents import *
from .paper.steps import *

warnings.warn(
    "analysis.simulation is now analysis.driven, analysis.paper.euler_maruyama and analysis.paper.exponents",
    DeprecationWarning,
    stacklevel=2,
)
