"""What storing hops costs: committing a chunk, scheduling it on workers, reading it back. `python benchmarks/data.py`."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from surrogate import dataset, generate
from surrogate.chunks import Task, run_chunk
from surrogate.dataset import Configuration, HopData
from tensegrity_gym import Scene

CHUNKS = 60


def main() -> None:
    """Print the costs."""
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
