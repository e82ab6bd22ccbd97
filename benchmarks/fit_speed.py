"""Is all that is fitted between two rollouts done in less time than the rollout took?

    python -m benchmarks.fit_speed

Trains, and takes the processor time of what happens between rollouts besides PPO's own update: contacts, tangent,
reward, regulator. Beside it stands the time that the rollout covers in the real system, ten milliseconds a step.
"""

from __future__ import annotations

import argparse
import csv
import functools
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks import runs
from benchmarks.references import contact_env
from sb3_mpc_policy import MpcLcsPolicy

HEADER = ["env", "seed", "transitions", "fit_seconds", "rollout_seconds"]


class FitTimes(BaseCallback):
    """Processor time of each ``MpcLcsPolicy.end_update`` that has something to fit, beside the transitions known."""

    def _on_training_start(self) -> None:
        policy = self.model.policy
        assert isinstance(policy, MpcLcsPolicy)
        self.times: list[tuple[int, float]] = []
        end_update = policy.end_update

        @functools.wraps(end_update)
        def timed(reward_scale: float = 1.0) -> dict[str, float]:
            begun = time.process_time()
            log = end_update(reward_scale)
            if len(policy.store):
                self.times.append((len(policy.store), time.process_time() - begun))
            return log

        policy.end_update = timed  # type: ignore[method-assign]

    def _on_step(self) -> bool:
        return True


def main(argv: Sequence[str] | None = None) -> list[list[object]]:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["CartPoleSoftWallsHardPyBullet-v0"], metavar="ID")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=3_840)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/fit_speed.csv"))
    args = parser.parse_args(argv)
    lines: list[list[object]] = []
    for env_id in args.env:
        settings, callback = runs.settings_for(env_id, {}), FitTimes()
        with contact_env(env_id) as plant:
            rollout = settings["n_steps"] * settings.get("n_envs", 1) * plant.control_step
        runs.train(env_id, settings, args.seed, args.steps, [callback])
        lines += [[env_id, args.seed, n, f"{seconds:.4f}", f"{rollout:.3g}"] for n, seconds in callback.times]
        seconds = np.array([seconds for _, seconds in callback.times])
        print(
            f"{env_id}: {rollout:.2f} s a rollout; fits take {np.median(seconds):.3f} s (median), "
            f"{np.quantile(seconds, 0.95):.3f} s (95 %), {seconds.max():.3f} s at most"
        )
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with args.output.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([HEADER, *lines])
    return lines


if __name__ == "__main__":
    main()
