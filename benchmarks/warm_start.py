"""Where the active-set method should start: its iterations and time by the first guess of the active constraints.

    python -m benchmarks.warm_start

States along the oracle's rollouts on PyBullet, in the order in which a controller meets them, and the same problems for
every guess: none at all, the contact mode of the nominal (what the solver does), and the active set of the plan before,
moved on by one step.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter

import daqp
import gymnasium as gym
import numpy as np

from benchmarks.references import oracle_controller
from benchmarks.solver_problems import first_pass
from sb3_mpc_policy import LcsMpc
from sb3_mpc_policy.solvers.condensed import CondensedProblem
from sb3_mpc_policy.solvers.daqp import ACTIVE_AT_LOWER, ACTIVE_AT_UPPER, OPTIMAL, guessed_active_set

ENVIRONMENTS = ("CartPoleSoftWallsPyBullet-v0", "CartPoleSoftWallsHardPyBullet-v0")
HORIZONS = (10, 20)
HEADER = ["environment", "horizon", "guess", "problems", "iterations_mean", "iterations_max", "us_a_problem"]
_UNBOUNDED = 1e30


def visited(env_id: str, controller: LcsMpc, n_episodes: int, n_steps: int) -> np.ndarray:
    """(N, n_x) the states of rollouts under the controller, environment units."""
    states = []
    with gym.make(env_id) as env:
        for seed in range(n_episodes):
            observation, _ = env.reset(seed=seed)
            for _ in range(n_steps):
                states.append(np.asarray(observation, dtype=np.float64))
                observation, _, terminated, _, _ = env.step(controller.plan(states[-1]).actions[0, 0])
                if terminated:
                    break
    return np.array(states)


def moved_on(active: np.ndarray, horizon: int, n_actions: int, n_contacts: int) -> np.ndarray:
    """A plan's flags (n_constraints,) for the plan one step later: without the first step, with the last one twice."""
    blocks = np.split(active, [horizon * n_actions, horizon * (n_actions + n_contacts)])
    steps = [block.reshape(horizon, -1) for block in blocks]
    return np.concatenate([np.vstack([step[1:], step[-1:]]).ravel() for step in steps])


def measure(env_id: str, horizon: int, n_episodes: int, n_steps: int) -> list[list[str]]:
    """A row for each guess."""
    controller = oracle_controller(env_id, horizon=horizon)
    problem, s0, weights = first_pass(controller, visited(env_id, controller, n_episodes, n_steps))
    condensed = CondensedProblem(problem)
    slope, gaps = condensed.slope(s0, weights), condensed.gap_offset(s0)
    lower = np.hstack([np.broadcast_to(condensed.low, slope.shape), -gaps])
    upper = np.minimum(np.concatenate([condensed.high, np.full(gaps.shape[1], np.inf)]), _UNBOUNDED)
    contact_mode = guessed_active_set(condensed, weights)
    _, n_actions, n_contacts = problem.sizes
    guesses: dict[str, Callable[[int, np.ndarray], np.ndarray]] = {
        "none": lambda i, before: np.zeros_like(before),
        "contact mode": lambda i, before: contact_mode[i],
        "previous plan": lambda i, before: moved_on(before, horizon, n_actions, n_contacts),
    }
    rows = []
    for name, guess in guesses.items():
        model = daqp.Model()
        model.setup(condensed.Q, slope[0], condensed.G, upper, lower[0], contact_mode[0].copy())
        before, iterations, seconds = contact_mode[0], [], 0.0
        for i in range(len(s0)):
            first = guess(i, before)
            begun = perf_counter()
            model.update(f=slope[i], blower=lower[i], sense=first)
            _, _, flag, info = model.solve()
            seconds += perf_counter() - begun
            if flag != OPTIMAL:
                raise RuntimeError(f"DAQP ended with flag {flag} on problem {i} of {env_id}, horizon {horizon}")
            iterations.append(info["iterations"])
            at_upper = np.where(info["lam"] > 1e-9, ACTIVE_AT_UPPER, 0)
            before = np.where(info["lam"] < -1e-9, ACTIVE_AT_LOWER, at_upper).astype(np.intc)
        figures = [f"{np.mean(iterations):.1f}", str(max(iterations)), f"{1e6 * seconds / len(s0):.1f}"]
        rows.append([env_id, str(horizon), name, str(len(s0)), *figures])
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--steps", type=int, default=100, help="of each episode, at most")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/warm_start.csv"))
    args = parser.parse_args(argv)
    lines = [HEADER]
    for env_id in ENVIRONMENTS:
        for horizon in HORIZONS:
            lines += measure(env_id, horizon, args.episodes, args.steps)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)
    for line in lines:
        print("  ".join(f"{entry:<16}" for entry in line))


if __name__ == "__main__":
    main()
