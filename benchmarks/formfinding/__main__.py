"""Form-finding measured: error against CPU time, line search, cells, other equilibria, where it fails, stability.

    python -m benchmarks.formfinding            # everything, 10 to 15 minutes on one core
    python -m benchmarks.formfinding --quick    # two minutes
    python -m benchmarks.formfinding --parts failures

Prints tables; charts go to docs/images/formfinding_*.png. Times are CPU times of one thread, so that a busy machine shows less.
"""

from __future__ import annotations

from collections.abc import Callable

import tyro

from benchmarks.formfinding.accuracy import accuracy, line_search
from benchmarks.formfinding.branches import branches
from benchmarks.formfinding.common import Config
from benchmarks.formfinding.failures import failures
from benchmarks.formfinding.speed import cells, throughput
from benchmarks.formfinding.stability import stability

PARTS: dict[str, Callable[[Config], None]] = {
    "accuracy": accuracy,
    "line_search": line_search,
    "cells": cells,
    "throughput": throughput,
    "branches": branches,
    "failures": failures,
    "stability": stability,
}


def main(config: Config) -> None:
    """Run the parts asked for."""
    for part in config.parts:
        PARTS[part](config)


if __name__ == "__main__":
    main(tyro.cli(Config))
