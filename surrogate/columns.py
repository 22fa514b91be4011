"""Columns into an HDF5 file, a chunk at a time, on disks that may fill up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from surrogate.hops import checksums, chunk_rows
from surrogate.schema import Column

#: Group of the columns' checksums, one unsigned number for each chunk of rows.
CHECKSUMS = "checksums"


class Sink:
    """A file to write HDF5 into that never fails under HDF5's feet: after an error it only pretends, and raises at the end.

    HDF5 cannot close a file that it cannot write, and complains for the rest of the process.
    """

    def __init__(self, path: Path) -> None:
        self.raw = open(path, "w+b", buffering=0)  # noqa: SIM115 - closed on exit
        self.error: OSError | None = None

    def __enter__(self) -> Sink:
        return self

    def __exit__(self, *_: object) -> None:
        self.raw.close()
        if self.error is not None:
            raise self.error

    def write(self, data: Any) -> int:
        view, done = memoryview(data).cast("B"), 0
        try:
            while self.error is None and done < len(view):
                done += self.raw.write(view[done:])
        except OSError as error:
            self.error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        try:
            return self.raw.truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0

    def read(self, size: int = -1) -> bytes:
        return self.raw.read(size)

    def readinto(self, buffer: Any) -> int:
        return self.raw.readinto(buffer)

    def seek(self, offset: int, whence: int = 0) -> int:
        return self.raw.seek(offset, whence)

    def tell(self) -> int:
        return self.raw.tell()

    def flush(self) -> None:
        self.raw.flush()


class ColumnWriter:
    """Appends to one data set in whole chunks, whatever the sizes of what comes."""

    def __init__(self, file: h5py.File, name: str, column: Column) -> None:
        self.file, self.name, self.column = file, name, column
        self.waiting: list[np.ndarray] = []
        self.sums: list[np.ndarray] = []
        self.data: h5py.Dataset | None = None

    def append(self, values: np.ndarray) -> None:
        self.waiting.append(values)
        rows = chunk_rows(values)
        ready = sum(len(v) for v in self.waiting) // rows * rows
        if ready:
            joined = np.concatenate(self.waiting)
            self._store(joined[:ready])
            self.waiting = [joined[ready:].copy()]

    def close(self, tail: tuple[int, ...]) -> np.ndarray:
        """Store what waits; returns the checksums of all chunks."""
        rest = np.concatenate(self.waiting) if self.waiting else np.zeros((0, *tail), self.column.dtype)
        if len(rest) or self.data is None:
            self._store(rest)
        sums = np.concatenate(self.sums)
        self.file.create_dataset(f"{CHECKSUMS}/{self.name}", data=sums)
        return sums

    def _store(self, values: np.ndarray) -> None:
        if self.data is None:
            self.data = self.file.create_dataset(
                self.name,
                shape=(0, *values.shape[1:]),
                maxshape=(None, *values.shape[1:]),
                chunks=(chunk_rows(values), *(max(1, k) for k in values.shape[1:])),
                dtype=np.dtype(self.column.dtype).newbyteorder("<"),
                compression="gzip",
                compression_opts=1,
                shuffle=True,
            )
            self.data.attrs["unit"] = self.column.unit
            self.data.attrs["description"] = self.column.description
        before = len(self.data)
        self.data.resize(before + len(values), axis=0)
        if len(values):
            self.data[before:] = values
        self.sums.append(checksums(values, self.column))
