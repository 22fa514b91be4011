"""``python -m benchmarks.accuracy [--quick] [part ...]``: measure, report and draw all parts or the named ones."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from multiprocessing import get_context

import tyro

from benchmarks.accuracy import (
    auto,
    bars,
    damping,
    drops,
    floor,
    growth,
    ladder,
    limits,
    reference,
    rounding,
    scenes,
    sensitivity,
    stability,
)
from benchmarks.accuracy.part import Options

MODULES = (bars, reference, floor, sensitivity, growth, stability, limits, drops, rounding, damping, scenes, ladder, auto)
PARTS = {part.name: part for module in MODULES for part in (module.PART, *getattr(module, "OTHERS", ()))}


@dataclass(frozen=True)
class Arguments(Options):
    """Accuracy of hops and the limits of the methods; data in ``runs``, figures in docs/images."""

    parts: tyro.conf.Positional[tuple[str, ...]] = ()
    """Which parts, in this order; all by default."""


def main(arguments: Arguments) -> None:
    """Run the parts asked for."""
    unknown = [name for name in arguments.parts if name not in PARTS]
    if unknown:
        raise SystemExit(f"accuracy: expected parts among {', '.join(PARTS)}, got {', '.join(unknown)}")
    names = arguments.parts or tuple(PARTS)
    if not arguments.quick:
        for name in names:
            run_part(name, arguments)
        return
    # side by side: a quick look's processor times may suffer a little
    with ProcessPoolExecutor(len(os.sched_getaffinity(0)), mp_context=get_context("fork")) as pool:
        list(pool.map(run_part, names, repeat(arguments)))


def run_part(name: str, options: Options) -> None:
    """One part, in this process."""
    PARTS[name].run(options)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
