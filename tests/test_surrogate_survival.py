"""Runs that are killed, run out of room, meet each other or meet what is not theirs: nothing lost, nothing overwritten."""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from surrogate import chunks, dataset, generate
from surrogate.check import check
from surrogate.dataset import Configuration
from surrogate.merge import merge
from surrogate.storage import writer_lock
from tensegrity_gym import Scene
from tensegrity_gym.errors import DataFileError, FileInUseError, OutputFolderError, SkippedChunksError

HOPS, CHUNK = 24, 3
CONFIGURATION = Configuration(scene=Scene(duration=0.01), seed=11)
#: Imports once, then forks a child for each line it reads: the child is a process of its own, without the start-up.
NURSERY = f"""
import os, signal, sys, time
from surrogate.generate import fill
from surrogate.dataset import Configuration
from tensegrity_gym import Scene
configuration = Configuration(scene=Scene(duration=0.01), seed=11)
print("ready", flush=True)
for line in sys.stdin:
    delay, path = line.strip().split(" ", 1)
    child = os.fork()
    if not child:
        fill(path, {HOPS}, configuration, chunk={CHUNK}, threads=1, progress=False)
        os._exit(0)
    if float(delay) >= 0:
        time.sleep(float(delay))
        os.kill(child, signal.SIGKILL)  # a zombie at worst: nobody has waited for it yet
    print(os.waitpid(child, 0)[1], flush=True)
"""


class Nursery:
    """Runs ``fill`` in processes that can be killed."""

    def __init__(self) -> None:
        self.parent = subprocess.Popen(
            [sys.executable, "-c", NURSERY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        assert self._line() == "ready"

    def _line(self) -> str:
        assert self.parent.stdout is not None
        return self.parent.stdout.readline().strip()

    def run(self, path: Path, kill_after: float | None = None) -> int:
        """Fill ``path``; exit status of the process, as from ``os.waitpid``."""
        assert self.parent.stdin is not None
        self.parent.stdin.write(f"{-1 if kill_after is None else kill_after} {path}\n")
        return int(self._line())

    def close(self) -> None:
        assert self.parent.stdin is not None
        self.parent.stdin.close()
        self.parent.wait(timeout=10)


@pytest.fixture(scope="module")
def nursery() -> Iterator[Nursery]:
    made = Nursery()
    yield made
    made.close()


@pytest.mark.parametrize("kills", [10, pytest.param(100, marks=pytest.mark.slow)])
def test_killed_runs_lose_nothing_and_double_nothing(tmp_path: Path, nursery: Nursery, kills: int) -> None:
    whole = generate.generate(tmp_path / "whole.h5", HOPS, CONFIGURATION, chunk=CHUNK, progress=False)
    folder = tmp_path / "killed"
    folder.mkdir()
    path = folder / "hops.h5"
    started = time.perf_counter()
    assert nursery.run(path) == 0
    seconds = time.perf_counter() - started
    path.unlink()
    moments, hit, finished = random.Random(5), 0, 0
    while hit < kills:
        status = nursery.run(path, kill_after=moments.uniform(0, seconds))
        hit += status == signal.SIGKILL
        for part in [path] * path.exists() + list(folder.glob("hops.h5.parts/*.h5")):
            assert check(part) == []  # whatever has a name is whole
        if path.exists() and moments.random() < 0.7:  # else let a run meet a finished file, and what its killed maker left
            finished += 1
            path.unlink()
    assert nursery.run(path) == 0
    data = dataset.read(path, expect=CONFIGURATION)
    assert data.digest == whole.digest
    assert np.array_equal(data["index"], np.arange(HOPS))
    assert [p.name for p in folder.iterdir()] == ["hops.h5"]


def test_thread_count_and_chunk_size_do_not_change_a_bit(tmp_path: Path) -> None:
    digests = set()
    for threads, chunk in ((1, 17), (2, 17), (2, 5), (1, 16)):  # the last leaves one hop alone
        name = tmp_path / f"{threads}_{chunk}.h5"
        generate.fill(name, 17, CONFIGURATION, chunk=chunk, threads=threads, progress=False)
        digests.add(dataset.attributes(name)["digest"])
    assert len(digests) == 1


def test_rerun_with_other_chunks_fills_the_gaps_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "hops.h5"
    generate.fill(path, 5, CONFIGURATION, first=4, chunk=4, progress=False)
    sizes: list[int] = []
    monkeypatch.setattr(chunks, "simulate", lambda s, **k: sizes.append(len(s)) or _simulate(s, **k))
    generate.fill(path, 12, CONFIGURATION, chunk=6, progress=False)
    assert sizes == [4, 3]
    data = dataset.read(path)
    assert np.array_equal(data["index"], np.arange(12))
    assert data.digest == generate.generate(tmp_path / "whole.h5", 12, CONFIGURATION, progress=False).digest


_simulate = chunks.simulate


def test_a_smaller_run_keeps_the_chunks_of_a_larger_one_that_was_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "hops.h5"
    generate.fill(path, 4, CONFIGURATION, chunk=4, progress=False)

    def killed(task: chunks.Task, **options: Any) -> dataset.HopData:
        if task.first == 12:
            raise KeyboardInterrupt
        return chunks.run_chunk(task, **options)

    with pytest.raises(KeyboardInterrupt):
        generate.fill(path, 20, CONFIGURATION, chunk=4, progress=False, work=killed)
    assert len(list(tmp_path.glob("hops.h5.parts/*.h5"))) == 2
    small = generate.generate(path, 4, CONFIGURATION, chunk=4, progress=False)  # which the file had already
    assert small["index"].tolist() == [0, 1, 2, 3]
    assert dataset.read(path)["index"].tolist() == list(range(12))
    assert check(path) == []
    assert [p.name for p in tmp_path.iterdir()] == ["hops.h5"]
    before = path.stat().st_mtime_ns
    generate.fill(path, 4, CONFIGURATION, chunk=4, progress=False)
    assert path.stat().st_mtime_ns == before  # with nothing to join, nothing is written
    sizes: list[int] = []
    monkeypatch.setattr(chunks, "simulate", lambda s, **k: sizes.append(len(s)) or _simulate(s, **k))
    assert len(generate.generate(path, 20, CONFIGURATION, chunk=4, progress=False)) == 20
    assert sizes == [4, 4]


def test_two_writers_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "hops.h5"
    code = """import sys, time; from surrogate.storage import writer_lock
with writer_lock(sys.argv[1]): print(1, flush=True); time.sleep(60)"""
    other = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None
    assert other.stdout.readline() == "1\n"
    with pytest.raises(FileInUseError, match=rf"process {other.pid} is at it"):
        generate.fill(path, 4, CONFIGURATION, progress=False)
    assert not path.exists()
    other.kill()  # the lock dies with its holder
    other.wait()
    generate.fill(path, 4, CONFIGURATION, progress=False)
    with writer_lock(path), pytest.raises(FileInUseError), writer_lock(path):
        pass


def test_disk_full_keeps_what_there_is(tmp_path: Path) -> None:
    path = tmp_path / "hops.h5"
    generate.fill(path, 4, CONFIGURATION, progress=False)
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))  # the system then refuses to write, as it does on a full disk
    try:
        with pytest.raises(OutputFolderError, match="expected room"):
            generate.fill(path, 8, CONFIGURATION, progress=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, old)
    assert path.read_bytes() == before
    generate.fill(path, 8, CONFIGURATION, progress=False)
    assert len(dataset.read(path)) == 8


def test_read_only_folder_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "closed"
    folder.mkdir(mode=0o555)
    root = os.geteuid() == 0
    if root:  # whom no mode stops
        os.chmod(tmp_path, 0o755)
        os.seteuid(65534)
    try:
        with pytest.raises(OutputFolderError, match="Permission denied"):
            generate.fill(folder / "hops.h5", 4, CONFIGURATION, progress=False)
    finally:
        if root:
            os.seteuid(0)
    assert list(folder.iterdir()) == []


def test_foreign_and_damaged_chunks_are_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "hops.h5"
    parts = tmp_path / "hops.h5.parts"
    parts.mkdir()
    part = parts / "0000000000-0000000004.h5"
    generate.fill(part, 4, replace(CONFIGURATION, seed=12), progress=False)
    before = part.read_bytes()
    with pytest.raises(DataFileError, match="seed: expected 11, got 12"):
        generate.fill(path, 8, CONFIGURATION, progress=False)
    assert part.read_bytes() == before
    part.unlink()
    generate.fill(part, 4, CONFIGURATION, progress=False)
    with h5py.File(part, "r+") as file:
        file["rest"][2, 0] += 1e-9
    with pytest.raises(DataFileError, match="checksum"):
        generate.fill(path, 8, CONFIGURATION, progress=False)
    assert part.exists()
    assert not path.exists()


def test_newer_schema_is_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "hops.h5"
    generate.fill(path, 4, CONFIGURATION, progress=False)
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = 99
    before = path.read_bytes()
    with pytest.raises(DataFileError, match=r"schema 2, got 99.*upgrade"):
        generate.fill(path, 8, CONFIGURATION, progress=False)
    assert path.read_bytes() == before


def test_poison_chunk_is_skipped_named_and_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "hops.h5"
    tries: list[int] = []

    def poisoned(stretches, **options):
        if len(stretches) == 4 and np.array_equal(stretches, generate.sample_stretches(12, 11)[4:8]):
            tries.append(1)
            raise ZeroDivisionError("poison")
        return _simulate(stretches, **options)

    monkeypatch.setattr(chunks, "simulate", poisoned)
    with pytest.raises(SkippedChunksError, match=r"3 chunks.*1 failed 3 times.*hops 4 to 7: ZeroDivisionError: poison"):
        generate.fill(path, 12, CONFIGURATION, chunk=4, progress=False)
    assert len(tries) == 3
    assert check(path) == []
    assert dataset.read(path)["index"].tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    assert '"first": 4' in dataset.attributes(path)["skipped"]
    generate.fill(path, 2, CONFIGURATION, first=12, progress=False)  # grown, and merged, it still says what it lacks, and why
    generate.fill(tmp_path / "more.h5", 2, CONFIGURATION, first=14, progress=False)
    for file in (path, merge(tmp_path / "all.h5", [path, tmp_path / "more.h5"])):
        assert [(note["first"], note["last"]) for note in json.loads(dataset.attributes(file)["skipped"])] == [(4, 8)]
    monkeypatch.setattr(chunks, "simulate", _simulate)
    generate.fill(path, 2, CONFIGURATION, first=4, progress=False)
    assert [(note["first"], note["last"]) for note in json.loads(dataset.attributes(path)["skipped"])] == [(6, 8)]
    data = generate.generate(path, 12, CONFIGURATION, chunk=4, progress=False)
    assert data.digest == generate.generate(tmp_path / "whole.h5", 12, CONFIGURATION, progress=False).digest
    assert dataset.attributes(path)["skipped"] == "[]"
