"""Episodes of many registered envs, with all their hops simulated in one batch: a lone hop costs as much as eight."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

import tensegrity_gym
from tensegrity_gym import Scene, simulate, task
from tensegrity_gym.scene_ranges import SceneRanges
from tensegrity_gym.types import HopStatus
from training.similarity import Scaling
from training.symmetry import FoldedTargets, Symmetry

#: How seeds of envs come from that of a training; trainings that began otherwise are others.
ENV_SEEDS = "drawn from it"


class ScaledObservation(gym.ObservationWrapper):
    """Observations over a fixed scale, so that the nets see numbers of order one."""

    def __init__(self, env: gym.Env, scale: float | Scaling) -> None:
        super().__init__(env)
        self.scaling = scale if isinstance(scale, Scaling) else Scaling((scale,))
        box = env.observation_space
        assert isinstance(box, gym.spaces.Box)
        self.observation_space = gym.spaces.Box(*self.scaling.bounds(box.low, box.high), dtype=np.float32)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Scaled observation, shape as it came."""
        return self.scaling(observation)


class SharedScene(gym.Wrapper):
    """Draws targets of its own, in the scene that another env has drawn."""

    def __init__(self, env: gym.Env, leader: gym.Env) -> None:
        super().__init__(env)
        self.leader = leader

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """As the env's; the leader must have been reset before."""
        return self.env.reset(seed=seed, options={**(options or {}), "scene": self.leader.unwrapped.scene})  # type: ignore[attr-defined]


class ScaledAction(gym.ActionWrapper):
    """Actions in [-1, 1] onto the env's range; gymnasium's RescaleAction rounds beyond its ends, this one does not."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        box = env.action_space
        assert isinstance(box, gym.spaces.Box)
        self.box = box
        self.action_space = gym.spaces.Box(-1.0, 1.0, shape=box.shape, dtype=np.float32)

    def action(self, action: np.ndarray) -> np.ndarray:
        """Stretches, shape as it came."""
        low, high = self.box.low, self.box.high
        return np.clip(low + (high - low) * (action + 1) / 2, low, high)


def make_env(scene: Scene | SceneRanges, scale: float | Scaling, leader: gym.Env | None = None) -> ScaledAction:
    """The registered env with observations over ``scale`` [m] and actions rescaled to [-1, 1], as policies want them.

    With a ``leader`` its scenes are those that the leader drew.
    """
    env: gym.Env = gym.make("TensegrityHop-v0", scene=scene)
    return ScaledAction(ScaledObservation(env if leader is None else SharedScene(env, leader), scale))


class BatchedHopVecEnv(DummyVecEnv):
    """``envs`` of :func:`make_env`; gives what DummyVecEnv with the same seeds gives, bit by bit.

    Targets, spaces and observations are the envs' own, rewards come from the same function that they call; only
    ``simulate`` is called once for all of them. Where scenes vary, the first env draws one for all at each reset, as the
    registered vector env does with ``shared_scene``. Infos hold ``landing`` (2,) [m], ``error`` [m] and ``status``.
    ``levers``: further arguments of ``simulate``; with a ``symmetry`` policies see folded targets, see ``FoldedTargets``.
    """

    def __init__(
        self,
        scene: Scene | SceneRanges,
        scale: float | Scaling,
        envs: int,
        levers: Mapping[str, Any] | None = None,
        symmetry: Symmetry | None = None,
    ) -> None:
        first = make_env(scene, scale)
        varied = isinstance(scene, SceneRanges) and bool(scene.ranges)

        def folded(env: gym.Env) -> gym.Env:
            return env if symmetry is None else FoldedTargets(env, symmetry)

        makers: list[Callable[[], gym.Env]] = [lambda: folded(first)]
        makers += [lambda: folded(make_env(scene, scale, first if varied else None))] * (envs - 1)
        super().__init__(makers)
        self.levers = dict(levers or {})
        #: Hops simulated since the envs were made.
        self.simulator_calls = 0
        #: Wall time that simulating them took [s].
        self.seconds = 0.0

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the envs with numbers drawn from ``seed``; with seed + k, as usual, neighbouring seeds share most targets."""
        first = super().seed(seed)[0]
        self._seeds = [int(drawn) for drawn in np.random.SeedSequence(first).generate_state(self.num_envs)]
        return self._seeds

    def step_wait(self) -> Any:
        """Simulate one hop per env; every episode ends, and every env is reset."""
        plain: list[Any] = self.envs
        low, high = tensegrity_gym.STRETCH_RANGE  # float32 cannot hold them: cut the overshoot off, as the env does
        asked = [_stretches(env, action) for env, action in zip(plain, self.actions, strict=True)]
        stretches = np.stack(asked).astype(np.float64)
        started = time.perf_counter()
        scene = plain[0].unwrapped.scene
        hop = simulate(np.clip(stretches, low, high), scene=scene, **self.levers)
        self.seconds += time.perf_counter() - started
        self.simulator_calls += len(stretches)
        targets = np.stack([info["target"] for info in self.reset_infos])
        rewards = task.reward(hop.landing, targets, hop.status, task.reach(scene))
        errors = task.landing_error(hop.landing, targets)
        observations = self.buf_obs[None].copy()  # type: ignore[index]
        outcomes = [
            (
                observations[k],
                float(rewards[k]),
                True,
                False,
                {"landing": hop.landing[k], "error": float(errors[k]), "status": HopStatus(int(hop.status[k]))},
            )
            for k in range(self.num_envs)
        ]
        self.envs = [_Stepped(env, outcome) for env, outcome in zip(plain, outcomes, strict=True)]  # type: ignore[misc]
        try:
            return super().step_wait()
        finally:
            self.envs = plain


def _stretches(env: Any, action: np.ndarray) -> np.ndarray:
    """What the wrapped env gets of an action."""
    while isinstance(env, gym.ActionWrapper):
        env, action = env.env, env.action(action)
    return action


class _Stepped:
    """Stands in for an env whose hop has been simulated."""

    def __init__(self, env: gym.Env, outcome: tuple[Any, ...]) -> None:
        self.env, self.outcome = env, outcome

    def step(self, action: np.ndarray) -> tuple[Any, ...]:
        return self.outcome

    def reset(self, **options: Any) -> Any:
        return self.env.reset(**options)
