"""Partial information: hidden signals, stacks of observations, and recurrent policies."""

import gymnasium
import numpy as np
import pytest

import agents
import roadgym
from agents.cli import environment_from, main, make_parser
from agents.training import load_hyperparameters
from agents.vec_env import QuarterCarVecEnv, Sight
from roadgym import ParameterError
from roadgym.task import make_task, signals
from roadgym.vector import QuarterCarVectorEnv

SIGNALS = signals(roadgym.QuarterCar())
PLANT = {"road": "multiplicative", "speed": [0.7, 2.0], "bandwidth": [0.1, 0.3]}
HIDDEN = PLANT | {"observation": ["travel", "velocity"], "observe_operating_point": False}
SMALL = {"n_envs": 4, "n_timesteps": 128, "n_steps": 16, "batch_size": 32, "n_epochs": 1, "features": ["signals"]}


@pytest.mark.parametrize(
    ("chosen", "signals"),
    [
        ({}, ("displacement", "velocity", "level", "slope", "speed", "bandwidth")),
        ({"observation": ["travel"]}, ("travel", "speed", "bandwidth")),
        ({"observation": ()}, ("speed", "bandwidth")),
        ({"observe_operating_point": False}, ("displacement", "velocity", "level", "slope")),
        ({"observation": ["bandwidth", "travel"], "observe_operating_point": False}, ("bandwidth", "travel")),
    ],
)
def test_observed_signals_are_those_asked_for(chosen, signals):
    whole = gymnasium.make(roadgym.ENVIRONMENT_ID, observation=SIGNALS, **PLANT).reset(seed=5)[0]
    env = gymnasium.make(roadgym.ENVIRONMENT_ID, **PLANT, **chosen)
    observation, _ = env.reset(seed=5)
    assert env.unwrapped.signal_names == signals
    assert env.observation_space.contains(observation)
    expected = [whole[SIGNALS.index(name)] for name in signals]
    np.testing.assert_array_equal(observation, np.array(expected, np.float32))


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"observation": (), "observe_operating_point": False}, "observation must name a signal .* not observed, got ()"),
        ({"observe_operating_point": "no"}, "observe_operating_point must be true or false, got 'no'"),
        ({"observation": ["up"]}, "unknown signal 'up' on this plant; known: displacement, .*, speed, bandwidth"),
    ],
)
def test_observations_that_cannot_be(chosen, message):
    with pytest.raises(ParameterError, match=message):
        make_task(**PLANT, **chosen)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], {}),
        (["--observation", "travel", "velocity"], {"observation": ["travel", "velocity"]}),
        (["--observation"], {"observation": []}),
        (["--hide-operating-point"], {"observe_operating_point": False}),
    ],
)
def test_command_line_chooses_the_observation(options, expected):
    environment = environment_from(make_parser().parse_args(["train", "--output", "unused", *options]))
    assert {name: environment[name] for name in environment if name.startswith("obser")} == expected


def test_command_line_tells_the_signals(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    told = capsys.readouterr().out
    assert all(name in told for name in SIGNALS)


def test_stack_is_that_of_the_last_observations():
    """Against a plain loop over rows and times, with episodes that start at different times."""
    task, number, depth = make_task(**PLANT, observation=["travel", "speed", "velocity"]), 3, 4
    sight = Sight(task, None, depth)
    rng = np.random.default_rng(1)
    observations = rng.normal(size=(9, number, 4)).astype(np.float32)
    starts = rng.random((9, number)) < 0.3
    starts[0] = True
    frames = None
    for k in range(9):
        frames = sight.stack(frames, observations[k], starts[k])
        seen = sight(observations[k], frames)
        assert seen.shape == (number, *sight.space.shape) == (number, 4 + 3 * 2)
        for i in range(number):
            begin = max(np.flatnonzero(starts[: k + 1, i]))
            older = [observations[max(k - age, begin), i, [0, 2]] for age in range(1, depth)]
            np.testing.assert_array_equal(seen[i], np.concatenate([observations[k, i], *older]))


def test_features_that_show_nothing_are_refused():
    with pytest.raises(ParameterError, match=r"features must leave something to see of travel, velocity, got \['lookahead'\]"):
        Sight(make_task(**HIDDEN), ["lookahead"])


def test_training_and_answers_see_the_same_stack():
    """What the adapter of training shows equals what an agent makes of the plain environment's rows, over ends of episodes."""
    depth, limit = 3, 5
    envs = QuarterCarVecEnv(4, max_episode_steps=limit, environment=HIDDEN, features=["signals", "products"], frame_stack=depth)
    plain = QuarterCarVectorEnv(4, max_episode_steps=limit, autoreset_mode="same_step", **HIDDEN)
    sight = Sight(envs.task, ["signals", "products"], depth)
    envs.seed(7)
    seen = envs.reset()
    rows, _ = plain.reset(seed=7)
    frames, starts = None, np.ones(4, np.bool_)
    actions = np.random.default_rng(3).uniform(-1, 1, (12, 4, 1)).astype(np.float32)
    for action in actions:
        frames = sight.stack(frames, rows, starts)
        np.testing.assert_array_equal(seen, sight(rows, frames))
        seen, _, dones, infos = envs.step(action)
        rows, _, _, starts, info = plain.step(np.float32(0.05) + (action + 1) * np.float32(0.475))
        np.testing.assert_array_equal(starts, dones)
        if dones.any():
            last = np.stack(info["final_obs"])
            final = sight(last, sight.stack(frames, last, None))
            np.testing.assert_array_equal([i["terminal_observation"] for i in infos], final)


def drive(agent, rows, starts):
    """Damping ratios, shape (times, rows), of observations, shape (times, rows, signals)."""
    state, answers = None, []
    for observation, start in zip(rows, starts, strict=True):
        damping, state = agent.predict(observation, state, start)
        answers.append(damping[:, 0])
    return np.array(answers)


@pytest.fixture(scope="module", params=["frame_stack", "recurrent_ppo"])
def remembering(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent") / request.param
    if request.param == "frame_stack":
        algorithm, own = "ppo", {"policy": "MlpPolicy", "frame_stack": 3, "policy_kwargs": {"net_arch": [8]}}
    else:
        algorithm, own = request.param, {"policy": "MlpLstmPolicy", "policy_kwargs": {"lstm_hidden_size": 8, "net_arch": [8]}}
    trained = agents.train(folder, algorithm=algorithm, environment=HIDDEN, hyperparameters=SMALL | own, seed=1)
    return trained, agents.load(folder)


def test_memory_is_kept_row_by_row_and_forgotten_where_an_episode_starts(remembering):
    trained, loaded = remembering
    rows = np.random.default_rng(4).normal(size=(6, 5, 2)).astype(np.float32)
    starts = np.zeros((6, 5), np.bool_)
    starts[0] = True
    answers = drive(trained, rows, starts)
    np.testing.assert_array_equal(drive(loaded, rows, starts), answers)
    assert np.all((answers >= np.float32(0.05)) & (answers <= 1))
    # a row alone, and without telling the first start
    np.testing.assert_allclose(drive(trained, rows[:, 2:3], [None] * 6)[:, 0], answers[:, 2], rtol=1e-5)
    # another past is another answer
    other = rows.copy()
    other[3] += 1
    assert not np.allclose(drive(trained, other, starts)[4], answers[4], rtol=1e-4)
    # an episode that starts after that past does not know it
    starts[4, :3] = True
    afresh = drive(trained, rows[4:], starts[:2])
    fresh = drive(trained, other, starts)
    np.testing.assert_allclose(fresh[4:, :3], afresh[:, :3], rtol=1e-5)
    assert not np.allclose(fresh[4:, 3:], afresh[:, 3:], rtol=1e-4)


def test_agent_answers_single_observations(remembering):
    trained, _ = remembering
    row = np.array([0.3, -0.2], np.float32)
    damping, state = trained.predict(row)
    assert damping.shape == (1,)
    assert trained.predict(row + 1, state)[0].shape == (1,)


def test_agents_drive_what_they_see(remembering):
    trained, _ = remembering
    result = agents.evaluate({"agent": trained}, environment=HIDDEN, speeds=[1.0], bandwidths=[0.2], episodes=16, duration=10)
    assert 0.1 < result["agent"].mean[0] < 10


def test_empty_observation_is_a_schedule_over_the_operating_point(tmp_path):
    hyperparameters = load_hyperparameters("ppo", "ppo_scheduling") | {
        "n_envs": 4,
        "n_timesteps": 128,
        "n_steps": 16,
        "batch_size": 32,
    }
    agent = agents.train(tmp_path / "agent", environment=PLANT | {"observation": []}, hyperparameters=hyperparameters)
    assert agent.task.signals == ("speed", "bandwidth")
    assert agent.predict(np.array([[0.5, 0.2], [0.6, 0.3]], np.float32))[0].shape == (2, 1)
