"""The batch environment: equal to the single one, whatever its size, its threads and its autoreset mode."""

import copy
import pickle
import threading

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as wrappers
from packaging.version import Version
from plants import EVERY_PLANT, plant_name

import analysis
import roadgym
from agents.wrappers import learning
from roadgym import ParameterError
from roadgym.record import STREAMED
from roadgym.vector import QuarterCarVectorEnv

ID = roadgym.ENVIRONMENT_ID
RANGES = {"speed": (0.7, 2.0)}
every_plant = pytest.mark.parametrize("plant", EVERY_PLANT, ids=plant_name)


def actions_for(n, steps):
    return np.random.default_rng(8).uniform(0.05, 1.0, (steps, n, 1)).astype(np.float32)


@pytest.mark.parametrize(("precision", "threads"), [("float32", 1), ("float32", 2), ("float64", 2)])
def test_large_batches_tell_the_same_and_what_they_told_stays(precision, threads):
    """Beyond `STREAMED` environments infos are written past the caches; 65 of them are no whole block."""
    plant = {"road": "gaussian", "valve": {"delay": 0.1}, "precision": precision, **RANGES}
    n = STREAMED + 65
    envs = QuarterCarVectorEnv(n, threads=threads, max_episode_steps=3, **plant)
    told, copies = [], []
    actions = np.random.default_rng(8).uniform(0.05, 1.0, (9, n, 1)).astype(np.float32)
    for action in [None, *actions]:  # more than are kept to be used again
        told.append(envs.reset(seed=5)[1] if action is None else envs.step(action)[4])
        copies.append({name: row.copy() for name, row in told[-1].items()})
    del envs
    for i in (0, 63, 64, n // 2, STREAMED - 1, STREAMED, n - 1):
        single = QuarterCarVectorEnv(1, max_episode_steps=3, **plant)
        alone = [single.reset(seed=5 + i)[1], *(single.step(action[i : i + 1])[4] for action in actions)]
        for info, copied, own in zip(told, copies, alone, strict=True):
            assert {name: info[name][i] for name in info} == {name: own[name][0] for name in own}
            assert all((info[name] == copied[name]).all() for name in info)


@every_plant
def test_environment_i_equals_the_single_one_with_seed_plus_i(plant):
    n, steps, limit = 70, 25, 10
    envs = gymnasium.make_vec(ID, num_envs=n, max_episode_steps=limit, **plant, **RANGES)
    observations, infos = envs.reset(seed=100)
    actions = actions_for(n, steps)
    batch = [envs.step(a) for a in actions]
    for i in (0, 1, 63, 64, 69):
        env = gymnasium.make(ID, max_episode_steps=limit, **plant, **RANGES)
        observation, info = env.reset(seed=100 + i)
        np.testing.assert_array_equal(observation, observations[i])
        assert info == {name: infos[name][i] for name in info}
        over = False
        for (obs, rewards, terminated, truncated, infos_now), action in zip(batch, actions, strict=True):
            if over:
                observation, info = env.reset()
                reward, over = 0.0, False
            else:
                observation, reward, _, over, info = env.step(action[i])
            assert info == {name: infos_now[name][i] for name in info}
            np.testing.assert_array_equal(observation, obs[i])
            assert reward == rewards[i]
            assert truncated[i] == over
            assert not terminated[i]


def test_results_do_not_depend_on_batch_size_or_threads():
    small, large = QuarterCarVectorEnv(5, **RANGES), QuarterCarVectorEnv(5000, threads=1, **RANGES)
    threaded = QuarterCarVectorEnv(5000, threads=2, **RANGES)
    assert threaded.plant.threads == 2
    for envs in (small, large, threaded):
        envs.reset(seed=7)
    for action in actions_for(5000, 5):
        results = [envs.step(action[: envs.num_envs]) for envs in (small, large, threaded)]
        np.testing.assert_array_equal(results[0][0], results[1][0][:5])
        np.testing.assert_array_equal(results[1][0], results[2][0])
        np.testing.assert_array_equal(results[1][1], results[2][1])


def test_one_pool_serves_every_number_of_threads():
    def count():
        return sum(thread.name.startswith("roadgym") for thread in threading.enumerate())

    before = count()
    for threads in range(2, 13):
        envs = QuarterCarVectorEnv(12 * 32 * 64, threads=threads)
        assert envs.plant.threads == threads
        envs.reset(seed=0)
    assert count() <= max(before, 11)


def test_same_step_gives_the_final_observation_and_next_step_the_same_episodes():
    n, limit, steps = 6, 7, 30
    options = {"max_episode_steps": limit, **RANGES}
    same = QuarterCarVectorEnv(n, autoreset_mode="SameStep", **options)
    nxt = QuarterCarVectorEnv(n, autoreset_mode=AutoresetMode.NEXT_STEP, **options)
    assert same.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    np.testing.assert_array_equal(same.reset(seed=3)[0], nxt.reset(seed=3)[0])
    action = np.full((n, 1), 0.3, np.float32)
    for _ in range(steps // limit):
        for k in range(limit):
            a, b = same.step(action), nxt.step(action)
            np.testing.assert_array_equal(a[1], b[1])
            assert a[3].all() == b[3].all() == (k == limit - 1)
            if k < limit - 1:
                np.testing.assert_array_equal(a[0], b[0])
        np.testing.assert_array_equal(np.stack(a[4]["final_obs"]), b[0])
        assert a[4]["_final_obs"].all()
        np.testing.assert_array_equal(a[4]["final_info"]["displacement"], b[4]["displacement"])
        observations, rewards, _, truncated, _ = nxt.step(np.full((n, 1), 0.9, np.float32))  # ignored: a reset
        np.testing.assert_array_equal(observations, a[0])
        assert not rewards.any()
        assert not truncated.any()


def test_disabled_mode_resets_what_the_mask_says():
    envs = QuarterCarVectorEnv(4, autoreset_mode="disabled", max_episode_steps=3, **RANGES)
    envs.reset(seed=1)
    action = np.full((4, 1), 0.3, np.float32)
    for _ in range(3):
        before, _, _, truncated, _ = envs.step(action)
    assert truncated.all()
    mask = np.array([True, False, True, False])
    after, info = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], before[~mask])
    assert not np.any(after[mask, 0] == before[mask, 0])
    np.testing.assert_array_equal(info["_speed"], mask)
    np.testing.assert_array_equal(envs.step(action)[3], ~mask)


@pytest.mark.parametrize("limit", [None, -1])
def test_no_time_limit(limit):
    envs = gymnasium.make_vec(ID, num_envs=2, max_episode_steps=limit, control_interval=0.01)
    envs.reset(seed=0)
    action = np.full((2, 1), 0.3, np.float32)
    assert not any(envs.step(action)[3].any() for _ in range(1100))


def test_registered_time_limit():
    envs = gymnasium.make_vec(ID, num_envs=2)
    envs.reset(seed=0)
    action = np.full((2, 1), 0.3, np.float32)
    assert [bool(envs.step(action)[3].all()) for _ in range(501)] == [False] * 499 + [True, False]


@every_plant
def test_infos_tell_the_same_at_a_reset_as_after_a_step(plant):
    """As recorders want it: Minari stacks them."""
    env, envs = gymnasium.make(ID, warm_up=1.0, **plant), gymnasium.make_vec(ID, 3, warm_up=1.0, **plant)
    began, drove = env.reset(seed=1)[1], env.step(np.array([0.3], np.float32))[4]
    assert list(began) == list(drove)
    assert {type(number) for number in (*began.values(), *drove.values())} == {float}
    assert {name: began[name] for name in (*roadgym.MEAN_SQUARES, "damping")} == dict.fromkeys(
        (*roadgym.MEAN_SQUARES, "damping"), 0.0
    )
    all_began, all_drove = envs.reset(seed=1)[1], envs.step(np.full((3, 1), 0.3, np.float32))[4]
    assert list(all_began) == list(all_drove)
    for infos in (all_began, all_drove):
        for name in began:
            assert infos[name].dtype == np.float64
            assert infos[name].shape == infos["_" + name].shape == (3,)


def test_seeds_may_be_a_list_and_options_may_differ():
    envs = QuarterCarVectorEnv(3, **RANGES)
    by_list, _ = envs.reset(seed=[5, 6, 7])
    np.testing.assert_array_equal(by_list, envs.reset(seed=5)[0])
    _, info = envs.reset(options={"speed": [0.8, 1.0, 1.9]})
    assert info["speed"] == pytest.approx([0.8, 1.0, 1.9])
    drawn = envs.reset(seed=5)[1]["speed"]
    _, info = envs.reset(seed=5, options={"speed": [0.8, None, 1.9], "bandwidth": None})
    assert info["speed"].tolist() == pytest.approx([0.8, drawn[1], 1.9])
    with pytest.raises(ParameterError, match="option 'speed' must be a number or 3 numbers"):
        envs.reset(options={"speed": [0.8, 1.0]})
    with pytest.raises(ParameterError, match="seed must be one integer or 3 of them"):
        envs.reset(seed=[1, 2])


def test_copies_go_on_alike():
    envs = QuarterCarVectorEnv(5, **RANGES)
    envs.reset(seed=2)
    copies = [copy.deepcopy(envs), pickle.loads(pickle.dumps(envs))]
    action = np.full((5, 1), 0.3, np.float32)
    expected = envs.step(action)
    for other in copies:
        np.testing.assert_array_equal(other.step(action)[0], expected[0])


def test_bad_actions_are_refused_before_anything_moves():
    envs, untouched = QuarterCarVectorEnv(3), QuarterCarVectorEnv(3)
    for e in (envs, untouched):
        e.reset(seed=2)
    good = np.full((3, 1), 0.3, np.float32)
    bad = good.copy()
    bad[1] = np.nan
    with pytest.raises(ParameterError, match="actions must be finite, got nan"):
        envs.step(bad)
    with pytest.raises(ParameterError, match=r"actions must have the shape \(3, 1\), got \(3,\)"):
        envs.step(good[:, 0])
    np.testing.assert_array_equal(envs.step(good)[0], untouched.step(good)[0])


def test_returned_arrays_are_the_users():
    envs = QuarterCarVectorEnv(3)
    envs.reset(seed=2)
    action = np.full((3, 1), 0.3, np.float32)
    first = envs.step(action)
    kept = first[0].copy(), first[1].copy(), first[4]["travel"].copy()
    envs.step(action)
    np.testing.assert_array_equal(first[0], kept[0])
    np.testing.assert_array_equal(first[1], kept[1])
    np.testing.assert_array_equal(first[4]["travel"], kept[2])


def make_single():
    return gymnasium.make(ID, **RANGES)


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_gymnasiums_own_vector_environments_agree(context):
    # the batch has used its threads in this process before workers are forked from it
    warm = QuarterCarVectorEnv(5000, threads=2)
    warm.reset(seed=0)
    warm.step(np.full((5000, 1), 0.3, np.float32))

    native = gymnasium.make_vec(ID, num_envs=3, **RANGES)
    others = [SyncVectorEnv([make_single] * 3), AsyncVectorEnv([make_single] * 3, context=context)]
    try:
        expected = native.reset(seed=21)[0]
        for other in others:
            np.testing.assert_array_equal(other.reset(seed=21)[0], expected)
        for action in actions_for(3, 4):
            expected = native.step(action)
            for other in others:
                found = other.step(action)
                np.testing.assert_array_equal(found[0], expected[0])
                np.testing.assert_allclose(found[1], expected[1], rtol=1e-7)
    finally:
        for other in others:
            other.close()


@pytest.mark.skipif(Version(gymnasium.__version__) < Version("1.2.2"), reason="its DictInfoToList fails, on CartPole too")
def test_vector_wrappers_work():
    envs = gymnasium.make_vec(ID, num_envs=4, max_episode_steps=5, **RANGES)
    envs = wrappers.RecordEpisodeStatistics(envs)
    envs = wrappers.NormalizeReward(envs)
    envs = wrappers.NormalizeObservation(envs)
    envs = wrappers.RescaleAction(envs, np.float32(-1), np.float32(1))
    envs = wrappers.DictInfoToList(envs)
    envs.reset(seed=1)
    for _ in range(5):
        *_, truncated, infos = envs.step(np.zeros((4, 1), np.float32))
    assert truncated.all()
    assert all(info["episode"]["l"] == 5 for info in infos)
    assert all(info["damping"] == pytest.approx(0.525) for info in infos)


# On random roads low-pass noise on the speed leaves no closed form.
WITH_THEORY = [plant for plant in EVERY_PLANT if plant["road"] == "harmonic" or plant["speed_noise"] is None]


@pytest.mark.statistical
@pytest.mark.parametrize("plant", WITH_THEORY, ids=plant_name)
def test_theory_holds_inside_the_environment(plant):
    """At the optimal constant damping the environment pays what theory says: standard error below 0.3 %, within 4 of them."""
    weights, bounds, speed = {"displacement": 1.0, "travel": 0.3}, (0.05, 1.0), 1.2
    n, skipped, steps = 20_000, 100, 400
    envs = gymnasium.make_vec(ID, num_envs=n, max_episode_steps=-1, reward=weights, speed=speed, damping_range=bounds, **plant)
    task = envs.unwrapped.task
    best = analysis.optimal_damping(task.road, task.speed_noise, speed=speed, weights=weights, bounds=bounds)
    damping = np.float32(best.damping)
    theory = analysis.mean_squares(task.road, task.speed_noise, damping=float(damping), speed=speed)
    expected = sum(w * float(getattr(theory, name)) for name, w in weights.items()) / task.road.variance
    assert expected == pytest.approx(best.cost, rel=1e-6)
    envs.reset(seed=17)
    action = np.full((n, 1), damping)
    for _ in range(skipped):
        envs.step(action)
    cost = -sum(envs.step(action)[1].astype(float) for _ in range(steps)) / steps
    error = cost.std(ddof=1) / np.sqrt(n)
    assert error < 0.003 * expected
    assert abs(cost.mean() - expected) < 4 * error


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"num_envs": 2, "autoreset_mode": "sometimes"}, "autoreset_mode must be one of"),
        ({"num_envs": 2, "max_episode_steps": 0.5}, "max_episode_steps must be an integer"),
        ({"num_envs": 2, "threads": 0}, "threads must be at least 1"),
    ],
)
def test_bad_parameters_are_refused_by_name(parameters, message):
    with pytest.raises(ParameterError, match=message):
        QuarterCarVectorEnv(**parameters)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_the_autoreset_mode_is_an_attribute(mode):
    """Where TorchRL looks for it, as in Gymnasium's own vector environments."""
    envs = gymnasium.make_vec(ID, 2, autoreset_mode=mode.name)
    assert envs.autoreset_mode is envs.metadata["autoreset_mode"] is learning(envs).autoreset_mode is mode
