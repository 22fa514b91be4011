"""Simulate what a planner or policy proposes, from starts moved a little, and measure how far from its targets it lands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tensegrity_gym.task import TARGET_LIMIT, reach
from tensegrity_gym.types import Floats
from training.hops import Hops

FIELDS = ("stretches", "landings", "errors")


@dataclass(frozen=True)
class Score:
    """Landing errors of one method's answers on a set of targets, each answer simulated from ``starts`` moved starts."""

    stretches: np.ndarray  #: proposed, shape (n, n_actuators) [-]
    landings: np.ndarray  #: simulated, shape (n, starts, 2) [m]; not-a-number where a hop failed
    errors: np.ndarray  #: mean distance of an answer's landings to its target, shape (n,) [m]

    @property
    def starts(self) -> int:
        """Moved starts of each answer."""
        return self.landings.shape[1]

    def summary(self, reach: float) -> dict[str, float]:
        """Median and mean error [m] and in % of ``reach`` [m], and the share of failed hops [%]."""
        median, mean = float(np.median(self.errors)), float(self.errors.mean())
        return {
            "median_error": median,
            "mean_error": mean,
            "median_percent": 100 * median / reach,
            "mean_percent": 100 * mean / reach,
            "failed_percent": 100 * float((~np.isfinite(self.landings).all(axis=2)).mean()),
        }

    def as_dict(self) -> dict[str, Any]:
        """JSON-like content."""
        return {name: getattr(self, name).tolist() for name in FIELDS}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Score:
        """Inverse of :meth:`as_dict`."""
        return cls(*(np.array(content[name]) for name in FIELDS))


def score_stretches(stretches: Floats, targets: Floats, hops: Hops, starts: int) -> Score:
    """Simulate stretches (n, n_actuators), meant to land on ``targets`` (n, 2) [m], each from ``starts`` moved starts.

    The unmoved start is left out: a planner may have tried its answer there, and a stored hop repeats its landing bit by bit.
    """
    stretches = np.asarray(stretches, dtype=np.float64)
    landings = hops.moved(stretches, starts)
    return Score(stretches, landings, distances(landings, targets, reach(hops.scene)).mean(axis=1))


def scatter(stretches: Floats, hops: Hops, starts: int) -> Floats:
    """How far moved starts alone carry the landings of ``stretches``: mean distance from the unmoved hop's, shape (n,) [m]."""
    landings = hops.perturbed(stretches, starts)
    return distances(landings[:, 1:], landings[:, 0], reach(hops.scene)).mean(axis=1)


def distances(landings: Floats, targets: Floats, reaches: Floats | float) -> Floats:
    """Distances of landings (..., n, starts, 2) from targets (n, 2), shape (..., n, starts) [m].

    A failed hop counts as one that landed as far away as any target may be; ``reaches``: of the targets' scenes, (n, 1) or
    one [m].
    """
    found = np.linalg.norm(landings - np.asarray(targets, dtype=np.float64)[:, None], axis=-1)
    return np.where(np.isfinite(found), found, TARGET_LIMIT * reaches)
