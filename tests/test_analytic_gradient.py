"""Analytic policy gradient: the plant in torch, the policy, and what is learned in seconds."""

import numpy as np
import pytest
import torch
from gradients import SMALL, check_gradient
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import agents
from agents.analytic_gradient import APG
from agents.controllers import make_controller
from agents.differentiable import Seen, values
from agents.evaluation import evaluate
from agents.features import Sight
from agents.report import theory_given
from agents.training import load_hyperparameters, make_model, usual_algorithm
from agents.vec_env import QuarterCarVecEnv
from agents.wrappers import learning
from roadgym import ParameterError
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

RANGES = {"speed": (0.7, 3.0), "bandwidth": (0.1, 0.4)}
PLANTS = {
    "bounded": {"road": "multiplicative", **RANGES},
    "comfort": {"road": "gaussian", "reward": {"acceleration": 1.0, "travel": 0.5}, **RANGES},
    "first order": {"road": "first_order", "speed": (0.5, 2.0), "reward": {"displacement": 1.0, "travel": 1.0}},
    "two masses": {"road": "iso_c", "car": "two_mass", "speed": (15.0, 25.0), "observation": ["acceleration", "travel"]},
    "weighted": {"road": "iso_c", "car": "two_mass", "speed": (15.0, 25.0), "reward": {"weighted_acceleration": 1.0}},
    "white": {"road": "harmonic", "speed_noise": "white", "speed": (0.5, 2.0)},
    "low-pass": {"road": "harmonic", "speed_noise": "low_pass", "observation": ["travel", "relative_velocity", "speed"]},
    "slow valve": {
        "road": "gaussian",
        **RANGES,
        "observation": ["acceleration", "travel"],
        "valve": {"delay": 0.25, "rise_time": 0.1, "fall_time": 0.05},
    },
    "valves that differ": {
        "road": "gaussian",
        **RANGES,
        "observation": ["acceleration", "travel"],
        "valve": {"fall_time": 0.06},
        "vary": {"valve.delay": [0.0, 0.5], "valve.rise_time": [0.05, 0.1]},
    },
    "cars that differ": {
        "road": "iso_c",
        "car": "two_mass",
        "speed": 20.0,
        "reward": {"weighted_acceleration": 1.0, "wheel_velocity": 0.1},
        "observation": ["acceleration", "travel", "wheel_velocity"],
        "vary": {"sprung_mass": [180.0, 300.0], "spring_rate": [12e3, 20e3], "tyre_rate": [128e3, 192e3]},
    },
}


def parameters(**changes):
    return load_hyperparameters("apg") | SMALL | changes


def driven(plant, **changes):
    """A model that has driven once, and what it drove."""
    model = make_model("apg", parameters(**changes), PLANTS[plant], 3, None)
    model.learn(model.n_envs * model.n_steps)
    return model, model.rollout_buffer


def watched(monkeypatch):
    """Lengths of the stretches that all models go down from now on, and their learning rates, as they happen."""
    lengths, rates, descend = [], [], APG._descend

    def counted(model, roads, starts, length, known):
        lengths.append(length)
        rates.append(model.policy.optimizer.param_groups[0]["lr"])
        return descend(model, roads, starts, length, known)

    monkeypatch.setattr(APG, "_descend", counted)
    return lengths, rates


@pytest.mark.parametrize("plant", PLANTS)
def test_what_was_driven_is_driven_again(plant):
    """With the policy that drove, the torch plant comes by the states, and the observations, of the environment."""
    _, roads = driven(plant, noise=0.0, policy_kwargs={"net_arch": [8]})
    step = 4
    cars, car, place = roads._cars[step], roads._car[step], torch.from_numpy(roads._places[step])
    moved = cars.moved(car, roads._forced[step], place)
    without = cars.moved(car, cars.forced(roads._ends[step : step + 1])[0], place)
    scale = roads._car.abs().mean(dim=(0, 1))
    assert ((moved - roads._car[step + 1]).abs().amax(0) < 1e-5 * scale).all()
    left = (moved - without).abs().mean(0)  # of the road between the ends little is left out
    assert left.mean() < 0.05 * scale.mean()
    assert (left < 0.1 * scale).all()
    held = place if roads._valve is None else roads._valve.begin(step + 1)[:, 0]
    seen = roads._sees(roads._look(step), roads._car[step + 1], held, step + 1, None)
    np.testing.assert_allclose(seen, roads._seen[step + 1], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("plant", "apart"),
    [("bounded", 2e-3), ("comfort", 0.1), ("two masses", 0.05), ("low-pass", 1e-4), ("cars that differ", 2e-3)],
)
def test_costs_of_intervals_are_those_of_the_environment(plant, apart):
    """Mean costs of the intervals of a drive agree with its rewards, but for what the road does within them."""
    environment = PLANTS[plant]
    envs = QuarterCarVecEnv(64, environment=environment, features=["signals"])
    envs.seed(5)
    envs.reset()
    roads, paid = envs.driven_roads(120), np.zeros((120, 64))
    rng = np.random.default_rng(1)
    for step in range(120):
        roads.note(step, *envs.road_and_car())
        action = rng.uniform(-1, 1, (64, 1)).astype(np.float32)
        seen, paid[step], ended, _ = envs.step(action)
        roads.answer(step, seen, action, ended)
    roads.note(120, *envs.road_and_car())
    roads.finish()
    modelled = roads._cars[0].cost(roads._car[:-1], roads._ends, torch.from_numpy(roads._places)).numpy()
    assert modelled[40:].mean() == pytest.approx(-paid[40:].mean(), rel=0.03)
    np.testing.assert_allclose(modelled[40:].mean(0), -paid[40:].mean(0), rtol=apart)  # of each car
    assert np.corrcoef(modelled[40:].ravel(), paid[40:].ravel())[0, 1] < -0.99


@pytest.mark.parametrize("plant", PLANTS)
def test_gradients_are_those_of_finite_differences(plant):
    model, roads = driven(plant, noise=0.0, policy_kwargs={"net_arch": [8], "activation_fn": "Tanh"})
    check_gradient(roads, model.policy.network)


@pytest.mark.parametrize(("plant", "most"), [("bounded", 0.03), ("cars that differ", 0.08)])
def test_what_another_damping_does_to_the_car_is_what_the_environment_does(plant, most):
    """The same roads twice, with another damping in one interval: the change of the states after it is the model's."""
    environment = PLANTS[plant]
    ends = []
    for place in (-0.2, 0.2):
        envs = QuarterCarVecEnv(64, environment=environment, features=["signals"])
        envs.seed(7)
        seen = envs.reset()
        roads = envs.driven_roads(41)
        for step in range(41):
            roads.note(step, *envs.road_and_car())
            action = np.full((64, 1), place if step == 40 else 0.0, np.float32)
            before, (seen, _, ended, _) = seen, envs.step(action)
            roads.answer(step, before, action, ended)
        roads.note(41, *envs.road_and_car())
        roads.finish()
        ends.append(roads)
    first, second = ends
    changed = second._car[41] - first._car[41]
    moved = [first._cars[40].moved(first._car[40], first._forced[40], torch.full((64,), place)) for place in (-0.2, 0.2)]
    apart, size = (moved[1] - moved[0] - changed).abs().amax(0), changed.abs().amax(0)
    assert apart.max() < most * size.max()
    assert (apart < 0.08 * size).all()


@pytest.mark.parametrize(
    ("valve", "vary"),
    [
        (PLANTS["slow valve"]["valve"], None),
        ({"levels": 3, "delay": 0.4}, None),
        ({"levels": 4, "rise_time": 0.1}, None),
        ({"fall_time": 0.1}, {"valve.delay": [0.0, 0.5], "valve.rise_time": [0.0, 0.3]}),
    ],
)
def test_a_valve_in_torch_is_that_of_the_environment(valve, vary):
    plant = PLANTS["bounded"] | {"valve": valve, "vary": vary}
    envs = QuarterCarVecEnv(16, max_episode_steps=7, environment=plant, features=["signals"])
    seen, roads, rng = envs.reset(), envs.driven_roads(10), np.random.default_rng(1)
    low, high = envs.task.damping_range
    for step in range(10):  # beyond the end of an episode
        roads.note(step, *envs.road_and_car())
        action = rng.uniform(-1, 1, (16, 1)).astype(np.float32)
        _, _, ended, infos = envs.step(action)
        roads.answer(step, seen, action, ended)
        in_force = low + (high - low) * (roads._valve._now[:, 0].numpy() + 1) / 2
        np.testing.assert_allclose(in_force, envs.envs.plant.row("damping"), atol=1e-6)
        means = low + (high - low) * (roads._places[step] + 1) / 2
        np.testing.assert_allclose(means, [info["damping"] for info in infos], atol=1e-6)
    command = torch.zeros(16, requires_grad=True)
    mean, after = roads._valve(roads._valve._now, command)
    (mean + after.sum(1)).sum().backward()
    assert float(command.grad.min()) > 0  # also through levels


@pytest.mark.parametrize("plant", ["comfort", "two masses"])
def test_the_end_of_a_stretch_is_worth_what_the_mixed_lookahead_says(plant):
    task = make_task(**{**PLANTS[plant], "observation": None})
    point = (1.5, 0.2 if plant == "comfort" else 0.0)
    found, cost = values(task, np.array([point]))
    expected, constant = (make_controller("mixed_lookahead", task, mixing=mixing).value(*point) for mixing in (0.5, 0.0))
    apart = np.abs(expected - constant).max()
    np.testing.assert_allclose(found[0], expected, atol=0.1 * apart)  # but for a constant damping that is nearly the best
    assert cost > 0


@pytest.mark.parametrize("features", [["products"], ["signals", "products", "lookahead"], ["signals"]])
def test_features_in_torch_are_those_that_the_agent_sees(features):
    task = make_task(**PLANTS["bounded"], observation=["travel", "displacement", "velocity", "level", "slope"])
    sight = Sight(task, features)
    observations = np.random.default_rng(0).uniform(0.1, 0.7, (20, 7)).astype(np.float32)
    lookahead = sight.features.lookahead
    forms = np.empty((20, 0)) if lookahead is None else lookahead.forms(observations[:, lookahead.point])
    shown = Seen(sight.features, 7)
    seen = shown(torch.from_numpy(observations), shown.of_pairs(torch.from_numpy(forms)))
    np.testing.assert_allclose(seen, sight(observations, None), rtol=1e-5, atol=1e-5)


def test_the_policy_is_even_in_the_state():
    model, _ = driven("bounded", features=["products", "lookahead"])
    sight = Sight(make_task(**PLANTS["bounded"]), ["products", "lookahead"])
    observations = np.random.default_rng(3).normal(size=(50, 6)).astype(np.float32)
    observations[:, 4:] = 0.4
    mirrored = observations * np.float32([-1, -1, -1, -1, 1, 1])
    answers = [model.predict(sight(rows, None), deterministic=True)[0] for rows in (observations, mirrored)]
    np.testing.assert_array_equal(*answers)
    assert np.ptp(answers[0]) > 0


def test_seconds_of_training_save_most_of_what_feedback_can(tmp_path):
    environment = {"road": "multiplicative", "speed": (1.0, 2.0), "bandwidth": (0.1, 0.3)}
    chosen = parameters(n_envs=64, n_steps=32, horizon=16, gradient_steps=8, features=["products"], n_timesteps=20 * 2048)
    agent = agents.train(tmp_path / "a", environment=environment, algorithm="apg", hyperparameters=chosen)
    found = evaluate({"agent": agent}, environment=environment, speeds=[1.5], bandwidths=[0.1], episodes=16)["agent"]
    assert found.mean < 0.5  # the best constant damping costs .982, the optimal feedback .227


def test_it_is_what_is_trained_where_nothing_is_chosen(tmp_path):
    agent = agents.train(tmp_path / "a", environment=PLANTS["white"], timesteps=1)
    assert [agent.description[name] for name in ("algorithm", "training_reward")] == ["apg", "gradient"]
    assert theory_given(agent).startswith("learned from the cost, differentiated through the plant")
    ideal = make_task(**PLANTS["white"])
    slow, noisy = make_task(valve={"delay": 0.2, "rate": 1.0}), make_task(sensors={"noise": 0.1})
    assert usual_algorithm(ideal, True) == usual_algorithm(ideal, False, ["module:Wrapper"]) == "ppo"
    assert usual_algorithm(slow, False) == usual_algorithm(noisy, False) == "ppo"
    assert usual_algorithm(noisy, False, (), "kalman") == "apg"
    assert usual_algorithm(make_task(valve={"delay": 0.2, "levels": 4}), False) == "apg"
    hidden, late = make_task(speed=(0.7, 3.0), observe_operating_point=False), make_task(sensors={"delay": 0.2})
    for task, chosen in ((slow, "ppo"), (hidden, "apg"), (late, "ppo")):
        assert usual_algorithm(task, False, (), "kalman") == chosen
    assert usual_algorithm(make_task(), False) == "apg"
    for field, chosen in (("valve.delay", "apg"), ("valve.rate", "ppo"), ("natural_frequency", "apg")):
        assert usual_algorithm(make_task(vary={field: [0.5, 1.0]}), False) == chosen


def test_other_wrappers_of_stable_baselines_do_not_disturb():
    envs = VecNormalize(QuarterCarVecEnv(8, environment=PLANTS["bounded"], features=["products"]), norm_obs=False)
    model = APG("MlpPolicy", envs, n_steps=8, horizon=4, gradient_steps=1, seed=1)
    model.learn(64)
    assert model.num_timesteps == 64
    assert model.policy.noise == 0.1


def test_saved_model_and_policy_predict_the_same(tmp_path):
    model, roads = driven("bounded")
    seen = roads._seen[3]
    expected = model.predict(seen, deterministic=True)[0]
    model.save(tmp_path / "model.zip")
    loaded = APG.load(tmp_path / "model.zip")
    np.testing.assert_array_equal(loaded.predict(seen, deterministic=True)[0], expected)
    model.policy.save(tmp_path / "policy.pth")
    policy = type(model.policy).load(tmp_path / "policy.pth")
    np.testing.assert_array_equal(policy.predict(seen, deterministic=True)[0], expected)
    loaded.set_env(QuarterCarVecEnv(32, environment=PLANTS["bounded"], features=["products"]))
    done, before = loaded._n_updates, loaded.predict(seen, deterministic=True)[0]
    loaded.lookahead_steps, loaded.lr_schedule = 5, lambda left: 1e-3
    loaded.learn(512, reset_num_timesteps=False)
    assert loaded._n_updates == done + 4  # one that has learned already does not begin with a lookahead once more
    assert np.abs(loaded.predict(seen, deterministic=True)[0] - before).max() > 1e-5


@pytest.mark.parametrize("total", [1, 150, 700])
def test_a_training_may_end_within_a_visit(monkeypatch, total):
    """It is driven to its end; no stretch is longer than the horizon, and the rate does not fall below zero."""
    lengths, rates = watched(monkeypatch)
    chosen = parameters(first_share=0.25, gradient_steps=1, n_timesteps=total)
    model = make_model("apg", chosen, PLANTS["bounded"], 3, None)
    model.learn(total)
    assert model.num_timesteps == 512 * -(-total // 512)
    assert lengths[-1] == 8
    assert min(rates) == 0.0


def test_a_lookahead_reaches_as_far_as_a_command_that_waits():
    late = PLANTS["slow valve"] | {"valve": {"delay": 0.4}}
    model = make_model("apg", parameters(lookahead_steps=2), late, 3, None)
    before = [weights.clone() for weights in model.policy.parameters()]
    model.learn(512)  # of one visit, whose own steps have the rate zero
    assert all((weights != own).any() for weights, own in zip(model.policy.parameters(), before, strict=True))


def test_a_second_training_begins_with_valves_that_have_been_told_nothing():
    model, roads = driven("slow valve")
    assert roads._valve._now[:, 0].max() > -1
    model.learn(512)
    assert float(model.rollout_buffer._valve._states[0][:, 0].max()) == -1.0


def test_episodes_that_end_within_what_is_driven_are_not_differentiated_through():
    envs = QuarterCarVecEnv(8, max_episode_steps=10, environment=PLANTS["bounded"], features=["products"])
    model = APG("MlpPolicy", envs, n_steps=16, horizon=8, seed=1)
    model.learn(3 * 128)
    ended = model.rollout_buffer._ended
    assert ended.any()
    for longest, expected in ((5, 5), (8, 8), (11, 8)):  # there are no longer ones here
        starts, length = model.rollout_buffer.windows(longest)
        assert length == expected
        assert len(starts) > 0
        for start in starts:
            assert not ended[start : start + length].any()


@pytest.mark.parametrize("side", [-1, 1])
def test_a_policy_that_is_all_at_one_end_of_the_range_comes_back(side):
    model, roads = driven("bounded", noise=0.0)
    with torch.no_grad():
        model.policy.network[-1].bias.fill_(30 * side)  # whose hyperbolic tangent is the end itself in single precision
    model.policy.optimizer.param_groups[0]["lr"] = 3e-3
    starts, length = roads.windows(4)
    for _ in range(300):
        model._descend(roads, starts, length, True)
    places = model.predict(roads._seen[8], deterministic=True)[0]
    assert np.ptp(places) > 0.5


def test_stretches_grow_and_become_fewer(monkeypatch):
    lengths, _ = watched(monkeypatch)
    model = make_model("apg", parameters(first_share=0.25, gradient_steps=2), PLANTS["bounded"], 3, None)
    model.learn(4 * 512)
    assert lengths == [3] * 5 + [4] * 4 + [6] * 3 + [8] * 2  # 16 intervals a visit, or nearly


def test_the_first_visit_teaches_the_lookahead_and_no_other(monkeypatch):
    """Before any stretch of many intervals the policy drives like the mixed lookahead; later visits leave that out."""
    lengths, rates = watched(monkeypatch)
    chosen = parameters(
        n_envs=128, lookahead_steps=300, gradient_steps=1, features=["products", "lookahead"], learning_rate=3e-3
    )
    model = make_model("apg", chosen, PLANTS["bounded"], 3, None)
    model.learn(2 * 2048)
    assert lengths == [1] * 300 + [8] * 2
    np.testing.assert_allclose(rates, [*np.linspace(3e-3, 1e-5, 300), 3e-3, 3e-3])

    model = make_model("apg", chosen, PLANTS["bounded"], 3, None)
    monkeypatch.setattr(model, "train", lambda: model._look_ahead(model.rollout_buffer))
    model.learn(2048)
    envs, task = QuarterCarVectorEnv(256, **PLANTS["bounded"]), make_task(**PLANTS["bounded"])
    envs.reset(seed=1)
    low, high = task.damping_range
    for _ in range(60):
        observed = envs.step(np.full((256, 1), low, np.float32))[0]
    rule = make_controller("mixed_lookahead", task).predict(observed)[0]
    place = model.predict(Sight(task, chosen["features"])(observed, None), deterministic=True)[0]
    apart = np.abs(rule - (low + (high - low) * (place + 1) / 2)) / (high - low)
    assert apart.mean() < 0.2  # of an untrained policy, at the middle of the range, .5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lookahead_steps": -1}, "lookahead_steps must be at least 0"),
        ({"horizon": 17}, "horizon must be at most n_steps, 16, got 17"),
        ({"first_share": 1.5}, "first_share must lie within"),
        ({"gradient_steps": 0}, "gradient_steps must be at least 1"),
        ({"noise": -1.0}, "noise must not be negative"),
        ({"policy_kwargs": {"features_extractor_class": "any"}}, "features_extractor_class must be left out"),
        ({"frame_stack": 2}, "frame_stack must be 1 for a gradient through the plant, got 2"),
        ({"damping_levels": 3}, "hyperparameters of apg: The algorithm only supports"),
        (
            {"wrappers": ["gymnasium.wrappers.vector:RecordEpisodeStatistics"]},
            "wrappers must be none for a gradient through the plant",
        ),
    ],
)
def test_what_cannot_be_differentiated_is_refused(changes, message):
    with pytest.raises(ParameterError, match=message):
        make_model("apg", parameters(**changes), PLANTS["bounded"], 0, None)


def test_separate_environments_are_refused():
    single = [lambda: learning(agents_env(), features=["products"])]
    with pytest.raises(ParameterError, match="env must be a QuarterCarVecEnv for a gradient through the plant"):
        APG("MlpPolicy", DummyVecEnv(single))


def agents_env():
    import gymnasium

    import roadgym

    return gymnasium.make(roadgym.ENVIRONMENT_ID, **PLANTS["bounded"])


def test_another_device_than_the_plant_s_is_refused():
    envs = QuarterCarVecEnv(8, environment=PLANTS["bounded"], features=["products"])
    with pytest.raises(ParameterError, match="device must be cpu for a gradient through the plant, got 'cuda'"):
        APG("MlpPolicy", envs, device="cuda")
