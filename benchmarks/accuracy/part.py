"""What a part of the accuracy benchmark is: it measures arrays, keeps them, reports lines and draws a figure."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np

from tensegrity_gym import MODEL_VERSION

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

Data = dict[str, np.ndarray]


@dataclass(frozen=True)
class Options:
    """Where results go and how much is measured."""

    quick: bool = False
    """Fewer hops and coarser maps: all parts within about three minutes on an idle core."""
    redo: bool = False
    """Measure again what a former run has left in ``runs``."""
    runs: Path = Path("runs/accuracy")
    """Data of each part, and of each batch of hops, so that an interrupted run goes on where it was."""
    images: Path = Path("docs/images")
    """Figures, accuracy_<part>.png; those of a quick run stay in ``runs``."""

    def size(self, full: int, quick: int) -> int:
        """``full`` or, in a quick run, ``quick``."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Part:
    """One question: ``measure`` answers it in arrays, ``report`` in lines of text, ``plot`` in a figure."""

    name: str
    measure: Callable[[Options], Data]
    report: Callable[[Data], list[str]]
    plot: Callable[[Data], Figure] | None = None

    def run(self, options: Options) -> None:
        """Measure (or read what was measured), print and keep the report, draw."""
        data = kept(options, self.name, lambda: self.measure(options))
        lines = self.report(data)
        text = "\n".join([f"== {self.name} ==", *lines])
        print(text, flush=True)
        (_folder(options) / f"{self.name}.txt").write_text(text + "\n")
        if self.plot is not None:
            figure = self.plot(data)
            folder = _folder(options) if options.quick else options.images
            folder.mkdir(parents=True, exist_ok=True)
            figure.savefig(folder / f"accuracy_{self.name}.png", dpi=72)
            plt.close(figure)


def kept(options: Options, name: str, measure: Callable[[], Data], **key: object) -> Data:
    """``measure()``, or what it gave when last called under this name, key and model version."""
    tag = hashlib.sha256(repr(sorted(key.items())).encode()).hexdigest()[:10] if key else "part"
    path = _folder(options) / f"{name}-{tag}.npz"
    if path.exists() and not options.redo:
        with np.load(path) as found:
            if str(found["model_version"]) == MODEL_VERSION:
                return {k: found[k] for k in found.files if k != "model_version"}
    start = time.process_time()
    data = measure()
    data = {"cpu": np.array(time.process_time() - start)} | data
    np.savez(path, model_version=np.array(MODEL_VERSION), **data)  # type: ignore[arg-type]
    return data


def _folder(options: Options) -> Path:
    folder = options.runs / ("quick" if options.quick else "full")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def table(head: str, rows: list[list[str]]) -> list[str]:
    """Columns of text under the words of ``head`` (separated by two blanks or more), right-aligned."""
    names = [name for name in head.split("  ") if name.strip()]
    lines = [[name.strip() for name in names], *rows]
    widths = [max(len(line[k]) for line in lines) for k in range(len(names))]
    return ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines]
