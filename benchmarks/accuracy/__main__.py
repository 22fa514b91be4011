"""``python -m benchmarks.accuracy [--quick] [part ...]``: measure, report and draw all parts or the named ones."""

from __future__ import annotations

from dataclasses import dataclass

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
PARTS = {module.PART.name: module.PART for module in MODULES}


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
    for name in arguments.parts or tuple(PARTS):
        PARTS[name].run(arguments)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
