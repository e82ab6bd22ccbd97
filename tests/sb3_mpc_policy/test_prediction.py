"""The prediction losses, eq (12), their gradients, and how they join PPO's own loss, eq (15) and (16)."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed

from sb3_mpc_policy import LinearComplementaritySystem, MpcLcsPolicy, PredictionLossCallback
from sb3_mpc_policy.prediction import (
    PREDICTION_LOSSES,
    add_to_backward,
    prediction_loss,
    step_deviation,
    violation_loss,
)
from tests.sb3_mpc_policy.toy_environments import policy_of, several, small_ppo

BOTH = pytest.mark.parametrize("loss_name", sorted(PREDICTION_LOSSES))
CONTACTS = pytest.mark.parametrize("n_contacts", [0, 1, 2, 4])

Data = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def make_model(
    n_contacts: int, offset: float, n_x: int = 3, n_a: int = 2, seed: int = 0
) -> LinearComplementaritySystem:
    """A random model with every parameter away from zero; ``offset`` opens (> 0) or closes (< 0) all gaps."""
    rng = np.random.default_rng(seed)
    lcs = LinearComplementaritySystem(n_x, n_a, n_contacts, rng.uniform(0.5, 2.0, n_x), rng.uniform(0.5, 2.0, n_a))
    with torch.no_grad():
        for name, parameter in lcs.named_parameters():
            size = 0.1 if name.startswith("F_") else 0.2
            parameter.copy_(size * torch.as_tensor(rng.normal(size=tuple(parameter.shape))))
            if name in ("A_scaled", "F_factor"):
                parameter.add_(torch.eye(len(parameter)))
        lcs.c_scaled.add_(offset)
    return lcs


def make_data(lcs: LinearComplementaritySystem, n: int = 7, seed: int = 1) -> Data:
    rng = np.random.default_rng(seed)
    s, a = 0.3 * rng.normal(size=(n, lcs.n_states)), 0.3 * rng.normal(size=(n, lcs.n_actions))
    s_next = s + 0.5 * rng.normal(size=s.shape)
    return tuple(torch.as_tensor(part) for part in (s, a, s_next, rng.uniform(0.5, 2.0, lcs.n_states)))  # type: ignore[return-value]


# -- the gradient of each loss ---------------------------------------------------------------------------------


@BOTH
@CONTACTS
@pytest.mark.parametrize("mode", ["active", "inactive", "some"])
def test_the_gradient_is_that_of_central_differences(
    loss_name: str, n_contacts: int, mode: str, parameter_gradients: Callable[..., dict[str, np.ndarray]]
) -> None:
    lcs = make_model(n_contacts, {"active": -3.0, "inactive": 3.0, "some": 0.0}[mode])
    data = make_data(lcs)
    forces = lcs.contact_force(*data[:2])
    if n_contacts:
        assert bool((forces > 1e-3).all()) == (mode == "active")
        assert bool((forces == 0.0).all()) == (mode == "inactive")
    # gamma of the violation loss is a constant: its bound, for an F this large
    assert not n_contacts or torch.linalg.eigvalsh(lcs.F_scaled + lcs.F_scaled.mT)[0] > 1.0

    loss = PREDICTION_LOSSES[loss_name]
    loss(lcs, *data).backward()
    expected = parameter_gradients(lcs, lambda: loss(lcs, *data).item())
    assert len(expected) == 9
    for name, parameter in lcs.named_parameters():
        found = np.zeros(tuple(parameter.shape)) if parameter.grad is None else parameter.grad.numpy()
        size = np.linalg.norm(expected[name])
        assert np.linalg.norm(found - expected[name]) <= 1e-4 * size + 1e-7, name


def test_only_the_violation_loss_moves_a_contact_that_is_not_active() -> None:
    lcs = make_model(n_contacts=2, offset=0.5)
    s, a, _, deviation = make_data(lcs)
    assert (lcs.contact_force(s, a) == 0.0).all()
    # a blow that the contacts' forces would explain, had they touched
    blow = (lcs.C @ torch.full((2,), 4.0, dtype=torch.float64)).detach()
    data = s, a, lcs.step(s, a).detach() + blow, 0.1 * deviation
    for loss, expected in ((prediction_loss, False), (violation_loss, True)):
        lcs.zero_grad()
        loss(lcs, *data).backward()
        for parameter in (lcs.D_scaled, lcs.c_scaled):
            assert parameter.grad is not None
            assert bool(parameter.grad.abs().max() > 1e-3) == expected


# -- the value of each loss ------------------------------------------------------------------------------------


@CONTACTS
def test_the_prediction_loss_is_the_mean_whitened_squared_error(n_contacts: int) -> None:
    lcs = make_model(n_contacts, 0.0)
    s, a, s_next, deviation = make_data(lcs)
    errors = [(((lcs.step(s[i], a[i]) - s_next[i]) / deviation) ** 2).sum().item() for i in range(len(s))]
    assert prediction_loss(lcs, s, a, s_next, deviation).item() == pytest.approx(np.mean(errors), rel=1e-12)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n_contacts", [1, 2, 4])
@pytest.mark.parametrize("surprise", [1.0, 30.0], ids=["small errors", "large errors"])
def test_the_violation_loss_is_the_least_that_any_forces_and_gaps_reach(
    n_contacts: int, seed: int, surprise: float
) -> None:
    lcs = make_model(n_contacts, 0.0, seed=seed)
    s, a, s_next, deviation = make_data(lcs, n=6, seed=seed)
    deviation = deviation / surprise
    A, B, C, d, D, E, F, c = (matrix.detach().numpy() for matrix in lcs.matrices())
    gamma, epsilon = 0.5 * min(1.0, np.linalg.eigvalsh(F + F.T)[0]), 1e-2
    least, products = [], []
    for s_i, a_i, following in zip(s.numpy(), a.numpy(), s_next.numpy(), strict=True):

        def objective(z: np.ndarray, s_i=s_i, a_i=a_i, following=following) -> tuple[float, np.ndarray]:
            lam, phi = np.split(z, 2)
            error = (A @ s_i + B @ a_i + C @ lam + d - following) / deviation.numpy()
            mismatch = D @ s_i + E @ a_i + F @ lam + c - phi
            value = error @ error + (lam @ phi + mismatch @ mismatch / (2 * gamma)) / epsilon
            slope_lam = 2 * (C / deviation.numpy()[:, None]).T @ error + (phi + F.T @ mismatch / gamma) / epsilon
            return value, np.concatenate([slope_lam, (lam - mismatch / gamma) / epsilon])

        options = dict(maxiter=10_000, maxfun=100_000, ftol=1e-16, gtol=1e-10)
        bounds = [(0.0, None)] * (2 * n_contacts)
        found = minimize(objective, np.ones(2 * n_contacts), jac=True, bounds=bounds, options=options)
        least.append(found.fun)
        products.append(np.prod(np.split(found.x, 2), axis=0).max())
    if surprise > 1.0:
        assert max(products) > 1e-3, "no error is worth a force at a distance"
    assert violation_loss(lcs, s, a, s_next, deviation).item() == pytest.approx(np.mean(least), rel=1e-6)


@BOTH
def test_no_unit_outweighs_another(loss_name: str) -> None:
    lcs = make_model(2, 0.0)
    s, a, s_next, deviation = make_data(lcs)
    unit = torch.tensor([1e3, 1e-2, 1.0], dtype=torch.float64)  # millimetres for metres, and so on
    A, B, C, d, D, E, F, c = (matrix.detach() for matrix in lcs.matrices())
    inverse = 1 / unit
    matrices = (unit[:, None] * A * inverse, unit[:, None] * B, unit[:, None] * C, unit * d, D * inverse, E, F, c)
    arrays = [matrix.numpy() for matrix in matrices]
    scale, action_scale = lcs.state_scale.numpy(), lcs.action_scale.numpy()
    other = LinearComplementaritySystem.from_matrices(*arrays, scale * unit.numpy(), action_scale)
    same = LinearComplementaritySystem.from_matrices(
        *(matrix.detach().numpy() for matrix in lcs.matrices()), scale, action_scale
    )
    loss = PREDICTION_LOSSES[loss_name]
    in_other_units = loss(other, s * unit, a, s_next * unit, deviation * unit).item()
    assert in_other_units == pytest.approx(loss(same, s, a, s_next, deviation).item(), rel=1e-9)


def test_whitening_divides_by_the_deviation_of_a_step_and_leaves_what_never_moves() -> None:
    s = np.array([[0.0, 5.0, 1.0], [1.0, 5.0, 2.0], [3.0, 5.0, 3.0]])
    s_next = s + np.array([[1.0, 0.0, 0.5], [2.0, 0.0, 0.5], [6.0, 0.0, 0.5]])
    np.testing.assert_allclose(step_deviation(s, s_next), [np.std([1.0, 2.0, 6.0]), 1.0, 1.0])


# -- how it joins the outer loss -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "outer",
    [
        lambda log_prob: log_prob.sum(),
        lambda log_prob: 0.01 * log_prob.mean(),
        lambda log_prob: -torch.min(2.0 * log_prob.exp(), 2.0 * log_prob.exp().clamp(0.8, 1.2)).mean(),
        lambda log_prob: 0.0 * log_prob.sum(),
    ],
    ids=["sum", "mean", "clipped ratio", "no weight"],
)
def test_add_to_backward_changes_no_value_and_adds_the_gradient_of_the_loss(
    outer: Callable[[torch.Tensor], torch.Tensor],
) -> None:
    x = torch.linspace(-1.0, 1.0, 6, requires_grad=True)
    model = torch.tensor([0.3, -0.7], dtype=torch.float64, requires_grad=True)

    def log_prob() -> torch.Tensor:
        return torch.sin(3.0 * x) * model.float().sum()

    def loss() -> torch.Tensor:
        return (model**3).sum() + 7.0 * model[0] * model[1]

    outer(log_prob()).backward()
    assert x.grad is not None and model.grad is not None
    grad_x, grad_model = x.grad.clone(), model.grad.clone()
    (grad_loss,) = torch.autograd.grad(loss(), model)

    x.grad = model.grad = None
    injected = add_to_backward(log_prob(), loss())
    assert torch.equal(injected, log_prob())
    outer(injected).backward()
    assert torch.equal(x.grad, grad_x)
    torch.testing.assert_close(model.grad, grad_model + grad_loss, rtol=1e-12, atol=1e-12)


def train_by_hand(model: PPO, policy: MpcLcsPolicy, transitions: np.ndarray, coefficient: float) -> None:
    """PPO's loss plus ``coefficient`` times the prediction loss, written out (eq 15 and 16)."""
    loss_of = PREDICTION_LOSSES[model.policy_kwargs["prediction_loss"]]
    s, a, _, s_next = np.split(transitions, [2, 3, 4], axis=1)
    data = [torch.as_tensor(part) for part in (s, a, s_next, (s_next - s).std(axis=0))]
    progress = model._current_progress_remaining
    clip = model.clip_range(progress)
    for group in policy.optimizer.param_groups:
        group["lr"] = model.lr_schedule(progress)
    for _ in range(model.n_epochs):
        for batch in model.rollout_buffer.get(model.batch_size):
            distribution = policy.get_distribution(batch.observations)
            log_prob, entropy = distribution.log_prob(batch.actions), distribution.entropy()
            values = policy.predict_values(batch.observations).flatten()
            advantages = batch.advantages
            if model.normalize_advantage:
                advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
            ratio = torch.exp(log_prob - batch.old_log_prob)
            surrogate = -torch.min(advantages * ratio, advantages * ratio.clamp(1 - clip, 1 + clip)).mean()
            if model.clip_range_vf is not None:
                most = model.clip_range_vf(progress)
                values = batch.old_values + (values - batch.old_values).clamp(-most, most)
            value_loss = torch.nn.functional.mse_loss(batch.returns, values)
            loss = surrogate + model.ent_coef * -entropy.mean() + model.vf_coef * value_loss
            total = loss + coefficient * loss_of(policy.lcs, *data)
            policy.optimizer.zero_grad()
            total.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), model.max_grad_norm)
            policy.optimizer.step()


@BOTH
@pytest.mark.parametrize(
    "settings",
    [
        dict(normalize_advantage=True),
        dict(normalize_advantage=False, ent_coef=0.02, vf_coef=0.9, clip_range_vf=0.1, max_grad_norm=100.0),
    ],
    ids=["defaults", "every coefficient"],
)
def test_stock_train_takes_the_very_step_of_the_joint_loss(loss_name: str, settings: dict) -> None:
    env = several(2, limit=0.4)
    model = small_ppo(env, prediction_loss=loss_name, prediction_coef=30.0, learning_rate=3e-3, **settings)
    model.learn(64)  # a first update, so that the optimiser has moments
    hook = PredictionLossCallback()
    _, callback = model._setup_learn(64, hook, reset_num_timesteps=False)
    callback.on_training_start({}, {})
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)

    policy = policy_of(model)
    before, by_hand, without = (copy.deepcopy(policy) for _ in range(3))
    transitions = policy.store.rows()
    set_random_seed(5)
    model.train()
    set_random_seed(5)
    train_by_hand(model, by_hand, transitions, 30.0)
    set_random_seed(5)
    train_by_hand(model, without, transitions, 0.0)

    expected, start, other = (dict(module.named_parameters()) for module in (by_hand, before, without))
    for name, parameter in policy.named_parameters():
        assert torch.equal(parameter, expected[name]), name
        assert not torch.equal(parameter, start[name]), name
    assert not torch.equal(policy.lcs.A_scaled, other["action_net.lcs.A_scaled"])
