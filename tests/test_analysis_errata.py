import json
import re
from pathlib import Path

import numpy as np
import pytest

import analysis
from agents.cli import main
from analysis.paper.errata import CHECKS, KINDS, run, table
from roadgym.parameters import ParameterError

PAGE = (Path(analysis.__file__).parent / "paper" / "ERRATA.md").read_text(encoding="utf-8")


@pytest.mark.statistical
def test_evidence_takes_the_side_of_the_derivation() -> None:
    reports = []
    checks = run(report=lambda *state: reports.append(state))
    assert [check.name for check in checks] == list(CHECKS)
    assert reports[-1] == ("errata", len(CHECKS), len(CHECKS))
    for check in checks:
        assert check.agrees(check.right), check.name
        assert not check.agrees(check.printed), check.name
        assert check.evidence in ("simulation", "calculation")
        if check.evidence == "simulation":
            assert abs(check.found.distance(check.printed)) > 10, check.name
        else:
            assert check.found.standard_error == 0, check.name
    lines = table(checks).splitlines()
    assert max(map(len, lines)) <= 80
    assert [line for line in lines if line in KINDS.values()] == list(KINDS.values())
    assert [line.split()[0] for line in lines if line.split() and line.split()[0] in CHECKS] == list(CHECKS)


def test_the_page_has_every_entry_under_the_heading_of_its_kind(capsys) -> None:
    kinds = {}
    for section in PAGE.split("\n## ")[1:]:
        heading = section.splitlines()[0]
        for name in re.findall(r"`roadgym errata --only (\w+)`", section):
            kinds[name] = heading
    assert set(kinds) == set(CHECKS)
    calculated = [name for name in CHECKS if name not in SIMULATED]
    assert main(["errata", "--json", "--only", *calculated]) == 0
    for entry in json.loads(capsys.readouterr().out):
        assert kinds[entry["name"]] == KINDS[entry["kind"]]
        assert entry["evidence"] == "calculation"
    counts = [list(kinds.values()).count(KINDS[kind]) for kind in ("slip", "wording", "scan")]
    words = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")
    slips, wordings, scans = (words[count] for count in counts)
    introduction = " ".join(PAGE.split("\n## ")[0].split())
    for claim in (f"There are {slips} slips.", f"{wordings} statements whose wording is off", f"{scans} places where the scan"):
        assert claim in introduction


SIMULATED = {"ellipse", "white_noise", "resonance_induction", "high_pass", "stability_map", "mean_exponent", "high_speed"}


def test_calculated_evidence_by_hand() -> None:
    found = {check.name: check for check in run(name for name in CHECKS if name not in SIMULATED)}
    # d(A cos phi) has the drift (n - sigma^2/2) A cos phi, and d[B, sin phi] gives sigma^2 A cos phi; n = +-sigma^2/2
    assert found["product_rule"].printed == pytest.approx(0.5 + 0.5**2)
    assert found["product_rule"].found.value == pytest.approx(0.5)
    # X drifts at mu (w1 - D sigma^2) by (19) and d cos phi; of the forcing of G the covariation takes 2 D sigma^2
    assert found["forcing"].found.value == pytest.approx(1 - 0.5)
    assert found["forcing"].printed == pytest.approx(1 - 0.5 - 1)
    assert found["level_rate"].found.value == pytest.approx(2)
    assert found["marginal"].found.value == pytest.approx(0.5)
    assert found["top_exponent"].found.value == pytest.approx(-0.1)
    assert found["diagonal_term"].found.value == pytest.approx(0.2)


def test_closure_for_high_pass_noise_follows_from_the_right_increment_and_from_the_printed_one() -> None:
    """(36) stands: what (34) lacks and what it has with the wrong sign cancel in the mean, where w_g E Psi^2 = sigma^2/2."""
    noise = analysis.moment_system("high_pass", damping=0.1, speed=0.7)
    corner, square = 1.0, 2 * noise.matrix[5, 0]
    turn, slope = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]]), np.array([0, 0, 0, 1.0])
    variance = square / (2 * corner)
    for coupling, damper in (
        (square * turn - corner * variance * turn, 0.2 * (corner * variance - square)),  # (33) and (31c) by Ito's rule
        (corner * variance * turn, -0.2 * corner * variance),  # (34) as printed
    ):
        np.testing.assert_allclose(noise.matrix[4:, :4], coupling)
        np.testing.assert_allclose(noise.forcing[4:], damper * slope)


def test_command_line(capsys) -> None:
    assert main(["errata", "--only", "limit_cycles"]) == 0
    assert "limit_cycles" in capsys.readouterr().out
    assert main(["errata", "--only", "spelling"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("roadgym errata: erratum must be one of level_rate, ")
    assert error.endswith("got 'spelling'\n")
    assert len(error.splitlines()) == 1
    with pytest.raises(ParameterError, match="erratum must be one of"):
        run(["spelling"])
