"""``TensegrityHop-v0``: one hop is one episode of one step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from tensegrity_gym import task
from tensegrity_gym.errors import InvalidParameterError, ResetNeededError
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.formfinding import STRETCH_RANGE
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.scene_ranges import SceneRanges, scene_ranges
from tensegrity_gym.viewer import RENDER_FPS, RENDER_MODES, Viewer, check_render_mode


class HopTask:
    """Options of the hop envs, checked, and the spaces that follow from them."""

    def __init__(
        self,
        scene: str | Scene | SceneRanges | Mapping[str, Any] = "earth",
        landing: str | None = None,
        target: str | ArrayLike = "inside",
        success_radius: float = task.SUCCESS_RADIUS,
        success_bonus: float = 0.0,
        energy_cost: float = 0.0,
        fidelity: str | Fidelity | Mapping[str, Any] = "paper",
    ) -> None:
        self.rule = task.RewardRule(success_radius, success_bonus, energy_cost)
        self.levers = task.check_fidelity(fidelity)
        self.lattice = Lattice(2, 2)
        self.scenes = scene_ranges(scene, landing)
        self.target = target
        low, high = task.observation_bounds(self.scenes)
        self.observation_space = spaces.Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
        self.action_space = spaces.Box(STRETCH_RANGE[0], STRETCH_RANGE[1], shape=(self.lattice.n_cells,), dtype=np.float32)
        if isinstance(target, str):
            if target not in task.TARGET_PLACES:
                raise InvalidParameterError(
                    f"target: expected one of {task.TARGET_PLACES} or two numbers (x, y) [m], got {target!r}"
                )
        else:
            for corner in self.scenes.corners():
                task.check_target(target, corner)

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any] | None = None) -> task.Episode:
        """A new episode."""
        return task.draw_episode(rng, self.scenes, self.target, options)

    def play(self, stretches: np.ndarray, episodes: list[task.Episode], trajectory_rate: float | None = None) -> list[Any]:
        """Hops of running episodes, stretches (n, 4); see :func:`tensegrity_gym.task.play`."""
        return task.play(stretches, episodes, self.lattice, self.rule, trajectory_rate=trajectory_rate, **self.levers)


class TensegrityHopEnv(gym.Env[np.ndarray, np.ndarray]):
    """Choose the four stretches that make the 2x2 lattice land on the target.

    Observation: Box float32, target x, y [m] relative to the start, then those of gravity [m/s^2], friction [-] and
    slope [rad] that are randomised: shape (2,) to (5,). Action: Box(0.2, 0.8, (4,), float32), the stretches [-].
    Reward: minus the landing error over the scene's reach [-], plus ``success_bonus`` for a success, minus
    ``energy_cost`` times the stored energy; at least ``task.WORST_REWARD``, which failed hops get.
    The first step terminates. Its info: ``landing``, ``touchdown`` (2,) [m], ``error`` [m], ``success``, ``apex`` [m],
    ``energies`` (4, 7) [J], ``stored_energy`` [J], ``status``, ``simulator_calls`` (hops that this step simulated).

    Args:
        scene: a preset's name, a Scene, or ranges to draw scenes from, e.g. ``{"gravity": (1.6, 9.8)}``.
        landing: "rest" or "touchdown": where the landing is read; default: as the scene says.
        target: "inside", "boundary" or "beyond" the reachable region, or one point (x, y) [m] for all episodes.
        success_radius: errors up to this are a success [reaches].
        success_bonus: added to the reward of a success [-].
        energy_cost: taken off the reward per joule stored [1/J].
        fidelity: "paper", "single", "flown", "reference", "auto", a Fidelity, or a mapping of what differs from "paper".
        render_mode: None; "rgb_array": the posture before the hop, then a filmstrip of it; "rgb_array_list": all frames
            since the last look, at ``render_fps``; "human": a window that shows them in real time.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": RENDER_FPS}  # noqa: RUF012 (gymnasium's way)

    def __init__(
        self,
        *,
        scene: str | Scene | SceneRanges | Mapping[str, Any] = "earth",
        landing: str | None = None,
        target: str | ArrayLike = "inside",
        success_radius: float = task.SUCCESS_RADIUS,
        success_bonus: float = 0.0,
        energy_cost: float = 0.0,
        fidelity: str | Fidelity | Mapping[str, Any] = "paper",
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = check_render_mode(render_mode)
        self.task = HopTask(scene, landing, target, success_radius, success_bonus, energy_cost, fidelity)
        self.observation_space, self.action_space = self.task.observation_space, self.task.action_space
        #: Hops simulated since the env was made.
        self.simulator_calls = 0
        self._viewer = Viewer(render_mode, self.task.lattice)
        self._episode: task.Episode | None = None
        self._running = False

    @property
    def scenes(self) -> SceneRanges:
        """The scenes that episodes are drawn from."""
        return self.task.scenes

    @property
    def scene(self) -> Scene | None:
        """Scene of the running or last episode; None before the first reset."""
        return self._episode.scene if self._episode else None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw a scene and a target, or take them from ``options``.

        ``options={"target": (x, y)}`` [m] or one of "inside", "boundary", "beyond"; ``options={"scene": ...}``, a preset's
        name, a Scene, or a mapping of the values to fix. Info: ``target`` (2,) [m], ``reach`` [m], ``reachable``.
        """
        super().reset(seed=plain_seed(seed))
        self._episode, self._running = self.task.draw(self.np_random, options), True
        self._viewer.wait(self._episode.target)
        return self._episode.observation.copy(), self._episode.info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hop with stretches ``action``, shape (4,); terminates."""
        if self._episode is None or not self._running:
            raise ResetNeededError("step: expected a running episode, got none; call reset() first, one hop ends an episode")
        stretches = task.check_action(action, self.action_space.shape or ())
        ((reward, info, hop, row),) = self.task.play(stretches[None], [self._episode], self._viewer.rate)
        self.simulator_calls += 1
        self._running = False
        self._viewer.hop(hop, row)
        return self._episode.observation.copy(), reward, True, False, info

    def render(self) -> np.ndarray | list[np.ndarray] | None:  # type: ignore[override]
        """What ``render_mode`` says: a picture (h, w, 3) uint8, a list of them, or None."""
        return show(self._viewer)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._viewer.close()


def plain_seed(seed: Any) -> Any:
    """NumPy's integers as Python's, which are all that gymnasium takes for a seed; anything else as it is."""
    return int(seed) if isinstance(seed, np.integer) else seed


def show(viewer: Viewer) -> np.ndarray | list[np.ndarray] | None:
    """What ``render`` returns; the window of mode "human" needs no call."""
    if viewer.mode is None:
        gym.logger.warn("render() was called without a render_mode; make the env with render_mode='rgb_array'")
    if viewer.mode == "rgb_array":
        return viewer.picture()
    return viewer.frames() if viewer.mode == "rgb_array_list" else None


def register_envs() -> None:
    """Register the envs with gymnasium; safe to call twice."""
    if "TensegrityHop-v0" not in gym.registry:
        # no max_episode_steps: the envs end their episodes themselves
        gym.register(
            "TensegrityHop-v0",
            entry_point="tensegrity_gym.env:TensegrityHopEnv",
            vector_entry_point="tensegrity_gym.vector_env:TensegrityHopVectorEnv",
        )
    if "TensegrityTravel-v0" not in gym.registry:
        gym.register("TensegrityTravel-v0", entry_point="tensegrity_gym.travel:TensegrityTravelEnv")
