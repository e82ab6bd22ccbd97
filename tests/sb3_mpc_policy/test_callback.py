"""What the model learns from: the action that was applied, and the state it really led to."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_mpc_policy import PredictionLossCallback
from sb3_mpc_policy.prediction import prediction_loss
from sb3_mpc_policy.terminal_value import QuadraticCritic
from tests.sb3_mpc_policy.toy_environments import point_mass, policy_of, recorded, several, small_ppo

VEC_ENVS: dict[str, Callable[[], Any]] = {
    "one": lambda: several(1),
    "three": lambda: several(3),
    "subprocesses": lambda: SubprocVecEnv([point_mass] * 2),
}


@pytest.mark.parametrize("name", sorted(VEC_ENVS))
def test_the_recorded_transitions_are_those_that_happened_inside_the_environment(name: str) -> None:
    env = VEC_ENVS[name]()
    # the widest noise that there is: some actions are clipped
    model = small_ppo(env, n_steps=48, log_std_init=0.0).learn(48)
    truth, rows = recorded(env), policy_of(model).store.rows()
    env.close()

    assert np.abs(model.rollout_buffer.actions).max() > 0.5, "no action was clipped"
    jumps = [np.abs(truth[i + env.num_envs, :2] - truth[i, 4:]).max() > 1e-3 for i in range(len(truth) - env.num_envs)]
    assert sum(jumps) >= 2, "no episode ended, so that nothing tells the terminal observation from the reset"
    np.testing.assert_array_equal(rows, truth)


def test_terminated_and_truncated_episodes_both_end_in_their_terminal_state() -> None:
    env = several(1)
    model = small_ppo(env, n_steps=96, log_std_init=-1.0).learn(96)
    truth = recorded(env)
    ends = np.flatnonzero(np.abs(truth[1:, :2] - truth[:-1, 4:]).max(axis=1) > 1e-3)
    terminated = np.abs(truth[ends, 4]) > 0.6
    assert terminated.any() and not terminated.all()
    np.testing.assert_array_equal(policy_of(model).store.everything().s_next[ends], truth[ends, 4:])


def test_a2c_records_the_same_way() -> None:
    env = several(2)
    model = A2C("MpcLcsPolicy", env, policy_kwargs=dict(horizon=3, log_std_init=0.0), seed=0, device="cpu").learn(40)
    np.testing.assert_array_equal(policy_of(model).store.rows(), recorded(env))


# -- VecNormalize ----------------------------------------------------------------------------------------------


def test_the_reward_is_recorded_before_it_is_normalised() -> None:
    inner = several(2)
    env = VecNormalize(inner, norm_obs=False, norm_reward=True)
    model = small_ppo(env).learn(64)
    rewards = policy_of(model).store.everything().reward
    np.testing.assert_array_equal(rewards, recorded(inner)[:, 3])
    assert np.abs(model.rollout_buffer.rewards.ravel().sum() - rewards[-64:].sum()) > 1.0  # PPO's are normalised


def test_the_policy_is_told_what_the_rewards_of_the_critic_were_divided_by(monkeypatch: pytest.MonkeyPatch) -> None:
    env = VecNormalize(several(1), norm_obs=False, norm_reward=True)
    model = small_ppo(env, terminal_value="critic")
    told: list[float] = []
    original = model.policy.mpc.refresh

    def refresh(critic: QuadraticCritic | None = None, reward_scale: float = 1.0) -> str:
        told.append(reward_scale)
        return original(critic, reward_scale)

    monkeypatch.setattr(model.policy.mpc, "refresh", refresh)
    model.learn(32)
    assert told[-1] == pytest.approx(np.sqrt(env.ret_rms.var + env.epsilon))
    assert told[-1] != told[0]


def test_normalised_observations_are_refused_before_any_step() -> None:
    inner = several(1)
    model = small_ppo(VecNormalize(inner, norm_obs=True))
    with pytest.raises(ValueError, match=r"VecNormalize\(norm_obs=True\).*norm_obs=False.*state_scale"):
        model.learn(32)
    assert not inner.env_method("recorded")[0].size


# -- which transitions an update sees --------------------------------------------------------------------------


class LossAtUpdate(BaseCallback):
    """Notes the prediction loss on which each update starts, and the model it is a loss of."""

    def __init__(self) -> None:
        super().__init__()
        self.losses: list[float] = []
        self.expected: list[dict[bool, float]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        policy = policy_of(self.model)
        self.losses.append(policy.prediction_loss().item())
        rows = recorded(self.training_env)
        self.expected.append({True: self.loss_on(rows), False: self.loss_on(rows[-self.model.n_steps :])})

    def loss_on(self, rows: np.ndarray) -> float:
        s, a, _, s_next = (torch.as_tensor(part) for part in np.split(rows, [2, 3, 4], axis=1))
        deviation = (s_next - s).std(dim=0, correction=0)
        return prediction_loss(policy_of(self.model).lcs, s, a, s_next, deviation).item()


@pytest.mark.parametrize("replay", [True, False])
def test_the_loss_is_over_all_transitions_with_replay_and_over_the_rollout_without(replay: bool) -> None:
    notes = LossAtUpdate()
    small_ppo(several(1), replay=replay, model_fit="gradient").learn(96, notes)
    assert len(notes.losses) == 3
    assert notes.losses == pytest.approx([expected[replay] for expected in notes.expected])
    assert notes.expected[2][True] != pytest.approx(notes.expected[2][False])


def test_of_too_many_transitions_a_sample_is_drawn_anew_for_each_rollout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_mpc_policy.policies._LARGEST_LOSS_BATCH", 10)
    drawn = []

    class Notes(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            drawn.append(policy_of(self.model)._loss_data[0])

    model = small_ppo(several(1)).learn(64, Notes())
    known = {tuple(row) for row in policy_of(model).store.everything().s}
    assert [len(states) for states in drawn] == [10, 10]
    assert {tuple(row) for row in torch.cat(drawn).tolist()} <= known
    assert not torch.equal(drawn[0], drawn[1])


def test_a_second_call_of_learn_goes_on_with_all_transitions() -> None:
    env = several(1)
    model = small_ppo(env).learn(32)
    model.learn(32, reset_num_timesteps=False)
    np.testing.assert_array_equal(policy_of(model).store.rows(), recorded(env))


def test_a_callback_that_ends_training_in_mid_rollout_leaves_a_usable_policy() -> None:
    steps = itertools.count()
    model = small_ppo(several(1)).learn(96, lambda locals_, globals_: next(steps) < 40)
    assert len(policy_of(model).store) == model.num_timesteps == 41
    assert np.isfinite(model.predict(np.zeros(2))[0]).all()


# -- what is refused -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spoil_step", [1, 40])
def test_an_observation_that_is_not_finite_is_refused_before_it_reaches_a_parameter(spoil_step: int) -> None:
    model = small_ppo(several(1, spoil_step=spoil_step))
    with pytest.raises(ValueError, match=r"transitions must be finite, got state.*next state \[\[nan nan\]\]"):
        model.learn(96)
    assert len(policy_of(model).store) == spoil_step - 1
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


def test_a_policy_of_another_class_is_refused() -> None:
    model = PPO("MlpPolicy", DummyVecEnv([point_mass]), n_steps=32, batch_size=32, device="cpu")
    with pytest.raises(TypeError, match=r"PredictionLossCallback is for MpcLcsPolicy.*is a ActorCriticPolicy"):
        model.learn(32, CallbackList([PredictionLossCallback()]))
