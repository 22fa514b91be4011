"""The landing task: where targets lie, what is observed, what is rewarded. Batched, pure, and written once.

Every env calls these functions; none of them simulates except :func:`measure_reach`, which is how the table of reaches
was made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import qmc

from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.formfinding import STRETCH_RANGE
from tensegrity_gym.scene import Scene
from tensegrity_gym.simulate import simulate
from tensegrity_gym.types import Floats, HopStatus

#: Reward of a hop that failed (unstable or not converged), and the least reward that any hop gets [reaches].
WORST_REWARD = -5.0
#: An error of less than this is a success, by default [reaches].
SUCCESS_RADIUS = 0.1
#: Targets may be asked for up to this distance from the middle of the reachable disc [reaches].
TARGET_LIMIT = 2.0
#: Scene values that may be randomised, in the order in which they are observed, with units [m/s^2], [-], [rad].
SCENE_VALUES = ("gravity", "friction", "slope")


@dataclass(frozen=True)
class Reach:
    """The disc that holds 95 % of the landings of hops with stretches spread evenly over their range."""

    radius: float
    """95th percentile of the distance from the middle [m]."""
    downhill: float = 0.0
    """How far the middle, the mean landing, lies downhill of the start [m]."""


#: Measured reaches of the default design's 2x2 lattice, by preset and by where the landing is read; made by
#: ``python -m tensegrity_gym reach --scene NAME --hops 256``.
REACHES: dict[str, dict[str, Reach]] = {
    "earth": {"rest": Reach(1.766), "touchdown": Reach(0.156)},
    "moon": {"rest": Reach(11.140), "touchdown": Reach(1.111)},
    "mars": {"rest": Reach(5.454), "touchdown": Reach(0.491)},
    "titan": {"rest": Reach(13.096), "touchdown": Reach(1.335)},
    "slope": {"rest": Reach(3.422, downhill=1.705), "touchdown": Reach(0.383, downhill=0.461)},
}

_FAILED = (int(HopStatus.UNSTABLE), int(HopStatus.NOT_CONVERGED))


def reach_of(scene: Scene) -> Reach:
    """The documented reach of ``scene``: that of the preset most like it.

    Alike is measured by slope first (flat or not), then by the ratio of gravities: a scene between the presets gets the
    nearest one's reach, so that rewards in a randomised scene stay comparable.
    """

    def unlikeness(name: str) -> tuple[bool, float]:
        preset = Scene.preset(name)
        return (preset.slope > 0) != (scene.slope > 0), abs(float(np.log(preset.gravity / scene.gravity)))

    return REACHES[min(REACHES, key=unlikeness)][scene.landing]


def reach(scene: Scene) -> float:
    """Radius of the reachable disc [m]: the unit of landing errors in ``scene``."""
    return reach_of(scene).radius


def reachable_middle(scene: Scene) -> Floats:
    """Middle of the reachable disc, relative to the start of the hop, shape (2,) [m]."""
    return reach_of(scene).downhill * np.array((np.cos(scene.slope_direction), np.sin(scene.slope_direction)))


def measure_reach(scene: Scene, hops: int = 256, seed: int = 0) -> dict[str, Reach]:
    """Simulate ``hops`` hops with Sobol stretches; for "rest" and "touchdown", the disc that holds 95 % of landings."""
    low, high = STRETCH_RANGE
    sobol = qmc.Sobol(d=4, seed=seed).random_base2(int(np.ceil(np.log2(hops))))[:hops]
    result = simulate(low + (high - low) * sobol, scene=scene)
    landed = ~failed(result.status)
    if not landed.any():
        raise InvalidParameterError(f"measure_reach: expected at least one of {hops} hops to succeed in {scene}, none did")
    return {
        "rest": _disc_of(result.rest[landed], scene),
        "touchdown": _disc_of(result.touchdown[landed & (result.flight_time > 0)], scene),
    }


def _disc_of(landing: Floats, scene: Scene) -> Reach:
    direction = np.array((np.cos(scene.slope_direction), np.sin(scene.slope_direction)))
    downhill = float(landing.mean(axis=0) @ direction) if scene.slope > 0 else 0.0
    return Reach(float(np.quantile(np.linalg.norm(landing - downhill * direction, axis=1), 0.95)), downhill)


def sample_targets(rng: np.random.Generator, n: int, scene: Scene) -> Floats:
    """Targets drawn uniformly from the reachable disc of ``scene``, shape (n, 2) [m]."""
    radius = reach(scene) * np.sqrt(rng.random(n))
    angle = 2 * np.pi * rng.random(n)
    return reachable_middle(scene) + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def failed(status: ArrayLike) -> np.ndarray:
    """True where a hop has no landing to speak of: unstable or not converged, shape as ``status``."""
    return np.isin(status, _FAILED)


def landing_error(landing: ArrayLike, target: ArrayLike) -> Floats:
    """Distance between landings and targets, shapes (n, 2) -> (n,) [m]."""
    difference = np.asarray(landing, dtype=np.float64) - np.asarray(target, dtype=np.float64)
    return np.hypot(difference[..., 0], difference[..., 1])


def reward(landing: ArrayLike, target: ArrayLike, status: ArrayLike, reach: ArrayLike) -> Floats:
    """Minus the landing error over the reach, never below ``WORST_REWARD``, which failed hops get, shape (n,) [-]."""
    error = landing_error(landing, target)
    lost = failed(status) | ~np.isfinite(error)
    return np.where(lost, WORST_REWARD, np.maximum(-np.where(lost, 0.0, error) / np.asarray(reach), WORST_REWARD))


def success(landing: ArrayLike, target: ArrayLike, status: ArrayLike, radius: ArrayLike) -> np.ndarray:
    """True where a hop that did not fail landed within ``radius`` [m] of its target, shape (n,)."""
    return ~failed(status) & (landing_error(landing, target) <= np.asarray(radius))


@dataclass(frozen=True)
class SceneRanges:
    """Scenes drawn at random: a base scene, and the values of it that are drawn uniformly from ranges."""

    base: Scene = field(default_factory=Scene)
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Range (low, high) of each randomised value; keys out of ``SCENE_VALUES``, units as theirs."""

    def __post_init__(self) -> None:
        for name, bounds in self.ranges.items():
            if name not in SCENE_VALUES:
                raise InvalidParameterError(f"scene ranges: expected keys out of {SCENE_VALUES}, got {name!r}")
            _check_range(name, bounds)
            for bound in bounds:  # a bound that no scene can have is refused now, not at some later reset
                self._with({name: bound})

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
        return [self._with(dict(zip(self.observed, values, strict=True))) for values in ends]

    def sample(self, rng: np.random.Generator) -> Scene:
        """One scene."""
        if not self.ranges:
            return self.base
        return self._with({name: rng.uniform(*self.ranges[name]) for name in self.observed})

    def _with(self, values: Mapping[str, float]) -> Scene:
        changes: dict[str, Any] = {name: float(value) for name, value in values.items()}
        return replace(self.base, **changes)


def scene_ranges(scene: str | Scene | SceneRanges | Mapping[str, Any], landing: str | None = None) -> SceneRanges:
    """What an env's ``scene=`` means: a preset's name, a Scene, or ranges such as ``{"gravity": (1.6, 9.8)}``.

    In a mapping, ``"preset"`` names the base scene (default "earth"), a pair is a range and a number fixes a value.
    ``landing`` ("rest" or "touchdown"), where given, replaces where the landing is read.
    """
    if isinstance(scene, SceneRanges):
        found = scene
    elif isinstance(scene, Scene):
        found = SceneRanges(scene)
    elif isinstance(scene, str):
        found = SceneRanges(Scene.preset(scene))
    elif isinstance(scene, Mapping):
        values = dict(scene)
        ranges = {k: tuple(v) for k, v in values.items() if k != "preset" and isinstance(v, (tuple, list))}
        fixed = {k: v for k, v in values.items() if k != "preset" and k not in ranges}
        unknown = [k for k in fixed if k not in Scene.__dataclass_fields__]
        if unknown:
            raise InvalidParameterError(f"scene: expected keys out of {sorted(Scene.__dataclass_fields__)}, got {unknown}")
        found = SceneRanges(Scene.preset(values.get("preset", "earth"), **fixed), ranges)  # type: ignore[arg-type]
    else:
        raise InvalidParameterError(f"scene: expected a preset's name, a Scene or a mapping of ranges, got {scene!r}")
    return found if landing is None else SceneRanges(replace(found.base, landing=landing), found.ranges)


def observation_bounds(scenes: SceneRanges) -> tuple[Floats, Floats]:
    """Least and greatest observation, shapes (2 + k,): target x, y [m], then what is randomised."""
    low, high = scenes.bounds()
    reaches = [reach_of(corner) for corner in scenes.corners()]
    far = max(r.downhill + TARGET_LIMIT * r.radius for r in reaches)
    return np.concatenate([[-far, -far], low]), np.concatenate([[far, far], high])


def observe(target: ArrayLike, scene: Scene, names: Sequence[str] = ()) -> np.ndarray:
    """Observation of targets in one scene, shapes (n, 2) -> (n, 2 + k), float32: target [m], then the values in ``names``."""
    target = np.asarray(target, dtype=np.float32)
    values = np.array([getattr(scene, name) for name in names], dtype=np.float32)
    return np.concatenate([target, np.broadcast_to(values, (*target.shape[:-1], len(values)))], axis=-1)


def check_target(target: ArrayLike, scene: Scene) -> Floats:
    """A target asked for by the user, as shape (2,) [m]; InvalidParameterError if it's out of the observation's bounds."""
    try:
        point = np.asarray(target, dtype=np.float64)
    except (TypeError, ValueError):
        point = np.zeros(0)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise InvalidParameterError(f"target: expected two finite numbers (x, y) [m], got {target!r}")
    limit = TARGET_LIMIT * reach(scene)
    distance = float(np.hypot(*(point - reachable_middle(scene))))
    if distance > limit:
        raise InvalidParameterError(
            f"target: expected within {limit:.3f} m ({TARGET_LIMIT:g} reaches) of the reachable disc's middle, "
            f"got {tuple(point)} at {distance:.3f} m"
        )
    return point


def _check_range(name: str, bounds: Any) -> None:
    if len(bounds) != 2 or not all(isinstance(b, (int, float, np.number)) and np.isfinite(b) for b in bounds):
        raise InvalidParameterError(f"scene ranges: {name}: expected (low, high), two finite numbers, got {bounds!r}")
    if not bounds[0] < bounds[1]:
        raise InvalidParameterError(f"scene ranges: {name}: expected low < high (a number fixes a value), got {bounds!r}")
