"""Pictures of a plant, drawn from its state alone: no display, no simulator, the same for every engine."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_envs.plants import AcrobotParameters, CartPoleParameters, Plant
from contact_envs.rendering.acrobot import AcrobotScene
from contact_envs.rendering.canvas import FAINT_INK, HEIGHT, INK, WIDTH
from contact_envs.rendering.cart_pole import CartPoleScene
from contact_envs.rendering.scene import Scene

__all__ = ["HEIGHT", "WIDTH", "draw_scene"]


def draw_scene(
    state: ArrayLike,
    parameters: Plant,
    force: float,
    max_force: float,
    time: float,
    plan_states: ArrayLike | None = None,
) -> NDArray[np.uint8]:
    """Draw one state, the forces that act in it, and, if given, a plan for what follows.

    The contacts' forces are those of their springs in this state. A plan is drawn as the path of the plant's
    tip, with the plant where it ends.

    :param state: (4,)
    :param parameters: of the plant
    :param force: of the actuator, N or N m
    :param max_force: N or N m, what the force's arrow is relative to
    :param time: s since the start of the episode
    :param plan_states: (H+1, 4) or None
    :return: (HEIGHT, WIDTH, 3)
    :raises ValueError: ``state`` or ``plan_states`` has the wrong shape or is not finite
    :raises TypeError: there is no picture of this plant
    """
    state = _checked_states("state", state, ndim=1)
    plan = None if plan_states is None else _checked_states("plan_states", plan_states, ndim=2)
    scene = _scene(parameters)
    scene.draw_surroundings(state)
    if plan is not None:
        scene.draw_plan(plan)
    scene.draw_plant(state, force, max_force)
    scene.canvas.caption(16, 14, f"t = {time:.2f} s", 18, INK, "la")
    for y, line in zip((14, 33), scene.readings(state), strict=True):
        scene.canvas.caption(WIDTH - 16, y, line, 13, FAINT_INK, "ra")
    return scene.canvas.pixels()


def _scene(parameters: Plant) -> Scene:
    match parameters:
        case CartPoleParameters():
            return CartPoleScene(parameters)
        case AcrobotParameters():
            return AcrobotScene(parameters)
    raise TypeError(f"parameters must be those of a cart-pole or an acrobot, got {parameters!r}")


def _checked_states(name: str, states: ArrayLike, ndim: int) -> NDArray[np.float64]:
    values = np.asarray(states, dtype=np.float64)
    if values.ndim != ndim or values.shape[-1] != 4 or values.size == 0 or not np.isfinite(values).all():
        accepted = "(4,)" if ndim == 1 else "(H+1, 4)"
        raise ValueError(f"{name} must be finite, shape {accepted}, got shape {values.shape}: {states!r}")
    return values
