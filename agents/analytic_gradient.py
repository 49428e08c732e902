"""Analytic policy gradient, as an algorithm of stable-baselines3: the mean cost, differentiated through the plant.

Algorithms of policy gradients that know nothing of the plant tell from the noise of many drives what another damping would have
cost. Here the plant is known, but for its road, and linear while D is held: what was driven is driven again in torch over the
same road (`agents.differentiable`), and the cost of a stretch of it, with a value for what comes after, is differentiated
through all its intervals by the weights of the policy.

Source: R. J. Williams, "On the use of backpropagation in associative reinforcement learning", ICNN 1988; with a value at the
end of a short horizon, J. Xu et al., "Accelerated policy learning with parallel differentiable simulation", ICLR 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from roadgym.installation import needs
from roadgym.parameters import ParameterError, non_negative, positive, shown, whole, within

from .differentiable import DrivenRoads
from .muon import Muon

with needs("train"):
    import torch
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
    from stable_baselines3.common.policies import BasePolicy
    from stable_baselines3.common.torch_layers import create_mlp
    from stable_baselines3.common.type_aliases import Schedule
    from stable_baselines3.common.utils import update_learning_rate
    from stable_baselines3.common.vec_env import VecEnv


class DampingPolicy(BasePolicy):
    """A network that answers with a number whose hyperbolic tangent is the action.

    With features that are even in the state, `agents.features`, it respects the symmetry of road and car exactly.

    Args:
        observation_space, action_space: of the environment.
        lr_schedule: learning rate by the share of training that is left.
        net_arch: sizes of the hidden layers.
        activation_fn: between them.
        noise: standard deviation of what is added to the answer where the policy is not deterministic.
        optimizer_class: what trains it; gradients of many cars have little noise, which suits `agents.muon.Muon`.
        options: of stable-baselines3's policies, such as ``optimizer_kwargs``; its extractors of features are not among them,
            which the gradient would not go through: see `agents.features`.

    Raises:
        ParameterError: an extractor of features.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: Sequence[int] = (64, 64),
        activation_fn: type[torch.nn.Module] = torch.nn.ReLU,
        noise: float = 0.0,
        optimizer_class: type[torch.optim.Optimizer] = Muon,
        **options: Any,
    ) -> None:
        if "features_extractor_class" in options:
            raise ParameterError("features_extractor_class must be left out for a gradient through the plant: choose features")
        super().__init__(observation_space, action_space, squash_output=True, optimizer_class=optimizer_class, **options)
        self.net_arch, self.activation_fn, self.noise = list(net_arch), activation_fn, noise
        self.features_extractor = self.make_features_extractor()
        self.network = torch.nn.Sequential(*create_mlp(self.features_extractor.features_dim, 1, self.net_arch, activation_fn))
        make: Any = self.optimizer_class
        self.optimizer = make(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"net_arch": self.net_arch, "activation_fn": self.activation_fn, "noise": self.noise}
        options = {name: getattr(self, name) for name in ("optimizer_class", "optimizer_kwargs")}
        return super()._get_constructor_parameters() | own | options | {"lr_schedule": self._dummy_schedule}

    def forward(self, observations: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Actions in [-1, 1], shape (n, 1)."""
        answer = self.network(self.extract_features(observations, self.features_extractor))
        return torch.tanh(answer if deterministic else answer + self.noise * torch.randn_like(answer))

    def _predict(self, observation: Any, deterministic: bool = False) -> torch.Tensor:
        return self.forward(observation, deterministic)


class APG(OnPolicyAlgorithm):
    """Analytic policy gradient on an `agents.vec_env.QuarterCarVecEnv`, within any of stable-baselines3's wrappers.

    Rewards are not looked at: what is learned is the least mean cost of the environment itself.

    Args:
        policy: "MlpPolicy", a `DampingPolicy`.
        env: the environment.
        learning_rate: of the policy's optimiser, or its schedule.
        n_steps: control intervals of every car in a visit to the plant.
        horizon: intervals of a stretch through which is differentiated at the end of the training, at most ``n_steps``.
        first_share: share of the ``horizon`` from which stretches grow by equal factors, visit by visit. Short
            ones teach by and large what is to be done, and long ones rely less on the value of what comes after.
        lookahead_steps: steps of the optimiser before all others, after the first visit, with a rate that falls to zero: they
            look one interval ahead, behind a late valve as many more as a command waits, so that the policy begins where a
            lookahead without learning ends.
        gradient_steps: stretches of ``horizon`` after each visit, one for each step of the optimiser; of shorter ones as many
            more, so that all visits are differentiated through as many intervals. Each is of all cars.
        noise: standard deviation of normal noise on what the policy answers, before it is squashed, in training: so it learns
            too where it would be at an end of the range.
        state_known: share of the training, its beginning, in which the policy sees the state itself along its stretches where
            it drives by what an estimator makes of sensors: so much is learned sooner, and certainty equivalence by and large.
        max_grad_norm: at most the norm of a gradient.
        policy_kwargs, stats_window_size, tensorboard_log, verbose, seed: as of stable-baselines3's algorithms.
        device: "cpu", where the plant is, or "auto", which is the same.

    Raises:
        ParameterError: one of these out of range, or an environment that cannot be differentiated.
    """

    learns_from: ClassVar[str] = "gradient"  # as agent.json tells
    lookahead_steps: int = 0  # of trainings that began before there were any
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": DampingPolicy}

    def __init__(
        self,
        policy: str | type[DampingPolicy],
        env: VecEnv,
        learning_rate: float | Schedule = 3e-3,
        n_steps: int = 64,
        horizon: int = 32,
        first_share: float = 1.0,
        lookahead_steps: int = 0,
        gradient_steps: int = 8,
        noise: float = 0.1,
        state_known: float = 0.5,
        max_grad_norm: float = 1.0,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        _init_setup_model: bool = True,
    ) -> None:
        self.horizon = whole("horizon", horizon)
        self.first_share = within("first_share", first_share, "mixing")
        self.lookahead_steps = whole("lookahead_steps", lookahead_steps, low=0)
        self.gradient_steps = whole("gradient_steps", gradient_steps)
        self.noise = non_negative("noise", noise)
        self.state_known = within("state_known", state_known, "mixing")
        if str(device) not in ("auto", "cpu"):
            raise ParameterError(f"device must be cpu for a gradient through the plant, got {shown(device)}")
        if whole("n_steps", n_steps) < horizon:
            raise ParameterError(f"horizon must be at most n_steps, {n_steps}, got {shown(horizon)}")
        super().__init__(
            policy,  # type: ignore[arg-type]
            env,
            learning_rate,
            n_steps=n_steps,
            gamma=1.0,
            gae_lambda=1.0,
            ent_coef=0.0,
            vf_coef=0.0,
            max_grad_norm=positive("max_grad_norm", max_grad_norm),
            use_sde=False,
            sde_sample_freq=-1,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs={"noise": noise} | (policy_kwargs or {}),
            verbose=verbose,
            seed=seed,
            device="cpu",
            supported_action_spaces=(spaces.Box,),
            _init_setup_model=_init_setup_model,
        )

    def _setup_model(self) -> None:
        """Make the network, and where there is an environment what records its roads."""
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        made = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs)
        self.policy = made.to(self.device)  # type: ignore[assignment]
        if self.env is not None:
            self.rollout_buffer = self._recorder(self.env)  # type: ignore[assignment]

    def _recorder(self, env: VecEnv) -> DrivenRoads:
        driven = getattr(env.unwrapped, "driven_roads", None)
        if driven is None:
            raise ParameterError(f"env must be a QuarterCarVecEnv for a gradient through the plant, got {shown(env.unwrapped)}")
        found: DrivenRoads = driven(self.n_steps)
        return found

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """Go on in another environment."""
        super().set_env(env, force_reset)
        assert self.env is not None
        self.rollout_buffer = self._recorder(self.env)  # type: ignore[assignment]

    def _setup_learn(self, total_timesteps: int, callback: Any = None, reset_num_timesteps: bool = True, *given: Any) -> Any:
        """Begin a training, with new episodes where stable-baselines3 begins those."""
        if reset_num_timesteps and self.env is not None:
            self.rollout_buffer = self._recorder(self.env)  # type: ignore[assignment]
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *given)

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, rollout_buffer: Any, n_rollout_steps: int) -> bool:
        """Drive with the policy and record the roads; false where a callback ends the training."""
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        batch: Any = env.unwrapped
        for step in range(n_rollout_steps):
            seen: Any = self._last_obs
            rollout_buffer.note(step, *batch.road_and_car())
            with torch.no_grad():
                actions = self.policy(torch.as_tensor(seen)).numpy()
            new_obs: Any
            new_obs, rewards, dones, infos = env.step(actions)
            self.num_timesteps += env.num_envs
            rollout_buffer.answer(step, seen, actions, dones)
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
            self._last_obs, self._last_episode_starts = new_obs, dones
        rollout_buffer.note(n_rollout_steps, *batch.road_and_car())
        rollout_buffer.finish()
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """Some steps down the gradient of the cost over what was driven last."""
        self.policy.set_training_mode(True)
        self._current_progress_remaining = max(0.0, self._current_progress_remaining)  # a visit may end beyond the training
        self._update_learning_rate(self.policy.optimizer)
        roads: Any = self.rollout_buffer
        done = 1 - self._current_progress_remaining
        first = max(1.0, self.first_share * self.horizon)
        starts, length = roads.windows(round(first * (self.horizon / first) ** done))
        if self.lookahead_steps and self._n_updates == 0:
            self._look_ahead(roads)
        known, found = done <= self.state_known, []
        for _ in range(round(self.gradient_steps * self.horizon / length)):
            found.append(self._descend(roads, starts, length, known))
        cost, norm = np.mean(found, axis=0)
        self.logger.record("train/cost", cost)  # with the value of the end, so that each length has costs of its own
        self.logger.record("train/gradient_norm", norm)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _look_ahead(self, roads: Any) -> None:
        """Learn the damping that is best for one interval, or the next that a command reaches, where a value follows it."""
        starts, length = roads.windows(1 + roads.late)
        for step in range(self.lookahead_steps):
            update_learning_rate(self.policy.optimizer, self.lr_schedule(1) * (1 - step / self.lookahead_steps))
            self._descend(roads, starts, length, known=True)
        self._update_learning_rate(self.policy.optimizer)

    def _descend(self, roads: Any, starts: npt.NDArray[np.intp], length: int, known: bool) -> tuple[float, float]:
        """One step down the gradient of the cost of one stretch of all cars; that cost, and the norm of the gradient."""
        start = int(starts[int(torch.randint(len(starts), ()))])
        cost = roads.cost(self.policy.network, start, length, self.noise, known)
        self.policy.optimizer.zero_grad()
        cost.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()
        self._n_updates += 1
        return float(cost.detach()), float(norm)
