"""The search for hyperparameters: resumable, repeatable, and with a result that trains."""

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import optuna
import pytest

import agents
from agents import tuning
from agents.cli import main
from agents.errors import AgentError
from agents.training import ALGORITHMS, load_hyperparameters, make_model
from roadgym import ParameterError
from roadgym.files import locked

ENVIRONMENT = {"road": "multiplicative", "speed": [0.7, 2.0], "bandwidth": [0.1, 0.3], "damping_range": [0.5, 1.0]}
TINY = {"n_envs": 64, "features": ["signals"], "normalize": {"norm_reward": True}}


def search(path, report=tuning.silent, **options):
    """A search over small networks, with short evaluations."""
    chosen = {"trials": 3, "timesteps": 4096, "environment": ENVIRONMENT, "hyperparameters": TINY, "seed": 3}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuning, "EPISODES", 16)
        patch.setattr(tuning, "DURATION", 20.0)
        space = tuning.SEARCH_SPACES["ppo"] | {"net_arch": ["8", "8-8"], "batch_size": [256, 512], "n_epochs": [1]}
        patch.setitem(tuning.SEARCH_SPACES, "ppo", space)
        return tuning.tune(path, **chosen | options, report=report)


def trials_of(path):
    return optuna.load_study(study_name="roadgym", storage=f"sqlite:///{path}").trials


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "study.db"
    calls = []
    best = search(path, lambda *report: calls.append(report))
    return path, best, calls


def test_best_is_the_least_of_the_trials(studied):
    path, best, calls = studied
    trials = trials_of(path)
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * 3
    assert best.trials == 3
    assert best.value == min(trial.value for trial in trials) == trials[best.number].value
    assert len({trial.value for trial in trials}) == 3
    assert all(len(trial.intermediate_values) == tuning.EVALUATIONS - 1 for trial in trials)
    assert all(0.3 < trial.value < 10 for trial in trials)
    assert [call[0] for call in calls] == sorted(call[0] for call in calls)
    assert calls[-1][:3] == (2, 4096, 4096)
    assert calls[-1][3] == min(trials[0].value, trials[1].value)


def test_study_goes_on_and_repeats(studied, tmp_path):
    """An interrupted trial is marked, does not count, and changes nothing of what follows."""
    path, best, _ = studied

    def interrupt(trial, done, timesteps, so_far):
        if trial == 1 and done > 2000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search(tmp_path / "study.db", interrupt)
    # as a killed process leaves it
    storage = f"sqlite:///{tmp_path / 'study.db'}"
    optuna.load_study(study_name="roadgym", storage=storage).ask()
    again = search(tmp_path / "study.db")
    trials = trials_of(tmp_path / "study.db")
    assert [trial.state.name for trial in trials] == ["COMPLETE", "FAIL", "FAIL", "COMPLETE", "COMPLETE"]
    study = optuna.load_study(study_name="roadgym", storage=storage)
    assert [trials[k].value for k in (0, 3, 4)] == [trial.value for trial in trials_of(path)]
    assert again.hyperparameters == best.hyperparameters
    assert search(tmp_path / "study.db") == again  # nothing was left to do
    study.set_user_attr("hyperparameters", TINY | {"n_timesteps": 4096})  # as earlier versions wrote it
    assert search(tmp_path / "study.db", hyperparameters=TINY | {"training_reward": "cost"}) == again
    assert len(trials_of(tmp_path / "study.db")) == 5


def test_studies_of_something_else_are_refused(studied, tmp_path):
    path, _, _ = studied
    with pytest.raises(ParameterError, match=r"seed of the study in .* is 3, got 4: choose another place"):
        search(path, seed=4)
    with pytest.raises(ParameterError, match="hyperparameters of the study"):
        search(path, timesteps=1024)
    (tmp_path / "text.db").write_text("no database at all, but a text that is long enough to be taken for one" * 20)
    with pytest.raises(AgentError, match=r"cannot use .* as a study") as caught:
        search(tmp_path / "text.db")
    assert "\n" not in str(caught.value)


def test_study_in_use_is_refused_and_left_alone(studied, tmp_path):
    path, best, _ = studied
    shutil.copy(path, tmp_path / "study.db")
    with locked(tmp_path / ".study.db.lock"), pytest.raises(AgentError, match="is in use by another search"):
        search(tmp_path / "study.db", trials=best.trials + 1)
    assert len(trials_of(tmp_path / "study.db")) == len(trials_of(path))


OTHER = """
import sys, time
from pathlib import Path
from test_tuning import search

folder = Path(sys.argv[1])

def wait(trial, done, timesteps, best):
    (folder / "begun").touch()
    while not (folder / "go").exists():
        time.sleep(0.05)

print(search(folder, wait, trials=4, timesteps=1024))
"""


def test_processes_share_a_study_in_a_folder(tmp_path):
    """Both do some of it and end with the same best; what a killed one was at is marked and does not count."""
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = {**os.environ, "PYTHONPATH": path}
    process = [sys.executable, "-c", OTHER, str(tmp_path)]
    with subprocess.Popen(process, stdout=subprocess.PIPE, text=True, env=environment) as other:
        while not (tmp_path / "begun").exists():
            assert other.poll() is None
            time.sleep(0.05)
        backend = optuna.storages.journal.JournalFileBackend(str(tmp_path / "journal.log"))
        study = optuna.load_study(study_name="roadgym", storage=optuna.storages.journal.JournalStorage(backend))
        study.ask().set_user_attr("worker", "killed")
        best = search(tmp_path, lambda *report: (tmp_path / "go").touch(), trials=4, timesteps=1024)
        assert other.communicate()[0] == f"{best}\n"
    states = [trial.state.name for trial in study.trials]
    assert (states[1], sorted(states)) == ("FAIL", ["COMPLETE"] * 4 + ["FAIL"])
    assert len({trial.user_attrs["worker"] for trial in study.trials}) == 3
    assert len({str(trial.params) for trial in study.trials}) == 5  # no two drew the same
    assert not list(tmp_path.glob("*.worker"))


def test_best_is_a_file_that_training_takes(studied, tmp_path):
    _, best, _ = studied
    file = tmp_path / "deep" / "best.yaml"
    tuning.write_best(best, file, "roadgym tune")
    assert file.read_text().startswith(f"# The best of 3 trials: trial {best.number}")
    hyperparameters = load_hyperparameters("ppo", file)
    assert hyperparameters == best.hyperparameters
    assert hyperparameters["n_timesteps"] == 4096
    agent = agents.train(tmp_path / "agent", environment=ENVIRONMENT, hyperparameters=hyperparameters, timesteps=1024)
    assert agent.predict(np.zeros((3, 6), np.float32))[0].shape == (3, 1)


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
def test_search_spaces_are_what_the_algorithms_take(algorithm):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    base = load_hyperparameters(algorithm)
    for _ in range(3):
        chosen = tuning.draw(study.ask(), algorithm, base)
        assert chosen != base
        small = {"n_envs": 2, "features": ["signals"]} | ({"buffer_size": 100} if "buffer_size" in chosen else {})
        if "buffer_size" not in chosen and "batch_size" in chosen:
            assert base["n_envs"] * chosen["n_steps"] % chosen["batch_size"] == 0
            small["batch_size"] = 2
        model = make_model(algorithm, chosen | small, ENVIRONMENT, 0, None)
        assert model.learning_rate(1.0) == float(chosen["learning_rate"].removeprefix("lin_"))


def test_hopeless_trials_are_given_up(tmp_path, monkeypatch):
    """Every evaluation after the first trials is bad: the pruner stops those trials, and they are not the best."""
    values = iter([1.0] * 5 * tuning.EVALUATIONS + [9.0] * 20)
    monkeypatch.setattr(tuning._Objective, "value", lambda self: next(values))
    best = search(tmp_path / "study.db", trials=7, timesteps=1024)
    assert [trial.state.name for trial in trials_of(tmp_path / "study.db")] == ["COMPLETE"] * 5 + ["PRUNED"] * 2
    assert best.value == 1.0
    assert best.trials == 7


def test_trials_that_diverge_are_told(tmp_path, monkeypatch):
    def diverge(self):
        raise ValueError("not\na number")

    monkeypatch.setattr(tuning._Objective, "value", diverge)
    with pytest.raises(AgentError, match="no trial of the study was completed: not a number"):
        search(tmp_path / "study.db", trials=2, timesteps=64)
    assert [trial.state.name for trial in trials_of(tmp_path / "study.db")] == ["FAIL"] * 2


def test_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tuning, "EPISODES", 16)
    monkeypatch.setattr(tuning, "DURATION", 20.0)
    monkeypatch.setitem(tuning.SEARCH_SPACES, "ppo", {"learning_rate": (1e-4, 1e-3)})
    (tmp_path / "own.yaml").write_text("roadgym/QuarterCar-v0: {n_envs: 4, n_steps: 16, batch_size: 32, gamma: 0.9}")
    command = ["tune", "--storage", str(tmp_path / "s.db"), "--trials", "1", "--timesteps", "64", "--damping-range", "0.5", "1"]
    command += ["--hyperparameters", str(tmp_path / "own.yaml"), "--output", str(tmp_path / "best.yaml")]
    assert main(command) == 0
    told = capsys.readouterr()
    assert "best of 1 trials: trial 0" in told.out
    assert "trial 0: 64 of 64" in told.err
    assert load_hyperparameters("ppo", tmp_path / "best.yaml")["gamma"] == 0.9
    assert main([*command, "--seed", "7"]) == 2
    assert "seed of the study" in capsys.readouterr().err


def test_missing_optuna_is_told(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert main(["tune", "--storage", str(tmp_path / "s.db")]) == 2
    told = r"roadgym tune: the package optuna is not installed, which the extra tune brings: pip install -e '.*\[tune\]'\n"
    assert re.fullmatch(told, capsys.readouterr().err)
