"""A valve as torch sees it: what a command does to the damping in force, now and later, with gradients.

As in `roadgym.actuation`, but for the limit of its rate, and in the mean over a control interval: the car takes it as if it
were held. What that leaves out, where D moves fast within an interval, stays what it was in the recorded drive. The gradient of
a level that is chosen is that of the command itself (Y. Bengio, N. Leonard and A. Courville, "Estimating or propagating
gradients through stochastic neurons for conditional computation", arXiv 1308.3432, 2013: straight through).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadgym.installation import needs
from roadgym.task import Task

with needs("train"):
    import torch
    from torch import Tensor

SOFTEST = -1.0  # place of the softest damping, which a valve has been told for long at a start


class DrivenValve:
    """The valves of a batch while it is recorded, and when it is driven again; each D is a place in its range, -1 to 1.

    Args:
        task: the plant, whose valve has no limited rate.
        num_envs: cars of the batch.
        steps: control intervals that are recorded.
    """

    def __init__(self, task: Task, num_envs: int, steps: int) -> None:
        interval = task.control_interval * task.car.natural_frequency
        numbers = task.valve.numbers(task.control_interval, task.car.natural_frequency)
        self._late, part = int(numbers["valve_late"]), float(numbers["valve_part"])
        self._step = 2 / (int(numbers["valve_levels"]) - 1) if numbers["valve_levels"] else None
        self._pieces = []  # until the newer command arrives, and after
        for waits, share in ((self._late + 1, part), (self._late, 1 - part)):
            constants = np.maximum([float(numbers["valve_rise"]), float(numbers["valve_fall"])], 1e-12)
            left = np.exp(-share * interval / constants)
            if share:
                self._pieces.append((waits, share, left.tolist(), (constants / interval * (1 - left)).tolist()))
        self._now = torch.full((num_envs, 2 + self._late), SOFTEST)
        self._states = torch.empty(steps, *self._now.shape)

    def note(self, step: int, commands: Tensor, ended: npt.NDArray[np.bool_]) -> Tensor:
        """Record the commands of a step, shape (num_envs,), and whose episode ended with it; the mean D of the interval."""
        self._states[step] = self._now
        mean, self._now = self(self._now, commands)
        self._now[torch.from_numpy(ended)] = SOFTEST
        return mean

    def begin(self, step: int, rows: Tensor | slice) -> Tensor:
        """The valves of some cars as they were at the beginning of a step: D in force, and commands that wait, newest first."""
        return self._states[step, rows]

    def __call__(self, state: Tensor, command: Tensor) -> tuple[Tensor, Tensor]:
        """(mean D over an interval, shape (n,), state at its end, D in force first), from a state and commands."""
        if self._step is not None:
            level = ((command + 1) / self._step).round() * self._step - 1
            command = command + (level - command).detach()
        waiting = torch.cat([command[:, None], state[:, 1:]], 1)
        value, mean = state[:, 0], torch.zeros_like(command)
        for waits, share, (up, down), (rising, falling) in self._pieces:
            target = waiting[:, waits]
            gap = value - target
            rises = gap < 0
            mean = mean + share * target + gap * torch.where(rises, rising, falling)
            value = target + gap * torch.where(rises, up, down)
        return mean, torch.cat([value[:, None], waiting[:, :-1]], 1)
