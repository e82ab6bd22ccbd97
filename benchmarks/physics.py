"""How far each engine is from the exact equations of motion, and from the other, by physics step.

    python -m benchmarks.physics

The exact motion is integrated by SciPy to 1e-12 (:func:`contact_envs.dynamics.integrate`).
"""

from __future__ import annotations

import argparse
import contextlib
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from contact_envs.dynamics import CartPoleParameters, integrate
from contact_envs.simulators import SIMULATORS, simulator_class

CONTROL_STEP = 0.01
PHYSICS_STEPS = (0.002, 0.001, 0.0005)
# name: start (x, x_dot, theta, theta_dot), force in N, control steps
CASES: dict[str, tuple[list[float], float, int]] = {
    "free flight": ([0.0, 0.5, 0.1, 0.5], 3.0, 20),
    "impact right": ([0.15, 0.8, 0.15, 0.5], 0.0, 25),
    "impact left": ([-0.2, -0.4, -0.1, -1.0], -2.0, 25),
}


def final_state(engine: str, physics_step: float, start: Sequence[float], force: float, steps: int) -> np.ndarray:
    """The state (4,) an engine ends in."""
    substeps = round(CONTROL_STEP / physics_step)
    with contextlib.closing(simulator_class(engine)(CartPoleParameters(), physics_step, substeps)) as simulator:
        simulator.reset(np.array(start))
        for _ in range(steps):
            state, _ = simulator.step(force)
    return state


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/physics.csv"))
    args = parser.parse_args(argv)
    lines: list[list[str]] = [["case", "engine", "against", "physics_step", "x", "x_dot", "theta", "theta_dot"]]
    for case, (start, force, steps) in CASES.items():
        exact = integrate(start, force, steps * CONTROL_STEP)
        for physics_step in PHYSICS_STEPS:
            found = {engine: final_state(engine, physics_step, start, force, steps) for engine in SIMULATORS}
            first, second = found
            pairs = [(engine, "exact", state - exact) for engine, state in found.items()]
            pairs.append((first, second, found[first] - found[second]))
            for engine, against, difference in pairs:
                errors = [f"{error:.2e}" for error in np.abs(difference)]
                lines.append([case, engine, against, str(physics_step), *errors])
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)
    for line in lines:
        print("".join(f"{entry:<14}" for entry in line))


if __name__ == "__main__":
    main()
