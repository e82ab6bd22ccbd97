"""A contact model in words: where each contact of eq (5) touches, and what touching does to the next state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from sb3_mpc_policy.lcs import LinearComplementaritySystem

__all__ = ["describe"]

Quantities = Sequence[tuple[str, str]]
"""(name, unit) of each component"""

_SMALL = 0.01  # share of the largest term, in scaled coordinates, under which a term is left out


def describe(
    lcs: LinearComplementaritySystem, states: Quantities | None = None, actions: Quantities | None = None
) -> str:
    """The text of :meth:`LinearComplementaritySystem.describe`, which has the arguments."""
    names = _checked("states", states, lcs.n_states, "s") + _checked("actions", actions, lcs.n_actions, "a")
    if not lcs.n_contacts:
        return "no contacts"
    _, _, C, _, D, E, F, c = (matrix.detach().cpu().numpy() for matrix in lcs.matrices())
    scale = torch.cat([lcs.state_scale, lcs.action_scale]).cpu().numpy()
    in_use = set(np.flatnonzero(C.any(axis=0)).tolist())
    lines = [f"{len(in_use)} of {lcs.n_contacts} contact{'' if lcs.n_contacts == 1 else 's'} in use"]
    for k in range(lcs.n_contacts):
        said = ["not in use"]
        if k in in_use:
            said = _paragraph(np.concatenate([D[k], E[k]]), float(c[k]), C[:, k] / F[k, k], scale, names)
        lines += [f"contact {k + 1}: {said[0]}", *(f"  {line}" for line in said[1:])]
    for j, k in zip(*np.nonzero(_coupled(F)), strict=True):
        if j in in_use or k in in_use:
            lines.append(f"F couples contacts {j + 1} and {k + 1}: the above holds where only one of them touches")
    return "\n".join(lines)


def _paragraph(
    row: np.ndarray, offset: float, push: np.ndarray, scale: np.ndarray, names: Sequence[tuple[str, str]]
) -> list[str]:
    """What there is to say of a contact.

    :param row: (n_x + n_a,) and offset: the gap ``row z + offset`` of ``z = (s, a)`` without contact force
    :param push: (n_x,) what is added to the next state for each unit that the gap would close
    :param scale: (n_x + n_a,) of z
    """
    n_x = len(push)
    size = np.abs(row) * scale
    if not size.any():
        changed = _effect(-offset * push, scale[:n_x], names)
        return ["touches everywhere", f"that changes, in one step: {changed}"] if offset < 0 else ["touches nowhere"]
    # the unit of the gap is that of a state wherever a state moves it
    lead = int(np.argmax(size[:n_x] if size[:n_x].any() else size))
    name, unit = names[lead]
    coefficients, border = row / row[lead], _number(-offset / row[lead], unit)
    others = [i for i in np.argsort(-size) if i != lead and size[i] >= _SMALL * size.max()]
    terms = [f"{'-' if coefficients[i] < 0 else '+'} {_digits(abs(coefficients[i]))} {names[i][0]}" for i in others]
    side, open_side = ("<", "above") if row[lead] > 0 else (">", "below")
    changed = _effect(abs(row[lead]) * push, scale[:n_x], names)
    return [
        f"touches where {' '.join([name, *terms])} {side} {border}",
        f"along {name} alone: at {name} = {border} (open {open_side})",
        f"each {unit or 'unit'} beyond it changes, in one step: {changed}",
    ]


def _effect(effect: np.ndarray, scale: np.ndarray, names: Sequence[tuple[str, str]]) -> str:
    """What is added to the states, the largest first."""
    size = np.abs(effect) / scale
    shown = [i for i in np.argsort(-size) if size[i] >= _SMALL * size.max()]
    return ", ".join(f"{names[i][0]} by {_number(effect[i], names[i][1], '+')}" for i in shown)


def _coupled(F: np.ndarray) -> np.ndarray:
    """(n_lambda, n_lambda) bool, upper triangle: whether one contact's force matters to the other's gap."""
    root = np.sqrt(np.diag(F))
    share = np.abs(F) / root / root[:, None]
    return np.triu(np.maximum(share, share.T) >= _SMALL, 1)


def _number(value: float, unit: str, sign: str = "") -> str:
    return f"{_digits(value, sign)} {unit}".rstrip()


def _digits(value: float, sign: str = "") -> str:
    """Three significant digits, without an exponent where all of them are before the point."""
    value = float(value) + 0.0  # no minus zero
    return f"{value:{sign}.0f}" if 99.95 <= abs(value) < 1e6 else f"{value:{sign}#.3g}"


def _checked(argument: str, given: Quantities | None, count: int, default: str) -> list[tuple[str, str]]:
    if given is None:
        return [(f"{default}[{i}]", "") for i in range(count)]
    pairs = list(given) if isinstance(given, Sequence) and not isinstance(given, str) else []
    if len(pairs) != count or not all(_is_pair(pair) for pair in pairs):
        raise ValueError(f"{argument} must be {count} pairs of strings (name, unit), names not empty, got {given!r}")
    return [(name, unit) for name, unit in pairs]


def _is_pair(pair: object) -> bool:
    return (
        isinstance(pair, tuple | list)
        and len(pair) == 2
        and all(isinstance(part, str) for part in pair)
        and bool(pair[0])
    )
