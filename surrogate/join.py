"""Pieces of files put together in the order of their hops, a block at a time."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from surrogate import dataset
from surrogate.hops import Configuration, HopData
from tensegrity_gym.errors import DataFileError


class Piece(NamedTuple):
    """Hops ``first`` to ``last`` (excluded), which are rows ``start`` to ``stop`` of a file."""

    path: Path
    first: int
    last: int
    start: int
    stop: int


def pieces_of(paths: Sequence[Path], configuration: Configuration | None = None) -> list[Piece]:
    """Runs of hops without gaps that files hold; DataFileError for one that is damaged or of another configuration."""
    pieces = []
    for path in paths:
        # reading all of a file is how its checksums are looked at; only one file is in memory at a time
        index = dataset.read(path, expect=configuration, content=None)["index"]
        edges = np.flatnonzero(np.diff(index) > 1) + 1
        if np.any(np.diff(index) < 0):
            raise DataFileError(f"{path}: expected hops in ascending order of their index; merge its pieces again")
        for a, b in pairwise([0, *edges.tolist(), len(index)]):
            if b > a:
                pieces.append(Piece(Path(path), int(index[a]), int(index[b - 1]) + 1, a, b))
    return pieces


def skipped_of(paths: Sequence[Path], pieces: Sequence[Piece]) -> list[dict[str, Any]]:
    """Chunks that files note as skipped, as far as no piece holds their hops."""
    missing = []
    for path in paths:
        for note in json.loads(dataset.attributes(path).get("skipped", "[]")):
            hops = np.arange(note["first"], note["last"])
            held = np.any([(piece.first <= hops) & (hops < piece.last) for piece in pieces], axis=0)
            for a, b in runs(hops[~held]):
                missing.append(note | {"first": a, "last": b})
    return missing


def runs(numbers: np.ndarray) -> Iterator[tuple[int, int]]:
    """First and last (excluded) of each run without gaps in ascending ``numbers``."""
    for run in np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1):
        if len(run):
            yield int(run[0]), int(run[-1]) + 1


def join(pieces: Sequence[Piece], rows: int = 16 * 1024) -> Iterator[HopData]:
    """The pieces' rows in the order of their hops; DataFileError where two of them hold the same hop."""
    ordered = sorted(pieces, key=lambda p: p.first)
    for before, after in pairwise(ordered):
        if after.first < before.last:
            raise DataFileError(
                f"{after.path}: expected hops from {before.last} on, but hop {after.first} is in {before.path} too; "
                "leave one of them out"
            )
    # wall time belongs to a file, not to its pieces
    counted: set[Path] = set()
    for piece in ordered:
        for part in dataset.blocks(piece.path, rows, piece.start, piece.stop):
            seconds = 0.0 if piece.path in counted else part.seconds
            counted.add(piece.path)
            yield HopData(part.columns, part.configuration, seconds)
