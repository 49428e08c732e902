"""Who is trained on the suite: learners that know nothing of theory, and this project's own choice for each task.

Plain learners are those of stable-baselines3: they see what the task observes, and products of it, and learn from the reward,
with the hyperparameters that are shipped for them. A recipe takes what this project knows: a gradient through the plant,
theory's lookahead among what is seen, a Kalman filter where the state is hidden.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from roadgym.parameters import ParameterError, shown
from roadgym.suite import SuiteTask

from ..hyperparameters import load_hyperparameters


@dataclasses.dataclass(frozen=True, kw_only=True)
class Learner:
    """How agents are trained on a task.

    Attributes:
        title: what it is called in tables.
        kind: of `agents.suite.entries.KINDS`.
        algorithm: a key of `agents.agent.ALGORITHMS`.
        file: name of a shipped file of hyperparameters.
        changes: hyperparameters in place of those in the file.
        timesteps: control intervals over all environments.
    """

    title: str
    kind: str
    algorithm: str
    file: str
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    timesteps: int

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """All of them."""
        return {**load_hyperparameters(self.algorithm, self.file), **self.changes}


BLIND = {"features": ["signals", "products"]}  # no lookahead
APG = Learner(title="APG", kind="recipe", algorithm="apg", file="apg", timesteps=1_536_000)
FILTERED = dataclasses.replace(APG, title="APG, filtered", changes={"estimator": "kalman"}, timesteps=768_000)
PPO = Learner(title="PPO", kind="plain", algorithm="ppo", file="ppo_plain", timesteps=1_015_808)
RECURRENT = Learner(title="recurrent PPO", kind="plain", algorithm="recurrent_ppo", file="recurrent_ppo", timesteps=507_904)
LEARNERS: Mapping[str, Learner] = {  # of every task, but for those of `OWN`
    "own": APG,
    "ppo": PPO,
    "recurrent_ppo": RECURRENT,
    "sac": Learner(title="SAC", kind="plain", algorithm="sac", file="sac", changes=BLIND, timesteps=100_032),
    "td3": Learner(title="TD3", kind="plain", algorithm="td3", file="td3", changes=BLIND, timesteps=100_032),
}
OWN: Mapping[str, Learner] = {  # what this project trains on tasks that need more than its usual recipe
    "Schedule-v0": dataclasses.replace(PPO, title="bandit PPO", file="ppo_scheduling", timesteps=2_506_752),
    "OneAccelerometer-v0": FILTERED,
    "Explore-v0": FILTERED,
}


def learner_of(task: SuiteTask, name: str) -> Learner:
    """The learner of this name on ``task``.

    Raises:
        ParameterError: there is none.
    """
    if name not in LEARNERS:
        raise ParameterError(f"learner must be one of {', '.join(LEARNERS)}, got {shown(name)}")
    return OWN.get(task.name, APG) if name == "own" else LEARNERS[name]
