"""The suite: tasks with frozen parameters, each a Gymnasium id, whose scores anybody can compare.

Every parameter that a default could change is written out, so a task is the same in every release; a change of numbers is a new
version of the task, never a new meaning of the old one. How entries are scored is in `agents.suite`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

NAMESPACE = "roadgym/"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuiteTask:
    """A task of the suite.

    Attributes:
        name: its Gymnasium id without the namespace, such as "Paper-v0".
        title: what it asks for, in a line.
        description: what drives on what and what is hard about it, in a paragraph.
        parameters: all those of `roadgym.task.make_task` that make a difference.
        speeds, bandwidths: the grid of operating points at which it is scored, m/s and 1; no bandwidths on a road without one.
        duration: measured time of an episode at which it is scored, s.
        single_constant: is the score's zero one constant damping at all these points? Else it is the best one at each.
        versions: by version what is new in it.
        max_episode_steps: control intervals in an episode.
    """

    name: str
    title: str
    description: str
    parameters: Mapping[str, Any]
    speeds: tuple[float, ...]
    bandwidths: tuple[float, ...] = ()
    duration: float
    single_constant: bool = False
    versions: Mapping[str, str]
    max_episode_steps: int = 500

    @property
    def id(self) -> str:
        """What `gymnasium.make` and `gymnasium.make_vec` take."""
        return NAMESPACE + self.name


FIRST = {"v0": "The first version."}
POINT = ("speed", "bandwidth")
WHOLE_STATE = ("displacement", "velocity", "level", "slope")
BOUNDED = {"kind": "multiplicative", "wavenumber": 1.0, "bandwidth": 0.1, "shape": 2.0, "level_bound": 1.0}
GAUSSIAN = {"kind": "gaussian", "wavenumber": 1.0, "bandwidth": 0.1, "noise_intensity": 0.2}
ONE_MASS: Mapping[str, Any] = {  # the paper's car and range of dampings, in its units
    "car": {"kind": "one_mass", "natural_frequency": 1.0},
    "damping_range": (0.05, 1.0),
    "speed": (0.5, 3.2),
    "reward": {"displacement": 1.0},
    "observe_operating_point": False,
    "control_interval": 0.2,
    "substeps": 7,
    "warm_up": 0.0,
    "precision": "float32",
}
SPEEDS, BANDWIDTHS = (0.7, 1.0, 1.5, 2.0, 3.0), (0.1, 0.3)

# class C of ISO 8608, 64e-6 m^3 at 0.1 cycles/m, as a first-order road with its corner at 0.01 cycles/m
CLASS_C = {"kind": "first_order", "wavenumber": 0.06283185307179587, "noise_intensity": 0.007108612701053387}
TWO_MASSES: Mapping[str, Any] = {
    "road": CLASS_C,
    "car": {
        "kind": "two_mass",
        "sprung_mass": 240.0,
        "unsprung_mass": 36.0,
        "spring_rate": 16e3,
        "tyre_rate": 160e3,
        "tyre_damping": 0.0,
        "damping_coefficients": (300.0, 4000.0),
    },
    "damping_range": (0.07654655446197431, 1.0206207261596576),
    "speed": (15.0, 25.0),
    "reward": {"acceleration": 1.0},
    "observation": ("displacement", "wheel_displacement", "velocity", "wheel_velocity", "level", "speed"),
    "observe_operating_point": False,
    "control_interval": 0.005,
    "substeps": 4,
    "warm_up": 0.0,
    "precision": "float32",
}
HEAVIER: Mapping[str, Any] = {
    **TWO_MASSES,
    "car": {
        "kind": "two_mass",
        "sprung_mass": 400.0,
        "unsprung_mass": 50.0,
        "spring_rate": 30e3,
        "tyre_rate": 250e3,
        "tyre_damping": 0.0,
        "damping_coefficients": (300.0, 3900.0),
    },
    "damping_range": (0.04330127018922193, 0.5629165124598852),
    "reward": {"acceleration": 1.0, "tyre_deflection": 28125.0},  # five times the natural frequency to the fourth
    "precision": "float64",
}

TASKS: Mapping[str, SuiteTask] = {
    task.name: task
    for task in (
        SuiteTask(
            name="Paper-v0",
            title="Keep the body still on a bounded road, at any speed and bandwidth",
            description="The plant of Wedig (2020): one mass on the bounded road, whose state, speed and bandwidth are all "
            "seen. The optimum is known at every operating point, and certified from below. The best damping switches, on a "
            "surface that moves with the operating point.",
            parameters={**ONE_MASS, "road": BOUNDED, "bandwidth": (0.05, 0.5), "observation": (*WHOLE_STATE, *POINT)},
            speeds=SPEEDS,
            bandwidths=BANDWIDTHS,
            duration=100.0,
            versions=FIRST,
        ),
        SuiteTask(
            name="SpeedNoise-v0",
            title="Keep the body still on a wave that is driven over at a random speed",
            description="One mass on a harmonic road; nothing but the speed is random, white noise around a mean that is seen. "
            "The road does not forget, and no optimal feedback is known: the best known one was learned.",
            parameters={
                **ONE_MASS,
                "road": {"kind": "harmonic", "wavenumber": 1.0, "amplitude": 1.0},
                "speed_noise": {"kind": "white", "intensity": 0.2},
                "observation": (*WHOLE_STATE, "speed"),
                "precision": "float64",
            },
            speeds=SPEEDS,
            duration=100.0,
            versions=FIRST,
        ),
        SuiteTask(
            name="Schedule-v0",
            title="Set the best constant damping for each speed and bandwidth, seeing nothing else",
            description="A bandit: each step drives fifty time units with one damping, and pays the mean squares of "
            "acceleration and travel, with their noise. What is best is known at every operating point by theory, and falls "
            "steeply at small bandwidths. The score's zero is the one damping that costs least over all its operating points.",
            parameters={
                **ONE_MASS,
                "road": BOUNDED,
                "bandwidth": (0.05, 0.5),
                "reward": {"acceleration": 1.0, "travel": 0.5},
                "observation": POINT,
                "control_interval": 50.0,
                "substeps": 1600,
            },
            speeds=(0.7, 1.0, 2.0, 3.0),  # at 1.5 the one damping is the best one
            bandwidths=BANDWIDTHS,
            duration=300.0,
            single_constant=True,
            versions=FIRST,
        ),
        SuiteTask(
            name="Comfort-v0",
            title="Spare the passengers of a car with a wheel, on a road of class C",
            description="A body of 240 kg and a wheel of 36 kg in SI units, on class C of ISO 8608 at 54 to 90 km/h; every 5 "
            "ms the damper is set, and the mean square of the body's acceleration is paid. The wheel hops at 10 Hz, the body "
            "swings at 1.3 Hz: 150 steps a swing.",
            parameters=TWO_MASSES,
            speeds=(15.0, 25.0),
            duration=10.0,
            versions=FIRST,
        ),
        SuiteTask(
            name="RoadHolding-v0",
            title="Comfort, with the wheels kept on the road",
            description="A body of 400 kg and a wheel of 50 kg on class C of ISO 8608; acceleration and the deflection of the "
            "tyre, which is the wheel's load, are paid together. Comfort asks for a soft damper, grip for a firm one.",
            parameters=HEAVIER,
            speeds=(15.0, 25.0),
            duration=10.0,
            versions=FIRST,
        ),
        SuiteTask(
            name="OneAccelerometer-v0",
            title="Keep the body still with one noisy accelerometer on it",
            description="One mass on the Gaussian road; the body's acceleration is seen, with a noise of 0.05 standard "
            "deviations of the road, and the operating point. The state of car and road must be tracked over many periods; a "
            "Kalman filter tells its law exactly.",
            parameters={
                **ONE_MASS,
                "road": GAUSSIAN,
                "bandwidth": (0.05, 0.5),
                "observation": ("acceleration", *POINT),
                "sensors": {"noise": {"acceleration": 0.05}},
            },
            speeds=SPEEDS,
            bandwidths=BANDWIDTHS,
            duration=100.0,
            versions=FIRST,
        ),
        SuiteTask(
            name="SlowValve-v0",
            title="Comfort and grip behind a valve that is late and slow",
            description="The plant and the reward of RoadHolding-v0, whose damper does what it was told 5 ms later, with a lag "
            "of 15 ms up and 14 ms down. A tenth of the wheel's period is lost; what is in force is not seen.",
            parameters={
                **HEAVIER,
                "substeps": 13,
                "valve": {"delay": 0.005, "rise_time": 0.015, "fall_time": 0.014},
            },
            speeds=(15.0, 25.0),
            duration=10.0,
            versions=FIRST,
        ),
        SuiteTask(
            name="AnyCar-v0",
            title="Comfort in a car that nobody described",
            description="In each episode another car: its body differs by up to 25 %, spring and tyre by up to 20 %, and the "
            "valve lags by up to 30 ms, up and down each by itself. Nobody is told what was drawn; observations and actions "
            "are those of the nominal car.",
            parameters={
                **TWO_MASSES,
                "speed": (20.0, 20.0),
                "control_interval": 0.01,
                "substeps": 26,
                "precision": "float64",
                "vary": {
                    "sprung_mass": (180.0, 300.0),
                    "spring_rate": (12.8e3, 19.2e3),
                    "tyre_rate": (128e3, 192e3),
                    "valve.rise_time": (0.0, 0.03),
                    "valve.fall_time": (0.0, 0.03),
                },
            },
            speeds=(20.0,),
            duration=10.0,
            versions=FIRST,
        ),
        SuiteTask(
            name="Explore-v0",
            title="Find out where and how fast you drive, by one coarse sensor of the travel",
            description="One mass on the Gaussian road; the suspension's travel is seen in steps of half a standard deviation "
            "of the road, and nothing else: speed, bandwidth and state are hidden. A firm damper holds the travel below what "
            "the sensor resolves, a soft one lets it speak: what is known depends on what is done, and no filter with a fixed "
            "rule sets the damping for the sake of knowing.",
            parameters={
                **ONE_MASS,
                "road": GAUSSIAN,
                "bandwidth": (0.05, 0.5),
                "observation": ("travel",),
                "sensors": {"noise": {"travel": 0.05}, "resolution": {"travel": 0.5}},
            },
            speeds=(1.5, 2.0),
            bandwidths=BANDWIDTHS,
            duration=100.0,
            versions=FIRST,
        ),
    )
}
