"""How far each engine is from the exact equations of motion, and from the other, by physics step.

    python -m benchmarks.physics

The exact motion is integrated by SciPy to 1e-12 (:func:`contact_envs.dynamics.integrate`). The columns are the
joints from the world outwards: the cart-pole's x (m, m/s) and theta (rad, rad/s); the acrobot's shoulder and elbow.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from contact_envs.dynamics import integrate
from contact_envs.plants import AcrobotParameters, CartPoleParameters, Plant
from contact_envs.simulators import SIMULATORS, simulator_class

CONTROL_STEP = 0.01
PHYSICS_STEPS = (0.002, 0.001, 0.0005)
PLANTS: dict[str, Plant] = {"cart-pole": CartPoleParameters(), "acrobot": AcrobotParameters()}
# (plant, name): start in the plant's order, force in N or N m, control steps
CASES: dict[tuple[str, str], tuple[list[float], float, int]] = {
    ("cart-pole", "free flight"): ([0.0, 0.5, 0.1, 0.5], 3.0, 20),
    ("cart-pole", "impact right"): ([0.15, 0.8, 0.15, 0.5], 0.0, 25),
    ("cart-pole", "impact left"): ([-0.2, -0.4, -0.1, -1.0], -2.0, 25),
    ("acrobot", "free fall"): ([0.05, -0.1, 0.5, -1.0], 1.0, 20),
    ("acrobot", "right stop"): ([0.15, -0.2, 1.0, -0.5], 1.0, 25),
    ("acrobot", "left stop"): ([-0.15, 0.1, -1.0, 0.0], -1.0, 25),
}


def final_state(
    engine: str, plant: Plant, physics_step: float, start: Sequence[float], force: float, steps: int
) -> np.ndarray:
    """The state (4,) an engine ends in."""
    substeps = round(CONTROL_STEP / physics_step)
    with contextlib.closing(simulator_class(engine)(plant, physics_step, substeps)) as simulator:
        simulator.reset(np.array(start))
        for _ in range(steps):
            state, _ = simulator.step(force)
    return state


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/physics.csv"))
    args = parser.parse_args(argv)
    columns = ["plant", "case", "engine", "against", "physics_step"]
    columns += ["position_1", "velocity_1", "position_2", "velocity_2"]
    lines: list[list[str]] = [columns]
    for (name, case), (start, force, steps) in CASES.items():
        plant = PLANTS[name]
        exact = integrate(start, force, steps * CONTROL_STEP, plant)
        joint_by_joint = np.stack([plant.POSITIONS, plant.VELOCITIES], axis=1).ravel()
        for physics_step in PHYSICS_STEPS:
            found = {engine: final_state(engine, plant, physics_step, start, force, steps) for engine in SIMULATORS}
            first, second = found
            pairs = [(engine, "exact", state - exact) for engine, state in found.items()]
            pairs.append((first, second, found[first] - found[second]))
            for engine, against, difference in pairs:
                errors = [f"{error:.2e}" for error in np.abs(difference)[joint_by_joint]]
                lines.append([name, case, engine, against, str(physics_step), *errors])
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)
    for line in lines:
        print("".join(f"{entry:<14}" for entry in line))


if __name__ == "__main__":
    main()
