"""A valve as torch sees it: what a command does to the damping in force, now and later, with gradients.

As in `roadgym.actuation`, but for the limit of its rate, and in the mean over a control interval: the car takes it as if it
were held. What that leaves out, where D moves fast within an interval, stays what it was in the recorded drive. The gradient of
a level that is chosen is that of the command itself (Y. Bengio, N. Leonard and A. Courville, "Estimating or propagating
gradients through stochastic neurons for conditional computation", arXiv 1308.3432, 2013: straight through).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from roadgym.installation import needs
from roadgym.task import Task
from roadgym.valve import Valve

with needs("train"):
    import torch
    from torch import Tensor

SOFTEST = -1.0  # place of the softest damping, which a valve has been told for long at a start
NUMBERS = 6  # of a piece of an interval


class DrivenValve:
    """The valves of a batch while it is recorded, and when it is driven again; each D is a place in its range, -1 to 1.

    The state of a valve is D in force, the commands that wait, newest first, and two pieces of the interval, until the newer
    command arrives and after: which of them is the target, for what share of the interval, and what of the gap to the target is
    left at the end, rising and falling, and in the mean.

    Args:
        task: the plant, whose valves have no limited rate.
        num_envs: cars of the batch.
        steps: control intervals that are recorded.

    Attributes:
        late: whole intervals that a command waits, of the slowest valve that there may be.
    """

    def __init__(self, task: Task, num_envs: int, steps: int) -> None:
        self._vary, self._interval, self._w1 = task.vary, task.control_interval, task.car.natural_frequency
        slowest = task.valve if task.vary is None else task.vary.slowest_valve
        levels, self.late = task.valve.levels, math.floor(round(slowest.delay / self._interval, 9))
        self._step = None if levels is None else 2 / (levels - 1)
        self._now = torch.full((num_envs, 2 + self.late + 2 * NUMBERS), SOFTEST)
        self._now[:, -2 * NUMBERS :] = torch.tensor(self._pieces(task.valve))
        self._drawn = np.empty(0)
        self._states = torch.empty(steps, *self._now.shape)

    def _pieces(self, valve: Valve) -> list[float]:
        """The numbers of the two pieces of an interval."""
        numbers, interval = valve.numbers(self._interval, self._w1), self._interval * self._w1
        late, part = int(numbers["valve_late"]), float(numbers["valve_part"])
        constants = np.maximum([float(numbers["valve_rise"]), float(numbers["valve_fall"])], 1e-12)
        found = []
        for waits, share in ((late + 1, part), (late, 1 - part)):
            left = np.exp(-share * interval / constants)
            found += [waits, share, *left, *(constants / interval * (1 - left))]
        return [float(number) for number in found]

    def meet(self, drawn: npt.NDArray[np.float64]) -> None:
        """Take the valves of those fields of the cars that vary, shape (fields, num_envs)."""
        if self._vary is not None and drawn is not self._drawn:
            self._drawn = drawn
            pieces = [self._pieces(self._vary.drawn(values)[1]) for values in drawn.T.tolist()]
            self._now[:, -2 * NUMBERS :] = torch.tensor(pieces)

    def note(self, step: int, commands: Tensor, ended: npt.NDArray[np.bool_]) -> Tensor:
        """Record the commands of a step, shape (num_envs,), and whose episode ended with it; the mean D of the interval."""
        self._states[step] = self._now
        mean, self._now = self(self._now, commands)
        self._now[torch.from_numpy(ended), : -2 * NUMBERS] = SOFTEST
        return mean

    def begin(self, step: int) -> Tensor:
        """The valves as they were at the beginning of a step."""
        return self._states[step]

    def __call__(self, state: Tensor, command: Tensor) -> tuple[Tensor, Tensor]:
        """(mean D over an interval, shape (n,), state at its end), from a state and commands."""
        if self._step is not None:
            level = ((command + 1) / self._step).round() * self._step - 1
            command = command + (level - command).detach()
        own = state[:, -2 * NUMBERS :]
        waiting = torch.cat([command[:, None], state[:, 1 : -2 * NUMBERS]], 1)
        value, mean = state[:, 0], torch.zeros_like(command)
        for piece in (own[:, :NUMBERS], own[:, NUMBERS:]):
            waits, share, up, down, rising, falling = piece.unbind(1)
            target = waiting.gather(1, waits[:, None].long())[:, 0]
            gap = value - target
            rises = gap < 0
            mean = mean + share * target + gap * torch.where(rises, rising, falling)
            value = target + gap * torch.where(rises, up, down)
        return mean, torch.cat([value[:, None], waiting[:, :-1], own], 1)
