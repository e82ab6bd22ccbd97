"""The evaluation protocol does what its description says, and leaves training alone."""

from __future__ import annotations

import random
from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_mpc_policy  # noqa: F401 - registers the policy and the environments
from benchmarks import evaluation
from benchmarks.evaluation import Evaluation, EvaluationCallback, Evaluator
from benchmarks.references import cart_pole, lqr, oracle

ENV_ID = "CartPoleSoftWallsPyBullet-v0"
ORACLE = 1000.0


def run(*scores: float) -> list[Evaluation]:
    """A training run with these scores, one evaluation every 128 steps and 3 episodes."""
    return [Evaluation(128 * i, 3 * i, 1.0 * i, score) for i, score in enumerate(scores)]


@pytest.fixture
def evaluator() -> Iterator[Evaluator]:
    evaluator = Evaluator(ENV_ID, n_episodes=2)
    yield evaluator
    evaluator.close()


class CountedEpisodes(gym.Env):
    """Episodes that last 3 steps, then 5, then 3 again; the policy has no say."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (4,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self) -> None:
        self.length = 5
        self.left = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.length = 8 - self.length
        self.left = self.length
        return np.zeros(4, np.float32), {}

    def step(self, action):
        self.left -= 1
        return np.zeros(4, np.float32), 0.0, self.left == 0, False, {}


# -- solved, rollouts to solve, held --


@pytest.mark.parametrize(
    ("scores", "rollouts", "held"),
    [
        pytest.param([0, 500, 949], None, False, id="never solved"),
        pytest.param([0, 950, 990], 3, True, id="exactly 95 % is solved"),
        pytest.param([0, 960, 901, 900], 3, True, id="90 % and more is held"),
        pytest.param([0, 960, 899.9, 1000], 3, False, id="one dip is not held, whatever comes after"),
        pytest.param([800, 100, 970], 6, True, id="what came before does not count"),
        pytest.param([0, 0, 0, 1100], 9, True, id="solved by the last evaluation"),
        pytest.param([960, 950], 0, True, id="solved untrained"),
    ],
)
def test_verdict(scores: list[float], rollouts: int | None, held: bool) -> None:
    assert evaluation.rollouts_to_solve(run(*scores), ORACLE) == rollouts
    assert evaluation.held(run(*scores), ORACLE) is held


def test_solved_is_the_first_evaluation_that_qualifies() -> None:
    assert evaluation.solved(run(0, 951, 999), ORACLE) == Evaluation(128, 3, 1.0, 951)


def test_a_fraction_of_a_negative_oracle_is_refused() -> None:
    with pytest.raises(ValueError, match="oracle"):
        evaluation.solved(run(0), -5.0)


# -- score --


def test_score_of_lqr_is_that_of_a_plain_loop_over_episodes() -> None:
    controller = lqr(ENV_ID)
    env = gym.make(ENV_ID)
    returns = []
    for seed in evaluation.RESET_SEEDS[:4]:
        observation, _ = env.reset(seed=seed)
        returns.append(0.0)
        over = False
        while not over:
            action = np.clip(controller(observation[None])[0], -1.0, 1.0).astype(np.float32)
            observation, reward, terminated, truncated, _ = env.step(action)
            returns[-1] += reward
            over = terminated or truncated
    env.close()
    assert evaluation.score(controller, ENV_ID, n_episodes=4) == pytest.approx(np.mean(returns), rel=1e-6)
    assert min(returns) > 5_000  # of at most 6,000: it balances


def test_the_oracle_balances_every_pole_that_lqr_does(evaluator: Evaluator) -> None:
    assert evaluator.returns(oracle(ENV_ID)) == pytest.approx(evaluator.returns(lqr(ENV_ID)), rel=0.05)


def test_references_are_for_environments_that_know_their_true_model() -> None:
    with pytest.raises(TypeError, match="env_id"):
        lqr("Pendulum-v1")
    with pytest.raises(TypeError, match="env_id must name a cart-pole"), cart_pole("AcrobotSoftLimitsPyBullet-v0"):
        pass


def test_an_environment_without_a_box_of_actions_is_refused() -> None:
    with pytest.raises(ValueError, match="env_id"):
        Evaluator("CartPole-v1", n_episodes=1)


def test_an_episode_leaves_the_batch_when_it_is_over(evaluator: Evaluator) -> None:
    """A controller that pushes to one side drops the poles at different times."""
    batches = []

    def push(observations: np.ndarray) -> np.ndarray:
        batches.append(len(observations))
        return np.full((len(observations), 1), 0.2)

    returns = evaluator.returns(push)
    assert batches[0] == 2 and batches[-1] == 1 and len(batches) < 400
    assert sorted(batches, reverse=True) == batches
    assert returns.shape == (2,)


def test_evaluating_twice_gives_the_same_returns(evaluator: Evaluator) -> None:
    controller = lqr(ENV_ID)
    assert np.array_equal(evaluator.returns(controller), evaluator.returns(controller))


def test_actions_beyond_the_bounds_are_clipped(evaluator: Evaluator) -> None:
    beyond = evaluator.returns(lambda obs: np.full((len(obs), 1), 7.0))
    bound = evaluator.returns(lambda obs: np.full((len(obs), 1), 1.0))
    assert np.array_equal(beyond, bound)


def test_a_model_is_scored_on_the_observations_it_was_trained_on(evaluator: Evaluator) -> None:
    env = VecNormalize(DummyVecEnv([lambda: gym.make(ENV_ID)]))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, seed=0, device="cpu").learn(128)
    counted = env.obs_rms.count

    def by_hand(observations: np.ndarray) -> np.ndarray:
        whitened = (observations - env.obs_rms.mean) / np.sqrt(env.obs_rms.var + env.epsilon)
        with torch.no_grad():
            mean = model.policy.get_distribution(torch.as_tensor(whitened, dtype=torch.float32)).mode()
        return np.clip(mean.numpy(), -1.0, 1.0)

    scored = evaluator.returns(evaluation.controller_of(model))
    assert scored == pytest.approx(evaluator.returns(by_hand), rel=1e-4)
    assert env.obs_rms.count == counted


@pytest.mark.parametrize("n_episodes", [0, 51])
def test_number_of_episodes_out_of_range(n_episodes: int) -> None:
    with pytest.raises(ValueError, match="n_episodes"):
        Evaluator(ENV_ID, n_episodes)


# -- during training --


def train(callback: EvaluationCallback | None, policy: str = "MlpPolicy") -> PPO:
    model = PPO(policy, gym.make(ENV_ID), n_steps=64, batch_size=32, n_epochs=2, seed=3, device="cpu")
    return model.learn(256, callback=callback)


class DrawingEvaluator(Evaluator):
    """Draws from every global random state while it scores."""

    def score(self, controller):
        random.random(), np.random.rand(), torch.rand(1)  # noqa: NPY002
        return super().score(controller)


@pytest.mark.parametrize("policy", ["MlpPolicy", "MpcLcsPolicy"])
def test_training_is_the_same_to_the_bit_with_and_without_evaluation(policy: str) -> None:
    evaluator = DrawingEvaluator(ENV_ID, n_episodes=2)
    with_evaluation = train(EvaluationCallback(evaluator, every=64), policy)
    drawn = (random.random(), np.random.rand(), torch.rand(1).item())  # noqa: NPY002
    without = train(None, policy)
    assert drawn == (random.random(), np.random.rand(), torch.rand(1).item())  # noqa: NPY002
    states = with_evaluation.policy.state_dict(), without.policy.state_dict()
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name]), name
    assert np.array_equal(with_evaluation._last_obs, without._last_obs)
    evaluator.close()


def test_random_states_outlive_a_policy_that_draws_from_them() -> None:
    torch.manual_seed(1)
    with evaluation.random_state_kept():
        expected = torch.rand(1), np.random.rand(), random.random()  # noqa: NPY002
    assert (torch.rand(1), np.random.rand(), random.random()) == expected  # noqa: NPY002


def test_evaluations_stand_between_rollouts(evaluator: Evaluator) -> None:
    callback = EvaluationCallback(evaluator, every=128)
    train(callback)
    assert [e.steps for e in callback.evaluations] == [0, 128, 256]

    every_rollout = EvaluationCallback(evaluator, every=1)
    train(every_rollout)
    assert [e.steps for e in every_rollout.evaluations] == [0, 64, 128, 192, 256]


@pytest.mark.parametrize(
    ("every", "steps"),
    [
        pytest.param([[128, 64], [None, 128]], [0, 64, 128, 256], id="seldom later"),
        pytest.param([[128, 1000], [None, 64]], [0, 256], id="an evaluation is due by the part the last one is in"),
        pytest.param([(100, 64), (150, 10), (None, 100)], [0, 64, 128, 192, 256], id="three parts"),
    ],
)
def test_evaluations_may_get_rarer_in_the_course_of_training(
    evaluator: Evaluator, every: list, steps: list[int]
) -> None:
    callback = EvaluationCallback(evaluator, every)
    train(callback)
    assert [e.steps for e in callback.evaluations] == steps


@pytest.mark.parametrize(
    "every", [0, -1, True, "128", [], [[None, 0]], [[64, 32]], [[64, 32], [64, 32], [None, 64]], [[0, 1], [None, 64]],
              [[None, 32], [None, 64]], [[64, 32, 1], [None, 64]], [64], None]
)  # fmt: skip
def test_a_schedule_that_is_none_is_refused(evaluator: Evaluator, every: object) -> None:
    with pytest.raises(ValueError, match="every must be"):
        EvaluationCallback(evaluator, every)


def test_an_off_policy_algorithm_is_evaluated_with_its_present_policy_and_trains_as_without(
    evaluator: Evaluator,
) -> None:
    def train(callback: EvaluationCallback | None) -> SAC:
        model = SAC("MlpPolicy", gym.make(ENV_ID), learning_starts=20, seed=0, policy_kwargs={"net_arch": [16]})
        return model.learn(50, callback=callback)

    callback = EvaluationCallback(evaluator, every=20)
    with_evaluation, without = train(callback), train(None)
    assert [e.steps for e in callback.evaluations] == [0, 20, 40, 50]
    assert callback.evaluations[-1].score == evaluator.score(evaluation.controller_of(with_evaluation))
    assert len({e.score for e in callback.evaluations[1:]}) == 3
    for name, value in with_evaluation.policy.state_dict().items():
        assert torch.equal(value, without.policy.state_dict()[name]), name


@pytest.mark.parametrize("policy", ["MlpPolicy", "MpcLcsPolicy"])
def test_the_last_score_is_that_of_the_trained_model(evaluator: Evaluator, policy: str) -> None:
    callback = EvaluationCallback(evaluator, every=128)
    model = train(callback, policy)
    assert callback.evaluations[-1].score == pytest.approx(evaluator.score(evaluation.controller_of(model)))
    assert callback.evaluations[-1].score != callback.evaluations[0].score


@pytest.mark.parametrize(
    ("n_envs", "begun"),
    [
        # Episodes end at steps 3, 8, 11, 16; evaluations stand at 0, 4, 8, 12, 16. So an episode is under way
        # at 4 and at 12, and none at 8 and at 16.
        pytest.param(1, [0, 2, 2, 4, 4], id="one environment"),
        pytest.param(3, [0, 6, 6, 12, 12], id="three environments"),
    ],
)
def test_rollouts_are_the_episodes_begun(evaluator: Evaluator, n_envs: int, begun: list[int]) -> None:
    model = PPO("MlpPolicy", DummyVecEnv([CountedEpisodes] * n_envs), n_steps=4, batch_size=4, device="cpu")
    callback = EvaluationCallback(evaluator, every=1)
    model.learn(16 * n_envs, callback=callback)
    assert [e.rollouts for e in callback.evaluations] == begun


def test_time_spent_on_evaluation_is_not_training_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(float(t) for t in (100, 100, 160, 163, 200))
    monkeypatch.setattr(evaluation.time, "perf_counter", lambda: next(clock))

    class Stub:
        num_timesteps = 0

    callback = EvaluationCallback(Evaluator.__new__(Evaluator), every=1)
    monkeypatch.setattr(callback.evaluator, "score", lambda controller: 0.0, raising=False)
    monkeypatch.setattr(evaluation, "controller_of", lambda model: None)
    callback.model = Stub()
    callback._on_training_start()  # at 100
    callback._evaluate()  # 100 to 160
    callback.num_timesteps = 64
    callback._evaluate()  # begins at 163
    assert [e.seconds for e in callback.evaluations] == [0.0, 3.0]
