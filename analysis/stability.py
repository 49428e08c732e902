"""The former place of `analysis.paper.stability`."""
# ruff: noqa: F403

import warnings

from .paper.stability import *

warnings.warn("analysis.stability is now analysis.paper.stability", DeprecationWarning, stacklevel=2)
