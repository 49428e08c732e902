"""The examples of the README run as they stand, and what they say is so."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from agents.cli import make_parser

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)

CHECK_ROAD = """
from roadgym import compiled
from roadgym.plant import Plant
from roadgym.task import make_task

# the response to two waves is the sum of the responses (3) to each, and the environment pays just that
task = make_task(road="two_frequency", speed=1.2)
plant = Plant(task, 4096)
plant.start(np.arange(4096, dtype=np.uint64))
action = np.full(4096, 0.3, np.float32)
for _ in range(200):
    plant.step(action)
cost = sum(plant.step(action).mean_squares[0].astype(float) for _ in range(400)) / 400

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
    if "iso_c" in EXAMPLES[number]:
        stated = re.findall(r"^print\(.*# ([0-9.]+)", EXAMPLES[number], re.MULTILINE)
        said = [float(line) for line in done.stdout.splitlines()[: len(stated)]]
        assert said == [pytest.approx(float(text), abs=0.51 * 0.1 ** len(text.partition(".")[2])) for text in stated]


def test_there_are_examples():
    assert len(EXAMPLES) == 3


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("[!_]*.md"))]
COMMANDS = sorted(
    {
        " ".join(line.replace("\\\n", " ").split())
        for page in PAGES
        for block in re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
        for line in block.replace("\\\n", " ").splitlines()
        if line.startswith("roadgym ")
    }
)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_of_the_documentation_are_understood(command):
    arguments = shlex.split(command, comments=True)[1:]
    if "COMMAND" not in arguments and "--version" not in arguments:
        assert make_parser().parse_args(arguments).command == arguments[0]


def test_every_command_has_an_example_that_is_understood():
    parser = make_parser()
    commands = next(action.choices for action in parser._actions if isinstance(action.choices, dict))
    assert len(commands) == 15
    for name, command in commands.items():
        example = shlex.split(command.epilog.removeprefix("example: "))
        assert example[:2] == ["roadgym", name]
        assert parser.parse_args(example[1:]).command == name
    for name, command in next(a.choices for a in commands["suite"]._actions if isinstance(a.choices, dict)).items():
        example = shlex.split(command.epilog.removeprefix("example: "))
        assert parser.parse_args(example[1:]).part == name


def test_there_are_commands():
    assert len(COMMANDS) > 15


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_what_is_linked_is_there(page):
    for link in re.findall(r"\]\(([^)]+)\)", (ROOT / page).read_text(encoding="utf-8")):
        if not link.startswith("https://"):
            file, _, heading = link.partition("#")
            assert (ROOT / file).is_file(), link
            lines = (ROOT / file).read_text(encoding="utf-8").splitlines() if heading else ()
            assert not heading or heading in {line.lstrip("# ").lower().replace(" ", "-") for line in lines if line[:1] == "#"}
