"""How the relaxed problem is optimised: one file a solver, one interface (base.py)."""

from __future__ import annotations

from collections.abc import Callable

from sb3_mpc_policy.solvers.auto import AutomaticSolver
from sb3_mpc_policy.solvers.base import Solution, Solver
from sb3_mpc_policy.solvers.check import CheckedSolver, kkt_residual
from sb3_mpc_policy.solvers.daqp import DaqpSolver
from sb3_mpc_policy.solvers.interior_point import InteriorPointSolver

__all__ = ["SOLVERS", "CheckedSolver", "Solution", "Solver", "kkt_residual", "make_solver"]


def _cvxpylayers() -> Solver:
    from sb3_mpc_policy.solvers.cvxpylayers import CvxpyLayersSolver  # takes a second to import

    return CvxpyLayersSolver()


SOLVERS: dict[str, Callable[[], Solver]] = {
    "daqp": DaqpSolver,
    "torch": InteriorPointSolver,
    "cvxpylayers": _cvxpylayers,
}


def make_solver(name: str) -> Solver:
    """
    :param name: "auto" (see auto.py) or a key of :data:`SOLVERS`
    :raise ValueError: for any other name
    """
    if name == "auto":
        return AutomaticSolver()
    if name not in SOLVERS:
        raise ValueError(f"solver must be 'auto' or one of {sorted(SOLVERS)}, got {name!r}")
    return SOLVERS[name]()
