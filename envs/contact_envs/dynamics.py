"""Reference computations for any plant: exact motion, and the linear complementarity system about upright.

NumPy and SciPy only, no simulator: what the tests measure the simulators against. Each function takes the
plant's parameters (:mod:`contact_envs.plants`); the cart-pole is the default. For its equations see
:mod:`contact_envs.plants.cart_pole`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_envs._validation import non_negative, positive
from contact_envs.plants import CartPoleParameters, Plant

__all__ = [
    "CartPoleParameters",
    "LcsMatrices",
    "equations_of_motion",
    "integrate",
    "mechanical_energy",
    "tip_position",
    "true_lcs",
    "wall_forces",
]


class LcsMatrices(NamedTuple):
    """A linear complementarity system in environment units: state SI, action in [-1, 1], forces in N or N m::

        s' = A s + B a + C lam + d
        0 <= lam  ⟂  D s + E a + F lam + c >= 0

    All float64. Shapes: A (4, 4), B (4, 1), C (4, 2), d (4,), D (2, 4), E (2, 1), F (2, 2), c (2,). ``lam``
    holds the forces of the right and the left contact (N; N m for a joint's stops); the gap
    ``D s + E a + F lam + c`` is in m (rad).
    """

    A: NDArray[np.float64]
    B: NDArray[np.float64]
    C: NDArray[np.float64]
    d: NDArray[np.float64]
    D: NDArray[np.float64]
    E: NDArray[np.float64]
    F: NDArray[np.float64]
    c: NDArray[np.float64]


def tip_position(state: ArrayLike, parameters: CartPoleParameters) -> NDArray[np.float64]:
    """Horizontal position of the pole's tip, m.

    :param state: (..., 4)
    :return: (...)
    """
    return parameters.tip_position(state)


def wall_forces(state: ArrayLike, parameters: CartPoleParameters) -> NDArray[np.float64]:
    """How hard each wall pushes on the tip, N: a one-sided spring, zero without contact.

    :param state: (..., 4)
    :return: (..., 2) right wall, left wall; both >= 0
    """
    return parameters.contact_forces(state)


def equations_of_motion(state: ArrayLike, force: ArrayLike, parameters: Plant) -> NDArray[np.float64]:
    """Time derivative of the state.

    :param state: (..., 4), in the plant's order
    :param force: (...) of the actuator, N or N m
    :return: (..., 4) d state / dt
    """
    return parameters.equations_of_motion(state, force)


def mechanical_energy(state: ArrayLike, parameters: Plant) -> NDArray[np.float64]:
    """Kinetic energy, gravity and what the contacts store, J: constant while nothing drives or brakes.

    :param state: (..., 4)
    :return: (...)
    """
    return parameters.mechanical_energy(state)


def integrate(
    state: ArrayLike,
    force: float,
    duration: float,
    parameters: Plant | None = None,
    *,
    rtol: float = 1e-12,
    atol: float = 1e-12,
) -> NDArray[np.float64]:
    """The reference motion: the state after ``duration`` under a constant force.

    Dormand-Prince 8(5,3). The right-hand side has a kink where a contact begins; the integration is cut
    there, so that every piece is smooth and keeps the method's order.

    :param state: (4,)
    :param force: of the actuator, N or N m, held for the whole duration
    :param duration: s, > 0
    :param parameters: of the plant; the default cart-pole if None
    :param rtol: relative tolerance of a step
    :param atol: absolute tolerance of a step
    :return: (4,) the state at the end
    :raises RuntimeError: SciPy could not integrate
    """
    from scipy.integrate import solve_ivp  # here: importing the package must stay quick

    parameters = CartPoleParameters() if parameters is None else parameters
    duration = positive("duration", duration)
    current, time = np.array(state, dtype=np.float64), 0.0

    def derivative(_: float, s: NDArray[np.float64]) -> NDArray[np.float64]:
        return parameters.equations_of_motion(s, force)

    def depth(_: float, s: NDArray[np.float64]) -> float:
        return float(-parameters.contact_gaps(s).min())

    depth.terminal = True  # type: ignore[attr-defined]
    touching, moved = depth(0.0, current) > 0.0, True
    while time < duration:
        # Only the crossing that ends this piece counts, so that the one that began it is not found again. A
        # piece of no length means a plant at rest on a contact's face: there is nothing to cut then.
        depth.direction = -1.0 if touching else 1.0  # type: ignore[attr-defined]
        events = depth if moved else None
        piece = solve_ivp(derivative, (time, duration), current, "DOP853", events=events, rtol=rtol, atol=atol)
        if not piece.success:
            raise RuntimeError(f"integration failed at {time} s from state {state!r}, force {force!r}: {piece.message}")
        touching, moved = not touching, piece.t[-1] > time
        current, time = piece.y[:, -1], float(piece.t[-1])
    return current


def true_lcs(
    parameters: Plant | None = None,
    control_step: float = 0.01,
    action_scale: float = 100.0,
    *,
    gap_instant: float = 0.5,
) -> LcsMatrices:
    """The linear complementarity system of a plant, linearised about upright.

    Between two control instants the linear equations are solved exactly (matrix exponential), with the action
    and the contact forces held constant. A contact's force is ``k`` times the penetration, hence
    complementary to its linearised gap plus ``lam / k`` (for the cart-pole's walls: ``w -+ (x + l theta) +
    lam / k``). The penetration changes within the control step; ``gap_instant`` says when it is read. The
    middle is the default because it is measured to be best: on random states near a contact its one-step
    error is less than a third of that of the start and of the end (``tests/contact_envs/test_true_lcs.py``
    repeats the comparison).

    :param parameters: of the plant; the default cart-pole if None
    :param control_step: s
    :param action_scale: N or N m per unit of action: the environment's ``max_force``
    :param gap_instant: when the gap is read, as a fraction of the control step: 0 start, 1 end
    :return: see :class:`LcsMatrices`. F is symmetric positive definite, hence a P-matrix.
    :raises ValueError: an argument is out of range; the message names it
    """
    from scipy.linalg import expm  # here: importing the package must stay quick

    parameters = CartPoleParameters() if parameters is None else parameters
    control_step = positive("control_step", control_step)
    action_scale = positive("action_scale", action_scale)
    gap_instant = non_negative("gap_instant", gap_instant)
    if gap_instant > 1.0:
        raise ValueError(f"gap_instant must be a fraction of the control step in [0, 1], got {gap_instant!r}")

    mass, loads, inward = parameters.linearisation()
    n_contacts, n_x = inward.shape
    loads[:, n_x] *= action_scale
    # d/dt (s, a, lam) with a and lam constant: one exponential gives A, B and C.
    generator = np.zeros((n_x + 1 + n_contacts,) * 2)
    generator[parameters.POSITIONS, parameters.VELOCITIES] = 1.0
    generator[parameters.VELOCITIES, :] = np.linalg.solve(mass, loads)

    step = expm(generator * control_step)[:n_x]
    gap = inward @ expm(generator * control_step * gap_instant)[:n_x]
    return LcsMatrices(
        A=step[:, :n_x],
        B=step[:, n_x : n_x + 1],
        C=step[:, n_x + 1 :],
        d=np.zeros(n_x),
        D=gap[:, :n_x],
        E=gap[:, n_x : n_x + 1],
        F=gap[:, n_x + 1 :] + np.eye(n_contacts) / parameters.contact_stiffness,
        c=parameters.contact_gaps(np.zeros(n_x)),
    )
