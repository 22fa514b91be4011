"""``TensegrityHop-v0``: one hop is one episode of one step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tensegrity_gym import task
from tensegrity_gym.errors import InvalidParameterError, InvalidStretchesError, ResetNeededError
from tensegrity_gym.formfinding import STRETCH_RANGE
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.simulate import HopResult, simulate
from tensegrity_gym.types import HopStatus

#: Rate at which a hop is recorded for rendering [1/s].
RENDER_RATE = 120.0


class TensegrityHopEnv(gym.Env[np.ndarray, np.ndarray]):
    """Choose the four stretches that make the 2x2 lattice land on the target.

    Observation: Box float32, target x, y [m] relative to the start, then those of gravity [m/s^2],
    friction [-] and slope [rad] that are randomised: shape (2,) to (5,). Action: Box(0.2, 0.8, (4,), float32), the stretches [-].
    Reward: minus the landing error over the scene's reach [-], at least ``task.WORST_REWARD``, which failed hops get.
    The first step terminates. Its info: ``landing``, ``touchdown`` (2,) [m], ``error`` [m], ``success``, ``apex`` [m],
    ``energies`` (4, 7) [J], ``status``, ``simulator_calls`` (hops that this step simulated).

    Args:
        scene: a preset's name, a Scene, or ranges to draw scenes from, e.g. ``{"gravity": (1.6, 9.8)}``.
        landing: "rest" or "touchdown": where the landing is read; default: as the scene says.
        success_radius: errors up to this are a success [reaches].
        render_mode: None or "rgb_array", which draws the posture before the hop, then a filmstrip of it.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012 (gymnasium declares it so)

    def __init__(
        self,
        *,
        scene: str | Scene | task.SceneRanges | Mapping[str, Any] = "earth",
        landing: str | None = None,
        success_radius: float = task.SUCCESS_RADIUS,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InvalidParameterError(
                f"render_mode: expected None or one of {self.metadata['render_modes']}, got {render_mode!r}"
            )
        if not np.isfinite(success_radius) or success_radius < 0:
            raise InvalidParameterError(f"success_radius: expected a finite number >= 0 [reaches], got {success_radius!r}")
        self.render_mode = render_mode
        self.success_radius = float(success_radius)
        self.lattice = Lattice(2, 2)
        self.scenes = task.scene_ranges(scene, landing)
        #: Hops simulated since the env was made.
        self.simulator_calls = 0
        low, high = task.observation_bounds(self.scenes)
        self.observation_space = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self.action_space = spaces.Box(STRETCH_RANGE[0], STRETCH_RANGE[1], shape=(self.lattice.n_cells,), dtype=np.float32)
        #: Scene of the running or last episode; None before the first reset.
        self.scene: Scene | None = None
        self._running = False
        self._target = np.zeros(2)
        self._hop: HopResult | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw a scene and a target; ``options={"target": (x, y)}`` [m] sets the target instead.

        Info: ``target`` (2,) [m], ``reach`` [m].
        """
        super().reset(seed=seed)
        options = options or {}
        unknown = sorted(set(options) - {"target"})
        if unknown:
            raise InvalidParameterError(f"reset options: expected keys out of ['target'], got {unknown}")
        scene = self.scenes.sample(self.np_random)
        if options.get("target") is not None:
            target = task.check_target(options["target"], scene)
        else:
            target = task.sample_targets(self.np_random, 1, scene)[0]
        observation = task.observe(target, scene, self.scenes.observed)
        # what is scored is what was observed: the target as float32
        self._target = observation[:2].astype(np.float64)
        self.scene, self._running, self._hop = scene, True, None
        return observation, {"target": self._target.copy(), "reach": task.reach(scene)}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hop with stretches ``action``, shape (4,); terminates."""
        scene = self.scene
        if scene is None or not self._running:
            raise ResetNeededError("step: expected a running episode, got none; call reset() first, one hop ends an episode")
        stretches = check_action(action, self.action_space.shape or ())
        rate = RENDER_RATE if self.render_mode else None
        self._hop = hop = simulate(stretches, scene=scene, lattice=self.lattice, trajectory_rate=rate)
        self.simulator_calls += 1
        self._running = False
        reach = task.reach(scene)
        scored = (hop.landing, self._target[None], hop.status)
        info = {
            "landing": hop.landing[0].copy(),
            "touchdown": hop.touchdown[0].copy(),
            "error": float(task.landing_error(hop.landing, self._target[None])[0]),
            "success": bool(task.success(*scored, self.success_radius * reach)[0]),
            "apex": float(hop.apex[0]),
            "energies": hop.energies[0].copy(),
            "status": HopStatus(int(hop.status[0])),
            "simulator_calls": 1,
        }
        observation = task.observe(self._target, scene, self.scenes.observed)
        return observation, float(task.reward(*scored, reach)[0]), True, False, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Picture of the posture before the hop, or filmstrip of the hop, shape (h, w, 3) uint8."""
        if self.render_mode is None:
            gym.logger.warn("render() was called without a render_mode; make the env with render_mode='rgb_array'")
            return None
        from tensegrity_gym import render  # Pillow is loaded only by those who look

        if self._hop is not None and self._hop.trajectory is not None:
            return render.filmstrip(self._hop.trajectory, lattice=self.lattice, target=self._target)
        return render.waiting_picture(self.lattice, target=self._target)


def check_action(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Stretches as float64 within ``STRETCH_RANGE``; InvalidStretchesError where an action is no such thing.

    float32 cannot hold 0.2 and 0.8 exactly, so bounds are checked as float32 and the overshoot is cut off.
    """
    low, high = STRETCH_RANGE
    try:
        stretches = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidStretchesError(f"action: expected {shape[0]} numbers in [{low}, {high}], got {action!r}") from None
    if stretches.shape != shape:
        raise InvalidStretchesError(f"action: expected shape {shape}, got {stretches.shape}")
    single = stretches.astype(np.float32)
    if not ((single >= np.float32(low)) & (single <= np.float32(high))).all():  # NaN fails this too
        raise InvalidStretchesError(
            f"action: expected finite stretches in [{low}, {high}], got {stretches}; clip actions, or rescale a policy's "
            "[-1, 1] with gymnasium.wrappers.RescaleAction"
        )
    return np.clip(stretches, low, high)


def register_envs() -> None:
    """Register ``TensegrityHop-v0`` with gymnasium; safe to call twice."""
    if "TensegrityHop-v0" not in gym.registry:
        # no max_episode_steps: the env ends its episodes itself
        gym.register("TensegrityHop-v0", entry_point="tensegrity_gym.env:TensegrityHopEnv")
