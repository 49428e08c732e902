"""Every plant, for parametrised tests: from the tables of components, so that a new one is tested at once."""

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


def plant_name(plant):
    return plant["road"] + (f"+{plant['speed_noise']}" if plant["speed_noise"] else "")
