"""Cars that differ from episode to episode: what is drawn, who is told, and that what drives is the car that was drawn."""

import dataclasses
import json
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import agents
import analysis
import roadgym
from agents.cli import main
from agents.hyperparameters import load_hyperparameters
from agents.report import notes
from agents.wrappers import training_reward
from roadgym import ParameterError, TwoMassCar
from roadgym.env import QuarterCarEnv, state_names
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

RANGES = {"sprung_mass": [180.0, 300.0], "tyre_rate": [128e3, 192e3], "spring_rate": [12.8e3, 19.2e3]}
LAGS = {"valve.rise_time": [0.0, 0.03], "valve.fall_time": [0.0, 0.03], "valve.delay": [0.0, 0.012]}
TWO = {"car": "two_mass", "road": "iso_c", "speed": 20.0}
FILTERED = {"acceleration": 1.0, "weighted_acceleration": 0.5}


def drive(envs, commands, seed=0):
    """Observations, rewards and infos of a drive, the reset first, stacked over steps."""
    observations, info = envs.reset(seed=seed)
    told = [(observations, np.zeros(envs.num_envs), info)]
    for command in commands:
        observations, rewards, _, _, info = envs.step(np.full((envs.num_envs, 1), command, np.float32))
        told.append((observations, rewards, info))
    return [np.array(part) for part in zip(*[(o, r) for o, r, _ in told], strict=True)], [info for _, _, info in told]


@pytest.mark.parametrize(
    ("plant", "vary"),
    [
        (TWO | {"reward": FILTERED}, RANGES | {"unsprung_mass": [30.0, 45.0]}),
        (TWO | {"reward": FILTERED, "valve": {"levels": 7, "rate": 20.0}}, RANGES | LAGS | {"valve.rate": [5.0, 50.0]}),
        (TWO | {"road": "gaussian", "car": {"kind": "two_mass", "tyre_damping": 50.0}}, {"tyre_damping": [10.0, 500.0]}),
        ({"road": "gaussian", "speed": 1.2, "reward": FILTERED, "natural_frequency": 8.0}, {"natural_frequency": [6.0, 11.0]}),
    ],
    ids=["two masses", "with a valve", "tyre damping", "one mass"],
)
def test_what_is_driven_is_the_car_that_was_drawn(plant, vary):
    """The same as a plant of that car alone, told in terms of the nominal car; the two have other units of time."""
    plant = plant | {"precision": "float64"}
    one_mass = "natural_frequency" in plant
    if one_mass:
        plant["road"] = {"kind": "gaussian", "wavenumber": 6.0}
    envs = QuarterCarVectorEnv(3, vary=vary, **plant)
    task, names = envs.task, list(envs.task.car.mean_squares)
    low, high = task.damping_range
    commands = np.random.default_rng(0).uniform(low, high, 40)
    (observations, rewards), infos = drive(envs, commands)
    states = dict(zip(state_names(task), envs.state().T, strict=True))
    for k, name in enumerate(task.signals):
        if name in task.car.motion.states:
            np.testing.assert_allclose(states[name], observations[-1, :, k], rtol=1e-6)
    for i in range(3):
        drawn = {name: infos[0][name][i] for name in vary}
        car = dataclasses.replace(task.car, **{name: value for name, value in drawn.items() if name[:6] != "valve."})
        lags = {name[6:]: value for name, value in drawn.items() if name[:6] == "valve."}
        valve = dataclasses.replace(task.valve, **lags)
        firmer = 1.0 if one_mass else car.damping_ratio(task.car.damping_unit)  # of a damper of the same coefficient
        own = {name: value for name, value in plant.items() if name != "natural_frequency"} | {"car": car, "valve": valve}
        if valve.rate:
            own["valve"] = roadgym.Valve(**{**vars(valve), "rate": valve.rate * firmer})
        scale = {"damping_range": (firmer * low, firmer * high), "control_interval": task.control_interval}
        alone = QuarterCarVectorEnv(1, substeps=task.substeps, **{**own, **scale})
        (seen, _), facts = drive(alone, firmer * commands, seed=i)
        powers = [2 * task.car.time_powers.get(name, 0) for name in names]
        faster = car.natural_frequency / task.car.natural_frequency
        for name, power in zip(names, powers, strict=True):
            expected = np.array([each[name][0] for each in facts[1:]]) * faster**power
            np.testing.assert_allclose([each[name][i] for each in infos[1:]], expected, rtol=2e-5, err_msg=name)
        units = alone.signal_scale / task.signal_scale
        for k, name in enumerate(task.signals):
            if name not in ("speed", "bandwidth", "slope"):
                expected = seen[:, 0, k] * units[k] * faster ** task.car.time_powers.get(name, 0)
                np.testing.assert_allclose(observations[:, i, k], expected, rtol=2e-5, atol=1e-6, err_msg=name)
        cost = sum(weight * np.array([each[name][i] for each in infos[1:]]) for name, weight in task.reward_by_name.items())
        np.testing.assert_allclose(-rewards[1:, i], cost / task.cost_unit, rtol=1e-6)


@pytest.mark.statistical
def test_mean_squares_at_a_constant_coefficient_are_those_of_theory_of_each_car():
    envs = QuarterCarVectorEnv(512, max_episode_steps=None, vary=RANGES, warm_up=3.0, **TWO)
    damping, steps = 0.3, 3000
    _, info = envs.reset(seed=5)
    drawn = np.array([info[name] for name in envs.task.vary.names])
    total = np.zeros((2, envs.num_envs))
    for _ in range(steps):
        *_, info = envs.step(np.full((envs.num_envs, 1), damping, np.float32))
        total += [info["acceleration"], info["wheel_load"]]
    coefficient = damping * envs.task.car.damping_unit
    excess = np.empty_like(total)
    for i, values in enumerate(drawn.T):
        car = TwoMassCar(**dict(zip(envs.task.vary.names, values.tolist(), strict=True)))
        own = analysis.mean_squares("iso_c", damping=car.damping_ratio(coefficient), speed=20.0, car=car)
        excess[:, i] = total[:, i] / steps / np.array([own["acceleration"], own["wheel_load"]]) - 1
    z = excess.mean(axis=1) / (excess.std(axis=1) / np.sqrt(envs.num_envs))
    assert np.abs(z).max() < 4
    for values in drawn:  # and there is nothing left of what was drawn in it
        for row in excess:
            assert abs(np.corrcoef(values, row)[0, 1]) < 4 / np.sqrt(envs.num_envs)


@pytest.mark.statistical
def test_draws_are_uniform_and_independent():
    envs = QuarterCarVectorEnv(2000, vary=RANGES | LAGS, **TWO)
    _, first = envs.reset(seed=1)
    _, second = envs.reset()
    names = envs.task.vary.names
    rows = np.array(
        [(info[name] - low) / (high - low) for info in (first, second) for name, low, high in envs.task.vary.ranges]
    )
    assert 0 <= rows.min() < 0.002
    assert 0.998 < rows.max() <= 1
    z = (rows.mean(axis=1) - 0.5) * np.sqrt(12 * 2000)
    assert np.abs(z).max() < 4
    spread = ((rows - 0.5) ** 2).mean(axis=1) - 1 / 12
    assert np.abs(spread / np.sqrt((1 / 80 - 1 / 144) / 2000)).max() < 4
    between = np.corrcoef(rows)[np.triu_indices(2 * len(names), 1)]
    assert np.abs(between).max() * np.sqrt(2000) < 4.5


def test_draws_depend_on_seed_episode_and_field_alone():
    alone, beside = {"tyre_rate": RANGES["tyre_rate"]}, RANGES | LAGS
    found = []
    for vary, damping in ((alone, 0.2), (beside, 0.9)):
        envs = QuarterCarVectorEnv(5, max_episode_steps=3, autoreset_mode="SAME_STEP", vary=vary, **TWO)
        _, infos = drive(envs, [damping] * 8, seed=11)
        found.append([info["tyre_rate"] for info in infos])
    np.testing.assert_array_equal(*found)
    assert len({tuple(row) for row in found[0]}) == 3  # the episodes
    assert (found[0][3] == found[0][0]).all()  # the last step tells of its own episode
    assert (found[0][4] != found[0][3]).all()


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP", "DISABLED"])
@pytest.mark.parametrize("vary", [RANGES, RANGES | LAGS], ids=["car", "valve"])
def test_batch_equals_single_bit_by_bit(mode, vary):
    plant = {**TWO, "vary": vary, "warm_up": 0.05, "reward": FILTERED}
    envs = QuarterCarVectorEnv(70, max_episode_steps=4, autoreset_mode=mode, **plant)
    singles = {i: gymnasium.wrappers.TimeLimit(QuarterCarEnv(**plant), 4) for i in (0, 3, 66)}
    observations, infos = envs.reset(seed=2)
    last = {}
    for i, single in singles.items():
        own, info = single.reset(seed=2 + i)
        np.testing.assert_array_equal(observations[i], own)
        assert info == {name: infos[name][i] for name in info}
        last[i] = False
    rng = np.random.default_rng(0)
    for _ in range(11):
        actions = rng.uniform(0.1, 0.9, (70, 1)).astype(np.float32)
        observations, rewards, _, truncated, infos = envs.step(actions)
        for i, single in singles.items():
            if mode == "NEXT_STEP" and last[i]:
                own, info = single.reset()
                reward, last[i] = 0.0, False
            else:
                own, reward, _, last[i], info = single.step(actions[i])
                assert last[i] == truncated[i]
                if mode == "SAME_STEP" and last[i]:
                    np.testing.assert_array_equal(infos["final_obs"][i], own)
                    assert {name: infos["final_info"][name][i] for name in info} == info
                    own, _ = single.reset()
            np.testing.assert_array_equal(observations[i], own)
            assert reward == rewards[i]
            assert info == {name: infos[name][i] for name in info}
        if mode == "DISABLED" and truncated.any():
            observations, _ = envs.reset(options={"reset_mask": truncated})
            for i, single in singles.items():
                if truncated[i]:
                    np.testing.assert_array_equal(single.reset()[0], observations[i])


def test_neither_the_size_of_a_batch_nor_threads_matter():
    few, many = (QuarterCarVectorEnv(n, vary=RANGES, threads=2, **TWO) for n in (3, 4500))
    (left, _), (right, _) = (drive(envs, [0.2, 0.7, 0.4], seed=9)[0] for envs in (few, many))
    np.testing.assert_array_equal(left, right[:, :3])


def test_what_is_hidden_stays_hidden():
    plain, varied = make_task(**TWO), make_task(vary=RANGES | LAGS, **TWO)
    assert plain.signals == varied.signals
    assert plain.observation_space == varied.observation_space
    assert plain.action_space == varied.action_space
    np.testing.assert_array_equal(plain.signal_scale, varied.signal_scale)
    assert training_reward("advantage", make_task(road="gaussian", vary={"natural_frequency": [0.8, 1.2]})) == "cost"
    assert training_reward("advantage", make_task(road="gaussian")) == "advantage"


def test_gymnasium_knows_it():
    env = gymnasium.make(roadgym.ENVIRONMENT_ID, vary=RANGES | LAGS, **TWO)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized space.*")
        check_env(env.unwrapped, skip_render_check=True)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert json.loads(env.spec.to_json())["kwargs"]["vary"] == RANGES | LAGS
    np.testing.assert_array_equal(env.reset(seed=4)[0], again.reset(seed=4)[0])
    assert env.step(np.array([0.3], np.float32))[4] == again.step(np.array([0.3], np.float32))[4]
    batch = gymnasium.make_vec(roadgym.ENVIRONMENT_ID, num_envs=2, vary=RANGES, vector_kwargs={}, **TWO)
    assert batch.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    _, info = batch.reset(seed=1)
    assert info["sprung_mass"].dtype == np.float64
    assert info["_sprung_mass"].all()


@pytest.mark.parametrize(
    ("vary", "said"),
    [
        ({"sprung_mas": [1, 2]}, "vary knows no field 'sprung_mas'"),
        ({"weighting": [1, 2]}, "vary knows no field 'weighting'"),
        ({"damping_coefficients": [1, 2]}, "vary knows no field 'damping_coefficients'"),
        ({"valve.levels": [2, 8]}, "vary knows no field 'valve.levels'"),
        ({"valve.lag": [0, 1]}, "vary knows no field 'valve.lag'"),
        ({"sprung_mass": 200}, "vary sprung_mass must be a pair"),
        ({"sprung_mass": [300, 200]}, "vary sprung_mass must be a pair"),
        ({"sprung_mass": [200, 200]}, "vary sprung_mass must be a pair"),
        ({"sprung_mass": [200, "x"]}, "high end of vary sprung_mass must be a number"),
        ({"sprung_mass": [200, float("nan")]}, "high end of vary sprung_mass must be finite"),
        ({"sprung_mass": [0, 200]}, "vary sprung_mass holds a value that is refused: sprung_mass must be positive"),
        ({"valve.rise_time": [-0.1, 0.2]}, "vary valve.rise_time holds a value that is refused"),
        ({"valve.delay": [0, 1e5]}, "vary valve.delay holds a value that is refused"),
        ({"valve.rate": [0, 5]}, "vary valve.rate holds a value that is refused"),
        ({"tyre_damping": [0, 300]}, "vary must leave wheel_load finite"),
        ({"sprung_mass": [1e-6, 200]}, "must"),
        ([("sprung_mass", [1, 2])], "vary must be a mapping"),
        ("sprung_mass", "vary must be a mapping"),
    ],
)
def test_what_cannot_vary_is_refused_in_one_line(vary, said):
    with pytest.raises(ParameterError) as caught:
        make_task(vary=vary, **TWO)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_delay_that_outlasts_an_episode_is_refused():
    with pytest.raises(ParameterError, match="delay of the valve must be shorter than an episode"):
        QuarterCarVectorEnv(1, max_episode_steps=2, vary={"valve.delay": [0.0, 0.02]}, **TWO)


def test_evaluations_draw_cars_for_all_alike_and_claim_no_theory():
    varied = TWO | {"vary": RANGES}
    task = make_task(**varied)
    rivals = {name: agents.make_controller(name, task) for name in ("analytic_optimum", "skyhook")}
    size = {"speeds": [20.0], "episodes": 64, "duration": 1.0, "transient": 1.0}
    results = agents.evaluate(rivals, environment=varied, **size)
    fixed = agents.evaluate(rivals, environment=TWO, **size)
    for name, found in results.items():
        assert (found.control_variates, found.balances) == ((), ())
        np.testing.assert_array_equal(found.adjusted_costs, found.costs)
        assert (found.costs != fixed[name].costs).all()
    pairs = np.corrcoef(results["skyhook"].costs[0], results["analytic_optimum"].costs[0])
    assert pairs[0, 1] > 0.5  # the same cars
    compared = agents.compare(
        None, environment=varied, speeds=[20.0], controllers=["d_min"], episodes=16, report=lambda *_: None
    )
    assert all(row.theory is None for row in compared.rows)
    (note,) = (text for name, text in notes(compared) if name == "cars")
    assert "sprung_mass within 180 to 300" in note
    assert "nominal" in note
    assert all(0 < row.bound.cost < row.cost for row in compared.rows)  # a mean over cars that are drawn


def test_an_agent_trains_on_cars_that_differ_and_keeps_their_law(tmp_path):
    hyperparameters = load_hyperparameters("ppo") | {"n_envs": 8, "n_steps": 64, "batch_size": 64}
    agent = agents.train(tmp_path, environment=TWO | {"vary": RANGES | LAGS}, hyperparameters=hyperparameters, timesteps=1)
    assert agent.description["training_reward"] == "cost"
    assert agents.load(tmp_path).task.vary == make_task(vary=RANGES | LAGS, **TWO).vary


def test_a_gradient_refuses_valves_whose_rate_varies(tmp_path):
    with pytest.raises(ParameterError, match="the rate of the valve unlimited"):
        agents.train(tmp_path, algorithm="apg", environment=TWO | {"vary": {"valve.rate": (1.0, 10.0)}}, timesteps=1)


def test_the_command_line_takes_it(capsys):
    given = ["--car", "two_mass", "--vary", '{"sprung_mass": [180, 300]}', "--speeds", "20", "--episodes", "16"]
    assert main(["evaluate", "--controller", "skyhook", *given]) == 0
    assert "cost" in capsys.readouterr().out
    given[3] = '{"sprung_mass": [0, 300]}'
    assert main(["evaluate", "--controller", "skyhook", *given]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_pictures_show_the_car_that_is_drawn():
    env = QuarterCarEnv(render_mode="rgb_array", vary=RANGES | LAGS, **TWO)
    env.reset(seed=1)
    env.step(np.array([0.5], np.float32))
    assert env.render().shape == (640, 800, 3)


def test_a_copy_drives_on_as_the_batch_does():
    envs = QuarterCarVectorEnv(3, max_episode_steps=3, autoreset_mode="SAME_STEP", vary=RANGES, **TWO)
    envs.reset(seed=1)
    other = pickle.loads(pickle.dumps(envs))
    for _ in range(5):
        left, right = (each.step(np.full((3, 1), 0.3, np.float32)) for each in (envs, other))
        np.testing.assert_array_equal(left[0], right[0])
        np.testing.assert_array_equal(left[4]["sprung_mass"], right[4]["sprung_mass"])
