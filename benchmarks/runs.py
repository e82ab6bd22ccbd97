"""One training run with the tuned settings or changed ones, and its result file."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.evaluation import EvaluationCallback
from sb3_mpc_policy import hyperparams


class Row(NamedTuple):
    """One line of a result file: an evaluation, and the run it belongs to."""

    env: str
    variant: str
    seed: int
    steps: int
    rollouts: int
    seconds: float
    score: float
    oracle: float


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write a result file, sorted by run and step."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        for row in sorted(rows):
            tidy = row._replace(seconds=round(row.seconds, 2), score=round(row.score, 2), oracle=round(row.oracle, 2))
            writer.writerow(tidy)


def read_rows(path: Path) -> list[Row]:
    """Read what :func:`write_rows` wrote."""
    with path.open(newline="") as file:
        return [
            Row(
                line["env"], line["variant"], int(line["seed"]), int(line["steps"]), int(line["rollouts"]),
                float(line["seconds"]), float(line["score"]), float(line["oracle"]),
            )
            for line in csv.DictReader(file)
        ]  # fmt: skip


# -- settings --


def parsed_changes(assignments: Sequence[str]) -> dict[str, Any]:
    """Nested settings from assignments such as ``"policy_kwargs.n_contacts=0"``; values are YAML.

    :raises ValueError: an assignment without a name or without ``=``
    """
    changes: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        keys = name.split(".")
        if not equals or not all(keys):
            raise ValueError(f"a setting must read name=value or outer.inner=value, got {assignment!r}")
        value = yaml.safe_load(text)
        if isinstance(value, str):
            with contextlib.suppress(ValueError):  # YAML 1.1 takes 1e-3 for a string
                value = float(value)
        inner = changes
        for key in keys[:-1]:
            inner = inner.setdefault(key, {})
        inner[keys[-1]] = value
    return changes


def changed(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``settings`` with ``changes`` laid over them; mappings are merged key by key."""
    result = dict(settings)
    for key, value in changes.items():
        old = result.get(key)
        result[key] = changed(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return result


def settings_for(env_id: str, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of ``PPO`` other than the environment.

    :param env_id: its tuned settings are what ``changes`` are laid over, unless they name another policy
    :param changes: nested settings; ``policy`` defaults to ``MpcLcsPolicy``
    """
    policy = changes.get("policy", "MpcLcsPolicy")
    tuned = hyperparams(env_id) if policy == "MpcLcsPolicy" else {}
    return {"device": "cpu", **changed(tuned, changes), "policy": policy}


# -- training --


def train(
    env_id: str,
    settings: Mapping[str, Any],
    seed: int,
    steps: int,
    callbacks: Sequence[BaseCallback],
) -> PPO:
    """Train once, on one thread.

    :param settings: see :func:`settings_for`
    :param seed: of the environment, the initial policy and the exploration
    :param steps: environment steps
    :param callbacks: e.g. an :class:`~benchmarks.evaluation.EvaluationCallback`
    """
    torch.set_num_threads(1)
    with contextlib.closing(make_vec_env(env_id, seed=seed)) as env:
        return PPO(env=env, seed=seed, **settings).learn(steps, callback=list(callbacks))


def rows_of(callback: EvaluationCallback, env_id: str, variant: str, seed: int, oracle: float) -> list[Row]:
    """A run's evaluations as lines of a result file."""
    return [Row(env_id, variant, seed, *evaluation, oracle) for evaluation in callback.evaluations]
