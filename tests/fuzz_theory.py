"""Random calls of `analysis`, for `test_fuzz`: each yields what it is about to give."""

import numpy as np
from fuzz_values import TASK, a_noise, a_number, a_range, a_road, a_seed, an_array, chosen, finite, junk, quick_task

import analysis
import roadgym
from analysis import explorer
from analysis.certification import autocovariance
from analysis.paper import figures as paper_figures
from roadgym import MEAN_SQUARES, HarmonicRoad
from roadgym.roads import make_road
from roadgym.speed import make_speed_noise

CLOSED = {"damping": an_array, "speed": an_array, "natural_frequency": a_number}


def call_mean_squares(rng):
    parameters = chosen(rng, {**CLOSED, "bandwidth": an_array, "relative_error": a_number}, {"damping": 0.3, "speed": 1.0})
    road, noise = a_road(rng), a_noise(rng)
    yield {"road": road, "speed_noise": noise, **parameters}
    if is_driven(road, noise):
        return
    squares = analysis.mean_squares(road, noise, **parameters)
    for name in MEAN_SQUARES:
        finite(getattr(squares, name), infinite=True)
        assert np.all(getattr(squares, name) >= 0)


def is_driven(road, noise):
    """Simulation, which takes seconds; and a road whose variance does."""
    the_road = make_road(road)
    if isinstance(the_road, roadgym.MultiplicativeRoad) and not the_road.is_circle:
        return True
    return make_speed_noise(noise, the_road) is not None and not isinstance(the_road, HarmonicRoad)


def call_optimal_damping(rng):
    generators = {"speed": an_array, "natural_frequency": a_number, "bounds": a_range, "bandwidth": an_array}
    parameters = chosen(rng, {**generators, "weights": TASK["reward"]}, {"speed": 1.0})
    road, noise = a_road(rng), a_noise(rng)
    yield {"road": road, "speed_noise": noise, **parameters}
    if is_driven(road, noise):
        return
    best = analysis.optimal_damping(road, noise, **parameters)
    finite(best.damping)
    finite(best.cost)


def call_lower_bound(rng):
    plant = {name: TASK[name] for name in ("speed", "bandwidth", "damping_range", "reward", "control_interval")}
    parameters = chosen(rng, plant, {"road": a_road(rng), "speed_noise": a_noise(rng), "speed": 1.0})
    yield parameters
    task = quick_task(parameters)
    generators = {"speed": a_number, "bandwidth": a_number, "seed": a_seed, "threads": a_number}
    arguments = chosen(rng, {**generators, "method": junk, "task": junk}, {"task": task, "method": "matrix_inequality"})
    yield {**parameters, **arguments}
    if task is not None:
        bound = analysis.lower_bound(**arguments)
        finite(bound.cost)
        assert bound.cost >= 0


def call_covariance(rng):
    parameters = chosen(rng, CLOSED, {"damping": 0.3, "speed": 1.0})
    road = a_road(rng)
    yield {"road": road, **parameters}
    if not is_driven(road, None):
        finite(analysis.covariance(road, **parameters))


def call_density(rng):
    road = a_road(rng)
    level, slope = an_array(rng), an_array(rng)
    yield {"road": road, "level": level, "slope": slope}
    finite(analysis.density(road, level, slope), infinite=True)
    finite(analysis.marginal_density(road, level), infinite=True)


def call_spectrum(rng):
    road, frequency, speed = a_road(rng), an_array(rng), an_array(rng)
    yield {"road": road, "frequency": frequency, "speed": speed}
    if not is_driven(road, None):
        finite(analysis.spectral_density(road, frequency, speed=speed))


def call_rotating_frame(rng):
    generators = {**CLOSED, "wavenumber": a_number, "amplitude": a_number}
    generators["form"] = lambda rng: ("exact", "closure", "printed", junk(rng))[rng.integers(4)]
    parameters = chosen(rng, generators, {"damping": 0.3, "speed": 1.0})
    noise = a_noise(rng)
    yield {"speed_noise": noise, **parameters}
    finite(analysis.mean_amplitude(noise, **parameters))
    if parameters.get("form") not in (None, "exact"):
        finite(analysis.moment_system(noise, **parameters).matrix)


def call_stability(rng):
    damping, number, speed = an_array(rng), an_array(rng), an_array(rng)
    choice = {
        "sense": ("mean", "almost_sure", junk(rng))[rng.integers(3)],
        "form": ("ito", "printed", junk(rng))[rng.integers(3)],
    }
    yield {"damping": damping, "intensity": number, "speed": speed, **choice}
    finite(analysis.rotation_numbers(damping, speed=speed))
    finite(analysis.lyapunov_exponents(damping, intensity=number, **choice))
    finite(analysis.critical_noise(damping, **choice), infinite=True)


def call_simulation(rng):
    generators = {
        **{"damping": a_number, "natural_frequency": a_number, "samples": a_number, "time_step": a_number, "lanes": a_number},
        **{"seed": a_seed, "threads": a_number, "bias": lambda rng: bool(rng.integers(2))},
        "histogram": lambda rng: (-1.0, 1.0, 10) if rng.integers(2) else junk(rng),
        "form": lambda rng: ("original", "ito", "printed", junk(rng))[rng.integers(4)],
    }
    road, noise, speed = a_road(rng), a_noise(rng), an_array(rng)
    parameters = chosen(rng, generators, {"damping": 0.3, "samples": 2048, "threads": 1})
    yield {"road": road, "speed_noise": noise, "speed": speed, **parameters}
    work = [parameters.get(name, 1) for name in ("samples", "lanes", "threads")]
    if any(isinstance(number, (int, np.integer)) and number > 5000 for number in work):
        return
    if is_long(road, noise, speed, parameters):
        return
    for result in analysis.simulate(road, noise, speed=speed, **parameters):
        finite(result.amplitude.value)
        finite(result.mean_squares["displacement"].value)


def is_long(road, noise, speed, parameters):
    """Does a simulation that is allowed take long, because it remembers long how it started?"""
    from analysis.driven import SETTLED
    from analysis.paper.euler_maruyama import make_system

    try:
        the_road = make_road(road)
        the_noise, w1 = make_speed_noise(noise, the_road), float(parameters.get("natural_frequency", 1.0))
        damping, form = float(parameters["damping"]), parameters.get("form", "original")
        step = float(parameters.get("time_step", 1e-3))
        speeds = np.asarray(speed, float).reshape(-1)
        systems = [make_system(the_road, the_noise, damping, v, w1, form) for v in speeds]
        return sum(SETTLED * system.memory / step for system in systems) > 1e5
    except Exception:  # what is wrong is for the call to say
        return False


def call_feedback_arguments(rng):
    """Parameters of the optimal feedback that are refused; what is not takes seconds."""
    generators = {
        **{
            "speed": a_number,
            "bandwidth": a_number,
            "natural_frequency": a_number,
            "weights": TASK["reward"],
            "bounds": a_range,
        },
        **{"control_interval": a_number, "tolerance": a_number, "precision": a_number, "refinements": a_number, "seed": a_seed},
        **{"threads": a_number},
    }
    parameters = chosen(rng, generators, {"speed": 1.0})
    road = a_road(rng)
    parameters["cache"] = 3  # refused at the end of the checks
    yield {"road": road, **parameters}
    if not is_driven(road, None):
        analysis.optimal_feedback(road, **parameters)


def call_explorer(rng):
    view = {str(name): a_number(rng) for name in rng.choice([*explorer.RANGES, "road", "speed_noise", "weights", "x"], 2)}
    view = view if rng.integers(4) else junk(rng)
    yield {"view": view}
    explorer.make_view(view)


def call_figures(rng):
    numbers = junk(rng) if rng.integers(2) else [junk(rng)]
    folder = 3 if rng.integers(2) else None  # no folder: nothing is ever drawn
    yield {"numbers": numbers, "folder": folder}
    paper_figures.write(folder, numbers)


def call_autocovariance(rng):
    lag = an_array(rng)
    yield {"lag": lag}
    finite(autocovariance(HarmonicRoad(), None, lag, speed=1.0))


def call_certify_arguments(rng):
    generators = {"speed": a_number, "damping": a_number, "natural_frequency": a_number, "seed": a_seed}
    road, noise = a_road(rng), a_noise(rng)
    parameters = chosen(rng, generators)
    parameters["lanes"] = 7  # refused at the end of the checks
    yield {"road": road, "speed_noise": noise, **parameters}
    analysis.certify(road, noise, **parameters)
