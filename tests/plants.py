"""Every plant, for parametrised tests: from the tables of components, so that a new one is tested at once."""

import math

from roadgym import ROADS, SPEED_NOISES, ParameterError
from roadgym.task import make_task

PLANTS = []
for _road in ROADS:
    for _noise in (None, *SPEED_NOISES):
        try:
            make_task(road=_road, speed_noise=_noise)
        except ParameterError:
            continue
        PLANTS.append({"road": _road, "speed_noise": _noise})


# the variants of the bounded road that have schemes of their own
ELLIPSE = {"kind": "multiplicative", "bandwidth": 0.3, "noise_intensity": 0.4, "level_bound": 1.0, "slope_bound": 0.7}
PROFILE = {"kind": "profile", "heights": [0.1 * math.sin(0.7 * k * k) for k in range(60)], "spacing": 0.5}
SMALL_SHAPE = {"kind": "multiplicative", "bandwidth": 0.3, "noise_intensity": 1.5, "level_bound": 1.0}
EVERY_PLANT = [
    *PLANTS,
    *({"road": road, "speed_noise": None} for road in (ELLIPSE, SMALL_SHAPE, PROFILE)),
    {"road": PROFILE, "speed_noise": "low_pass"},
]

# by kind what makes it: its name, or the parameters of one without defaults
EVERY_ROAD = {kind: PROFILE if kind == "profile" else kind for kind in ROADS}


def plant_name(plant):
    road = plant["road"]
    if not isinstance(road, str):
        road = "profile" if road is PROFILE else "ellipse" if "slope_bound" in road else "small shape"
    return road + (f"+{plant['speed_noise']}" if plant["speed_noise"] else "")
