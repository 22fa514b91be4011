"""What the measurements of form-finding share."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl
import numpy as np

from tensegrity_gym import Design, Equilibria, Lattice

mpl.use("Agg")
import matplotlib.pyplot as plt

IMAGES = Path(__file__).parents[2] / "docs" / "images"
LATTICE, DESIGN = Lattice(2, 2), Design()
#: Energies closer than this are one equilibrium [J]: found ones agree to 1e-12 J, different ones differ by 1e-5 J or more.
SAME = 1e-7


@dataclass
class Config:
    """What to measure."""

    quick: bool = False
    """Fewer stretches and lattices."""
    parts: tuple[str, ...] = ("accuracy", "line_search", "cells", "throughput", "branches", "failures", "stability")
    """Which measurements."""
    images: Path = field(default=IMAGES)
    """Folder for the charts."""
    seed: int = 0
    """Of the random stretches and starts."""


def timed(call: Callable[[], Equilibria]) -> tuple[Equilibria, float]:
    """The equilibria and the CPU time each took [s]."""
    begin = time.process_time()
    found = call()
    return found, (time.process_time() - begin) / len(found.stretches)


def stretches(n: int, seed: int, cells: int = 4, low: float = 0.2, high: float = 0.8) -> np.ndarray:
    """Random stretches in the paper's range, shape (n, cells)."""
    return np.random.default_rng(seed).uniform(low, high, size=(n, cells))


def save(figure: plt.Figure, config: Config, name: str) -> None:
    """Write a chart."""
    config.images.mkdir(parents=True, exist_ok=True)
    figure.savefig(config.images / f"formfinding_{name}.png", dpi=80, bbox_inches="tight")
    plt.close(figure)


def first(found: Equilibria, n: int) -> Equilibria:
    """The first ``n`` equilibria."""
    return select(found, np.arange(n))


def select(found: Equilibria, rows: np.ndarray) -> Equilibria:
    """Some of the equilibria."""
    columns = {k: v[rows] if isinstance(v, np.ndarray) else v for k, v in vars(found).items()}
    columns["energies"] = {k: v[rows] for k, v in found.energies.items()}
    return Equilibria(**columns)
