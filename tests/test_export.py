"""Exported agents: C99 that is compiled, called and driven, ONNX that a runtime runs, and the table."""

import csv
import ctypes
import dataclasses
import math
import re
import shutil
import subprocess
import types

import numpy as np
import pytest

import agents
from agents.cli import main
from agents.evaluation import drive, evaluate
from agents.export import export, file_name, tabulate
from agents.export.stages import scales_of
from agents.hyperparameters import load_hyperparameters
from agents.training import silent
from roadgym import ParameterError
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

ENVIRONMENT = {"road": "multiplicative", "speed": [0.7, 2.0], "bandwidth": [0.1, 0.3]}
HIDDEN = ENVIRONMENT | {"observation": ["travel", "velocity"], "observe_operating_point": False}
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror", "-O2")
SMALL = {
    "n_envs": 4,
    "n_timesteps": 64,
    "n_steps": 8,
    "batch_size": 16,
    "n_epochs": 1,
    "buffer_size": 500,
    "learning_starts": 32,
    "gradient_steps": 1,
}
BATCH = """
#include "agent.h"

void batch(const float *x, float *d, int cars, int steps)
{
    for (int car = 0; car < cars; car++) {
        INIT
        for (int k = car * steps; k < (car + 1) * steps; k++) d[k] = CALL;
    }
}
"""
CC = shutil.which("cc")
needs_compiler = pytest.mark.skipif(CC is None, reason="there is no C compiler")


def compiled(folder, remembers):
    """The function ``batch`` of an agent in C: answers, shape (cars, steps), to observations, shape (cars, steps, signals)."""
    init, call = ("agent_state state; agent_init(&state);", "agent_step(&state, ") if remembers else ("", "agent_damping(")
    text = BATCH.replace("INIT", init).replace("CALL", f"{call}x + k * AGENT_SIGNALS)")
    (folder / "batch.c").write_text(text)
    subprocess.run([CC, *STRICT, "-shared", "-fPIC", "-o", "batch.so", "batch.c", "agent.c", "-lm"], cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "batch.so"))

    def answer(observations):
        cars, steps, _ = observations.shape
        x, found = np.ascontiguousarray(observations, np.float32), np.empty((cars, steps), np.float32)
        library.batch(x.ctypes.data_as(ctypes.c_void_p), found.ctypes.data_as(ctypes.c_void_p), cars, steps)
        return found

    return answer


class InC:
    """An agent in C that answers cars: one damper for each."""

    def __init__(self, task, folder, header):
        self.task, self.library = task, ctypes.CDLL(str(folder / "batch.so"))
        size = re.search(r"(\d+) bytes to remember", header)
        self.size = int(size[1]) if size else 0
        self.call = self.library.agent_step if size else self.library.agent_damping
        self.call.restype = ctypes.c_float

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        found = np.empty((len(observation), 1), np.float32)
        rows = np.ascontiguousarray(observation)
        state = ctypes.create_string_buffer(self.size * len(rows)) if state is None else state
        for k, row in enumerate(rows):
            memory = [ctypes.byref(state, self.size * k)] if self.size else []
            if self.size and episode_start[k]:
                self.library.agent_init(*memory)
            found[k] = self.call(*memory, ctypes.c_void_p(row.ctypes.data))
        return found, state


def driven_both(agent, folder, remembers, **options):
    """Evaluations of an agent, in Python and in C."""
    header = export(agent, "c", folder)[0].read_text()
    compiled(folder, remembers)
    drivers = {"python": agent, "c": InC(agent.task, folder, header)}
    options = {"environment": agent.description["environment"], "duration": 60.0, "episodes": 32, "seed": 2, **options}
    return evaluate(drivers, **options)


def in_python(agent, observations):
    """The same by the agent."""
    state, begins, answers = None, np.ones(len(observations), np.bool_), []
    for x in np.moveaxis(observations, 1, 0):
        damping, state = agent.predict(x, state, begins)
        begins = np.zeros_like(begins)
        answers.append(damping[:, 0])
    return np.stack(answers, axis=1)


def driven(agent, steps=64, cars=128):
    """Observations of cars that the agent drives."""
    envs = QuarterCarVectorEnv(cars, max_episode_steps=None, threads=1, **agent.description["environment"])
    return np.stack([before for (before, *_), _ in zip(drive(agent, envs, 7, {}), range(steps), strict=False)], axis=1)


def drawn(agent, spread):
    """Observations all over their space, as no road gives them."""
    space, random = agent.task.observation_space, np.random.default_rng(1)
    shape = (128, 32, *space.shape)
    point = np.array([name in ("speed", "bandwidth") for name in agent.task.signals], bool)
    return np.where(point, random.uniform(0, 1, shape), random.uniform(-spread, spread, shape)).astype(np.float32)


def trained(folder, algorithm, environment=ENVIRONMENT, hyperparameters=None, changes=None):
    """An agent that has hardly learned, but answers with all of the range."""
    chosen = load_hyperparameters(algorithm, hyperparameters)
    chosen |= {name: value for name, value in SMALL.items() if name in chosen} | (changes or {})
    agent = agents.train(folder, algorithm=algorithm, environment=environment, hyperparameters=chosen, seed=3, report=silent)
    for name, parameter in agent.model.policy.named_parameters():
        if name.startswith("action_net"):  # which begins near zero
            parameter.data *= 100
    return agent


KINDS = {  # by name, what `trained` takes
    "apg": ("apg", ENVIRONMENT, None, {"horizon": 4}),
    "ppo": ("ppo",),
    "a2c": ("a2c",),
    "sac": ("sac",),
    "td3": ("td3",),
    "dqn": ("dqn",),
    "levels": ("ppo", ENVIRONMENT, None, {"damping_levels": 3, "features": None}),
    "plain_signals": ("ppo", ENVIRONMENT, None, {"features": None}),
    "stacked": ("ppo", HIDDEN, "ppo_stacked"),
    "stacked_point": ("ppo", ENVIRONMENT, "ppo_stacked", {"frame_stack": 2}),
    "recurrent": ("recurrent_ppo", HIDDEN),
    "two_layers": ("recurrent_ppo", ENVIRONMENT, None, {"policy_kwargs": {"lstm_hidden_size": 8, "n_lstm_layers": 2}}),
    "spread": ("sac", ENVIRONMENT, None, {"use_sde": True}),
    "squashed": ("ppo", ENVIRONMENT, None, {"use_sde": True, "policy_kwargs": {"squash_output": True, "activation_fn": "ELU"}}),
    "schedule": ("ppo", ENVIRONMENT | {"observation": []}, "ppo_scheduling"),
    "two_mass": ("ppo", {"car": "savaresi", "road": "iso_c", "speed": [15, 25]}),
}


@pytest.fixture(scope="module", params=list(KINDS))
def each(request, tmp_path_factory):
    return trained(tmp_path_factory.mktemp("agent") / "a", *KINDS[request.param])


@needs_compiler
def test_c_answers_as_the_agent(each, tmp_path):
    files = export(each, "c", tmp_path)
    assert sorted(path.name for path in files) == ["agent.c", "agent.h", "agent_check.c", "agent_vectors.h"]
    remembers = "agent_state" in files[0].read_text()
    answer = compiled(tmp_path, remembers)
    high = each.task.damping_range[1]
    assert in_python(each, driven(each)).std() > 0.01 * high
    # far out, sums of large terms of either sign leave a small one, with their rounding: of torch as of C
    for observations, rounding in ((driven(each), 1e-6), (drawn(each, 2.0), 1e-6), (drawn(each, 20.0), 5e-6)):
        expected = in_python(each, observations)
        np.testing.assert_allclose(answer(observations), expected, rtol=0, atol=rounding * high)
    subprocess.run([CC, *STRICT, "-o", "check", "agent_check.c", "agent.c", "-lm"], cwd=tmp_path, check=True)
    said = subprocess.run([tmp_path / "check"], capture_output=True, text=True)
    assert (said.returncode, said.stdout[:12]) == (0, "512 vectors,")


def told(agent, observations):
    """What is measured where these are observed, and what of it is observed in single precision."""
    scales = scales_of(agent.task).astype(np.float32)
    point = np.array([name in ("speed", "bandwidth") for name in agent.task.signals], bool)
    with np.errstate(divide="ignore"):
        measured = np.where(point, observations / (1 - observations), observations).astype(np.float32) * scales
    seen = measured / scales
    return measured, np.where(point, seen / (np.where(point, seen, 0) + np.float32(1)), seen)


def by_onnx(agent, measured, commanded=None):
    """Answers of the agent as ONNX, shape (cars, steps), where what was ``commanded`` may be another one."""
    import onnxruntime

    from agents.export.onnx_graph import onnx_file

    session = onnxruntime.InferenceSession(onnx_file(agent, "agent"))
    assert session.get_modelmeta().custom_metadata_map["signals"].split() == list(agent.task.signals)
    kinds, found = {"tensor(float)": np.float32, "tensor(double)": np.float64}, []
    inputs, names = session.get_inputs()[2:], [value.name.removeprefix("next_") for value in session.get_outputs()[1:]]
    handed = {value.name: np.zeros((len(measured), *value.shape[1:]), kinds[value.type]) for value in inputs}
    for step in range(measured.shape[1]):
        begins = {"begins": np.full((len(measured), 1), step == 0)} if inputs else {}
        damping, *kept = session.run(None, {"measured": measured[:, step], **begins, **handed})
        handed = dict(zip(names, kept, strict=True))
        if commanded is not None:
            handed["commanded"] = commanded[:, step]
        found.append(damping[:, 0])
    return np.stack(found, axis=1)


def test_onnx_answers_as_the_agent(each):
    pytest.importorskip("onnxruntime")
    measured, seen = told(each, np.concatenate([driven(each)[:, :32], drawn(each, 2.0)]))
    high = each.task.damping_range[1]
    np.testing.assert_allclose(by_onnx(each, measured), in_python(each, seen), rtol=0, atol=1e-6 * high)


@pytest.fixture(scope="module")
def ppo(tmp_path_factory):
    """The folder of an agent, and the agent."""
    folder = tmp_path_factory.mktemp("agent") / "ppo"
    return folder, trained(folder, "ppo", changes={"features": ["signals", "products"]})


@needs_compiler
@pytest.mark.parametrize("kind", ["ppo", "recurrent"])
def test_c_drives_as_the_agent(kind, tmp_path):
    """In the plant, where each answer moves the next observation."""
    agent = trained(tmp_path / "a", *KINDS[kind])
    both = driven_both(agent, tmp_path, kind == "recurrent", speeds=[1.5], bandwidths=[0.1, 0.3], transient=20.0)
    python, c = both["python"], both["c"]
    assert np.all(np.abs(c.mean - python.mean) < 1e-4 * python.mean)
    assert np.all(np.abs(c.mean - python.mean) < python.standard_error)
    assert python.costs.std() > 0.01 * python.mean.min()


@needs_compiler
@pytest.mark.parametrize(
    ("environment", "unit"),
    [
        ({"car": "savaresi", "road": "iso_c", "speed": [15, 25]}, "m/s"),  # a car that is told in SI units
        ({"road": {"kind": "gaussian", "wavenumber": 2.0}, "natural_frequency": 3.0, "speed": [0.7, 2.0]}, "m"),
    ],
)
def test_observations_are_made_of_what_is_measured(environment, unit, tmp_path):
    agent = trained(tmp_path / "a", "ppo", environment, changes={"features": ["signals", "products"]})
    header = export(agent, "c", tmp_path)[0].read_text()
    compiled(tmp_path, remembers=False)
    library = ctypes.CDLL(str(tmp_path / "batch.so"))
    task = agent.task
    assert re.search(rf"^ \*   velocity +{unit} +\S+$", header, re.M)
    assert ("a velocity is one in m/s over 3 rad/s" in header) == (unit == "m")
    assert (f"times {task.car.damping_unit or 0:.9g} is the damping coefficient in N s/m" in header) == (unit == "m/s")
    assert f"once every {task.control_interval:g} s" in header
    seen = driven(agent)[:, -1]
    measured = (seen * task.signal_scale).astype(np.float32)
    for k, name in enumerate(task.signals):
        if name == "speed":
            measured[:, k] = seen[:, k] / (1 - seen[:, k]) * task.car.natural_frequency / task.road.wavenumber
        elif name == "bandwidth":
            measured[:, k] = seen[:, k] / (1 - seen[:, k]) / 2
        elif name == "slope":
            measured[:, k] *= task.road.wavenumber  # dZ/ds
    found = np.empty_like(measured)
    for x, y in zip(measured, found, strict=True):
        library.agent_observe(ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(y.ctypes.data))
    np.testing.assert_allclose(found, seen, rtol=1e-6, atol=1e-7)
    speeds = measured[:, task.signals.index("speed")]
    assert task.speed[0] * 0.999 < speeds.min() < speeds.max() < task.speed[1] * 1.001


@needs_compiler
@pytest.mark.parametrize("kind", ["plain_signals", "squashed"])
def test_damping_lies_in_the_range_whatever_is_seen(kind, tmp_path):
    export(trained(tmp_path / "a", *KINDS[kind]), "c", tmp_path)
    answer = compiled(tmp_path, remembers=False)
    bad = [math.nan, math.inf, -math.inf, 3e38, -3e38, 0.0, 1.0]
    observations = np.random.default_rng(3).choice(bad, (500, 1, 6)).astype(np.float32)
    damping = answer(observations)
    assert np.all((damping >= np.float32(0.05)) & (damping <= 1))
    if kind == "squashed":  # through which no number stays none, to the end
        assert answer(np.full((1, 1, 6), np.nan))[0, 0] == np.float32(0.05)


@needs_compiler
@pytest.mark.skipif(shutil.which("nm") is None, reason="there is no nm")
def test_c_has_no_global_and_calls_mathematics_alone(tmp_path):
    export(trained(tmp_path / "a", *KINDS["recurrent"]), "c", tmp_path)
    subprocess.run([CC, *STRICT, "-c", "agent.c"], cwd=tmp_path, check=True)
    said = subprocess.run(["nm", "-P", "agent.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    symbols = [line.split()[:2] for line in said.splitlines()]
    assert {kind for _, kind in symbols} <= {"T", "t", "r", "R", "U"}  # functions, constants and what is called
    assert {name for name, kind in symbols if kind == "U"} <= {"expf", "tanhf", "expm1f", "sqrtf", "_GLOBAL_OFFSET_TABLE_"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "c", "--output", "nowhere"], "cannot write to 'nowhere': no such folder"),
        (["--to", "c", "--name", "9 lives"], "name must be letters, digits and underscores, a letter first, got '9 lives'"),
        (["--to", "onnx", "--signals", "travel", "velocity"], "--signals cannot be given with --to onnx, .*"),
        (["--to", "c", "--episodes", "64"], "--episodes cannot be given with --to c, which evaluates nothing"),
        (["--to", "table", "--signals", "travel", "sound"], "signals must be two of displacement, .*, got travel, sound"),
        (["--to", "table", "--signals", "travel", "travel"], "signals must be two of displacement, .*, got travel, travel"),
        (["--to", "table", "--speeds", "9"], "speed must lie within .*, got 9"),
        (["--to", "c", "--name", "there"], "'there.h' is there already: choose another folder or another name"),
    ],
)
def test_bad_input_is_told_in_one_line(arguments, message, ppo, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.h").write_text("mine")
    assert main(["export", "--agent", str(ppo[0]), *arguments]) == 2
    assert re.fullmatch(f"roadgym export: {message}\n", capsys.readouterr().err)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_what_cannot_be_exported_is_told_in_one_line(ppo, tmp_path):
    _, agent = ppo
    wrapped = types.SimpleNamespace(**{**vars(agent), "layers": [object()]})
    with pytest.raises(agents.AgentError, match="whose wrapper changes actions"):
        export(wrapped, "c", tmp_path)
    other = types.SimpleNamespace(**{**vars(agent), "description": agent.description | {"algorithm": "own"}})
    with pytest.raises(agents.AgentError, match="cannot export an agent of 'own': known are apg, ppo, "):
        export(other, "onnx", tmp_path)
    odd = trained(tmp_path / "odd", "ppo", changes={"policy_kwargs": {"net_arch": [8], "activation_fn": "Softsign"}})
    with pytest.raises(agents.AgentError, match=r"cannot export a policy with a Softsign: known are .*, ReLU"):
        export(odd, "c", tmp_path)
    with pytest.raises(ParameterError, match="to must be one of c, onnx, table, got 'rust'"):
        export(agent, "rust", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["odd"]


def test_files_are_written_together_or_not_at_all(ppo, tmp_path, monkeypatch, capsys):
    written = []

    def stop(path):
        written.append(path)
        if len(written) > 2:
            raise OSError("the disk is full")

    monkeypatch.setattr("roadgym.files.sync", stop)
    assert main(["export", "--agent", str(ppo[0]), "--to", "c", "--output", str(tmp_path)]) == 2
    assert "the disk is full" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_names_are_those_of_the_folder(ppo, tmp_path, capsys):
    assert main(["export", "--agent", str(ppo[0]), "--to", "c", "--output", str(tmp_path)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert [line.rpartition("/")[2] for line in said] == ["ppo.h", "ppo.c", "ppo_check.c", "ppo_vectors.h"]
    assert "float ppo_damping(" in (tmp_path / "ppo.h").read_text()
    assert [file_name(text) for text in ("agent-0", "3 cars", "über")] == ["agent_0", "agent_3_cars", "ber"]


@pytest.fixture(scope="module")
def skyhook():
    """What is known: the damping of skyhook is a function of two signals."""
    task = make_task(**ENVIRONMENT)
    rule = agents.make_controller("skyhook", task)
    agent = types.SimpleNamespace(task=task, description={"environment": ENVIRONMENT}, predict=rule.predict)
    return tabulate(agent, speeds=[1.0, 1.5], bandwidths=[0.1, 0.3], episodes=32)


def test_table_finds_the_signals_and_loses_little(skyhook):
    assert skyhook.table.task.signals == ("velocity", "relative_velocity", "speed")
    assert skyhook.explained > 0.8
    assert 0.97 < skyhook.loss.low < skyhook.loss.value < skyhook.loss.high < 1.03
    table = skyhook.table
    firm = table.damping[:, :4, :4], table.damping[:, -4:, -4:]
    soft = table.damping[:, :4, -4:], table.damping[:, -4:, :4]
    assert min(part.min() for part in firm) > 0.9
    assert max(part.max() for part in soft) < 0.15
    np.testing.assert_allclose(table.damping, table.damping[:, ::-1, ::-1], atol=1e-6)  # of the mirrored car the same
    one = dataclasses.replace(table, damping=np.full((2, 1, 1), 0.6))
    np.testing.assert_allclose(one.sharpened([1.0, 3.0]).damping.ravel(), [0.6, 0.525 + 3 * 0.075])


@needs_compiler
@pytest.mark.parametrize("speeds", [[1.5], [1.0, 1.3, 1.5]])
def test_table_in_c_and_csv_is_the_one_that_drove(speeds, skyhook, tmp_path):
    table = skyhook.table
    places = np.array([task_share(table.task, speed) for speed in speeds])
    random = np.random.default_rng(4)
    table = dataclasses.replace(table, shares=places, damping=random.uniform(0.05, 1, (len(speeds), 15, 15)))
    files = export(dataclasses.replace(skyhook, table=table), "table", tmp_path, "own")
    assert [path.name for path in files] == ["own_table.csv", "own_table.h", "own_table.c"]
    subprocess.run([CC, *STRICT, "-shared", "-fPIC", "-o", "t.so", "own_table.c", "-lm"], cwd=tmp_path, check=True)
    look_up = ctypes.CDLL(str(tmp_path / "t.so")).own_table
    look_up.restype, look_up.argtypes = ctypes.c_float, [ctypes.c_float] * (2 + (len(speeds) > 1))
    speed = random.uniform(0.5, 2.0, 500)
    seen = np.column_stack([random.normal(0, 1.5, (500, 2)), task_share(table.task, speed)])
    scale = table.task.signal_scale[:2]
    found = [look_up(*(x[:2] * scale), *([v] if len(speeds) > 1 else [])) for x, v in zip(seen, speed, strict=True)]
    np.testing.assert_allclose(found, table.predict(seen)[0][:, 0], atol=2e-5)
    rows = list(csv.reader((tmp_path / "own_table.csv").read_text().splitlines()))
    assert rows[0] == ["speed m/s", "velocity m", "relative_velocity m", "damping ratio"]
    at = np.array(rows[1:], float)[random.integers(0, len(rows) - 1, 50)]
    exact = np.column_stack([at[:, 1:3] / scale, task_share(table.task, at[:, 0])])
    np.testing.assert_allclose(table.predict(exact)[0][:, 0], at[:, 3], atol=1e-5)


def task_share(task, speed):
    """The speed as it is observed."""
    ratio = task.frequency_ratio(speed)
    return ratio / (1 + ratio)


def test_table_command_tells_what_it_costs(ppo, tmp_path, capsys):
    options = ["--to", "table", "--output", str(tmp_path), "--speeds", "1.5", "--bandwidths", "0.1", "--episodes", "16"]
    assert main(["export", "--agent", str(ppo[0]), *options, "--signals", "travel", "velocity"]) == 0
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= 80
    assert re.match(r"travel and velocity explain \d+ % of the variance of the agent's damping;\s+sharpened\s+by", said)
    assert re.search(r"^ +1\.5 +0\.1 +0\.98\d+ +\S+\(\d+\) +\S+\(\d+\) +\S+ \(\S+ to \S+\)$", said, re.M)
    assert re.search(r"the table costs \S+ \(\S+ to \S+\) of the agent's costs, on average\n$", said)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ppo_table.c", "ppo_table.csv", "ppo_table.h"]
