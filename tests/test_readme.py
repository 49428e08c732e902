"""The examples of the README run as they stand, and what they say is so."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)

CHECK_ROAD = """
from roadgym import compiled
from roadgym.plant import Plant
from roadgym.task import make_task

# the response to two waves is the sum of the responses (3) to each, and the environment pays just that
task = make_task(road="two_frequency", speed=1.2)
plant = Plant(task, 4096)
everyone = np.ones(4096, np.bool_)
plant.seed(np.arange(4096, dtype=np.uint64), everyone)
plant.reset(plant.forced({}), everyone)
action = np.full(4096, 0.3, np.float32)
for _ in range(200):
    plant.step(action)
cost = sum(plant.step(action)[1][1].astype(float) for _ in range(400)) / 400

def gain(nu):
    return (1 + (0.6 * nu) ** 2) / ((1 - nu**2) ** 2 + (0.6 * nu) ** 2)

expected = (gain(1.2) + 0.25 * gain(1.2 * 1.7)) / 1.25
error = cost.std() / 64
assert abs(cost.mean() - expected) < 4 * error + 1e-3 * expected, (cost.mean(), expected, error)
assert error < 0.01 * expected
"""


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_example_runs(number, tmp_path):
    file = tmp_path / "example.py"
    file.write_text(EXAMPLES[number] + (CHECK_ROAD if "TwoFrequencyRoad" in EXAMPLES[number] else ""))
    done = subprocess.run([sys.executable, "-W", "error", file], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if "best.cost" in EXAMPLES[number]:
        predicted, driven = (float(line.split()[-1]) for line in done.stdout.splitlines())
        assert predicted == pytest.approx(0.982, abs=1e-3)
        assert driven == pytest.approx(predicted, rel=0.015)


def test_there_are_examples():
    assert len(EXAMPLES) == 2
