"""The evaluation protocol: what a policy's score is, and when a training run counts as solved and held.

- *Score*: mean undiscounted return of the deterministic policy over :data:`RESET_SEEDS`.
- *Solved*: an evaluation scores at least 95 % of the oracle, the same controller that knows the true model
  (:mod:`benchmarks.references`).
- *Rollouts to solve*: training episodes begun, finished or not, when an evaluation first meets it.
- *Held*: no later evaluation of the run drops under 90 %.

Evaluation does not touch training: it has its own environments, and leaves every random state as it found it.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
import random
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeGuard

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

Controller = Callable[[np.ndarray], np.ndarray]
"""Observations (N, n_x) of N independent episodes -> actions (N, n_a), environment units."""

RESET_SEEDS = range(1_000_000, 1_000_050)
"""Reset seeds of the scored episodes. Training seeds its environments with far smaller numbers."""

SOLVED, HELD = 0.95, 0.90
"""Fractions of the oracle's score."""


class Evaluation(NamedTuple):
    """One evaluation during a training run."""

    steps: int
    """Environment steps taken so far, over all parallel environments."""
    rollouts: int
    """Training episodes begun so far, finished or not; an episode begins with its first step."""
    seconds: float
    """Wall-clock time of training so far, without evaluations."""
    score: float
    """Mean undiscounted return."""


class Evaluator:
    """Scores controllers on the fixed episodes; holds the environments, so that it can be used many times.

    All episodes run in lockstep, one environment an episode, so that a controller sees one batch a step;
    episodes that are over leave the batch.

    :param env_id: a registered environment with a Box action space, or a specification of one with other arguments
    :param n_episodes: the first so many of :data:`RESET_SEEDS`
    :raises ValueError: ``n_episodes`` is out of range, or the action space is not a Box
    """

    def __init__(self, env_id: str | EnvSpec, n_episodes: int = len(RESET_SEEDS)) -> None:
        if not 1 <= n_episodes <= len(RESET_SEEDS):
            raise ValueError(f"n_episodes must be in 1..{len(RESET_SEEDS)}, got {n_episodes!r}")
        self.envs = [gym.make(env_id) for _ in range(n_episodes)]
        if not isinstance(self.envs[0].action_space, gym.spaces.Box):
            raise ValueError(f"env_id must name an environment with a Box action space, got {env_id!r}")
        self.action_space = self.envs[0].action_space
        self.seeds = RESET_SEEDS[:n_episodes]

    def returns(self, controller: Controller) -> np.ndarray:
        """Undiscounted returns (n_episodes,), in the order of the reset seeds.

        :param controller: its actions are clipped to the action space
        """
        space = self.action_space
        observations = np.array([env.reset(seed=s)[0] for env, s in zip(self.envs, self.seeds, strict=True)])
        returns = np.zeros(len(self.envs))
        alive = np.arange(len(self.envs))
        while len(alive):
            actions = np.clip(controller(observations[alive]), space.low, space.high).astype(space.dtype)
            going_on = []
            for episode, action in zip(alive, actions, strict=True):
                observations[episode], reward, terminated, truncated, _ = self.envs[episode].step(action)
                returns[episode] += float(reward)
                going_on.append(not (terminated or truncated))
            alive = alive[going_on]
        return returns

    def score(self, controller: Controller) -> float:
        """Mean undiscounted return."""
        return float(self.returns(controller).mean())

    def close(self) -> None:
        """Close the environments."""
        for env in self.envs:
            env.close()


def score(policy: Controller | BaseAlgorithm, env_id: str, n_episodes: int = len(RESET_SEEDS)) -> float:
    """Score a trained model or any other controller.

    :param policy: a Stable-Baselines3 model, or a :data:`Controller`
    :param env_id: see :class:`Evaluator`
    :param n_episodes: see :class:`Evaluator`
    """
    with contextlib.closing(Evaluator(env_id, n_episodes)) as evaluator:
        return evaluator.score(controller_of(policy) if isinstance(policy, BaseAlgorithm) else policy)


def controller_of(model: BaseAlgorithm) -> Controller:
    """The deterministic policy of a model, with the observation normalisation it is trained with, if any.

    It is a copy of the present policy: a solver that starts from its last solution would otherwise carry a
    trace of the evaluation, of the size of rounding errors, into training.
    """
    normalisation = model.get_vec_normalize_env()
    # A distribution holds tensors of the last forward pass: torch refuses a deep copy, nobody needs one.
    # It belongs to the policy in on-policy algorithms, to its actor in the others.
    distributions = [part.action_dist for part in model.policy.modules() if hasattr(part, "action_dist")]
    policy = copy.deepcopy(model.policy, memo={id(each): copy.copy(each) for each in distributions})

    def act(observations: np.ndarray) -> np.ndarray:
        seen = observations if normalisation is None else normalisation.normalize_obs(observations)
        return policy.predict(seen, deterministic=True)[0]

    return act


@contextlib.contextmanager
def random_state_kept() -> Iterator[None]:
    """The global random states of Python, NumPy and torch are the same after the block as before it."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002 - Stable-Baselines3 uses this one
    with torch.random.fork_rng():
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy)  # noqa: NPY002


class Phase(NamedTuple):
    """A part of a training run, and how often it is evaluated."""

    until: int | None
    """Environment steps at which the part ends; None: when training does."""
    every: int
    """Environment steps from one evaluation to the next."""


def evaluation_schedule(every: int | Sequence[Sequence[int | None]]) -> tuple[Phase, ...]:
    """The one form of what may be said in two.

    :param every: environment steps, or pairs (until, every), such as ``[[1280, 128], [None, 1280]]``: every 128 steps
        in the first 1,280, then every 1,280
    :raises ValueError: no such thing
    """
    pairs: Sequence[Any] = [(None, every)] if isinstance(every, int) else every
    try:
        phases = tuple(Phase(*pair) for pair in pairs)
    except TypeError:
        phases = ()
    untils = [phase.until for phase in phases]
    bounds = [until for until in untils[:-1] if _is_count(until)]
    if (
        not phases
        or untils[-1] is not None
        or len(bounds) < len(untils) - 1
        or any(a >= b for a, b in itertools.pairwise(bounds))
        or not all(_is_count(phase.every) for phase in phases)
    ):
        raise ValueError(
            f"every must be a number of environment steps, at least 1, or pairs [until, every] with growing steps "
            f"until, the last of them null; got {every!r}"
        )
    return phases


def _is_count(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


class EvaluationCallback(BaseCallback):
    """Scores the policy in the course of training, without touching it.

    Algorithms change their policy between rollouts only; that a rollout of an off-policy algorithm is a single step
    makes no difference. Evaluations therefore stand where a rollout begins: before the first, then wherever the last
    evaluation is at least ``every`` environment steps ago, and once more when training ends. ``evaluations`` holds
    the results.

    :param evaluator: holds the scored episodes
    :param every: environment steps, or pairs (until, every) of them, see :func:`evaluation_schedule`
    :param on_evaluation: called with each result, e.g. to show progress
    :raises ValueError: ``every`` is no schedule
    """

    def __init__(
        self,
        evaluator: Evaluator,
        every: int | Sequence[Sequence[int | None]] = 128,
        on_evaluation: Callable[[Evaluation], None] | None = None,
    ) -> None:
        super().__init__()
        self.evaluator = evaluator
        self.schedule = evaluation_schedule(every)
        self.on_evaluation = on_evaluation
        self.evaluations: list[Evaluation] = []
        self._finished = self._under_way = 0
        self._started = self._spent = 0.0

    def _on_training_start(self) -> None:
        self._started = time.perf_counter()
        self._spent = 0.0

    def _on_step(self) -> bool:
        done = self.locals["dones"]
        self._finished += int(np.sum(done))
        self._under_way = int(np.sum(~done))  # where an episode has just finished, the next has no step yet
        return True

    def _on_rollout_start(self) -> None:
        if not self.evaluations or self.num_timesteps >= self._due(self.evaluations[-1].steps):
            self._evaluate()

    def _due(self, last: int) -> int:
        """Environment steps at which the evaluation after the one at ``last`` stands."""
        return last + next(phase.every for phase in self.schedule if phase.until is None or last < phase.until)

    def _on_training_end(self) -> None:
        if self.num_timesteps > self.evaluations[-1].steps:
            self._evaluate()

    def _evaluate(self) -> None:
        begun = time.perf_counter()
        seconds = begun - self._started - self._spent
        with random_state_kept():
            score = self.evaluator.score(controller_of(self.model))
        self.evaluations.append(Evaluation(self.num_timesteps, self._finished + self._under_way, seconds, score))
        if self.on_evaluation is not None:
            self.on_evaluation(self.evaluations[-1])
        self._spent += time.perf_counter() - begun


def solved(evaluations: Sequence[Evaluation], oracle: float) -> Evaluation | None:
    """The first evaluation at 95 % of the oracle's score or more; None if there is none.

    :raises ValueError: the oracle's score is not positive, so that fractions of it mean nothing
    """
    if not oracle > 0.0:
        raise ValueError(f"oracle must be a positive score, got {oracle!r}")
    return next((e for e in evaluations if e.score >= SOLVED * oracle), None)


def rollouts_to_solve(evaluations: Sequence[Evaluation], oracle: float) -> int | None:
    """Training episodes begun when the run is first solved; None if it never is."""
    first = solved(evaluations, oracle)
    return None if first is None else first.rollouts


def after_solving(evaluations: Sequence[Evaluation], oracle: float) -> list[Evaluation]:
    """The evaluations that come after the one that solved the run."""
    first = solved(evaluations, oracle)
    return [] if first is None else [e for e in evaluations if e.steps > first.steps]


def held(evaluations: Sequence[Evaluation], oracle: float) -> bool:
    """Solved, and no later evaluation under 90 % of the oracle's score.

    A run that is solved by its last evaluation is held: nothing speaks against it.
    """
    if solved(evaluations, oracle) is None:
        return False
    return all(e.score >= HELD * oracle for e in after_solving(evaluations, oracle))
