"""Whether what a caller gave is what was asked for."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from tensegrity_gym.errors import InvalidParameterError

T = TypeVar("T")


def is_number(value: object) -> bool:
    """Whether ``value`` is one finite real number: no bool, no text, no array."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        return False
    return bool(np.isfinite(value))


def or_default(value: T | None, kind: type[T], caller: str) -> T:
    """``value``, or the default of its kind for None; InvalidParameterError, in the name of ``caller``, for another kind."""
    if value is None:
        return kind()
    if not isinstance(value, kind):
        name = kind.__name__
        raise InvalidParameterError(f"{caller}: expected a {name} or None, got {value!r}; use {name}(...)")
    return value
