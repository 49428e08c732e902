"""Compiled code that is kept: never older than the sources, outside the package, and not needed."""

import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from unittest import mock

import numba
import numpy as np
import pytest

import roadgym
from agents.cli import main
from roadgym import cache, compiler, kernel

PACKAGE = Path(roadgym.__file__).parent
# state_row is in signals.py, it is computed from a constant of compiled.py
SCRATCH = """
import numpy as np, roadgym
from roadgym import record, signals
assert roadgym.__file__.startswith({0!r}), roadgym.__file__
plant = np.zeros(1, record.PLANT)
plant["own_states"] = 30
print(signals.state_row(plant[0], 20), len(signals.state_row.stats.cache_hits))
"""


@pytest.fixture
def copy(tmp_path):
    """A copy of the package in a folder of its own."""
    shutil.copytree(PACKAGE, tmp_path / "copy" / "roadgym", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "copy"


def run(copy, **environment):
    """(where a row is, signatures found in the cache, what is said) in a process of its own."""
    known = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    done = subprocess.run(
        [sys.executable, "-c", SCRATCH.format(str(copy))],
        cwd=copy,
        env=known | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    size, hits = map(int, done.stdout.split())
    return size, hits, done.stderr


def test_edit_of_another_module_is_compiled_anew(copy, tmp_path):
    kept = {"XDG_CACHE_HOME": str(tmp_path / "kept")}
    assert run(copy, **kept) == (20 * 64, 0, "")
    assert run(copy, **kept) == (20 * 64, 1, "")
    source = copy / "roadgym" / "compiled.py"
    source.write_text(source.read_text(encoding="utf-8").replace("LANES = 64", "LANES = 32"), encoding="utf-8")
    assert run(copy, **kept)[:2] == (20 * 32, 0)
    assert {path.suffix for path in copy.rglob("*.*")} <= {".py", ".typed"}  # nothing is left in the package
    assert len(list((tmp_path / "kept" / "roadgym" / "compiled").iterdir())) == 2


def test_compiling_the_kernel_is_told_once(monkeypatch, caplog):
    monkeypatch.setattr(cache, "_told", False)
    for _ in range(2):
        cache.Kept(kernel.step_blocks.function).tell()
    assert caplog.messages == ["compiling the plant, once: up to half a minute"]


def test_works_where_nothing_can_be_written(copy):
    for folder in (copy / "roadgym", copy / "roadgym" / "roads", copy / "roadgym" / "cars"):
        (folder / "__pycache__").write_text("no folder, so that nobody can write there")
    size, hits, said = run(copy, HOME="/dev/null/x", LOCALAPPDATA="/dev/null/x")
    assert (size, hits) == (20 * 64, 0)
    assert said.count("cache cannot be written") == said.count("Warning") == 1


MODULE = """
from roadgym.compiled import LANES, LaneFunction

@LaneFunction
def double(lanes, words, table):
    for i in range(LANES):
        lanes[i] = 2 * lanes[i]
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The folder of compiled code, a new one."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "kept"))
    monkeypatch.setattr(cache, "_warned", False)
    return tmp_path / "kept" / "roadgym" / "compiled"


def doubled(folder, text=MODULE):
    """Import the module anew, double ones by its function, and tell whether that came from the cache."""
    folder.mkdir(exist_ok=True)
    (folder / "own.py").write_text(text)
    names = {"__name__": "own"}
    exec(compile(text, folder / "own.py", "exec"), names)
    lanes, words = np.ones(64), np.zeros(64, np.uint32)
    with mock.patch.object(compiler, "lane_code", wraps=compiler.lane_code) as made:
        names["double"].entry(np.float64)(lanes.ctypes.data, words.ctypes.data, lanes.ctypes.data)
    return lanes[0], 1 - made.call_count


def test_damaged_code_is_compiled_anew_and_own_roads_are_kept_too(place, tmp_path):
    assert doubled(tmp_path / "a") == (2, 0)
    assert doubled(tmp_path / "a") == (2, 1)
    (file,) = place.rglob("*.code")
    content = file.read_bytes()
    for damaged in (b"", content[:-1], content[:50] + b"?" + content[51:]):
        file.write_bytes(damaged)
        assert doubled(tmp_path / "a") == (2, 0)
    assert doubled(tmp_path / "a") == (2, 1)
    assert doubled(tmp_path / "a", MODULE.replace("2 *", "3 *")) == (3, 0)


def test_stamps_that_were_not_used_for_long_are_removed(place, tmp_path):
    for age in range(cache.KEPT + 5):
        folder = place / f"{age:032x}"
        folder.mkdir(parents=True)
        os.utime(folder, (1e9 - age, 1e9 - age))
    (place / "somebody's").mkdir()
    doubled(tmp_path)
    left = {path.name for path in place.iterdir()}
    assert len(left) == cache.KEPT + 1
    assert {f"{age:032x}" for age in range(cache.KEPT - 1)} | {"somebody's"} < left


def test_cache_that_cannot_be_written_is_told_once(place, tmp_path):
    place.parent.parent.write_text("in the way")
    with pytest.warns(RuntimeWarning, match="cache cannot be written"):
        assert doubled(tmp_path / "a") == (2, 0)
    assert doubled(tmp_path / "b") == (2, 0)


def test_cache_is_told_and_cleared(place, tmp_path, capsys):
    doubled(tmp_path / "a")
    mine = [place.parent / "mine.npz", place / "mine"]
    feedback = place.parent / f"feedback-{'0' * 32}.npz"
    for path in (*mine, feedback):
        path.write_bytes(bytes(1_000_000))
    assert main(["cache"]) == 0
    said = capsys.readouterr().out
    assert re.search(rf"compiled code +1 +0\.0\d +{re.escape(str(place))}\n", said)
    assert re.search(rf"optimal feedbacks +1 +1\.00 +{re.escape(str(place.parent))}\n", said)
    assert main(["cache", "--clear"]) == 0
    assert {path for path in place.parent.rglob("*") if path.is_file()} == set(mine)
    assert doubled(tmp_path / "a") == (2, 0)


def test_function_without_a_file_is_compiled_all_the_same(place):
    names = {"__name__": "own"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exec(MODULE, names)
        assert names["double"].address(np.float64)
    assert not list(place.rglob("*.code"))


def test_a_step_needs_no_numba_once_it_is_compiled():
    """To load numba takes longer than all else from the start of a process to its first step."""
    code = (
        "import sys, gymnasium as g; e = g.make('roadgym:roadgym/QuarterCar-v0'); e.reset(seed=0); "
        "e.step(e.action_space.sample()); print(*{'numba', 'scipy'} & set(sys.modules))"
    )
    said = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout for _ in range(2)]
    assert said[1] == "\n"
