"""The Kalman filter: exact on what is linear, and as sure of itself as it should be."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from scipy.linalg import expm

from roadgym import ParameterError
from roadgym.env import QuarterCarEnv
from roadgym.kalman import KalmanFilter
from roadgym.linear import LinearSystem
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv
from roadgym.wrappers import KalmanObservation, VectorKalmanObservation

PLANTS = {
    "one mass": {"road": "gaussian", "speed": 1.5, "bandwidth": 0.1, "observation": ["travel", "acceleration"]},
    "third order": {"road": "two_corner", "speed": 1.0, "observation": ["acceleration"]},
    "slope of white noise": {"road": "first_order", "speed": 1.0, "observation": ["travel", "velocity"]},
    "two masses": {"road": "iso_c", "car": "two_mass", "speed": 20.0, "observation": ["travel", "acceleration"]},
}
NOISE = {"sensors": {"noise": 0.05}}
HIDDEN = {"observe_operating_point": False}


def batch(number, **environment):
    return QuarterCarVectorEnv(number, **{"max_episode_steps": None, **NOISE, **environment})


def drive(envs, steps, seed=1):
    """Yields infos and observations of a drive with dampings of all sizes."""
    random = np.random.default_rng(seed)
    low, high = envs.task.damping_range
    for _ in range(steps):
        damping = np.where(random.random(envs.num_envs) < 0.5, random.choice([low, high]), random.uniform(low, high))
        observations, *_, info = envs.step(damping[:, None].astype(np.float32))
        yield info, observations


def truth(envs, names):
    from roadgym.env import state_names

    told = state_names(envs.task)
    return envs.state()[:, [told.index(name) for name in names]]


@pytest.mark.parametrize("plant", PLANTS)
def test_mean_and_covariance_are_those_of_a_filter_from_scratch(plant):
    task = make_task(**PLANTS[plant], **NOISE)
    known, envs = KalmanFilter(task), batch(2, **PLANTS[plant])
    road, ratio = task.road.shaping_filter(), task.frequency_ratio(task.speed[0])
    time = task.control_interval * task.car.natural_frequency

    def system(damping):
        return LinearSystem.of(road, task.car.motion.own, damping=damping, ratio=ratio)

    def corrected(mean, covariance, seen, damping):
        rows = np.array([system(damping).signals[name] for name in known.measured])
        innovation = rows @ covariance @ rows.T + 0.05**2 * np.eye(len(rows))
        gain = covariance @ rows.T @ np.linalg.inv(innovation)
        return mean + gain @ (seen[: len(rows)].astype(float) - rows @ mean), covariance - gain @ rows @ covariance

    observations, _ = envs.reset(seed=1)
    belief = known.begin(observations)
    still = system(0.0)
    rise = np.vstack([still.heights * task.car.starts_on_road, np.eye(len(road.states))])
    size = len(rise)
    mean, covariance = corrected(np.zeros(size), rise @ road.covariance @ rise.T, observations[1], task.damping_range[0])
    for info, seen in drive(envs, 40):
        damping = info["damping"][1]
        belief = known.advance(belief, info.get("damping_command", info["damping"]), seen)
        now = system(damping)
        block = np.block([[-now.drift, now.noise @ now.noise.T], [np.zeros((size, size)), now.drift.T]])  # of C. F. Van Loan
        right = expm(block * time)[:, size:]
        phi = right[size:].T
        mean, covariance = corrected(phi @ mean, phi @ covariance @ phi.T + phi @ right[:size], seen[1], damping)
    np.testing.assert_allclose(belief.mean[1], mean, atol=2e-6 * np.abs(mean).max())
    np.testing.assert_allclose(belief.covariance[1], covariance, atol=2e-6 * np.abs(covariance).max())


SENSORS = {
    "noise alone": {"noise": 0.05},
    "bias": {"noise": 0.05, "bias": {"travel": 0.3}},
    "delay": {"noise": 0.05, "delay": {"travel": 0.4, "acceleration": 0.2}},
    "slow": {"noise": 0.05, "interval": {"acceleration": 0.6}, "delay": {"acceleration": 0.4}},
    "slow valve": {"noise": 0.05},
    "coarse": {"noise": 0.02, "resolution": 0.05},
    "another car": {"noise": 0.05},
}
ANOTHER = {"natural_frequency": (1.3, 1.3000001), "valve.rise_time": (0.1, 0.1000001)}  # told in terms of the nominal car


@pytest.mark.statistical
@pytest.mark.parametrize("sensors", SENSORS)
def test_innovations_are_white_and_errors_as_predicted(sensors):
    plant = {**PLANTS["one mass"], "speed": (0.7, 2.0), "bandwidth": (0.1, 0.3), "warm_up": 1.0}
    valve = {"delay": 0.25, "levels": 4, "rate": 5.0, "rise_time": 0.1, "fall_time": 0.05} if sensors == "slow valve" else None
    vary = ANOTHER if sensors == "another car" else None
    envs = batch(4096 if vary is None else 1024, **{**plant, "sensors": SENSORS[sensors], "valve": valve, "vary": vary})
    known = KalmanFilter(envs.task, hypotheses=1)
    belief = known.begin(envs.reset(seed=3)[0])
    normal, fresh = [belief.surprise[0]], [belief.surprise[1] > 0]
    for info, seen in drive(envs, 40):
        belief = known.advance(belief, info.get("damping_command", info["damping"]), seen)
        normal.append(belief.surprise[0])
        fresh.append(belief.surprise[1] > 0)
    normal, fresh = np.array(normal), np.array(fresh)
    for k in range(2):
        number = fresh[..., k].sum()
        assert abs((normal[..., k] ** 2).sum() - number) < 4 * np.sqrt(2 * number)
        assert abs(normal[..., k].sum()) < 4 * np.sqrt(number)
        for j in range(2):
            products = normal[1:, :, k] * normal[:-1, :, j]
            assert abs(products.sum()) < 4 * np.sqrt((products**2).sum() + 1)
    assert fresh[1:, :, 1].mean() == {"slow": 12 / 40, "delay": 39 / 40}.get(sensors, 1)  # what is told anew
    np.testing.assert_allclose(belief.valve[:, 0], envs.plant.row("damping") if valve or vary else info["damping"], atol=3e-7)
    names = known.full.signals[:4]
    errors = (known.observation(belief)[:, :4] - truth(envs, names)) / known.deviations(belief)[:, :4]
    for error in errors.T:
        assert abs((error**2).mean() - 1) * np.sqrt(len(error) / 2) < 4


@pytest.mark.statistical
def test_it_is_as_good_on_the_bounded_road_as_it_says():
    plant = {**PLANTS["one mass"], "road": {"kind": "multiplicative", "shape": 1.0}}
    envs = batch(4096, **plant)
    known = KalmanFilter(envs.task)
    belief = known.begin(envs.reset(seed=3)[0])
    for info, seen in drive(envs, 60):
        belief = known.advance(belief, info.get("damping_command", info["damping"]), seen)
    squares = ((known.observation(belief)[:, :4] - truth(envs, known.full.signals[:4])) / known.deviations(belief)[:, :4]) ** 2
    for square in squares.T:
        assert abs(square.mean() - 1) < 4 * square.std() / np.sqrt(len(square))


def test_a_wide_range_of_dampings_takes_a_longer_series_or_is_refused():
    narrow, wide = (make_task(**PLANTS["one mass"], damping_range=ends) for ends in ((0.05, 1.0), (0.05, 30.0)))
    one, other = KalmanFilter(narrow), KalmanFilter(wide)
    points = np.array([[1.5, 0.1]])
    assert one.model(points).series.shape[1] < other.model(points).series.shape[1]
    with pytest.raises(ParameterError, match="damping_range must be narrower"):
        KalmanFilter(make_task(**PLANTS["one mass"], damping_range=(0.01, 100.0), control_interval=10.0))


def test_who_measures_all_without_noise_knows_all():
    envs = batch(3, road="gaussian", speed=1.5, sensors=None)
    known = KalmanFilter(envs.task)
    observations, _ = envs.reset(seed=3)
    belief = known.begin(observations)
    for info, seen in drive(envs, 20):
        belief = known.advance(belief, info.get("damping_command", info["damping"]), seen)
        np.testing.assert_allclose(known.observation(belief), seen, atol=1e-6)
        assert known.deviations(belief).max() < 1e-6


@pytest.mark.statistical
def test_a_bank_finds_the_operating_point_that_is_hidden():
    hidden = {
        "speed": (0.7, 3.0),
        "bandwidth": (0.1, 0.5),
        "observe_operating_point": False,
        "observation": ["travel", "velocity"],
    }
    envs = batch(256, road="gaussian", **hidden)
    known = KalmanFilter(envs.task, hypotheses=6)
    belief = known.begin(envs.reset(seed=3, options={"speed": 2.5})[0])
    assert belief.weight.shape == (256, 36)
    first = known.observation(belief)[:, -2].mean()
    for info, seen in drive(envs, 150):
        belief = known.advance(belief, info.get("damping_command", info["damping"]), seen)
    np.testing.assert_allclose(belief.weight.sum(axis=1), 1)
    share = known.observation(belief)[:, -2]
    ratio = share / (1 - share)
    assert first / (1 - first) < 1.9
    assert abs(np.median(ratio) - 2.5) < 0.15
    assert np.mean(np.abs(known.likeliest(belief)[:, 0] - 2.5 / 3.5) < 0.05) > 0.8
    assert np.all(known.deviations(belief)[:, -2] > 0)


@pytest.mark.parametrize(
    ("plant", "vary"),
    [("one mass", {"natural_frequency": (0.6, 1.4)}), ("two masses", {"sprung_mass": (120.0, 360.0)})],
)
def test_a_bank_weighs_the_car(plant, vary):
    ((name, (low, high)),) = vary.items()
    envs = batch(64, **PLANTS[plant], vary=vary)
    known = KalmanFilter(envs.task)
    observations, info = envs.reset(seed=3)
    true, belief = info[name], known.begin(observations)
    mean, deviation = known.varied(belief)[name]
    np.testing.assert_allclose([mean[0], deviation[0]], [(low + high) / 2, (high - low) / np.sqrt(12)], rtol=0.15)
    for info, seen in drive(envs, 60):
        belief = known.advance(belief, info.get("damping_command", info["damping"]), seen)
    likeliest = belief.point[np.arange(64), belief.weight.argmax(axis=1), 2]
    nearest = belief.point[0, :, 2][np.abs(belief.point[0, :, 2] - true[:, None]).argmin(axis=1)]
    assert np.mean(likeliest == nearest) > 0.8
    assert known.varied(belief)[name][1].mean() < 0.05 * (high - low)


def test_a_bank_covers_what_is_hidden_alone():
    envs = batch(3, road="gaussian", speed=(0.7, 3.0), bandwidth=(0.1, 0.5), observation=["travel", "speed"], **HIDDEN)
    known = KalmanFilter(envs.task, hypotheses=4)
    seen = envs.reset(seed=3)[0]
    belief = known.begin(seen)
    assert belief.weight.shape == (3, 4)
    np.testing.assert_allclose(belief.point[:, :, 1], [[0.15, 0.25, 0.35, 0.45]] * 3)
    np.testing.assert_allclose(known.observation(belief)[:, -2], seen[:, 1], rtol=1e-6)
    assert np.all(known.deviations(belief)[:, -1] > 0)


def test_where_the_car_is_known_each_has_the_filter_of_it():
    """As one that sees speed and bandwidth, beyond the ends of episodes; and behind a valve of its own."""
    point = {"speed": (0.7, 3.0), "bandwidth": (0.1, 0.5), "observation": ["travel", "acceleration"]}
    shown = []
    for own in (HIDDEN, {"observe_operating_point": True}):
        layer = VectorKalmanObservation(batch(4, road="gaussian", **point, **own, max_episode_steps=5))
        layer.car_known = True
        shown.append([layer.reset(seed=3)[0], *(layer.step(np.full((4, 1), 0.1 * k, np.float32))[0] for k in range(1, 10))])
        some = {"reset_mask": np.array([False, True, False, True])}
        shown[-1] += [layer.reset(options=some)[0], layer.step(np.full((4, 1), 0.3, np.float32))[0]]
    np.testing.assert_allclose(*shown, atol=1e-5)
    vary = {"natural_frequency": (0.6, 1.4), "valve.delay": (0.0, 0.5), "valve.rise_time": (0.1, 0.3)}
    envs = batch(4, road="gaussian", **point, vary=vary, max_episode_steps=5)
    layer = VectorKalmanObservation(envs, hypotheses=2)
    layer.car_known = True
    layer.reset(seed=3)
    for k in range(1, 10):
        layer.step(np.full((4, 1), 0.1 * k, np.float32))
        np.testing.assert_allclose(layer.belief.point[:, 0, 2:].T, envs.plant.drawn_now)
        np.testing.assert_allclose(layer.belief.valve[:, 0], envs.plant.row("damping"), atol=1e-6)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
@pytest.mark.parametrize("hidden", [False, True])
def test_each_of_a_batch_is_the_single_environment_bit_by_bit(mode, hidden):
    plant = {
        "road": "gaussian",
        "speed": (0.7, 2.0),
        "bandwidth": (0.1, 0.3),
        "observation": ["travel", "acceleration"],
        "observe_operating_point": not hidden,
        "warm_up": 1.0,
        "sensors": {"noise": 0.05, "bias": 0.1, "delay": {"travel": 0.2}},
        "valve": {"rise_time": 0.1},
    }
    envs = VectorKalmanObservation(QuarterCarVectorEnv(5, max_episode_steps=7, autoreset_mode=mode, **plant), deviations=True)
    singles = [KalmanObservation(QuarterCarEnv(**plant), deviations=True) for _ in range(5)]
    observations, _ = envs.reset(seed=4)
    for i, single in enumerate(singles):
        np.testing.assert_array_equal(observations[i], single.reset(seed=4 + i)[0])
    damping, starting = np.linspace(0.05, 1, 5, dtype=np.float32)[:, None], False
    for _ in range(17):
        observations, _, _, truncated, info = envs.step(damping)
        assert envs.observation_space.contains(observations)
        begins = starting if mode is AutoresetMode.NEXT_STEP else truncated.all()
        for i, single in enumerate(singles):
            if not starting:
                last = single.step(damping[i])[0]
                np.testing.assert_array_equal(info["final_obs"][i] if begins else observations[i], last)
            if begins:
                np.testing.assert_array_equal(observations[i], single.reset()[0])
        starting = mode is AutoresetMode.NEXT_STEP and bool(truncated.all())


def test_part_of_a_batch_is_reset():
    plant = {**PLANTS["one mass"], "speed": (0.7, 2.0), "sensors": {"noise": 0.05}}
    envs = VectorKalmanObservation(QuarterCarVectorEnv(4, autoreset_mode="disabled", max_episode_steps=None, **plant))
    single = KalmanObservation(QuarterCarEnv(**plant))
    envs.reset(seed=1)
    single.reset(seed=3)
    damping = np.full((4, 1), 0.3, np.float32)
    for _ in range(3):
        envs.step(damping)
    mask = np.array([False, False, True, False])
    fresh = envs.reset(options={"reset_mask": mask})[0]
    np.testing.assert_array_equal(fresh[2], single.reset()[0])
    np.testing.assert_array_equal(envs.step(damping)[0][2], single.step(damping[2])[0])


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_gymnasium_finds_no_fault():
    env = gymnasium.make("roadgym/QuarterCar-v0", observation=["acceleration"], sensors={"noise": 0.05})
    for wrapped in (KalmanObservation(env), KalmanObservation(env, deviations=True)):
        check_env(wrapped, skip_render_check=True)
    assert wrapped.spec.make().observation_space == wrapped.observation_space
    assert KalmanObservation(env).task.signals == ("displacement", "velocity", "level", "slope", "speed", "bandwidth")


MANY = {
    "sprung_mass": (200.0, 280.0),
    "unsprung_mass": (30.0, 40.0),
    "spring_rate": (15e3, 17e3),
    "tyre_rate": (150e3, 170e3),
    "valve.rise_time": (0.0, 0.01),
}


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"road": "harmonic"}, "linear filter of white noise, at a constant speed; got a harmonic road$"),
        ({"road": "harmonic", "speed_noise": "white"}, "got a harmonic road under white speed noise"),
        ({"road": "gaussian", "speed_noise": "low_pass"}, "got a gaussian road under low_pass speed noise"),
        ({"observation": []}, "needs a signal to be measured; the task observes speed, bandwidth"),
        (
            {"road": "iso_c", "car": "two_mass", "speed": 20.0, "vary": MANY},
            "hypotheses of sprung_mass, .* at most 2500 filters",
        ),
        ({"sensors": {"delay": 0.3}}, r"delay of sensors must be whole control intervals, 0.2 s, for a Kalman filter, got 0.3"),
    ],
)
def test_what_no_filter_is_for_is_refused_in_one_line(environment, message):
    with pytest.raises(ParameterError, match=message) as caught:
        KalmanObservation(QuarterCarEnv(**{"observation": ["travel"], **environment}))
    assert "\n" not in str(caught.value)


def test_what_changes_the_observation_is_no_sensor():
    env = QuarterCarEnv(road="gaussian", observation=["travel"])
    for changed in (KalmanObservation(env), gymnasium.wrappers.TransformObservation(env, np.negative, env.observation_space)):
        with pytest.raises(ParameterError, match="must show the observation of its task"):
            KalmanObservation(changed)


def test_deviations_are_shown_or_not():
    for wrap, env in ((KalmanObservation, QuarterCarEnv()), (VectorKalmanObservation, QuarterCarVectorEnv(2))):
        with pytest.raises(ParameterError, match="deviations must be True or False, got 'x'"):
            wrap(env, deviations="x")


def test_only_what_the_task_observes_is_measured():
    with pytest.raises(ParameterError, match="must show the observation of its task"):
        KalmanObservation(gymnasium.wrappers.TimeAwareObservation(gymnasium.make("roadgym/QuarterCar-v0")))
