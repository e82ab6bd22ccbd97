"""Acrobot with soft joint limits, as a Gymnasium environment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from contact_envs._validation import positive
from contact_envs.plants import AcrobotParameters
from contact_envs.soft_contact_env import SoftContactEnv, plant_parameters

__all__ = ["AcrobotSoftLimitsEnv"]


class AcrobotSoftLimitsEnv(SoftContactEnv):
    """
    ## Description

    Two links stand on each other: the lower end of the first turns freely on a fixed shoulder, the second is
    driven by a motor at the elbow between them. Two soft stops, one-sided elastic springs, push the first
    link back where it leans out further than `limit_angle`. The task is to bring both links to rest upright
    with a motor that is too weak to do it by itself from most starts: the acrobot has to lean on a stop and
    let itself be pushed back.

    It is the acrobot with soft joint limits of Aydinoglu, Preciado and Posa, "Contact-aware controller design
    for complementarity systems" (ICRA 2020), with that paper's links, limited joint and limit angle; the
    torque limit, the stiffness of the stops, the reward and the starts are this environment's.

    A stop is a force law, not a collision: Drake applies its torque through blocks of its own diagram, for
    PyBullet it is added in each physics step. (The engines' own joint limits take no stiffness.) Both engines
    step in time to first order, and agree with each other to rounding.

    ## Action space

    `Box(-1, 1, (1,), float32)`; actions beyond the bounds are clipped.

    | Num | Action                                                | Min | Max | Unit         |
    |-----|-------------------------------------------------------|-----|-----|--------------|
    | 0   | motor torque on the second link, held one step        | -1  | 1   | `max_torque` |

    ## Observation space

    `Box(-inf, inf, (4,), float64)`. The start and the end of an episode bound angles in practice (see below);
    no bound is promised on the observation that ends an episode, nor on velocities.

    | Num | Observation                                                          | Min  | Max | Unit  |
    |-----|----------------------------------------------------------------------|------|-----|-------|
    | 0   | shoulder angle `theta_1` of the first link, 0 upright, > 0 to the right | -inf | inf | rad   |
    | 1   | elbow angle `theta_2` of the second link relative to the first       | -inf | inf | rad   |
    | 2   | shoulder angular velocity `theta_1_dot`                              | -inf | inf | rad/s |
    | 3   | elbow angular velocity `theta_2_dot`                                 | -inf | inf | rad/s |

    The stops push the first link where `|theta_1| > limit_angle`.

    ## Reward

    Paid for the state *before* the step and the torque applied in it, `u` in N m after clipping:

    `reward_constant - sum(state_weights * state**2) - action_weight * u**2`

    `15 - (10 theta_1^2 + 10 theta_2^2 + theta_1_dot^2 + theta_2_dot^2) - 0.01 u^2` by default.

    ## Starting state

    Uniform in `-reset_range .. reset_range`, componentwise.
    `reset(options={"state": [theta_1, theta_2, theta_1_dot, theta_2_dot]})` starts from a state of one's own.

    ## Episode end

    - Termination: a link leans out further than `lean_limit`: `|theta_1|` or `|theta_1 + theta_2|` is larger.
    - Truncation: after 400 steps (4 s), by `gymnasium.make`'s `TimeLimit`.

    Stepping on after the end goes on with the physics; `terminated` stays as the state says.

    ## Info

    - `"torque"`: the motor's torque during the step, N m (0 on reset).
    - `"limit_torques"`: array (2,), the right and the left stop's torque on the first link in N m, >= 0,
      averaged over the step (on reset: in the starting state).

    ## Why these numbers

    Mean return over 50 starts on PyBullet, of LQR, which knows the true model but no stop, and of the
    complementarity controller with the true model (`python -m benchmarks.contact_matters`).

    | changed                                       | LQR   | with contact |
    |-----------------------------------------------|-------|--------------|
    | nothing                                       | 1,162 | 5,506        |
    | `reset_range=(0.03, 0.03, 0.05, 0.05)`        | 3,194 | 5,661        |
    | `reset_range=(0.1, 0.1, 0.2, 0.2)`            | 35    | 5,565        |
    | `max_torque=5.0`                              | 1,309 | 5,298        |
    | `max_torque=20.0`                             | 835   | 5,404        |
    | `parameters={"limit_stiffness": 100.0}`       | 1,032 | 5,204        |
    | `parameters={"limit_stiffness": 1000.0}`      | 1,185 | 5,606        |
    | `parameters={"limit_angle": 0.1}`             | 431   | 5,876        |

    ## Arguments

    ```python
    import gymnasium as gym
    import contact_envs  # registers the environments

    env = gym.make("AcrobotSoftLimits-v0", render_mode="rgb_array", parameters={"limit_stiffness": 100.0})
    ```

    | Id                              | Engine   |
    |---------------------------------|----------|
    | `AcrobotSoftLimits-v0`          | Drake    |
    | `AcrobotSoftLimitsDrake-v0`     | Drake    |
    | `AcrobotSoftLimitsPyBullet-v0`  | PyBullet |

    :param simulator: `"drake"` or `"pybullet"`
    :param parameters: of the plant: a :class:`~contact_envs.plants.AcrobotParameters`, or a mapping with
        those of its fields that differ from the default
    :param max_torque: N m, the torque of action 1
    :param control_step: s, how long an action is held; a whole multiple of `physics_step`
    :param physics_step: s, the engine's time step
    :param state_weights: (4,) of the squared state in the reward, >= 0
    :param action_weight: of the squared torque in (N m)^2, >= 0
    :param reward_constant: what a step at rest in the origin pays
    :param reset_range: (4,) largest magnitude of each component of the starting state, >= 0
    :param lean_limit: rad
    :param render_mode: `None`, `"rgb_array"` (drawn without a display, the same picture for both engines) or
        `"human"` (Meshcat in a browser for Drake, a window for PyBullet)
    :raises TypeError: an argument is of the wrong type; the message names it
    :raises ValueError: an argument is out of range; the message names it
    :raises ImportError: the engine is not installed; the message says how to install it

    ## Version history

    * v0: initial version
    """

    FORCE: ClassVar = "torque"
    CONTACT_FORCES: ClassVar = "limit_torques"

    parameters: AcrobotParameters

    def __init__(
        self,
        simulator: str = "drake",
        parameters: AcrobotParameters | Mapping[str, float] | None = None,
        max_torque: float = 10.0,
        control_step: float = 0.01,
        physics_step: float = 0.001,
        state_weights: Sequence[float] = (10.0, 10.0, 1.0, 1.0),
        action_weight: float = 0.01,
        reward_constant: float = 15.0,
        reset_range: Sequence[float] = (0.05, 0.05, 0.1, 0.1),
        lean_limit: float = math.pi / 3,
        render_mode: str | None = None,
    ) -> None:
        self.lean_limit = positive("lean_limit", lean_limit)
        super().__init__(
            plant_parameters(AcrobotParameters, parameters),
            positive("max_torque", max_torque),
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
    def max_torque(self) -> float:
        """N m, the torque of action 1."""
        return self.max_force

    @property
    def _safe_range(self) -> str:
        return f"|theta_1| <= {self.lean_limit} and |theta_1 + theta_2| <= {self.lean_limit}"

    def _terminal(self, state: NDArray[np.float64]) -> bool:
        return bool(max(abs(state[0]), abs(state[0] + state[1])) > self.lean_limit)
