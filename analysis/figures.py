"""The former place of `analysis.paper.figures`."""
# ruff: noqa: F403

import warnings

from .paper.drawing import *
from .paper.figures import *
from .paper.stability_figures import *

warnings.warn("analysis.figures is now analysis.paper.figures", DeprecationWarning, stacklevel=2)
