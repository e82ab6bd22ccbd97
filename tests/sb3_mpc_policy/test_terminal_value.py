"""The value beyond the horizon: the regulator's, the critic's, or none."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sb3_mpc_policy.lqr import AffineLqr
from sb3_mpc_policy.terminal_value import TERMINAL_VALUES, CriticValue, NoValue, QuadraticCritic, RiccatiValue

LQR = AffineLqr(np.diag([2.0, 3.0]), np.array([0.5, -1.0]), np.zeros((1, 2)), np.zeros(1), "riccati")
SCALE = torch.tensor([0.1, 20.0], dtype=torch.float64)


@pytest.fixture
def critic() -> QuadraticCritic:
    """Away from its initial values; V is far from symmetric."""
    critic = QuadraticCritic(SCALE)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in critic.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return critic


def test_the_choices_are_named():
    assert {"riccati": RiccatiValue, "critic": CriticValue, "none": NoValue} == TERMINAL_VALUES
    assert [name for name, value in TERMINAL_VALUES.items() if value.needs_quadratic_critic] == ["critic"]


def test_riccati_is_the_regulators_cost_to_go(critic):
    for given in (critic, None):
        P, p = RiccatiValue().quadratic(LQR, given, 7.0)
        np.testing.assert_array_equal(P, LQR.P)
        np.testing.assert_array_equal(p, LQR.p)


def test_none_is_nothing(critic):
    P, p = NoValue().quadratic(LQR, critic, 7.0)
    assert P.shape == (2, 2)
    assert p.shape == (2,)
    assert not P.any()
    assert not p.any()


@pytest.mark.parametrize("reward_scale", [1.0, 50.0])
def test_the_critics_value_is_what_the_controller_gets(critic, reward_scale):
    """-V(s) of the forward pass, up to its constant, undoing the scale of the rewards that it saw."""
    P, p = CriticValue().quadratic(LQR, critic, reward_scale)
    assert P.dtype == p.dtype == np.float64
    s = SCALE * torch.randn(40, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    value = critic(s.float()).detach().double().numpy()
    assert value.shape == (40, 1)
    x = (s / SCALE).numpy()
    cost = np.einsum("ni,ij,nj->n", x, P, x) + x @ p
    expected = -reward_scale * (value[:, 0] - critic.constant.item())
    np.testing.assert_allclose(cost, expected, rtol=1e-4, atol=1e-4 * reward_scale)


def test_the_critic_is_concave_whatever_its_parameters(critic):
    P, _ = CriticValue().quadratic(LQR, critic, 1.0)
    np.testing.assert_allclose(P, P.T)
    assert np.linalg.eigvalsh(P).min() >= -1e-12
    with torch.no_grad():
        one, other = torch.randn(2, 100, 2, generator=torch.Generator().manual_seed(3)) * SCALE.float()
        middle = critic((one + other) / 2)
        assert (middle >= (critic(one) + critic(other)) / 2 - 1e-4).all()


def test_the_critic_can_learn_any_concave_quadratic(critic):
    """Its three parameters all have gradients, and they vanish where it fits."""
    s = torch.randn(200, 2, generator=torch.Generator().manual_seed(2)) * SCALE.float()
    x = s / SCALE.float()
    target = 3.0 + x @ torch.tensor([1.0, -2.0]) - (x[:, 0] + 0.5 * x[:, 1]) ** 2 - x[:, 1] ** 2
    optimiser = torch.optim.LBFGS(critic.parameters(), max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        value = (critic(s)[:, 0] - target).square().mean()
        value.backward()
        return value

    optimiser.step(loss)
    assert loss() < 1e-6


def test_a_critic_value_without_critic_says_what_to_choose():
    with pytest.raises(ValueError, match=r"terminal_value='critic' needs a critic.*'riccati' or 'none'"):
        CriticValue().quadratic(LQR, None, 1.0)
