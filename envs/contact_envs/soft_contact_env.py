"""What the environments have in common: a plant inside an engine, a quadratic reward, the ground truth."""

from __future__ import annotations

import dataclasses
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import EzPickle
from numpy.typing import ArrayLike, NDArray

from contact_envs import dynamics
from contact_envs._validation import finite, finite_vector, non_negative, positive
from contact_envs.dynamics import LcsMatrices
from contact_envs.plants import Plant
from contact_envs.simulators import Simulator, simulator_class

__all__ = ["SoftContactEnv", "plant_parameters"]

AnyPlant = TypeVar("AnyPlant", bound=Plant)


class SoftContactEnv(gym.Env[NDArray[np.float64], NDArray[np.float32]], EzPickle, ABC):
    """A plant with one actuator and soft contacts, to be brought to rest upright.

    A sub-class names its arguments and says when an episode ends.

    :param parameters: of the plant
    :param max_force: of the actuator at action 1, N or N m
    :param simulator: a key of :data:`contact_envs.simulators.SIMULATORS`
    :param control_step: s, how long an action is held; a whole multiple of ``physics_step``
    :param physics_step: s, the engine's time step
    :param state_weights: (n_x,) of the squared state in the reward, >= 0
    :param action_weight: of the squared force, >= 0
    :param reward_constant: what a step at rest in the origin pays
    :param reset_range: (n_x,) largest magnitude of each component of the starting state, >= 0
    :param render_mode: None, "rgb_array" or "human"
    :raises TypeError: an argument is of the wrong type; the message names it
    :raises ValueError: an argument is out of range; the message names it
    :raises ImportError: the engine is not installed; the message says how to install it
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 100}  # noqa: RUF012 - Gymnasium's convention

    FORCE: ClassVar[str]
    """Of the actuator's force in ``info``."""
    CONTACT_FORCES: ClassVar[str]
    """Of the contacts' forces in ``info``."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        # Engines hold C++ objects that do not pickle: a copy is rebuilt from the arguments of whatever
        # sub-class's constructor comes next.
        env = super().__new__(cls)
        EzPickle.__init__(env, *args, **kwargs)
        return env

    def __init__(
        self,
        parameters: Plant,
        max_force: float,
        simulator: str,
        control_step: float,
        physics_step: float,
        state_weights: Sequence[float],
        action_weight: float,
        reward_constant: float,
        reset_range: Sequence[float],
        render_mode: str | None,
    ) -> None:
        self.parameters = parameters
        self.max_force = max_force
        self.control_step = positive("control_step", control_step)
        self.physics_step = positive("physics_step", physics_step)
        self.state_weights = self._magnitudes("state_weights", state_weights)
        self.action_weight = non_negative("action_weight", action_weight)
        self.reward_constant = finite("reward_constant", reward_constant)
        self.reset_range = self._magnitudes("reset_range", reset_range)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}")
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.control_step))}

        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (len(parameters.STATE),), np.float64)
        self._simulator: Simulator = simulator_class(simulator)(
            parameters,
            self.physics_step,
            _substeps(self.control_step, self.physics_step),
            viewer=render_mode == "human",
        )
        self._state: NDArray[np.float64] | None = None
        self._force = 0.0
        self._step_count = 0
        self._frame_due = 0.0

    @property
    def state(self) -> NDArray[np.float64]:
        """(4,) the current state, a copy.

        :raises gymnasium.error.ResetNeeded: before the first reset
        """
        if self._state is None:
            raise ResetNeeded("the environment has no state yet: call reset() first")
        return self._state.copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Start an episode.

        :param seed: of the starting state's random numbers
        :param options: ``{"state": (4,)}`` to start from a given state
        :raises ValueError: ``options`` holds something else, or a state that is not finite or already
            terminal
        """
        super().reset(seed=seed)
        start = self._given_start(options or {})
        if start is None:
            start = self.np_random.uniform(-self.reset_range, self.reset_range)
        self._simulator.reset(start)
        self._state, self._force, self._step_count = start, 0.0, 0
        if self.render_mode == "human":
            self._frame_due = time.monotonic()
            self.render()
        return self.state, self._info(self.parameters.contact_forces(start))

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Hold the actuator's force for one control step.

        :param action: (1,) in units of ``max_force``, clipped to [-1, 1]
        :return: observation, reward, terminated, truncated (always False here), info
        :raises ValueError: ``action`` has the wrong shape or is not finite
        :raises gymnasium.error.ResetNeeded: before the first reset
        """
        before = self.state
        self._force = self.max_force * _clipped_action(action)
        self._state, contact_forces = self._simulator.step(self._force)
        self._step_count += 1
        if self.render_mode == "human":
            self.render()
        reward = self.reward(before, self._force)
        return self.state, reward, self._terminal(self._state), False, self._info(contact_forces)

    def reward(self, state: ArrayLike, force: float) -> float:
        """What a step from ``state`` under ``force`` pays.

        :param state: (4,) before the step
        :param force: of the actuator, N or N m
        """
        state_cost = float(self.state_weights @ np.square(np.asarray(state, dtype=np.float64)))
        return self.reward_constant - state_cost - self.action_weight * force**2

    def equations_of_motion(self, state: ArrayLike, force: ArrayLike) -> NDArray[np.float64]:
        """The exact dynamics that the engine approximates.

        :param state: (..., 4)
        :param force: (...) of the actuator, N or N m
        :return: (..., 4) d state / dt
        """
        return self.parameters.equations_of_motion(state, force)

    def true_lcs(self) -> LcsMatrices:
        """The dynamics of one control step linearised about upright, in environment units (action in [-1, 1]).

        :return: see :func:`contact_envs.dynamics.true_lcs`
        """
        return dynamics.true_lcs(self.parameters, self.control_step, self.max_force)

    def draw(self, plan_states: ArrayLike | None = None) -> NDArray[np.uint8]:
        """A picture of the current state, whatever the render mode.

        :param plan_states: (H+1, 4) a planned trajectory to draw over it, or None
        :return: (height, width, 3)
        :raises ValueError: ``plan_states`` has the wrong shape or is not finite
        """
        from contact_envs.rendering import draw_scene  # here: pillow is needed for pictures only

        elapsed = self._step_count * self.control_step
        return draw_scene(self.state, self.parameters, self._force, self.max_force, elapsed, plan_states)

    def render(self) -> NDArray[np.uint8] | None:
        """A frame for ``"rgb_array"``; for ``"human"``, the engine's window brought up to date in real
        time."""
        if self.render_mode == "rgb_array":
            return self.draw()
        if self.render_mode == "human":
            time.sleep(max(0.0, self._frame_due - time.monotonic()))
            self._frame_due = time.monotonic() + self.control_step
            self._simulator.show()
            return None
        gym.logger.warn("render() without a render mode does nothing: pass render_mode='rgb_array' to gymnasium.make")
        return None

    def close(self) -> None:
        """Give back what the engine holds."""
        self._simulator.close()

    @property
    @abstractmethod
    def _safe_range(self) -> str:
        """What :meth:`_terminal` asks of a state, for errors."""

    @abstractmethod
    def _terminal(self, state: NDArray[np.float64]) -> bool:
        """Whether an episode ends in this state."""

    def _info(self, contact_forces: NDArray[np.float64]) -> dict[str, Any]:
        return {self.FORCE: self._force, self.CONTACT_FORCES: contact_forces}

    def _given_start(self, options: dict[str, Any]) -> NDArray[np.float64] | None:
        unknown = sorted(set(options) - {"state"})
        if unknown:
            raise ValueError(f"reset accepts options {{'state': (4,)}} only, got also {unknown}")
        if options.get("state") is None:
            return None
        state = finite_vector("options['state']", options["state"], len(self.parameters.STATE))
        if self._terminal(state):
            raise ValueError(f"options['state'] must be inside {self._safe_range}, got {options['state']!r}")
        return state

    def _magnitudes(self, name: str, values: Sequence[float]) -> NDArray[np.float64]:
        components = self.parameters.STATE
        vector = finite_vector(name, values, len(components))
        if (vector < 0.0).any():
            raise ValueError(f"{name} must be >= 0 in each of {', '.join(components)}, got {values!r}")
        return vector


def plant_parameters(kind: type[AnyPlant], parameters: AnyPlant | Mapping[str, float] | None) -> AnyPlant:
    """The constructor argument ``parameters`` as a plant.

    :param kind: the plant's class
    :param parameters: one of those, a mapping with those of its fields that differ from the default, or None
    :raises TypeError: anything else
    :raises ValueError: the mapping has other keys
    """
    if isinstance(parameters, kind):
        return parameters
    if parameters is None:
        return kind()
    if not isinstance(parameters, Mapping):
        raise TypeError(f"parameters must be {kind.__name__}, a mapping or None, got {parameters!r}")
    accepted = {field.name for field in dataclasses.fields(kind)}
    unknown = sorted(set(parameters) - accepted)
    if unknown:
        raise ValueError(f"parameters must hold only {sorted(accepted)}, got also {unknown}")
    return kind(**parameters)


def _substeps(control_step: float, physics_step: float) -> int:
    substeps = round(control_step / physics_step)
    if substeps < 1 or not math.isclose(substeps * physics_step, control_step, rel_tol=1e-9):
        raise ValueError(f"control_step must be a multiple of physics_step, got {control_step!r} and {physics_step!r}")
    return substeps


def _clipped_action(action: ArrayLike) -> float:
    return min(1.0, max(-1.0, float(finite_vector("action", action, 1)[0])))
