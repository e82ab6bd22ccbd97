"""The cart-pole between two soft walls as mathematics: no simulator, NumPy and SciPy only.

The pole is a massless rod of length ``l`` that carries a point mass ``m_p`` at distance ``l_c`` from its
hinge on the cart (mass ``m_c``). Nothing dissipates energy. With the state ``s = (x, x_dot, theta,
theta_dot)``, ``theta = 0`` upright and positive towards +x, the horizontal force ``u`` on the cart and the
wall forces ``lam_right, lam_left >= 0`` on the pole's tip, Lagrange's equations read::

    (m_c + m_p) x_ddot + m_p l_c (cos(theta) theta_ddot - sin(theta) theta_dot^2) = u + f
    m_p l_c cos(theta) x_ddot + m_p l_c^2 theta_ddot - m_p g l_c sin(theta)       = l cos(theta) f

    f = lam_left - lam_right
    lam_right = k max(0,  (x + l sin(theta)) - w)
    lam_left  = k max(0, -(x + l sin(theta)) - w)

This is the system every simulator backend approximates, and what the tests measure them against. Two-element
wall arrays are ordered (right wall at +w, left wall at -w) everywhere.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from contact_envs._validation import non_negative, positive

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


@dataclasses.dataclass(frozen=True)
class CartPoleParameters:
    """Physical constants of the plant, SI units.

    Masses, lengths and the wall distance are those of the public C3 cart-pole example; the wall stiffness is
    the paper's (section IV-A).

    :param cart_mass: kg
    :param pole_mass: kg, concentrated at ``mass_centre``
    :param pole_length: m, from the hinge to the tip, which is what the walls touch
    :param mass_centre: m, from the hinge to the point mass
    :param wall_distance: m, from the origin to each wall: contact starts when the tip's centre is this far
        out
    :param wall_stiffness: N/m
    :param gravity: m/s^2, downwards; zero is allowed
    :param tip_radius: m, radius of the sphere at the tip in the simulators and in pictures. The walls' faces
        stand this much further out, so it does not change the motion.
    :raises TypeError: a value is not a real number
    :raises ValueError: a value is not finite, or not positive
    """

    cart_mass: float = 0.978
    pole_mass: float = 0.411
    pole_length: float = 0.6
    mass_centre: float = 0.4267
    wall_distance: float = 0.35
    wall_stiffness: float = 700.0
    gravity: float = 9.81
    tip_radius: float = 0.02

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            check = non_negative if field.name == "gravity" else positive
            object.__setattr__(self, field.name, check(field.name, getattr(self, field.name)))


class LcsMatrices(NamedTuple):
    """A linear complementarity system in environment units: state SI, action in [-1, 1], forces in N::

        s' = A s + B a + C lam + d
        0 <= lam  ⟂  D s + E a + F lam + c >= 0

    All float64. Shapes: A (4, 4), B (4, 1), C (4, 2), d (4,), D (2, 4), E (2, 1), F (2, 2), c (2,). ``lam``
    holds the forces of the right and the left wall in N; the gap ``D s + E a + F lam + c`` is in m.
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
    state = np.asarray(state, dtype=np.float64)
    return state[..., 0] + parameters.pole_length * np.sin(state[..., 2])


def wall_forces(state: ArrayLike, parameters: CartPoleParameters) -> NDArray[np.float64]:
    """How hard each wall pushes on the tip, N: a one-sided spring, zero without contact.

    :param state: (..., 4)
    :return: (..., 2) right wall, left wall; both >= 0
    """
    tip = tip_position(state, parameters)
    depth = np.stack([tip, -tip], axis=-1) - parameters.wall_distance
    return parameters.wall_stiffness * np.maximum(depth, 0.0)


def equations_of_motion(state: ArrayLike, force: ArrayLike, parameters: CartPoleParameters) -> NDArray[np.float64]:
    """Time derivative of the state.

    :param state: (..., 4) x (m), x_dot (m/s), theta (rad), theta_dot (rad/s)
    :param force: (...) horizontal force on the cart, N
    :return: (..., 4) d state / dt
    """
    state = np.asarray(state, dtype=np.float64)
    walls = wall_forces(state, parameters)
    contact = walls[..., 1] - walls[..., 0]
    x_dot, theta, theta_dot = state[..., 1], state[..., 2], state[..., 3]
    sin, cos = np.sin(theta), np.cos(theta)

    total = parameters.cart_mass + parameters.pole_mass
    moment = parameters.pole_mass * parameters.mass_centre
    inertia = moment * parameters.mass_centre
    on_x = np.asarray(force) + contact + moment * sin * theta_dot**2
    on_theta = parameters.gravity * moment * sin + parameters.pole_length * cos * contact

    determinant = total * inertia - (moment * cos) ** 2
    x_ddot = (inertia * on_x - moment * cos * on_theta) / determinant
    theta_ddot = (total * on_theta - moment * cos * on_x) / determinant
    return np.stack(np.broadcast_arrays(x_dot, x_ddot, theta_dot, theta_ddot), axis=-1)


def mechanical_energy(state: ArrayLike, parameters: CartPoleParameters) -> NDArray[np.float64]:
    """Kinetic energy, gravity and what the walls store, J: constant while the force on the cart is zero.

    :param state: (..., 4)
    :return: (...)
    """
    state = np.asarray(state, dtype=np.float64)
    x_dot, theta, theta_dot = state[..., 1], state[..., 2], state[..., 3]
    moment = parameters.pole_mass * parameters.mass_centre
    kinetic = (
        0.5 * (parameters.cart_mass + parameters.pole_mass) * x_dot**2
        + moment * np.cos(theta) * x_dot * theta_dot
        + 0.5 * moment * parameters.mass_centre * theta_dot**2
    )
    gravity = moment * parameters.gravity * np.cos(theta)
    walls = (wall_forces(state, parameters) ** 2).sum(axis=-1) / (2.0 * parameters.wall_stiffness)
    return kinetic + gravity + walls


def integrate(
    state: ArrayLike,
    force: float,
    duration: float,
    parameters: CartPoleParameters | None = None,
    *,
    rtol: float = 1e-12,
    atol: float = 1e-12,
) -> NDArray[np.float64]:
    """The reference motion: the state after ``duration`` under a constant force.

    Dormand-Prince 8(5,3). The right-hand side has a kink where the tip meets a wall; the integration is cut
    there, so that every piece is smooth and keeps the method's order.

    :param state: (4,)
    :param force: horizontal force on the cart, N, held for the whole duration
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
        return equations_of_motion(s, force, parameters)

    def depth(_: float, s: NDArray[np.float64]) -> float:
        return float(abs(tip_position(s, parameters)) - parameters.wall_distance)

    depth.terminal = True  # type: ignore[attr-defined]
    touching, moved = depth(0.0, current) > 0.0, True
    while time < duration:
        # Only the crossing that ends this piece counts, so that the one that began it is not found again. A
        # piece of no length means a tip at rest on a wall's face: there is nothing to cut then.
        depth.direction = -1.0 if touching else 1.0  # type: ignore[attr-defined]
        events = depth if moved else None
        piece = solve_ivp(derivative, (time, duration), current, "DOP853", events=events, rtol=rtol, atol=atol)
        if not piece.success:
            raise RuntimeError(f"integration failed at {time} s from state {state!r}, force {force!r}: {piece.message}")
        touching, moved = not touching, piece.t[-1] > time
        current, time = piece.y[:, -1], float(piece.t[-1])
    return current


def true_lcs(
    parameters: CartPoleParameters | None = None,
    control_step: float = 0.01,
    action_scale: float = 100.0,
    *,
    gap_instant: float = 0.5,
) -> LcsMatrices:
    """The linear complementarity system of the cart-pole, linearised about upright.

    Between two control instants the linear equations are solved exactly (matrix exponential), with the action
    and the wall forces held constant. A wall's force is ``k`` times the penetration, hence complementary to
    the gap ``w -+ (x + l theta) + lam / k``. The penetration changes within the control step; ``gap_instant``
    says when it is read. The middle is the default because it is measured to be best: on random states within
    3 cm of a wall its one-step error is less than a third of that of the start and of the end
    (``tests/contact_envs/test_true_lcs.py`` repeats the comparison).

    :param parameters: of the plant; the default cart-pole if None
    :param control_step: s
    :param action_scale: N per unit of action: the environment's ``max_force``
    :param gap_instant: when the gap is read, as a fraction of the control step: 0 start, 1 end
    :return: see :class:`LcsMatrices`; ``lam`` = forces of the right (+w) and the left (-w) wall in N. F is
        symmetric positive definite, hence a P-matrix.
    :raises ValueError: an argument is out of range; the message names it
    """
    from scipy.linalg import expm  # here: importing the package must stay quick

    parameters = CartPoleParameters() if parameters is None else parameters
    control_step = positive("control_step", control_step)
    action_scale = positive("action_scale", action_scale)
    gap_instant = non_negative("gap_instant", gap_instant)
    if gap_instant > 1.0:
        raise ValueError(f"gap_instant must be a fraction of the control step in [0, 1], got {gap_instant!r}")

    moment = parameters.pole_mass * parameters.mass_centre
    mass = np.array([[parameters.cart_mass + parameters.pole_mass, moment], [moment, moment * parameters.mass_centre]])
    # Columns: theta, action, right wall, left wall. Rows: what they do to x and to theta.
    loads = np.array(
        [
            [0.0, action_scale, -1.0, 1.0],
            [moment * parameters.gravity, 0.0, -parameters.pole_length, parameters.pole_length],
        ]
    )
    accelerations = np.linalg.solve(mass, loads)
    # d/dt (s, a, lam) with a and lam constant: one exponential gives A, B and C.
    generator = np.zeros((7, 7))
    generator[0, 1] = generator[2, 3] = 1.0
    generator[[1, 3], 2] = accelerations[:, 0]
    generator[[1, 3], 4:] = accelerations[:, 1:]

    step = expm(generator * control_step)[:4]
    at_gap = expm(generator * control_step * gap_instant)[:4]
    inward = np.array([[-1.0, 0.0, -parameters.pole_length, 0.0], [1.0, 0.0, parameters.pole_length, 0.0]])
    gap = inward @ at_gap
    return LcsMatrices(
        A=step[:, :4],
        B=step[:, 4:5],
        C=step[:, 5:],
        d=np.zeros(4),
        D=gap[:, :4],
        E=gap[:, 4:5],
        F=gap[:, 5:] + np.eye(2) / parameters.wall_stiffness,
        c=np.full(2, parameters.wall_distance),
    )
