"""Plan, simulate the plan, learn from it, plan again: a few simulator calls an answer, each chosen by what the last one told."""

from __future__ import annotations

from typing import Any

import numpy as np

from tensegrity_gym.errors import InvalidParameterError
from training.inverse import InversePlanner
from training.planner import Land, Prediction, targets_of


class RefiningPlanner:
    """Answer with the best of ``tries`` hops, each of which is planned with those before it in memory.

    The map is rough between the stored hops, but smooth close by: a handful of hops around an answer tell how it runs there.
    """

    def __init__(self, inverse: InversePlanner, land: Land, tries: int = 8) -> None:
        if tries < 1:
            raise InvalidParameterError(f"tries: expected an integer >= 1, got {tries}")
        self.inverse, self.land, self.tries = inverse, land, tries
        #: Hops simulated for answers so far.
        self.simulator_calls = 0

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4); each costs ``tries`` simulator calls."""
        targets = targets_of(observation)
        planners = [self.inverse] * len(targets)
        asked = self.inverse.plan(targets).stretches
        best, least = asked.copy(), np.full(len(targets), np.inf)
        for k in range(self.tries):
            landings = np.asarray(self.land(asked))
            self.simulator_calls += len(asked)
            error = np.linalg.norm(landings - targets, axis=1)
            error[~np.isfinite(error)] = np.inf
            better = error < least
            best[better], least[better] = asked[better], error[better]
            if k + 1 == self.tries:
                break
            for i in np.flatnonzero(np.isfinite(error)):
                planners[i] = planners[i].told(asked[i : i + 1], landings[i : i + 1])
            following = [planner.plan(target[None]).stretches[0] for planner, target in zip(planners, targets, strict=True)]
            asked = np.stack(following)
        return (best[0] if np.ndim(observation) == 1 else best), state
