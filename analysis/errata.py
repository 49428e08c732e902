"""The former place of `analysis.paper.errata`."""
# ruff: noqa: F403

import warnings

from .paper.amplitude_errata import *
from .paper.check import *
from .paper.errata import *
from .paper.road_errata import *

warnings.warn("analysis.errata is now analysis.paper.errata", DeprecationWarning, stacklevel=2)
