"""The table of experiments: which runs there are, and with which settings.

A row of ``experiments.yml``::

    mpc/easy/pybullet:                 # its name; names that start with "." are templates for anchors, and no rows
      env: CartPoleSoftWallsPyBullet-v0
      algorithm: PPO                   # PPO (default), SAC, TQC, CrossQ
      policy: MpcLcsPolicy             # the default; its tuned settings are what `settings` are laid over
      settings: {n_steps: 64, learning_rate: lin_1e-3, policy_kwargs: {horizon: 20}}
      n_envs: 1
      normalize: false                 # true, or a mapping of arguments: VecNormalize
      steps: 2048                      # environment steps
      seeds: [1000, 1001]              # or {first: 1000, count: 10}
      evaluate: 128                    # environment steps between evaluations, or pairs [until, every], last null
      episodes: 50                     # scored episodes of an evaluation
      probes: [robustness]             # what is asked of the finished model, see benchmarks/probes
"""

from __future__ import annotations

import dataclasses
import difflib
import fnmatch
import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from stable_baselines3.common.utils import LinearSchedule

from benchmarks.evaluation import RESET_SEEDS, Phase, evaluation_schedule
from benchmarks.probes import PROBES
from benchmarks.runs import changed
from sb3_mpc_policy import hyperparams

TABLE = Path(__file__).parent / "experiments.yml"
ALGORITHMS = {
    "PPO": "stable_baselines3",
    "SAC": "stable_baselines3",
    "TQC": "sb3_contrib",
    "CrossQ": "sb3_contrib",
}
"""Name -> the module that has it, imported when needed."""
MPC_POLICY = "MpcLcsPolicy"
_NAME = re.compile(r"[a-z0-9_-][a-z0-9._-]*(/[a-z0-9_-][a-z0-9._-]*)*")
_SMALL_STEPS = {MPC_POLICY: 256, "PPO": 2_048, "CrossQ": 256, "off-policy": 512}  # CrossQ's networks are wide
_SMALL_EPISODES = 4


@dataclass(frozen=True)
class Experiment:
    """A row of the table, all defaults filled in."""

    name: str
    env: str
    steps: int
    seeds: tuple[int, ...]
    algorithm: str = "PPO"
    policy: str = MPC_POLICY
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Arguments of the algorithm other than policy, environment and seed; schedules as in RL Zoo, ``lin_1e-3``."""
    n_envs: int = 1
    normalize: Mapping[str, Any] | None = None
    """Arguments of VecNormalize; None without it."""
    evaluate: tuple[Phase, ...] = (Phase(None, 128),)
    episodes: int = len(RESET_SEEDS)
    probes: tuple[str, ...] = ()

    @property
    def settings_hash(self) -> str:
        """Short hash of everything that determines a run but its seed."""
        entries = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        determining = {key: value for key, value in entries.items() if key not in ("name", "seeds", "probes")}
        return short_hash(determining)

    def small(self) -> Experiment:
        """The same in a hurry: one short run, scored on few episodes when it begins and ends."""
        kind = self.policy if self.policy == MPC_POLICY else self.algorithm
        steps = min(self.steps, _SMALL_STEPS.get(kind, _SMALL_STEPS["off-policy"]))
        return dataclasses.replace(
            self,
            seeds=self.seeds[:1],
            steps=steps,
            evaluate=(Phase(None, steps),),
            episodes=min(self.episodes, _SMALL_EPISODES),
        )


def short_hash(value: Any) -> str:
    """Twelve hexadecimal digits, the same for equal values in any order of their keys."""
    text = json.dumps(value, sort_keys=True, default=_described)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _described(value: object) -> list:
    if isinstance(value, LinearSchedule):
        return ["linear", value.start, value.end, value.end_fraction]
    raise TypeError(f"settings must be made of plain values and linear schedules, got {value!r}")


# -- reading --


class _Loader(yaml.SafeLoader):
    """Refuses a key that stands twice in a mapping, of which YAML would silently take the last."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise ValueError(f"line {key.start_mark.line + 1}: {key.value!r} stands twice")
                seen.add(key.value)
        return node


def read_table(path: Path, changes: Mapping[str, Any] | None = None) -> list[Experiment]:
    """The experiments of a table, in its order.

    :param changes: laid over every row, e.g. ``{"steps": 500, "settings": {"n_epochs": 5}}``
    :raises OSError: no such file
    :raises ValueError: something in the table is not as it should be; the message names the row and the key
    """
    try:
        # a SafeLoader underneath
        table = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: {error}") from error
    if not isinstance(table, dict):
        raise ValueError(f"{path}: must be a mapping of row names to settings, got {type(table).__name__}")
    rows = {name: row for name, row in table.items() if not str(name).startswith(".")}
    try:
        return [experiment(name, row, changes or {}) for name, row in rows.items()]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def experiment(name: object, row: object, changes: Mapping[str, Any] | None = None) -> Experiment:
    """A row of the table, checked and with all defaults filled in.

    :param changes: laid over it
    :raises ValueError: something in it is not as it should be; the message names the row and the key
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"row {name!r}: a name is made of a-z, 0-9, '.', '_', '-', and '/' between groups")
    if "__" in name or name == "references" or name.endswith((".runs", *(f".{probe}" for probe in PROBES))):
        raise ValueError(f"row {name!r}: its result files could have the names of others, see benchmarks/store.py")
    if not isinstance(row, Mapping):
        raise ValueError(f"row {name!r}: must be a mapping, got {row!r}")
    given = _numbers(changed(row, changes or {}))
    keys = [field.name for field in dataclasses.fields(Experiment) if field.name != "name"]
    for key in given:
        if key not in keys:
            raise ValueError(f"row {name!r}: unknown key {key!r}{_close(str(key), keys)}; known are {', '.join(keys)}")
    for key in ("env", "steps", "seeds"):
        if key not in given:
            raise ValueError(f"row {name!r}: {key!r} is missing")
    entries: dict[str, Any] = {"name": name}
    for key, value in given.items():
        try:
            entries[key] = _CHECKS[key](value)
        except ValueError as error:
            raise ValueError(f"row {name!r}, {key}: {error}") from error
    made = Experiment(**entries)
    if made.policy == MPC_POLICY and made.algorithm != "PPO":
        raise ValueError(f"row {name!r}, policy: {MPC_POLICY} is trained by PPO alone, got algorithm {made.algorithm}")
    settings = resolved(made.env, made.policy, made.settings)
    normalize = made.normalize
    if normalize is not None and "gamma" in settings:
        normalize = {"gamma": settings["gamma"], **normalize}  # rewards are scaled by the returns the algorithm sees
    return dataclasses.replace(made, settings=settings, normalize=normalize)


def resolved(env_id: str, policy: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the algorithm: ``settings`` over the tuned ones, if the policy is ours and there are any."""
    tuned: dict[str, Any] = {}
    if policy == MPC_POLICY:
        try:
            tuned = hyperparams(env_id)
        except KeyError:
            tuned = {}  # the policy has defaults for any environment
    return {"device": "cpu", **changed(tuned, settings)}


def selected(experiments: Sequence[Experiment], patterns: Iterable[str] | None) -> list[Experiment]:
    """The experiments whose names match a pattern, such as ``ablation/*``; all of them without patterns.

    :raises ValueError: a pattern that matches nothing
    """
    if patterns is None:
        return list(experiments)
    names = [each.name for each in experiments]
    chosen: set[str] = set()
    for pattern in patterns:
        matching = fnmatch.filter(names, pattern)
        if not matching:
            raise ValueError(f"no row matches {pattern!r}{_close(pattern, names)}")
        chosen.update(matching)
    return [each for each in experiments if each.name in chosen]


def _close(word: str, words: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, words, n=3, cutoff=0.5)
    return f" (close: {', '.join(close)})" if close else ""


def _numbers(value: Any) -> Any:
    """``value`` with the numbers that YAML 1.1 takes for strings, such as 1e-3, as numbers."""
    if isinstance(value, Mapping):
        return {key: _numbers(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_numbers(inner) for inner in value]
    if isinstance(value, str) and re.fullmatch(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+", value):
        return float(value)
    return value


# -- checks, a function for each key: its value in the form that Experiment holds, or a ValueError --


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError(f"must be a name, got {value!r}")
    return value


def _count(value: Any) -> int:
    if isinstance(value, float) and value.is_integer():
        value = int(value)  # 1e6
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError(f"must be a positive integer, got {value!r}")
    return value


def _algorithm(value: Any) -> str:
    if value not in list(ALGORITHMS):
        raise ValueError(f"must be one of {', '.join(ALGORITHMS)}, got {value!r}")
    return value


def _settings(value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise ValueError(f"must be a mapping of the algorithm's arguments, got {value!r}")
    for key in ("policy", "env", "seed"):
        if key in value:
            raise ValueError(f"{key!r} is not a setting of the algorithm but of the row")
    for inner in value.values():
        if isinstance(inner, str) and inner.startswith("lin_"):
            schedule(inner)
    return dict(value)


def _normalize(value: Any) -> dict[str, Any] | None:
    if isinstance(value, bool):
        return {} if value else None
    if not isinstance(value, Mapping):
        raise ValueError(f"must be true, false, or a mapping of VecNormalize's arguments, got {value!r}")
    return dict(value)


def seeds(value: Any) -> tuple[int, ...]:
    """Seeds from a list of them or from ``{"first": 1000, "count": 10}``.

    :raises ValueError: neither, or one stands twice
    """
    if isinstance(value, Mapping) and set(value) == {"first", "count"}:
        first, count = value["first"], _count(value["count"])
        value = list(range(first, first + count)) if isinstance(first, int) else value
    proper = isinstance(value, list) and all(isinstance(s, int) and not isinstance(s, bool) and s >= 0 for s in value)
    if not proper or not value or len(set(value)) < len(value):
        raise ValueError(f"must be a list of different seeds, or {{first: 1000, count: 10}}, got {value!r}")
    return tuple(value)


def _episodes(value: Any) -> int:
    if _count(value) > len(RESET_SEEDS):
        raise ValueError(f"must be at most {len(RESET_SEEDS)}, got {value!r}")
    return _count(value)


def _probes(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or any(name not in list(PROBES) for name in value):
        raise ValueError(f"must be a list of {', '.join(PROBES)}, got {value!r}")
    return tuple(dict.fromkeys(value))


_CHECKS = {
    "env": _text,
    "algorithm": _algorithm,
    "policy": _text,
    "settings": _settings,
    "n_envs": _count,
    "normalize": _normalize,
    "steps": _count,
    "seeds": seeds,
    "evaluate": evaluation_schedule,
    "episodes": _episodes,
    "probes": _probes,
}


# -- from plain values to what algorithms take --


def schedule(text: str) -> LinearSchedule:
    """A rate that falls linearly to zero over training, from RL Zoo's notation ``lin_1e-3``.

    :raises ValueError: not that notation
    """
    try:
        return LinearSchedule(float(text.removeprefix("lin_")), 0.0, 1.0)
    except ValueError:
        raise ValueError(f"a linear schedule reads lin_1e-3, got {text!r}") from None


def algorithm_arguments(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with schedules, activation functions and the like in place of the words for them.

    :raises ValueError: an activation function that torch does not have
    """
    arguments: dict[str, Any] = {
        key: schedule(value) if isinstance(value, str) and value.startswith("lin_") else value
        for key, value in settings.items()
    }
    if isinstance(arguments.get("train_freq"), list):
        arguments["train_freq"] = tuple(arguments["train_freq"])  # (1, "episode")
    activation = arguments.get("policy_kwargs", {}).get("activation_fn")
    if isinstance(activation, str):
        if not hasattr(torch.nn, activation):
            raise ValueError(f"activation_fn must name a class of torch.nn, such as Tanh, got {activation!r}")
        arguments["policy_kwargs"] = {**arguments["policy_kwargs"], "activation_fn": getattr(torch.nn, activation)}
    return arguments
