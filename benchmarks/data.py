"""What single precision changes, and what storing hops costs: commit, schedule, read back. `python -m benchmarks.data`."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from surrogate import dataset, generate
from surrogate.chunks import Task, run_chunk
from surrogate.dataset import Configuration, HopData
from tensegrity_gym import ENERGY_NAMES, HopResult, Scene, form_find, simulate
from tensegrity_gym.specimen import moved_start

CHUNKS = 60
#: Where single precision is compared with double: hops of a flight.
SCENES = {
    "Earth": Scene(duration=1.3),
    "slope of 30 degrees": Scene(slope=np.radians(30.0), slope_direction=-2.0, friction=0.9, duration=2.0),
    "Moon": Scene.preset("moon", duration=7.0),
}


def rounding(hops: int = 16) -> None:
    """Print what single precision moves, beside what 10 um at the start move."""
    rng = np.random.default_rng(1)
    stretches = rng.uniform(0.2, 0.8, (hops, 4))
    for name, scene in SCENES.items():
        start = form_find(stretches, scene=scene)
        double = simulate(stretches, scene=scene, equilibria=start)
        single = simulate(stretches, scene=scene, equilibria=start, precision="float32")
        moved = simulate(stretches, scene=scene, equilibria=moved_start(start))
        apart = [1e3 * np.median(np.linalg.norm(r.touchdown - double.touchdown, axis=1)) for r in (single, moved)]
        drift, damped = (v.mean(axis=1) / single.stored_energy for v in _drift(single, double))
        print(
            f"float32, {name}: touchdown moves by {apart[0]:.2f} mm, floor {apart[1]:.2f} mm (medians of {hops}); energies drift "
            f"by {drift.mean():.2%} of the stored energy until touchdown, {damped.mean():.2%} in what damping takes"
        )


def _drift(single: HopResult, double: HopResult) -> tuple[np.ndarray, np.ndarray]:
    """Departure of the sum of energies, and of the damped energy from that in float64, at touchdown [J], shapes (n, 1)."""
    total, damping = single.energies.sum(axis=2), ENERGY_NAMES.index("dissipated_damping")
    return np.abs(total[:, 2:3] - total[:, :1]), (single.energies - double.energies)[:, 2:3, damping]


def main() -> None:
    """Print the costs."""
    rounding()
    short = Configuration(scene=Scene(duration=0.01), precision="float32")
    made = run_chunk(Task(short, 0, generate.CHUNK), threads=1)

    def nothing(task: Task, **_: object) -> HopData:
        """A chunk whose hops cost nothing, so that all that is left is overhead."""
        columns = dict(made.columns) | {"index": np.arange(task.first, task.last)}
        return HopData(columns, made.configuration)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        started = time.perf_counter()
        for k in range(CHUNKS):
            dataset.write(folder / f"{k}.h5", made)
        print(f"committing a chunk of {generate.CHUNK} hops: {1e3 * (time.perf_counter() - started) / CHUNKS:.1f} ms")
        took = {}
        for scheduler in ("threads", "dask"):
            times = {}
            for chunks in (2, CHUNKS):  # the difference leaves out starting the workers
                started = time.perf_counter()
                options = {"scheduler": scheduler, "workers": 2, "work": nothing, "progress": False}
                generate.fill(folder / f"{scheduler}{chunks}.h5", chunks * generate.CHUNK, short, **options)  # type: ignore[arg-type]
                times[chunks] = time.perf_counter() - started
            took[scheduler] = (times[CHUNKS] - times[2]) / (CHUNKS - 2)
            print(f"{scheduler}: {1e3 * took[scheduler]:.1f} ms of overhead a chunk, commit and join included")
        print(f"scheduling and moving a chunk: {1e3 * (took['dask'] - took['threads']):.1f} ms")
        path = folder / f"dask{CHUNKS}.h5"
        started = time.perf_counter()
        rows = len(dataset.read(path))
        print(f"reading and checking: {(time.perf_counter() - started) / rows * 1e6:.2f} s per 1e6 rows, all columns")


if __name__ == "__main__":
    main()
