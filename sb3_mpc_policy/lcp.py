"""The linear complementarity problem (5b) and its derivative.

    find lam   with   0 <= lam  ⟂  F lam + q >= 0

When every principal minor of ``F`` is positive (a *P-matrix*) there is exactly one solution for every ``q``.
The index set alpha on which ``lam > 0`` is the *active set* (the contact mode). On it the problem is linear,
``lam_alpha = -F_aa^{-1} q_alpha``, and so is its derivative: that is the implicit function theorem used in the
backward pass. Where a contact is just about to open or close, the derivative is that of the mode found.

Two exact methods share one interface:

* few contacts: every one of the ``2^n`` modes is a fixed linear map ``lam = M q`` that depends on ``F`` only. All are
  tabulated once and applied to the whole batch in one product;
* many contacts: block principal pivoting (Júdice and Pires 1994), with Murty's single pivots as the safeguard that
  makes it finite.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

__all__ = ["LcpSolver", "solve_lcp"]

# 2^n modes are tabulated up to this n. Beyond it the table grows faster than pivoting costs.
_MAX_TABULATED_CONTACTS = 4
# Relative to the size of q: below it a negative entry is rounding error, not a violated inequality.
_TOLERANCE = 1e-12
# What rounding can take from F's least eigenvalue, relative to the largest entry. Beside entries of 1e16 the one that
# makes F a P-matrix is lost, and F singular.
_ROUNDING = 1e-14


class LcpSolver:
    """Solve ``0 <= lam ⟂ F lam + q >= 0`` for one ``F`` and many ``q``.

    :param F: (n, n) P-matrix; n may be 0
    """

    def __init__(self, F: np.ndarray) -> None:
        self.F = _safe(np.asarray(F, dtype=np.float64))
        self.n = self.F.shape[0]
        self._modes: np.ndarray | None = None
        if 0 < self.n <= _MAX_TABULATED_CONTACTS:
            self._patterns = np.array(list(product([False, True], repeat=self.n)))
            self._modes = np.stack([_mode_map(self.F, pattern) for pattern in self._patterns])
            # one (n, 2^n * n) matrix each, so that every mode of every problem is one product
            self._to_forces = self._modes.reshape(-1, self.n).T.copy()
            gaps = np.einsum("ij,mjk->mik", self.F, self._modes) + np.eye(self.n)
            self._to_gaps = gaps.reshape(-1, self.n).T.copy()

    def __call__(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        :param q: (N, n)
        :return: the solution lam (N, n), and the active set (N, n), True where lam may be positive
        """
        if self.n == 0 or q.min(initial=0.0) >= 0.0:  # all contacts open, the commonest case
            return np.zeros_like(q), np.zeros(q.shape, dtype=bool)
        if self._modes is None:
            return _block_principal_pivoting(self.F, q)
        lam, active = np.zeros_like(q), np.zeros(q.shape, dtype=bool)
        closing = np.flatnonzero(~(q >= 0.0).all(axis=1))
        some = q[closing]
        shape = (len(some), len(self._patterns), self.n)
        forces = (some @ self._to_forces).reshape(shape)
        gaps = (some @ self._to_gaps).reshape(shape)
        best = np.minimum(forces, gaps).min(axis=2).argmax(axis=1)
        lam[closing], active[closing] = np.maximum(forces[np.arange(len(some)), best], 0.0), self._patterns[best]
        return lam, active


def _safe(F: np.ndarray) -> np.ndarray:
    """F, its diagonal raised where rounding has made it singular or worse."""
    size = _ROUNDING * np.abs(F).max(initial=0.0)
    if not np.isfinite(size) or np.linalg.eigvalsh(F + F.T).min(initial=np.inf) > size:
        return F
    return F + size * np.eye(len(F))


def _mode_map(F: np.ndarray, active: np.ndarray) -> np.ndarray:
    """The matrix M of one mode: ``lam = M q`` with ``lam = 0`` off the active set."""
    mode = np.zeros_like(F)
    index = np.flatnonzero(active)
    if len(index):
        mode[np.ix_(index, index)] = -np.linalg.inv(F[np.ix_(index, index)])
    return mode


def _block_principal_pivoting(F: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flip every violated index at once; one problem that stops improving falls back to Murty's rule.

    Murty's rule (flip the violated index of largest number only) ends after finitely many pivots for a P-matrix.
    """
    n_problems, n = q.shape
    tolerance = _TOLERANCE * (1.0 + np.abs(q).max(axis=1, keepdims=True, initial=0.0))
    active = q < 0.0
    lam = np.zeros_like(q)
    fewest = np.full(n_problems, n + 1)
    patience = np.full(n_problems, 10)
    todo = np.arange(n_problems)
    for _ in range(20 * 2 ** min(n, 12)):
        mask = active[todo]
        lam[todo] = np.linalg.solve(_masked(F, mask), np.where(mask, -q[todo], 0.0)[..., None])[..., 0]
        gap = lam[todo] @ F.T + q[todo]
        violated = np.where(mask, lam[todo] < -tolerance[todo], gap < -tolerance[todo])
        count = violated.sum(axis=1)
        unsolved = count > 0
        if not unsolved.any():
            break
        todo, violated, count = todo[unsolved], violated[unsolved], count[unsolved]
        improved = count < fewest[todo]
        fewest[todo] = np.minimum(fewest[todo], count)
        patience[todo] = np.where(improved, 10, patience[todo] - 1)
        last = n - 1 - violated[:, ::-1].argmax(axis=1)
        single = np.zeros_like(violated)
        single[np.arange(len(todo)), last] = True
        flip = np.where((patience[todo] > 0)[:, None], violated, single)
        active[todo] ^= flip
    else:
        raise ArithmeticError("no solution of the complementarity problem was found: F is not a P-matrix")
    return np.maximum(lam, 0.0), active


def _masked(F: np.ndarray, active: np.ndarray) -> np.ndarray:
    """(N, n, n): F on the active rows and columns, the identity elsewhere."""
    return np.where(active[:, :, None] & active[:, None, :], F, np.eye(len(F)))


class _Lcp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, F: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        lam, active = LcpSolver(F.detach().cpu().numpy())(q.detach().cpu().numpy())
        ctx.lam, ctx.active = lam, active
        ctx.save_for_backward(F)
        return torch.as_tensor(lam, device=q.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        # lam_a = -F_aa^{-1} q_a  =>  d lam_a = -F_aa^{-1} (dq_a + dF_aa lam_a)
        (F,) = ctx.saved_tensors
        rhs = np.where(ctx.active, -grad.cpu().numpy(), 0.0)
        transposed = _masked(_safe(F.detach().cpu().numpy()), ctx.active).transpose(0, 2, 1)
        adjoint = np.linalg.solve(transposed, rhs[..., None])[..., 0]
        return torch.as_tensor(adjoint.T @ ctx.lam, device=grad.device), torch.as_tensor(adjoint, device=grad.device)


def solve_lcp(F: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """The contact forces ``lam = LCP(F, q)`` of eq (5b), differentiable in both arguments.

    :param F: (n, n) float64 P-matrix, n >= 0
    :param q: (N, n) float64
    :return: lam (N, n)
    :raise ArithmeticError: where pivoting finds no solution, which a P-matrix rules out
    """
    if F.shape[0] == 0:
        return torch.zeros_like(q)
    return _Lcp.apply(F, q)
