"""Road models. To add one: write a file like its neighbours and a line in `ROADS`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..component import Registry
from . import iso8608
from .alone import sample_road
from .base import Road
from .first_order import FirstOrderRoad
from .gaussian import GaussianRoad
from .harmonic import HarmonicRoad
from .linear import LinearRoad
from .multiplicative import MultiplicativeRoad
from .power_law import PowerLawRoad
from .profile import ProfileRoad
from .profile_files import Profile, read_profile
from .two_corner import TwoCornerRoad

__all__ = [
    "ROADS",
    "FirstOrderRoad",
    "GaussianRoad",
    "HarmonicRoad",
    "LinearRoad",
    "MultiplicativeRoad",
    "PowerLawRoad",
    "Profile",
    "ProfileRoad",
    "Road",
    "TwoCornerRoad",
    "make_road",
    "read_profile",
    "sample_road",
]

ROADS: Registry[Road] = Registry(
    "road",
    Road,
    {
        "harmonic": HarmonicRoad,
        "first_order": FirstOrderRoad,
        "gaussian": GaussianRoad,
        "multiplicative": MultiplicativeRoad,
        "two_corner": TwoCornerRoad,
        "power_law": PowerLawRoad,
        "profile": ProfileRoad,
    },
    presets={f"iso_{name.lower()}": {"kind": "first_order", "iso_class": name} for name in iso8608.MEANS},
    of_file="profile",
)


def make_road(road: str | Mapping[str, Any] | Road) -> Road:
    """A road from its name, that of a file with a profile, a mapping with the key "kind" and its parameters, or as it is.

    Raises:
        ParameterError: unknown kind or parameter, or a value out of range.
    """
    return ROADS.make(road)
