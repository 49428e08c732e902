"""The recipes for contributors work as they stand, and so do the checks and the kind of install that they rest on."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
CHECKS = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
RECIPES = dict(
    re.findall(r"## ([^\n]+)\n(?:(?!## |```).)*```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text("utf-8"), re.S)
)


def follow(recipe):
    """What a recipe prints."""
    done = subprocess.run([sys.executable, "-W", "error", "-c", RECIPES[recipe]], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_recipe_is_followed_here():
    assert set(RECIPES) == {"A car", "A controller", "A reward"}


def test_recipe_of_a_car():
    said = follow("A car")
    damping, cost = map(float, said.splitlines()[0].split())
    assert (round(damping, 2), round(cost, 1)) == (0.23, 10.0)
    assert "seat acceleration, constant (m^2)" in said
    assert "none failed: the plant is certified" in said


def test_recipe_of_a_controller():
    cost = float(re.search(r"1\.5 +0\.1 +(\S+)\(", follow("A controller"))[1])
    assert 0.5 < cost < 0.95  # it switches, and to good purpose: the best constant damping costs 0.982


def test_recipe_of_a_reward():
    damping, predicted, driven = map(float, follow("A reward").split())
    assert 0.05 < damping < 0.9  # for displacement alone it is 0.981
    assert driven == pytest.approx(predicted, rel=0.01)


def test_an_editable_install_is_found_from_above_the_clone(tmp_path):
    pytest.importorskip("setuptools", minversion="77")
    clone, site = tmp_path / "roadgym", tmp_path / "site"
    for name in ("roadgym", "analysis", "agents"):
        shutil.copytree(ROOT / name, clone / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, clone)
    build = f"from setuptools.build_meta import build_editable; build_editable({str(tmp_path)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=clone, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    (site / "roadgym" / "__pycache__").mkdir(parents=True)  # left by an install of another kind
    zipfile.ZipFile(wheel).extractall(site)
    look = "import importlib.util as u, site, sys; site.addsitedir(sys.argv[1]); print(u.find_spec('roadgym').origin)"
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, "-S", "-c", look, site]
    for folder in (tmp_path, site):
        done = subprocess.run(command, cwd=folder, env=alone, capture_output=True, text=True, check=True)
        assert Path(done.stdout.strip()) == clone / "roadgym" / "__init__.py"


@pytest.fixture
def checkout(tmp_path):
    """A repository in which the checks take no time: the README's first command makes tools that do nothing."""
    if shutil.which("git") is None:
        pytest.skip("there is no git")
    folder = tmp_path / "checkout"
    (folder / ".ci").mkdir(parents=True)
    shutil.copy(ROOT / ".ci" / "run", folder / ".ci")
    (folder / ".ci" / "package").write_text('test -d "$1" && grep -q README.md "$2"\n')
    tools = "python3 -m venv -h >made && mkdir -p .venv/bin && for t in pip ruff mypy lint-imports sphinx-build; do"
    (folder / "README.md").write_text(
        f'## Two commands\n```sh\n{tools} ln -s "$(type -P true)" .venv/bin/$t; done\n```\n'
        "```sh\npython3 -m venv -h >made && test -d .venv && cat result && ! grep -q failed result\n```\n## What comes out\n"
    )
    (folder / ".gitignore").write_text(".venv/\n")
    (folder / ".venv").mkdir()
    (folder / ".venv" / "mine").touch()
    return folder


@pytest.mark.parametrize("result", ["== 7 passed in 3.21s ==", "== 1 failed, 6 passed in 3.21s =="])
def test_checks_leave_the_checkout_alone_and_say_what_came_out(checkout, result, tmp_path):
    (checkout / "result").write_text(f"a test\n{result}\n")
    git = ["git", "-C", checkout, "-c", "user.name=a", "-c", "user.email=a@b.example", "-c", "core.hooksPath="]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "add", "."], check=True)
    subprocess.run([*git, "commit", "-q", "-m", "all"], check=True)
    (tmp_path / "temporary").mkdir()
    environment = {"CI": "true", "HOME": str(tmp_path), "TMPDIR": str(tmp_path / "temporary"), "PIP_CACHE_DIR": str(tmp_path)}
    environment["PATH"] = f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin"
    done = subprocess.run(["bash", checkout / ".ci" / "run"], env=environment, capture_output=True, text=True, cwd=tmp_path)
    passed = "failed" not in result
    assert (done.returncode == 0) == passed, done.stdout + done.stderr
    end = done.stdout[done.stdout.rindex(result) :]
    assert re.findall(r"^ +\d+ s  (.+)$", end, re.M)[:2] == ["compare", "tests" if passed else "tests: FAILED"]
    assert ("package" in end) == passed
    assert (checkout / ".venv" / "mine").exists()
    status = subprocess.run([*git, "status", "--porcelain", "--ignored"], capture_output=True, text=True, check=True).stdout
    assert status == "!! .venv/\n"
    assert not list((tmp_path / "temporary").iterdir())


def test_pre_commit_and_the_workflow_run_the_same_checks():
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    entries = [hook["entry"].removesuffix(" --force-exclude") for hook in repository["hooks"]]
    checks = re.findall(r"^part \w+ (\.venv/bin/(?:ruff|mypy|lint-imports).*)$", CHECKS, re.M)
    assert entries == [check.removesuffix(" .").removesuffix(" --check") for check in checks]
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    steps = {name: [step["run"] for step in job["steps"] if "run" in step] for name, job in workflow["jobs"].items()}
    assert steps["everything"] == ["bash .ci/run"]


def test_the_workflow_tries_the_lowest_and_the_newest_releases():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    job = workflow["jobs"]["releases"]
    install, tests = (step["run"] for step in job["steps"] if "run" in step)
    assert "pip install ${{ matrix.constraints }} -e '.[test]'" in install
    assert tests == ".venv/bin/python -m pytest -n auto"
    assert [each["constraints"] for each in job["strategy"]["matrix"]["include"]] == ["-c constraints-floor.txt", ""]
