"""Hops under different gravities made alike, so that one net serves them all, and observations brought to order one.

What a hop takes off with comes of its elastic energy, which is large against what lifting the lattice by its own height costs:
the velocity v hardly depends on gravity g, and what follows is a throw, whose distance and rise go as v^2/g and whose time
goes as v/g. Multiplied by g over Earth's they are nearly what they are on Earth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from surrogate.dataset import HopData
from tensegrity_gym import Scene
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.scene_ranges import SceneRanges
from tensegrity_gym.task import reach
from tensegrity_gym.types import Floats

#: Gravity that lengths and times are brought to [m/s^2].
EARTH = float(Scene.PRESETS["earth"]["gravity"])
#: By how much of a range's greater end a scene value may lie beyond it: observations are float32.
ROUNDING = 1e-6
#: Columns of a data set that go as 1/g.
BALLISTIC = ("landing", "touchdown", "rest", "apex", "flight_time")


def likeness(values: Floats, names: Sequence[str]) -> Floats:
    """By what lengths are multiplied in scenes of ``values`` (n, k), ordered as ``names``, shape (n,); 1 if gravity is fixed."""
    if "gravity" not in names:
        return np.ones(len(values))
    return np.asarray(values, dtype=np.float64)[:, list(names).index("gravity")] / EARTH


def alike(observations: ArrayLike, scenes: SceneRanges) -> tuple[Floats, Floats]:
    """Observations (2 + k,) or (n, 2 + k) to targets as they would be on Earth (n, 2) [m] and scene values (n, k) [SI].

    InvalidParameterError for what is no observation of these scenes, such as one of a scene beyond their ranges.
    """
    width = 2 + len(scenes.observed)
    rows = np.atleast_2d(np.asarray(observations, dtype=np.float64))
    if rows.ndim != 2 or rows.shape[1] != width or not np.isfinite(rows).all():
        raise InvalidParameterError(
            f"observation: expected a finite target [m] and {list(scenes.observed)}, ({width},) or (n, {width}), "
            f"got {observations!r}"
        )
    values = rows[:, 2:]
    low, high = scenes.bounds()
    away = ROUNDING * np.maximum(np.abs(low), np.abs(high))
    strange = ((values < low - away) | (values > high + away)).any(axis=1)
    if strange.any():
        known = ", ".join(f"{name} from {a:g} to {b:g}" for name, a, b in zip(scenes.observed, low, high, strict=True))
        raise InvalidParameterError(
            f"observation: expected scene values in this order and these ranges: {known}, got {values[strange][0].tolist()}; "
            f"put them in order, or learn from hops of such scenes"
        )
    return rows[:, :2] * likeness(values, scenes.observed)[:, None], values


def alike_data(data: HopData, scenes: SceneRanges) -> HopData:
    """Hops with their lengths and times of flight as they would be on Earth; their configuration says so, as ``lengths``."""
    values = np.column_stack([data[f"scene_{name}"] for name in scenes.observed])
    factor = likeness(values, scenes.observed)
    columns = {name: data[name] * (factor if data[name].ndim == 1 else factor[:, None]) for name in BALLISTIC}
    return replace(data, columns=data.columns | columns, configuration=data.configuration | {"lengths": "as on Earth"})


@dataclass(frozen=True)
class Scaling:
    """How observations are brought to order one: targets made alike where gravity varies, then (value - offset) / scale."""

    scale: tuple[float, ...]
    """Of each column; one number serves all."""
    offset: tuple[float, ...] = (0.0,)
    """Of each column; one number serves all."""
    gravity: int | None = None
    """Column of the gravity, where it varies."""

    @classmethod
    def of(cls, scenes: SceneRanges) -> Scaling:
        """Targets over the reach, scene values from -1 to 1 over their ranges."""
        if not scenes.ranges:
            return cls((reach(scenes.base),))
        low, high = scenes.bounds()
        column = 2 + scenes.observed.index("gravity") if "gravity" in scenes.observed else None
        unit = max(reach(s) * (1.0 if column is None else s.gravity / EARTH) for s in scenes.corners())
        return cls((unit, unit, *((high - low) / 2).tolist()), (0.0, 0.0, *((high + low) / 2).tolist()), column)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Observations (..., d) as nets see them, float32, shape as they came."""
        seen = np.asarray(observation, dtype=np.float32)
        if self.gravity is not None:
            seen = seen.copy()
            seen[..., :2] *= seen[..., self.gravity, None] / np.float32(EARTH)
        return (seen - np.asarray(self.offset, dtype=np.float32)) / np.asarray(self.scale, dtype=np.float32)

    def bounds(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest of what comes out, of observations from ``low`` to ``high``, shapes (d,)."""
        ends = low.copy(), high.copy()
        if self.gravity is not None:  # the farthest targets count most where gravity is greatest
            for end in ends:
                end[self.gravity] = high[self.gravity]
        low_seen, high_seen = (self(end) for end in ends)
        if self.gravity is not None:
            low_seen[self.gravity] = self(low)[self.gravity]
        return low_seen, high_seen
