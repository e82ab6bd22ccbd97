"""Probes: what is asked of a finished model, by name. A new one is a file here and a line in the table.

A probe is a function ``probe(model, env_id, *, small=False)`` that returns tidy lines: some keys that say what was
asked, then ``quantity`` and ``value``. With ``small`` it makes do with few episodes.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable

__all__ = ["PROBES", "ProbeLine", "probe_named"]

ProbeLine = dict[str, str | float]
"""Keys of the probe, then ``quantity`` and ``value``."""

PROBES = {
    "robustness": "benchmarks.probes.robustness:probe",
    "reuse": "benchmarks.probes.reuse:probe",
    "model_quality": "benchmarks.probes.model_quality:probe",
    "episode": "benchmarks.probes.episode:probe",
}
"""Name -> module and function. Imported when asked for: some need what others do not."""


def probe_named(name: str) -> Callable[..., list[ProbeLine]]:
    """The function of a probe.

    :raises ValueError: there is none of that name
    """
    if name not in PROBES:
        raise ValueError(f"probes must be among {sorted(PROBES)}, got {name!r}")
    module, function = PROBES[name].split(":")
    return getattr(importlib.import_module(module), function)
