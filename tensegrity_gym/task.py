"""The landing task: where targets lie, what is observed, what is simulated and what is rewarded. Batched, written once.

Every env, single or vector, calls these functions and adds nothing of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tensegrity_gym.batch import thread_count
from tensegrity_gym.design import Design
from tensegrity_gym.errors import InvalidParameterError, InvalidStretchesError
from tensegrity_gym.fidelity import NAMES, Fidelity, changed, named_fidelity
from tensegrity_gym.formfinding import STRETCH_RANGE
from tensegrity_gym.hops import HopResult, time_step
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.reachable import reach_of
from tensegrity_gym.scene import Scene
from tensegrity_gym.scene_ranges import SceneRanges
from tensegrity_gym.simulate import simulate
from tensegrity_gym.types import Floats, HopStatus

#: Reward of a hop that failed (unstable or not converged), and the least reward that any hop gets [-].
WORST_REWARD = -5.0
#: An error of less than this is a success, by default [reaches].
SUCCESS_RADIUS = 0.1
#: Targets may be asked for up to this distance from the middle of the reachable region [reaches].
TARGET_LIMIT = 2.0
#: Where targets may be drawn from: evenly from the reachable region, on its boundary, or from beyond it.
TARGET_PLACES = ("inside", "boundary", "beyond")
#: Targets from beyond lie between these multiples of the boundary's distance, but within TARGET_LIMIT.
BEYOND = (1.1, 1.5)
#: What a fidelity may be made of, if it is given as a mapping.
LEVERS = ("dt", *(f.name for f in fields(Fidelity) if f.name != "reason"))

#: How far a rounded action may lie out of its range [-]: four units in the last place of float32 there.
ROUNDING = 4 * float(np.spacing(np.float32(STRETCH_RANGE[1])))

_FAILED = (int(HopStatus.UNSTABLE), int(HopStatus.NOT_CONVERGED))


def reach(scene: Scene) -> float:
    """Radius of the disc that holds 95 % of the landings [m]: the unit of landing errors in ``scene``."""
    return reach_of(scene).radius


def reachable_middle(scene: Scene) -> Floats:
    """Middle of the reachable region, relative to the start of the hop, shape (2,) [m]."""
    return reach_of(scene).downhill * np.array((np.cos(scene.slope_direction), np.sin(scene.slope_direction)))


def reachable(target: ArrayLike, scene: Scene) -> np.ndarray:
    """True where a target lies in the reachable region of ``scene``, shapes (n, 2) -> (n,)."""
    away = np.asarray(target, dtype=np.float64) - reachable_middle(scene)
    direction = np.arctan2(away[..., 1], away[..., 0]) - (scene.slope_direction if scene.slope > 0 else 0.0)
    return np.hypot(away[..., 0], away[..., 1]) <= reach_of(scene).distance(direction)


def sample_targets(rng: np.random.Generator, n: int, scene: Scene, place: str = "inside") -> Floats:
    """Targets drawn evenly from the reachable region of ``scene``, its boundary or beyond it, shape (n, 2) [m]."""
    if place not in TARGET_PLACES:
        raise InvalidParameterError(f"target: expected one of {TARGET_PLACES} or two numbers (x, y) [m], got {place!r}")
    region = reach_of(scene)
    share, depth = rng.random((n, 2)).T
    direction = region.directions(share)
    distance = region.distance(direction)
    if place == "inside":
        distance = distance * np.sqrt(depth)
    elif place == "beyond":
        distance = np.minimum(distance * (BEYOND[0] + (BEYOND[1] - BEYOND[0]) * depth), TARGET_LIMIT * region.radius)
    angle = direction + (scene.slope_direction if scene.slope > 0 else 0.0)
    return reachable_middle(scene) + distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def failed(status: ArrayLike) -> np.ndarray:
    """True where a hop has no landing to speak of: unstable or not converged, shape as ``status``."""
    return np.isin(status, _FAILED)


def landing_error(landing: ArrayLike, target: ArrayLike) -> Floats:
    """Distance between landings and targets, shapes (n, 2) -> (n,) [m]."""
    difference = np.asarray(landing, dtype=np.float64) - np.asarray(target, dtype=np.float64)
    return np.hypot(difference[..., 0], difference[..., 1])


def success(landing: ArrayLike, target: ArrayLike, status: ArrayLike, radius: ArrayLike) -> np.ndarray:
    """True where a hop that did not fail landed within ``radius`` [m] of its target, shape (n,)."""
    return ~failed(status) & (landing_error(landing, target) <= np.asarray(radius))


@dataclass(frozen=True)
class RewardRule:
    """What is added to minus the landing error over the reach."""

    success_radius: float = SUCCESS_RADIUS
    """Errors up to this are a success [reaches]."""
    success_bonus: float = 0.0
    """Added for a success [-]."""
    energy_cost: float = 0.0
    """Taken off per joule that was stored for the hop [1/J]."""

    def __post_init__(self) -> None:
        for name in ("success_radius", "success_bonus", "energy_cost"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not 0 <= value < np.inf:
                raise InvalidParameterError(f"{name}: expected a finite number >= 0, got {value!r}")


PLAIN_RULE = RewardRule()


def reward(
    landing: ArrayLike,
    target: ArrayLike,
    status: ArrayLike,
    reach: ArrayLike,
    stored_energy: ArrayLike = 0.0,
    rule: RewardRule = PLAIN_RULE,
) -> Floats:
    """Minus the landing error over the reach [m], with ``rule``'s bonus and cost of the ``stored_energy`` [J], shape (n,) [-].

    Never below ``WORST_REWARD``, which failed hops get.
    """
    error = landing_error(landing, target)
    lost = failed(status) | ~np.isfinite(error)
    score = -np.where(lost, 0.0, error) / np.asarray(reach) - rule.energy_cost * np.asarray(stored_energy)
    if rule.success_bonus:
        score = score + rule.success_bonus * success(landing, target, status, rule.success_radius * np.asarray(reach))
    return np.where(lost, WORST_REWARD, np.maximum(score, WORST_REWARD))


@dataclass(frozen=True)
class Episode:
    """What an episode asks for: a target in a scene."""

    scene: Scene
    target: Floats
    """As observed, in float32's digits: what is scored, shape (2,) [m]."""
    observation: np.ndarray
    """float32, shape (2 + k,)."""

    def info(self) -> dict[str, Any]:
        """What ``reset`` says: "target" (2,) [m], "reach" [m], "reachable"."""
        known = bool(reachable(self.target, self.scene))
        return {"target": self.target.copy(), "reach": reach(self.scene), "reachable": known}


def draw_episode(
    rng: np.random.Generator, scenes: SceneRanges, place: str | ArrayLike = "inside", options: Mapping[str, Any] | None = None
) -> Episode:
    """A scene and a target: drawn from ``rng``, or as ``options`` "scene" and "target" say.

    ``place`` is where targets come from: one of ``TARGET_PLACES`` or a point (x, y) [m].
    """
    options = options or {}
    unknown = sorted(set(options) - {"target", "scene"})
    if unknown:
        raise InvalidParameterError(f"reset options: expected keys out of ['scene', 'target'], got {unknown}")
    scene = scenes.sample(rng)
    if options.get("scene") is not None:
        scene = _asked_scene(options["scene"], scene, scenes)
    wanted = place if options.get("target") is None else options["target"]
    target = sample_targets(rng, 1, scene, wanted)[0] if isinstance(wanted, str) else check_target(wanted, scene)
    observation = observe(target, scene, scenes.observed)
    return Episode(scene, observation[:2].astype(np.float64), observation)


def _asked_scene(asked: Any, drawn: Scene, scenes: SceneRanges) -> Scene:
    """The scene that reset was asked for, if it can be observed in this env."""
    if isinstance(asked, Mapping):
        scene = scenes.changed(drawn, asked)
    elif isinstance(asked, str):
        scene = replace(Scene.preset(asked), landing=drawn.landing)
    elif isinstance(asked, Scene):
        scene = asked
    else:
        raise InvalidParameterError(f"reset options: scene: expected a preset's name, a Scene or a mapping, got {asked!r}")
    for name in scenes.observed:
        low, high = scenes.ranges[name]
        if not low <= getattr(scene, name) <= high:
            raise InvalidParameterError(f"reset options: scene: expected {name} in [{low}, {high}], got {getattr(scene, name)}")
    limit, wanted = farthest_target(scenes), reach_of(scene).downhill + TARGET_LIMIT * reach(scene)
    if wanted > limit * (1 + 1e-9):
        raise InvalidParameterError(
            f"reset options: scene: targets would lie up to {wanted:.3f} m away, expected at most this env's {limit:.3f} m; "
            "make the env with this scene, or with ranges that hold it"
        )
    return scene


def farthest_target(scenes: SceneRanges) -> float:
    """Greatest distance at which a target may be asked for [m]."""
    reaches = [reach_of(corner) for corner in scenes.corners()]
    return max(r.downhill + TARGET_LIMIT * r.radius for r in reaches)


def observation_bounds(scenes: SceneRanges) -> tuple[Floats, Floats]:
    """Least and greatest observation, shapes (2 + k,): target x, y [m], then what is randomised."""
    low, high = scenes.bounds()
    far = farthest_target(scenes)
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
        raise InvalidParameterError(f"target: expected two finite numbers (x, y) [m] or {TARGET_PLACES}, got {target!r}")
    limit = TARGET_LIMIT * reach(scene)
    distance = float(np.hypot(*(point - reachable_middle(scene))))
    if distance > limit:
        raise InvalidParameterError(
            f"target: expected within {limit:.3f} m ({TARGET_LIMIT:g} reaches) of the reachable region's middle, "
            f"got {tuple(point)} at {distance:.3f} m"
        )
    return point


def check_action(action: Any, shape: tuple[int, ...]) -> Floats:
    """Stretches as float64 within ``STRETCH_RANGE``; InvalidStretchesError where an action is no such thing.

    float32 cannot hold 0.2 and 0.8 exactly, and whoever rescales actions to them, as gymnasium's RescaleAction does, rounds
    once more: an overshoot of up to ``ROUNDING`` is cut off.
    """
    low, high = STRETCH_RANGE
    try:
        given = np.asarray(action)
    except (TypeError, ValueError):  # ragged lists
        given = np.array("ragged")
    if given.dtype.kind not in "fiu":
        raise InvalidStretchesError(f"action: expected real numbers in [{low}, {high}] of shape {shape}, got {action!r}")
    stretches = given.astype(np.float64)
    if stretches.shape != shape:
        raise InvalidStretchesError(f"action: expected shape {shape}, got {stretches.shape}")
    bad = ~((stretches >= low - ROUNDING) & (stretches <= high + ROUNDING))  # NaN fails this too
    if bad.any():
        worst = stretches[np.argmax(bad.any(axis=-1))] if stretches.ndim > 1 else stretches
        raise InvalidStretchesError(
            f"action: expected finite stretches in [{low}, {high}], got {worst}; clip actions, or rescale a policy's "
            "[-1, 1] with gymnasium.wrappers.RescaleAction"
        )
    return np.clip(stretches, low, high)


def check_fidelity(fidelity: str | Fidelity | Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of ``simulate`` that a fidelity means: one of its names, a Fidelity, or a mapping of ``LEVERS``.

    A mapping names what differs from the paper's model.
    """
    if isinstance(fidelity, str) and fidelity in NAMES:
        return {"fidelity": fidelity}
    step = None
    if isinstance(fidelity, Mapping) and set(fidelity) <= {*LEVERS, "reason"}:
        levers = {name: value for name, value in fidelity.items() if name != "reason"}  # which a spec read from JSON carries
        step = levers.pop("dt", None)
        fidelity = changed(named_fidelity("paper"), levers)
    if isinstance(fidelity, Fidelity):
        # what no hop could be simulated with is refused now, not at every step
        time_step(step, fidelity.design(Design()), Lattice(), fidelity, caller="fidelity")
        return {"fidelity": fidelity} | ({} if step is None else {"dt": float(step)})
    raise InvalidParameterError(f"fidelity: expected one of {NAMES}, a Fidelity or a mapping of {LEVERS}, got {fidelity!r}")


def simulate_hops(
    stretches: Floats, scenes: Sequence[Scene], lattice: Lattice, **levers: Any
) -> tuple[list[HopResult], np.ndarray]:
    """Simulate hops, one batch for each scene that occurs; stretches of shape (n, 4), n scenes.

    Returns the batches and, for each hop, its batch and its row in there, shape (n, 2).
    """
    distinct = list(dict.fromkeys(scenes))
    where = np.array([distinct.index(scene) for scene in scenes])
    rows = np.zeros(len(scenes), dtype=np.int64)
    for k in range(len(distinct)):
        rows[where == k] = np.arange((where == k).sum())
    if len(distinct) == 1:
        return [simulate(stretches, scene=distinct[0], lattice=lattice, **levers)], np.column_stack([where, rows])

    def one(k: int) -> HopResult:
        return simulate(stretches[where == k], scene=distinct[k], lattice=lattice, threads=1, **levers)

    with ThreadPoolExecutor(thread_count(None)) as pool:
        return list(pool.map(one, range(len(distinct)))), np.column_stack([where, rows])


def play(
    stretches: Floats, episodes: Sequence[Episode], lattice: Lattice, rule: RewardRule = PLAIN_RULE, **levers: Any
) -> list[tuple[float, dict[str, Any], HopResult, int]]:
    """Hops of n running episodes, stretches of shape (n, 4): of each, reward, info, its batch and its row in there."""
    batches, where = simulate_hops(stretches, [episode.scene for episode in episodes], lattice, **levers)
    outcomes = []
    for episode, (batch, row) in zip(episodes, where, strict=True):
        hop, one = batches[batch], slice(row, row + 1)
        scored = (hop.landing[one], episode.target[None], hop.status[one])
        unit = reach(episode.scene)
        info = {
            "landing": hop.landing[row].copy(),
            "touchdown": hop.touchdown[row].copy(),
            "error": float(landing_error(*scored[:2])[0]),
            "success": bool(success(*scored, rule.success_radius * unit)[0]),
            "apex": float(hop.apex[row]),
            "energies": hop.energies[row].copy(),
            "stored_energy": float(hop.stored_energy[row]),
            "status": HopStatus(int(hop.status[row])),
            "simulator_calls": 1,
        }
        outcomes.append((float(reward(*scored, unit, hop.stored_energy[one], rule)[0]), info, hop, int(row)))
    return outcomes
