"""The benchmark of identification measures what it says, and the published losses are what they are named after."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from benchmarks import contact_identification as benchmark
from benchmarks import identification_rivals as rivals


def test_every_method_gets_a_row_and_ours_learns(tmp_path: Path) -> None:
    path = tmp_path / "result.csv"
    settings = ["--settings", "1,400,0.5", "4,5000,0.5", "--trials", "1", "--rival-trials", "1"]
    benchmark.main([*settings, "--iterations", "3", "--rival-iterations", "2", "--output", str(path)])
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["n_lambda"], row["method"]) for row in rows} == {
        (n, method) for n in "14" for method in [benchmark.OURS, *rivals.RIVALS]
    }
    for row in rows:
        if row["method"] == benchmark.OURS:
            assert 1.0 <= float(row["ratio"]) < 1.1
            assert float(row["error"]) < 0.5
        else:
            assert int(row["iterations"]) == (3 if row["n_lambda"] == "4" else 2)
            assert float(row["ratio"]) > 10.0


def test_the_true_model_has_no_error_and_a_ratio_of_one() -> None:
    true = benchmark.predictor(benchmark.random_system(benchmark.BASE, np.random.default_rng(0)))
    assert benchmark.errors(true, true, np.random.default_rng(1)) == (0.0, 1.0, 0.0, 1.0)


def test_an_error_as_large_as_the_noise_counts_one() -> None:
    true = benchmark.predictor(benchmark.random_system(benchmark.BASE, np.random.default_rng(0)))
    error, ratio, _, _ = benchmark.errors(lambda s, a: true(s, a) + benchmark.NOISE, true, np.random.default_rng(1))
    assert error == pytest.approx(1.0)
    assert ratio == pytest.approx(np.sqrt(2.0), rel=0.03)


def test_systems_have_the_published_form() -> None:
    for n_lambda, stiffness in ((1, 5.0), (4, 0.005), (16, 0.5)):
        setting = benchmark.Setting(n_lambda, 10, stiffness)
        system = benchmark.random_system(setting, np.random.default_rng(n_lambda))
        assert np.linalg.eigvalsh(system.F + system.F.T).min() >= 2.0 * stiffness - 1e-9
        assert np.abs(np.linalg.eigvals(system.A)).max() <= benchmark.SPECTRAL_RADIUS + 1e-12
        assert (system.C.shape, system.E.shape) == ((4, n_lambda), (n_lambda, 2))


def random_lcs() -> tuple[rivals._Lcs, torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    lcs = rivals._Lcs(3, 1, 2)
    z = torch.randn(5, 5, dtype=torch.float64)
    return lcs, z, torch.randn(5, 3, dtype=torch.float64)


def test_the_violation_loss_is_the_minimum_over_forces_and_gaps() -> None:
    lcs, z, s_next = random_lcs()
    smooth, C, P, F = (part.detach().numpy() for part in (lcs.smooth, lcs.C, lcs.P, lcs.F))

    def violation(x: np.ndarray, row: np.ndarray, target: np.ndarray) -> float:
        lam, phi = x[:2], x[2:]
        error = np.square(smooth @ row + C @ lam - target).sum()
        return error + (lam @ phi + np.square(P @ row + F @ lam - phi).sum() / 1e-2) / 1e-4

    least = [
        minimize(
            violation, np.ones(4), (row, target), "L-BFGS-B", bounds=[(0.0, None)] * 4,
            options={"ftol": 1e-15, "gtol": 1e-10, "maxiter": 5000, "maxfun": 100_000},
        ).fun
        for row, target in zip(z.numpy(), s_next.numpy(), strict=True)
    ]  # fmt: skip
    expected = np.mean(least) + 1e-6 * np.square(C).sum()
    assert rivals._violation_loss(lcs, z, s_next).item() == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("loss", [rivals._prediction_loss, rivals._violation_loss])
def test_gradients_are_those_of_central_differences(loss: rivals.Loss) -> None:
    lcs, z, s_next = random_lcs()
    loss(lcs, z, s_next).backward()
    for parameter in lcs.parameters():
        flat = parameter.data.view(-1)
        for i, gradient in enumerate(parameter.grad.view(-1).tolist()):
            at, values = flat[i].item(), []
            for step in (1e-6, -1e-6):
                flat[i] = at + step
                values.append(loss(lcs, z, s_next).item())
            flat[i] = at
            assert gradient == pytest.approx((values[0] - values[1]) / 2e-6, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("method", rivals.RIVALS)
def test_rivals_learn(method: str) -> None:
    setting = benchmark.Setting(1, 500, 0.5)
    early, late = (benchmark.run_trial(setting, method, 0, iterations) for iterations in (5, 500))
    assert late.error < 0.7 * early.error
