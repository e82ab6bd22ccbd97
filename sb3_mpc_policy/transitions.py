"""The true transitions the model learns from: what was really applied, and where it really led."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["TransitionStore", "Transitions"]


class Transitions(NamedTuple):
    """A batch of transitions, environment units, float64.

    s (N, n_x) state; a (N, n_a) the action that was applied, clipped to its bounds; reward (N,); s_next (N, n_x) the
    state it led to, the terminal one where an episode ended.
    """

    s: np.ndarray
    a: np.ndarray
    reward: np.ndarray
    s_next: np.ndarray

    def take(self, index: np.ndarray) -> Transitions:
        """The transitions at ``index``."""
        return Transitions(*(part[index] for part in self))


class TransitionStore:
    """All transitions seen, and among them those of the current rollout (the paper's D_k).

    :param n_states: n_x
    :param n_actions: n_a
    """

    def __init__(self, n_states: int, n_actions: int) -> None:
        self.n_states, self.n_actions = n_states, n_actions
        self._chunks: list[np.ndarray] = []
        self._rollout_start = 0
        self._columns = np.cumsum([n_states, n_actions, 1])

    def __len__(self) -> int:
        return sum(len(chunk) for chunk in self._chunks)

    def start_rollout(self) -> None:
        """What is added from now on belongs to a new rollout."""
        self._rollout_start = len(self)

    def add(self, s: np.ndarray, a: np.ndarray, reward: np.ndarray, s_next: np.ndarray) -> None:
        """Add N transitions (shapes: :class:`Transitions`).

        :raise ValueError: for a number that is not finite
        """
        parts = (s, a, np.reshape(reward, (-1, 1)), s_next)
        row = np.concatenate([np.asarray(part, dtype=np.float64).reshape(len(s), -1) for part in parts], axis=1)
        if not np.isfinite(row).all():
            raise ValueError(
                f"transitions must be finite, got state {s}, action {a}, reward {reward}, next state {s_next}"
            )
        self._chunks.append(row)

    def everything(self) -> Transitions:
        """All transitions since the first."""
        return self._split(self.rows())

    def latest(self, n: int) -> Transitions:
        """The last n transitions, or all where there are fewer."""
        return self._split(self.rows()[-n:])

    def rollout(self) -> Transitions:
        """The transitions of the current rollout."""
        return self._split(self.rows()[self._rollout_start :])

    def rows(self) -> np.ndarray:
        """All transitions as one (N, 2 n_x + n_a + 1) array: state, action, reward, next state."""
        if len(self._chunks) != 1:
            empty = np.empty((0, 2 * self.n_states + self.n_actions + 1))
            self._chunks = [np.concatenate([empty, *self._chunks])]
        return self._chunks[0]

    def restore(self, rows: np.ndarray) -> None:
        """Replace everything by saved :meth:`rows`.

        :raise ValueError: where they do not fit the numbers of states and actions
        """
        width = 2 * self.n_states + self.n_actions + 1
        if rows.ndim != 2 or rows.shape[1] != width:
            raise ValueError(f"rows must have shape (N, {width}), got {rows.shape}")
        self._chunks, self._rollout_start = [np.array(rows, dtype=np.float64)], len(rows)

    def _split(self, rows: np.ndarray) -> Transitions:
        s, a, reward, s_next = np.split(rows, self._columns, axis=1)
        return Transitions(s, a, reward[:, 0], s_next)
