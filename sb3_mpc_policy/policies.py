"""MpcLcsPolicy: a Gaussian policy whose mean is the first action of a plan over a learned contact model."""

from __future__ import annotations

import contextlib
import copy
import warnings
from collections.abc import Iterator, Mapping
from typing import Any, Self

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import get_device
from torch import nn

from sb3_mpc_policy.contact_fit import fit_contacts
from sb3_mpc_policy.exploration import MOST_NOISE, WanderingTarget
from sb3_mpc_policy.lcs import LinearComplementaritySystem
from sb3_mpc_policy.model_fit import MODEL_FITS, fit_tangent
from sb3_mpc_policy.mpc import ControllerStatistics, LcsMpc, MpcPlan
from sb3_mpc_policy.prediction import PREDICTION_LOSSES, add_to_backward, step_deviation
from sb3_mpc_policy.reward import QuadraticReward, fit_cost, is_flat
from sb3_mpc_policy.terminal_value import TERMINAL_VALUES, QuadraticCritic
from sb3_mpc_policy.transitions import TransitionStore

__all__ = ["MpcLcsPolicy"]

# The loss is taken over at most this many transitions, drawn anew for each rollout where there are more.
_LARGEST_LOSS_BATCH = 4096
# The fits between rollouts take the latest of this many, so that a long run's rollouts do not take longer and longer.
_LARGEST_FIT = 20_000
# n_contacts="auto": room for so many.
_AUTO_CONTACTS = 4
# Exploration at the start, as a share of the action scale.
_INITIAL_NOISE = 0.2

# How the model learns, by name; each entry can be overridden by the argument of the same name.
PRESETS: dict[str, dict[str, Any]] = {
    "default": {"model_fit": "contacts", "replay": True, "prediction_loss": "prediction"},
    # Algorithm 1 as printed: nothing but eq (16), on the current rollout D_k
    "paper": {"model_fit": "gradient", "replay": False, "prediction_loss": "prediction"},
}


class MpcLcsPolicy(ActorCriticPolicy):
    """Actor-critic policy for PPO and A2C, ``a ~ N(mu(s), xi)`` with ``mu`` the first action of eq (6).

    Everything but the mean is Stable-Baselines3's own: the critic (unless ``terminal_value="critic"``), the Gaussian,
    ``forward``, ``evaluate_actions`` up to the prediction loss, saving and loading. The transitions the model has
    learned from travel with the policy, so that training goes on where it stopped.

    :param observation_space: one-dimensional Box
    :param action_space: one-dimensional Box
    :param lr_schedule: learning rate, a function of the remaining progress
    :param net_arch: layers of the critic, a list or ``dict(vf=[...])``
    :param log_std_init: logarithm of the initial standard deviation of every action, environment units; a fifth of
        the action scale where None
    :param horizon: H >= 1, control steps
    :param n_contacts: n_lambda >= 0, with ``model_fit="contacts"`` at most so many; "auto" for as many as are found, up
        to four. Contacts that are not in use cost no time
    :param reward: a :class:`QuadraticReward`, or its arguments as a dict; None to learn one from the rewards observed
    :param terminal_value: "riccati", "critic" or "none"
    :param penalty: rho of the relaxation's first pass, relative to the size of the cost; it stiffens from pass to pass
    :param smoothing: epsilon of the relaxation, scaled coordinates
    :param n_iterations: most passes of the relaxation
    :param solver: "auto", "daqp", "torch" or "cvxpylayers"
    :param check: whether every solution must meet the optimality conditions; the regulator stands in for one that
        does not
    :param prediction_coef: alpha of eq (15)
    :param preset: "default", or "paper" for Algorithm 1 as printed; sets ``prediction_loss``, ``model_fit`` and
        ``replay`` where they are None, and whether noise is limited to a quarter of the range of a bounded action
    :param prediction_loss: "prediction" (eq 12) or "violation" (Jin et al. 2022)
    :param model_fit: what is fitted directly between rollouts: "contacts" for the whole model, "least_squares" for A, B
        and d only, or "gradient" for nothing, eq (16) alone
    :param fit_updates: number of updates after which the model is left to the gradient; None for never
    :param policy_gradient: whether the gradient of PPO's own loss reaches the model, as in eq (16)
    :param replay: True to learn from all transitions so far, False from the current rollout alone (the paper's D_k)
    :param state_scale: (n_x,) size of each state where the controller works; the spread of the first rollout where
        None, so pass it where rollouts are as short as A2C's
    :param action_scale: (n_a,); half the range of a bounded action, else one, where None
    :param initial_lcs: start from this model (copied); n_contacts and the scales are then those of the model
    :param target_noise: how far rollouts may take place from the target, in scaled units, so that contacts out of the
        controller's way are found (exploration.py); 0 for nowhere else. Predictions are not concerned
    :param kwargs: further arguments of ``ActorCriticPolicy``
    :raise ValueError: for spaces or arguments that the controller has no use for; the message says which
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.Tanh,
        ortho_init: bool = True,
        use_sde: bool = False,
        log_std_init: float | None = None,
        *,
        horizon: int = 10,
        n_contacts: int | str = 2,
        reward: QuadraticReward | dict[str, Any] | None = None,
        terminal_value: str = "riccati",
        penalty: float = 100.0,
        smoothing: float = 0.0,
        n_iterations: int = 6,
        solver: str = "auto",
        check: bool = False,
        prediction_coef: float = 100.0,
        preset: str = "default",
        prediction_loss: str | None = None,
        model_fit: str | None = None,
        fit_updates: int | None = None,
        policy_gradient: bool = True,
        replay: bool | None = None,
        state_scale: ArrayLike | None = None,
        action_scale: ArrayLike | None = None,
        initial_lcs: LinearComplementaritySystem | None = None,
        target_noise: float = 0.0,
        **kwargs: Any,
    ) -> None:
        n_states, n_actions = _check_spaces(observation_space, action_space)
        if use_sde:
            raise ValueError("use_sde must be False: MpcLcsPolicy has the paper's Gaussian (eq 1), got True")
        extractor = kwargs.get("features_extractor_class", FlattenExtractor)
        if extractor is not FlattenExtractor:
            raise ValueError(
                f"features_extractor_class must be FlattenExtractor: the model needs the state, got {extractor}"
            )
        if not (np.isfinite(prediction_coef) and prediction_coef >= 0):
            raise ValueError(f"prediction_coef must be a finite number >= 0, got {prediction_coef!r}")
        if fit_updates is not None and (int(fit_updates) != fit_updates or fit_updates < 0):
            raise ValueError(f"fit_updates must be an integer >= 0 or None, got {fit_updates!r}")
        if preset not in PRESETS:
            raise ValueError(f"preset must be one of {sorted(PRESETS)}, got {preset!r}")
        prediction_loss = PRESETS[preset]["prediction_loss"] if prediction_loss is None else prediction_loss
        model_fit = PRESETS[preset]["model_fit"] if model_fit is None else model_fit
        replay = PRESETS[preset]["replay"] if replay is None else replay
        for name, value, accepted in (
            ("terminal_value", terminal_value, TERMINAL_VALUES),
            ("prediction_loss", prediction_loss, PREDICTION_LOSSES),
            ("model_fit", model_fit, MODEL_FITS),
        ):
            if value not in accepted:
                raise ValueError(f"{name} must be one of {sorted(accepted)}, got {value!r}")
        if isinstance(n_contacts, str) and (n_contacts != "auto" or model_fit != "contacts"):
            raise ValueError(
                "n_contacts must be an integer >= 0, or 'auto' with model_fit='contacts'; "
                f"got {n_contacts!r} with model_fit={model_fit!r}"
            )
        if isinstance(reward, dict):
            reward = QuadraticReward(**reward)
        if reward is not None and not isinstance(reward, QuadraticReward):
            raise TypeError(f"reward must be a QuadraticReward, a dict of its arguments or None, got {reward!r}")

        self._mpc_arguments: dict[str, Any] = dict(
            horizon=horizon, n_contacts=n_contacts, reward=reward, terminal_value=terminal_value, penalty=penalty,
            smoothing=smoothing, n_iterations=n_iterations, solver=solver, check=check, prediction_coef=prediction_coef,
            preset=preset, prediction_loss=prediction_loss, model_fit=model_fit, fit_updates=fit_updates,
            policy_gradient=policy_gradient, replay=replay, state_scale=state_scale, action_scale=action_scale,
            initial_lcs=initial_lcs, log_std_init=log_std_init, target_noise=target_noise,
        )  # fmt: skip
        self._sizes = n_states, n_actions
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=dict(pi=[], vf=_critic_layers(net_arch, terminal_value)),
            activation_fn=activation_fn,
            ortho_init=ortho_init,
            use_sde=False,
            log_std_init=0.0,
            **kwargs,
        )

    _scale_is_set: torch.Tensor
    _fits: torch.Tensor
    value_net: nn.Module  # type: ignore[assignment]  # linear, or a QuadraticCritic

    # -- construction -------------------------------------------------------------------------------------------

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        given = self._mpc_arguments
        space = self.action_space
        assert isinstance(space, spaces.Box)
        low, high = (np.asarray(bound, dtype=np.float64).ravel() for bound in (space.low, space.high))
        lcs = _make_lcs(self._sizes, given, low, high)
        self.action_net = LcsMpc(
            lcs, given["reward"], low, high, given["horizon"], given["terminal_value"], given["penalty"],
            given["smoothing"], given["n_iterations"], given["solver"], given["check"],
        )  # fmt: skip
        scale_is_known = given["state_scale"] is not None or given["initial_lcs"] is not None
        self.register_buffer("_scale_is_set", torch.tensor(scale_is_known))
        self.register_buffer("_fits", torch.tensor(0))
        if self.mpc.terminal_value.needs_quadratic_critic:
            self.value_net = QuadraticCritic(lcs.state_scale)
        if given["log_std_init"] is None:
            log_std = torch.log(_INITIAL_NOISE * lcs.action_scale).float()
        else:
            log_std = torch.full((self._sizes[1],), float(given["log_std_init"]))
        with torch.no_grad():
            self.log_std.copy_(log_std)

        self.store = TransitionStore(*self._sizes)
        self._loss_data: tuple[torch.Tensor, ...] | None = None
        self._losses: list[float] = []
        self._target = WanderingTarget(*self._sizes, given["target_noise"])
        self._is_exploring = False
        self._warned_of_flat_reward = False
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        for of_gsde in ("squash_output", "full_std", "use_expln"):
            data.pop(of_gsde, None)
        data["share_features_extractor"] = self.share_features_extractor
        return data | self._mpc_arguments

    @classmethod
    def load(cls, path: str, device: torch.device | str = "auto") -> Self:
        """As in the base class.

        :raise ValueError: for a file that another policy class saved
        """
        device = get_device(device)
        saved = torch.load(path, map_location=device, weights_only=False)
        unknown = {"horizon", "n_contacts"} - set(saved["data"])
        if unknown:
            raise ValueError(
                f"{path} must be a file saved by {cls.__name__}; another policy class, such as MlpPolicy, saved this "
                f"one: it lacks {sorted(unknown)} and has {sorted(saved['data'])}"
            )
        policy = cls(**saved["data"])
        policy.load_state_dict(saved["state_dict"])
        policy.to(device)
        return policy

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """As in the base class.

        :raise ValueError: where all of the state is asked for, and it is that of another policy class
        """
        if strict and "action_net.lcs.A_scaled" not in state_dict:
            raise ValueError(
                f"state_dict must be that of an {type(self).__name__}; this one has no learned model, so it is from "
                f"another policy class, such as MlpPolicy: it has {sorted(state_dict)}"
            )
        return super().load_state_dict(state_dict, strict, assign)

    @torch.no_grad()
    def load_from_vector(self, vector: np.ndarray) -> None:
        """As in the base class, which would turn the model's float64 into float32."""
        flat = torch.as_tensor(vector, device=self.device)
        parts = flat.split([parameter.numel() for parameter in self.parameters()])
        for parameter, part in zip(self.parameters(), parts, strict=True):
            parameter.copy_(part.view_as(parameter))

    def get_extra_state(self) -> torch.Tensor:
        """The transitions seen, saved with the weights."""
        return torch.as_tensor(self.store.rows())

    def set_extra_state(self, state: torch.Tensor) -> None:
        self.store.restore(state.cpu().numpy())

    # -- public -------------------------------------------------------------------------------------------------

    @property
    def mpc(self) -> LcsMpc:
        """The controller."""
        controller = self.action_net
        assert isinstance(controller, LcsMpc)
        return controller

    @property
    def lcs(self) -> LinearComplementaritySystem:
        """The learned model."""
        return self.mpc.lcs

    def plan(self, observation: np.ndarray, previous: MpcPlan | None = None) -> MpcPlan:
        """The plan behind the action.

        :param observation: (N, n_x) or (n_x,)
        :param previous: the plan made one step earlier, see :meth:`LcsMpc.plan`
        """
        return self.mpc.plan(np.asarray(observation, dtype=np.float64), previous)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        if not deterministic:
            return super()._predict(observation, deterministic)
        # the mode of the Gaussian, without making one
        mean: torch.Tensor = self.mpc(BasePolicy.extract_features(self, observation, self.pi_features_extractor))
        return mean

    def forward(
        self, obs: torch.Tensor, deterministic: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """As in the base class. Rollouts are collected by this, so the target is the one that wanders."""
        with self._exploring():
            return super().forward(obs, deterministic)

    @contextlib.contextmanager
    def _exploring(self) -> Iterator[None]:
        self._is_exploring = True
        try:
            yield
        finally:
            self._is_exploring = False

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Distribution:
        if not (self._is_exploring and self._target.is_shifted):
            return super()._get_action_dist_from_latent(latent_pi)
        state, action = (latent_pi.new_tensor(part) for part in (self._target.state, self._target.action))
        assert isinstance(self.action_dist, DiagGaussianDistribution)
        return self.action_dist.proba_distribution(self.mpc(latent_pi - state) + action, self.log_std)

    def set_training_mode(self, mode: bool) -> None:
        """As in the base class, which visits every module for each action, also where nothing changes."""
        if mode != self.training:
            super().set_training_mode(mode)

    def evaluate_actions(
        self, obs: PyTorchObs, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """As in the base class; a backward pass through the log-probabilities adds ``alpha L_pred`` (eq 16).

        :raise RuntimeError: while training, where no transitions have been handed over
        """
        with self._exploring():
            if not torch.is_grad_enabled():
                return super().evaluate_actions(obs, actions)
            if self._mpc_arguments["policy_gradient"]:
                values, log_prob, entropy = super().evaluate_actions(obs, actions)
            else:
                self.lcs.requires_grad_(False)
                try:
                    values, log_prob, entropy = super().evaluate_actions(obs, actions)
                finally:
                    self.lcs.requires_grad_(True)
        # it keeps the graph of this batch, and a policy that holds a graph cannot be copied
        self.action_dist.distribution = None  # type: ignore[assignment]  # as in a new policy
        loss = self.prediction_loss()
        self._losses.append(loss.item())
        return values, add_to_backward(log_prob, self._mpc_arguments["prediction_coef"] * loss), entropy

    def prediction_loss(self) -> torch.Tensor:
        """``L_pred`` on the transitions of the update in progress, a float64 number with gradient.

        :raise RuntimeError: where no transitions have been handed over for this update
        """
        if self._loss_data is None:
            raise RuntimeError(
                "MpcLcsPolicy has no transitions to learn its model from. PPO and A2C record them in learn() once "
                "sb3_mpc_policy is imported; any other algorithm needs callback=PredictionLossCallback() in learn(), "
                "and a training loop of one's own must drive that callback"
            )
        return PREDICTION_LOSSES[self._mpc_arguments["prediction_loss"]](self.lcs, *self._loss_data)

    # -- what the callback drives -------------------------------------------------------------------------------

    def prepare_update(self) -> None:
        """A rollout ended: choose the transitions that the coming update's prediction loss is taken over."""
        if not self._scale_is_set:
            self._set_scale()
        data = self.store.everything() if self._mpc_arguments["replay"] else self.store.rollout()
        deviation = step_deviation(data.s, data.s_next)
        if len(data.s) > _LARGEST_LOSS_BATCH:
            data = data.take(torch.randperm(len(data.s))[:_LARGEST_LOSS_BATCH].numpy())
        arrays = (data.s, data.a, data.s_next, deviation)
        self._loss_data = tuple(torch.as_tensor(array, device=self.device) for array in arrays)
        self._losses.clear()

    def end_update(self, reward_scale: float = 1.0) -> dict[str, float]:
        """An update ended: fit what is not left to the gradient, and bring the controller up to date.

        :param reward_scale: what the rewards that the critic saw were divided by
        :return: what there is to log
        """
        log: dict[str, float] = {}
        data = self.store.latest(_LARGEST_FIT) if self._mpc_arguments["replay"] else self.store.rollout()
        if len(data.s):  # none before the first rollout, nor, without replay, after loading
            if self._mpc_arguments["reward"] is None:
                scales = self.lcs.state_scale.cpu().numpy(), self.lcs.action_scale.cpu().numpy()
                if len(data.reward) > 1 and is_flat(data.reward):
                    self._warn_of_flat_reward()
                cost, log["train/reward_loss"] = fit_cost(data.s, data.a, data.reward, *scales)
                self.mpc.set_cost(cost)
            target, prior = self.mpc.target(), self._mpc_arguments["initial_lcs"]
            model_fit = self._model_fit()
            if model_fit == "contacts" and self.lcs.n_contacts:
                log["train/n_contacts"] = fit_contacts(self.lcs, data, target, prior)
            if model_fit != "gradient":
                log["train/model_fit_error"] = fit_tangent(self.lcs, data, target, prior)
                self._fits += 1
            self._target.move(self.lcs)
        if self._mpc_arguments["preset"] != "paper":
            self._limit_noise()
        if self._losses:
            log["train/prediction_loss"] = float(np.mean(self._losses))
        self._loss_data = None  # the next update needs its own
        critic = self.value_net if isinstance(self.value_net, QuadraticCritic) else None
        self.mpc.refresh(critic, reward_scale)
        return log | self._controller_log()

    def _model_fit(self) -> str:
        """What the coming fit is of."""
        most = self._mpc_arguments["fit_updates"]
        return "gradient" if most is not None and self._fits >= most else str(self._mpc_arguments["model_fit"])

    def end_training(self) -> None:
        """Training ended: nothing explores any more."""
        self._target.reset()

    @torch.no_grad()
    def _limit_noise(self) -> None:
        half_range = (self.mpc.action_high - self.mpc.action_low) / 2
        self.log_std.clamp_(max=self.log_std.new_tensor(np.log(MOST_NOISE * half_range)))

    def _set_scale(self) -> None:
        """Freeze the state scale, the spread of the first rollout, before anything is learned in its units."""
        spread = self.store.everything().s.std(axis=0)
        if not spread.any():
            return  # a single state: there will be more
        scale = np.maximum(spread, 1e-3 * max(float(spread.max()), 1e-6))
        self.lcs.set_scales(scale)
        if isinstance(self.value_net, QuadraticCritic):
            self.value_net.state_scale.copy_(torch.as_tensor(scale))
        self._scale_is_set.fill_(True)
        self.mpc.refresh()

    def _warn_of_flat_reward(self) -> None:
        """Once, and not after every rollout."""
        if not self._warned_of_flat_reward:
            self._warned_of_flat_reward = True
            warnings.warn(
                "The observed reward is flat, so no cost can be learned from it, and the controller only stays near "
                "the origin. Say what to control with policy_kwargs=dict(reward=QuadraticReward(state_weight, "
                "action_weight, target)).",
                UserWarning,
                stacklevel=2,
            )

    def _controller_log(self) -> dict[str, float]:
        counts = self.mpc.statistics
        self.mpc.statistics = ControllerStatistics()
        if not counts.plans:
            return {}
        return {
            "mpc/solve_time_ms": 1e3 * counts.seconds / counts.plans,
            "mpc/failed_share": counts.failed / counts.plans,
            "mpc/contact_share": counts.in_contact / counts.plans,
            "mpc/complementarity": counts.complementarity,
        }


def _check_spaces(observation_space: spaces.Space, action_space: spaces.Space) -> tuple[int, int]:
    for name, space in (("observation_space", observation_space), ("action_space", action_space)):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
            raise ValueError(
                f"{name} must be a one-dimensional Box of floats: MpcLcsPolicy models state and action as vectors; "
                f"got {space}"
            )
    return observation_space.shape[0], action_space.shape[0]  # type: ignore[index]


def _critic_layers(net_arch: list[int] | dict[str, list[int]] | None, terminal_value: str) -> list[int]:
    if TERMINAL_VALUES[terminal_value].needs_quadratic_critic:
        if net_arch not in (None, [], {}, dict(pi=[], vf=[])):
            raise ValueError(
                f"net_arch must be None with terminal_value={terminal_value!r}, whose critic is a quadratic; "
                f"got {net_arch!r}"
            )
        return []
    if net_arch is None:
        return [64, 64]
    if isinstance(net_arch, dict):
        if net_arch.get("pi"):
            raise ValueError(
                f"net_arch must not have layers for pi: the policy's mean is a controller, got {net_arch!r}"
            )
        return list(net_arch.get("vf", []))
    return list(net_arch)


def _make_lcs(
    sizes: tuple[int, int], given: dict[str, Any], low: np.ndarray, high: np.ndarray
) -> LinearComplementaritySystem:
    n_states, n_actions = sizes
    initial: LinearComplementaritySystem | None = given["initial_lcs"]
    if initial is not None:
        if not isinstance(initial, LinearComplementaritySystem):
            raise TypeError(f"initial_lcs must be a LinearComplementaritySystem or None, got {initial!r}")
        for name in ("state_scale", "action_scale"):
            if given[name] is not None:
                raise ValueError(f"{name} must be None with initial_lcs, which has its own, got {given[name]!r}")
        if (initial.n_states, initial.n_actions) != sizes:
            raise ValueError(
                f"initial_lcs must have {n_states} states and {n_actions} actions, "
                f"got {initial.n_states} and {initial.n_actions}"
            )
        return copy.deepcopy(initial)
    half_range = np.where(np.isfinite(high - low), (high - low) / 2, 1.0)
    action_scale = half_range if given["action_scale"] is None else given["action_scale"]
    n_contacts = _AUTO_CONTACTS if given["n_contacts"] == "auto" else given["n_contacts"]
    return LinearComplementaritySystem(n_states, n_actions, n_contacts, given["state_scale"], action_scale)
