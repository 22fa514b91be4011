"""Whether a hop file is what was written, is of the schema, and obeys physics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import h5py
import tyro

from surrogate import dataset
from surrogate.hops import HopData
from surrogate.rules import violations
from surrogate.schema import SCHEMA_VERSION, columns_of
from tensegrity_gym.errors import DataFileError


@dataclass(frozen=True)
class CheckConfig:
    """Verify seal, schema, checksums and physics of files of hops."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Files to check."""


def check(path: Path | str) -> list[str]:
    """All that is wrong with a file, one line each; none for a good file."""
    path = Path(path)
    if not path.is_file():
        return [f"expected a data file at {path}, found none"]
    problems = []
    with open(path, "rb") as raw:
        if raw.read(dataset.SEAL_BYTES) != dataset.seal_of(path):
            problems.append("seal: the file's bytes are not those that were written (flipped, cut off, or changed since)")
    try:
        data = dataset.read(path, content=None)
        with dataset.opened(path) as file:
            problems += _attributes(file, data)
    except DataFileError as error:
        return [*problems, str(error)]
    return problems + [f"{what}: {count} rows, first at {row}" for what, count, row in violations(data)]


def _attributes(file: h5py.File, data: HopData) -> Iterator[str]:
    schema = columns_of(data.configuration)
    extra = sorted(set(file) - set(schema) - {dataset.CHECKSUMS})
    if extra:
        yield f"columns: expected {list(schema)}, got {extra} beside them"
    for name, column in schema.items():
        for what, wanted in (("unit", column.unit), ("description", column.description)):
            if file[name].attrs.get(what) != wanted:
                yield f"column {name}: expected {what} {wanted!r}, got {file[name].attrs.get(what)!r}"
    fields: tuple[tuple[str, Any], ...] = (
        ("hops", len(data)),
        ("schema_version", SCHEMA_VERSION),
        ("model_version", data.configuration["model_version"]),
        ("precision", data.configuration["precision"]),
        ("seed", data.configuration["seed"]),
    )
    for what, value in fields:
        if file.attrs.get(what) != value:
            yield f"attribute {what}: expected {value!r}, got {file.attrs.get(what)!r}"
    for what in ("command", "date", "packages", "skipped", *(k for k in dataset.PARTS if k in data.configuration)):
        if what not in file.attrs:
            yield f"attribute {what}: missing"


def main(config: CheckConfig) -> None:
    """Entry of ``python -m surrogate check``; DataFileError if anything is wrong."""
    wrong: dict[str, Any] = {}
    for path in config.files:
        problems = check(path)
        print(f"{path}: {'good' if not problems else f'{len(problems)} problems'}")
        for problem in problems:
            print(f"  {problem}")
        if problems:
            wrong[str(path)] = problems
    if wrong:
        raise DataFileError(f"expected good files, got problems in {', '.join(wrong)}; generate them again")
