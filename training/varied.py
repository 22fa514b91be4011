"""Planners where scenes vary: each observation says which scene it is of, and a planner is made for that scene.

All plan in lengths made alike (see ``similarity``), so that what is learnt in one gravity serves in another.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import KDTree

from tensegrity_gym.scene_ranges import SceneRanges
from tensegrity_gym.types import Floats
from training.planner import NearestHopPlanner, Planner, Prediction
from training.similarity import alike

#: Neighbours of each hop that tell how its landing changes with stretches and scene.
NEIGHBOURS = 8


class VariedPlanner:
    """Observations, target [m] and scene values, answered by a planner made anew for each scene that occurs among them.

    ``make``: scene values (k,) [SI] to a planner of targets in that scene, as they would be on Earth [m].
    """

    def __init__(self, make: Callable[[Floats], Any], scenes: SceneRanges) -> None:
        self.make, self.scenes = make, scenes

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Observations (2 + k,) or (n, 2 + k) to stretches (4,) or (n, 4)."""
        found = self._asked(observation, lambda planner, targets: planner.predict(targets)[0])
        return (found[0] if np.ndim(observation) == 1 else found), state

    def propose(self, observations: np.ndarray, count: int) -> np.ndarray:
        """``count`` different answers to each observation (n, 2 + k), best first, shape (n, count, n_actuators)."""
        return self._asked(observations, lambda planner, targets: planner.propose(targets, count))

    def _asked(self, observations: np.ndarray, ask: Callable[[Any, Floats], np.ndarray]) -> np.ndarray:
        targets, values = alike(observations, self.scenes)
        distinct, which = np.unique(values, axis=0, return_inverse=True)
        rows = [np.flatnonzero(which.reshape(-1) == k) for k in range(len(distinct))]
        parts = [ask(self.make(scene), targets[row]) for scene, row in zip(distinct, rows, strict=True)]
        return np.concatenate(parts)[np.argsort(np.concatenate(rows))]


class ScaledScenes:
    """A planner that is told scenes itself: targets as they would be on Earth [m], then scene values from -1 to 1."""

    def __init__(self, planner: Planner, scenes: SceneRanges) -> None:
        self.planner, self.scenes = planner, scenes

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Observations (2 + k,) or (n, 2 + k) to stretches (4,) or (n, 4)."""
        targets, values = alike(observation, self.scenes)
        found, _ = self.planner.predict(np.column_stack([targets, unit_values(values, self.scenes)]))
        return (found[0] if np.ndim(observation) == 1 else found), state


def unit_values(values: Floats, scenes: SceneRanges) -> Floats:
    """Scene values (n, k) [SI] from -1 to 1 over their ranges."""
    low, high = scenes.bounds()
    return (np.asarray(values, dtype=np.float64) - (low + high) / 2) / ((high - low) / 2)


class NearestVariedHops:
    """Stored hops of many scenes: for each scene the planner that repeats one of them.

    The squared error to expect of repeating a hop is its landing's squared distance to the target plus what being of another
    scene costs: ``weights`` (k,) [m^2] times the squared differences of the scene values, ranges being 2 long. These weights are
    read off the stored hops themselves: how far apart hops with nearly the same stretches landed, squared, is fitted by a
    constant and multiples of the squared differences of stretches and scene values (non-negative least squares).

    Args:
        stretches: shape (n, n_actuators).
        landings: as they would be on Earth, shape (n, 2) [m].
        values: of each hop's scene, shape (n, k) [SI].
    """

    def __init__(self, stretches: Floats, landings: Floats, values: Floats, scenes: SceneRanges) -> None:
        self.stretches, self.landings, self.scenes = stretches, landings, scenes
        self.values = unit_values(values, scenes)
        self.weights = self._fitted()

    def at(self, values: Floats) -> NearestHopPlanner:
        """The planner of one scene, of ``values`` (k,) [SI]."""
        away = (self.values - unit_values(values[None], self.scenes)) ** 2
        return NearestHopPlanner(self.stretches, self.landings, away @ self.weights)

    def _fitted(self) -> Floats:
        count = min(NEIGHBOURS + 1, len(self.stretches))
        if count < 2:
            return np.zeros(self.values.shape[1])
        near = KDTree(self.stretches).query(self.stretches, count)[1][:, 1:]  # the first is the hop itself
        apart = ((self.stretches[near] - self.stretches[:, None]) ** 2).sum(axis=2).reshape(-1, 1)
        strange = ((self.values[near] - self.values[:, None]) ** 2).reshape(-1, self.values.shape[1])
        moved = ((self.landings[near] - self.landings[:, None]) ** 2).sum(axis=2).reshape(-1)
        return nnls(np.column_stack([np.ones(len(apart)), apart, strange]), moved)[0][2:]
