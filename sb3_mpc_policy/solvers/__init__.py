"""How the relaxed problem is optimised: one file a solver, one interface (base.py)."""

from __future__ import annotations

from collections.abc import Callable

from sb3_mpc_policy.solvers.base import Solution, Solver
from sb3_mpc_policy.solvers.condensed import kkt_residual

__all__ = ["SOLVERS", "Solution", "Solver", "kkt_residual", "make_solver"]


def _daqp() -> Solver:
    from sb3_mpc_policy.solvers.daqp import DaqpSolver

    return DaqpSolver()


def _cvxpylayers() -> Solver:
    from sb3_mpc_policy.solvers.cvxpylayers import CvxpyLayersSolver

    return CvxpyLayersSolver()


SOLVERS: dict[str, Callable[[], Solver]] = {"daqp": _daqp, "cvxpylayers": _cvxpylayers}
_AUTOMATIC = "daqp"  # exact, and far quicker than the reference


def make_solver(name: str) -> Solver:
    """
    :param name: "auto" or a key of :data:`SOLVERS`
    :raise ValueError: for any other name
    """
    chosen = _AUTOMATIC if name == "auto" else name
    if chosen not in SOLVERS:
        raise ValueError(f"solver must be 'auto' or one of {sorted(SOLVERS)}, got {name!r}")
    return SOLVERS[chosen]()
