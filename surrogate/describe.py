"""What is in a hop file, in words."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import h5py
import numpy as np
import tyro

from surrogate import dataset
from surrogate.schema import columns_of
from tensegrity_gym import HopStatus


@dataclass(frozen=True)
class DescribeConfig:
    """Print what a file of hops holds."""

    file: Annotated[Path, tyro.conf.Positional]
    """The file."""


def describe(path: Path | str) -> str:
    """Provenance, columns and outcomes of a file, for a terminal."""
    path = Path(path)
    about = dataset.attributes(path)
    configuration = about["configuration"]
    lines = [f"{path}: {about['hops']} rows of {configuration['content']}, {path.stat().st_size / 1e6:.2f} MB"]
    for name in (
        "schema_version",
        "model_version",
        "date",
        "command",
        "configuration_hash",
        "digest",
        "wall_seconds",
        "packages",
    ):
        lines.append(f"  {name:<20} {about[name]}")
    for name, value in configuration.items():
        if name not in ("schema_version", "model_version"):
            lines.append(f"  {name:<20} {json.dumps(value) if isinstance(value, (dict, list)) else value}")
    for part in json.loads(about["skipped"]):
        lines.append(f"  skipped: hops {part['first']} to {part['last'] - 1}: {part['error']}")
    lines += ["", *_columns(path), "", *_outcomes(path)]
    waiting = path.with_name(path.name + ".parts")
    if waiting.is_dir():
        lines.append(f"{len(list(waiting.glob('*.h5')))} committed chunks wait in {waiting} for the run to go on")
    return "\n".join(lines)


def _columns(path: Path) -> list[str]:
    rows = [("column", "type", "shape", "chunk", "unit", "bytes/row", "meaning")]
    with h5py.File(path, "r") as file:
        for name, column in columns_of(dataset.attributes(path)["configuration"]).items():
            data = file[name]
            stored = f"{data.id.get_storage_size() / max(1, len(data)):.1f}"
            rows.append((name, str(data.dtype), str(data.shape), str(data.chunks[0]), column.unit, stored, column.description))
    widths = [max(len(r[k]) for r in rows) for k in range(6)]
    return ["  ".join([*(c.ljust(w) for c, w in zip(r[:6], widths, strict=True)), r[6]]) for r in rows]


def _outcomes(path: Path) -> list[str]:
    counts: dict[str, int] = {}
    for part in dataset.blocks(path):
        if "status" in part.columns:
            names = [HopStatus(int(s)).name if s in set(HopStatus) else f"unknown {s}" for s in part["status"]]
        else:
            names = np.where(part["converged"] == 1, "CONVERGED", "NOT_CONVERGED").tolist()
        for name in names:
            counts[name] = counts.get(name, 0) + 1
    return [f"{name:<16} {count}" for name, count in sorted(counts.items())]


def main(config: DescribeConfig) -> None:
    """Entry of ``python -m surrogate describe``."""
    print(describe(config.file))
