"""A lower bound of the cost of every controller, and how far it is to be trusted."""

from __future__ import annotations

import dataclasses

from roadgym.task import Task

PROVED = "proved"
SOLVED = "proved up to the solver's residual, which is charged"
STATISTICAL = "statistical"
RIGOURS = (PROVED, SOLVED, STATISTICAL)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LowerBound:
    """No controller whose damping stays within the range costs less than this in the mean, whatever it sees or remembers.

    Attributes:
        cost: minus the mean reward.
        method: how it was found.
        assumption: what it takes for granted, in a few words.
        rigour: `PROVED`, `SOLVED` or `STATISTICAL`.
        standard_error: of the cost, where it is statistical.
    """

    cost: float
    method: str
    assumption: str
    rigour: str
    standard_error: float = 0.0

    @property
    def safe(self) -> float:
        """The cost less two standard errors."""
        return self.cost - 2 * self.standard_error


def common_refusal(task: Task) -> str | None:
    """Why no method has a bound for ``task``, in a few words; None where one may have."""
    if task.vary is not None:
        return "cars that differ from episode to episode"
    if task.speed_noise is not None:
        return f"{task.speed_noise.kind} noise on the speed"
    return None
