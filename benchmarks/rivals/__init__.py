"""Other people's solvers of the relaxed problem, behind the package's own interface: what its speed is compared with.

Not on the list, though ``cvxpylayers`` offers them (version 1.2.0, cart-pole of 10 steps):

- Moreau 0.4.1 through ``CvxpyLayer(solver="MOREAU")``: wrong by up to 2, the whole range of an action, as soon as
  there are contacts. Called directly, as here, it is right.
- MPAX 0.2.4, a first-order method: actions wrong by up to 0.2 with contacts at its default tolerance, and
  ``cvxpylayers`` has no derivative for it.
- cuClarabel: needs a graphics card and Julia.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import NamedTuple

from sb3_mpc_policy.solvers import Solver

__all__ = ["RIVALS", "SOLVES_AGAIN", "Rival", "missing_package"]


class Rival(NamedTuple):
    """A solver that may not be there."""

    make: Callable[[], Solver]
    package: str
    """The module it needs."""


def _cvxpylayers_default() -> Solver:
    from benchmarks.rivals.cvxpylayer import CvxpyLayerRival

    return CvxpyLayerRival()


def _moreau() -> Solver:
    from benchmarks.rivals.moreau import MoreauRival

    return MoreauRival()


def _qpth() -> Solver:
    from benchmarks.rivals.qpth import QpthRival

    return QpthRival()


def _clarabel() -> Solver:
    from benchmarks.rivals.clarabel import ClarabelRival

    return ClarabelRival()


def _piqp() -> Solver:
    from benchmarks.rivals.piqp import PiqpDense

    return PiqpDense()


def _piqp_multistage() -> Solver:
    from benchmarks.rivals.piqp import PiqpMultistage

    return PiqpMultistage()


def _proxqp() -> Solver:
    from benchmarks.rivals.proxqp import ProxQp

    return ProxQp()


def _proxqp_warm() -> Solver:
    from benchmarks.rivals.proxqp import ProxQp

    return ProxQp(warm=True)


RIVALS: dict[str, Rival] = {
    "cvxpylayers-default": Rival(_cvxpylayers_default, "cvxpylayers"),
    "moreau": Rival(_moreau, "moreau"),
    "qpth": Rival(_qpth, "qpth"),
    "clarabel": Rival(_clarabel, "clarabel"),
    "piqp": Rival(_piqp, "piqp"),
    "piqp-multistage": Rival(_piqp_multistage, "piqp"),
    "proxqp": Rival(_proxqp, "proxsuite"),
    "proxqp-warm": Rival(_proxqp_warm, "proxsuite"),
}

SOLVES_AGAIN = ("cvxpylayers", "cvxpylayers-default", "moreau", "qpth")
"""Solvers whose differentiable actions are a solve of their own, and not something added to a solution."""


def missing_package(name: str) -> str | None:
    """The module that the rival ``name`` lacks, or None if it is there."""
    package = RIVALS[name].package
    return package if importlib.util.find_spec(package) is None else None
