"""Rollouts around a shifted target: where it goes, and who is concerned by it."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback

from sb3_mpc_policy import LinearComplementaritySystem, MpcLcsPolicy
from sb3_mpc_policy.exploration import MOST_NOISE, WanderingTarget
from tests.sb3_mpc_policy.toy_environments import fingerprint, policy_of, several, small_ppo

ModelFactory = Callable[..., LinearComplementaritySystem]
SIZES = [(1, 1), (4, 1), (3, 2), (2, 3)]


def shifts(target: WanderingTarget, lcs: LinearComplementaritySystem, rollouts: int) -> np.ndarray:
    """(rollouts, n_x + n_a), scaled coordinates."""
    scale = torch.cat([lcs.state_scale, lcs.action_scale]).numpy()
    rows = []
    for _ in range(rollouts):
        target.move(lcs)
        rows.append(np.concatenate([target.state, target.action]) / scale)
    return np.array(rows)


# -- where the target goes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n_x", "n_a"), SIZES)
def test_every_shift_is_a_steady_state_of_the_model_in_the_units_of_the_environment(
    n_x: int, n_a: int, random_model: ModelFactory
) -> None:
    lcs = random_model(3, n_x, n_a, 1)
    A, B = lcs.A.detach().numpy(), lcs.B.detach().numpy()
    target = WanderingTarget(n_x, n_a, 2.0)
    for _ in range(40):
        target.move(lcs)
        assert target.is_shifted and target.state.shape == (n_x,) and target.action.shape == (n_a,)
        left = A @ target.state + B @ target.action - target.state
        np.testing.assert_allclose(left, 0.0, atol=1e-9 * (np.abs(target.state).max() + np.abs(target.action).max()))


@pytest.mark.parametrize("size", [0.3, 2.0])
def test_shifts_are_of_about_the_size_asked_for_and_come_gradually(size: float, random_model: ModelFactory) -> None:
    lengths, jumps = [], []
    for seed in range(10):
        torch.manual_seed(seed)
        path = shifts(WanderingTarget(3, 2, size), random_model(seed, 3, 2), 100)
        lengths.append(np.linalg.norm(path, axis=1))
        jumps.append(np.linalg.norm(np.diff(path, axis=0), axis=1).max())
    assert np.median(lengths) == pytest.approx(size, rel=0.2)
    assert np.max(lengths) < 1.6 * size
    assert np.max(jumps) < 3.0 * size  # from one side to the other is up to twice its largest


@pytest.mark.parametrize(("n_x", "n_a"), SIZES)
def test_opposite_sides_are_visited_equally(n_x: int, n_a: int, random_model: ModelFactory) -> None:
    lcs = random_model(0, n_x, n_a)
    torch.manual_seed(0)
    path = shifts(WanderingTarget(n_x, n_a, 1.0), lcs, 600)
    assert np.abs(path.mean(axis=0)).max() < 0.1 * np.linalg.norm(path, axis=1).mean()
    largest = int(np.argmax(path.std(axis=0)))
    assert np.mean(path[:, largest] > 0.0) == pytest.approx(0.5, abs=0.1)


def test_all_steady_states_are_visited_where_there_are_several_actions(random_model: ModelFactory) -> None:
    lcs = random_model(1, 3, 2)
    torch.manual_seed(0)
    path = shifts(WanderingTarget(3, 2, 1.0), lcs, 600)
    spread = np.linalg.svd(path, compute_uv=False)
    assert spread[1] > 0.3 * spread[0] and spread[2] < 1e-9 * spread[0]  # as many directions as actions


def test_each_side_is_held_for_some_rollouts(cart_pole: ModelFactory) -> None:
    torch.manual_seed(0)
    path = shifts(WanderingTarget(4, 1, 1.0), cart_pole(), 300)
    side = np.sign(path[:, 0])  # for a cart-pole, steady states are cart positions
    assert np.abs(path[:, 1:]).max() < 1e-9 and np.abs(path[:, 0]).max() > 0.8
    changes = np.flatnonzero(np.diff(side))
    assert len(changes) > 10 and np.diff(changes).min() >= 3


def test_a_model_that_changes_a_little_keeps_the_target_on_its_side(cart_pole: ModelFactory) -> None:
    """The model is fitted anew after each rollout."""
    still, restless, rng, path = cart_pole(), cart_pole(), np.random.default_rng(0), []
    torch.manual_seed(0)
    expected = shifts(WanderingTarget(4, 1, 1.0), still, 100)
    torch.manual_seed(0)
    target = WanderingTarget(4, 1, 1.0)
    for _ in range(100):
        with torch.no_grad():
            restless.A_scaled.copy_(still.A_scaled + 1e-6 * torch.as_tensor(rng.normal(size=(4, 4))))
        path.append(shifts(target, restless, 1)[0])
    np.testing.assert_allclose(path, expected, atol=1e-3)


def test_the_same_seed_gives_the_same_shifts_and_another_gives_others(random_model: ModelFactory) -> None:
    lcs, paths = random_model(0), []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        paths.append(shifts(WanderingTarget(3, 1, 1.0), lcs, 30))
    np.testing.assert_array_equal(paths[0], paths[1])
    assert np.abs(paths[0] - paths[2]).max() > 1e-3


def test_a_size_of_zero_moves_nothing_and_draws_no_random_numbers(random_model: ModelFactory) -> None:
    target, lcs = WanderingTarget(3, 1, 0.0), random_model(0)
    before = torch.get_rng_state()
    for _ in range(30):
        target.move(lcs)
        assert not target.is_shifted
    assert torch.equal(torch.get_rng_state(), before)


def test_a_reset_goes_back_to_the_target_itself(random_model: ModelFactory) -> None:
    target = WanderingTarget(3, 1, 1.0)
    target.move(random_model(0))
    assert target.is_shifted
    target.reset()
    assert not target.is_shifted and not target.state.any() and not target.action.any()


@pytest.mark.parametrize("size", [-1.0, np.nan, np.inf])
def test_a_size_that_makes_no_sense_is_refused(size: float) -> None:
    with pytest.raises(ValueError, match=f"target_noise must be a finite number >= 0, got {size}"):
        WanderingTarget(3, 1, size)
    with pytest.raises(ValueError, match="target_noise must be a finite number >= 0"):
        small_ppo(target_noise=size)


# -- the policy ------------------------------------------------------------------------------------------------


class Rollouts(BaseCallback):
    """Notes the shift of each rollout, and how the policy compares with itself while it is shifted."""

    def __init__(self) -> None:
        super().__init__()
        self.shifts: list[tuple[np.ndarray, np.ndarray]] = []
        self.ratios: list[torch.Tensor] = []
        self.means: list[tuple[torch.Tensor, torch.Tensor]] = []
        self.predictions: list[tuple[np.ndarray, np.ndarray]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        policy, buffer = policy_of(self.model), self.model.rollout_buffer
        shift = policy._target.state.copy(), policy._target.action.copy()
        self.shifts.append(shift)
        s = torch.as_tensor(buffer.observations.reshape(-1, buffer.obs_shape[0]))
        a = torch.as_tensor(buffer.actions.reshape(len(s), -1))
        old = torch.as_tensor(buffer.log_probs.ravel())
        with torch.no_grad():
            mean, _, _ = policy(s, deterministic=True)
            moved = policy.mpc(s - s.new_tensor(shift[0])) + s.new_tensor(shift[1])
            self.means.append((mean, moved))
            planned = policy.plan(s.numpy()).actions[:, 0]
            self.predictions.append((self.model.predict(s.numpy(), deterministic=True)[0], planned))
        _, log_prob, _ = policy.evaluate_actions(s, a)
        self.ratios.append((log_prob.detach() - old).exp())


@pytest.fixture(scope="module")
def shifted() -> Rollouts:
    """A run whose rollouts, from the second on, take place around other targets."""
    notes = Rollouts()
    small_ppo(several(2), target_noise=1.0, horizon=5, learning_rate=3e-3).learn(256, notes)
    assert len(notes.shifts) == 4
    return notes


def test_rollouts_take_place_around_the_shifted_target(shifted: Rollouts) -> None:
    assert not np.concatenate(shifted.shifts[0]).any()  # nothing is known yet
    for (state, action), (mean, moved) in zip(shifted.shifts[1:], shifted.means[1:], strict=True):
        assert state.any() or action.any()
        np.testing.assert_allclose(mean, moved, rtol=0.0, atol=1e-6)


def test_predictions_and_plans_are_not_shifted(shifted: Rollouts) -> None:
    for predicted, planned in shifted.predictions:
        np.testing.assert_allclose(predicted, planned, rtol=1e-6, atol=1e-7)
    assert np.abs(shifted.means[-1][0].numpy() - shifted.predictions[-1][1]).max() > 1e-2


def test_the_first_probability_ratio_of_an_update_is_one(shifted: Rollouts) -> None:
    for ratio in shifted.ratios:
        torch.testing.assert_close(ratio, torch.ones_like(ratio), rtol=0.0, atol=1e-4)


def test_samples_scatter_about_the_shifted_mean_and_samples_of_predict_about_the_plan() -> None:
    policy = policy_of(small_ppo(several(1), target_noise=1.0).learn(64))
    policy._target.state, policy._target.action = np.array([0.3, -0.2]), np.array([0.2])
    states = torch.zeros(2_000, 2)
    with torch.no_grad():
        collected, _, log_prob = policy(states)
        mean, _, _ = policy(states[:1], deterministic=True)
        plan = policy.mpc(states[:1])
        _, same, _ = policy.evaluate_actions(states, collected)
    predicted = policy.predict(states.numpy())[0]
    assert (mean - plan).abs().max() > 0.05
    std = policy.log_std.exp().item()
    assert collected.mean().item() == pytest.approx(mean.item(), abs=0.1 * std)
    assert predicted.mean() == pytest.approx(plan.item(), abs=0.1 * std)
    assert torch.equal(same, log_prob)


@pytest.mark.parametrize("most", [96, 70], ids=["at its end", "in mid rollout"])
def test_nothing_is_shifted_after_training(most: int) -> None:
    states = torch.as_tensor(np.random.default_rng(0).normal(size=(10, 2)).astype(np.float32))
    policy = policy_of(model := small_ppo(several(1), target_noise=1.0))
    was_shifted = []

    def go_on(*_: object) -> bool:
        was_shifted.append(policy._target.is_shifted)
        return len(policy.store) < most

    model.learn(96, go_on)
    assert len(policy.store) == most and was_shifted[-1] and not policy._target.is_shifted
    with torch.no_grad():
        mean, _, _ = policy(states, deterministic=True)
    np.testing.assert_allclose(mean, policy.plan(states.numpy()).actions[:, 0], rtol=1e-6, atol=1e-7)


def test_the_gradient_of_the_shifted_policy_is_that_of_the_controller_at_the_shifted_state() -> None:
    policy = policy_of(small_ppo(several(1), horizon=5).learn(64))
    s, a = torch.tensor([[0.2, -0.1], [0.1, 0.3]]), torch.tensor([[0.1], [-0.2]])
    shift = np.array([0.3, -0.2]), np.array([0.2])

    def gradients(state: np.ndarray, action: np.ndarray, s: torch.Tensor, a: torch.Tensor) -> list[torch.Tensor]:
        twin = copy.deepcopy(policy)
        twin.train()
        twin._target.state, twin._target.action = state, action
        twin.prepare_update()
        _, log_prob, _ = twin.evaluate_actions(s, a)
        return list(torch.autograd.grad(log_prob.sum(), list(twin.lcs.parameters())))

    moved = gradients(np.zeros(2), np.zeros(1), s - s.new_tensor(shift[0]), a - a.new_tensor(shift[1]))
    for one, two in zip(gradients(*shift, s, a), moved, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-6)


def test_without_target_noise_training_is_as_if_there_were_none(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = fingerprint(small_ppo(several(2), learning_rate=3e-3).learn(128).policy)
    monkeypatch.setattr(WanderingTarget, "move", lambda self, lcs: None)
    assert fingerprint(small_ppo(several(2), learning_rate=3e-3, target_noise=0.0).learn(128).policy) == plain
    monkeypatch.undo()
    assert fingerprint(small_ppo(several(2), learning_rate=3e-3, target_noise=1.0).learn(128).policy) != plain


# -- the width of the noise ------------------------------------------------------------------------------------


class WidestNoise(BaseCallback):
    """The largest standard deviation of any rollout."""

    largest = 0.0

    def _on_step(self) -> bool:
        self.largest = max(self.largest, self.model.policy.log_std.max().exp().item())
        return True


def test_the_paper_has_no_bound_on_the_noise() -> None:
    assert small_ppo(several(1), preset="paper", log_std_init=1.0, learning_rate=0.0).learn(64).policy.log_std == 1.0


@pytest.mark.parametrize("start", [3.0, None], ids=["wide from the start", "made wide by the entropy bonus"])
def test_the_noise_of_bounded_actions_is_never_wider_than_a_share_of_their_range(start: float | None) -> None:
    notes = WidestNoise()
    model = small_ppo(several(1), log_std_init=start, ent_coef=10.0, learning_rate=0.5).learn(128, notes)
    bound = MOST_NOISE * 0.5
    assert notes.largest == pytest.approx(bound, rel=1e-6) and model.policy.log_std.exp().item() <= bound * (1 + 1e-6)


def test_each_action_has_a_bound_of_its_own_and_unbounded_ones_have_none() -> None:
    policy = MpcLcsPolicy(
        spaces.Box(-np.inf, np.inf, (2,), np.float32),
        spaces.Box(np.array([-0.5, 0.0, -np.inf, 0.0], np.float32), np.array([0.5, 20.0, np.inf, np.inf], np.float32)),
        lambda progress: 1e-3,
        log_std_init=5.0,
    )
    policy.end_update()
    widest = [MOST_NOISE * 0.5, MOST_NOISE * 10.0, np.exp(5.0), np.exp(5.0)]
    np.testing.assert_allclose(policy.log_std.detach().exp(), widest, rtol=1e-5)


def test_noise_under_the_bound_is_left_alone() -> None:
    model = small_ppo(several(1), log_std_init=-4.0, learning_rate=0.0).learn(64)
    assert model.policy.log_std.item() == -4.0
