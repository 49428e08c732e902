"""The former place of `analysis.paper.rotating_frame`."""
# ruff: noqa: F403

import warnings

from .paper.rotating_frame import *

warnings.warn("analysis.rotating_frame is now analysis.paper.rotating_frame", DeprecationWarning, stacklevel=2)
