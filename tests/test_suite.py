"""The suite: tasks that are frozen, references and rows that are driven again, entries, training, pages."""

import hashlib
import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import agents
from agents import pretrained
from agents.cli import main
from agents.errors import AgentError
from agents.export import export
from agents.suite import leaderboard, load_entry, references, score
from agents.suite.drivers import ZERO, driver_of, zero_of
from agents.suite.pages import write_pages
from roadgym import TASKS, ParameterError
from roadgym.task import make_task

DOCS = Path(__file__).parents[1] / "docs" / "suite"
FROZEN = {  # name: digest of all its parameters, and the sum of rewards of a short drive
    "Paper-v0": ("fc5742245e42ad11", -214.63),
    "SpeedNoise-v0": ("6495bc058d5365d6", -179.5),
    "Schedule-v0": ("c688767d2eeb435e", -45.047),
    "Comfort-v0": ("83f8c538cd1e5e6b", -385.44),
    "RoadHolding-v0": ("89338947282cd2f2", -291.2),
    "OneAccelerometer-v0": ("62bade1400ac238b", -145.33),
    "SlowValve-v0": ("11c4b00944de63d5", -447.17),
    "AnyCar-v0": ("2b1fc413d7e5ab59", -1036.4),
    "Explore-v0": ("adfeb08815dc8382", -145.33),
}
ROWS = leaderboard.read()
QUICK = ("mixed_lookahead", "skyhook", "analytic_optimum")  # the optimal feedback takes a minute where it is not kept


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_task_is_what_it_was(task):
    told = json.dumps([task.parameters, task.max_episode_steps, task.speeds, task.bandwidths, task.duration], sort_keys=True)
    envs = gymnasium.make_vec(task.id, num_envs=4)
    damping = np.full((4, 1), np.mean(make_task(**task.parameters).damping_range), np.float32)
    envs.reset(seed=7)
    total = sum(envs.step(damping)[1].sum() for _ in range(3 if task.name == "Schedule-v0" else 50))
    assert (hashlib.sha256(told.encode()).hexdigest()[:16], total) == (
        FROZEN[task.name][0],
        pytest.approx(FROZEN[task.name][1], rel=1e-3),
    )
    assert gymnasium.spec(task.id).max_episode_steps == envs.spec.kwargs["max_episode_steps"]


@pytest.mark.statistical
@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_rows_are_driven_again(task):
    """Every shipped agent, and a rule that is quickly made, save what leaderboard and references say at one operating point."""
    known = references(task)
    place = len(known.points) // 2
    middle = known.points[place]
    rows = [row for row in ROWS if row["task"] == task.name and row["origin"] is not None]
    quick = [row for rule in QUICK for row in rows if row["origin"].get("rule") == rule]
    chosen = {row["entry"]: row for row in [*quick[:1], *(row for row in rows if "agent" in row["origin"])]}
    assert len(chosen) == 2
    plant = make_task(**task.parameters)
    w1 = plant.car.natural_frequency
    driven = agents.evaluate(
        {ZERO: zero_of(task, middle.damping), **{name: driver_of(task, row["origin"]) for name, row in chosen.items()}},
        environment=task.parameters,
        speeds=[middle.point.speed],
        bandwidths=[middle.point.bandwidth],
        episodes=16,
        transient=15 / w1,
        duration=max(25 / w1, plant.control_interval),
        seed=3,
    )
    zero = driven[ZERO].adjusted_costs[0]
    for name, row in chosen.items():
        costs, told = driven[name].adjusted_costs[0], row["points"][place]
        saved = 1 - costs.mean() / zero.mean()
        error = (zero - costs - saved * zero).std(ddof=1) / zero.mean() / np.sqrt(len(zero))
        error = np.hypot(error, middle.room * (told["high"] - told["low"]) / 400)
        assert abs(saved - middle.room * told["value"] / 100) < 4 * error + 0.01, name


def test_bounds_lie_below_what_is_known():
    for task in TASKS.values():
        for point in references(task).points:
            assert point.best < point.constant + 4 * point.constant_error
            assert point.bound is None or 0 < point.bound < point.best + 4 * point.best_error


def test_an_entry_of_code_scores_as_the_rule_does_and_the_constant_scores_nothing(tmp_path):
    page = (DOCS / "index.md").read_text(encoding="utf-8")
    told, code = page.split("```json\n")[1].split("```")[0], page.split("```python\n")[3].split("```")[0]
    (tmp_path / "entry.json").write_text(told)
    (tmp_path / "entry.py").write_text(code)
    entry = load_entry(tmp_path)
    task = entry.task
    rule = agents.make_controller("skyhook", make_task(**task.parameters))
    entries = {"mine": entry.drivers, "rule": [rule], "twice": [rule, rule], "constant": [zero_of(task, 0.0)]}
    found = score(task, entries, episodes=16, speeds=[1.5], bandwidths=[0.1])
    assert found["constant"].mean.value == 0
    assert found["mine"].mean.value == pytest.approx(found["rule"].mean.value, abs=0.1)
    assert found["twice"].mean == pytest.approx(found["rule"].mean)
    row = next(row for row in ROWS if row["task"] == task.name and row["entry"] == "skyhook")
    place = [(each.point.speed, each.point.bandwidth) for each in references(task).points].index((1.5, 0.1))
    assert abs(found["rule"].mean.value - row["points"][place]["value"]) < found["rule"].mean.high - found["rule"].mean.low


def test_an_entry_of_onnx_answers_as_the_agent(tmp_path):
    agent = agents.load("roadgym/Paper-v0")
    export(agent, "onnx", tmp_path, "model")
    (tmp_path / "model.onnx").rename(tmp_path / "0.onnx")
    (tmp_path / "entry.json").write_text('{"task": "Paper-v0", "kind": "recipe", "steps": 5}')
    space = agent.task.observation_space
    space.seed(0)
    seen = np.stack([space.sample() / [5, 5, 5, 5, 1.5, 1.5] for _ in range(20)]).astype(np.float32)
    (driver,) = load_entry(tmp_path).drivers
    np.testing.assert_allclose(driver.predict(seen)[0], agent.predict(seen)[0], atol=1e-4)


@pytest.mark.parametrize(
    ("content", "code", "error"),
    [
        ("{", "", "cannot read its entry.json"),
        ('{"task": "Paper-v1", "kind": "rule"}', "", "task must be one of Paper-v0"),
        ('{"task": "Paper-v0", "kind": "magic"}', "", "kind of the entry must be one of rule, plain, recipe"),
        ('{"task": "Paper-v0", "kind": "rule", "seeds": []}', "", "seeds of the entry must be a list"),
        ('{"task": "Paper-v0", "kind": "rule"}', "", "neither a class Driver"),
        ('{"task": "Paper-v0", "kind": "rule"}', "1/0", "ZeroDivisionError"),
    ],
)
def test_a_wrong_entry_is_told_in_one_line(tmp_path, capsys, content, code, error):
    (tmp_path / "entry.json").write_text(content)
    (tmp_path / "entry.py").write_text(code)
    assert main(["suite", "score", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert error in told
    assert told.count("\n") == 1


def test_run_makes_entries_and_goes_on(tmp_path, capsys):
    command = ["suite", "run", "--tasks", "Paper-v0", "--learners", "ppo", "--timesteps", "1", "--on", "here"]
    for _ in range(2):
        assert main([*command, "--output", str(tmp_path)]) == 0
        assert capsys.readouterr().out == f"{tmp_path / 'Paper-v0' / 'ppo'}\n"
    entry = load_entry(tmp_path / "Paper-v0" / "ppo")
    assert (entry.name, entry.kind, entry.seeds, entry.steps) == ("PPO", "plain", (0,), 16384)
    assert entry.drivers[0].description["hyperparameters"]["features"] == ["signals", "products"]
    (tmp_path / "Paper-v0" / "ppo" / "entry.json").write_text('{"task": "Paper-v0", "kind": "plain", "seeds": [1]}')
    with pytest.raises(AgentError, match="has nothing that drives for seed 1"):
        load_entry(tmp_path / "Paper-v0" / "ppo")
    assert main(["suite", "run", "--learners", "nobody", "--output", str(tmp_path)]) == 2
    assert "learner must be one of own, ppo" in capsys.readouterr().err


def test_shipped_agents_are_small_and_need_no_pickle(monkeypatch):
    assert set(pretrained.names()) <= set(TASKS)
    for name in pretrained.names():
        assert pretrained.find(name).stat().st_size < 300_000
        description = pretrained.description_of(name)
        assert make_task(**description["environment"]) == make_task(**TASKS[name].parameters)
    assert pretrained.find("../Paper-v0") is None
    with pytest.raises(AgentError, match="no such folder"):
        agents.load("Paper-v9")


def test_pages_and_table_are_those_of_the_files(tmp_path, capsys):
    for file in write_pages(ROWS, tmp_path):
        assert file.read_text(encoding="utf-8") == (DOCS / file.name).read_text(encoding="utf-8"), f"{file.name}: {REMEDY}"
    assert main(["suite", "table"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80
    assert main(["suite", "table", "--tasks", "Paper-v0"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("roadgym/Paper-v0: ")
    assert "Comfort-v0" not in text
    with pytest.raises(ParameterError, match="no references"):
        references(TASKS["Paper-v0"].__class__(**{**vars(TASKS["Paper-v0"]), "name": "Other-v0"}))


REMEDY = "roadgym suite table --output docs/suite writes it anew"
