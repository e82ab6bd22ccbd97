"""What a worker does for an experiment: train and evaluate, ask the trained model, score the references.

All of it runs on one thread and takes and returns plain values, so that it may run on another machine.
"""

from __future__ import annotations

import contextlib
import datetime
import importlib
import importlib.metadata
import io
import math
import os
import pickle
import platform
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import sb3_mpc_policy  # noqa: F401  (registers the policy and the environments)
from benchmarks.evaluation import Evaluation, EvaluationCallback, Evaluator
from benchmarks.experiments import ALGORITHMS, Experiment, algorithm_arguments, short_hash
from benchmarks.probes import ProbeLine, probe_named
from benchmarks.references import CONTROLLER_SETTINGS, contact_env, lqr, oracle
from benchmarks.store import Reference, replaced
from sb3_mpc_policy import hyperparams

PACKAGES = (
    "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy", "scipy", "daqp", "drake", "pybullet", "mujoco",
)  # fmt: skip
"""Those whose versions are noted down with a run."""


class SavedModel(NamedTuple):
    """A trained model, as bytes."""

    settings: str
    """Hash of the settings it was trained with."""
    model: bytes
    """What ``model.save`` writes."""
    normalization: bytes | None
    """The pickled VecNormalize, if there is one."""

    def write(self, folder: Path) -> None:
        """Write it into a folder of its own."""
        with replaced(folder / "settings") as path:  # taken back first: it vouches for the other two
            path.write_text("")
        with replaced(folder / "model.zip") as path:
            path.write_bytes(self.model)
        if self.normalization is not None:
            with replaced(folder / "vecnormalize.pkl") as path:
                path.write_bytes(self.normalization)
        with replaced(folder / "settings") as path:
            path.write_text(self.settings)

    @classmethod
    def read(cls, folder: Path, experiment: Experiment) -> SavedModel | None:
        """What :meth:`write` wrote, if it was trained with the settings of ``experiment``; None otherwise."""
        note = folder / "settings"
        if not note.exists() or note.read_text() != experiment.settings_hash:
            return None
        normalization = None if experiment.normalize is None else (folder / "vecnormalize.pkl").read_bytes()
        return cls(experiment.settings_hash, (folder / "model.zip").read_bytes(), normalization)


class Probed(NamedTuple):
    """What the probes found in a model, and why others did not come to an end."""

    found: dict[str, list[ProbeLine]]
    failed: dict[str, str]
    """Name of a probe -> reason and traceback."""


class Trained(NamedTuple):
    """A training run."""

    evaluations: list[Evaluation]
    model: SavedModel
    probed: Probed
    wall_seconds: float
    """Of training and evaluating."""
    machine: str
    versions: str
    date: str


def train(experiment: Experiment, seed: int, small: bool = False) -> Trained:
    """One training run of an experiment with its evaluations, and its probes of the trained model.

    :param seed: of the environments, the initial policy and the exploration
    :param small: the probes make do with few episodes
    :raises FloatingPointError: a score is not a number
    """
    torch.set_num_threads(1)
    begun = time.perf_counter()
    with contextlib.ExitStack() as stack:
        evaluator = stack.enter_context(contextlib.closing(Evaluator(experiment.env, experiment.episodes)))
        env = stack.enter_context(_environment(experiment, seed))
        callback = EvaluationCallback(evaluator, experiment.evaluate, on_evaluation=_check_score)
        arguments = algorithm_arguments(experiment.settings)
        model = algorithm(experiment.algorithm)(experiment.policy, env, seed=seed, **arguments)
        model.learn(experiment.steps, callback=callback)
        wall_seconds = time.perf_counter() - begun
        saved = _saved(model, experiment.settings_hash)
    return Trained(
        evaluations=callback.evaluations,
        model=saved,
        probed=probe(experiment, saved, experiment.probes, small),
        wall_seconds=wall_seconds,
        machine=machine(),
        versions=versions(),
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )


def probe(experiment: Experiment, saved: SavedModel, names: Sequence[str], small: bool = False) -> Probed:
    """What the named probes find in a trained model.

    A model is probed as it was saved, right after training too: the answers are the same whenever one asks.
    """
    torch.set_num_threads(1)
    probed = Probed({}, {})
    for name in names:
        with _environment(experiment, seed=0) as env:
            try:
                model = algorithm(experiment.algorithm).load(io.BytesIO(saved.model), _normalized(env, saved))
                probed.found[name] = probe_named(name)(model, experiment.env, small=small)
            except Exception:  # told to whoever asked, who has the results of the others to keep
                probed.failed[name] = traceback.format_exc()
    return probed


def reference(env_id: str, episodes: int) -> Reference:
    """Scores of the oracle and of LQR; not a number where the environment does not tell its true model."""
    torch.set_num_threads(1)
    try:
        with contact_env(env_id):
            pass
    except TypeError:
        return Reference(env_id, episodes, math.nan, math.nan, reference_settings(env_id))
    with contextlib.closing(Evaluator(env_id, episodes)) as evaluator:
        scores = [round(evaluator.score(controller(env_id)), 3) for controller in (oracle, lqr)]
    return Reference(env_id, episodes, scores[0], scores[1], reference_settings(env_id))


def reference_settings(env_id: str) -> str:
    """Hash of the settings that the oracle takes from the tuned policy."""
    try:
        tuned = hyperparams(env_id).get("policy_kwargs", {})
    except KeyError:
        tuned = {}  # such as the oracle of contact_envs refuses, and others have none
    return short_hash({name: tuned.get(name) for name in (*CONTROLLER_SETTINGS, "state_scale")})


def algorithm(name: str) -> type[BaseAlgorithm]:
    """The class of an algorithm of the table.

    :raises ImportError: its package is not installed
    """
    return getattr(importlib.import_module(ALGORITHMS[name]), name)


# -- environments and models --


@contextlib.contextmanager
def _environment(experiment: Experiment, seed: int) -> Iterator[VecEnv]:
    env: VecEnv = make_vec_env(experiment.env, n_envs=experiment.n_envs, seed=seed)
    if experiment.normalize is not None:
        env = VecNormalize(env, **experiment.normalize)
    with contextlib.closing(env):
        yield env


def _saved(model: BaseAlgorithm, settings: str) -> SavedModel:
    buffer = io.BytesIO()
    model.save(buffer)
    normalization = model.get_vec_normalize_env()
    return SavedModel(settings, buffer.getvalue(), None if normalization is None else pickle.dumps(normalization))


def _normalized(env: VecEnv, saved: SavedModel) -> VecEnv:
    """The environment with the statistics of a saved model, which it leaves as they are."""
    if saved.normalization is None:
        return env
    assert isinstance(env, VecNormalize)
    normalization: VecNormalize = pickle.loads(saved.normalization)
    normalization.set_venv(env.venv)
    normalization.training = False
    return normalization


def _check_score(evaluation: Evaluation) -> None:
    if not math.isfinite(evaluation.score):
        raise FloatingPointError(f"the score after {evaluation.steps} steps is {evaluation.score}: training diverged")


# -- where and with what --


def machine() -> str:
    """Processor and number of cores; no name."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = models[0] if models else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores"


def versions() -> str:
    """Of Python and of those of :data:`PACKAGES` that are installed."""
    found: Mapping[str, Any] = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found = {**found, package: importlib.metadata.version(package)}
    return " ".join(f"{package}={version}" for package, version in found.items())
