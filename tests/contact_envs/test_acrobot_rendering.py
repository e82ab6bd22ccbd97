"""The acrobot's picture shows the state, the torques and the plan, and does not depend on the engine."""

from __future__ import annotations

import numpy as np
import pytest

from contact_envs.acrobot_soft_limits import AcrobotSoftLimitsEnv
from contact_envs.plants import AcrobotParameters

rendering = pytest.importorskip("contact_envs.rendering", exc_type=ImportError)

PARAMETERS = AcrobotParameters()
UPRIGHT = np.zeros(4)
IN_RIGHT_STOP = np.array([0.25, 0.0, 0.0, 0.0])
SCALE = rendering.WIDTH / (2 * 1.15 * 1.5)  # pixels per metre
SHOULDER = np.array([0.9 * rendering.HEIGHT, 0.5 * rendering.WIDTH])


def draw(state=UPRIGHT, torque=0.0, time=0.0, plan_states=None, parameters=PARAMETERS) -> np.ndarray:
    return rendering.draw_scene(state, parameters, torque, 10.0, time, plan_states)


def changed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(n, 2) row and column of every pixel that differs."""
    return np.argwhere((first != second).any(axis=-1))


def coloured(frame: np.ndarray, colour: list[int], nearness: int = 10) -> np.ndarray:
    """(n, 2) row and column of every pixel of about this colour."""
    return np.argwhere(np.abs(frame.astype(int) - colour).sum(axis=-1) < nearness)


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


@pytest.mark.parametrize("state", [UPRIGHT, [0.15, -0.4, 0, 0], [-0.3, 0.9, 0, 0]])
def test_the_masses_are_where_the_angles_put_them(state):
    masses = coloured(draw(state), [150, 62, 22])
    elbow = 0.5 * np.array([-np.cos(state[0]), np.sin(state[0])])
    end = elbow + np.array([-np.cos(state[0] + state[1]), np.sin(state[0] + state[1])])
    for place in (elbow, end):
        near = masses[np.linalg.norm(masses - (SHOULDER + SCALE * place), axis=1) < 20]
        assert len(near) > 20
        np.testing.assert_allclose(near.mean(axis=0), SHOULDER + SCALE * place, atol=2.5)


def test_pressing_a_stop_reddens_it():
    def red(state) -> np.ndarray:
        return coloured(draw(state), [231, 76, 60], 40)

    assert len(red(UPRIGHT)) == 0
    deep = 1.2 * IN_RIGHT_STOP
    assert len(red(deep)) > 50
    assert (red(deep)[:, 1] > rendering.WIDTH / 2).all()


def test_a_stops_torque_is_an_arrow_back_to_the_middle():
    def arrow(state) -> np.ndarray:
        return coloured(draw(state), [192, 40, 45])

    assert len(arrow(UPRIGHT)) == 0
    right, left = arrow(IN_RIGHT_STOP), arrow(-IN_RIGHT_STOP)
    assert min(len(right), len(left)) > 50
    link = 0.35 * np.sin(0.25) * SCALE  # where the arrow begins
    assert right[:, 1].max() < rendering.WIDTH / 2 + link + 5
    assert left[:, 1].min() > rendering.WIDTH / 2 - link - 5


def test_the_motors_torque_is_an_arrow_that_turns_its_way():
    def to_the_right(torque: float) -> int:
        """How many more of the arrow's pixels are on the right: it lies across the middle, and its head is wide."""
        columns = coloured(draw(torque=torque), [41, 121, 201])[:, 1] - rendering.WIDTH / 2
        columns = columns[np.abs(columns) < 45]  # without the number beside it
        return int((columns > 0).sum() - (columns < 0).sum())

    assert len(coloured(draw(), [41, 121, 201])) == 0
    assert to_the_right(10.0) > 10
    assert to_the_right(-10.0) < -10
    assert len(changed(draw(torque=5.0), draw(torque=10.0))) > 50


def test_time_is_shown():
    assert len(changed(draw(), draw(time=1.23))) > 10


def test_a_plan_is_drawn_over_the_state():
    plan = np.linspace(UPRIGHT, [0.2, -0.4, 0.0, 0.0], 11)
    with_plan = draw(plan_states=plan)
    assert len(changed(draw(), with_plan)) > 200
    assert len(changed(with_plan, draw(plan_states=plan[::2]))) > 10
    assert draw(plan_states=plan[:1]).shape == with_plan.shape


def test_extreme_states_and_other_plants_can_be_drawn():
    for state in ([50.0, 0, 3.0, 0], [-1.0, -300.0, -1.5, 1e6], [0.9, 2.0, 1.5, 0]):
        draw(state, torque=1e4)
    draw(IN_RIGHT_STOP, parameters=AcrobotParameters(upper_length=0.01, limit_angle=0.01, limit_stiffness=5.0))


def test_a_state_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="state must be finite"):
        draw(np.zeros(3))


def test_both_engines_show_the_same_picture(both_engines):
    frames = []
    for engine in both_engines:
        env = AcrobotSoftLimitsEnv(simulator=engine, render_mode="rgb_array")
        env.reset(options={"state": [0.1, -0.2, 0.1, 0.3]})
        start = env.render()
        env.step(np.array([0.3]))
        # Equal as far as the readings go: the engines' states differ in digits that are not shown.
        frames.append((start, env.render()))
        assert len(changed(*frames[-1])) > 50
    np.testing.assert_array_equal(frames[0][0], frames[1][0])
    assert len(changed(frames[0][1], frames[1][1])) == 0
