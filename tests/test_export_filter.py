"""Agents that drive by a Kalman filter, in C99: the filter is compiled with them, and tells what it tells in Python."""

import ctypes
import functools
import re
import subprocess

import numpy as np
import pytest
import torch
from test_export import CC, STRICT, by_onnx, driven, driven_both, in_python, needs_compiler, told, trained

import agents
from agents.export import export
from agents.export.filtering import estimate
from agents.export.program import Memory, given
from roadgym.kalman import KalmanFilter
from roadgym.task import make_task

RANGE = {"road": "multiplicative", "speed": [0.7, 2.0], "bandwidth": [0.1, 0.3]}
TWO = {"observation": ["travel", "acceleration"], "sensors": {"noise": 0.05}}
SLOW = {
    "noise": 0.05,
    "bias": {"travel": 0.1},
    "delay": {"travel": 0.4, "acceleration": 0.2},
    "interval": {"velocity": 0.6},
    "resolution": 0.02,
}
FIXED = {"road": "gaussian", "speed": 1.5, "bandwidth": 0.1, "observation": ["acceleration"], "sensors": {"noise": 0.05}}
CASES = {
    "over a range": ({**RANGE, **TWO}, {}),
    "one accelerometer": ({**FIXED, "observe_operating_point": False}, {}),
    "late, slow and biased sensors, a late valve of five levels": (
        {**RANGE, "observation": ["travel", "velocity", "acceleration"], "sensors": SLOW, "valve": {"delay": 0.4, "levels": 5}},
        {},
    ),
    "a bank, a late valve with limited rate and lag": (
        {
            "road": "gaussian",
            "speed": [0.7, 2.0],
            "bandwidth": 0.2,
            **TWO,
            "observe_operating_point": False,
            "valve": {"delay": 0.3, "rate": 3.0, "rise_time": 0.05, "fall_time": 0.03},
        },
        {},
    ),
    "a bank over cars that vary and speeds": (
        {
            "road": "gaussian",
            "speed": [0.7, 2.0],
            "bandwidth": 0.2,
            **TWO,
            "observe_operating_point": False,
            "vary": {"natural_frequency": [0.6, 1.4]},
        },
        {},
    ),
    "a stack, two masses, a lag": (
        {"car": "savaresi", "road": "iso_c", "speed": [15, 25], **TWO, "valve": {"fall_time": 0.005}},
        {"frame_stack": 2, "features": None},
    ),
}


COMMANDED = """
#include "agent.h"

void commanded(const float *x, const float *commands, float *d, int cars, int steps)
{
    for (int car = 0; car < cars; car++) {
        agent_state state;
        agent_init(&state);
        for (int k = car * steps; k < (car + 1) * steps; k++) {
            d[k] = agent_step(&state, x + k * AGENT_SIGNALS);
            state.commanded[0] = commands[k];
        }
    }
}
"""


def filtering(folder, environment, changes=None):
    """An agent that drives by a filter, with answers all over the range."""
    agent = trained(folder, "ppo", environment, changes={"estimator": "kalman", **(changes or {})})
    first = np.array([[0.5 * (name in ("speed", "bandwidth")) for name in agent.task.signals]], np.float32)
    seen = agent.filter.observation(agent.filter.begin(first))
    x = torch.as_tensor(agent.sight(seen, agent.sight.stack(None, seen, None)))
    agent.model.policy.action_net.bias.data -= agent.model.policy.get_distribution(x).distribution.mean[0].detach()
    return agent


@pytest.fixture(scope="module")
def filters(tmp_path_factory):
    """Agents by the name of their case."""
    return functools.cache(lambda case: filtering(tmp_path_factory.mktemp("filter") / "a", *CASES[case]))


@pytest.fixture(scope="module")
def ranging(filters):
    """An agent with two sensors over a range of operating points."""
    return filters("over a range")


def in_c(folder):
    """Answers of the agent in C, shape (cars, steps), to observations after commands that are told."""
    (folder / "commanded.c").write_text(COMMANDED)
    line = [CC, *STRICT, "-shared", "-fPIC", "-o", "commanded.so", "commanded.c", "agent.c", "-lm"]
    subprocess.run(line, cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "commanded.so"))

    def answer(observations, commands):
        x, command = (np.ascontiguousarray(each, np.float32) for each in (observations, commands))
        found = np.empty_like(command)
        library.commanded(*(ctypes.c_void_p(each.ctypes.data) for each in (x, command, found)), *found.shape)
        return found

    return answer


def by_the_agent(agent, observations, commands):
    """The same by the agent."""
    state, answers = None, []
    for x, command in zip(np.moveaxis(observations, 1, 0), commands.T, strict=True):
        damping, (frames, memory, (belief, _)) = agent.predict(x, state)
        state = frames, memory, (belief, command[:, None])
        answers.append(damping[:, 0])
    return np.stack(answers, axis=1)


@needs_compiler
@pytest.mark.parametrize("case", list(CASES))
def test_c_filters_and_answers_as_the_agent(case, filters, tmp_path):
    agent = filters(case)
    export(agent, "c", tmp_path)
    observations, high = driven(agent, 200, 16), agent.task.damping_range[1]
    # rounding may grow where an answer is both what is compared and what the filter takes to move a car that it did not move
    answers, drawn = in_python(agent, observations), np.random.default_rng(5).uniform(0, high, observations.shape[:2])
    for commands in (answers, drawn.astype(np.float32)):
        expected = by_the_agent(agent, observations, commands)
        np.testing.assert_allclose(in_c(tmp_path)(observations, commands), expected, rtol=0, atol=1e-6 * high)
        assert expected.std() > 0.03 * high
    subprocess.run([CC, *STRICT, "-o", "check", "agent_check.c", "agent.c", "-lm"], cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "check"], capture_output=True, text=True).stdout.endswith("passed\n")


@needs_compiler
@pytest.mark.parametrize(
    ("case", "points"),
    [
        ("over a range", {"speeds": [1.0, 1.5], "bandwidths": [0.2]}),
        ("a bank, a late valve with limited rate and lag", {"speeds": [1.5], "bandwidths": [0.2], "episodes": 16}),
    ],
)
def test_c_drives_by_the_filter_as_the_agent(case, points, filters, tmp_path):
    both = driven_both(filters(case), tmp_path, True, **points)
    python, c = both["python"], both["c"]
    assert np.all(np.abs(c.mean - python.mean) < 1e-4 * python.mean)
    assert np.all(np.abs(c.mean - python.mean) < 0.1 * python.standard_error)


@needs_compiler
def test_what_is_not_measured_tells_nothing(ranging, tmp_path):
    export(ranging, "c", tmp_path)
    answer, observations = in_c(tmp_path), driven(ranging, 200, 32)
    commands = in_python(ranging, observations)
    lost, expected = observations.copy(), answer(observations, commands)
    lost[:, 20:30, 1] = np.nan  # no acceleration for two seconds
    lost[:, 25:28, 0] = -np.inf
    found = answer(lost, commands)
    np.testing.assert_array_equal(found[:, :20], expected[:, :20])
    error = np.sqrt(np.mean((found - expected) ** 2, axis=0))
    assert error[27] > error[23] > 0.02
    assert error[-50:].mean() < 0.1 * error[29]
    assert np.all((found >= np.float32(0.05)) & (found <= 1))
    lost[:, :, 2:] = np.nan  # nor an operating point: D is in its range still
    found = answer(lost, commands)
    assert np.all((found >= np.float32(0.05)) & (found <= 1))


@needs_compiler
def test_the_header_tells_the_size_of_what_is_remembered(filters, tmp_path):
    agent = filters("one accelerometer")
    header = export(agent, "c", tmp_path)[0].read_text()
    text = '#include "agent.h"\nint size(void) { return (int)sizeof(agent_state); }\n'
    (tmp_path / "size.c").write_text(text)
    subprocess.run([CC, *STRICT, "-shared", "-fPIC", "-o", "size.so", "size.c"], cwd=tmp_path, check=True)
    assert ctypes.CDLL(str(tmp_path / "size.so")).size() == int(re.search(r"(\d+) bytes to remember", header)[1])
    assert "NaN counts as not measured" in header


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({**RANGE, "warm_up": 5.0}, "no polynomials of speed and bandwidth, as after a warm-up: fix both, or"),
        ({**FIXED, "vary": {"valve.delay": [0.0, 0.2]}}, "over valves that vary: vary the car alone"),
    ],
)
def test_a_filter_that_cannot_be_exported_is_told_in_one_line(changes, message):
    known = KalmanFilter(make_task(**{**changes, **TWO}))
    with pytest.raises(agents.AgentError, match=message) as caught:
        estimate(known, given("observation", (len(known.task.signals),)), Memory())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("case", list(CASES))
def test_onnx_filters_and_answers_as_the_agent(case, filters):
    pytest.importorskip("onnxruntime")
    agent = filters(case)
    observations, high = driven(agent, 40, 8), agent.task.damping_range[1]
    commands = np.random.default_rng(5).uniform(0, high, observations.shape[:2]).astype(np.float32)
    measured, seen = told(agent, observations)
    found = by_onnx(agent, measured, commanded=commands)
    np.testing.assert_allclose(found, by_the_agent(agent, seen, commands), rtol=0, atol=1e-6 * high)


def test_onnx_takes_what_is_not_measured_for_nothing(filters):
    pytest.importorskip("onnxruntime")
    agent = filters("over a range")
    observations = driven(agent, 100, 4)
    measured, _ = told(agent, observations)
    commands, lost = in_python(agent, observations), measured.copy()
    lost[:, 5, :2] = np.nan
    sound, found = by_onnx(agent, measured, commands), by_onnx(agent, lost, commands)
    np.testing.assert_array_equal(found[:, :5], sound[:, :5])
    error = np.abs(found - sound).max(axis=0)
    assert error[5] > 1e-3  # and it is forgotten
    assert error[-10:].max() < 0.1 * error[5]
