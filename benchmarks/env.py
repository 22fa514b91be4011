"""What the envs cost above the simulator, the vector env against SyncVectorEnv, and frames drawn per second.

``python -m benchmarks.env`` prints medians of interleaved rounds. On a busy machine a lone hop on one thread
suffers less than a batch on all of them: look at the processor time too.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import tensegrity_gym  # noqa: F401  registers the envs
from tensegrity_gym import Scene, simulate
from tensegrity_gym.render import FRAME_SIZE, hop_frames, whole_hop


@dataclass(frozen=True)
class EnvBenchmark:
    """How much to measure."""

    rounds: int = 5
    """Repetitions of everything, interleaved; medians are printed."""
    envs: int = 32
    """Envs of the vector env, hops of a batch."""
    duration: float = 3.0
    """Longest hop [s]."""
    resets: int = 200
    """Resets timed at once."""


def main(config: EnvBenchmark) -> None:
    """Measure and print."""
    scene = Scene(duration=config.duration)
    actions = np.random.default_rng(0).uniform(0.25, 0.75, (config.envs, 4)).astype(np.float32)
    env = gym.make("TensegrityHop-v0", scene=scene)
    vector = gym.make_vec("TensegrityHop-v0", num_envs=config.envs, scene=scene)
    few = 2  # single envs are slow: time two and count hops per second
    maker = partial(gym.make, "TensegrityHop-v0", scene=scene)
    sync = SyncVectorEnv([maker] * few, autoreset_mode=AutoresetMode.SAME_STEP)
    film = whole_hop(simulate([0.2, 0.52, 0.29, 0.33], scene=scene, trajectory_rate=30.0))
    jobs: dict[str, Callable[[], object]] = {
        "simulate, one hop": lambda: simulate(actions[0], scene=scene),
        "env, reset and step": lambda: (env.reset(), env.step(actions[0])),
        "env, reset": lambda: [env.reset() for _ in range(config.resets)],
        "simulate, batch": lambda: simulate(actions, scene=scene),
        "vector env, step": lambda: vector.step(actions),
        "sync vector env, step": lambda: sync.step(actions[:few]),
        "frames": lambda: hop_frames(film, target=(0.5, 0.5)),
    }
    vector.reset(seed=0)
    sync.reset(seed=0)
    for job in jobs.values():
        job()  # compiles, fills caches
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    work: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(config.rounds):
        for name, job in jobs.items():
            start, cpu = time.perf_counter(), time.process_time()
            job()
            seconds[name].append(time.perf_counter() - start)
            work[name].append(time.process_time() - cpu)
    ratio = {
        "single": np.median(np.array(seconds["env, reset and step"]) / seconds["simulate, one hop"]),
        "vector": np.median(np.array(seconds["vector env, step"]) / seconds["simulate, batch"]),
        "sync": per_hop(seconds, config, few),
        "sync, processor": per_hop(work, config, few),
    }
    median = {name: float(np.median(values)) for name, values in seconds.items()}
    frames = int(film.frames[0])
    own = own_cost(config, actions, scene)
    print(f"hops of at most {config.duration:g} s, {config.rounds} rounds, medians")
    print(f"env, reset and step             {median['env, reset and step']:.4f} s, {ratio['single']:.3f} x simulate of one hop")
    print(f"  of which outside simulate     {1e3 * own:.3f} ms, {own / median['simulate, one hop']:.2%}")
    print(f"env, reset                      {1e6 * median['env, reset'] / config.resets:.0f} us")
    step = median["vector env, step"]
    print(f"vector env of {config.envs}, step           {step:.4f} s, {ratio['vector']:.3f} x simulate of the batch")
    print(f"vector env of {config.envs}                 {config.envs / step:.1f} hops/s")
    print(f"SyncVectorEnv over single envs  {few / median['sync vector env, step']:.2f} hops/s; vector env {ratio['sync']:.1f} x")
    print(f"  in processor time             {ratio['sync, processor']:.1f} x: what lanes alone give, on any number of threads")
    print(f"frames of {FRAME_SIZE[0]} x {FRAME_SIZE[1]} pixels       {frames / median['frames']:.0f} per second")


def per_hop(seconds: dict[str, list[float]], config: EnvBenchmark, few: int) -> float:
    """What a hop in SyncVectorEnv costs over what it costs in the vector env [-]."""
    sync, vector = (np.array(seconds[name]) for name in ("sync vector env, step", "vector env, step"))
    return float(np.median(sync / few / (vector / config.envs)))


def own_cost(config: EnvBenchmark, actions: np.ndarray, scene: Scene) -> float:
    """Seconds of one reset and step that are not spent in simulate, which is replaced by its stored result."""
    from tensegrity_gym import task

    real, done = task.simulate, simulate(actions[0], scene=scene)
    task.simulate = lambda *_, **__: done  # type: ignore[assignment]
    try:
        env = gym.make("TensegrityHop-v0", scene=scene)
        start = time.perf_counter()
        for _ in range(config.resets):
            env.reset()
            env.step(actions[0])
        return (time.perf_counter() - start) / config.resets
    finally:
        task.simulate = real


if __name__ == "__main__":
    main(tyro.cli(EnvBenchmark))
