"""The model: a linear complementarity system, eq (5) of the paper.

    s' = A s + B a + C lam + d                                      (5a)
    0 <= lam  ⟂  phi = D s + E a + F lam + c >= 0                   (5b)

``lam`` are contact forces and ``phi`` the gaps that they keep open. ``F = G Gᵀ + kappa I + (S − Sᵀ)`` with
``kappa > 0`` has a positive definite symmetric part, so it is a P-matrix and (5b) has exactly one solution.

The parameters live in *scaled coordinates*: state, action, force and gap divided by fixed scales, so that an
optimiser's step means the same for metres, radians and newtons. Everything public is in the environment's units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import nn

from sb3_mpc_policy.lcp import solve_lcp

__all__ = ["LcsMatrices", "LinearComplementaritySystem", "of_contacts"]

# Least eigenvalue of the symmetric part of F in scaled coordinates, relative to gaps and forces of size one.
KAPPA = 1e-3


Matrix = TypeVar("Matrix", np.ndarray, torch.Tensor)


class LcsMatrices(NamedTuple, Generic[Matrix]):
    """The matrices of eq (5), as arrays or as tensors: A (n_x, n_x), B (n_x, n_a), C (n_x, n_lambda), d (n_x),
    D (n_lambda, n_x), E (n_lambda, n_a), F (n_lambda, n_lambda), c (n_lambda)."""

    A: Matrix
    B: Matrix
    C: Matrix
    d: Matrix
    D: Matrix
    E: Matrix
    F: Matrix
    c: Matrix


def of_contacts(model: LcsMatrices[Matrix], index: np.ndarray) -> LcsMatrices[Matrix]:
    """The same model with these contacts only."""
    A, B, C, d, D, E, F, c = model
    return LcsMatrices(A, B, C[:, index], d, D[index], E[index], F[index][:, index], c[index])


class LinearComplementaritySystem(nn.Module):
    """A learnable LCS for any number of contacts, ``n_contacts = 0`` (a linear model) included.

    A fresh model stands still: ``A`` is near the identity, ``C`` is small, both random; ``B`` is zero, so that a
    controller that knows nothing does nothing; and every contact is open at the origin, its direction random.
    :meth:`from_matrices` starts from a known one.

    :param n_states: n_x >= 1
    :param n_actions: n_a >= 1
    :param n_contacts: n_lambda >= 0
    :param state_scale: (n_x,) > 0, size of each state component, environment units; ones where None
    :param action_scale: (n_a,) > 0, likewise for the action
    """

    A_scaled: nn.Parameter

    def __init__(
        self,
        n_states: int,
        n_actions: int,
        n_contacts: int = 0,
        state_scale: np.ndarray | None = None,
        action_scale: np.ndarray | None = None,
    ) -> None:
        super().__init__()
        for name, value, least in (
            ("n_states", n_states, 1),
            ("n_actions", n_actions, 1),
            ("n_contacts", n_contacts, 0),
        ):
            if int(value) != value or value < least:
                raise ValueError(f"{name} must be an integer >= {least}, got {value!r}")
        self.n_states, self.n_actions, self.n_contacts = int(n_states), int(n_actions), int(n_contacts)
        n_x, n_a, n_c = self.n_states, self.n_actions, self.n_contacts

        def normal(*shape: int) -> torch.Tensor:
            return torch.randn(*shape, dtype=torch.float64)

        self.A_scaled = nn.Parameter(torch.eye(n_x, dtype=torch.float64) + 0.01 * normal(n_x, n_x))
        self.B_scaled = nn.Parameter(torch.zeros(n_x, n_a, dtype=torch.float64))
        self.C_scaled = nn.Parameter(0.01 * normal(n_x, n_c))
        self.d_scaled = nn.Parameter(torch.zeros(n_x, dtype=torch.float64))
        directions = normal(n_c, n_x)
        self.D_scaled = nn.Parameter(directions / directions.norm(dim=1, keepdim=True).clamp_min(1e-12))
        self.E_scaled = nn.Parameter(torch.zeros(n_c, n_a, dtype=torch.float64))
        self.c_scaled = nn.Parameter(torch.ones(n_c, dtype=torch.float64))
        self.F_factor = nn.Parameter(torch.eye(n_c, dtype=torch.float64))
        self.F_skew = nn.Parameter(torch.zeros(n_c, n_c, dtype=torch.float64))
        for name, size in (("state", n_x), ("action", n_a), ("force", n_c), ("gap", n_c)):
            self.register_buffer(f"{name}_scale", torch.ones(size, dtype=torch.float64))
        self.set_scales(state_scale, action_scale)

    state_scale: torch.Tensor
    action_scale: torch.Tensor
    force_scale: torch.Tensor
    gap_scale: torch.Tensor

    def set_scales(self, state_scale: np.ndarray | None = None, action_scale: np.ndarray | None = None) -> None:
        """Fix the scales. The scaled parameters stay as they are, so do this before anything is learned."""
        for name, value, size in (
            ("state_scale", state_scale, self.n_states),
            ("action_scale", action_scale, self.n_actions),
        ):
            if value is None:
                continue
            scale = np.asarray(value, dtype=np.float64)
            if scale.shape != (size,) or not np.isfinite(scale).all() or (scale <= 0).any():
                raise ValueError(f"{name} must be {size} finite positive numbers, got {value!r}")
            getattr(self, name).copy_(torch.as_tensor(scale))

    @classmethod
    def from_matrices(
        cls,
        A: np.ndarray,
        B: np.ndarray,
        C: np.ndarray,
        d: np.ndarray,
        D: np.ndarray,
        E: np.ndarray,
        F: np.ndarray,
        c: np.ndarray,
        state_scale: np.ndarray | None = None,
        action_scale: np.ndarray | None = None,
    ) -> LinearComplementaritySystem:
        """Start from a known model, given in the environment's units (shapes: :class:`LcsMatrices`).

        :raise ValueError: for a matrix of the wrong shape, a number that is not finite, or an ``F`` whose symmetric
            part is not positive definite
        """
        given = LcsMatrices(*(np.asarray(m, dtype=np.float64) for m in (A, B, C, d, D, E, F, c)))
        if given.A.ndim != 2 or given.B.ndim != 2:
            raise ValueError(f"A and B must be matrices, got shapes {given.A.shape} and {given.B.shape}")
        n_x, n_a, n_c = given.A.shape[0], given.B.shape[1], given.c.size
        shapes = [(n_x, n_x), (n_x, n_a), (n_x, n_c), (n_x,), (n_c, n_x), (n_c, n_a), (n_c, n_c), (n_c,)]
        for name, matrix, shape in zip(LcsMatrices._fields, given, shapes, strict=True):
            if matrix.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {matrix.shape}")
            if not np.isfinite(matrix).all():
                raise ValueError(f"{name} must be finite, got {matrix!r}")
        lcs = cls(n_x, n_a, n_c, state_scale, action_scale)
        lcs._assign(given)
        return lcs

    @torch.no_grad()
    def _assign(self, given: LcsMatrices[np.ndarray]) -> None:
        """Take over matrices in environment units; choose force and gap scales that make F's diagonal one.

        All contacts share the unit of force times gap: only such scales keep F's symmetric part positive definite. Its
        size makes the gaps of order one.
        """
        s, a = self.state_scale.cpu().numpy(), self.action_scale.cpu().numpy()
        size = np.linalg.norm(np.hstack([given.D * s, given.E * a]), axis=1)
        size[size == 0.0] = 1.0
        diagonal = np.diag(given.F)
        if (diagonal <= 0).any():
            raise ValueError(f"F must have a positive definite symmetric part, got the diagonal {diagonal}")
        product = np.exp(np.mean(np.log(size**2 / diagonal))) if len(size) else 1.0
        gap, force = np.sqrt(product * diagonal), np.sqrt(product / diagonal)
        F = given.F * force / gap[:, None]
        least = np.linalg.eigvalsh((F + F.T) / 2).min(initial=np.inf)
        if least < KAPPA:
            raise ValueError(
                "F must have a positive definite symmetric part: scaled to a unit diagonal its least eigenvalue must "
                f"be at least {KAPPA}, got {least:.3g}"
            )
        skew = np.triu(F - F.T, 1) / 2
        factor = np.linalg.cholesky((F + F.T) / 2 - (KAPPA - 1e-12) * np.eye(len(F))) if len(F) else F
        for parameter, value in (
            (self.A_scaled, given.A * s / s[:, None]),
            (self.B_scaled, given.B * a / s[:, None]),
            (self.C_scaled, given.C * force / s[:, None]),
            (self.d_scaled, given.d / s),
            (self.D_scaled, given.D * s / gap[:, None]),
            (self.E_scaled, given.E * a / gap[:, None]),
            (self.c_scaled, given.c / gap),
            (self.F_factor, factor),
            (self.F_skew, skew),
            (self.force_scale, force),
            (self.gap_scale, gap),
        ):
            parameter.copy_(torch.as_tensor(value))

    # -- scaled coordinates: what the controller and the losses work in -----------------------------------------

    @property
    def F_scaled(self) -> torch.Tensor:
        """``G Gᵀ + kappa I + (S − Sᵀ)``: a P-matrix for every value of the parameters."""
        identity = torch.eye(self.n_contacts, dtype=torch.float64, device=self.F_factor.device)
        return self.F_factor @ self.F_factor.mT + KAPPA * identity + self.F_skew - self.F_skew.mT

    def scaled(self) -> LcsMatrices[torch.Tensor]:
        """The matrices of eq (5) in scaled coordinates, as tensors that carry gradients to the parameters."""
        return LcsMatrices(
            self.A_scaled, self.B_scaled, self.C_scaled, self.d_scaled,
            self.D_scaled, self.E_scaled, self.F_scaled, self.c_scaled,
        )  # fmt: skip

    def step_scaled(self, s: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        """One step of eq (5), scaled coordinates. s: (N, n_x), a: (N, n_a) -> (N, n_x)."""
        A, B, C, d, D, E, F, c = self.scaled()
        lam = solve_lcp(F, s @ D.mT + a @ E.mT + c)
        return s @ A.mT + a @ B.mT + lam @ C.mT + d

    # -- the environment's units ---------------------------------------------------------------------------------

    def step(self, s: torch.Tensor | np.ndarray, a: torch.Tensor | np.ndarray) -> torch.Tensor:
        """The next state (5a). s: (N, n_x) or (n_x,), a: (N, n_a) or (n_a,), environment units -> like s, float64."""
        state, action, single = self._inputs(s, a)
        result = self.step_scaled(state / self.state_scale, action / self.action_scale) * self.state_scale
        return result[0] if single else result

    def contact_force(self, s: torch.Tensor | np.ndarray, a: torch.Tensor | np.ndarray) -> torch.Tensor:
        """The contact forces lam (5b). s: (N, n_x) or (n_x,), a likewise -> (N, n_lambda) or (n_lambda,).

        Their unit is that of the model: newtons where it was started from one in newtons, else, and once contacts have
        been fitted, as it was learned.
        """
        state, action, single = self._inputs(s, a)
        _, _, _, _, D, E, F, c = self.matrices()
        lam = solve_lcp(F, state @ D.mT + action @ E.mT + c)
        return lam[0] if single else lam

    def _inputs(
        self, s: torch.Tensor | np.ndarray, a: torch.Tensor | np.ndarray
    ) -> tuple[torch.Tensor, torch.Tensor, bool]:
        device = self.A_scaled.device
        state = torch.as_tensor(s, dtype=torch.float64, device=device)
        action = torch.as_tensor(a, dtype=torch.float64, device=device)
        single = state.ndim == 1
        for name, value, size in (("s", state, self.n_states), ("a", action, self.n_actions)):
            if value.ndim not in (1, 2) or value.shape[-1] != size:
                raise ValueError(f"{name} must have shape (N, {size}) or ({size},), got {tuple(value.shape)}")
        if action.shape[:-1] != state.shape[:-1]:
            raise ValueError(f"a must have as many rows as s, {tuple(state.shape[:-1])}, got {tuple(action.shape)}")
        return torch.atleast_2d(state), torch.atleast_2d(action), single

    def matrices(self) -> LcsMatrices[torch.Tensor]:
        """The matrices of eq (5) in the environment's units, as tensors that carry gradients."""
        A, B, C, d, D, E, F, c = self.scaled()
        s, a, force, gap = self.state_scale, self.action_scale, self.force_scale, self.gap_scale
        return LcsMatrices(
            s[:, None] * A / s, s[:, None] * B / a, s[:, None] * C / force, s * d,
            gap[:, None] * D / s, gap[:, None] * E / a, gap[:, None] * F / force, gap * c,
        )  # fmt: skip

    A = property(lambda self: self.matrices().A, doc="(n_x, n_x), eq (5a), environment units")
    B = property(lambda self: self.matrices().B, doc="(n_x, n_a), eq (5a), environment units")
    C = property(lambda self: self.matrices().C, doc="(n_x, n_lambda), eq (5a), environment units")
    d = property(lambda self: self.matrices().d, doc="(n_x,), eq (5a), environment units")
    D = property(lambda self: self.matrices().D, doc="(n_lambda, n_x), eq (5b), environment units")
    E = property(lambda self: self.matrices().E, doc="(n_lambda, n_a), eq (5b), environment units")
    F = property(lambda self: self.matrices().F, doc="(n_lambda, n_lambda), eq (5b), environment units")
    c = property(lambda self: self.matrices().c, doc="(n_lambda,), eq (5b), environment units")

    def describe(
        self, states: Sequence[tuple[str, str]] | None = None, actions: Sequence[tuple[str, str]] | None = None
    ) -> str:
        """The contacts in words and units, for instance::

            2 of 2 contacts in use
            contact 1: touches where x + 0.600 theta + 0.00500 x_dot > 0.350 m
              along x alone: at x = 0.350 m (open below)
              each m beyond it changes, in one step: theta_dot by -60.3 rad/s, x_dot by +2.79 m/s, theta by -0.302 rad

        Each gap is given in the unit of the state that matters most to it, with that state's coefficient one; what a
        contact changes is ``C_k / F_kk`` for each unit its gap would close. Terms under 1 % of the largest, in scaled
        coordinates, are left out. A contact is not in use where its column of C is zero.

        :param states: (name, unit) of each state, such as ``("x", "m")``; ``("s[0]", "")`` and so on where None
        :param actions: likewise; ``("a[0]", "")`` and so on where None
        :raise ValueError: for another number of names, or anything else than pairs of strings
        """
        from sb3_mpc_policy.description import describe

        return describe(self, states, actions)

    def extra_repr(self) -> str:
        return f"n_states={self.n_states}, n_actions={self.n_actions}, n_contacts={self.n_contacts}"
