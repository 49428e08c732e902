"""The command that tells what a measured profile is: its text, its JSON, its page, its exit codes."""

import json
import re
import shlex

import numpy as np
import pytest

import roadgym
from agents.cli import environment_from, main, make_parser
from roadgym import FirstOrderRoad, MultiplicativeRoad
from roadgym.roads import make_road
from roadgym.task import make_task


def write_profile(path, road, *, spacing, points, seed=1, finer=1):
    """A profile as a table, in millimetres."""
    distance, heights = roadgym.sample_road(road, spacing=spacing / finer, points=finer * (points - 1) + 1, seed=seed)
    rows = np.column_stack([distance, 1000 * heights[0]])[::finer]
    np.savetxt(path, rows, fmt="%.5f", delimiter=",", header="distance,height", comments="")
    return path


@pytest.fixture(scope="module")
def class_c(tmp_path_factory):
    road = FirstOrderRoad.from_iso8608("C", lowest_frequency=3e-3)
    return str(write_profile(tmp_path_factory.mktemp("roads") / "class_c.csv", road, spacing=0.1, points=6000))


@pytest.fixture(scope="module")
def bounded(tmp_path_factory):
    road = MultiplicativeRoad.from_shape(shape=1.5, bandwidth=0.2, wavenumber=0.8, level_bound=0.05)
    return str(write_profile(tmp_path_factory.mktemp("roads") / "bounded.csv", road, spacing=0.5, points=6000, finer=4))


def test_text_fits_the_screen_and_says_what_there_is(class_c, capsys):
    assert main(["road", class_c, "--units", "mm", "--folded"]) == 0
    text = capsys.readouterr().out
    assert all(len(line) <= 80 for line in text.splitlines() if "--road" not in line)
    for part in ("6000 heights, 0.1 m apart", "C: G(n0) = 0.000", "with a waviness of", "m/km", "kurtosis", "To drive it:"):
        assert part in " ".join(text.split()), part


def test_json_has_the_figures(class_c, capsys):
    assert main(["road", class_c, "--units", "mm", "--folded", "--json", "--iso-class", "c"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["points"] == 6000
    assert found["spacing"] == pytest.approx(0.1)
    for law in ("free", "standard"):
        assert found[law]["iso_class"] == "C"
        assert abs(found[law]["roughness"] - 256e-6) < 4 * found[law]["roughness_error"]
    assert abs(found["free"]["waviness"] - 2) < 4 * found["free"]["waviness_error"]
    assert found["iri"] == pytest.approx(8.7, rel=0.15)
    assert found["certificate"]["passed"]
    criteria = [road["information_criterion"] for road in found["roads"]]
    assert criteria == sorted(criteria)
    assert {road["road"]["kind"] for road in found["roads"]} == {"first_order", "gaussian", "power_law"}
    for road in found["roads"]:
        make_road(road["road"])


@pytest.mark.parametrize(("name", "code"), [("C", 0), ("D", 1)])
def test_a_claim_is_certified(class_c, name, code, capsys):
    assert main(["road", class_c, "--units", "mm", "--folded", "--iso-class", name]) == code
    text = capsys.readouterr().out
    assert ("NOT certified" in text) == bool(code)
    assert ("FAIL" in text) == bool(code)


def test_a_bounded_road_is_found_and_shown(bounded, tmp_path, capsys):
    """The page holds all its pictures, for wide and narrow screens, each with words for who cannot see it."""
    folder = tmp_path / "new" / "page"
    assert main(["road", bounded, "--units", "mm", "--output", str(folder)]) == 0
    captured = capsys.readouterr()
    options = shlex.split(captured.out.partition("To drive it:")[2])
    assert options[0] == "--road"
    road = make_road(json.loads(options[1]))
    assert road.kind == "multiplicative"
    assert road.level_bound == pytest.approx(0.05, rel=0.1)
    assert road.wavenumber == pytest.approx(0.8, rel=0.05)
    assert options[2:] == ["--bandwidth-range", f"{road.bandwidth:g}", f"{road.bandwidth:g}"]
    given = environment_from(make_parser().parse_args(["evaluate", "--controller", "d_max", *options]))
    assert make_task(**given).road == road
    names = {path.name for path in folder.iterdir()}
    pictures = {"spectrum", "profile", "residuals", "heights"}
    assert names == {"road.html", *(f"{name}{end}.png" for name in pictures for end in ("", "_narrow"))}
    assert captured.err.count("wrote ") == len(names)
    page = (folder / "road.html").read_text(encoding="utf-8")
    assert page.count('<img alt="') == page.count("<source media=") == len(pictures)
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "http" not in page
    assert "multiplicative" in page
    before = (folder / "spectrum.png").stat().st_ino
    assert main(["road", bounded, "--units", "mm", "--output", str(folder)]) == 0  # again, over what is there
    assert (folder / "spectrum.png").stat().st_ino != before
    assert {path.name for path in folder.iterdir()} == names
    other = write_profile(tmp_path / "other's.csv", FirstOrderRoad(), spacing=0.1, points=300)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "profile.png").write_text("a picture of ours")
    capsys.readouterr()
    for place, held in ((folder, "road.html"), (tmp_path / "own", "profile.png")):
        before = {path: path.stat().st_mtime_ns for path in place.iterdir()}
        assert main(["road", str(other), "--output", str(place)]) == 2
        assert re.search(f"must not hold the {held} of others than .*other's.csv.*another folder\n$", capsys.readouterr().err)
        assert before == {path: path.stat().st_mtime_ns for path in place.iterdir()}


def test_faults_are_told_in_one_line(class_c, tmp_path, capsys):
    write_profile(tmp_path / "short.csv", FirstOrderRoad(), spacing=1.0, points=100)
    np.savetxt(tmp_path / "line.csv", np.arange(300)[:, None] * [0.1, 0.002], delimiter=",")
    for arguments, message in (
        ([str(tmp_path / "none.csv")], "none.csv"),
        ([str(tmp_path / "short.csv"), "--units", "mm"], "short.csv': heights must be 256 or more in a row"),
        ([str(tmp_path / "line.csv")], "line.csv': heights must not all be on a line"),
        ([class_c, "--units", "mm", "--iso-class", "Z"], "iso_class must be a letter of A, B, "),
        ([class_c, "--units", "parsec"], "parsec"),
        ([class_c, "--units", "mm", "--band", "2", "1"], "band must be a pair (low, high)"),
        ([class_c, "--units", "mm", "--output", class_c], "class_c.csv"),
    ):
        assert main(["road", *arguments]) == 2, arguments
        error = capsys.readouterr().err
        assert error.startswith("roadgym road: ")
        assert error.count("\n") == 1
        assert message in error
