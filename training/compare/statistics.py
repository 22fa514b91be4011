"""Statistics of errors over seeds and targets, after Agarwal et al. 2021, "Deep RL at the edge of the statistical precipice"."""

from __future__ import annotations

import numpy as np
from scipy import stats

from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.types import Floats


def interquartile_mean(values: Floats, axis: int | None = None) -> Floats:
    """Mean of the middle half: as robust as a median, with less scatter."""
    return stats.trim_mean(values, 0.25, axis=axis)


def interval(errors: Floats, level: float = 0.95, draws: int = 2000, seed: int = 0) -> tuple[float, float]:
    """Bootstrap interval of the interquartile mean of ``errors``, shape (seeds, targets), at ``level``.

    Stratified: seeds are drawn anew within each target, so it speaks of other training seeds on the same targets. With one
    seed there is nothing to draw from, and both ends are not a number.
    """
    seeds, targets = _checked(errors).shape
    if seeds == 1:
        return float("nan"), float("nan")
    rng = np.random.default_rng(seed)
    drawn = errors[rng.integers(seeds, size=(draws, seeds, targets)), np.arange(targets)]
    means = interquartile_mean(drawn.reshape(draws, -1), axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def probability_of_improvement(ours: Floats, theirs: Floats) -> float:
    """Chance that a run of ours errs less than one of theirs on a target, mean over targets; ties count half.

    Shapes (seeds, targets) and (other seeds, targets).
    """
    if _checked(ours).shape[1] != _checked(theirs).shape[1]:
        raise InvalidParameterError(f"expected errors on the same targets, got {ours.shape[1]} and {theirs.shape[1]}")
    a, b = ours[:, None], theirs[None]
    return float(((a < b) + 0.5 * (a == b)).mean())


def performance_profile(errors: Floats, radii: Floats) -> Floats:
    """Share of errors within each of ``radii``, shape (n,)."""
    return (np.asarray(errors).reshape(-1, 1) <= np.asarray(radii)).mean(axis=0)


def _checked(errors: Floats) -> Floats:
    if errors.ndim != 2 or not errors.size:
        raise InvalidParameterError(f"errors: expected shape (seeds, targets), got {errors.shape}")
    return errors
