"""What makes work repeat: seeds by purpose, and packages that load what they need alone."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from agents.records import Purpose, stream_seed, training_seed


def test_seeds_of_every_purpose_stay_as_they_are():
    """Another number would drive the same seed over other roads."""
    roads = [Purpose.TRAINING, Purpose.EVALUATION, Purpose.PICTURE, Purpose.FILM]
    assert [stream_seed(7, purpose) for purpose in roads] == [stream_seed(7, number) for number in range(4)]
    assert training_seed(7, 100) == stream_seed(7, 0, 100)
    assert stream_seed(7, Purpose.EVALUATION) == 3317731564112288844
    assert len({stream_seed(seed, purpose, step) for seed in range(20) for purpose in roads for step in range(20)}) == 1600


@pytest.mark.parametrize("module", ["evaluation", "controllers", "driving", "comparison", "figures", "report"])
def test_what_does_not_learn_loads_no_learning_library(module):
    code = f"import sys, agents.{module}; print([name for name in ('torch', 'stable_baselines3') if name in sys.modules])"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said == "[]\n"


def test_classical_controllers_need_no_learning_library_on_the_command_line():
    code = "import sys, agents.cli; agents.cli.main(sys.argv[1:]); print('torch' in sys.modules)"
    asked = ["evaluate", "--controller", "skyhook", "--speeds", "9"]
    done = subprocess.run([sys.executable, "-c", code, *asked], capture_output=True, text=True, check=True)
    assert "speed must lie within the environment's range" in done.stderr
    assert done.stdout == "False\n"


def test_command_line_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "agents.cli", "cache", "--help"], capture_output=True, text=True, check=True)
    assert "example: roadgym cache --clear" in done.stdout


def test_every_package_is_installed():
    root = Path(__file__).parents[1]
    listed = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["packages"]
    found = {
        ".".join(file.parent.relative_to(root).parts)
        for name in ("roadgym", "analysis", "agents")
        for file in (root / name).rglob("*.py")
    }
    assert set(listed) >= found
