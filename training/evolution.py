"""CMA-ES, one search per target: on the simulator the oracle that other planners are measured by, or on a surrogate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tensegrity_gym import STRETCH_RANGE
from tensegrity_gym.errors import InvalidParameterError, MissingExtraError
from training.planner import Land, Planner, Prediction, targets_of


@dataclass(frozen=True)
class EvolutionConfig:
    """One covariance matrix adaptation per target."""

    evaluations: int = 160
    """Hops looked at per target."""
    population: int = 8
    """Hops per generation."""
    sigma: float = 0.08
    """Standard deviation of the first generation, in stretches."""
    seed: int = 0
    """Seed of the search."""

    def __post_init__(self) -> None:
        if self.population < 2 or self.evaluations < self.population:
            raise InvalidParameterError(
                f"population and evaluations: expected 2 <= population <= evaluations, got {self.population}, {self.evaluations}"
            )


class EvolutionPlanner:
    """CMA-ES from another planner's answer; the searches of all targets advance together, so that hops form batches."""

    def __init__(self, land: Land, start: Planner, config: EvolutionConfig | None = None) -> None:
        self.land, self.start, self.config = land, start, config or EvolutionConfig()
        #: Calls of ``land``, in hops, so far.
        self.calls = 0

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4): of all hops looked at, the nearest to each target."""
        targets = targets_of(observation)
        searches = [self._search(first) for first in self.start.predict(targets)[0]]
        best, least = np.stack([s.x0 for s in searches]), np.full(len(targets), np.inf)
        for _ in range(self.config.evaluations // self.config.population):
            asked = np.clip(np.array([s.ask() for s in searches]), *STRETCH_RANGE)  # (n, population, n_actuators)
            landings = np.asarray(self.land(asked.reshape(-1, asked.shape[2]))).reshape(*asked.shape[:2], 2)
            self.calls += asked.shape[0] * asked.shape[1]
            error = np.linalg.norm(landings - targets[:, None], axis=2)
            error = np.where(np.isfinite(error), error, 1e3)  # a failed hop is far from everything
            for k, search in enumerate(searches):
                search.tell(list(asked[k]), error[k].tolist())
                winner = int(error[k].argmin())
                if error[k, winner] < least[k]:
                    best[k], least[k] = asked[k, winner], error[k, winner]
        return (best[0] if np.ndim(observation) == 1 else best), state

    def _search(self, first: np.ndarray) -> Any:
        try:
            import cma
        except ImportError as missing:
            raise MissingExtraError(
                "CMA-ES: expected cma to be installed, it is not; pip install 'tensegrity-gym[cma]'"
            ) from missing
        low, high = STRETCH_RANGE
        options = {
            "bounds": [low, high],
            "popsize": self.config.population,
            "seed": self.config.seed + 1,  # 0 would mean the time of day
            "verbose": -9,
        }
        return cma.CMAEvolutionStrategy(np.clip(first, low + 1e-6, high - 1e-6), self.config.sigma, options)
