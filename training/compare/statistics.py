"""Statistics of errors over seeds and targets, after Agarwal et al. 2021, "Deep RL at the edge of the statistical precipice"."""

from __future__ import annotations

import numpy as np
from scipy import stats

from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.types import Floats

#: Seeds from which on a bootstrap over them says something.
FEWEST_SEEDS = 5


def interquartile_mean(values: Floats, axis: int | None = None) -> Floats:
    """Mean of the middle half: as robust as a median, with less scatter."""
    return stats.trim_mean(values, 0.25, axis=axis)


def interval(errors: Floats, level: float = 0.95, draws: int = 2000, seed: int = 0) -> tuple[float, float]:
    """Bootstrap interval of the interquartile mean of ``errors``, shape (seeds, targets), at ``level``.

    Whole seeds are drawn: one training answers all targets, and a bad one errs on many, so that seeds drawn anew within each
    target, as for benchmarks whose every task has trainings of its own, would promise too much. The targets are the same in
    each draw. With fewer than ``FEWEST_SEEDS`` the ends are those of the range of the seeds' own interquartile means.
    """
    seeds = len(_checked(errors))
    if seeds < FEWEST_SEEDS:
        own = interquartile_mean(errors, axis=1)
        return float(own.min()), float(own.max())

    def statistic(rows: np.ndarray, axis: int = -1) -> Floats:
        drawn = errors[rows]  # (..., seeds, targets)
        return interquartile_mean(drawn.reshape(*drawn.shape[:-2], -1), axis=-1)

    found = stats.bootstrap(
        (np.arange(seeds),), statistic, n_resamples=draws, confidence_level=level, method="percentile", random_state=seed
    ).confidence_interval
    return float(found.low), float(found.high)


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
