"""Cart-pole between two soft walls, as a Gymnasium environment."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import EzPickle
from numpy.typing import ArrayLike, NDArray

from contact_envs import dynamics
from contact_envs._validation import finite, finite_vector, non_negative, positive
from contact_envs.dynamics import CartPoleParameters, LcsMatrices
from contact_envs.simulators import Simulator, simulator_class

__all__ = ["CartPoleSoftWallsEnv"]


class CartPoleSoftWallsEnv(gym.Env[NDArray[np.float64], NDArray[np.float32]], EzPickle):
    """
    ## Description

    A pole is hinged on a cart that runs on a rail without friction. Two soft, frictionless, elastic walls
    stand on either side of the pole's tip. The task is to bring pole and cart to rest upright at the origin
    by pushing the cart; the walls may get in the way, or help. It is the task of section IV-A of the paper
    that this package accompanies.

    The contact is the physics engine's own: a sphere at the pole's tip against a compliant wall. Two engines
    stand behind the same interface. They agree with each other far more closely than either agrees with the
    exact equations of motion, because both step in time to first order.

    ## Action space

    `Box(-1, 1, (1,), float32)`; actions beyond the bounds are clipped.

    | Num | Action                                       | Min | Max | Unit        |
    |-----|----------------------------------------------|-----|-----|-------------|
    | 0   | horizontal force on the cart, held one step  | -1  | 1   | `max_force` |

    ## Observation space

    `Box(-inf, inf, (4,), float64)`. The start and the end of an episode bound positions in practice (see
    below); no bound is promised on the observation that ends an episode, nor on velocities.

    | Num | Observation                                     | Min  | Max | Unit  |
    |-----|-------------------------------------------------|------|-----|-------|
    | 0   | cart position `x`                               | -inf | inf | m     |
    | 1   | cart velocity `x_dot`                           | -inf | inf | m/s   |
    | 2   | pole angle `theta`, 0 upright, > 0 to the right | -inf | inf | rad   |
    | 3   | pole angular velocity `theta_dot`               | -inf | inf | rad/s |

    The tip is at `x + pole_length * sin(theta)`; the walls at `-wall_distance` and `+wall_distance` act on
    it.

    ## Reward

    Paid for the state *before* the step and the force applied in it, `u` in newtons after clipping:

    `reward_constant - sum(state_weights * state**2) - action_weight * u**2`

    with the paper's `15 - (20 x^2 + 20 x_dot^2 + 0.1 theta^2 + 0.1 theta_dot^2) - 0.001 u^2` by default.

    ## Starting state

    Uniform in `-reset_range .. reset_range`, componentwise. The tip may start inside a wall.
    `reset(options={"state": [x, x_dot, theta, theta_dot]})` starts from a state of one's own.

    ## Episode end

    - Termination: `|theta| > theta_limit` or `|x| > x_limit`.
    - Truncation: after 400 steps (4 s), by `gymnasium.make`'s `TimeLimit`.

    Stepping on after the end goes on with the physics; `terminated` stays as the state says.

    ## Info

    - `"force"`: the force on the cart during the step, N (0 on reset).
    - `"wall_forces"`: array (2,), the right and the left wall's force on the tip in N, >= 0: the engine's
      contact force averaged over the step (on reset: the springs' force in the starting state).

    ## Arguments

    ```python
    import gymnasium as gym
    import contact_envs  # registers the environments

    env = gym.make("CartPoleSoftWalls-v0", render_mode="rgb_array", parameters={"wall_stiffness": 300.0})
    ```

    | Id                                   | Engine   | `max_force` | `reset_range`           |
    |--------------------------------------|----------|-------------|-------------------------|
    | `CartPoleSoftWalls-v0`               | Drake    | 100 N       | (0.25, 0.5, 0.25, 0.5)  |
    | `CartPoleSoftWallsDrake-v0`          | Drake    | 100 N       | (0.25, 0.5, 0.25, 0.5)  |
    | `CartPoleSoftWallsPyBullet-v0`       | PyBullet | 100 N       | (0.25, 0.5, 0.25, 0.5)  |
    | `CartPoleSoftWallsHard-v0`           | Drake    | 10 N        | (0.35, 1.0, 0.30, 1.0)  |
    | `CartPoleSoftWallsHardDrake-v0`      | Drake    | 10 N        | (0.35, 1.0, 0.30, 1.0)  |
    | `CartPoleSoftWallsHardPyBullet-v0`   | PyBullet | 10 N        | (0.35, 1.0, 0.30, 1.0)  |

    :param simulator: `"drake"` or `"pybullet"`
    :param parameters: of the plant: a :class:`~contact_envs.dynamics.CartPoleParameters`, or a mapping with
        those of its fields that differ from the default
    :param max_force: N, the force of action 1
    :param control_step: s, how long an action is held; a whole multiple of `physics_step`
    :param physics_step: s, the engine's time step
    :param state_weights: (4,) of the squared state in the reward, >= 0
    :param action_weight: of the squared force in N^2, >= 0
    :param reward_constant: what a step at rest in the origin pays
    :param reset_range: (4,) largest magnitude of each component of the starting state, >= 0
    :param theta_limit: rad
    :param x_limit: m
    :param render_mode: `None`, `"rgb_array"` (drawn without a display, the same picture for both engines) or
        `"human"` (Meshcat in a browser for Drake, a window for PyBullet)
    :raises TypeError: an argument is of the wrong type; the message names it
    :raises ValueError: an argument is out of range; the message names it
    :raises ImportError: the engine is not installed; the message says how to install it

    ## Version history

    * v0: initial version
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 100}  # noqa: RUF012 - Gymnasium's convention

    def __init__(
        self,
        simulator: str = "drake",
        parameters: CartPoleParameters | Mapping[str, float] | None = None,
        max_force: float = 100.0,
        control_step: float = 0.01,
        physics_step: float = 0.001,
        state_weights: Sequence[float] = (20.0, 20.0, 0.1, 0.1),
        action_weight: float = 1e-3,
        reward_constant: float = 15.0,
        reset_range: Sequence[float] = (0.25, 0.5, 0.25, 0.5),
        theta_limit: float = math.pi / 3,
        x_limit: float = 1.0,
        render_mode: str | None = None,
    ) -> None:
        # Engines hold C++ objects that do not pickle: a copy is rebuilt from the constructor's arguments.
        EzPickle.__init__(
            self,
            simulator,
            parameters,
            max_force,
            control_step,
            physics_step,
            state_weights,
            action_weight,
            reward_constant,
            reset_range,
            theta_limit,
            x_limit,
            render_mode,
        )
        self.parameters = _plant_parameters(parameters)
        self.max_force = positive("max_force", max_force)
        self.control_step = positive("control_step", control_step)
        self.physics_step = positive("physics_step", physics_step)
        self.state_weights = _magnitudes("state_weights", state_weights)
        self.action_weight = non_negative("action_weight", action_weight)
        self.reward_constant = finite("reward_constant", reward_constant)
        self.reset_range = _magnitudes("reset_range", reset_range)
        self.theta_limit = positive("theta_limit", theta_limit)
        self.x_limit = positive("x_limit", x_limit)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}")
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.control_step))}

        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self._simulator: Simulator = simulator_class(simulator)(
            self.parameters,
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
        return self.state, {"force": 0.0, "wall_forces": dynamics.wall_forces(start, self.parameters)}

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Hold a force for one control step.

        :param action: (1,) in units of ``max_force``, clipped to [-1, 1]
        :return: observation, reward, terminated, truncated (always False here), info
        :raises ValueError: ``action`` has the wrong shape or is not finite
        :raises gymnasium.error.ResetNeeded: before the first reset
        """
        before = self.state
        self._force = self.max_force * _clipped_action(action)
        self._state, wall_forces = self._simulator.step(self._force)
        self._step_count += 1
        if self.render_mode == "human":
            self.render()
        info = {"force": self._force, "wall_forces": wall_forces}
        return self.state, self.reward(before, self._force), self._terminal(self._state), False, info

    def reward(self, state: ArrayLike, force: float) -> float:
        """What a step from ``state`` under ``force`` pays.

        :param state: (4,) before the step
        :param force: N
        """
        state_cost = float(self.state_weights @ np.square(np.asarray(state, dtype=np.float64)))
        return self.reward_constant - state_cost - self.action_weight * force**2

    def equations_of_motion(self, state: ArrayLike, force: ArrayLike) -> NDArray[np.float64]:
        """The exact dynamics that the engine approximates.

        :param state: (..., 4)
        :param force: (...) N
        :return: (..., 4) d state / dt
        """
        return dynamics.equations_of_motion(state, force, self.parameters)

    def true_lcs(self) -> LcsMatrices:
        """The dynamics of one control step linearised about upright, in environment units (action in [-1,
        1]).

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

    def _terminal(self, state: NDArray[np.float64]) -> bool:
        return bool(abs(state[2]) > self.theta_limit or abs(state[0]) > self.x_limit)

    def _given_start(self, options: dict[str, Any]) -> NDArray[np.float64] | None:
        unknown = sorted(set(options) - {"state"})
        if unknown:
            raise ValueError(f"reset accepts options {{'state': (4,)}} only, got also {unknown}")
        if options.get("state") is None:
            return None
        state = finite_vector("options['state']", options["state"], 4)
        if self._terminal(state):
            raise ValueError(
                f"options['state'] must be inside |x| <= {self.x_limit} and |theta| <= {self.theta_limit}, "
                f"got {options['state']!r}"
            )
        return state


def _plant_parameters(parameters: CartPoleParameters | Mapping[str, float] | None) -> CartPoleParameters:
    if isinstance(parameters, CartPoleParameters):
        return parameters
    if parameters is None:
        return CartPoleParameters()
    if not isinstance(parameters, Mapping):
        raise TypeError(f"parameters must be CartPoleParameters, a mapping or None, got {parameters!r}")
    accepted = set(CartPoleParameters.__dataclass_fields__)
    unknown = sorted(set(parameters) - accepted)
    if unknown:
        raise ValueError(f"parameters must hold only {sorted(accepted)}, got also {unknown}")
    return CartPoleParameters(**parameters)


def _magnitudes(name: str, values: Sequence[float]) -> NDArray[np.float64]:
    vector = finite_vector(name, values, 4)
    if (vector < 0.0).any():
        raise ValueError(f"{name} must be >= 0 in each of x, x_dot, theta, theta_dot, got {values!r}")
    return vector


def _substeps(control_step: float, physics_step: float) -> int:
    substeps = round(control_step / physics_step)
    if substeps < 1 or not math.isclose(substeps * physics_step, control_step, rel_tol=1e-9):
        raise ValueError(f"control_step must be a multiple of physics_step, got {control_step!r} and {physics_step!r}")
    return substeps


def _clipped_action(action: ArrayLike) -> float:
    return min(1.0, max(-1.0, float(finite_vector("action", action, 1)[0])))
