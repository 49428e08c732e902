import re
from pathlib import Path

import pytest

import analysis
from agents.cli import main
from analysis.errata import CHECKS, run, table
from roadgym.parameters import ParameterError

PAGE = (Path(analysis.__file__).parent / "ERRATA.md").read_text(encoding="utf-8")


@pytest.mark.statistical
def test_simulation_takes_the_side_of_the_derivation() -> None:
    reports = []
    checks = run(report=lambda *state: reports.append(state))
    assert [check.name for check in checks] == list(CHECKS)
    assert reports[-1] == ("errata", len(CHECKS), len(CHECKS))
    for check in checks:
        assert check.simulated.standard_error > 0, check.name
        assert abs(check.simulated.distance(check.right)) < 4, check.name
        assert abs(check.simulated.distance(check.printed)) > 10, check.name
    lines = table(checks).splitlines()
    assert len(lines) == len(checks) + 3
    assert max(map(len, lines)) < 180


def test_every_erratum_has_its_line_on_the_page() -> None:
    assert set(re.findall(r"`roadgym errata --only (\w+)`", PAGE)) == set(CHECKS)


def test_figures_of_the_papers_formulas() -> None:
    [check] = run(["forcing"])
    # both amplitudes by hand at D = 1/2, nu = 1, sigma = 1: C solves (s^2 + s + 1) C = s + 1 + (f - 3/2), s = 1/2 + i
    s = 0.5 + 1j
    for found, forcing in ((check.right, 1.5), (check.printed, 0.5)):
        # K = s C; (s + 1) K + C = f + i for the forcing f of G and -1 of H
        assert found == pytest.approx(abs((forcing + 1j) / (s * (s + 1) + 1)))


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
