"""The flat HDF5 file of hops: atomic writing, and reading with every check.

The first 512 bytes of a file are text, its *seal*: what it is, and the SHA-256 of all bytes after them. HDF5 readers skip it.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from surrogate.columns import CHECKSUMS, ColumnWriter, Sink
from surrogate.hops import (
    Configuration,
    HopData,
    check_configuration,
    checksums,
    chunk_rows,
    concatenate,
    digest_of,
    from_equilibria,
    from_result,
    split_share,
)
from surrogate.schema import COLUMNS, EVENTS, SCHEMA_VERSION, SPLITS, Column, columns_of, expected_shape
from surrogate.storage import atomic_path, ensure_folder, hash_of, package_versions
from tensegrity_gym.errors import DataFileError

__all__ = [
    "CHECKSUMS",
    "COLUMNS",
    "EVENTS",
    "SCHEMA_VERSION",
    "SEAL_BYTES",
    "SPLITS",
    "Configuration",
    "HopData",
    "attributes",
    "blocks",
    "check_configuration",
    "concatenate",
    "from_equilibria",
    "from_result",
    "opened",
    "read",
    "seal_of",
    "split_share",
    "write",
    "write_blocks",
]

SEAL_BYTES = 512
#: What to do about a damaged file: a run to the same name would go on from it, and be refused.
AGAIN = "move it out of the way and generate it again"
#: Parts of the configuration that are root attributes of their own, as JSON.
PARTS = ("design", "scene", "fidelity")


def write(path: Path | str, data: HopData) -> Path:
    """Write the whole file beside ``path`` and rename it: at every moment there is the old file, or the new one."""
    return write_blocks(path, data.configuration, [data])


def write_blocks(
    path: Path | str, configuration: dict[str, Any], parts: Iterable[HopData], skipped: Sequence[dict[str, Any]] = ()
) -> Path:
    """As :func:`write`, from parts that never need to be in memory together; ``skipped`` chunks are noted in the file."""
    path = Path(path)
    ensure_folder(path.parent)
    schema = columns_of(configuration)
    with atomic_path(path) as temporary:
        with Sink(temporary) as sink, h5py.File(sink, "w", userblock_size=SEAL_BYTES) as file:
            seconds, hops = 0.0, 0
            writers = {name: ColumnWriter(file, name, column) for name, column in schema.items()}
            for part in parts:
                seconds, hops = seconds + part.seconds, hops + len(part)
                for name, writer in writers.items():
                    writer.append(part[name])
            sums = {name: writer.close(_tail(schema[name], configuration)) for name, writer in writers.items()}
            file.attrs.update(
                {
                    "schema_version": SCHEMA_VERSION,
                    "model_version": configuration["model_version"],
                    "hops": hops,
                    "wall_seconds": seconds,
                    "configuration": json.dumps(configuration, sort_keys=True),
                    "configuration_hash": hash_of(configuration),
                    **{k: json.dumps(configuration[k], sort_keys=True) for k in PARTS if k in configuration},
                    **{k: configuration[k] for k in ("precision", "seed")},
                    "packages": json.dumps(package_versions()),
                    "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
                    "date": datetime.now(UTC).isoformat(timespec="seconds"),
                    "skipped": json.dumps(list(skipped)),
                    "digest": digest_of(sums, schema),
                }
            )
        seal = seal_of(temporary)
        with open(temporary, "r+b") as raw:
            raw.write(seal)
    return path


def _tail(column: Column, configuration: dict[str, Any]) -> tuple[int, ...]:
    return expected_shape(column, 0, configuration)[1:]


def seal_of(path: Path) -> bytes:
    """The seal that a file must carry for the bytes it has after it."""
    total = hashlib.sha256()
    with open(path, "rb") as raw:
        raw.seek(SEAL_BYTES)
        while block := raw.read(2**22):
            total.update(block)
    text = f"tensegrity_gym hop data: HDF5 from byte {SEAL_BYTES} on\nsha256 of those bytes: {total.hexdigest()}\n"
    return text.encode().ljust(SEAL_BYTES, b"\n")


def read(
    path: Path | str, expect: Configuration | None = None, *, columns: Sequence[str] | None = None, content: str | None = "hops"
) -> HopData:
    """Read and check a file: schema, damage and, where ``expect`` is given, that it was made with that configuration.

    ``columns`` reads (and checks) only those, beside ``index``; ``content`` is what the file must hold, None for either.
    Raises DataFileError, which names the file, what was expected and what came.
    """
    path = Path(path)
    with opened(path) as file:
        configuration = _configuration(path, file)
        if expect is not None:
            check_configuration(configuration, expect.as_dict(), str(path))
            content = expect.content
        if content is not None and configuration.get("content") != content:
            raise DataFileError(f"{path}: expected a file of {content}, got one of {configuration.get('content')}")
        schema = columns_of(configuration)
        wanted = [name for name in schema if columns is None or name == "index" or name in columns]
        unknown = sorted(set(columns or ()) - set(schema))
        if unknown:
            raise DataFileError(f"{path}: expected columns out of {list(schema)}, asked for {unknown}")
        missing = sorted(set(schema) - set(file))
        if missing:
            raise DataFileError(f"{path}: expected the columns {sorted(schema)}, missing {missing}; {AGAIN}")
        hops = len(file["index"])
        found = {name: _column(path, file, name, schema[name], hops, configuration) for name in wanted}
        if columns is None:
            sums = {name: file[f"{CHECKSUMS}/{name}"][()] for name in schema}
            _expect(path, "digest", file.attrs.get("digest"), digest_of(sums, schema))
        return HopData(found, configuration, float(file.attrs.get("wall_seconds", 0.0)))


def blocks(path: Path | str, rows: int = 16 * 1024, start: int = 0, stop: int | None = None) -> Iterator[HopData]:
    """Rows ``start`` to ``stop`` of a file, some at a time, for what does not fit into memory.

    Chunks are not checked against their checksums: see ``surrogate.check``.
    """
    path = Path(path)
    with opened(path) as file:
        configuration = _configuration(path, file)
        names, hops = list(columns_of(configuration)), len(file["index"])
        seconds = float(file.attrs.get("wall_seconds", 0.0))
        stop = hops if stop is None else stop
        for first in range(start, stop, rows):
            part = {name: file[name][first : min(first + rows, stop)] for name in names}
            yield HopData(part, configuration, seconds if first == start else 0.0)


def attributes(path: Path | str) -> dict[str, Any]:
    """Root attributes of a file, and ``configuration`` decoded."""
    path = Path(path)
    with opened(path) as file:
        return {**{k: v.item() if isinstance(v, np.generic) else v for k, v in file.attrs.items()}} | {
            "configuration": _configuration(path, file)
        }


class opened:
    """An HDF5 file open for reading; whatever HDF5 says of it becomes a DataFileError."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> h5py.File:
        if not self.path.is_file():
            raise DataFileError(
                f"expected a data file at {self.path}, found none; make it with `python -m surrogate generate {self.path}`"
            )
        try:
            self.file = h5py.File(self.path, "r")
        except Exception as error:
            raise DataFileError(self._damaged(error)) from error
        return self.file

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self.file.close()
        # a flipped bit in HDF5's own structures may make it say, or h5py try, anything
        if isinstance(error, Exception) and not isinstance(error, DataFileError):
            raise DataFileError(self._damaged(error)) from error

    def _damaged(self, error: BaseException) -> str:
        return f"{self.path}: expected a whole HDF5 file of hops, but it cannot be read ({error}); {AGAIN}"


def _configuration(path: Path, file: h5py.File) -> dict[str, Any]:
    version = int(file.attrs.get("schema_version", -1))
    if version != SCHEMA_VERSION:
        fix = "a newer version of this package made it: upgrade" if version > SCHEMA_VERSION else AGAIN
        raise DataFileError(
            f"{path}: expected a hop file of schema {SCHEMA_VERSION}, got {version if version >= 0 else None}; {fix}"
        )
    try:
        configuration = json.loads(file.attrs["configuration"])
        columns_of(configuration)
        expected_shape(COLUMNS["stretches"], 0, configuration)
    except (KeyError, TypeError, ValueError) as error:
        raise DataFileError(f"{path}: expected its configuration as JSON among its attributes ({error}); {AGAIN}") from error
    _expect(path, "configuration hash", file.attrs.get("configuration_hash"), hash_of(configuration))
    return configuration


def _column(path: Path, file: h5py.File, name: str, column: Column, hops: int, configuration: dict[str, Any]) -> np.ndarray:
    """One whole column, checked; the length of trajectories is what the file says."""
    stored = file[name]
    frames = stored.shape[1] if stored.ndim > 1 else 0
    shape = expected_shape(column, hops, configuration, frames)
    if stored.shape != shape or stored.dtype != np.dtype(column.dtype):
        came = f"{stored.dtype}{stored.shape}"
        raise DataFileError(f"{path}: expected column {name} as {column.dtype}{shape}, got {came}; {AGAIN}")
    values = stored[()].astype(np.dtype(column.dtype), copy=False)
    sums, kept = checksums(values, column), file[f"{CHECKSUMS}/{name}"][()]
    if not np.array_equal(sums, kept):
        rows = chunk_rows(values)
        bad = np.flatnonzero(sums != kept)[:8].tolist() if len(sums) == len(kept) else "of another number"
        raise DataFileError(
            f"{path}: column {name}: checksum of chunks {bad} (of {rows} rows each) does not match what was written: damaged; "
            f"{AGAIN}"
        )
    return values


def _expect(path: Path, what: str, kept: Any, came: str) -> None:
    if kept != came:
        raise DataFileError(f"{path}: expected {what} {kept}, got {came}: damaged; {AGAIN}")
