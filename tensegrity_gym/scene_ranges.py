"""Scenes drawn at random, for domain randomisation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import product
from typing import Any

import numpy as np

from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.scene import Scene
from tensegrity_gym.types import Floats

#: Scene values that may be randomised, in the order in which they are observed, with units [m/s^2], [-], [rad].
SCENE_VALUES = ("gravity", "friction", "slope")


@dataclass(frozen=True)
class SceneRanges:
    """Scenes drawn at random: a base scene, and the values of it that are drawn uniformly from ranges."""

    base: Scene = field(default_factory=Scene)
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Range (low, high) of each randomised value; keys out of ``SCENE_VALUES``, units as theirs."""
    lasting: bool = False
    """Whether scenes of weaker gravity than the base's are followed for longer (``Scene.lasting``), so that hops come down."""

    def __post_init__(self) -> None:
        for name, bounds in self.ranges.items():
            if name not in SCENE_VALUES:
                raise InvalidParameterError(f"scene ranges: expected keys out of {SCENE_VALUES}, got {name!r}")
            _check_range(name, bounds)
            for bound in bounds:  # a bound that no scene can have is refused now, not at some later reset
                self.changed(self.base, {name: bound})

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of the randomised values in the order in which they are observed."""
        return tuple(name for name in SCENE_VALUES if name in self.ranges)

    def bounds(self) -> tuple[Floats, Floats]:
        """Least and greatest of the randomised values, in observed order, shapes (k,)."""
        pairs = np.array([self.ranges[name] for name in self.observed], dtype=np.float64).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def corners(self) -> list[Scene]:
        """The scenes whose randomised values are all at one end of their range; reaches are widest in one of them."""
        ends = product(*(self.ranges[name] for name in self.observed))
        return [self.changed(self.base, dict(zip(self.observed, values, strict=True))) for values in ends]

    def sample(self, rng: np.random.Generator) -> Scene:
        """One scene."""
        if not self.ranges:
            return self.base
        return self.changed(self.base, {name: float(rng.uniform(*self.ranges[name])) for name in self.observed})

    def changed(self, scene: Scene, values: Mapping[str, Any]) -> Scene:
        """``scene`` with some of its values changed; InvalidParameterError for values that no scene has."""
        known = {f.name for f in fields(Scene)}
        unknown = [k for k in values if k not in known]
        if unknown:
            raise InvalidParameterError(f"scene: expected keys out of {sorted(known)}, got {unknown}")
        found = replace(scene, **values)
        if self.lasting and "gravity" in values and "duration" not in values:
            found = replace(found, duration=self.base.duration).lasting()
        return found


def scene_ranges(scene: str | Scene | SceneRanges | Mapping[str, Any], landing: str | None = None) -> SceneRanges:
    """What an env's ``scene=`` means: a preset's name, a Scene, or ranges such as ``{"gravity": (1.6, 9.8)}``.

    In a mapping, ``"preset"`` names the base scene (default "earth"), a pair is a range and a number fixes a value; where it has
    no ``"duration"``, hops under weaker gravity than the preset's are followed longer (``Scene.lasting``).
    ``landing`` ("rest" or "touchdown"), where given, replaces where the landing is read.
    """
    if isinstance(scene, SceneRanges):
        found = scene
    elif isinstance(scene, Scene):
        found = SceneRanges(scene)
    elif isinstance(scene, str):
        found = SceneRanges(Scene.preset(scene))
    elif isinstance(scene, Mapping) and "base" in scene:  # ranges, as a spec of an env that was read from JSON has them
        found = _read_back(scene)
    elif isinstance(scene, Mapping):
        values = dict(scene)
        ranges = {k: tuple(v) for k, v in values.items() if k != "preset" and isinstance(v, (tuple, list))}
        fixed = {k: v for k, v in values.items() if k != "preset" and k not in ranges}
        lasting = "duration" not in fixed
        base = SceneRanges(preset := Scene.preset(values.get("preset", "earth")), lasting=lasting).changed(preset, fixed)
        found = SceneRanges(base, ranges, lasting)  # type: ignore[arg-type]
    else:
        raise InvalidParameterError(f"scene: expected a preset's name, a Scene or a mapping of ranges, got {scene!r}")
    return found if landing is None else replace(found, base=replace(found.base, landing=landing))


def _read_back(plain: Mapping[str, Any]) -> SceneRanges:
    known = {f.name for f in fields(SceneRanges)}
    if not set(plain) <= known or not isinstance(plain["base"], Mapping) or not isinstance(plain.get("ranges", {}), Mapping):
        raise InvalidParameterError(f"scene: expected the fields {sorted(known)} of SceneRanges, got {dict(plain)}")
    ranges = {name: tuple(bounds) for name, bounds in plain.get("ranges", {}).items()}
    base = SceneRanges().changed(Scene(), plain["base"])
    return SceneRanges(base, ranges, bool(plain.get("lasting", False)))  # type: ignore[arg-type]


def _check_range(name: str, bounds: Any) -> None:
    if len(bounds) != 2 or not all(isinstance(b, (int, float, np.number)) and np.isfinite(b) for b in bounds):
        raise InvalidParameterError(f"scene ranges: {name}: expected (low, high), two finite numbers, got {bounds!r}")
    if not bounds[0] < bounds[1]:
        raise InvalidParameterError(f"scene ranges: {name}: expected low < high (a number fixes a value), got {bounds!r}")
