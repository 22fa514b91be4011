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


class NumpyStream:
    """NumPy's global random numbers, which ``cma`` seeds and draws from: inside ``with`` ours, outside as the user left them."""

    def __init__(self) -> None:
        self.inside: Any = None
        self.outside: Any = None

    def __enter__(self) -> None:
        self.outside = np.random.get_state()  # noqa: NPY002 (the generator that cma uses)
        if self.inside is not None:
            np.random.set_state(self.inside)  # noqa: NPY002

    def __exit__(self, *raised: object) -> None:
        self.inside = np.random.get_state()  # noqa: NPY002
        np.random.set_state(self.outside)  # noqa: NPY002


class EvolutionPlanner:
    """CMA-ES from another planner's answer; the searches of all targets advance together, so that hops form batches.

    They draw in turn from one stream of random numbers, seeded anew for each batch: the same batch gets the same answers, but
    a target's answer depends, a little, on which targets are asked with it.
    """

    def __init__(self, land: Land, start: Planner, config: EvolutionConfig | None = None) -> None:
        self.land, self.start, self.config = land, start, config or EvolutionConfig()
        #: Calls of ``land``, in hops, so far.
        self.calls = 0

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4): of all hops looked at, the nearest to each target."""
        targets = targets_of(observation)
        starts = self.start.predict(targets)[0]
        stream = NumpyStream()
        with stream:
            searches = [self._search(first) for first in starts]
        # the start is the answer until a hop has landed: one that failed is none
        best, least = np.clip(starts, *STRETCH_RANGE), np.full(len(targets), np.inf)
        for _ in range(self.config.evaluations // self.config.population):
            with stream:
                asked = np.clip(np.array([s.ask() for s in searches]), *STRETCH_RANGE)  # (n, population, n_actuators)
            landings = np.asarray(self.land(asked.reshape(-1, asked.shape[2]))).reshape(*asked.shape[:2], 2)
            self.calls += asked.shape[0] * asked.shape[1]
            error = np.linalg.norm(landings - targets[:, None], axis=2)
            landed = np.isfinite(error)
            told = np.where(landed, error, 1e3)  # a failed hop is far from everything
            with stream:
                for search, stretches, found in zip(searches, asked, told, strict=True):
                    search.tell(list(stretches), found.tolist())
            error = np.where(landed, error, np.inf)
            for k, winner in enumerate(error.argmin(axis=1)):
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
