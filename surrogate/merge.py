"""Shards of one configuration put into one file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surrogate import dataset
from surrogate.hops import check_configuration
from surrogate.join import join, pieces_of, skipped_of
from surrogate.storage import ensure_folder, writer_lock
from tensegrity_gym.errors import DataFileError


@dataclass(frozen=True)
class MergeConfig:
    """Join shards into one file; what they hold twice, or of another configuration, is refused."""

    out: Annotated[Path, tyro.conf.Positional]
    """File to make; it must not be there."""
    shards: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Files to join."""


def merge(out: Path | str, shards: list[Path]) -> Path:
    """Join ``shards`` in the order of their hops into ``out``, which must not exist yet."""
    out = Path(out)
    if not shards:
        raise DataFileError("merge: expected at least one shard, got none")
    if out.exists():
        raise DataFileError(f"merge: expected {out} not to be there yet, it is; choose another name")
    ensure_folder(out.parent)
    configuration = dataset.attributes(shards[0])["configuration"]
    for shard in shards[1:]:
        check_configuration(dataset.attributes(shard)["configuration"], configuration, str(shard))
    with writer_lock(out):
        pieces = pieces_of(shards)
        return dataset.write_blocks(out, configuration, join(pieces), skipped_of(shards, pieces))


def main(config: MergeConfig) -> None:
    """Entry of ``python -m surrogate merge``."""
    merge(config.out, list(config.shards))
    about = dataset.attributes(config.out)
    print(f"{config.out}: {about['hops']} rows of {len(config.shards)} shards, digest {about['digest'][:16]}")
