"""Hops in scenes that vary, made comparable: landings in reaches of their scene, apexes as on Earth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surrogate.hops import HopData
from tensegrity_gym import Scene
from tensegrity_gym.reachable import reach_of
from tensegrity_gym.task import reachable_middle

EARTH = Scene().gravity


def scene_rows(data: HopData) -> tuple[list[Scene], np.ndarray]:
    """The scenes that occur, and which of them each hop was in, shape (n,)."""
    base, names = Scene(**data.configuration["scene"]), sorted(data.configuration["scene_ranges"])
    values = np.column_stack([data[f"scene_{name}"] for name in names])
    distinct, which = np.unique(values, axis=0, return_inverse=True)
    return [replace(base, **dict(zip(names, row.tolist(), strict=True))) for row in distinct], which.ravel()


def comparable(data: HopData) -> HopData:
    """The hops with ``rest`` and ``touchdown`` from the middle of their scene's reachable region, in its reaches [-].

    ``apex`` [m] is multiplied by gravity over the Earth's: in vacuum, what the same take-off would reach there.
    """
    scenes, which = scene_rows(data)
    columns = dict(data.columns)
    for name in ("rest", "touchdown"):
        read = [replace(scene, landing=name) for scene in scenes]
        middle = np.array([reachable_middle(scene) for scene in read])
        radius = np.array([reach_of(scene).radius for scene in read])
        columns[name] = (data[name] - middle[which]) / radius[which, None]
    gravity = np.array([scene.gravity for scene in scenes])
    columns["apex"] = data["apex"] * gravity[which] / EARTH
    return HopData(columns, data.configuration, data.seconds)


def unit_of(data: HopData) -> str:
    """Of :func:`comparable` hops' landings, or of hops in one scene."""
    return "reaches" if data.configuration["scene_ranges"] else "m"
