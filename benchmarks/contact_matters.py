"""How much contact decides: the oracle's score beside that of LQR, which knows the true model without its contacts.

    python -m benchmarks.contact_matters

For the cart-pole as registered, and for the acrobot also with each of its numbers changed: what its defaults were
chosen by.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

import sb3_mpc_policy  # noqa: F401 - registers the environments
from benchmarks.evaluation import RESET_SEEDS, Evaluator
from benchmarks.references import lqr, oracle

ACROBOT = "AcrobotSoftLimitsPyBullet-v0"
CASES: list[tuple[str, dict[str, Any]]] = [
    ("CartPoleSoftWallsPyBullet-v0", {}),
    ("CartPoleSoftWallsHardPyBullet-v0", {}),
    (ACROBOT, {}),
    (ACROBOT, {"reset_range": (0.03, 0.03, 0.05, 0.05)}),
    (ACROBOT, {"reset_range": (0.1, 0.1, 0.2, 0.2)}),
    (ACROBOT, {"max_torque": 5.0}),
    (ACROBOT, {"max_torque": 20.0}),
    (ACROBOT, {"parameters": {"limit_stiffness": 100.0}}),
    (ACROBOT, {"parameters": {"limit_stiffness": 1000.0}}),
    (ACROBOT, {"parameters": {"limit_angle": 0.1}}),
]


def changed(env_id: str, changes: dict[str, Any]) -> EnvSpec:
    """A registered environment with other arguments."""
    spec = copy.deepcopy(gym.spec(env_id))
    spec.kwargs.update(changes)
    return spec


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=len(RESET_SEEDS), help="scored episodes")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/contact_matters.csv"))
    args = parser.parse_args(argv)
    lines = [["env", "changed", "lqr", "oracle", "lqr_lowest", "oracle_lowest"]]
    for env_id, changes in CASES:
        spec = changed(env_id, changes)
        with contextlib.closing(Evaluator(spec, args.episodes)) as evaluator:
            returns = [evaluator.returns(controller) for controller in (lqr(spec), oracle(spec))]
        scores = [f"{of_one.mean():.0f}" for of_one in returns] + [f"{of_one.min():.0f}" for of_one in returns]
        label = " ".join(f"{name}={value}" for name, value in changes.items())
        lines.append([env_id, label, *scores])
        print("  ".join(lines[-1]), flush=True)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)


if __name__ == "__main__":
    main()
