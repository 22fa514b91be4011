"""The reachable region of a scene: measured from simulated hops, stored with the package, read back by the task.

``python -m tensegrity_gym reach --scene NAME --save`` recomputes ``tensegrity_gym/reaches/NAME.json``.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tensegrity_gym.batch import Progress
from tensegrity_gym.calibration import sample_stretches
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.hops import HopResult
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import LANDINGS, Scene
from tensegrity_gym.simulate import simulate
from tensegrity_gym.types import Floats, HopStatus
from tensegrity_gym.version import MODEL_VERSION

FOLDER = Path(__file__).parent / "reaches"
#: Share of the landings that the disc, and in each direction the region, holds.
SHARE = 0.95
#: Directions in which the region's boundary is stored, evenly spaced from +x towards +y.
DIRECTIONS = 36
#: Landings within this angle of a direction count for it [rad].
WINDOW = np.radians(15.0)


@dataclass(frozen=True)
class Reach:
    """Where hops with stretches spread evenly over their range land, in one scene."""

    radius: float
    """Radius of the disc around the middle that holds 95 % of the landings [m]: the unit of landing errors."""
    downhill: float
    """How far the middle, the mean landing, lies downhill of the start [m]."""
    boundary: tuple[float, ...]
    """Distance of the region's boundary from the middle, in evenly spaced directions from downhill (on flat ground: from
    +x) towards +y [m]: in each, the distance within which 95 % of the landings near that direction lie."""

    def scaled(self, factor: float) -> Reach:
        """The same shape, ``factor`` times as large."""
        return Reach(factor * self.radius, factor * self.downhill, tuple(factor * b for b in self.boundary))

    def distance(self, direction: ArrayLike) -> Floats:
        """Distance from the middle to the boundary [m] in directions [rad], shape as ``direction``."""
        at = np.arange(len(self.boundary)) * (2 * np.pi / len(self.boundary))
        return np.interp(np.asarray(direction, dtype=np.float64), at, self.boundary, period=2 * np.pi)

    def directions(self, share: ArrayLike) -> Floats:
        """Directions [rad] below which lies that share of the region's area, shape as ``share``.

        Evenly spread shares give directions of points spread evenly over the region.
        """
        at = np.linspace(0, 2 * np.pi, 721)
        middle = 0.5 * (at[1:] + at[:-1])
        area = np.concatenate([[0.0], np.cumsum(self.distance(middle) ** 2)])
        return np.interp(np.asarray(share, dtype=np.float64), area / area[-1], at)


@lru_cache(maxsize=16)
def stored_reach(preset: str, landing: str) -> Reach:
    """The reach of a scene preset, as stored with the package; ``landing`` is "rest" or "touchdown"."""
    found = json.loads((FOLDER / f"{preset}.json").read_text())[landing]
    return Reach(found["radius"], found["downhill"], tuple(found["boundary"]))


@lru_cache(maxsize=256)
def reach_of(scene: Scene) -> Reach:
    """The documented reach of ``scene``, by its gravity, by whether it slopes, and by where its landing is read.

    A preset has its own. Flat ground with a gravity between two presets' has what lies between theirs, geometrically;
    beyond them, the nearest one's. Sloping ground has the region of preset "slope", in proportion to how much farther or
    less far hops go on flat ground with that gravity. Nothing else of a scene is taken into account.
    """
    flat = _flat_reach(scene.gravity, scene.landing)
    if scene.slope == 0:
        return flat
    slope = Scene.PRESETS["slope"]["gravity"]
    if scene.gravity == slope:
        return stored_reach("slope", scene.landing)
    return stored_reach("slope", scene.landing).scaled(flat.radius / _flat_reach(slope, scene.landing).radius)


def _flat_reach(gravity: float, landing: str) -> Reach:
    flat = sorted((values["gravity"], name) for name, values in Scene.PRESETS.items() if not values.get("slope"))
    at = np.log(np.clip(gravity, flat[0][0], flat[-1][0]))
    known = [stored_reach(name, landing) for _, name in flat]
    logs = np.log([g for g, _ in flat])
    below = min(int(np.searchsorted(logs, at, side="right")) - 1, len(flat) - 1)
    above = min(below + 1, len(flat) - 1)
    share = 0.0 if above == below else float((at - logs[below]) / (logs[above] - logs[below]))
    if share == 0:
        return known[below]
    ends = [np.log([known[k].radius, *known[k].boundary]) for k in (below, above)]
    radius, *boundary = np.exp((1 - share) * ends[0] + share * ends[1])
    return Reach(float(radius), 0.0, tuple(float(b) for b in boundary))


def measure_reach(scene: Scene, hops: int = 256, seed: int = 0, progress: Progress | None = None) -> dict[str, Reach]:
    """Simulate ``hops`` hops with Sobol stretches; for "rest" and "touchdown", the region of their landings.

    The lattice's symmetries map hops onto hops (on a slope, those that keep its direction), so each counts with its images.
    """
    result = simulate(sample_stretches(hops, seed), scene=scene, progress=progress)
    return {landing: _region_of(_landings(result, landing), scene) for landing in LANDINGS}


def _landings(result: HopResult, landing: str) -> Floats:
    """Landings of the hops that have one, shape (n, 2) [m]."""
    never_down = np.isin(result.status, (HopStatus.NO_FLIGHT, HopStatus.IN_FLIGHT))
    bad = result.failed | (never_down if landing == "touchdown" else False)
    if bad.all():
        raise InvalidParameterError(f"measure_reach: expected a hop with a landing, got none out of {len(bad)}")
    return getattr(result, landing)[~bad]


def _region_of(landings: Floats, scene: Scene) -> Reach:
    downhill = np.array((np.cos(scene.slope_direction), np.sin(scene.slope_direction)))
    signs = Lattice(2, 2).symmetry_signs
    if scene.slope > 0:
        signs = signs[np.isclose(signs * downhill, downhill).all(axis=1)]
    points = np.concatenate([landings * s for s in signs])
    shift = float(points.mean(axis=0) @ downhill) if scene.slope > 0 else 0.0
    points = points - shift * downhill
    away = np.linalg.norm(points, axis=1)
    angle = np.arctan2(points[:, 1], points[:, 0]) - (scene.slope_direction if scene.slope > 0 else 0.0)
    boundary = []
    for direction in np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS):
        near = np.abs(np.angle(np.exp(1j * (angle - direction)))) <= WINDOW
        boundary.append(float(np.quantile(away[near], SHARE)) if near.any() else 0.0)
    return Reach(float(np.quantile(away, SHARE)), shift, tuple(boundary))


def save_reach(preset: str, measured: dict[str, Reach], hops: int, seed: int, folder: Path = FOLDER) -> Path:
    """Write what :func:`measure_reach` found for a preset, with what it was made by; returns the file's path."""
    content: dict[str, Any] = {
        "command": f"python -m tensegrity_gym reach --scene {preset} --hops {hops} --seed {seed} --save",
        "model_version": MODEL_VERSION,
        "scene": asdict(replace(Scene.preset(preset), landing="rest")),
        "units": "m",
    }
    for landing, reach in measured.items():
        rounded = [round(b, 5) for b in reach.boundary]
        content[landing] = {"radius": round(reach.radius, 5), "downhill": round(reach.downhill, 5), "boundary": rounded}
    path = folder / f"{preset}.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    return path
