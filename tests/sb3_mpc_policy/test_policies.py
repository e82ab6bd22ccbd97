"""MpcLcsPolicy as an actor-critic policy: actions, plans, every choice of its arguments, training, errors."""

from __future__ import annotations

import copy
import itertools
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.torch_layers import NatureCNN

from sb3_mpc_policy import LinearComplementaritySystem, MpcLcsPolicy, QuadraticReward
from sb3_mpc_policy.model_fit import MODEL_FITS
from sb3_mpc_policy.prediction import PREDICTION_LOSSES, prediction_loss
from sb3_mpc_policy.solvers import SOLVERS, Solution
from sb3_mpc_policy.terminal_value import TERMINAL_VALUES, QuadraticCritic
from tests.sb3_mpc_policy.toy_environments import (
    CART_POLE,
    PointMass,
    box_env,
    fingerprint,
    point_mass,
    policy_of,
    several,
    small_ppo,
)


def box(shape: tuple[int, ...], bound: float = np.inf) -> spaces.Box:
    return spaces.Box(-bound, bound, shape, np.float32)


def make_policy(
    observations: spaces.Space | None = None, actions: spaces.Space | None = None, **kw: Any
) -> MpcLcsPolicy:
    """A policy on its own, without an algorithm."""
    return MpcLcsPolicy(observations or box((2,)), actions or box((1,), 0.5), lambda progress: 1e-3, **kw)


def finite(model: PPO | A2C) -> bool:
    return all(value.isfinite().all() for value in model.policy.state_dict().values() if value.is_floating_point())


@pytest.fixture(scope="module")
def trained() -> PPO:
    """A model that two updates have moved away from its start."""
    return small_ppo(several(1), horizon=5, learning_rate=3e-3).learn(64)


# -- actions and plans -----------------------------------------------------------------------------------------


def test_predict_takes_one_state_or_a_batch(trained: PPO) -> None:
    states = np.random.default_rng(0).normal(size=(7, 2))
    batch, _ = trained.predict(states, deterministic=True)
    assert batch.shape == (7, 1) and batch.dtype == np.float32
    for state, action in zip(states, batch, strict=True):
        single, _ = trained.predict(state, deterministic=True)
        assert single.shape == (1,)
        np.testing.assert_allclose(single, action, atol=1e-6)


def test_noise_is_added_only_where_it_is_asked_for(trained: PPO) -> None:
    states = np.zeros((200, 2))
    noisy, _ = trained.predict(states)
    still, _ = trained.predict(states, deterministic=True)
    assert still.std() == pytest.approx(0.0, abs=1e-7)
    std = trained.policy.log_std.exp().item()
    assert noisy.std() == pytest.approx(std, rel=0.2)
    assert (np.abs(trained.predict(1e3 * np.ones((3, 2)))[0]) <= 0.5).all()


def test_the_mean_of_the_distribution_is_the_first_action_of_the_plan(trained: PPO) -> None:
    states = np.random.default_rng(1).normal(size=(5, 2)).astype(np.float32)
    policy = policy_of(trained)
    mean = policy.get_distribution(torch.as_tensor(states)).distribution.mean.detach().numpy()
    planned = policy.plan(states).actions[:, 0]
    assert np.abs(planned).max() > 0.01
    np.testing.assert_allclose(mean, planned, rtol=1e-6, atol=1e-7)
    _, values, log_prob = policy(torch.as_tensor(states), deterministic=True)
    assert values.shape == (5, 1) and log_prob.shape == (5,)


@pytest.mark.parametrize("n_contacts", [0, 1, 3])
def test_plans_have_the_documented_shapes_and_the_units_of_the_environment(n_contacts: int) -> None:
    policy = make_policy(
        box((3,)),
        spaces.Box(-40.0, 60.0, (2,), np.float32),
        horizon=4,
        n_contacts=n_contacts,
        state_scale=[1e-2, 1.0, 1e3],
    )
    with torch.no_grad():
        policy.lcs.B_scaled.normal_()
    states = np.random.default_rng(2).normal(size=(6, 3)) * [1e-2, 1.0, 1e3]
    plan = policy.plan(states)
    assert plan.actions.shape == (6, 4, 2) and plan.states.shape == (6, 5, 3)
    assert plan.contact_forces.shape == plan.gaps.shape == (6, 4, n_contacts)
    assert plan.cost.shape == plan.complementarity.shape == plan.status.shape == (6,)
    np.testing.assert_allclose(plan.states[:, 0], states, rtol=1e-9)
    assert (plan.actions >= -40.0 - 1e-6).all() and (plan.actions <= 60.0 + 1e-6).all()
    assert np.abs(plan.actions).max() > 1.0  # far beyond scaled units
    A, B, C, d, *_ = (matrix.detach().numpy() for matrix in policy.lcs.matrices())
    now, action, force = plan.states[:, :-1], plan.actions, plan.contact_forces
    following = now @ A.T + action @ B.T + force @ C.T + d
    np.testing.assert_allclose(plan.states[:, 1:], following, rtol=1e-6, atol=1e-6)
    assert policy.plan(states[0]).actions.shape == (1, 4, 2)


# -- the noise -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, np.log([0.1, 2.0])),
        (dict(log_std_init=-1.5), [-1.5] * 2),
        (dict(action_scale=[1.0, 5.0]), np.log([0.2, 1.0])),
    ],
    ids=["a fifth of half the range", "log_std_init", "a fifth of action_scale"],
)
def test_the_noise_starts_where_it_should(given: dict[str, Any], expected: list[float]) -> None:
    actions = spaces.Box(np.array([-0.5, 0.0], np.float32), np.array([0.5, 20.0], np.float32))
    np.testing.assert_allclose(make_policy(actions=actions, **given).log_std.detach(), expected, rtol=1e-6)


def test_unbounded_actions_have_a_scale_of_one() -> None:
    policy = make_policy(actions=box((2,)))
    np.testing.assert_array_equal(policy.lcs.action_scale, [1.0, 1.0])
    np.testing.assert_allclose(policy.log_std.detach(), np.log([0.2, 0.2]), rtol=1e-6)
    assert np.isfinite(policy.predict(np.ones(2))[0]).all()


def test_the_noise_is_learned() -> None:
    model = small_ppo(several(1), learning_rate=1e-2)
    before = model.policy.log_std.item()
    model.learn(32)
    assert model.policy.log_std.item() != before


# -- every choice trains ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", [PPO, A2C])
@pytest.mark.parametrize("n_contacts", [0, 1, 2])
def test_any_number_of_contacts_trains(algorithm: type, n_contacts: int) -> None:
    size = dict(n_steps=16, batch_size=16, n_epochs=2) if algorithm is PPO else dict(n_steps=16)
    kwargs = dict(n_contacts=n_contacts, horizon=3)
    model = algorithm("MpcLcsPolicy", several(2), policy_kwargs=kwargs, device="cpu", seed=1, **size)
    before = {name: value.detach().clone() for name, value in model.policy.named_parameters()}
    model.learn(64)
    assert finite(model) and policy_of(model).lcs.n_contacts == n_contacts
    assert not torch.equal(policy_of(model).lcs.A_scaled, before["action_net.lcs.A_scaled"])


def test_as_many_contacts_as_are_found_are_room_for_four() -> None:
    model = small_ppo(several(1), n_contacts="auto").learn(64)
    assert finite(model) and policy_of(model).lcs.n_contacts == 4
    assert policy_of(model).plan(np.zeros((3, 2))).contact_forces.shape == (3, 3, 4)


def test_without_walls_in_reach_no_contact_is_in_use() -> None:
    table = Table()
    model = small_ppo(several(1, limit=0.4), n_contacts="auto")
    model.set_logger(Logger(None, [table]))
    model.learn(128)
    assert np.abs(policy_of(model).store.everything().s[:, 0]).max() < 0.5
    assert table.rows[-1]["train/n_contacts"] == 0 and not policy_of(model).lcs.C.any()


@pytest.mark.parametrize("loss", sorted(PREDICTION_LOSSES))
@pytest.mark.parametrize("model_fit", sorted(MODEL_FITS))
@pytest.mark.parametrize("terminal_value", sorted(TERMINAL_VALUES))
@pytest.mark.parametrize("replay", [True, False])
def test_every_combination_of_choices_trains(loss: str, model_fit: str, terminal_value: str, replay: bool) -> None:
    arguments = dict(prediction_loss=loss, model_fit=model_fit, terminal_value=terminal_value, replay=replay)
    model = small_ppo(several(1), **arguments).learn(64)
    assert finite(model)
    assert np.isfinite(model.predict(np.ones((3, 2)))[0]).all()


@pytest.mark.parametrize(
    ("given", "learns_from", "fits"),
    [
        ({}, 64, {"n_contacts", "model_fit_error"}),
        (dict(n_contacts=0), 64, {"model_fit_error"}),
        (dict(model_fit="least_squares"), 64, {"model_fit_error"}),
        (dict(preset="paper"), 32, set()),
        (dict(preset="paper", replay=True), 64, set()),
        (dict(preset="paper", model_fit="least_squares"), 32, {"model_fit_error"}),
    ],
    ids=["default", "default without contacts", "default without their fit", "paper", "paper with replay",
         "paper with the direct fit"],
)  # fmt: skip
def test_a_preset_says_how_the_model_learns_and_arguments_overrule_it(
    given: dict[str, Any], learns_from: int, fits: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes, table = [], Table()

    def loss(lcs: LinearComplementaritySystem, s: torch.Tensor, *rest: torch.Tensor) -> torch.Tensor:
        sizes.append(len(s))
        return prediction_loss(lcs, s, *rest)

    monkeypatch.setitem(PREDICTION_LOSSES, "prediction", loss)
    model = small_ppo(several(1), **given)
    model.set_logger(Logger(None, [table]))
    model.learn(64)
    assert sizes[0] == 32 and sizes[-1] == learns_from
    assert {name for name in ("n_contacts", "model_fit_error") if f"train/{name}" in table.rows[1]} == fits


@pytest.mark.parametrize("solver", ["auto", *sorted(SOLVERS)])
def test_every_solver_trains(solver: str) -> None:
    model = small_ppo(several(1), solver=solver, n_steps=8, batch_size=8, n_epochs=1, horizon=2).learn(16)
    assert finite(model)
    assert policy_of(model).plan(np.zeros(2)).status.tolist() == ["solved"]


@pytest.mark.parametrize(("n_states", "n_actions"), [(1, 1), (5, 3)])
def test_any_box_environment_trains(n_states: int, n_actions: int) -> None:
    assert finite(small_ppo(box_env(n_states, n_actions)).learn(64))


def test_actions_whose_bounds_say_nothing_train_with_a_scale_of_their_own() -> None:
    assert finite(small_ppo(box_env(2, 1, bound=1e30), action_scale=[1.0]).learn(64))


def test_the_defaults_run_on_the_pendulum() -> None:
    model = PPO("MpcLcsPolicy", "Pendulum-v1", n_steps=128, seed=0, device="cpu").learn(300)
    assert finite(model) and len(policy_of(model).store) == 384


@pytest.mark.slow
def test_the_defaults_of_ppo_and_policy_run_on_the_pendulum() -> None:
    model = PPO("MpcLcsPolicy", "Pendulum-v1", device="cpu").learn(300)
    assert finite(model) and len(policy_of(model).store) == 2048


def test_the_same_seed_gives_the_same_bits() -> None:
    first, second, other = (
        fingerprint(small_ppo(several(2), learning_rate=3e-3, seed=seed).learn(128).policy) for seed in (4, 4, 5)
    )
    assert first == second != other


# -- the model and its gradients -------------------------------------------------------------------------------


class Gradients(BaseCallback):
    """At the first update: gradients of the surrogate's part and of the prediction loss, each taken alone."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        policy = policy_of(self.model)
        batch = next(self.model.rollout_buffer.get(32))
        names, parameters = zip(*policy.named_parameters(), strict=True)
        _, log_prob, _ = policy.evaluate_actions(batch.observations, batch.actions)
        both = torch.autograd.grad((batch.advantages * log_prob).sum(), parameters, allow_unused=True)
        alone = torch.autograd.grad(100.0 * policy.prediction_loss(), parameters, allow_unused=True)
        zero = [torch.zeros_like(parameter) for parameter in parameters]
        self.both, self.alone = (
            {n: z if g is None else g for n, g, z in zip(names, some, zero, strict=True)} for some in (both, alone)
        )


@pytest.mark.parametrize("policy_gradient", [True, False])
def test_ppos_gradient_reaches_the_model_only_where_it_may_and_the_prediction_loss_always(
    policy_gradient: bool,
) -> None:
    notes = Gradients()
    model = small_ppo(several(1), policy_gradient=policy_gradient, horizon=5, n_steps=64, batch_size=64)
    model.learn(64)
    model.learn(64, notes, reset_num_timesteps=False)
    model_part = [name for name in notes.both if ".lcs." in name]
    assert len(model_part) == 9 and notes.both["log_std"].abs().max() > 0
    assert notes.alone["action_net.lcs.A_scaled"].abs().max() > 0
    for name in model_part:
        if not policy_gradient:
            torch.testing.assert_close(notes.both[name], notes.alone[name], rtol=1e-9, atol=1e-12)
    difference = notes.both["action_net.lcs.B_scaled"] - notes.alone["action_net.lcs.B_scaled"]
    assert bool(difference.abs().max() > 1e-6) == policy_gradient
    assert all(parameter.requires_grad for parameter in model.policy.parameters())


def test_a_coefficient_of_zero_leaves_the_model_to_ppo_alone() -> None:
    model = small_ppo(several(1), prediction_coef=0.0, policy_gradient=False, model_fit="gradient")
    before = {name: value.clone() for name, value in model.policy.lcs.named_parameters()}
    model.learn(64)
    assert all(torch.equal(value, before[name]) for name, value in model.policy.lcs.named_parameters())


class Models(BaseCallback):
    """The model as each rollout begins."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[dict[str, torch.Tensor]] = []

    def _on_rollout_start(self) -> None:
        lcs = policy_of(self.model).lcs
        self.seen.append({name: value.detach().clone() for name, value in lcs.named_parameters()})

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("fit_updates", [0, 2])
def test_after_so_many_updates_the_model_is_fitted_no_more(fit_updates: int) -> None:
    models = Models()
    nothing_else = dict(prediction_coef=0.0, policy_gradient=False)
    small_ppo(several(1), fit_updates=fit_updates, **nothing_else).learn(5 * 32, models)
    same = [all(torch.equal(one[name], two[name]) for name in one) for one, two in itertools.pairwise(models.seen)]
    assert same == [number >= fit_updates for number in range(4)]


def test_the_fits_made_before_saving_count_after_loading(tmp_path: Path) -> None:
    nothing_else = dict(prediction_coef=0.0, policy_gradient=False)
    small_ppo(several(1), fit_updates=2, **nothing_else).learn(2 * 32).save(tmp_path / "model")
    models = Models()
    PPO.load(tmp_path / "model", several(1)).learn(3 * 32, models)
    assert all(torch.equal(value, models.seen[-1][name]) for name, value in models.seen[0].items())


@pytest.mark.parametrize("model_fit", sorted(MODEL_FITS))
def test_training_makes_predictions_better(model_fit: str) -> None:
    env = several(1, limit=0.4)
    arguments = dict(model_fit=model_fit, learning_rate=1e-2, max_grad_norm=100.0, n_epochs=10)
    model = small_ppo(env, **arguments)
    start = copy.deepcopy(policy_of(model).lcs)
    model.learn(128)
    s, a, _, s_next = (torch.as_tensor(part) for part in policy_of(model).store.everything())
    after, before = (
        prediction_loss(lcs, s, a, s_next, (s_next - s).std(dim=0)) for lcs in (policy_of(model).lcs, start)
    )
    assert after < (0.5 if model_fit == "gradient" else 0.02) * before
    if model_fit != "gradient":  # between the walls the system is linear
        np.testing.assert_allclose(policy_of(model).lcs.A.detach(), [[1.0, 0.1], [0.1, 1.0]], atol=1e-3)
        np.testing.assert_allclose(policy_of(model).lcs.B.detach(), [[0.0], [0.4]], atol=1e-3)


def test_the_critic_that_serves_as_terminal_value_is_a_concave_quadratic_and_is_trained() -> None:
    model = small_ppo(several(1), terminal_value="critic", learning_rate=1e-2)
    critic = model.policy.value_net
    assert isinstance(critic, QuadraticCritic)
    before = [parameter.detach().clone() for parameter in critic.parameters()]
    model.learn(96)
    assert all(not torch.equal(old, new) for old, new in zip(before, critic.parameters(), strict=True))
    one, two = torch.randn(2, 50, 2)
    middle = (critic(one) + critic(two)) / 2
    assert (critic((one + two) / 2) >= middle - 1e-4).all()
    # the controller's terminal cost is minus the critic, up to a constant
    policy = policy_of(model)
    x = (one.double() / policy.lcs.state_scale).numpy()
    P, p = policy.mpc.terminal_weight.numpy(), policy.mpc.terminal_slope.numpy()
    cost = np.einsum("ni,ij,nj->n", x, P, x) + x @ p
    values = critic(one).detach().numpy()[:, 0]
    np.testing.assert_allclose(cost - cost[0], values[0] - values, rtol=1e-3, atol=1e-3)


# -- the reward ------------------------------------------------------------------------------------------------


def test_the_learned_reward_recovers_the_weights_of_the_cart_pole() -> None:
    model = small_ppo(gym.make(CART_POLE), n_steps=128, batch_size=128, n_epochs=1, log_std_init=-1.0).learn(128)
    mpc = policy_of(model).mpc
    np.testing.assert_allclose(mpc.cost_weight, np.diag([20.0, 20.0, 0.1, 0.1, 10.0]), atol=0.02)
    np.testing.assert_allclose(mpc.cost_slope, np.zeros(5), atol=0.02)


def test_a_reward_may_be_given_as_its_arguments() -> None:
    arguments: dict[str, Any] = dict(state_weight=[1.0, 2.0], action_weight=3.0, target=[0.5, 0.0])
    one, two = make_policy(reward=arguments), make_policy(reward=QuadraticReward(**arguments))
    np.testing.assert_array_equal(one.mpc.cost_weight, two.mpc.cost_weight)
    np.testing.assert_array_equal(one.mpc.cost_weight, np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(one.mpc.target(), [0.5, 0.0])


def test_a_given_reward_is_not_changed_by_training() -> None:
    model = small_ppo(several(1), reward=dict(state_weight=[1.0, 2.0], action_weight=3.0)).learn(64)
    np.testing.assert_array_equal(policy_of(model).mpc.cost_weight, np.diag([1.0, 2.0, 3.0]))


def test_a_flat_reward_warns_once_in_a_run_and_says_what_to_do() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = small_ppo(several(1, flat_reward=True)).learn(128)
    messages = [str(warning.message) for warning in caught if "flat" in str(warning.message)]
    assert len(messages) == 1 and "reward=QuadraticReward(" in messages[0]
    assert finite(model)


# -- scales and the first model --------------------------------------------------------------------------------


def test_a_given_scale_is_kept() -> None:
    model = small_ppo(several(1), state_scale=[2.0, 3.0], action_scale=[4.0]).learn(64)
    np.testing.assert_array_equal(policy_of(model).lcs.state_scale, [2.0, 3.0])
    np.testing.assert_array_equal(policy_of(model).lcs.action_scale, [4.0])


def test_the_scale_is_the_spread_of_the_first_rollout_and_stays() -> None:
    model = small_ppo(several(1)).learn(32)
    expected = policy_of(model).store.everything().s.std(axis=0)
    model.learn(64, reset_num_timesteps=False)
    np.testing.assert_array_equal(policy_of(model).lcs.state_scale, expected)


class ModelAfterUpdate(BaseCallback):
    """Notes the model, environment units, when the update on the first rollout has just ended."""

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        policy, original = policy_of(self.model), policy_of(self.model).end_update

        def end_update(reward_scale: float = 1.0) -> dict[str, float]:
            self.before = [matrix.detach().clone() for matrix in policy.lcs.matrices()]
            return original(reward_scale)

        policy.end_update = end_update  # type: ignore[method-assign]


def test_freezing_the_scale_does_not_change_what_the_first_update_learned() -> None:
    notes = ModelAfterUpdate()
    model = small_ppo(several(1), model_fit="gradient", learning_rate=1e-2).learn(32, notes)
    for old, new in zip(notes.before, policy_of(model).lcs.matrices(), strict=True):
        assert torch.equal(old, new)
    assert not (policy_of(model).lcs.state_scale == 1.0).any()


def test_a_rollout_of_a_single_state_leaves_the_scale_to_later_ones() -> None:
    model = A2C("MpcLcsPolicy", several(1), n_steps=1, policy_kwargs=dict(horizon=2), device="cpu", seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nor is its one reward called flat
        model.learn(4)
    expected = policy_of(model).store.everything().s[:2].std(axis=0)
    np.testing.assert_allclose(policy_of(model).lcs.state_scale, np.maximum(expected, 1e-3 * expected.max()))
    assert finite(model)


def test_the_first_model_is_copied_and_not_changed() -> None:
    rng = np.random.default_rng(0)
    given = LinearComplementaritySystem(2, 1, 3, [0.5, 0.7], [0.4])
    with torch.no_grad():
        given.B_scaled.copy_(torch.as_tensor(rng.normal(size=(2, 1))))
    before = fingerprint(given)
    model = small_ppo(several(1), initial_lcs=given)
    assert fingerprint(policy_of(model).lcs) == before
    model.learn(64)
    assert fingerprint(given) == before != fingerprint(policy_of(model).lcs)
    assert policy_of(model).lcs.n_contacts == 3
    np.testing.assert_array_equal(policy_of(model).lcs.state_scale, [0.5, 0.7])


def test_a_learned_model_may_be_the_first_of_another_run() -> None:
    learned = policy_of(small_ppo(several(1, limit=0.4)).learn(64)).lcs
    assert finite(small_ppo(several(1), initial_lcs=learned).learn(64))


@pytest.mark.parametrize("fit", ["fit_tangent", "fit_contacts"])
def test_the_direct_fits_keep_to_the_first_model_where_there_is_one(fit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    priors = []
    monkeypatch.setattr(f"sb3_mpc_policy.policies.{fit}", lambda lcs, data, target, prior: priors.append(prior) or 0)
    given = LinearComplementaritySystem(2, 1, 1, [0.5, 0.7], [0.4])
    small_ppo(several(1), initial_lcs=given).learn(32)
    assert priors and all(fingerprint(prior) == fingerprint(given) for prior in priors)
    priors.clear()
    small_ppo(several(1)).learn(32)
    assert priors and set(priors) == {None}


# -- what is logged --------------------------------------------------------------------------------------------


class Table(KVWriter):
    """Keeps what a logger writes."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
        self.rows.append(dict(key_values))


def test_the_logger_shows_the_model_and_the_controller() -> None:
    table = Table()
    model = small_ppo(several(1))
    model.set_logger(Logger(None, [table]))
    model.learn(96)
    names = ("solve_time_ms", "failed_share", "complementarity", "contact_share")
    expected = {"train/prediction_loss", "train/reward_loss", *(f"mpc/{name}" for name in names)}
    assert expected <= set(table.rows[1]) and expected <= set(table.rows[2])
    row = table.rows[2]
    assert all(np.isfinite(row[name]) for name in expected)
    assert row["mpc/solve_time_ms"] > 0 and row["mpc/failed_share"] == 0
    assert 0 <= row["mpc/contact_share"] <= 1 and row["train/prediction_loss"] > 0
    assert row["train/reward_loss"] < 1e-6  # the reward of the point mass is a quadratic


# -- solves that fail ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_solves_that_fail_are_counted_and_replaced_and_harm_no_parameter(
    share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    table, rng = Table(), np.random.default_rng(0)
    model = small_ppo(several(2))
    model.set_logger(Logger(None, [table]))
    solver = policy_of(model).mpc.solver
    original = type(solver).solve

    def solve(self: Any, *args: Any) -> Solution:
        solution = original(self, *args)
        failed = rng.random(len(solution.solved)) < share
        solution.solved[failed] = False
        for part in (solution.actions, solution.states, solution.forces, solution.gaps, solution.multipliers):
            part[failed] = np.nan
        return solution

    monkeypatch.setattr(type(solver), "solve", solve)
    model.learn(192)
    assert finite(model)
    assert np.isfinite(policy_of(model).store.rows()).all()
    assert table.rows[1]["mpc/failed_share"] == pytest.approx(share, abs=0.12)
    plan = policy_of(model).plan(np.zeros((50, 2)))
    assert np.mean(plan.status == "fallback") == pytest.approx(share, abs=0.25)
    assert np.isfinite(plan.actions).all() and np.isfinite(plan.states).all()


# -- errors ----------------------------------------------------------------------------------------------------


OBSERVATIONS = {
    "Dict": spaces.Dict({"x": box((2,))}),
    "image": spaces.Box(0, 255, (36, 36, 3), np.uint8),
    "Discrete": spaces.Discrete(3),
    "2-D": box((2, 2)),
    "integers": spaces.Box(-5, 5, (2,), np.int64),
}
ACTIONS = {
    "Discrete": spaces.Discrete(3),
    "MultiDiscrete": spaces.MultiDiscrete([2, 2]),
    "MultiBinary": spaces.MultiBinary(2),
    "2-D": box((2, 2), 1.0),
}


@pytest.mark.parametrize("name", sorted(OBSERVATIONS))
def test_observations_that_are_no_vector_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"observation_space must be a one-dimensional Box of floats.*got"):
        make_policy(OBSERVATIONS[name])


@pytest.mark.parametrize("name", sorted(ACTIONS))
def test_actions_that_are_no_vector_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"action_space must be a one-dimensional Box of floats.*got"):
        make_policy(actions=ACTIONS[name])


def test_ppo_passes_the_refusal_on() -> None:
    with pytest.raises(ValueError, match=r"action_space must be a one-dimensional Box.*got Discrete\(2\)"):
        PPO("MpcLcsPolicy", "CartPole-v1", device="cpu")


KNOWN = LinearComplementaritySystem(2, 1)
REFUSED: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "use_sde": (dict(use_sde=True), ValueError, r"use_sde must be False.*got True"),
    "extractor": (
        dict(features_extractor_class=NatureCNN),
        ValueError,
        r"features_extractor_class must be Flatten.*NatureCNN",
    ),
    "pi layers": (
        dict(net_arch=dict(pi=[8], vf=[8])),
        ValueError,
        r"net_arch must not have layers for pi.*'pi': \[8\]",
    ),
    "critic layers": (dict(net_arch=[8], terminal_value="critic"), ValueError, r"net_arch must be None.*got \[8\]"),
    "horizon": (dict(horizon=0), ValueError, r"horizon must be an integer >= 1, got 0"),
    "part of a step": (dict(horizon=2.5), ValueError, r"horizon must be an integer >= 1, got 2.5"),
    "n_contacts": (dict(n_contacts=-1), ValueError, r"n_contacts must be an integer >= 0, got -1"),
    "n_iterations": (dict(n_iterations=0), ValueError, r"n_iterations must be an integer >= 1, got 0"),
    "penalty": (dict(penalty=0.0), ValueError, r"penalty must be a finite number > 0, got 0.0"),
    "smoothing": (dict(smoothing=-1.0), ValueError, r"smoothing must be a finite number >= 0, got -1.0"),
    "fits": (dict(fit_updates=-1), ValueError, r"fit_updates must be an integer >= 0 or None, got -1"),
    "coefficient": (dict(prediction_coef=-1.0), ValueError, r"prediction_coef must be a finite number >= 0, got -1"),
    "nan coefficient": (dict(prediction_coef=np.nan), ValueError, r"prediction_coef must be a finite .*got nan"),
    "solver": (
        dict(solver="none"),
        ValueError,
        r"solver must be 'auto' or one of \['cvxpylayers', .*got 'none'",
    ),
    "terminal_value": (dict(terminal_value="x"), ValueError, r"terminal_value must be one of \['critic', .*got 'x'"),
    "loss": (
        dict(prediction_loss="x"),
        ValueError,
        r"prediction_loss must be one of \['prediction', 'violation'\], got 'x'",
    ),
    "fit": (
        dict(model_fit="x"),
        ValueError,
        r"model_fit must be one of \['contacts', 'gradient', 'least_squares'\], got 'x'",
    ),
    "contacts in words": (
        dict(n_contacts="some"),
        ValueError,
        r"n_contacts must be an integer >= 0, or 'auto'.*'some'",
    ),
    "contacts to be found by the gradient": (
        dict(n_contacts="auto", model_fit="gradient"),
        ValueError,
        r"n_contacts must be.*'auto' with model_fit='contacts'; got 'auto' with model_fit='gradient'",
    ),
    "target_noise": (dict(target_noise=-1.0), ValueError, r"target_noise must be a finite number >= 0, got -1.0"),
    "preset": (dict(preset="x"), ValueError, r"preset must be one of \['default', 'paper'\], got 'x'"),
    "state_scale": (dict(state_scale=[1.0]), ValueError, r"state_scale must be 2 finite positive numbers, got \[1.0\]"),
    "action_scale": (
        dict(action_scale=[0.0]),
        ValueError,
        r"action_scale must be 1 finite positive numbers, got \[0.0\]",
    ),
    "no reward": (dict(reward=3.0), TypeError, r"reward must be a QuadraticReward, a dict.* got 3.0"),
    "negative": (
        dict(reward=dict(state_weight=[1, -1], action_weight=1)),
        ValueError,
        r"state_weight must not be negative",
    ),
    "short": (
        dict(reward=dict(state_weight=[1], action_weight=1)),
        ValueError,
        r"state_weight must be for 2 states.*\(1,\)",
    ),
    "actions": (
        dict(reward=dict(state_weight=[1, 1], action_weight=[1, 1])),
        ValueError,
        r"action_weight must be for 1 act",
    ),
    "indefinite": (
        dict(reward=dict(state_weight=[[1, 2], [2, 1]], action_weight=1)),
        ValueError,
        r"state_weight must be positive semidefinite, got an eigenvalue of -1",
    ),
    "model of another size": (
        dict(initial_lcs=LinearComplementaritySystem(3, 2)),
        ValueError,
        r"initial_lcs must have 2 states and 1 actions, got 3 and 2",
    ),
    "no model": (dict(initial_lcs="model.zip"), TypeError, r"initial_lcs must be a LinearCompl.*got 'model.zip'"),
    "two scales": (
        dict(initial_lcs=KNOWN, state_scale=[1, 1]),
        ValueError,
        r"state_scale must be None with initial_lcs.*got \[1, 1\]",
    ),
    "unknown": (dict(no_such_argument=1), TypeError, r"no_such_argument"),
}


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_an_argument_that_makes_no_sense_is_named(name: str) -> None:
    arguments, error, message = REFUSED[name]
    with pytest.raises(error, match=message):
        make_policy(**arguments)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_observation_that_is_not_finite_is_refused(trained: PPO, value: float) -> None:
    for call in (trained.predict, policy_of(trained).plan):
        with pytest.raises(ValueError, match=r"observations must be finite, got"):
            call(np.array([[0.0, 0.0], [0.0, value]]))


def test_an_observation_of_another_size_is_refused(trained: PPO) -> None:
    with pytest.raises(ValueError, match=r"states must have shape \(N, 2\), got \(4, 3\)"):
        policy_of(trained).plan(np.zeros((4, 3)))


def test_an_environment_that_resets_to_nan_is_refused() -> None:
    class Broken(PointMass):
        def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
            super().reset(**kwargs)
            return np.array([np.nan, 0.0]), {}

    model = small_ppo(Broken())
    with pytest.raises(ValueError, match="observations must be finite"):
        model.learn(32)
    assert finite(model)


def test_the_policy_outside_a_run_says_what_it_lacks() -> None:
    policy = make_policy()
    with pytest.raises(RuntimeError, match=r"no transitions.*PredictionLossCallback"):
        policy.evaluate_actions(torch.zeros(3, 2), torch.zeros(3, 1))
    with torch.no_grad():
        values, log_prob, _ = policy.evaluate_actions(torch.zeros(3, 2), torch.zeros(3, 1))
    assert values.shape == (3, 1) and log_prob.shape == (3,)


def test_a_gym_environment_is_wrapped_as_usual() -> None:
    assert finite(small_ppo(point_mass()).learn(32))
