"""Models and reference computations that several tests share."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain, combinations

import numpy as np
import pytest
import torch

from contact_envs.dynamics import true_lcs
from sb3_mpc_policy.lcs import LinearComplementaritySystem

ModelFactory = Callable[..., LinearComplementaritySystem]


def _enumerate_lcp(F: np.ndarray, q: np.ndarray) -> np.ndarray:
    size = len(q)
    for active in chain.from_iterable(combinations(range(size), count) for count in range(size + 1)):
        lam, rows = np.zeros(size), list(active)
        if rows:
            lam[rows] = np.linalg.solve(F[np.ix_(rows, rows)], -q[rows])
        if (lam >= -1e-12).all() and (F @ lam + q >= -1e-12 * (1.0 + np.abs(q).max(initial=0.0))).all():
            return lam
    raise AssertionError("no active set fits")


@pytest.fixture
def enumerate_lcp() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The solution lam (n,) of one linear complementarity problem (F, q), by trying every active set."""
    return _enumerate_lcp


@pytest.fixture
def central_difference() -> Callable[..., np.ndarray]:
    """``(function, x, step)``: the gradient of a number with respect to the array x, entry by entry."""

    def gradient(function: Callable[[np.ndarray], float], x: np.ndarray, step: float = 1e-6) -> np.ndarray:
        result = np.zeros_like(x)
        for index in np.ndindex(x.shape):
            moved = np.zeros_like(x)
            moved[index] = step
            result[index] = (function(x + moved) - function(x - moved)) / (2.0 * step)
        return result

    return gradient


@pytest.fixture
def parameter_gradients() -> Callable[..., dict[str, np.ndarray]]:
    """``(module, function, step)``: the gradient of a number with respect to each parameter of the module."""

    @torch.no_grad()
    def gradients(module: torch.nn.Module, function: Callable[[], float], step: float = 1e-6) -> dict[str, np.ndarray]:
        result = {}
        for name, parameter in module.named_parameters():
            flat, entries = parameter.view(-1), np.zeros(parameter.numel())
            for i in range(parameter.numel()):
                at = flat[i].item()
                flat[i] = at + step
                above = function()
                flat[i] = at - step
                entries[i] = (above - function()) / (2.0 * step)
                flat[i] = at
            result[name] = entries.reshape(tuple(parameter.shape))
        return result

    return gradients


@pytest.fixture
def cart_pole() -> ModelFactory:
    """The cart-pole between soft walls, linearised; n_lambda = 2. Keywords go to ``true_lcs``."""

    def make(**arguments: float) -> LinearComplementaritySystem:
        return LinearComplementaritySystem.from_matrices(*true_lcs(**arguments), state_scale=[0.35, 1.0, 0.3, 1.0])

    return make


@pytest.fixture
def random_model() -> ModelFactory:
    """``(seed, n_x, n_a, n_lambda)``: a random model whose every parameter is away from zero, F asymmetric."""

    def make(seed: int, n_x: int = 3, n_a: int = 1, n_lambda: int = 2) -> LinearComplementaritySystem:
        rng = np.random.default_rng(seed)
        scales = rng.uniform(0.5, 2.0, n_x), rng.uniform(0.5, 2.0, n_a)
        lcs = LinearComplementaritySystem(n_x, n_a, n_lambda, *scales)
        with torch.no_grad():
            for name, parameter in lcs.named_parameters():
                noise = torch.as_tensor(rng.normal(size=tuple(parameter.shape)))
                parameter.copy_(0.3 * noise + (parameter if name in ("A_scaled", "F_factor") else 0.2 * noise.sign()))
        return lcs

    return make
