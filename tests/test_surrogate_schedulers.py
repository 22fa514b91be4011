"""The same data from a cluster of workers as from threads, whatever happens to the workers."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surrogate import dataset, generate
from surrogate.chunks import run_chunk
from surrogate.dataset import Configuration
from tensegrity_gym import Scene
from tensegrity_gym.errors import InvalidParameterError, SkippedChunksError

distributed = pytest.importorskip("distributed")
CONFIGURATION = Configuration(scene=Scene(duration=0.01), seed=2)
HOPS, CHUNK = 32, 4


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    import dask

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 2}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0") as made,
    ):
        yield made


@pytest.fixture(scope="module")
def digest(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("whole") / "hops.h5"
    return generate.generate(path, HOPS, CONFIGURATION, chunk=CHUNK, threads=1, progress=False).digest


def test_cluster_and_threads_give_the_same_bytes(tmp_path: Path, cluster: Any, digest: str) -> None:
    path = tmp_path / "hops.h5"
    generate.fill(path, HOPS, CONFIGURATION, chunk=CHUNK, scheduler=cluster.scheduler_address, progress=False)
    assert dataset.read(path, expect=CONFIGURATION).digest == digest


def test_killed_workers_chunk_is_done_again(tmp_path: Path, cluster: Any, digest: str) -> None:
    flag = tmp_path / "killed"

    def deadly_once(task, **options):
        if task.first == 8 and not flag.exists():
            flag.write_text(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGKILL)
        return run_chunk(task, **options)

    path = tmp_path / "hops.h5"
    address = cluster.scheduler_address
    generate.fill(path, HOPS, CONFIGURATION, chunk=CHUNK, scheduler=address, progress=False, work=deadly_once)
    assert int(flag.read_text()) != os.getpid()
    assert dataset.read(path).digest == digest


def test_poison_chunk_on_a_cluster_is_reported_and_skipped(tmp_path: Path, cluster: Any, digest: str) -> None:
    def poisoned(task, **options):
        if task.first == 4:
            raise ZeroDivisionError("poison")
        return run_chunk(task, **options)

    path = tmp_path / "hops.h5"
    address = cluster.scheduler_address
    with pytest.raises(SkippedChunksError, match=r"hops 4 to 7: ZeroDivisionError: poison"):
        generate.fill(path, HOPS, CONFIGURATION, chunk=CHUNK, scheduler=address, progress=False, work=poisoned)
    assert np.array_equal(np.setdiff1d(np.arange(HOPS), dataset.read(path)["index"]), [4, 5, 6, 7])
    generate.fill(path, HOPS, CONFIGURATION, chunk=CHUNK, progress=False)
    assert dataset.read(path).digest == digest


@pytest.mark.slow
def test_chunk_that_kills_every_worker_is_reported_and_skipped(tmp_path: Path, cluster: Any) -> None:
    def deadly(task, **options):
        if task.first == 4:
            os.kill(os.getpid(), signal.SIGKILL)
        return run_chunk(task, **options)

    path = tmp_path / "hops.h5"
    address = cluster.scheduler_address
    with pytest.raises(SkippedChunksError, match=r"hops 4 to 7: KilledWorker"):
        generate.fill(path, HOPS, CONFIGURATION, chunk=CHUNK, scheduler=address, progress=False, work=deadly)
    assert len(dataset.read(path)) == HOPS - CHUNK


def test_local_cluster_is_made_and_closed(tmp_path: Path, digest: str) -> None:
    path = tmp_path / "hops.h5"
    generate.fill(path, HOPS, CONFIGURATION, chunk=CHUNK, scheduler="dask", workers=2, progress=False)
    assert dataset.read(path).digest == digest


def test_unknown_scheduler_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="expected threads, dask or an address"):
        generate.fill(tmp_path / "hops.h5", 4, CONFIGURATION, scheduler="slurm", progress=False)
