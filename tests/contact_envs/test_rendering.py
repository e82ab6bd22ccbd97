"""The picture shows the state, the forces and the plan, and does not depend on the engine."""

from __future__ import annotations

import numpy as np
import pytest

from contact_envs.cart_pole_soft_walls import CartPoleSoftWallsEnv
from contact_envs.dynamics import CartPoleParameters

rendering = pytest.importorskip("contact_envs.rendering", exc_type=ImportError)

PARAMETERS = CartPoleParameters()
UPRIGHT = np.zeros(4)
IN_RIGHT_WALL = np.array([0.3, 0.0, 0.2, 0.0])


def draw(state=UPRIGHT, force=0.0, time=0.0, plan_states=None, parameters=PARAMETERS) -> np.ndarray:
    return rendering.draw_scene(state, parameters, force, 100.0, time, plan_states)


def changed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(n, 2) row and column of every pixel that differs."""
    return np.argwhere((first != second).any(axis=-1))


def test_a_frame_is_an_rgb_picture():
    frame = draw()
    assert frame.shape == (rendering.HEIGHT, rendering.WIDTH, 3)
    assert frame.dtype == np.uint8
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 20
    np.testing.assert_array_equal(frame, draw())


@pytest.mark.parametrize("axis", range(4))
def test_every_component_of_the_state_is_visible(axis):
    state = np.zeros(4)
    state[axis] = 0.1
    assert len(changed(draw(), draw(state))) > 10


def test_the_cart_moves_to_the_right_with_x():
    scale = rendering.WIDTH / 2.4  # pixels per metre
    cart_row = np.round(0.77 * rendering.HEIGHT + 10).astype(int)

    def cart_centre(x: float) -> float:
        row = draw([x, 0, 0, 0])[cart_row].astype(int)
        return float(np.flatnonzero(np.abs(row - [52, 73, 94]).sum(axis=1) < 6).mean())

    assert cart_centre(0.3) - cart_centre(0.0) == pytest.approx(0.3 * scale, abs=1.5)


def test_the_pole_leans_to_the_right_with_theta():
    pixels = changed(draw(), draw([0.0, 0.0, 0.3, 0.0]))
    pole = pixels[(pixels[:, 0] > 60) & (pixels[:, 0] < 250)]  # below the readings, above the cart
    assert pole[:, 1].max() > rendering.WIDTH / 2 + 30
    assert pole[:, 1].min() > rendering.WIDTH / 2 - 15


def test_pressing_a_wall_reddens_it():
    def red(frame: np.ndarray) -> np.ndarray:
        return np.argwhere(np.abs(frame.astype(int) - [231, 76, 60]).sum(axis=-1) < 50)

    assert len(red(draw())) == 0
    assert len(red(draw(IN_RIGHT_WALL))) > 50
    assert (red(draw(IN_RIGHT_WALL))[:, 1] > rendering.WIDTH / 2).all()


def test_a_walls_force_is_an_arrow_from_the_tip_inwards():
    def arrow(state) -> np.ndarray:
        return np.argwhere(np.abs(draw(state).astype(int) - [192, 40, 45]).sum(axis=-1) < 10)

    assert len(arrow(UPRIGHT)) == 0
    right, left = arrow(IN_RIGHT_WALL), arrow(-IN_RIGHT_WALL)
    assert min(len(right), len(left)) > 50
    tip = (0.3 + 0.6 * np.sin(0.2)) * rendering.WIDTH / 2.4
    assert right[:, 1].max() < rendering.WIDTH / 2 + tip
    assert left[:, 1].min() > rendering.WIDTH / 2 - tip


def test_the_force_is_an_arrow_on_the_side_it_points_to():
    right, left = changed(draw(), draw(force=50.0)), changed(draw(), draw(force=-50.0))
    assert (right[:, 1] > rendering.WIDTH / 2).all()
    assert (left[:, 1] < rendering.WIDTH / 2).all()
    assert len(changed(draw(force=50.0), draw(force=100.0))) > 50


def test_time_is_shown():
    assert len(changed(draw(), draw(time=1.23))) > 10


def test_a_plan_is_drawn_over_the_state():
    plan = np.linspace(UPRIGHT, [0.2, 0.0, -0.4, 0.0], 11)
    with_plan = draw(plan_states=plan)
    assert len(changed(draw(), with_plan)) > 200
    assert len(changed(with_plan, draw(plan_states=plan[::2]))) > 10
    assert draw(plan_states=plan[:1]).shape == with_plan.shape


def test_extreme_states_and_other_plants_can_be_drawn():
    for state in ([50.0, 0, 3.0, 0], [-1.0, -300.0, -1.5, 1e6], [0.9, 0, 1.5, 0]):
        draw(state, force=1e4)
    draw(parameters=CartPoleParameters(pole_length=3.0, wall_distance=0.01, wall_stiffness=5.0, tip_radius=0.2))


@pytest.mark.parametrize("plan", [np.zeros(4), np.zeros((0, 4)), np.zeros((5, 3)), np.full((5, 4), np.nan)])
def test_a_plan_of_another_shape_is_refused(plan):
    with pytest.raises(ValueError, match="plan_states must be finite"):
        draw(plan_states=plan)


def test_both_engines_show_the_same_picture(both_engines):
    frames = []
    for engine in both_engines:
        env = CartPoleSoftWallsEnv(simulator=engine, render_mode="rgb_array")
        env.reset(options={"state": [0.1, 0.2, 0.1, 0.3]})
        start = env.render()
        env.step(np.array([0.3]))
        # Equal as far as the readings go: the engines' states differ in digits that are not shown.
        frames.append((start, env.render()))
        assert len(changed(*frames[-1])) > 50
    np.testing.assert_array_equal(frames[0][0], frames[1][0])
    assert len(changed(frames[0][1], frames[1][1])) == 0


def test_the_environment_draws_plans_in_any_render_mode(engine):
    env = CartPoleSoftWallsEnv(simulator=engine)
    env.reset(seed=0)
    plan = np.linspace(env.state, np.zeros(4), 11)
    assert len(changed(env.draw(), env.draw(plan_states=plan))) > 100
