"""What the solver's speed comes to in a policy: how long an action takes, and the controller's share of training.

Called by ``python -m benchmarks.solver_speed --latency --training``.
"""

from __future__ import annotations

import contextlib
import csv
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from rich.box import SIMPLE_HEAD
from rich.table import Table
from stable_baselines3 import PPO
from torch.autograd.function import once_differentiable

from benchmarks.references import cart_pole
from sb3_mpc_policy import LinearComplementaritySystem, MpcLcsPolicy, hyperparams
from sb3_mpc_policy.lcs import LcsMatrices
from sb3_mpc_policy.problem import ComplementarityWeights, RelaxedProblem
from sb3_mpc_policy.solvers import Solution, Solver

__all__ = ["Line", "latency", "run", "training"]

LATENCY_ENVS = ("CartPoleSoftWallsPyBullet-v0", "CartPoleSoftWallsHardPyBullet-v0")
LATENCY_HORIZONS = (10, None)
"""None is the tuned one."""
TRAINING_ENV = "CartPoleSoftWalls-v0"


class Line(NamedTuple):
    """One line of the result file."""

    measurement: str
    environment: str
    quantity: str
    value: float
    unit: str


# -- one action --


def policy_with_true_model(env_id: str, env: gym.Env, horizon: int | None = None) -> PPO:
    """The tuned policy, untrained, which starts from the environment's true LCS.

    :param horizon: in place of the tuned one
    """
    settings = hyperparams(env_id)
    arguments: dict[str, Any] = settings.pop("policy_kwargs")
    if horizon is not None:
        arguments["horizon"] = horizon
    with cart_pole(env_id) as plant:
        matrices = plant.true_lcs()
    model = LinearComplementaritySystem.from_matrices(*matrices, state_scale=arguments.pop("state_scale"))
    return PPO("MpcLcsPolicy", env, device="cpu", policy_kwargs=arguments | {"initial_lcs": model}, **settings)


def latency(env_id: str, n_states: int = 10_000, horizon: int | None = None) -> list[Line]:
    """Of ``model.predict`` for one state: over the states of rollouts under that policy.

    :param env_id: a registered cart-pole
    :param n_states: states
    :param horizon: in place of the tuned one
    """
    with contextlib.closing(gym.make(env_id)) as env:
        model = policy_with_true_model(env_id, env, horizon)
        policy = model.policy
        assert isinstance(policy, MpcLcsPolicy)
        observation, _ = env.reset(seed=0)
        model.predict(observation, deterministic=True)  # what is done once
        seconds = np.empty(n_states)
        for i in range(n_states):
            begun = time.perf_counter()
            action, _ = model.predict(observation, deterministic=True)
            seconds[i] = time.perf_counter() - begun
            observation, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                observation, _ = env.reset()
    values = {"p50": np.percentile(seconds, 50), "p99": np.percentile(seconds, 99), "longest": seconds.max()}
    at = f"H = {policy.mpc.horizon}"
    return [Line("latency", env_id, f"{name}, {at}", float(value), "s") for name, value in values.items()] + [
        Line("latency", env_id, f"states, {at}", n_states, "")
    ]


# -- training --


class Stopwatch:
    """Seconds by what they were spent on."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextlib.contextmanager
    def on(self, what: str) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        self.seconds[what] += time.perf_counter() - begun

    def watch(self, owner: object, name: str, what: str) -> None:
        """Count every call of a method."""
        method = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.on(what):
                return method(*args, **kwargs)

        setattr(owner, name, timed)


class TimedSolver(Solver):
    """Another solver, with the time its backward passes take."""

    def __init__(self, solver: Solver, stopwatch: Stopwatch) -> None:
        self.solver, self.stopwatch = solver, stopwatch

    def solve(self, problem: RelaxedProblem, s0: np.ndarray, weights: ComplementarityWeights) -> Solution:
        with self.stopwatch.on("controller, of which in the solver"):
            return self.solver.solve(problem, s0, weights)

    def differentiable_actions(
        self,
        problem: RelaxedProblem,
        model: LcsMatrices[torch.Tensor],
        s0: torch.Tensor,
        weights: ComplementarityWeights,
        solution: Solution,
    ) -> torch.Tensor:
        return _TimedActions.apply(self, problem, weights, solution, s0, *model)


class _TimedActions(torch.autograd.Function):
    """The solver's own graph inside one node, whose backward pass can be timed."""

    @staticmethod
    def forward(
        ctx: Any,
        timed: TimedSolver,
        problem: RelaxedProblem,
        weights: ComplementarityWeights,
        solution: Solution,
        *inputs: torch.Tensor,
    ) -> torch.Tensor:
        ctx.leaves = [one.detach().requires_grad_() for one in inputs]
        with torch.enable_grad():
            s0, *model = ctx.leaves
            ctx.actions = timed.solver.differentiable_actions(problem, LcsMatrices(*model), s0, weights, solution)
        ctx.stopwatch = timed.stopwatch
        return ctx.actions.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> Any:
        with ctx.stopwatch.on("controller, backward"):
            return (None,) * 4 + torch.autograd.grad(ctx.actions, ctx.leaves, grad, allow_unused=True)


def training(env_id: str, steps: int = 2_000, seed: int = 0) -> list[Line]:
    """Where the time of a training run with the tuned settings goes.

    "All else" is Stable-Baselines3's own work, the critic, and the backward pass of the prediction loss.

    :param env_id: a registered environment with tuned settings
    :param steps: environment steps
    :param seed: of the run
    """
    stopwatch = Stopwatch()
    with contextlib.closing(gym.make(env_id)) as env:
        model = PPO("MpcLcsPolicy", env, seed=seed, device="cpu", **hyperparams(env_id))
        policy = model.policy
        assert isinstance(policy, MpcLcsPolicy)
        policy.mpc.solver = TimedSolver(policy.mpc.solver, stopwatch)
        stopwatch.watch(policy.mpc, "forward", "controller, forward")
        stopwatch.watch(policy, "prediction_loss", "prediction loss, forward")
        stopwatch.watch(policy, "end_update", "model fit")
        for name in ("step", "reset"):
            stopwatch.watch(env.unwrapped, name, "simulator")
        begun = time.perf_counter()
        model.learn(steps)
        total = time.perf_counter() - begun
    seconds = dict(stopwatch.seconds)
    parts = {name: value for name, value in seconds.items() if "of which" not in name}
    seconds["all else"] = total - sum(parts.values())
    controller = parts["controller, forward"] + parts.get("controller, backward", 0.0)
    return [
        Line("training", env_id, "environment steps", steps, ""),
        Line("training", env_id, "total", total, "s"),
        Line("training", env_id, "controller's share", controller / total, ""),
        *(Line("training", env_id, name, value, "s") for name, value in sorted(seconds.items())),
    ]


# -- files --


def run(path: Path, with_latency: bool, with_training: bool, n_states: int = 10_000, steps: int = 2_000) -> Table:
    """Measure, write, and return the table for the terminal. What is not measured stays in the file as it was.

    :param path: of the result file
    """
    lines = []
    for wanted, measurement in ((with_latency, "latency"), (with_training, "training")):
        if not wanted:
            lines += [line for line in _read(path) if line.measurement == measurement]
        elif measurement == "latency":
            for env_id, horizon in product(LATENCY_ENVS, LATENCY_HORIZONS):
                lines += latency(env_id, n_states, horizon)
        else:
            lines += training(TRAINING_ENV, steps)
    _write(path, lines)
    table = Table(title="Speed of the policy", box=SIMPLE_HEAD, padding=0)
    for name in Line._fields[:3]:
        table.add_column(name, overflow="fold", no_wrap=name == "environment")
    table.add_column("value", justify="right", no_wrap=True)
    for line in lines:
        scale, unit = (1e3, "ms") if line.unit == "s" and line.value < 0.1 else (1.0, line.unit)
        table.add_row(*line[:3], f"{scale * line.value:,.3f} {unit}" if unit else f"{line.value:,.4g}")
    return table


def _read(path: Path) -> list[Line]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [
            Line(line["measurement"], line["environment"], line["quantity"], float(line["value"]), line["unit"])
            for line in csv.DictReader(file)
        ]


def _write(path: Path, lines: Sequence[Line]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Line._fields)
        for line in lines:
            writer.writerow(line._replace(value=float(f"{line.value:.4g}")))
