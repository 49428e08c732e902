"""A plain installation does its part and names what it lacks; who has taken the names `agents` and `analysis` is named too."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from agents import training

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = {  # what each brings, by the names that are imported
    "train": ("torch", "stable_baselines3", "tensorboard", "yaml", "rich"),
    "report": ("matplotlib", "jinja2", "yaml"),
    "render": ("pygame", "PIL", "imageio_ffmpeg"),
    "tune": ("optuna",),
    "recurrent": ("sb3_contrib",),
    "onnx": ("onnx",),
    "bounds": ("threadpoolctl",),
}
PLAIN = f"""
import sys

class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name in {sorted({package for packages in EXTRAS.values() for package in packages})}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, NotInstalled())
"""


def python(*arguments, path=ROOT, cwd=None):
    """A new process of Python, without any editable install, that finds roadgym in the folder ``path``."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(path), sysconfig.get_path("purelib")))}
    command = [sys.executable, "-S", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=cwd)


def plain(code, *arguments):
    """Run code where no extra is installed."""
    return python("-c", PLAIN + code, *arguments)


def command(*arguments):
    """Run a command where no extra is installed."""
    return plain("from roadgym.__main__ import main; sys.exit(main())", *arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        ("evaluate", "--controller", "skyhook", "--speeds", "1.5", "--bandwidths", "0.1", "--episodes", "16"),
        ("certify", "--lanes", "4096"),
        ("explore", "--output", "FOLDER/explorer.html"),
        ("errata", "--only", "forcing"),
        ("cache",),
        ("train", "--help"),
        ("--version",),
    ],
    ids=lambda arguments: arguments[0],
)
def test_plain_installation_suffices(arguments, tmp_path):
    done = command(*(argument.replace("FOLDER", str(tmp_path)) for argument in arguments))
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_environment_and_theory_need_no_extra():
    code = """
import gymnasium, roadgym, analysis, agents
envs = gymnasium.make_vec("roadgym/QuarterCar-v0", num_envs=2, road="gaussian")
envs.reset(seed=1)
envs.step(envs.action_space.sample())
print(analysis.optimal_damping("multiplicative", speed=1.5).cost, sorted(agents.CONTROLLERS)[0])
"""
    done = plain(code)
    assert done.stdout.startswith("0.982"), done.stderr


def test_progress_without_rich_is_told_in_lines():
    code = """
sys.stderr.isatty = lambda: True
from agents.progress import work_progress
with work_progress() as report:
    report("driving", 2, 4)
    report("driving", 4, 4)
"""
    assert plain(code).stderr == "driving: 4 of 4\n"  # what goes fast is told at its end alone


@pytest.fixture(scope="module")
def agent(tmp_path_factory):
    """The folder of an agent that has hardly learned."""
    folder = tmp_path_factory.mktemp("agents") / "agent"
    training.train(
        folder, environment={"road": "gaussian"}, hyperparameters={"n_envs": 2, "n_steps": 8, "batch_size": 16}, timesteps=16
    )
    return folder


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (("train", "--output", "OUT"), "train"),
        (("tune", "--storage", "OUT.db"), "train"),
        (("compare", "--output", "OUT"), "train"),
        (("evaluate", "--agent", "AGENT"), "train"),
        (("compare", "--agent", "AGENT", "--output", "OUT"), "train"),
        (("drive", "--agent", "AGENT", "--output", "OUT.gif"), "train"),
        (("export", "--agent", "AGENT", "--to", "c"), "train"),
        (("drive", "--controller", "skyhook"), "render"),
        (("drive", "--controller", "skyhook", "--output", "OUT.mp4"), "render"),
        (("drive", "--controller", "skyhook", "--output", "OUT.gif"), "render"),
        (("figures", "--output", "OUT"), "report"),
        (("benchmark",), "train"),
        (("benchmark", "--only", "memory", "--scaling", "--output", "OUT.json"), "report"),
    ],
    ids=lambda value: "-".join(value[:2]) if isinstance(value, tuple) else value,
)
def test_missing_extra_is_told_in_one_line(arguments, extra, agent, tmp_path):
    folder = str(tmp_path / "out")
    done = command(*(argument.replace("AGENT", str(agent)).replace("OUT", folder) for argument in arguments))
    told = rf"roadgym {arguments[0]}: the package (\w+) is not installed, which the extra {extra} brings: pip install -e (.+)\n"
    found = re.fullmatch(told, done.stderr)
    assert found, done.stderr
    assert done.returncode == 2
    assert found[1] in EXTRAS[extra]
    assert found[2] in (f"'.[{extra}]'", f"'{ROOT}[{extra}]'")
    assert list(tmp_path.iterdir()) == []


def test_pictures_of_a_comparison_are_missed_before_its_training(tmp_path):
    code = "import sys; sys.modules['jinja2'] = None; from agents.cli import main; sys.exit(main())"
    done = python("-c", code, "compare", "--output", tmp_path / "out")
    assert (done.returncode, list(tmp_path.iterdir())) == (2, [])
    assert "jinja2 is not installed, which the extra report brings" in done.stderr


@pytest.mark.parametrize(
    ("what", "extra"), [("agents.train", "train"), ("agents.tune", "train"), ("analysis.figures", "report")]
)
def test_python_is_told_in_the_same_line(what, extra):
    package, name = what.split(".")
    done = plain(f"try: from {package} import {name}\nexcept ImportError as error: print(error)")
    assert re.fullmatch(rf"the package .* which the extra {extra} brings: pip install -e .*\n", done.stdout), done.stderr


def test_extras_are_those_that_messages_name():
    optional = PROJECT["optional-dependencies"]
    assert set(optional) == {*EXTRAS, "ray", "slurm", "all", "docs", "test", "lint"}  # those of clusters in no other
    names = {"yaml": "pyyaml", "PIL": "pillow", "pygame": "pygame-ce"}  # of distributions, where they differ
    for extra, packages in EXTRAS.items():
        brought = {canonicalize_name(Requirement(line).name) for line in optional[extra]} - {"roadgym"}
        assert brought == {canonicalize_name(names.get(package, package)) for package in packages}
    assert Requirement(optional["all"][0]).extras == set(EXTRAS)


def test_lower_bounds_are_those_that_are_tried():
    lines = (ROOT / "constraints-floor.txt").read_text(encoding="utf-8").splitlines()
    tried = {canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines) if version}
    required = [
        *PROJECT["dependencies"],
        *(line for extra in (*EXTRAS, "ray", "slurm") for line in PROJECT["optional-dependencies"][extra]),
    ]
    for requirement in map(Requirement, required):
        if requirement.name != "roadgym":
            (bound,) = requirement.specifier
            assert (bound.operator, Version(bound.version)) == (">=", Version(tried[canonicalize_name(requirement.name)]))


def distribution(site, name, version, files):
    """Write files as pip does, over what is there, with the metadata of a distribution."""
    for file, text in files.items():
        (site / file).write_text(text, encoding="utf-8")
    information = site / f"{name.replace('-', '_')}-{version}.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", encoding="utf-8")
    (information / "RECORD").write_text("".join(f"{file},,\n" for file in files), encoding="utf-8")


@pytest.fixture
def site(tmp_path):
    """A folder of installed packages, with roadgym in it."""
    folder = tmp_path / "site-packages"
    for name in ("roadgym", "analysis", "agents"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    distribution(
        folder,
        "roadgym",
        "0.1.0",
        {f"{name}/__init__.py": (ROOT / name / "__init__.py").read_text() for name in ("agents", "analysis")},
    )
    return folder


def told(*arguments, **where):
    """The one line that the command says, with exit code 2."""
    done = python("-m", "roadgym", *arguments, **where)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    return done.stderr


@pytest.mark.parametrize(("package", "other"), [("agents", "openai-agents"), ("analysis", "some-analysis")])
def test_another_distribution_over_ours_is_named(package, other, site, tmp_path):
    assert python("-m", "roadgym", "--version", path=site, cwd=tmp_path).stdout == "roadgym 0.1.0\n"
    distribution(site, other, "0.3.1", {f"{package}/__init__.py": "Agent = object\n"})
    line = told("evaluate", "--controller", "skyhook", path=site, cwd=tmp_path)
    assert line.startswith(f"roadgym: the package {package} is here that of {other} 0.3.1, not that of roadgym: ")
    assert f"or uninstall {other} and install roadgym again" in line
    done = python("-c", "import roadgym; print(roadgym.__file__)", path=site, cwd=tmp_path)
    assert done.stdout.strip() == str(site / "roadgym" / "__init__.py"), done.stderr
    (site / package / "__init__.py").unlink()  # it is uninstalled
    assert told("cache", path=site, cwd=tmp_path) == (
        f"roadgym: the package {package} of roadgym is not whole: install roadgym again\n"
    )


@pytest.mark.parametrize("file", ["agents/__init__.py", "analysis/__init__.py", "agents.py", "analysis.py"])
def test_a_folder_or_file_beside_a_script_is_named(file, tmp_path):
    path = tmp_path / file
    path.parent.mkdir(exist_ok=True)
    path.write_text("import roadgym\n")
    package = file.removesuffix(".py").removesuffix("/__init__")
    where = f"the folder {path.parent}" if "/" in file else f"the file {path}"
    line = f"the package {package} is here {where}, not that of roadgym: rename it, or take it out of Python's path\n"
    assert told("cache", cwd=tmp_path) == f"roadgym: {line}"
    (tmp_path / "script.py").write_text("import gymnasium, roadgym\nprint(gymnasium.make(roadgym.ENVIRONMENT_ID).spec.id)\n")
    assert python(tmp_path / "script.py").stdout == "roadgym/QuarterCar-v0\n"
    if package == "analysis":  # what rests on it says the same
        assert python("-c", "import agents", cwd=tmp_path).stderr.endswith(f"InstallationError: {line}")


def test_a_folder_that_is_no_package_takes_no_name(tmp_path):
    (tmp_path / "agents").mkdir()
    (tmp_path / "analysis").mkdir()
    assert python("-m", "roadgym", "--version", cwd=tmp_path).stdout == "roadgym 0.1.0\n"


def test_the_command_stands_where_no_other_distribution_takes_its_place():
    assert PROJECT["scripts"] == {"roadgym": "roadgym.__main__:main"}
