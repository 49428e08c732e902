"""What Wedig (2020) has wrong, each with a number that shows it: as printed, as derived, and as the evidence has it.

`ERRATA.md` beside this file says in words what is wrong and why. The evidence starts from what is in no doubt, and could have
come out for the print: simulation of the original equations, phase and car (18), (19), (30) and road (7), (8); or a calculation
from the paper's own equations. What one step of a stochastic equation does on average is calculated with both of the increments
+-dt^(1/2) of W, so that no rule of stochastic calculus is taken for granted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from roadgym.parameters import ParameterError

from . import amplitude_errata, road_errata
from .check import KINDS, Check


def run(names: Iterable[str] | None = None, *, report: Callable[[str, int, int], None] | None = None) -> list[Check]:
    """Run the checks of these names; by default all.

    Args:
        names: of `CHECKS`.
        report: called as ``report(what, done, in all)``.

    Raises:
        ParameterError: an unknown name.
    """
    chosen = list(CHECKS if names is None else dict.fromkeys(names))
    for name in chosen:
        if name not in CHECKS:
            raise ParameterError(f"erratum must be one of {', '.join(CHECKS)}, got {name!r}")
    results = []
    for name in chosen:
        results.append(CHECKS[name](name))
        if report:
            report("errata", len(results), len(chosen))
    return results


def table(checks: Sequence[Check]) -> str:
    """The checks as text of at most 80 columns, by their kinds."""
    rows = [("", "printed", "off", "right", "off", "evidence")]
    for check in checks:
        numbers = (f"{check.printed:.5g}", check.off(check.printed), f"{check.right:.5g}", check.off(check.right))
        rows.append((check.name, *numbers, check.found_text()))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    texts = [
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]
    lines = []
    for kind, heading in KINDS.items():
        chosen = [(text, check) for text, check in zip(texts[1:], checks, strict=True) if check.kind == kind]
        if chosen:
            lines += [heading, texts[0]]
            for text, check in chosen:
                lines += [text, f"    {check.equation}: {check.quantity}"]
            lines.append("")
    return "\n".join([*lines, "Off: the evidence less the formula, in standard errors where it is simulated."])


CHECKS: dict[str, Callable[[str], Check]] = {
    check.__name__: check
    for check in (
        road_errata.level_rate,
        road_errata.marginal,
        road_errata.square_increment,
        road_errata.ellipse,
        amplitude_errata.product_rule,
        amplitude_errata.high_pass_increment,
        amplitude_errata.forcing,
        amplitude_errata.white_noise,
        amplitude_errata.resonance_induction,
        amplitude_errata.high_pass,
        amplitude_errata.top_exponent,
        amplitude_errata.stability_map,
        amplitude_errata.mean_exponent,
        road_errata.skew_symmetric,
        road_errata.high_speed,
        amplitude_errata.diagonal_term,
        amplitude_errata.limit_cycles,
        amplitude_errata.sum_angle,
        amplitude_errata.forcing_sign,
        amplitude_errata.road_rate,
    )
}
