"""The same data from a cluster of workers as from threads, whatever happens to the workers."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surrogate import dataset, generate, schedule
from surrogate.chunks import Task, run_chunk
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


class Meeting:
    """A chunk's work that waits until four are at it at once; found by name, as it is not sent but lies in this process."""

    grown, complete, lock = threading.Event(), threading.Event(), threading.Lock()
    at_work = 0

    @classmethod
    def work(cls, task, **options):
        cls.grown.wait(60)
        if task.first:  # the first chunk is done when there are four workers, and the run may see them
            with cls.lock:
                cls.at_work += 1
                if cls.at_work == 4:
                    cls.complete.set()
            if not cls.complete.wait(10):
                cls.at_work -= 1
        with cls.lock:
            return run_chunk(task, **options)


def test_workers_that_come_later_get_chunks_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that starts with one worker has all four at work at once when three more have come."""
    monkeypatch.setattr(schedule, "CENSUS", 0.0)
    path = tmp_path / "hops.h5"
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as few:

        def grow() -> None:
            few.scale(4)
            few.wait_for_workers(4)
            Meeting.grown.set()

        threading.Timer(0.5, grow).start()
        address = few.scheduler_address
        generate.fill(path, HOPS, CONFIGURATION, chunk=CHUNK, scheduler=address, progress=False, work=Meeting.work)
    assert Meeting.complete.is_set()
    assert len(dataset.read(path)) == HOPS


def test_two_runs_on_one_scheduler_get_chunks_of_their_own(cluster: Any) -> None:
    def run(seed: int) -> Iterator[schedule.Outcome]:
        tasks = [Task(Configuration(scene=CONFIGURATION.scene, seed=seed), first, first + 2) for first in range(0, 8, 2)]
        return schedule.run_on_cluster(tasks, run_chunk, cluster.scheduler_address, None, 0, lambda hops: None)

    first = run(2)
    came = {2: [next(first)]}  # the first run's other chunks are on the cluster, or done, while the second works its own off
    came |= {3: list(run(3))}
    came[2] += list(first)
    for seed, outcomes in came.items():
        assert sorted(task.first for task, _ in outcomes) == [0, 2, 4, 6]
        for _, data in outcomes:
            assert isinstance(data, dataset.HopData)
            assert data.configuration["seed"] == seed


def test_scheduler_is_found_by_its_file(tmp_path: Path, cluster: Any, digest: str, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "scheduler.json"
    threading.Timer(0.3, file.write_text, [json.dumps({"address": cluster.scheduler_address})]).start()  # it starts later
    generate.fill(tmp_path / "hops.h5", HOPS, CONFIGURATION, chunk=CHUNK, scheduler=str(file), progress=False)
    assert dataset.read(tmp_path / "hops.h5").digest == digest
    monkeypatch.setattr(schedule, "PATIENCE", 0.0)
    with pytest.raises(InvalidParameterError, match=r"expected a file .*none.json from `dask scheduler"):
        generate.fill(tmp_path / "more.h5", HOPS, CONFIGURATION, scheduler=str(tmp_path / "none.json"), progress=False)


def test_unknown_scheduler_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="expected threads, dask, an address"):
        generate.fill(tmp_path / "hops.h5", 4, CONFIGURATION, scheduler="slurm", progress=False)
