"""What moved into `analysis.paper` and `analysis.driven` is still where it was, and says where it is now."""

import importlib
import sys

import pytest

import analysis
from analysis import driven
from analysis.paper import drawing, errata, euler_maruyama, exponents, figures, rotating_frame, stability, stability_figures

FORMER = {
    "errata": [(errata, ["CHECKS", "KINDS", "Check", "run", "table"])],
    "figures": [
        (drawing, ["Drawing"]),
        (figures, ["FIGURES", "figure_2", "write"]),
        (stability_figures, ["figure_14", "stability_angles"]),
    ],
    "rotating_frame": [(rotating_frame, ["FORMS", "ROTATION", "MomentSystem", "mean_amplitude", "moment_system"])],
    "simulation": [
        (driven, ["drive_together", "driven_mean_squares", "driven_optimum"]),
        (euler_maruyama, ["FORMS", "Estimate", "Simulation", "march", "simulate"]),
        (exponents, ["Stability", "simulate_stability"]),
    ],
    "stability": [(stability, ["NOISE_FACTOR", "critical_noise", "lyapunov_exponents", "rotation_numbers"])],
}


@pytest.mark.parametrize("name", FORMER)
def test_former_places_hold_the_same_and_warn(name, monkeypatch) -> None:
    monkeypatch.delitem(sys.modules, f"analysis.{name}", raising=False)
    monkeypatch.delitem(vars(analysis), name, raising=False)
    with pytest.warns(DeprecationWarning, match=rf"^analysis\.{name} is now analysis\.") as told:
        module = importlib.import_module(f"analysis.{name}")
    assert len(told) == 1
    for place, names in FORMER[name]:
        for what in names:
            assert getattr(module, what) is getattr(place, what)


def test_modules_that_came_with_the_package_still_do(monkeypatch) -> None:
    for name in ("rotating_frame", "simulation", "stability"):
        monkeypatch.delitem(sys.modules, f"analysis.{name}", raising=False)
        monkeypatch.delitem(vars(analysis), name, raising=False)
        with pytest.warns(DeprecationWarning, match=name):
            assert getattr(analysis, name).__name__ == f"analysis.{name}"
    with pytest.raises(AttributeError, match="no attribute 'stabilty'"):
        analysis.stabilty  # noqa: B018
