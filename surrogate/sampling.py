"""Which stretches, and which scene, hop number k of a file has: a pure function of the configuration and k."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.stats import qmc

from tensegrity_gym import STRETCH_RANGE
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tensegrity_gym.types import Floats

SAMPLERS = ("sobol", "uniform", "lhs", "grid", "file")


def unit_points(sampler: str, first: int, last: int, seed: int, dimensions: int, size: int = 0) -> Floats:
    """Points ``first`` to ``last`` of a sampler's sequence in the unit cube, shape (last - first, dimensions).

    ``sobol`` (scrambled) and ``uniform`` are endless and their prefixes nest. ``lhs``, a Latin hypercube, has ``size`` points;
    ``grid`` has ``size`` points along each axis, ends included, the last dimension running fastest.
    """
    if sampler == "sobol":
        whole = 2 ** int(np.ceil(np.log2(last - first)))  # a power of two, cut: scipy warns of anything else
        sequence = qmc.Sobol(dimensions, scramble=True, rng=seed)
        return (sequence.fast_forward(first) if first else sequence).random(whole)[: last - first]
    if sampler == "uniform":  # a counter-based generator: any chunk is drawn without those before it
        blocks = -(-dimensions // 4)
        bits = np.random.Philox(key=seed).advance(first * blocks)
        return np.random.Generator(bits).random((last - first, 4 * blocks))[:, :dimensions]
    if sampler == "lhs":
        return _latin_hypercube(size, dimensions, seed)[first:last]
    if sampler == "grid":
        steps = np.unravel_index(np.arange(first, last), (size,) * dimensions)
        return np.column_stack(steps) / max(size - 1, 1)
    raise InvalidParameterError(f"sampler: expected one of {SAMPLERS}, got {sampler!r}")


@lru_cache(maxsize=1)
def _latin_hypercube(size: int, dimensions: int, seed: int) -> Floats:
    return qmc.LatinHypercube(dimensions, rng=seed).random(size)


def sample_size(sampler: str, size: int, dimensions: int) -> int | None:
    """How many points a sampler has; None if it has no end."""
    return {"lhs": size, "grid": size**dimensions, "file": size}.get(sampler)


def scale(points: Floats) -> Floats:
    """From the unit cube to the range of stretches."""
    low, high = STRETCH_RANGE
    return np.clip(low + (high - low) * points, low, high)


def sample_stretches(hops: int, seed: int, n_actuators: int = 4) -> Floats:
    """The first scrambled Sobol points in the range of stretches, shape (hops, n_actuators); a prefix of any longer sample."""
    if hops < 1:
        raise InvalidParameterError(f"hops: expected an integer >= 1, got {hops}")
    return scale(unit_points("sobol", 0, hops, seed, n_actuators))


def read_stretches(path: Path | str, n_actuators: int = 4) -> Floats:
    """Stretches from a .npy file or a text file of numbers, one hop a line, shape (n, n_actuators)."""
    path = Path(path)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")  # which is said below, by name
            values = (
                np.load(path)
                if path.suffix == ".npy"
                else np.loadtxt(path, delimiter="," if path.suffix == ".csv" else None, ndmin=2)
            )
        values = np.atleast_2d(np.asarray(values, dtype=np.float64))
    except (OSError, ValueError, EOFError) as error:
        raise DataFileError(f"{path}: expected stretches as .npy, .csv or plain text, one hop a line ({error})") from error
    low, high = STRETCH_RANGE
    if not values.size:
        raise DataFileError(f"{path}: expected stretches of one hop at least, got none; write {n_actuators} numbers a line")
    if values.ndim != 2 or values.shape[1] != n_actuators or not np.all((values >= low) & (values <= high)):
        raise DataFileError(
            f"{path}: expected (n, {n_actuators}) stretches in [{low:g}, {high:g}], got shape {values.shape} "
            f"in [{values.min():g}, {values.max():g}]; reshape, clip or rescale them"
        )
    return values


def stretches_hash(stretches: Floats) -> str:
    """Hash of a list of stretches, 16 hex digits."""
    return hashlib.sha256(np.ascontiguousarray(stretches, dtype="<f8").tobytes()).hexdigest()[:16]


def draw_scene(ranges: Mapping[str, tuple[float, float]], seed: int, group: int) -> dict[str, float]:
    """The varied values of the scene that hops of ``group`` share; each uniform in its range."""
    rng = np.random.default_rng([seed, group])
    return {name: float(rng.uniform(*ranges[name])) for name in sorted(ranges)}
