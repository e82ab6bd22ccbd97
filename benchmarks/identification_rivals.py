"""Other ways to learn a contact model from transitions, with the settings they were published with.

The two losses, their learning rates, batches, initial values and the constants below are those of the public
evaluations of Jin, Aydinoglu, Halm and Posa, "Learning Linear Complementarity Systems" (L4DC 2022;
DAIRLab/Learning-LCS, ``evaluations/vary_dim_lam/run_train.py``). Everything is in the data's own units, as there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from sb3_mpc_policy.lcp import LcpSolver, solve_lcp

__all__ = ["RIVALS", "Predictor"]

Predictor = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(s, a) -> s_next, in rows"""

BATCH = 200
_MAGNITUDE = 0.1  # of the initial parameters
_LEAST_F = 1.0  # the learner's F is G Gᵀ + I + H − Hᵀ
_GAMMA, _EPSILON = 1e-2, 1e-4
_PREDICTION_RATE, _VIOLATION_RATE, _NETWORK_RATE = 1e-3, 5e-3, 1e-3
_C_PENALTY = 1e-6


class _Lcs(nn.Module):
    """The LCS in the parameters of the publication: all random, G lower triangular."""

    def __init__(self, n_x: int, n_a: int, n_lambda: int) -> None:
        super().__init__()

        def random(*shape: int) -> nn.Parameter:
            return nn.Parameter(_MAGNITUDE * torch.randn(*shape, dtype=torch.float64))

        self.smooth, self.C = random(n_x, n_x + n_a + 1), random(n_x, n_lambda)
        self.P = random(n_lambda, n_x + n_a + 1)
        self.G, self.H = random(n_lambda, n_lambda), random(n_lambda, n_lambda)

    @property
    def F(self) -> torch.Tensor:
        G = torch.tril(self.G)
        return G @ G.mT + _LEAST_F * torch.eye(len(G), dtype=G.dtype) + self.H - self.H.mT

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        return z @ self.smooth.mT + solve_lcp(self.F, z @ self.P.mT) @ self.C.mT


def _prediction_loss(lcs: _Lcs, z: torch.Tensor, s_next: torch.Tensor) -> torch.Tensor:
    """Eq (12)."""
    error = (lcs(z) - s_next).square().sum(dim=1).mean()
    return error + _C_PENALTY * lcs.C.square().sum()


def _violation_loss(lcs: _Lcs, z: torch.Tensor, s_next: torch.Tensor) -> torch.Tensor:
    """min over lam, phi >= 0 of |error|² + (lamᵀ phi + |P z + F lam − phi|² / gamma) / epsilon, envelope gradient."""
    F, q = lcs.F, z @ lcs.P.mT
    free_error = z @ lcs.smooth.mT - s_next
    n = F.shape[0]
    with torch.no_grad():
        identity = torch.eye(n, dtype=F.dtype)
        # half of epsilon times the objective is ½ xᵀ H x + gᵀ x in x = (lam, phi)
        mixed = identity / 2 - F.mT / _GAMMA
        upper = torch.cat([_EPSILON * lcs.C.mT @ lcs.C + F.mT @ F / _GAMMA, mixed], dim=1)
        H = torch.cat([upper, torch.cat([mixed.mT, identity / _GAMMA], dim=1)])
        g = torch.cat([_EPSILON * free_error @ lcs.C + q @ F / _GAMMA, -q / _GAMMA], dim=1)
        x, _ = LcpSolver(H.numpy())(g.numpy())
        lam, phi = torch.as_tensor(x).split(n, dim=1)
    error = (free_error + lam @ lcs.C.mT).square().sum(dim=1)
    violation = (lam * phi).sum(dim=1) + (q + lam @ F.mT - phi).square().sum(dim=1) / _GAMMA
    return (error + violation / _EPSILON).mean() + _C_PENALTY * lcs.C.square().sum()


def _network_loss(network: nn.Module, z: torch.Tensor, s_next: torch.Tensor) -> torch.Tensor:
    return (network(z) - s_next).square().sum(dim=1).mean()


Loss = Callable[..., torch.Tensor]


def _adam(
    model: nn.Module, loss: Loss, z: torch.Tensor, y: torch.Tensor, rate: float, iterations: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(model.parameters(), lr=rate)
    for _ in range(iterations):
        batch = torch.as_tensor(rng.permutation(len(z))[:BATCH])
        optimizer.zero_grad()
        loss(model, z[batch], y[batch]).backward()
        optimizer.step()


def _inputs(s: np.ndarray, a: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.hstack([s, a, np.ones((len(s), 1))]))


def _learned_lcs(loss: Loss, rate: float) -> Callable[..., Predictor]:
    def learn(s: np.ndarray, a: np.ndarray, s_next: np.ndarray, n_lambda: int, iterations: int, seed: int) -> Predictor:
        torch.manual_seed(seed)
        lcs = _Lcs(s.shape[1], a.shape[1], n_lambda)
        _adam(lcs, loss, _inputs(s, a), torch.as_tensor(s_next), rate, iterations, seed)

        @torch.no_grad()
        def predict(s: np.ndarray, a: np.ndarray) -> np.ndarray:
            return lcs(_inputs(s, a)).numpy()

        return predict

    return learn


def _learned_network(
    s: np.ndarray, a: np.ndarray, s_next: np.ndarray, n_lambda: int, iterations: int, seed: int
) -> Predictor:
    """One hidden layer of rectifiers with as many parameters as the LCS, inputs and outputs whitened."""
    torch.manual_seed(seed)
    n_x, n_in = s.shape[1], s.shape[1] + a.shape[1]
    n_parameters = sum(parameter.numel() for parameter in _Lcs(n_x, a.shape[1], n_lambda).parameters())
    hidden = max(1, round((n_parameters - n_x) / (n_in + 1 + n_x)))
    network = nn.Sequential(nn.Linear(n_in, hidden), nn.ReLU(), nn.Linear(hidden, n_x)).double()
    inputs = np.hstack([s, a])
    mean, size, middle, spread = inputs.mean(axis=0), inputs.std(axis=0), s_next.mean(axis=0), s_next.std(axis=0)
    z, y = torch.as_tensor((inputs - mean) / size), torch.as_tensor((s_next - middle) / spread)
    _adam(network, _network_loss, z, y, _NETWORK_RATE, iterations, seed)

    @torch.no_grad()
    def predict(s: np.ndarray, a: np.ndarray) -> np.ndarray:
        return network(torch.as_tensor((np.hstack([s, a]) - mean) / size)).numpy() * spread + middle

    return predict


RIVALS: dict[str, Callable[..., Predictor]] = {
    "eq (12)": _learned_lcs(_prediction_loss, _PREDICTION_RATE),
    "violation": _learned_lcs(_violation_loss, _VIOLATION_RATE),
    "network": _learned_network,
}
"""all by Adam; name: ``learn(s, a, s_next, n_lambda, iterations, seed)`` -> predictor"""
