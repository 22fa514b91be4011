"""Where lanes begin to pay: a few hops one after another, each alone, over the same hops side by side in one vector's lanes.

Run: ``python -m benchmarks.alone`` (a minute). Ratios are medians of interleaved rounds; ``rollouts.ALONE`` is chosen by them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import tyro

from tensegrity_gym import Equilibria, Fidelity, Scene, form_find, rollouts, simulate
from tensegrity_gym.fidelity import CHOICES


@dataclass(frozen=True)
class AloneConfig:
    """How much to measure."""

    rounds: int = 7
    """Repetitions; medians are printed."""
    hops: int = 4
    """Up to so many hops."""
    duration: float = 0.4
    """Length of each hop [s]."""


def clocks(equilibria: Equilibria, fidelity: Fidelity, threads: int, alone: int, duration: float) -> tuple[np.ndarray, int]:
    """Wall and processor time of the hops [s], shape (2,), and the steps of each; ``alone`` hops a thread go without lanes."""
    chosen, rollouts.ALONE = rollouts.ALONE, alone
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        scene = Scene(duration=duration)
        result = simulate(equilibria.stretches, equilibria=equilibria, scene=scene, fidelity=fidelity, threads=threads)
    finally:
        rollouts.ALONE = chosen
    return np.array((time.perf_counter() - wall, time.process_time() - cpu)), int(result.steps.max())


def main(config: AloneConfig) -> None:
    """Measure and print."""
    stretches = np.random.default_rng(3).uniform(0.2, 0.8, (config.hops, 4))
    found = {n: form_find(stretches[:n]) for n in range(1, config.hops + 1)}
    print("precision  threads  hops  step in lanes, alone [us wall]  alone over lanes: wall, processor time")
    for precision in CHOICES["precision"]:
        for threads in (1, 2):
            for n, equilibria in found.items():
                rounds = []
                for _ in range(config.rounds + 1):
                    pair = [clocks(equilibria, Fidelity(precision=precision), threads, k, config.duration) for k in (0, n)]
                    rounds.append([seconds / steps for seconds, steps in pair])
                lanes, alone = np.array(rounds[1:]).transpose(1, 2, 0)  # the first round compiles
                wall, cpu = np.median(alone / lanes, axis=1)
                each = f"{1e6 * np.median(lanes[0]):.2f}, {1e6 * np.median(alone[0]):.2f}"
                print(f"{precision:>9}  {threads:7d}  {n:4d}  {each:>30}  {wall:22.2f}, {cpu:.2f}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(AloneConfig))
