"""``TensegrityTravel-v0``: hop after hop to a goal that is too far for one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tensegrity_gym import task
from tensegrity_gym.auto import choose_fidelity
from tensegrity_gym.design import Design
from tensegrity_gym.env import plain_seed, show
from tensegrity_gym.errors import InvalidParameterError, ResetNeededError
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.formfinding import STRETCH_RANGE
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.scene_ranges import SceneRanges, scene_ranges
from tensegrity_gym.simulate import simulate
from tensegrity_gym.types import Floats, HopStatus
from tensegrity_gym.viewer import RENDER_FPS, RENDER_MODES, Viewer, check_render_mode

#: Hops are followed for this many times the scene's duration, so that nearly all come to rest.
PATIENCE = 2.0
#: Half a turn about the diagonal x = y: maps the lattice onto itself, upside down.
FLIP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Pose:
    """How a lattice lies, as the canonical one turned and shifted."""

    heading: float
    """Angle from the canonical to the actual lattice about the vertical [rad], in (-pi, pi]."""
    upside_down: bool
    """Whether it lies on what was its top at first; by symmetry that is the same lattice, its cells renumbered."""
    tilt: float
    """Angle by which it still leaned when the hop ended [rad]: what making the pose canonical took away."""


def read_pose(nodes: Floats, lattice: Lattice) -> Pose:
    """The pose of a lattice whose nodes lie at (n_nodes, 3) [m]: the best rigid fit, then the nearest of both faces."""
    reference = _reference(lattice)
    centred = nodes[: lattice.n_nodes] - nodes[: lattice.n_nodes].mean(axis=0)
    left, _, right = np.linalg.svd(reference.T @ centred)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = (left @ mirror @ right).T  # nodes = turn @ reference
    upside_down = bool(turn[2, 2] < 0)
    upright = turn @ FLIP if upside_down else turn
    heading = float(np.arctan2(upright[1, 0] - upright[0, 1], upright[0, 0] + upright[1, 1]))
    return Pose(heading, upside_down, float(np.arccos(np.clip(abs(turn[2, 2]), 0.0, 1.0))))


@lru_cache(maxsize=4)
def _reference(lattice: Lattice) -> Floats:
    nodes = Design().unloaded_nodes(lattice)
    return nodes - nodes.mean(axis=0)


def turned(points: Floats, angle: float) -> Floats:
    """Horizontal vectors (..., 2) turned by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]])


class TensegrityTravelEnv(gym.Env[np.ndarray, np.ndarray]):
    """Hop to a far goal; each hop starts where and how the last one came to rest.

    After a hop the lattice lies on one of its two large faces, turned about the vertical. Lying upside down it is, by a
    symmetry of the lattice, the upright lattice with its cells renumbered; so the next hop is simulated from the canonical
    pose, in the lattice's own frame, and its landing is turned and shifted back. Stretches are numbered as the lattice
    stands. If a hop ended before the lattice lay flat, it is laid onto the nearer face (``info["tilt"]`` says by how much).

    Observation: Box float32, all in the lattice's own frame: goal x, y from here [m]; sine of the slope times the downhill
    direction (2,) [-], zero on flat ground; then those of gravity, friction and slope that are randomised: shape (4,) to
    (7,). Action: as ``TensegrityHop-v0``. Reward per hop: how much nearer the goal is [reaches], minus ``hop_cost``, plus
    ``success_bonus`` on arrival; never below ``task.WORST_REWARD``, which a failed hop gets. Terminates on arrival within
    ``success_radius`` and on failure; truncates after ``max_hops``.

    Args:
        scene: a preset's name, a Scene, or ranges to draw scenes from; landings are always read at rest.
        distance: of the goal from the start [reaches].
        max_hops: hops after which an episode is truncated.
        success_radius: being within this of the goal is arrival [reaches].
        success_bonus: added on arrival [-].
        hop_cost: taken off for every hop [-].
        fidelity: as ``TensegrityHop-v0``; "auto" is chosen once an episode, at its first hop.
        render_mode: as ``TensegrityHop-v0``.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": RENDER_FPS}  # noqa: RUF012 (gymnasium's way)

    def __init__(
        self,
        *,
        scene: str | Scene | SceneRanges | Mapping[str, Any] = "earth",
        distance: float = 5.0,
        max_hops: int = 20,
        success_radius: float = 0.25,
        success_bonus: float = 1.0,
        hop_cost: float = 0.1,
        fidelity: str | Fidelity | Mapping[str, Any] = "paper",
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        for name, value in {"distance": distance, "success_radius": success_radius, "success_bonus": success_bonus}.items():
            _check_number(name, value)
        _check_number("hop_cost", hop_cost)
        if isinstance(max_hops, bool) or not isinstance(max_hops, (int, np.integer)) or max_hops < 1:
            raise InvalidParameterError(f"max_hops: expected an integer >= 1, got {max_hops!r}")
        self.lattice = Lattice(2, 2)
        self.scenes = scene_ranges(scene, "rest")
        self.levers = task.check_fidelity(fidelity)
        self.distance, self.max_hops = float(distance), int(max_hops)
        self.success_radius, self.success_bonus, self.hop_cost = success_radius, success_bonus, hop_cost
        self.observation_space = _observation_space(self.scenes, self.distance, self.max_hops)
        self.action_space = spaces.Box(STRETCH_RANGE[0], STRETCH_RANGE[1], shape=(self.lattice.n_cells,), dtype=np.float32)
        #: Hops simulated since the env was made.
        self.simulator_calls = 0
        self._viewer = Viewer(render_mode, self.lattice)
        self._running = False
        self._hops = 0
        self._levers = self.levers
        self.scene = self.scenes.base
        self.heading = 0.0
        self.position: Floats = np.zeros(2)
        self.goal: Floats = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start at the origin; a goal in a random direction, or at ``options={"goal": (x, y)}`` [m].

        Info: ``goal``, ``position`` (2,) [m], ``heading`` [rad], ``distance``, ``reach`` [m], ``hops``.
        """
        super().reset(seed=plain_seed(seed))
        unknown = sorted(set(options or {}) - {"goal"})
        if unknown:
            raise InvalidParameterError(f"reset options: expected keys out of ['goal'], got {unknown}")
        self.scene = self.scenes.sample(self.np_random)
        direction = 2 * np.pi * self.np_random.random()
        reach = task.reach(self.scene)
        goal: Floats = self.distance * reach * np.array((np.cos(direction), np.sin(direction)))
        if options and options.get("goal") is not None:
            box = self.observation_space
            assert isinstance(box, spaces.Box)
            goal = _check_goal(options["goal"], float(box.high[0]))
        self.goal, self.position, self.heading = goal, np.zeros(2), 0.0
        self._levers = self.levers
        self._hops, self._running = 0, True
        self._viewer.wait(self.goal)
        return self._observe(), {**self._whereabouts(), "reach": reach}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One hop with stretches ``action``, shape (4,), numbered as the lattice stands."""
        if not self._running:
            raise ResetNeededError("step: expected a running episode, got none; call reset() first")
        stretches = task.check_action(action, self.action_space.shape or ())
        start, before = (float(self.position[0]), float(self.position[1]), self.heading), self._distance()
        # flat ground has no downhill: turning it would only make it look like another scene
        downhill = _wrapped(self.scene.slope_direction - self.heading) if self.scene.slope > 0 else 0.0
        scene = replace(self.scene, slope_direction=downhill, duration=PATIENCE * self.scene.duration)
        if self._levers["fidelity"] == "auto":
            # for the scene as it was drawn: each hop's own slopes another way, and would be tried out anew
            self._levers = {**self._levers, "fidelity": choose_fidelity(Design(), self.scene, self.lattice)}
        hop = simulate(stretches, scene=scene, lattice=self.lattice, trajectory_rate=self._viewer.rate, **self._levers)
        self.simulator_calls += 1
        self._hops += 1
        failed = bool(task.failed(hop.status)[0])
        pose = Pose(0.0, False, 0.0)
        landing: Floats = np.zeros(2)
        if not failed:
            landing = turned(hop.rest[0], self.heading)
            pose = read_pose(hop.end_nodes[0], self.lattice)  # not a frame: those depend on what is rendered
            self.position = self.position + landing
            self.heading = _wrapped(self.heading + pose.heading)
            self._viewer.hop(hop, 0, start)
        reach = task.reach(self.scene)
        arrived = not failed and self._distance() <= self.success_radius * reach
        reward = (before - self._distance()) / reach - self.hop_cost + self.success_bonus * arrived
        self._running = not (arrived or failed or self._hops >= self.max_hops)
        info = {
            **self._whereabouts(),
            "landing": landing,
            "upside_down": pose.upside_down,
            "tilt": pose.tilt,
            "success": arrived,
            "apex": float(hop.apex[0]),
            "energies": hop.energies[0].copy(),
            "stored_energy": float(hop.stored_energy[0]),
            "status": HopStatus(int(hop.status[0])),
            "simulator_calls": 1,
        }
        terminated = arrived or failed
        reward = task.WORST_REWARD if failed else max(float(reward), task.WORST_REWARD)
        return self._observe(), reward, terminated, not terminated and not self._running, info

    def render(self) -> np.ndarray | list[np.ndarray] | None:  # type: ignore[override]
        """What ``render_mode`` says: a picture (h, w, 3) uint8, a list of them, or None."""
        return show(self._viewer)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._viewer.close()

    def _distance(self) -> float:
        return float(np.hypot(*(self.goal - self.position)))

    def _observe(self) -> np.ndarray:
        goal = turned(self.goal - self.position, -self.heading)
        direction = self.scene.slope_direction - self.heading
        downhill = np.sin(self.scene.slope) * np.array((np.cos(direction), np.sin(direction)))
        values = [getattr(self.scene, name) for name in self.scenes.observed]
        box = self.observation_space
        assert isinstance(box, spaces.Box)
        return np.clip(np.concatenate([goal, downhill, values]).astype(np.float32), box.low, box.high)

    def _whereabouts(self) -> dict[str, Any]:
        return {
            "goal": self.goal.copy(),
            "position": self.position.copy(),
            "heading": self.heading,
            "distance": self._distance(),
            "hops": self._hops,
        }


def _observation_space(scenes: SceneRanges, distance: float, max_hops: int) -> spaces.Box:
    """Far enough for ``max_hops`` of the farthest hops away from the goal; what goes beyond is clipped."""
    reach = max(task.reach(corner) for corner in scenes.corners())
    far = distance * reach + max_hops * task.farthest_target(scenes)
    low, high = scenes.bounds()
    return spaces.Box(
        np.concatenate([[-far, -far, -1, -1], low]).astype(np.float32),
        np.concatenate([[far, far, 1, 1], high]).astype(np.float32),
        dtype=np.float32,
    )


def _wrapped(angle: float) -> float:
    """The same angle in [-pi, pi) [rad]."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _check_number(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not 0 <= value < np.inf:
        raise InvalidParameterError(f"{name}: expected a finite number >= 0, got {value!r}")


def _check_goal(goal: Any, limit: float) -> Floats:
    try:
        point = np.asarray(goal, dtype=np.float64)
    except (TypeError, ValueError):
        point = np.zeros(0)
    if point.shape != (2,) or not np.isfinite(point).all() or np.hypot(*point) > limit:
        raise InvalidParameterError(f"goal: expected two finite numbers (x, y) within {limit:.3f} m of the start, got {goal!r}")
    return point
