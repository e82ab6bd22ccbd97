"""A rollout in NumPy is the model stepped again and again, under given actions and under a clipped feedback."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.simulation import LcsRollout, LcsSimulator, LinearFeedback

FEEDBACK = LinearFeedback(np.array([[1.0, -2.0, 0.5]]), np.array([0.1]), np.array([-0.3]), np.array([0.5]))


def arrays(lcs) -> LcsMatrices[np.ndarray]:
    return LcsMatrices(*(matrix.detach().numpy() for matrix in lcs.matrices()))


def assert_follows(rollout: LcsRollout, lcs, s0: np.ndarray) -> None:
    """Every state, force and gap is what the model itself says of the state before and the action."""
    D, E, F, c = (matrix.detach() for matrix in (lcs.D, lcs.E, lcs.F, lcs.c))
    np.testing.assert_array_equal(rollout.states[:, 0], s0)
    for k in range(rollout.actions.shape[1]):
        s, a = torch.as_tensor(rollout.states[:, k]), torch.as_tensor(rollout.actions[:, k])
        force = lcs.contact_force(s, a).detach()
        np.testing.assert_allclose(rollout.states[:, k + 1], lcs.step(s, a).detach(), rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(rollout.forces[:, k], force, rtol=1e-7, atol=1e-9)
        gap = s @ D.mT + a @ E.mT + force @ F.mT + c
        np.testing.assert_allclose(rollout.gaps[:, k], gap, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("n_contacts", [0, 1, 3, 6])
def test_given_actions_are_taken_step_by_step(random_model, n_contacts):
    lcs = random_model(7, 3, 2, n_contacts)
    rng = np.random.default_rng(0)
    s0, actions = rng.normal(size=(20, 3)), rng.normal(size=(20, 4, 2))
    rollout = LcsSimulator(arrays(lcs)).under(s0, actions)
    np.testing.assert_array_equal(rollout.actions, actions)
    assert_follows(rollout, lcs, s0)
    if n_contacts:
        assert (rollout.forces > 0).any()
        assert not (rollout.forces > 0).all()


def test_a_feedback_acts_on_every_state_and_is_clipped(random_model):
    lcs = random_model(7)
    s0 = np.random.default_rng(0).normal(size=(40, 3))
    rollout = LcsSimulator(arrays(lcs), FEEDBACK).regulated(s0, 5)
    expected = np.clip(rollout.states[:, :-1] @ FEEDBACK.gain.T + FEEDBACK.offset, FEEDBACK.low, FEEDBACK.high)
    np.testing.assert_allclose(rollout.actions, expected, rtol=0, atol=1e-12)
    assert_follows(rollout, lcs, s0)
    assert rollout.actions.min() == -0.3
    assert rollout.actions.max() == 0.5
    assert (rollout.forces > 0).any()


def test_states_that_touch_nothing_and_states_that_do_are_simulated_alike(cart_pole):
    """The pole starts between the walls or in one of them; the first kind takes a way of its own."""
    lcs = cart_pole()
    feedback = LinearFeedback(np.array([[0.1, 0.2, -0.9, -0.2]]), np.zeros(1), np.full(1, -np.inf), np.full(1, np.inf))
    s0 = np.random.default_rng(0).uniform(-1, 1, (40, 4)) * [0.45, 0.5, 0.1, 0.5]
    rollout = LcsSimulator(arrays(lcs), feedback).regulated(s0, 5)
    touched = (rollout.forces > 0).any(axis=(1, 2))
    assert 5 < touched.sum() < 35
    np.testing.assert_allclose(rollout.actions, rollout.states[:, :-1] @ feedback.gain.T, rtol=0, atol=1e-12)
    assert_follows(rollout, lcs, s0)


def test_a_rollout_does_not_depend_on_its_company_nor_on_the_horizon_before(random_model):
    simulator = LcsSimulator(arrays(random_model(7)), FEEDBACK)
    s0 = np.random.default_rng(0).normal(size=(40, 3))
    together = simulator.regulated(s0, 5)
    simulator.regulated(s0, 3)
    for i in range(40):
        for alone, all_of_them in zip(simulator.regulated(s0[[i]], 5), together, strict=True):
            np.testing.assert_allclose(alone[0], all_of_them[i], rtol=0, atol=1e-12)


def test_without_a_feedback_there_is_no_regulated_rollout(random_model):
    with pytest.raises(ValueError, match="made with a feedback"):
        LcsSimulator(arrays(random_model(7))).regulated(np.zeros((1, 3)), 3)
