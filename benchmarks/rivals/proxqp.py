"""ProxQP (Bambade, El-Kazdadi, Taylor and Carpentier 2022), a proximal augmented Lagrangian, on the dense problem."""

from __future__ import annotations

import numpy as np
from proxsuite import proxqp

from benchmarks.rivals.base import TOLERANCE
from benchmarks.rivals.condensed import CondensedRival
from sb3_mpc_policy.solvers.condensed import CondensedProblem

__all__ = ["ProxQp"]

_UNBOUNDED = 1e30  # ProxQP's infinity
_MOST_ITERATIONS = 200  # of the outer loop: what it solves at all takes it less than 20, and its own limit is 10,000


class ProxQp(CondensedRival):
    """
    :param warm: start from the solution of the problem before, which in a batch is that of an unrelated state
    """

    def __init__(self, warm: bool = False) -> None:
        super().__init__()
        self._warm = warm

    def _setup(self, condensed: CondensedProblem) -> None:
        n_gaps = len(condensed.G)
        self._qp = proxqp.dense.QP(condensed.n, 0, n_gaps, True)
        settings = self._qp.settings
        settings.eps_abs, settings.eps_rel = TOLERANCE, 0.0
        settings.max_iter = _MOST_ITERATIONS
        settings.initial_guess = proxqp.InitialGuess.NO_INITIAL_GUESS
        none = np.full(n_gaps, _UNBOUNDED)
        low, high = np.maximum(condensed.low, -_UNBOUNDED), np.minimum(condensed.high, _UNBOUNDED)
        self._qp.init(H=condensed.Q, g=np.zeros(condensed.n), C=condensed.G, l=-none, u=none, l_box=low, u_box=high)

    def _solve_one(self, slope: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        self._qp.update(g=slope, **(dict(l=-offset) if len(offset) else {}))
        self._qp.solve()
        if self._warm:  # only now is there a solution to start from: without one ProxQP ends the process
            self._qp.settings.initial_guess = proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
        found = self._qp.results
        multipliers = np.concatenate([found.z[len(offset) :], found.z[: len(offset)]])
        return found.x, multipliers, found.info.status == proxqp.PROXQP_SOLVED
