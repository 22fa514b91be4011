"""Who works the chunks off: threads of this process, workers of this machine, or a cluster."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from surrogate.chunks import Progress, Task
from surrogate.hops import HopData
from tensegrity_gym.errors import InvalidParameterError, MissingExtraError, TensegrityError

#: What a chunk came to: its data, or what went wrong each time it was tried.
Outcome = tuple[Task, HopData | Exception]
#: A worker that dies takes its chunk along; a chunk that outlived no worker this often is poison.
DEATHS = 2
#: How often the workers are counted [s].
CENSUS = 1.0
#: How long a scheduler may take to write its file [s].
PATIENCE = 120.0
#: Chunks in flight per worker: one at work, one waiting.
AHEAD = 2


def run_here(
    tasks: Iterable[Task], work: Callable[..., HopData], threads: int | None, retries: int, progress: Progress
) -> Iterator[Outcome]:
    """One chunk after the other on ``threads`` threads."""
    for task in tasks:
        outcome: HopData | Exception = RuntimeError("never tried")
        for _ in range(retries + 1):
            counted = 0

            def count(hops: int) -> None:
                nonlocal counted
                counted += hops
                progress(hops)

            try:
                outcome = work(task, threads=threads, progress=count)
            except TensegrityError:  # asked for what cannot be: every chunk would say the same
                raise
            except Exception as error:  # whatever else a chunk does is its own
                progress(-counted)
                outcome = error
                continue
            progress(task.last - task.first - counted)
            break
        yield task, outcome


def run_on_cluster(
    tasks: Iterable[Task], work: Callable[..., HopData], address: str, workers: int | None, retries: int, progress: Progress
) -> Iterator[Outcome]:
    """Chunks as tasks of a dask cluster: one made here for ``address`` "dask", or the scheduler at tcp://host:port, or the
    one whose scheduler file ``address`` names.

    Each worker takes one chunk at a time, on one thread of its own. A killed worker's chunk goes to another one.
    """
    distributed = _distributed()
    run = uuid4().hex  # a scheduler takes tasks of one key for one task, also those of two runs
    with _client(distributed, address, workers) as client:
        waiting = iter(tasks)
        crew = _Crew(client)
        ready = distributed.as_completed(loop=client.loop, raise_errors=False)
        of: dict[str, Task] = {}

        def send() -> None:
            for task in islice(waiting, max(1, AHEAD * crew.size() - len(of))):
                key = f"hops-{task.first}-{task.last}-{run}"
                future = client.submit(work, task, threads=1, retries=retries, pure=False, key=key)
                of[future.key] = task
                ready.add(future)

        send()
        for future in ready:
            task = of.pop(future.key)
            error = future.exception()
            if isinstance(error, TensegrityError):
                raise error
            outcome = future.result() if error is None else error
            future.release()  # else the cluster keeps every chunk
            send()
            progress(task.last - task.first)
            yield task, outcome


class _Crew:
    """How many workers a cluster has: on a real one they come, and go, while chunks are worked off."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.asked, self.count = -np.inf, 0

    def size(self) -> int:
        if time.monotonic() > self.asked + CENSUS:
            self.count, self.asked = len(self.client.nthreads()), time.monotonic()
        return self.count


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise MissingExtraError(
            "scheduler: expected dask and distributed to be installed, they are not; pip install 'tensegrity-gym[cluster]'"
        ) from error
    return distributed


def _client(distributed: Any, address: str, workers: int | None) -> Any:
    import dask

    dask.config.set({"distributed.scheduler.allowed-failures": DEATHS})
    if address == "dask":
        cluster = distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
        )
        client = distributed.Client(cluster, set_as_default=False)
        return _Both(client, cluster)
    if address.endswith(".json"):
        where = {"scheduler_file": _written(Path(address))}
    elif "://" in address:
        where = {"address": address}
    else:
        raise InvalidParameterError(
            f"scheduler: expected threads, dask, an address such as tcp://host:8786 or a scheduler's file.json, got {address!r}"
        )
    try:
        return distributed.Client(**where, timeout="30s", set_as_default=False)
    except OSError as error:
        raise InvalidParameterError(f"scheduler: expected a dask scheduler at {address}, found none ({error})") from error


def _written(path: Path) -> str:
    """A scheduler's file, once it is there."""
    until = time.monotonic() + PATIENCE
    while not path.exists():
        if time.monotonic() > until:
            raise InvalidParameterError(
                f"scheduler: expected a file {path} from `dask scheduler --scheduler-file {path}`, found none in {PATIENCE:g} s"
            )
        time.sleep(0.1)
    return str(path)


class _Both:
    """A client and the cluster that was made for it, closed together."""

    def __init__(self, client: Any, cluster: Any) -> None:
        self.client, self.cluster = client, cluster

    def __enter__(self) -> Any:
        return self.client

    def __exit__(self, *_: Any) -> None:
        self.client.close()
        self.cluster.close()
