"""Simulate hops from spread-out stretches into one file; a rerun goes on where the last one stopped."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.stats import qmc
from tqdm import tqdm

from surrogate import dataset
from surrogate.dataset import Configuration, HopData
from surrogate.storage import ensure_folder
from tensegrity_gym import STRETCH_RANGE, Scene, simulate
from tensegrity_gym.errors import InvalidParameterError


@dataclass(frozen=True)
class GenerateConfig:
    """Simulate hops into an HDF5 file."""

    out: Annotated[Path, tyro.conf.Positional]
    """File to write; an interrupted or smaller one of the same configuration is continued."""
    hops: int = 256
    """Number of hops in the file."""
    seed: int = 0
    """Seed of the scrambled Sobol sequence of stretches."""
    scene: str = "earth"
    """Scene preset."""
    landing: str = "rest"
    """Where a landing is read: rest or touchdown."""
    chunk: int = 32
    """Hops that are committed together."""
    threads: int | None = None
    """Threads of the simulator."""


def sample_stretches(hops: int, seed: int, n_actuators: int = 4) -> np.ndarray:
    """Scrambled Sobol points in the range of stretches, shape (hops, n_actuators); a prefix of any longer sample."""
    if hops < 1:
        raise InvalidParameterError(f"hops: expected an integer >= 1, got {hops}")
    points = qmc.Sobol(n_actuators, scramble=True, rng=seed).random_base2(int(np.ceil(np.log2(hops))))[:hops]
    low, high = STRETCH_RANGE
    return np.clip(low + (high - low) * points, low, high)


def generate(
    path: Path | str,
    hops: int,
    configuration: Configuration,
    *,
    chunk: int = 32,
    threads: int | None = None,
    progress: bool = True,
) -> HopData:
    """Fill ``path`` up to ``hops`` hops and return the first ``hops`` of them.

    Each chunk is committed as a file of its own under ``<path>.parts``, by a rename; the parts are joined, and removed,
    when all are there. Killed at any moment, nothing is lost but the chunk at work.
    """
    path = Path(path)
    if configuration.sampler != "sobol":
        raise InvalidParameterError(f"sampler: expected 'sobol', got {configuration.sampler!r}")
    ensure_folder(path.parent)
    stretches = sample_stretches(hops, configuration.seed, configuration.lattice.n_cells)
    done = dataset.read(path, expect=configuration) if path.exists() else None
    start = 0 if done is None else len(done)
    if done is not None and start >= hops:
        return done.rows(slice(0, hops))
    folder = ensure_folder(path.with_name(path.name + ".parts"))
    parts = [] if done is None else [done]
    with tqdm(total=hops, initial=start, unit="hop", desc=f"hops -> {path.name}", disable=not progress) as bar:
        for first, last in _chunks(start, hops, chunk):
            parts.append(_part(folder / f"{first:08d}-{last:08d}.h5", stretches[first:last], configuration, threads, bar))
            bar.set_postfix(failed=int(sum((~p.usable).sum() for p in parts)), refresh=False)
    data = dataset.concatenate(parts)
    dataset.write(path, data)
    shutil.rmtree(folder)
    return data


def _chunks(start: int, stop: int, chunk: int) -> Iterator[tuple[int, int]]:
    """Row ranges cut at multiples of ``chunk``, so that a grown file has the chunks of one made in one go."""
    while start < stop:
        end = min((start // chunk + 1) * chunk, stop)
        yield start, end
        start = end


def _part(path: Path, stretches: np.ndarray, configuration: Configuration, threads: int | None, bar: tqdm) -> HopData:
    if path.exists():
        part = dataset.read(path, expect=configuration)
        bar.update(len(part))
        return part
    started = time.perf_counter()
    result = simulate(
        stretches,
        design=configuration.design,
        scene=configuration.scene,
        lattice=configuration.lattice,
        dt=configuration.dt,
        threads=threads,
        progress=bar.update,
    )
    part = dataset.from_result(result, configuration, time.perf_counter() - started)
    dataset.write(path, part)
    return part


def main(config: GenerateConfig) -> None:
    """Entry of ``python -m surrogate generate``."""
    configuration = Configuration(scene=Scene.preset(config.scene, landing=config.landing), seed=config.seed)
    data = generate(config.out, config.hops, configuration, chunk=config.chunk, threads=config.threads)
    distance = np.linalg.norm(data["landing"][data.usable], axis=1)
    print(f"{config.out}: {len(data)} hops, {int((~data.usable).sum())} failed, landing at {np.median(distance):.3f} m (median)")
