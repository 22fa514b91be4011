"""Simulate what a planner or policy proposes and measure where it lands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tensegrity_gym import Design, HopStatus, Lattice, Scene, simulate
from training.planner import Planner

FIELDS = ("stretches", "landings", "errors", "failed")


@dataclass(frozen=True)
class Score:
    """Landing errors of one planner on a set of targets."""

    stretches: np.ndarray  #: proposed, shape (n, n_actuators) [-]
    landings: np.ndarray  #: simulated, shape (n, 2) [m]
    errors: np.ndarray  #: distance to the targets, shape (n,) [m]
    failed: np.ndarray  #: hops that blew up or had no equilibrium, shape (n,)

    def summary(self, reach: float) -> dict[str, float]:
        """Median and mean error [m] and in % of ``reach`` [m], and the share of failed hops [%].

        A failed hop counts as landing where it last was finite; the share says how many there are.
        """
        median, mean = float(np.median(self.errors)), float(self.errors.mean())
        return {
            "median_error": median,
            "mean_error": mean,
            "median_percent": 100 * median / reach,
            "mean_percent": 100 * mean / reach,
            "failed_percent": 100 * float(self.failed.mean()),
        }

    def as_dict(self) -> dict[str, Any]:
        """JSON-like content."""
        return {name: getattr(self, name).tolist() for name in FIELDS}

    def divided(self, parts: int) -> list[Score]:
        """Equal parts, in order."""
        columns = [np.split(getattr(self, name), parts) for name in FIELDS]
        return [Score(*part) for part in zip(*columns, strict=True)]

    @classmethod
    def of_landings(cls, stretches: Any, landings: Any, targets: np.ndarray) -> Score:
        """Score of hops that are known to have landed at ``landings`` (n, 2) [m]."""
        landings = np.asarray(landings, dtype=np.float64)
        errors = np.linalg.norm(landings - targets, axis=1)
        return cls(np.asarray(stretches, dtype=np.float64), landings, errors, np.zeros(len(landings), dtype=bool))

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Score:
        """Inverse of :meth:`as_dict`."""
        return cls(*(np.array(content[name]) for name in FIELDS))


def score(
    planner: Planner,
    targets: np.ndarray,
    scene: Scene,
    *,
    design: Design | None = None,
    lattice: Lattice | None = None,
    progress: Any = None,
) -> Score:
    """Ask ``planner`` for every target (n, 2) [m] and simulate its answers; these hops count as evaluation."""
    stretches, _ = planner.predict(np.asarray(targets, dtype=np.float32), deterministic=True)
    return score_stretches(stretches, targets, scene, design=design, lattice=lattice, progress=progress)


def score_stretches(
    stretches: np.ndarray,
    targets: np.ndarray,
    scene: Scene,
    *,
    design: Design | None = None,
    lattice: Lattice | None = None,
    progress: Any = None,
) -> Score:
    """Simulate stretches (n, n_actuators) that are meant to land on ``targets`` (n, 2) [m]."""
    stretches = np.asarray(stretches, dtype=np.float64)
    result = simulate(stretches, design=design or Design(), scene=scene, lattice=lattice or Lattice(), progress=progress)
    errors = np.linalg.norm(result.landing - np.asarray(targets, dtype=np.float64), axis=1)
    return Score(stretches, result.landing, errors, np.isin(result.status, (HopStatus.UNSTABLE, HopStatus.NOT_CONVERGED)))
