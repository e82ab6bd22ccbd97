"""The environments keep Gymnasium's and Stable-Baselines3's contracts, and their own."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

import contact_envs
from contact_envs.acrobot_soft_limits import AcrobotSoftLimitsEnv
from contact_envs.cart_pole_soft_walls import CartPoleSoftWallsEnv
from contact_envs.dynamics import equations_of_motion, true_lcs
from contact_envs.plants import AcrobotParameters, CartPoleParameters

CART_POLE, ACROBOT = "CartPoleSoftWalls", "AcrobotSoftLimits"
ENGINES = {"drake": "Drake", "pybullet": "PyBullet"}
# Actuator's greatest force, and the reset range.
DOCUMENTED = {
    "CartPoleSoftWallsHard": (10.0, [0.35, 1.0, 0.30, 1.0]),
    "CartPoleSoftWalls": (100.0, [0.25, 0.5, 0.25, 0.5]),
    "AcrobotSoftLimits": (10.0, [0.05, 0.05, 0.1, 0.1]),
}
STIFFNESS = {CART_POLE: "wall_stiffness", ACROBOT: "limit_stiffness"}
GREATEST = {CART_POLE: "max_force", ACROBOT: "max_torque"}
both_plants = pytest.mark.parametrize("plant", [CART_POLE, ACROBOT])


def make(engine: str, plant: str = CART_POLE, **kwargs) -> gym.Env:
    return gym.make(f"{plant}{ENGINES[engine]}-v0", **kwargs)


def rollout(env: gym.Env, seed: int, actions: np.ndarray) -> list:
    """Observations, rewards, ends and forces, as far as the episode goes."""
    observation, info = env.reset(seed=seed)
    path = [observation, *info.values()]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        path += [observation, *info.values(), np.array([reward, terminated, truncated])]
        if terminated or truncated:
            break
    return path


def random_actions(steps: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.2, 0.2, (steps, 1)).astype(np.float32)


@pytest.mark.parametrize("env_id", contact_envs.ENV_IDS)
def test_registered_environments_pass_both_checkers(env_id):
    pytest.importorskip("pybullet" if "PyBullet" in env_id else "pydrake")
    env = gym.make(env_id, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The observation space is unbounded, and says so; Gymnasium calls that "probably too low".
        warnings.filterwarnings("ignore", message=".*Box observation space m.*imum value is.*")
        check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env)
    assert env.spec.max_episode_steps == 400


@pytest.mark.parametrize("env_id", contact_envs.ENV_IDS)
def test_ids_stand_for_the_documented_engine_force_and_starts(env_id):
    pytest.importorskip("pybullet" if "PyBullet" in env_id else "pydrake")
    env = gym.make(env_id).unwrapped
    assert ("PyBullet" in type(env._simulator).__name__) == ("PyBullet" in env_id)
    greatest, reset_range = next(numbers for name, numbers in DOCUMENTED.items() if env_id.startswith(name))
    assert env.max_force == greatest
    np.testing.assert_array_equal(env.reset_range, reset_range)


def test_importing_registers_once_and_loads_nothing_heavy():
    program = """
import sys
import contact_envs
del sys.modules["contact_envs"]
import contact_envs
heavy = {"pydrake", "pybullet", "matplotlib", "PIL", "scipy", "torch", "stable_baselines3", "sb3_mpc_policy"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""
    # Gymnasium warns when an environment is registered twice; here warnings are errors.
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@both_plants
def test_same_seed_and_actions_give_the_same_bits_also_after_other_episodes(engine, plant):
    used, fresh = make(engine, plant), make(engine, plant)
    for seed in range(3):
        rollout(used, 100 + seed, random_actions(40, seed))
    actions = random_actions(60)
    for first, second in zip(rollout(used, 5, actions), rollout(fresh, 5, actions), strict=True):
        np.testing.assert_array_equal(first, second)


@both_plants
def test_worker_processes_reproduce_the_process_they_come_from(engine, plant):
    """A worker imports the package by itself when the id names it."""
    env_id = f"contact_envs:{make(engine, plant).spec.id}"
    kwargs = {"n_envs": 2, "seed": 3, "env_kwargs": {"parameters": {STIFFNESS[plant]: 200.0}}}
    here, there = make_vec_env(env_id, **kwargs), make_vec_env(env_id, vec_env_cls=SubprocVecEnv, **kwargs)
    np.testing.assert_array_equal(here.reset(), there.reset())
    for action in random_actions(60).reshape(30, 2, 1):
        # Rewards come as float32 from one and as float64 from the other.
        for first, second in zip(here.step(action)[:3], there.step(action)[:3], strict=True):
            np.testing.assert_array_equal(first, second.astype(first.dtype))
    there.close()


@both_plants
def test_a_pickled_environment_is_rebuilt_with_its_arguments(engine, plant):
    env = make(engine, plant, parameters={"gravity": 5.0}, **{GREATEST[plant]: 25.0}).unwrapped
    actions = random_actions(20)
    for twin in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env)):
        assert twin.parameters == type(env.parameters)(gravity=5.0)
        assert twin.max_force == 25.0
        for first, second in zip(rollout(env, 1, actions), rollout(twin, 1, actions), strict=True):
            np.testing.assert_array_equal(first, second)


@both_plants
def test_starts_fill_the_reset_range_and_no_more(engine, plant):
    env = make(engine, plant)
    starts = np.array([env.reset(seed=seed)[0] for seed in range(300)]) / DOCUMENTED[plant][1]
    assert (np.abs(starts) <= 1.0).all()
    np.testing.assert_array_less(0.95, np.abs(starts).max(axis=0))
    np.testing.assert_allclose(starts.std(axis=0), 1 / np.sqrt(3), rtol=0.1)


def test_a_given_start_is_the_first_observation(engine):
    env = make(engine)
    start = [0.3, -0.4, 0.2, 1.5]
    observation, info = env.reset(options={"state": start})
    np.testing.assert_array_equal(observation, start)
    assert observation.dtype == env.observation_space.dtype == np.float64
    assert info["force"] == 0.0
    depth = 0.3 + 0.6 * np.sin(0.2) - 0.35
    np.testing.assert_allclose(info["wall_forces"], [700.0 * depth, 0.0])
    observation[:] = 0.0  # the caller's copy
    np.testing.assert_array_equal(env.unwrapped.state, start)


def test_an_acrobots_given_start_is_the_first_observation(engine):
    env = make(engine, ACROBOT)
    start = [-0.3, 0.4, 0.2, 1.5]
    observation, info = env.reset(options={"state": start})
    np.testing.assert_array_equal(observation, start)
    assert info["torque"] == 0.0
    np.testing.assert_allclose(info["limit_torques"], [0.0, 300.0 * (0.3 - 0.2)])


def test_reward_is_for_the_state_before_the_step_and_the_clipped_force(engine):
    env = make(engine)
    start = np.array([0.2, -0.3, 0.1, 0.4])
    for action, force in ((0.25, 25.0), (-3.0, -100.0)):
        env.reset(options={"state": start})
        _, reward, _, _, info = env.step(np.array([action], dtype=np.float32))
        cost = 20 * 0.2**2 + 20 * 0.3**2 + 0.1 * 0.1**2 + 0.1 * 0.4**2
        np.testing.assert_allclose(reward, 15 - cost - 1e-3 * force**2, rtol=1e-12)
        assert info["force"] == force


def test_an_acrobots_reward_is_for_the_state_before_the_step_and_the_clipped_torque(engine):
    env = make(engine, ACROBOT)
    start = np.array([0.1, -0.2, 0.3, 0.4])
    for action, torque in ((0.25, 2.5), (-3.0, -10.0)):
        env.reset(options={"state": start})
        _, reward, _, _, info = env.step(np.array([action], dtype=np.float32))
        cost = 10 * 0.1**2 + 10 * 0.2**2 + 0.3**2 + 0.4**2
        np.testing.assert_allclose(reward, 15 - cost - 1e-2 * torque**2, rtol=1e-12)
        assert info["torque"] == torque


def test_the_torque_turns_the_elbow(engine):
    env = make(engine, ACROBOT)
    env.reset(options={"state": np.zeros(4)})
    observation = env.step(np.array([0.2], dtype=np.float32))[0]
    acceleration = equations_of_motion(np.zeros(4), 2.0, env.unwrapped.parameters)
    assert acceleration[3] > 0.0 > acceleration[2]
    np.testing.assert_allclose(observation[2:], 0.01 * acceleration[2:], rtol=0.01)


def test_the_force_pushes_the_cart(engine):
    env = make(engine)
    env.reset(options={"state": np.zeros(4)})
    observation = env.step(np.array([0.5], dtype=np.float32))[0]
    acceleration = equations_of_motion(np.zeros(4), 50.0, env.unwrapped.parameters)
    np.testing.assert_allclose(observation[[1, 3]], 0.01 * acceleration[[1, 3]], rtol=0.01)


@pytest.mark.parametrize(
    ("start", "ends"),
    [
        ([0.999, 0.5, 0.0, 0.0], True),
        ([-0.999, -0.5, 0.0, 0.0], True),
        ([0.0, 0.0, 1.0, 8.0], True),
        ([0.0, 0.0, -1.0, -8.0], True),
        ([0.9, 0.1, 0.9, 0.1], False),
    ],
)
def test_leaving_the_safe_range_terminates(engine, start, ends):
    # Walls out of the way, so that nothing pushes back.
    env = make(engine, parameters={"wall_distance": 5.0})
    env.reset(options={"state": start})
    _, _, terminated, truncated, _ = env.step(np.zeros(1, dtype=np.float32))
    assert terminated is ends
    assert truncated is False


@pytest.mark.parametrize(
    ("start", "ends"),
    [
        ([1.04, 0.0, 1.0, 0.0], True),
        ([-1.04, 0.0, -1.0, 0.0], True),
        ([0.1, 0.94, 0.0, 2.0], True),
        ([-0.1, -0.94, 0.0, -2.0], True),
        ([-0.5, 1.2, 0.0, 0.1], False),
    ],
)
def test_an_acrobot_that_leans_out_too_far_has_fallen(engine, start, ends):
    # Stops out of the way, so that nothing pushes back.
    env = make(engine, ACROBOT, parameters={"limit_angle": 3.0})
    env.reset(options={"state": start})
    _, _, terminated, truncated, _ = env.step(np.zeros(1, dtype=np.float32))
    assert terminated is ends
    assert truncated is False


@both_plants
def test_an_episode_is_truncated_after_400_steps(engine, plant):
    env = make(engine, plant, parameters={"gravity": 0.0})
    env.reset(options={"state": np.zeros(4)})
    ends = [env.step(np.zeros(1, dtype=np.float32))[2:4] for _ in range(400)]
    assert ends == [(False, False)] * 399 + [(False, True)]


def test_info_reports_the_wall_that_is_hit(engine):
    env = make(engine)
    for start, wall in (([0.33, 0.8, 0.05, 0.0], 0), ([-0.33, -0.8, -0.05, 0.0], 1)):
        env.reset(options={"state": start})
        info = env.step(np.zeros(1, dtype=np.float32))[4]
        assert info["wall_forces"].shape == (2,)
        assert info["wall_forces"][wall] > 1.0
        assert info["wall_forces"][1 - wall] == 0.0


def test_info_reports_the_stop_that_is_hit(engine):
    env = make(engine, ACROBOT)
    for start, stop in (([0.19, 0.0, 2.0, 0.0], 0), ([-0.19, 0.0, -2.0, 0.0], 1)):
        env.reset(options={"state": start})
        info = env.step(np.zeros(1, dtype=np.float32))[4]
        assert info["limit_torques"].shape == (2,)
        assert info["limit_torques"][stop] > 0.5
        assert info["limit_torques"][1 - stop] == 0.0


@pytest.mark.parametrize(
    ("plant", "parameters"),
    [(CART_POLE, CartPoleParameters(wall_stiffness=200.0)), (ACROBOT, AcrobotParameters(limit_stiffness=200.0))],
)
def test_the_ground_truth_is_that_of_the_environments_own_parameters(engine, plant, parameters):
    given = {"parameters": {STIFFNESS[plant]: 200.0}, GREATEST[plant]: 20.0, "control_step": 0.02}
    env = make(engine, plant, **given).unwrapped
    assert env.parameters == parameters
    assert make(engine, plant, parameters=parameters).unwrapped.parameters == parameters
    for mine, expected in zip(env.true_lcs(), true_lcs(parameters, 0.02, 20.0), strict=True):
        np.testing.assert_array_equal(mine, expected)
    state = np.array([0.4, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(env.equations_of_motion(state, 3.0), equations_of_motion(state, 3.0, parameters))


def test_every_number_of_the_task_can_be_changed(engine):
    env = make(
        engine,
        max_force=50.0,
        control_step=0.02,
        physics_step=0.002,
        state_weights=(1.0, 2.0, 3.0, 4.0),
        action_weight=0.5,
        reward_constant=-1.0,
        reset_range=(0.0, 0.0, 0.1, 0.0),
        theta_limit=0.2,
        x_limit=0.3,
    )
    start, _ = env.reset(seed=0)
    np.testing.assert_array_equal(start[[0, 1, 3]], 0.0)
    assert env.unwrapped.metadata["render_fps"] == 50
    env.reset(options={"state": [0.29, 1.0, 0.1, -1.0]})
    _, reward, terminated, _, info = env.step(np.array([0.1], dtype=np.float32))
    np.testing.assert_allclose(info["force"], 5.0, rtol=1e-6)
    np.testing.assert_allclose(reward, -1.0 - (0.29**2 + 2.0 + 3 * 0.1**2 + 4.0) - 0.5 * info["force"] ** 2, rtol=1e-12)
    assert terminated


def test_every_number_of_the_acrobots_task_can_be_changed(engine):
    env = make(
        engine,
        ACROBOT,
        max_torque=5.0,
        control_step=0.02,
        physics_step=0.002,
        state_weights=(1.0, 2.0, 3.0, 4.0),
        action_weight=0.5,
        reward_constant=-1.0,
        reset_range=(0.0, 0.0, 0.1, 0.0),
        lean_limit=0.2,
    )
    start, _ = env.reset(seed=0)
    np.testing.assert_array_equal(start[[0, 1, 3]], 0.0)
    assert env.unwrapped.metadata["render_fps"] == 50
    assert env.unwrapped.max_torque == 5.0
    env.reset(options={"state": [0.1, 0.09, 1.0, 1.0]})
    _, reward, terminated, _, info = env.step(np.array([0.1], dtype=np.float32))
    np.testing.assert_allclose(info["torque"], 0.5, rtol=1e-6)
    cost = 0.1**2 + 2 * 0.09**2 + 3.0 + 4.0
    np.testing.assert_allclose(reward, -1.0 - cost - 0.5 * info["torque"] ** 2, rtol=1e-12)
    assert terminated


@pytest.mark.parametrize("action", [[np.nan], [np.inf], [0.0, 0.0], 0.0, [[0.0]]])
def test_an_action_that_is_not_one_finite_number_is_refused(engine, action):
    env = make(engine).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must be 1 finite number"):
        env.step(np.array(action))


def test_stepping_before_reset_is_refused(engine):
    with pytest.raises(ResetNeeded):
        make(engine).unwrapped.step(np.zeros(1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"state": [0.0, 0.0, 0.0]}, r"options\['state'\]"),
        ({"state": [0.0, np.nan, 0.0, 0.0]}, r"options\['state'\]"),
        ({"state": [1.5, 0.0, 0.0, 0.0]}, r"options\['state'\] must be inside"),
        ({"start": [0.0, 0.0, 0.0, 0.0]}, "'start'"),
    ],
)
def test_impossible_starts_are_refused(engine, options, message):
    with pytest.raises(ValueError, match=message):
        make(engine).reset(options=options)


@pytest.mark.parametrize("start", [[1.1, 0.0, 0.0, 0.0], [0.6, 0.6, 0.0, 0.0], [-0.6, -0.6, 0.0, 0.0]])
def test_an_acrobot_that_has_fallen_is_no_start(engine, start):
    with pytest.raises(ValueError, match=r"options\['state'\] must be inside \|theta_1\| <= 1.047.*theta_1 \+ theta_2"):
        make(engine, ACROBOT).reset(options={"state": start})


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"simulator": "mujoco"}, ValueError, "simulator must be one of"),
        ({"parameters": {"mass": 1.0}}, ValueError, "mass"),
        ({"parameters": 3}, TypeError, "parameters"),
        ({"max_force": 0.0}, ValueError, "max_force"),
        ({"control_step": 0.0105}, ValueError, "control_step"),
        ({"physics_step": -0.001}, ValueError, "physics_step"),
        ({"state_weights": [1.0]}, ValueError, "state_weights"),
        ({"state_weights": [1.0, -1.0, 1.0, 1.0]}, ValueError, "state_weights"),
        ({"action_weight": -1.0}, ValueError, "action_weight"),
        ({"reward_constant": float("nan")}, ValueError, "reward_constant"),
        ({"reset_range": [0.1, 0.1, 0.1, -0.1]}, ValueError, "reset_range"),
        ({"theta_limit": "wide"}, TypeError, "theta_limit"),
        ({"x_limit": 0.0}, ValueError, "x_limit"),
        ({"render_mode": "ansi"}, ValueError, "render_mode"),
    ],
)
def test_impossible_arguments_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        CartPoleSoftWallsEnv(**arguments)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"simulator": "mujoco"}, ValueError, "simulator must be one of"),
        ({"parameters": {"wall_stiffness": 1.0}}, ValueError, "wall_stiffness"),
        ({"parameters": CartPoleParameters()}, TypeError, "parameters must be AcrobotParameters"),
        ({"max_torque": 0.0}, ValueError, "max_torque"),
        ({"state_weights": [1.0, -1.0, 1.0, 1.0]}, ValueError, "state_weights.*theta_1, theta_2"),
        ({"lean_limit": -1.0}, ValueError, "lean_limit"),
    ],
)
def test_an_acrobots_impossible_arguments_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        AcrobotSoftLimitsEnv(**arguments)


@both_plants
def test_drakes_human_view_follows_the_episode(plant):
    geometry = pytest.importorskip("pydrake.geometry")
    del geometry
    env = gym.make(f"{plant}Drake-v0", render_mode="human")
    seen, unseen = rollout(env, 0, random_actions(5)), rollout(make("drake", plant), 0, random_actions(5))
    for first, second in zip(seen, unseen, strict=True):
        np.testing.assert_array_equal(first, second)
    assert env.render() is None
    env.close()
