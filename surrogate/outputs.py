"""What the surrogate predicts, and the columns of a file of hops that it learns from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from surrogate.dataset import HopData


class Output(NamedTuple):
    """One predicted number: its column and place there, unit, and the axis whose reflection flips its sign (or None)."""

    name: str
    column: str
    component: int | None
    unit: str
    axis: int | None


OUTPUTS: tuple[Output, ...] = (
    Output("landing_x", "landing", 0, "m", 0),
    Output("landing_y", "landing", 1, "m", 1),
    Output("touchdown_x", "touchdown", 0, "m", 0),
    Output("touchdown_y", "touchdown", 1, "m", 1),
    Output("apex", "apex", None, "m", None),
    Output("takeoff_velocity_x", "takeoff_velocity", 0, "m/s", 0),
    Output("takeoff_velocity_y", "takeoff_velocity", 1, "m/s", 1),
    Output("takeoff_velocity_z", "takeoff_velocity", 2, "m/s", None),
    Output("flight_time", "flight_time", None, "s", None),
)
LANDING = slice(0, 2)


def target_columns(data: HopData) -> np.ndarray:
    """The outputs of stored hops, not-a-number where a hop has none, shape (n, len(OUTPUTS)) [each its unit]."""
    columns = [data[o.column] if o.component is None else data[o.column][:, o.component] for o in OUTPUTS]
    return np.column_stack(columns).astype(np.float32)


def scene_columns(data: HopData) -> np.ndarray:
    """Varied scene values of stored hops, in the order of their names, shape (n, k) [SI]."""
    names = sorted(data.configuration.get("scene_ranges") or {})
    return np.column_stack([data[f"scene_{name}"] for name in names]).astype(np.float32) if names else np.empty((len(data), 0))
