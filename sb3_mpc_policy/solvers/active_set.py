"""The optimality conditions of the condensed problem on known active constraints: a linear system for each problem.

    Q x + Gᵀ nu = r  in the free variables,      x = 0 in the fixed ones,
    G x         = t  at the active gaps,         nu = 0 at the others

A fixed variable leaves the system with its row and column, and so does an inactive gap. What remains is small, since
forces out of contact are fixed at zero, and differs from problem to problem. Problems of like size are padded to the
largest among them and solved in one batched call, on the device of the tensors.
"""

from __future__ import annotations

import numpy as np
import torch

from sb3_mpc_policy.solvers.condensed import CondensedProblem

__all__ = ["active_constraints", "exact_solution", "solve_on_active_set"]

# A multiplier above this share of the largest counts its constraint as active.
_ACTIVE = 1e-9
# Far below the smallest curvature along a gap's normal: of redundant active gaps it picks one of the multipliers.
_SHIFT = 1e-13
# Problems a call: enough to hide the call's own cost, few enough that sizes within it are alike.
_CHUNK = {"cpu": 128, "cuda": 2048}
_CORRECTIONS = 8  # of a guessed active set
_SIGN = 1e-10  # violations and multipliers up to this are none, relative to the problem's size


def active_constraints(multipliers: torch.Tensor, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Which variables are free and which gaps active, (N, n) and (N, n_gaps), by multipliers (N, n + n_gaps)."""
    size = multipliers.abs()
    active = size > _ACTIVE * (1.0 + size.amax(dim=1, keepdim=True))
    return ~active[:, :n], active[:, n:]


def solve_on_active_set(
    Q: torch.Tensor, G: torch.Tensor, free: torch.Tensor, on_gap: torch.Tensor, r: torch.Tensor, t: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve the system above.

    :param Q: (n, n) positive definite
    :param G: (n_gaps, n)
    :param free: (N, n) boolean
    :param on_gap: (N, n_gaps) boolean
    :param r: (N, n)
    :param t: (N, n_gaps)
    :return: x (N, n) and nu (N, n_gaps); a problem whose system is singular gets values that are not finite
    """
    order = torch.argsort(free.sum(dim=1) + on_gap.sum(dim=1))
    x, nu = torch.zeros_like(r), torch.zeros_like(t)
    for some in order.split(_CHUNK.get(Q.device.type, len(order) or 1)):
        x[some], nu[some] = _solve_padded(Q, G, free[some], on_gap[some], r[some], t[some])
    return x, nu


def exact_solution(
    condensed: CondensedProblem,
    device: str,
    f: np.ndarray,
    g: np.ndarray,
    at_low: torch.Tensor,
    at_high: torch.Tensor,
    on_gap: torch.Tensor,
) -> tuple[np.ndarray, np.ndarray]:
    """The solution on the active constraints: x (N, n) and multipliers (N, n + n_gaps).

    What is violated then joins the set and what pulls leaves it, as in a primal-dual active-set method, until nothing
    changes or the corrections are spent.
    """

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, device=device)

    Q, G, low, high = (tensor(part) for part in (condensed.Q, condensed.G, condensed.low, condensed.high))
    slope, offset = tensor(f), tensor(g)
    size = _SIGN * (1.0 + slope.abs().amax(dim=1, keepdim=True))
    result_x, result_bound, result_gap = torch.zeros_like(slope), torch.zeros_like(slope), torch.zeros_like(offset)
    todo = torch.arange(len(slope), device=device)
    for _ in range(1 + _CORRECTIONS):
        some_f, some_g, tol = slope[todo], offset[todo], size[todo]
        fixed = at_low | at_high
        at = torch.where(at_low, low, torch.where(at_high, high, 0.0))
        x, nu = solve_on_active_set(Q, G, ~fixed, on_gap, -(some_f + at @ Q), -(some_g + at @ G.mT))
        x = torch.where(fixed, at, x)
        mu = torch.where(fixed, -(some_f + x @ Q + nu @ G), 0.0)
        result_x[todo], result_bound[todo], result_gap[todo] = x, mu, nu
        now = (
            torch.where(at_low, mu < tol, x < low - _SIGN),
            torch.where(at_high, mu > -tol, x > high + _SIGN),
            torch.where(on_gap, nu < tol, x @ G.mT + some_g < -_SIGN),
        )
        changed = torch.cat([now[0] != at_low, now[1] != at_high, now[2] != on_gap], dim=1).any(dim=1)
        todo = todo[changed]
        if not len(todo):
            break
        at_low, at_high, on_gap = (part[changed] for part in now)
    return result_x.cpu().numpy(), torch.cat([result_bound, result_gap], dim=1).cpu().numpy()


def _solve_padded(
    Q: torch.Tensor, G: torch.Tensor, free: torch.Tensor, on_gap: torch.Tensor, r: torch.Tensor, t: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    variables, is_variable = _first(free)
    gaps, is_gap = _first(on_gap)
    n_free, used = variables.shape[1], torch.cat([is_variable, is_gap], dim=1)
    system = Q.new_zeros(len(free), used.shape[1], used.shape[1])
    system[:, :n_free, :n_free] = Q[variables[:, :, None], variables[:, None, :]]
    coupling = G[gaps[:, :, None], variables[:, None, :]]
    system[:, n_free:, :n_free], system[:, :n_free, n_free:] = coupling, coupling.mT
    system *= used[:, :, None] & used[:, None, :]
    system.diagonal(dim1=1, dim2=2).add_((~used).to(system.dtype))
    rhs = torch.cat([r.gather(1, variables), t.gather(1, gaps)], dim=1) * used
    shifted = system.clone()
    shifted.diagonal(dim1=1, dim2=2)[:, n_free:].sub_(_SHIFT * is_gap)
    factors = torch.linalg.lu_factor_ex(shifted)
    solved = torch.linalg.lu_solve(factors.LU, factors.pivots, rhs[..., None])
    # one refinement takes the shift out of the solution
    solved += torch.linalg.lu_solve(factors.LU, factors.pivots, rhs[..., None] - system @ solved)
    solved = torch.where((factors.info == 0)[:, None], solved[..., 0], torch.nan)
    x = torch.zeros_like(r).scatter_(1, variables, solved[:, :n_free])
    return x, torch.zeros_like(t).scatter_(1, gaps, solved[:, n_free:])


def _first(mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The indices of the true entries of each row, padded to the most of any row, and which of them are no padding."""
    most = int(mask.sum(dim=1).amax()) if mask.numel() else 0
    index = torch.argsort(mask.to(torch.int8), dim=1, descending=True, stable=True)[:, :most]
    return index, mask.gather(1, index)
