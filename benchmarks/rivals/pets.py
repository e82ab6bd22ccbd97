"""PETS (Chua, Calandra, McAllister and Levine 2018), model-based like the policy here, but with a general model.

    python -m benchmarks.rivals.pets --output benchmarks/results/rivals_pets.csv

A probabilistic ensemble of networks learns the dynamics, the cross-entropy method plans through it. Both are those of
mbrl-lib, which needs a virtual environment of its own: how to make it stands in ``pets-requirements.txt``.

PETS is told the reward and when an episode ends, and learns the dynamics. mbrl-lib pays a step for the state it leads
to, the environment for the state it starts from: a plan's sum leaves out the cost of the present state, which no
action changes, and has that of its last one. Nothing stands for what comes after a plan.

Settings are mbrl-lib's own for its cart-pole, except for

- what keeps a step affordable on one core (theirs in brackets): networks of 2 hidden layers of 64 (4 of 200), plans of
  100 candidates (350), 5 particles each (20), in 3 rounds (5);
- the horizon, 30 steps (15): a step takes 0.01 s here, and a pole that is about to fall takes longer than 15 to do so;
- the plan played, the mean of the best candidates and not the best one, which carries the noise of so few rounds;
- training: batches of 32 and 50 epochs (256 and 25), as 25 updates are too few for the first 200 transitions;
- the unit of each state, its change's standard deviation in a step of exploration: mbrl-lib does not scale what it
  predicts, and keeps its standard deviation above 0.0067, which is more than the cart moves in a step at 0.5 m/s.

They were chosen in a few short runs with seed 0, not by a search.

Evaluations follow :mod:`benchmarks.evaluation`, with few episodes, since planning is slow. The policy is not
deterministic: the method samples its candidates. Steps and rollouts count those of random exploration, too.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import mbrl.models  # type: ignore[import-not-found]
import mbrl.planning  # type: ignore[import-not-found]
import mbrl.util  # type: ignore[import-not-found]
import mbrl.util.common  # type: ignore[import-not-found]
import numpy as np
import torch
from omegaconf import OmegaConf  # type: ignore[import-not-found]

from benchmarks.evaluation import RESET_SEEDS, Evaluation, random_state_kept
from benchmarks.rivals.pets_task import reward_function, termination_function
from contact_envs.cart_pole_soft_walls import CartPoleSoftWallsEnv

ENV = "CartPoleSoftWallsPyBullet-v0"
EXPLORATION = 200
"""Steps of random actions before the first model."""
FIT_EVERY = 50
"""Steps."""
MODEL = {"num_layers": 2, "hid_size": 64, "ensemble_size": 7, "activation_fn_cfg": {"_target_": "torch.nn.SiLU"}}
ELITES = 5
"""Members of the ensemble that plans are made with."""
OPTIMISER = {"optim_lr": 7.5e-4, "weight_decay": 3e-5}
FIT = {"model_batch_size": 32, "validation_ratio": 0.0, "num_epochs_train_model": 50, "patience": 50}
HORIZON = 30
PARTICLES = 5
CROSS_ENTROPY = {
    "_target_": "mbrl.planning.CEMOptimizer",
    "num_iterations": 3,
    "elite_ratio": 0.1,
    "population_size": 100,
    "alpha": 0.1,
    "return_mean_elites": True,
    "device": "cpu",
}


class Experience:
    """The training environment and what has been seen of it.

    :param env: to be trained in
    :param seed: of its starts
    """

    def __init__(self, env: gym.Env, seed: int) -> None:
        self.env = env
        self.state, _ = env.reset(seed=seed)
        self.rollouts = 0
        self.episode_begins = True
        self._rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def step(self, action: np.ndarray) -> None:
        """Take one step; start anew where it ends the episode.

        :param action: (1,)
        """
        self.rollouts += self.episode_begins
        next_state, _, terminated, truncated, _ = self.env.step(action)
        self._rows.append((self.state, action, next_state))
        self.episode_begins = terminated or truncated
        self.state = self.env.reset()[0] if self.episode_begins else next_state

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States (n, 4), actions (n, 1), next states (n, 4)."""
        states, actions, next_states = (np.array(part) for part in zip(*self._rows, strict=True))
        return states, actions, next_states


class Pets:
    """The learned model and plans through it.

    :param experience: of exploration; it sets the unit of each state
    :param seed: of the batches
    :raises TypeError: the environment is another one
    """

    def __init__(self, experience: Experience, seed: int) -> None:
        plant = experience.env.unwrapped
        if not isinstance(plant, CartPoleSoftWallsEnv):
            raise TypeError(f"experience must come from a cart-pole with soft walls, got {plant!r}")
        states, actions, next_states = experience.arrays()
        self._scale = 1.0 / (next_states - states).std(axis=0)
        scale = torch.as_tensor(self._scale, dtype=torch.float32)
        self._task = termination_function(plant, scale), reward_function(plant, scale)
        self._env = experience.env
        self._rng = np.random.default_rng(seed)
        n_x, n_a = states.shape[1], actions.shape[1]
        ensemble = mbrl.models.GaussianMLP(
            n_x + n_a, n_x, device="cpu", deterministic=False, propagation_method="random_model", **MODEL
        )
        self._model = mbrl.models.OneDTransitionRewardModel(
            ensemble,
            target_is_delta=True,
            normalize=True,
            normalize_double_precision=True,
            learned_rewards=False,
            num_elites=ELITES,
        )
        self._trainer = mbrl.models.ModelTrainer(self._model, **OPTIMISER)

    def fit(self, experience: Experience) -> None:
        """Train the model further on all that has been seen."""
        states, actions, next_states = experience.arrays()
        n, n_x = states.shape
        buffer = mbrl.util.ReplayBuffer(n, (n_x,), actions.shape[1:], np.float64, np.float64, np.float64, rng=self._rng)
        no = np.zeros(n, dtype=bool)  # the model learns neither rewards nor ends
        buffer.add_batch(states * self._scale, actions, next_states * self._scale, np.zeros(n), no, no)
        mbrl.util.common.train_model_and_save_model_and_data(
            self._model, self._trainer, OmegaConf.create(FIT), buffer, work_dir=None
        )

    def planner(self, seed: int) -> Planner:
        """A planner through the present model and those to come.

        :param seed: of the noise in predictions; candidates come from torch's global random state
        """
        generator = torch.Generator().manual_seed(seed)
        model_env = mbrl.models.ModelEnv(self._env, self._model, *self._task, generator=generator)
        agent = mbrl.planning.TrajectoryOptimizerAgent(
            OmegaConf.create(CROSS_ENTROPY), action_lb=[-1.0], action_ub=[1.0], planning_horizon=HORIZON
        )
        agent.set_trajectory_eval_fn(
            lambda state, plans: model_env.evaluate_action_sequences(
                plans, initial_state=state, num_particles=PARTICLES
            )
        )
        return Planner(agent, self._scale)


class Planner:
    """First action of the best plan found; plans start from what is left of the last one.

    :param agent: mbrl-lib's
    :param scale: (4,) of the states
    """

    def __init__(self, agent: Any, scale: np.ndarray) -> None:
        self._agent = agent
        self._scale = scale

    def begin(self) -> None:
        """Forget the last plan, at the start of an episode."""
        self._agent.reset()

    def act(self, state: np.ndarray) -> np.ndarray:
        """
        :param state: (4,)
        :return: (1,)
        """
        return np.clip(self._agent.act(state * self._scale), -1.0, 1.0).astype(np.float32)


def score(planner: Planner, env_id: str, n_episodes: int) -> float:
    """Mean undiscounted return over the first so many of the protocol's reset seeds."""
    returns = np.zeros(n_episodes)
    with contextlib.closing(gym.make(env_id)) as env:
        for episode, seed in enumerate(RESET_SEEDS[:n_episodes]):
            planner.begin()
            state, _ = env.reset(seed=seed)
            over = False
            while not over:
                state, reward, terminated, truncated, _ = env.step(planner.act(state))
                returns[episode] += float(reward)
                over = terminated or truncated
    return float(returns.mean())


def train(env_id: str, seed: int, steps: int, every: int, n_episodes: int) -> Iterator[Evaluation]:
    """One training run; evaluated after exploration, then every so many steps and at the end.

    :param env_id: a cart-pole with soft walls
    :param seed: of everything
    :param steps: environment steps, exploration included
    :param every: environment steps
    :param n_episodes: of an evaluation
    """
    started, spent = time.perf_counter(), 0.0
    torch.manual_seed(seed)
    with contextlib.closing(gym.make(env_id)) as env:
        env.action_space.seed(seed)
        experience = Experience(env, seed)
        while len(experience) < EXPLORATION:
            experience.step(env.action_space.sample())
        pets = Pets(experience, seed)
        planner = pets.planner(seed)
        while True:
            since = len(experience) - EXPLORATION
            if since % FIT_EVERY == 0:
                pets.fit(experience)
            if since % every == 0 or len(experience) == steps:
                begun = time.perf_counter()
                with random_state_kept():
                    torch.manual_seed(seed)
                    result = score(pets.planner(seed), env_id, n_episodes)
                yield Evaluation(len(experience), experience.rollouts, begun - started - spent, result)
                spent += time.perf_counter() - begun
            if len(experience) == steps:
                return
            if experience.episode_begins or since == 0:
                planner.begin()
            experience.step(planner.act(experience.state))


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, and write one line an evaluation.

    :param arguments: of the command line; those of the process by default
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, nargs="+", default=[1000])
    parser.add_argument("--steps", type=int, default=1000, help=f"environment steps, {EXPLORATION} of them random")
    parser.add_argument("--every", type=int, default=400, help="environment steps from evaluation to evaluation")
    parser.add_argument("--episodes", type=int, default=2, help="of an evaluation")
    parser.add_argument("--output", type=Path, required=True, help="CSV file to write")
    options = parser.parse_args(arguments)
    if options.steps < EXPLORATION:
        parser.error(f"--steps must be at least {EXPLORATION}, those of exploration, got {options.steps}")
    if options.every < 1:
        parser.error(f"--every must be at least 1 environment step, got {options.every}")
    if not 1 <= options.episodes <= len(RESET_SEEDS):
        parser.error(f"--episodes must be in 1..{len(RESET_SEEDS)}, got {options.episodes}")
    with options.output.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["seed", *Evaluation._fields])
        for seed in options.seed:
            for result in train(ENV, seed, options.steps, options.every, options.episodes):
                rounded = result._replace(seconds=round(result.seconds, 2), score=round(result.score, 2))
                writer.writerow([seed, *rounded])
                file.flush()
                print(f"seed {seed}: {result.steps} steps, {result.rollouts} rollouts, score {result.score:.1f}")


if __name__ == "__main__":
    main()
