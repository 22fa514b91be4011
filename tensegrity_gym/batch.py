"""Splitting a batch over threads, with progress that a caller can watch."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from itertools import pairwise

import numpy as np

from tensegrity_gym.errors import InvalidParameterError

Progress = Callable[[int], object]


def thread_count(threads: int | None) -> int:
    """``threads``, or as many as this process may use; InvalidParameterError for what is no integer."""
    if threads is None:
        # only Linux tells which cores a process may use
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if isinstance(threads, bool) or not isinstance(threads, (int, np.integer)):
        raise InvalidParameterError(f"threads: expected an integer or None, got {threads!r}")
    return max(1, int(threads))


def shares(n: int, parts: int, lanes: int) -> list[tuple[int, int]]:
    """Cut ``n`` cases into at most ``parts`` runs of whole lane blocks."""
    blocks = -(-n // lanes)
    parts = max(1, min(parts, blocks))
    edges = [min(n, lanes * (blocks * p // parts)) for p in range(parts + 1)]
    return [(a, b) for a, b in pairwise(edges) if b > a]


def dealt(order: np.ndarray, parts: int) -> np.ndarray:
    """``order``, dealt to ``parts`` shares like cards: what it begins with is what each share begins with."""
    parts = max(1, parts)
    return np.concatenate([order[k::parts] for k in range(parts)])


def run_shares(
    work: Callable[[int, int, np.ndarray], None], n: int, threads: int | None, lanes: int, progress: Progress | None
) -> None:
    """Call ``work(first, last, counter)`` for every share in threads; ``counter[0]`` counts what is done of that share.

    ``progress`` is called with the number of cases newly done, from the calling thread.
    """
    parts = shares(n, thread_count(threads), lanes)
    counters = [np.zeros(1, dtype=np.int64) for _ in parts]
    reported = 0
    with ThreadPoolExecutor(max_workers=max(1, len(parts))) as pool:
        jobs = [pool.submit(work, first, last, counter) for (first, last), counter in zip(parts, counters, strict=True)]
        pending = set(jobs)
        while pending:
            _, pending = wait(pending, timeout=0.2 if progress else None, return_when=FIRST_EXCEPTION)
            done = int(sum(c[0] for c in counters))
            if progress and done > reported:
                progress(done - reported)
                reported = done
    for job in jobs:
        job.result()
    if progress and n > reported:  # kernels count what they end, not what was over before it began
        progress(n - reported)
