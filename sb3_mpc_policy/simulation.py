"""Rolling the model, eq (5), out in time: plain NumPy for whole batches, without gradients."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sb3_mpc_policy.lcp import LcpSolver
from sb3_mpc_policy.lcs import LcsMatrices

__all__ = ["LcsRollout", "LcsSimulator", "LinearFeedback"]


class LcsRollout(NamedTuple):
    """A simulated trajectory: states (N, H+1, n_x), actions (N, H, n_a), forces and gaps (N, H, n_lambda)."""

    states: np.ndarray
    actions: np.ndarray
    forces: np.ndarray
    gaps: np.ndarray


class LinearFeedback(NamedTuple):
    """``a = clip(gain s + offset, low, high)``: gain (n_a, n_x), the others (n_a,)."""

    gain: np.ndarray
    offset: np.ndarray
    low: np.ndarray
    high: np.ndarray


# A model that explodes within the horizon ends in numbers that are not finite, which the controller recognises.
_may_explode = np.errstate(over="ignore", invalid="ignore")


class LcsSimulator:
    """Rollouts of one model, in whichever coordinates its matrices and the arguments share.

    :param model: the matrices of eq (5)
    :param feedback: for :meth:`regulated`
    """

    def __init__(self, model: LcsMatrices[np.ndarray], feedback: LinearFeedback | None = None) -> None:
        A, B, C, d, D, E, F, c = model
        self.n_x, self.n_a, self.n_c = len(A), B.shape[1], len(c)
        self.feedback = feedback
        self._lcp = LcpSolver(F)
        # (s, a, 1) times the first is (s', gap) without contact forces; forces times the second are what they add
        self._free = np.vstack([np.hstack([A, B, d[:, None]]), np.hstack([D, E, c[:, None]])]).T.copy()
        self._push = np.vstack([C, F]).T.copy()
        self._maps: dict[int, np.ndarray] = {}  # by horizon

    @_may_explode
    def under(self, s0: np.ndarray, actions: np.ndarray) -> LcsRollout:
        """s0: (N, n_x), actions: (N, H, n_a)"""
        return self._step_by_step(s0, actions.shape[1], actions, None)

    @_may_explode
    def regulated(self, s0: np.ndarray, horizon: int) -> LcsRollout:
        """Under the feedback, from s0 (N, n_x).

        :raise ValueError: where the simulator was made without a feedback
        """
        if self.feedback is None:
            raise ValueError("regulated needs a simulator that was made with a feedback")
        # Most rollouts meet neither a contact nor a bound. Those are linear in s_0: one product for the whole horizon.
        n, n_x, n_a, n_c, H = len(s0), self.n_x, self.n_a, self.n_c, horizon
        if H not in self._maps:
            self._maps[H] = self._contact_free(H, self.feedback)
        flat = np.concatenate([s0, np.ones((n, 1))], axis=1) @ self._maps[H]
        first, second = (H + 1) * n_x, (H + 1) * n_x + H * n_a
        result = LcsRollout(
            flat[:, :first].reshape(n, H + 1, n_x),
            flat[:, first:second].reshape(n, H, n_a),
            np.zeros((n, H, n_c)),
            flat[:, second:].reshape(n, H, n_c),
        )
        allowed = (result.actions >= self.feedback.low) & (result.actions <= self.feedback.high)
        index = np.flatnonzero(~(allowed.all(axis=(1, 2)) & (result.gaps >= 0.0).all(axis=(1, 2))))
        if len(index):
            for whole, part in zip(result, self._step_by_step(s0[index], H, None, self.feedback), strict=True):
                whole[index] = part
        return result

    def _contact_free(self, horizon: int, feedback: LinearFeedback) -> np.ndarray:
        """(n_x + 1, ...): (s_0, 1) times this is every state, action and gap without contacts and bounds, flattened."""
        n_x = self.n_x
        to_action = np.concatenate([feedback.gain, feedback.offset[:, None]], axis=1).T
        to_input = np.zeros((n_x + 1, n_x + self.n_a + 1))  # (s, 1) to (s, a, 1)
        to_input[:n_x, :n_x], to_input[n_x, -1] = np.eye(n_x), 1.0
        to_input[:, n_x:-1] = to_action
        following = to_input @ self._free
        powers = np.empty((horizon + 1, n_x + 1, n_x + 1))
        powers[0] = np.eye(n_x + 1)
        step = np.eye(n_x + 1)
        step[:, :n_x] = following[:, :n_x]
        for k in range(horizon):
            powers[k + 1] = powers[k] @ step
        parts = (powers[:, :, :n_x], powers[:-1] @ to_action, powers[:-1] @ following[:, n_x:])
        return np.concatenate([part.transpose(1, 0, 2).reshape(n_x + 1, -1) for part in parts], axis=1)

    def _step_by_step(
        self, s0: np.ndarray, horizon: int, actions: np.ndarray | None, feedback: LinearFeedback | None
    ) -> LcsRollout:
        n, n_x = len(s0), self.n_x
        inputs = np.empty((horizon + 1, n, n_x + self.n_a + 1))  # (s, a, 1), time first: contiguous in each step
        inputs[:, :, -1] = 1.0
        inputs[0, :, :n_x] = s0
        if actions is not None:
            inputs[:horizon, :, n_x:-1] = actions.transpose(1, 0, 2)
        forces, gaps = np.zeros((horizon, n, self.n_c)), np.empty((horizon, n, self.n_c))
        for k in range(horizon):
            if feedback is not None:
                a = inputs[k, :, :n_x] @ feedback.gain.T
                a += feedback.offset
                np.minimum(np.maximum(a, feedback.low, out=a), feedback.high, out=inputs[k, :, n_x:-1])
            after = inputs[k] @ self._free
            if after[:, n_x:].min(initial=0.0) < 0.0:
                forces[k], _ = self._lcp(after[:, n_x:])
                after += forces[k] @ self._push
            inputs[k + 1, :, :n_x], gaps[k] = after[:, :n_x], after[:, n_x:]
        return LcsRollout(
            inputs[:, :, :n_x].transpose(1, 0, 2),
            inputs[:horizon, :, n_x:-1].transpose(1, 0, 2),
            forces.transpose(1, 0, 2),
            gaps.transpose(1, 0, 2),
        )
