"""Arguments checked once, at construction, with errors that say what was given and what is accepted."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["finite", "finite_vector", "non_negative", "positive"]


def finite(name: str, value: object) -> float:
    """``value`` as a float.

    :param name: the argument's name, for the error
    :param value: what the caller gave
    :raises TypeError: ``value`` is not a real number
    :raises ValueError: ``value`` is not finite
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number, got {value!r}")
    if not math.isfinite(value):
        raise ValueError(f"{name} must be finite, got {value!r}")
    return float(value)


def non_negative(name: str, value: object) -> float:
    """As :func:`finite`; also raises ValueError below zero."""
    number = finite(name, value)
    if number < 0.0:
        raise ValueError(f"{name} must be >= 0, got {value!r}")
    return number


def positive(name: str, value: object) -> float:
    """As :func:`finite`; also raises ValueError for zero and below."""
    number = finite(name, value)
    if number <= 0.0:
        raise ValueError(f"{name} must be > 0, got {value!r}")
    return number


def finite_vector(name: str, values: ArrayLike, size: int) -> NDArray[np.float64]:
    """``values`` as a new float64 array.

    :param name: the argument's name, for the error
    :param values: (size,)
    :param size: how many numbers are expected
    :raises ValueError: another shape, or a number that is not finite
    """
    vector = np.array(values, dtype=np.float64)
    if vector.shape != (size,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} must be {size} finite number(s), shape ({size},), got {values!r}")
    return vector
