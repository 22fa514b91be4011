"""A chunk of hops: the unit of work that is simulated, sent, committed and redone as a whole."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from surrogate.hops import Configuration, HopData, concatenate, from_equilibria, from_result
from surrogate.sampling import draw_scene, scale, unit_points
from surrogate.symmetry import with_images
from tensegrity_gym import form_find, simulate
from tensegrity_gym.types import Floats

Progress = Callable[[int], object]


class Task(NamedTuple):
    """Hops ``first`` to ``last`` (excluded) of a configuration, with their stretches where these come from a file."""

    configuration: Configuration
    first: int
    last: int
    stretches: Floats | None = None

    def points(self) -> Floats:
        """Stretches of the task's hops, shape (last - first, n_actuators)."""
        if self.stretches is not None:
            return self.stretches
        c = self.configuration
        return scale(unit_points(c.sampler, self.first, self.last, c.seed, c.lattice.n_cells, c.sampler_size))


def run_chunk(task: Task, threads: int | None = None, progress: Progress | None = None) -> HopData:
    """Simulate a chunk. Its data are a function of the task alone: no other chunk, thread or worker count enters."""
    configuration, stretches = task.configuration, task.points()
    index = np.arange(task.first, task.last)
    if not configuration.scene_ranges:
        data = _one_scene(configuration, {}, stretches, index, threads, progress)
    else:
        group = index // configuration.hops_per_scene
        parts = []
        for number in np.unique(group):
            values = draw_scene(configuration.scene_ranges, configuration.seed, int(number))
            rows = group == number
            parts.append(_one_scene(configuration, values, stretches[rows], index[rows], threads, progress))
        data = concatenate(parts)
    return with_images(data, configuration) if configuration.symmetry else data


def _one_scene(
    configuration: Configuration,
    values: dict[str, float],
    stretches: Floats,
    index: np.ndarray,
    threads: int | None,
    progress: Progress | None,
) -> HopData:
    wall, cpu = time.perf_counter(), time.process_time()
    scene = replace(configuration.scene, **values)  # type: ignore[arg-type]
    common: dict[str, Any] = {"scene": scene, "lattice": configuration.lattice, "threads": threads, "progress": progress}
    if configuration.content == "equilibria":
        found = form_find(stretches, design=configuration.modelled, **common)
        make, result = from_equilibria, found
    else:
        rate = None if configuration.trajectory == "none" else configuration.trajectory_rate
        result = simulate(  # type: ignore[assignment]
            stretches,
            design=configuration.design,
            fidelity=configuration.model,
            dt=configuration.dt,
            trajectory_rate=rate,
            **common,
        )
        make = from_result  # type: ignore[assignment]
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return make(result, configuration, wall, index=index, cpu_seconds=cpu, scene_values=values)
