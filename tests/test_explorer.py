"""The interactive page is one file that has all it needs, of the view that was asked for."""

import json
import re
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest

import roadgym
from agents.cli import main
from analysis import explorer
from roadgym import ROADS, SPEED_NOISES, ParameterError

PLANTS = [(road, noise) for road in explorer.roads() for noise in ("none", *SPEED_NOISES)]
DEFINED = [(road, noise) for road, noise in PLANTS if road == "harmonic" or noise in ("none", "low_pass")]


def test_page_is_one_file_and_loads_nothing(tmp_path):
    text = explorer.write(tmp_path / "page.html").read_text(encoding="utf-8")
    assert not re.findall(r"/\*\S+\*/", text)  # places of the parts and the data
    for name in explorer.PARTS:
        assert explorer.TEMPLATE.with_name(name).read_text(encoding="utf-8").strip() in text
    assert not re.findall(r"""https?:|@import|url\((?!#)|\bsrc=|\bfetch\(|href="(?!data:)""", text)
    assert roadgym.__version__ in text
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_every_part_of_the_page_is_installed():
    project = Path(__file__).parents[1] / "pyproject.toml"
    setuptools = tomllib.loads(project.read_text(encoding="utf-8"))["tool"]["setuptools"]
    assert explorer.__name__ in setuptools["packages"]
    for name in (explorer.TEMPLATE.name, *explorer.PARTS):
        assert any(fnmatch(name, pattern) for pattern in setuptools["package-data"][explorer.__name__]), name


def test_plants_are_those_that_are_defined():
    found = explorer.plants()
    assert "two_corner" in found
    assert [(road, noise) for road, noise in PLANTS if noise in found[road]] == DEFINED
    assert found["harmonic"]["high_pass"] == {"simulated": False, "divergent": ("acceleration", "relative_velocity")}
    assert found["gaussian"]["low_pass"]["simulated"]


@pytest.mark.parametrize(
    ("view", "message"),
    [
        ({"damping": 5.0}, r"damping must be from 0.01 to 2, got 5"),
        ({"damping": float("nan")}, r"damping must be finite"),
        ({"road": "gravel"}, r"unknown road 'gravel'; known: harmonic, "),
        ({"road": 3}, r"road must be one of harmonic, .*got 3"),
        ({"speed_noise": "pink"}, r"speed_noise must be one of none, white, .*'pink'"),
        ({"road": "gaussian", "speed_noise": "white"}, r"white speed noise is defined on the harmonic road only"),
        ({"speed": 1.0}, r"name in the view of the one_mass car must be one of car, road, .*'speed'"),
        ({"car": "savaresi", "frequency_ratio": 1}, r"of the two_mass car must be one of car, .*_hour, got 'frequency_ratio'"),
        ({"sprung_mass": 300}, r"of the one_mass car must be one of car, .*damping_max, got 'sprung_mass'"),
        ({"damping_min": 0.5, "damping_max": 0.2}, r"damping_min must not be above damping_max, 0.2, got 0.5"),
        ({"road": "first_order", "weights": {"acceleration": 1}}, r"mean square of acceleration is infinite"),
        ({"car": "lorry"}, r"car must be one of one_mass, two_mass, savaresi, .*'lorry'"),
        ({"car": "savaresi", "road": "gaussian"}, r"road must be one of iso_a, .*'gaussian'"),
        ({"car": "savaresi", "speed_noise": "white"}, r"speed_noise must be one of none, got 'white'"),
        ({"car": "two_mass", "tyre_rate": 5.0}, r"tyre_rate must be from 200 to 1e\+06, got 5"),
        ({"car": "two_mass", "weights": {"grip": 1}}, r"weights must be one of displacement, .*wheel_load, got 'grip'"),
        ({"car": "two_mass", "weights": {"weighted_acceleration": 1}}, r"wheel_load, got 'weighted_acc"),
    ],
)
def test_bad_view_is_refused(view, message, tmp_path):
    with pytest.raises(ParameterError, match=message):
        explorer.write(tmp_path / "page.html", view)
    assert not list(tmp_path.iterdir())


def test_road_of_an_installed_package_is_found(tmp_path, monkeypatch):
    metadata = tmp_path / "pebbles-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: pebbles\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[roadgym.components]\npebbles = pebbles\n")
    (tmp_path / "pebbles.py").write_text(
        """import dataclasses, roadgym
@dataclasses.dataclass(frozen=True, kw_only=True)
class Pebbles(roadgym.TwoCornerRoad):
    kind: str = dataclasses.field(default="pebbles", init=False)
roadgym.register("road", "pebbles", Pebbles)
"""
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    try:
        assert explorer.make_view({"road": "pebbles"})["road"] == "pebbles"
        assert explorer.roads()["pebbles"] == explorer.roads()["two_corner"]
    finally:
        ROADS.pop("pebbles", None)
        sys.modules.pop("pebbles", None)


def test_unwritable_file_is_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "folder", tmp_path / "nowhere" / "page.html"):
        with pytest.raises(ParameterError, match="cannot write"):
            explorer.write(path)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_command(tmp_path, capsys):
    path = tmp_path / "page.html"
    arguments = "--road harmonic --speed-noise white --value damping 0.3 --value intensity 0.5 --weights velocity=2"
    assert main(["explore", "--output", str(path), *arguments.split()]) == 0
    assert capsys.readouterr().out == f"{path}\n"
    data = json.loads(re.search(r'id="data">(.*?)</script>', path.read_text(encoding="utf-8"))[1])
    given = {"road": "harmonic", "speed_noise": "white", "damping": 0.3, "intensity": 0.5, "weights": {"velocity": 2.0}}
    assert data["view"] == explorer.make_view(given)
    arguments = "--car golden_car --road iso_e --value kilometres_per_hour 80 --weights wheel_load=2"
    assert main(["explore", "--output", str(path), *arguments.split()]) == 0
    data = json.loads(re.search(r'id="data">(.*?)</script>', path.read_text(encoding="utf-8"))[1])
    assert (data["view"]["car"], data["view"]["iso_class"], data["view"]["tyre_rate"]) == ("two_mass", "E", 653.0)
    assert data["view"]["si_weights"]["si_wheel_load"] == 2.0
    assert main(["explore", "--output", str(path), "--value", "damping", "9"]) == 2
    assert "damping must be from" in capsys.readouterr().err
