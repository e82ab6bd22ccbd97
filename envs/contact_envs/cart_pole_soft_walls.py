"""Cart-pole between two soft walls, as a Gymnasium environment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from contact_envs._validation import positive
from contact_envs.plants import CartPoleParameters
from contact_envs.soft_contact_env import SoftContactEnv, plant_parameters

__all__ = ["CartPoleSoftWallsEnv"]


class CartPoleSoftWallsEnv(SoftContactEnv):
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
    :param parameters: of the plant: a :class:`~contact_envs.plants.CartPoleParameters`, or a mapping with
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

    FORCE: ClassVar = "force"
    CONTACT_FORCES: ClassVar = "wall_forces"

    parameters: CartPoleParameters

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
        self.theta_limit = positive("theta_limit", theta_limit)
        self.x_limit = positive("x_limit", x_limit)
        super().__init__(
            plant_parameters(CartPoleParameters, parameters),
            positive("max_force", max_force),
            simulator,
            control_step,
            physics_step,
            state_weights,
            action_weight,
            reward_constant,
            reset_range,
            render_mode,
        )

    @property
    def _safe_range(self) -> str:
        return f"|x| <= {self.x_limit} and |theta| <= {self.theta_limit}"

    def _terminal(self, state: NDArray[np.float64]) -> bool:
        return bool(abs(state[2]) > self.theta_limit or abs(state[0]) > self.x_limit)
