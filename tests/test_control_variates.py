import numpy as np
import pytest
from scipy.stats import t as student

import analysis
from agents.controllers import ConstantDamping, make_controller, theoretical_cost
from agents.evaluation import evaluate, standard_error
from analysis.control_variates import adjust, control_dampings, expected_squares
from roadgym.roads import MultiplicativeRoad
from roadgym.task import make_task

ENVIRONMENT = {"road": "gaussian", "speed": (0.7, 3.0), "bandwidth": (0.1, 0.3)}


def samples(generator: np.random.Generator, count: int, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Skewed samples of mean 1.5, a curved function of what ``number`` controls see, the controls, and their means."""
    luck = generator.gamma(6.0, 1 / 6, (3, count))
    controls = np.stack([luck[0] + 0.1 * k * luck[1] + 0.03 * k * k * luck[2] for k in range(number)])
    means = np.array([1 + 0.1 * k + 0.03 * k * k for k in range(number)])
    return luck[0] + 0.3 * (luck[1] ** 2 - 1 / 6) + 0.2 * generator.gamma(6.0, 1 / 6, count), controls, means


@pytest.mark.statistical
@pytest.mark.parametrize(("count", "number"), [(16, 2), (32, 4)])
def test_interval_covers_the_truth_and_the_mean_has_no_bias(count: int, number: int) -> None:
    generator = np.random.default_rng(11)
    repetitions = 3000
    errors, plain, covered = np.empty(repetitions), np.empty(repetitions), 0
    for i in range(repetitions):
        values, controls, means = samples(generator, count, number)
        adjusted = adjust(values, controls, means)
        errors[i], plain[i] = adjusted.mean() - 1.5, values.mean() - 1.5
        half = student.ppf(0.975, count - 1 - number) * standard_error(adjusted)
        covered += bool(abs(errors[i]) < half)
    # skewed samples so few cost even a plain mean a percent or two
    assert 0.92 < covered / repetitions < 0.96
    assert abs(errors.mean()) < 4 * errors.std() / np.sqrt(repetitions)
    assert errors.var() < 0.35 * plain.var()


@pytest.mark.statistical
def test_controls_that_tell_nothing_cost_their_degrees_of_freedom_at_most() -> None:
    generator = np.random.default_rng(12)
    found = []
    for _ in range(3000):
        values = generator.gamma(6.0, 1 / 6, 32)
        found.append((adjust(values, *samples(generator, 32, 4)[1:]).mean() - 1, values.mean() - 1))
    adjusted, plain = np.var(found, axis=0)
    assert adjusted < (1 + 4 / 26) * 1.12 * plain


def test_a_bias_of_the_known_means_is_not_blown_up() -> None:
    generator = np.random.default_rng(13)
    values, luck = generator.normal(1, 0.1, (2, 256))
    # four controls that differ by a little noise only, as near dampings do, and one that has less noise than bias
    controls = np.stack([luck + 1e-5 * generator.normal(size=256) for _ in range(4)] + [1 + 1e-7 * values])
    wrong = np.array([1.0, 1.00003, 0.99996, 1.00002, 1.00005])
    off = adjust(luck + 0.001 * values, controls, wrong).mean() - adjust(luck + 0.001 * values, controls, np.ones(5)).mean()
    assert abs(off) < 1e-4


@pytest.mark.statistical
def test_constants_of_every_kind_of_road_are_what_theory_says() -> None:
    for environment in (
        {"road": "harmonic", "speed": (0.7, 3.0)},
        {"road": "harmonic", "speed_noise": "white", "speed": (0.7, 3.0)},
        {"road": "first_order", "speed": (0.7, 3.0)},
        {**ENVIRONMENT, "reward": {"acceleration": 1.0, "travel": 0.5}},
    ):
        task = make_task(**environment)
        found = evaluate(
            {"constant": ConstantDamping(task, 0.3)},
            environment=environment,
            speeds=[0.7, 1.5],
            bandwidths=[0.1],
            episodes=64,
            duration=150.0,
        )["constant"]
        theory = [theoretical_cost(task, float(np.float32(0.3)), point.speed, point.bandwidth) for point in found.points]
        assert np.all(found.standard_error < 2e-4 * found.mean)
        np.testing.assert_allclose(found.mean, theory, rtol=1e-4 + 4 * float((found.standard_error / found.mean).max()))
        weighted = np.array(task.weights) @ np.where(np.isfinite(found.mean_squares), found.mean_squares, 0)
        np.testing.assert_allclose(weighted, found.mean, rtol=1e-6)  # the mean squares are adjusted alike
        squares = expected_squares(task, (float(np.float32(0.3)),), 1.5, found.points[1].bandwidth)[:, 0]
        np.testing.assert_allclose(found.mean_squares[:, 1], squares, rtol=1e-3)  # infinite where theory is


def test_feedback_has_less_noise_and_the_costs_as_driven_stay() -> None:
    task = make_task(**ENVIRONMENT)
    options = {"environment": ENVIRONMENT, "speeds": [0.7], "bandwidths": [0.1]}
    found = evaluate({"skyhook": make_controller("skyhook", task)}, episodes=64, duration=150.0, **options)["skyhook"]
    driven = standard_error(found.costs)[0]
    assert found.standard_error[0] < 0.2 * driven
    assert abs(found.mean[0] - found.costs.mean()) < 4 * driven
    assert len(found.control_variates) == 4
    assert found.degrees_of_freedom == 59
    few = evaluate({"skyhook": make_controller("skyhook", task)}, episodes=16, duration=150.0, **options)["skyhook"]
    assert len(few.control_variates) == 2
    np.testing.assert_array_equal(few.costs[0], found.costs[0, :16])
    # after too short a transient no constant damping is what theory says
    short = evaluate({"skyhook": make_controller("skyhook", task)}, episodes=16, duration=20.0, transient=5.0, **options)
    assert short["skyhook"].control_variates == ()
    np.testing.assert_array_equal(short["skyhook"].adjusted_costs, short["skyhook"].costs)


def test_balances_of_the_drive_serve_on_a_rough_road() -> None:
    """They cut the error of a rule, and move nothing: over other roads the means agree within it."""
    environment = {"car": "two_mass", "road": "iso_c", "speed": [15.0, 25.0], "control_interval": 0.02}
    task = make_task(**environment)
    rules = {"skyhook": make_controller("skyhook", task), "constant": make_controller("d_max", task)}
    found, again = (
        evaluate(rules, environment=environment, speeds=[15.0, 25.0], episodes=96, duration=8.0, seed=seed) for seed in (0, 1)
    )
    one, two = found["skyhook"], again["skyhook"]
    assert one.balances[0] == "power"
    assert np.all(one.standard_error < 0.25 * standard_error(one.costs))
    assert np.all(np.abs(one.mean - two.mean) < 4 * np.hypot(one.standard_error, two.standard_error))
    exact = [theoretical_cost(task, task.damping_range[1], point.speed, 0.0) for point in one.points]
    away = np.abs(found["constant"].mean - exact)
    assert np.all(away < 4 * found["constant"].standard_error + 1e-4 * np.array(exact))
    smooth = evaluate(
        {"d_max": make_controller("d_max", make_task(speed=1.0))},
        environment={"speed": 1.0},
        speeds=[1.0],
        bandwidths=[0.1],
        episodes=16,
    )
    assert smooth["d_max"].balances == ()


def test_dampings_serve_only_where_theory_is_exact_and_the_start_is_forgotten() -> None:
    def dampings(transient: float = 100.0, count: int = 256, **environment) -> tuple[float, ...]:
        return control_dampings(make_task(**{"speed": 1.0, **environment}), transient, count)

    assert all(0.12 < damping < 1 for damping in dampings(road="gaussian"))
    assert len(dampings(road="gaussian", damping_range=(0.3, 0.3001))) == 4
    assert dampings(road="gaussian", damping_range=(1.5, 3.0)) == ()  # the scheme is not exact enough
    assert all(damping < 1 for damping in dampings(road="gaussian", damping_range=(0.5, 3.0)))
    assert dampings(transient=12.0, road="gaussian") == ()
    assert dampings(transient=20.0, road="gaussian", natural_frequency=5.0)
    assert dampings(road="gaussian", speed_noise="low_pass") == ()  # theory is itself simulated
    assert dampings(road=MultiplicativeRoad(slope_bound=0.5)) == ()  # so is the ellipse's variance
    assert dampings(road=MultiplicativeRoad.from_shape(shape=0.3, bandwidth=0.2))


def test_cost_of_the_optimal_feedback_is_adjusted() -> None:
    """Nearly without freedom it is a constant damping, whose cost other ones give away."""
    road = MultiplicativeRoad.from_shape(shape=2.0, bandwidth=0.2)
    options = {"precision": 0.02, "refinements": 1, "threads": 1}
    result = analysis.optimal_feedback(road, speed=0.7, bounds=(0.5, 0.5001), **options)
    theory = float(analysis.mean_squares(road, damping=0.5, speed=0.7).displacement) / road.variance
    assert result.standard_error < 1e-4 * theory  # 2560 cars over 150 time units alone would give 5e-3
    assert result.cost == pytest.approx(theory, rel=3e-4)
