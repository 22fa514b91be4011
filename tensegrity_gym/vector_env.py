"""``gym.make_vec("TensegrityHop-v0", num_envs=...)``: all hops of a step in one SIMD batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from tensegrity_gym import task
from tensegrity_gym.env import HopTask, plain_seed
from tensegrity_gym.errors import InvalidParameterError, ResetNeededError
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.scene import Scene
from tensegrity_gym.scene_ranges import SceneRanges


class TensegrityHopVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """``num_envs`` of ``TensegrityHop-v0`` stepped together; gives what SyncVectorEnv over single envs gives, bit by bit.

    SAME_STEP autoreset: ``step`` returns the observations of the next episodes, with the ended ones' observations in
    ``infos["final_obs"]`` and infos in ``infos["final_info"]``. Where scenes are randomised, each scene is a batch of its
    own, unless ``shared_scene`` draws one scene for all envs at each reset (by the first env's random numbers).

    Other arguments: as ``TensegrityHopEnv``, without render modes.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012 (gymnasium's way)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scene: str | Scene | SceneRanges | Mapping[str, Any] = "earth",
        landing: str | None = None,
        target: str | ArrayLike = "inside",
        success_radius: float = task.SUCCESS_RADIUS,
        success_bonus: float = 0.0,
        energy_cost: float = 0.0,
        fidelity: str | Fidelity | Mapping[str, Any] = "paper",
        shared_scene: bool = False,
        render_mode: str | None = None,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise InvalidParameterError(f"num_envs: expected an integer >= 1, got {num_envs!r}")
        if render_mode is not None:
            raise InvalidParameterError(f"render_mode: expected None, got {render_mode!r}; for pictures use gym.make")
        self.num_envs = int(num_envs)
        self.render_mode = None
        self.shared_scene = bool(shared_scene)
        self.task = HopTask(scene, landing, target, success_radius, success_bonus, energy_cost, fidelity)
        self.single_observation_space, self.single_action_space = self.task.observation_space, self.task.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        #: Hops simulated since the env was made.
        self.simulator_calls = 0
        self._rngs: list[np.random.Generator] = []
        self._seeds: list[int] = []
        self._episodes: list[task.Episode] = []

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Draw scenes and targets; env i is seeded by ``seed + i``, or by ``seed[i]``.

        ``options``: as the single env's; "target" may also be one per env, shape (num_envs, 2) [m].
        """
        if _single(seed):
            seeds = [None if seed is None else seed + i for i in range(self.num_envs)]  # type: ignore[operator]
        elif isinstance(seed, Sequence | np.ndarray) and all(_single(s) for s in seed):
            seeds = list(seed)
        else:
            raise InvalidParameterError(f"seed: expected an integer, a list of {self.num_envs} or None, got {seed!r}")
        if len(seeds) != self.num_envs:
            raise InvalidParameterError(f"seed: expected one, or {self.num_envs}, one per env, got {len(seeds)}")
        self._seed(seeds)
        self._episodes = self._draw(options)
        return self._observations(), self._gather([episode.info() for episode in self._episodes], {})

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Seed of each env's generator, drawn at random where reset was given none, shape (num_envs,)."""
        self._seed([None] * self.num_envs)
        return tuple(self._seeds)

    def _seed(self, seeds: Sequence[int | None]) -> None:
        """Generators anew where a seed is given, or where there is none yet."""
        first = not self._rngs
        for i, seed in enumerate(seeds):
            if first:
                rng, kept = seeding.np_random(plain_seed(seed))
                self._rngs.append(rng)
                self._seeds.append(kept)
            elif seed is not None:
                self._rngs[i], self._seeds[i] = seeding.np_random(plain_seed(seed))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Hop with stretches ``actions``, shape (num_envs, 4); every episode terminates and the next one begins."""
        if not self._episodes:
            raise ResetNeededError("step: expected running episodes, got none; call reset() first")
        stretches = task.check_action(actions, (self.num_envs, *(self.single_action_space.shape or ())))
        outcomes = self.task.play(stretches, self._episodes)
        self.simulator_calls += self.num_envs
        ended = [
            {"final_obs": episode.observation, "final_info": info}
            for episode, (_, info, _, _) in zip(self._episodes, outcomes, strict=True)
        ]
        infos = self._gather(ended, {})
        self._episodes = self._draw(None)
        infos = self._gather([episode.info() for episode in self._episodes], infos)
        rewards = np.array([reward for reward, _, _, _ in outcomes], dtype=np.float64)
        done = np.ones(self.num_envs, dtype=np.bool_)
        return self._observations(), rewards, done, np.zeros_like(done), infos

    def _draw(self, options: dict[str, Any] | None) -> list[task.Episode]:
        each = self._options_per_env(options)
        if not (self.shared_scene and self.task.scenes.ranges):
            return [self.task.draw(rng, one) for rng, one in zip(self._rngs, each, strict=True)]
        first = self.task.draw(self._rngs[0], each[0])
        rest = [self.task.draw(r, {**one, "scene": first.scene}) for r, one in zip(self._rngs[1:], each[1:], strict=True)]
        return [first, *rest]

    def _options_per_env(self, options: dict[str, Any] | None) -> list[dict[str, Any]]:
        options = options or {}
        targets = options.get("target")
        if targets is None or isinstance(targets, str) or np.shape(targets) != (self.num_envs, 2):
            return [options] * self.num_envs
        return [{**options, "target": target} for target in targets]

    def _observations(self) -> np.ndarray:
        return np.stack([episode.observation for episode in self._episodes])

    def _gather(self, each: list[dict[str, Any]], infos: dict[str, Any]) -> dict[str, Any]:
        for i, one in enumerate(each):
            infos = self._add_info(infos, one, i)
        return infos


def _single(seed: Any) -> bool:
    return seed is None or isinstance(seed, (int, np.integer))
