"""The worked examples run at a small size, and the snippets of the documentation print what it says."""

import doctest
import importlib.util
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import roadgym
from agents.evaluation import in_units_of
from roadgym.task import make_task

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
SNIPPETS = {
    str(page.relative_to(ROOT)): re.findall(r"```pycon\n(.*?)```", page.read_text("utf-8"), re.DOTALL) for page in PAGES
}


def run(script, *arguments, folder, warnings="error"):
    command = [sys.executable, "-W", warnings, ROOT / "examples" / script, *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}  # small networks are fastest on one thread
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_train_and_compare(tmp_path):
    size = ("--output", "agent", "--timesteps", "1", "--episodes", "16", "--duration", "2")
    output = run("train_and_compare.py", *size, folder=tmp_path)
    first, head, *rows = output.splitlines()
    assert re.fullmatch(r"agent: apg, \d+ steps", first)
    assert head.split() == ["speed", "bandwidth", "agent", "analytic_optimum", "skyhook", "agent", "saves"]
    numbers = [[float(word) for word in row.split() if word != "±"] for row in rows]
    assert [row[:2] for row in numbers] == [[v, b] for v in (0.7, 1.0, 1.5, 2.0, 3.0) for b in (0.1, 0.3)]
    for _, _, agent, _, optimum, _, _, _, saved, error in numbers:
        assert saved == pytest.approx(optimum - agent, abs=2e-4)
        assert error > 0
    made = (tmp_path / "agent" / "agent.json").read_text()
    assert run("train_and_compare.py", *size, folder=tmp_path) == output  # loads the agent; the same roads, the same costs
    assert (tmp_path / "agent" / "agent.json").read_text() == made


def test_slow_valves(tmp_path):
    few = ("--lags", "30", "--delays", "--levels", "--rules", "clipped_lqr", "--episodes", "16", "--duration", "1")
    first, head, *rows = run(
        "slow_valves.py", *few, "--agents", "--timesteps", "1", "--output", "a", folder=tmp_path
    ).splitlines()
    assert re.fullmatch(r"the best constant damping costs \S+; over it", first)
    assert head.split() == ["clipped_lqr", "agent,", "unaware", "agent,", "aware", "agent,", "of", "many"]
    found = {row[:15].strip(): [float(word) for word in row[15:].split() if word != "±"] for row in rows}
    assert list(found) == ["ideal", "lag 30 ms"]
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["ideal", "lag-30-ms", "many"]
    (ideal, error, *_), (slow, its_own, *_) = found["ideal"], found["lag 30 ms"]
    assert found["ideal"][2:4] == found["ideal"][4:6]  # the same agent
    assert abs(ideal - 0.714) < 0.03 + 4 * error
    assert slow - ideal > 0.05 - 3 * (error + its_own)


def test_unseen_cars(tmp_path):
    kinds, size = ("--learners", "nominal", "lags", "apg"), ("--episodes", "16", "--duration", "1", "--lags", "20")
    training = ("--output", "agents", "--seeds", "1", "--timesteps", "1")
    _, head, *rows = run("unseen_cars.py", *kinds, *training, *size, folder=tmp_path).splitlines()
    assert head.split() == ["analytic_optimum", "skyhook_continuous", "clipped_lqr", "nominal", "lags", "apg"]
    assert [row[:15].strip() for row in rows] == ["unseen cars", "lag 20 ms"]
    for row in rows:
        best, *shares = (float(cell.split(" ± ")[0]) for cell in re.findall(r"\S+ ± \S+", row[15:]))
        assert best == 0
        assert all(-100 < share < 60 for share in shares)
    assert sorted(path.name for path in (tmp_path / "agents").iterdir()) == ["apg-0", "lags-0", "nominal-0"]


def test_rules_of_two_masses(tmp_path):
    rules = ("--rewards", "comfort", "--rules", "skyhook", "hybrid", "clipped_lqr")
    output = run("rules_of_two_masses.py", *rules, "--episodes", "16", "--duration", "4", folder=tmp_path)
    head, *rows = output.splitlines()
    assert re.fullmatch(r"comfort: the best constant damping costs \S+; over it", head)
    found = {row.split()[0]: row.split()[1:4:2] for row in rows}
    assert list(found) == ["skyhook", "hybrid", "clipped_lqr"]
    assert re.search(r"hybrid .*, mixing = \S+$", rows[1])
    ratio, error = map(float, (text.rstrip(",") for text in found["clipped_lqr"]))
    assert abs(ratio - 0.54) < 0.03 + 4 * error


def test_own_training_loop(tmp_path):
    size = ("--timesteps", "100000", "--cars", "256", "--steps", "200")
    output = run("own_training_loop.py", *size, folder=tmp_path)
    found = re.search(r"damping (\S+): cost (\S+) by theory, (\S+) ± (\S+) driven", output)
    damping, theory, driven, error = (float(text) for text in found.groups())
    assert damping == pytest.approx(0.9814, abs=1e-3)
    assert theory == pytest.approx(0.9821, abs=1e-4)
    assert abs(driven - theory) < 4 * error < 0.2
    saved, error = (float(text) for text in re.search(r"saved: (\S+) ± (\S+) of", output).groups())
    assert saved > 5 * error  # it has begun to learn


def test_measured_road(tmp_path):
    size = ("--output", "agent", "--timesteps", "1", "--episodes", "16", "--duration", "2")
    output = run("measured_road.py", *size, folder=tmp_path)
    first, *_, lost, carried = output.splitlines()
    assert first.startswith("1000 m, every 0.1 m; fitted: MultiplicativeRoad(")
    rows = re.findall(r"^ +(\S.*\S) (\S+) ± (\S+) \(m/s²\)², (\S+) of", output, re.MULTILINE)
    assert [row[0] for row in rows] == 2 * ["best constant D", "agent", "skyhook"]
    shares = {}
    for k, (who, cost, error, share) in enumerate(rows):
        best = float(rows[3 * (k // 3)][1])
        assert float(share) == pytest.approx(float(cost) / best, abs=1e-3)
        assert (float(error) == 0) == (who == "best constant D")
        shares.setdefault(who, []).append(float(share))
    told = float(re.search(r"profile: (\S+) %", lost).group(1))
    assert told == pytest.approx(100 * (shares["agent"][1] - shares["agent"][0]), abs=0.2)
    assert 0 <= float(re.search(r"loses (\S+) %", carried).group(1)) < 30


def test_one_accelerometer(tmp_path):
    size = ("--rule", "mixed_lookahead", "--noises", "0.05", "--episodes", "16", "--duration", "20")
    learned = ("--agents", "stacked", "--timesteps", "1", "--output", "agents")
    output = run("one_accelerometer.py", *size, *learned, "--sensors", "all", "acceleration", folder=tmp_path)
    at, _, *rows = output.splitlines()
    said = re.search(r"below (\S+), best constant damping (\S+), mixed_lookahead (\S+)", at).groups()
    bound, best, known = map(float, said)
    assert 0.1 < bound < known
    shares = {}
    for row in rows:
        who, *numbers, mean = re.search(r"0\.05 +(.*): (\S+) \((\S+) ± (\S+) %\), mean (\S+) ± ", row).groups()
        cost, share, error = map(float, numbers)
        assert share == pytest.approx(100 * (best - cost) / (best - known), abs=0.1)
        assert float(mean) == share  # of one point
        assert 0 < error < 10
        shares.setdefault(who, []).append(share)
    assert 60 < shares["rule on the filter"][1] < shares["rule on the filter"][0] < 105
    assert max(shares["stacked"]) < 60  # which has hardly learned


# sizes that take seconds, and the smallest share of the gap then, in per cent; one that has learned nothing is at -5
LEARNERS = {
    "skrl": ("with_skrl.py", "--timesteps", "32768", 10),
    "stable_baselines3": ("with_stable_baselines3.py", "--timesteps", "4096", -10),
    "sbx": ("with_stable_baselines3.py", "--package=sbx", "--timesteps", "65536", 10),
    "torchrl": ("with_torchrl.py", "--timesteps", "32768", 10),
    "ray+ormsgpack": ("with_rllib.py", "--timesteps", "65536", 10),
    "minari+jax+h5py": ("with_minari.py", "--drives", "10", 60),
}


@pytest.mark.parametrize("packages", LEARNERS)  # what a library needs of its own extras beside itself
def test_other_libraries_learn(packages, tmp_path):
    for package in packages.split("+"):
        if not importlib.util.find_spec(package):
            pytest.skip(f"{package} is not installed")
    script, *size, least = LEARNERS[packages]
    # each of them warns of itself with one release or another of what it stands on
    output = run(f"learners/{script}", *size, "--episodes", "16", folder=tmp_path, warnings="default")
    share, error = (float(text) for text in re.search(r"closes (\S+) ± (\S+) % of the gap", output).groups())
    assert 0 < error < 2
    assert least < share < 100
    assert ("the environment is recovered: True" in output) == (script == "with_minari.py")


def test_a_rule_made_for_one_road_sees_another_in_its_terms():
    """On a road that is scaled, and named in other units, the same drive: heights, speeds and slopes are what they are."""
    plain = roadgym.GaussianRoad(bandwidth=0.3, noise_intensity=0.02)
    own = make_task(road=roadgym.GaussianRoad(bandwidth=0.3, noise_intensity=0.1, wavenumber=2.0), speed=0.6)
    here = make_task(road=plain, speed=1.2)
    seen = np.array([[0.5, -1.0, 2.0, 1.5, 1.2 / 2.2, 0.375]], np.float32)
    found = in_units_of(own, here)(seen)[0]
    deviation = math.sqrt(plain.variance / own.road.variance)
    np.testing.assert_allclose(found[:3], deviation * seen[0, :3], rtol=1e-6)
    assert found[3] == pytest.approx(deviation / 2 * seen[0, 3])  # dZ/ds is Omega U
    assert found[4] / (1 - found[4]) == pytest.approx(2.4)  # 1.2 m/s on a road of twice the wavenumber
    assert found[5] == seen[0, 5]
    assert in_units_of(here, here)(seen) is seen


@pytest.mark.parametrize("page", [page for page, snippets in SNIPPETS.items() if snippets])
def test_snippets_of_the_documentation(page):
    test = doctest.DocTestParser().get_doctest("\n".join(SNIPPETS[page]), {}, page, page, 0)
    report = []
    doctest.DocTestRunner(verbose=False).run(test, out=report.append)
    assert not report, "".join(report)


def test_the_documentation_has_snippets():
    assert sum(len(snippets) for snippets in SNIPPETS.values()) >= 5
