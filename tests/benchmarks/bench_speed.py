"""The cases of ``roadgym benchmark`` for pytest-benchmark, run by hand: ``pytest tests/benchmarks/bench_speed.py``."""

import gymnasium
import numpy as np
import pytest

from agents import benchmark as cases


@pytest.mark.parametrize("num_envs", [1, 64, 4096, 65536])
def test_batch_step(benchmark, num_envs):
    benchmark(cases.batch(num_envs, threads=1))


def test_cartpole_batch_step(benchmark):
    envs = gymnasium.make_vec("CartPole-v1", num_envs=4096)
    envs.reset(seed=0)
    actions = np.zeros(4096, np.int64)
    benchmark(lambda: envs.step(actions))


@pytest.mark.parametrize("substeps", [2, 34])
def test_substeps(benchmark, substeps):
    benchmark(cases.batch(4096, threads=1, substeps=substeps))


def test_normal_draws(benchmark):
    generator, buffer = np.random.default_rng(0), np.empty(4096)
    benchmark(lambda: generator.standard_normal(out=buffer))


@pytest.mark.parametrize(("identifier", "action"), [(cases.ENVIRONMENT_ID, np.array([0.3], np.float32)), ("CartPole-v1", 0)])
def test_single_step(benchmark, identifier, action):
    benchmark(cases.single(identifier, action))


@pytest.mark.parametrize("case", [name for name in cases.CASES if name not in ("vector_step", "substep", "single_step")])
def test_case(benchmark, case):
    result = benchmark.pedantic(cases.CASES[case], rounds=1)
    benchmark.extra_info.update(ratio=result.ratio, reach=result.reach)
