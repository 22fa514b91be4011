"""From targets to stretches. Every planner has stable-baselines3's ``predict`` signature, so that one scorer fits all.

Here: what a planner is, and those that look at simulated hops alone. ``inverse`` descends through a surrogate, ``tandem``
learns the inverse once and for all, ``evolution`` searches without derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from scipy.spatial import KDTree

from tensegrity_gym.errors import InvalidParameterError

#: Stored hops that tell how landings change about a point.
NEIGHBOURS = 24
#: Stretches, shape (n, n_actuators), to where their hops land, shape (n, 2) [m]; not-a-number where a hop failed.
Land = Callable[[np.ndarray], np.ndarray]
Prediction = tuple[np.ndarray, Any]
#: Symmetries under which hops have images: permutations of stretches (g, n_actuators) and signs of landings (g, 2).
Images = tuple[np.ndarray, np.ndarray]


class Planner(Protocol):
    """Anything that answers observations with stretches: the planners here, and policies."""

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Observations whose first two numbers are the target [m], (2,) or (n, 2), to stretches (4,) or (n, 4)."""
        ...


class SlopedPlanner(Planner, Protocol):
    """A planner that also knows how landings change about an answer."""

    def slope(self, stretches: np.ndarray) -> np.ndarray:
        """How landings change with the stretches (n, n_actuators), shape (n, 2, n_actuators) [m]."""
        ...


def targets_of(observation: np.ndarray) -> np.ndarray:
    """The targets in one observation or a batch of them, shape (n, 2) [m]; InvalidParameterError if they are none."""
    targets = np.atleast_2d(np.asarray(observation, dtype=np.float64))
    if targets.ndim != 2 or targets.shape[1] < 2 or not len(targets) or not np.isfinite(targets).all():
        raise InvalidParameterError(f"observation: expected finite targets (2,) or (n, 2) [m], at least one, got {observation!r}")
    return targets[:, :2]


def with_images(stretches: np.ndarray, landings: np.ndarray, images: Images | None) -> tuple[np.ndarray, np.ndarray]:
    """Hops, stretches (n, n_actuators) and landings (n, 2) [m], with their images, (g n, n_actuators) and (g n, 2) [m]."""
    if images is None:
        return stretches, landings
    permutations, signs = images
    return stretches[:, permutations].reshape(-1, stretches.shape[1]), (landings[:, None] * signs).reshape(-1, 2)


class NearestHopPlanner:
    """Repeat the stored hop that landed nearest to the target: the baseline that every other planner must beat.

    Args:
        stretches: of the stored hops, shape (m, n_actuators).
        landings: where they landed, shape (m, 2) [m]; hops whose landing is not a number are left out.
        images: symmetries of lattice and ground: a hop's image under each counts as stored too, for it needs no simulating.
        strangeness: squared error to expect of each hop for its being of another scene, shape (m,) [m^2].
    """

    def __init__(
        self,
        stretches: np.ndarray,
        landings: np.ndarray,
        *,
        images: Images | None = None,
        strangeness: np.ndarray | None = None,
    ) -> None:
        stretches, landings = np.asarray(stretches, dtype=np.float64), np.asarray(landings, dtype=np.float64)
        known = np.isfinite(landings).all(axis=1) if landings.ndim == 2 else np.zeros(0, dtype=bool)
        if len(stretches) != len(landings) or not known.any():
            raise InvalidParameterError(
                f"expected as many stretches as landings, at least one of them finite, got {len(stretches)} and {len(landings)}, "
                f"{known.sum()} finite"
            )
        #: All images of the stored hops: stretches (g m, n_actuators) and where they land (g m, 2) [m].
        self.stretches, self.landings = with_images(stretches[known], landings[known], images)
        self.strangeness = None if strangeness is None else np.repeat(strangeness[known], len(self.stretches) // known.sum())

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4)."""
        targets = targets_of(observation)
        if self.strangeness is None:
            nearest = self._landed.query(targets)[1]
        else:  # one target at a time: all at once would take targets x hops numbers
            nearest = np.array([(((self.landings - t) ** 2).sum(axis=1) + self.strangeness).argmin() for t in targets])
        chosen = self.stretches[nearest]
        return (chosen[0] if np.ndim(observation) == 1 else chosen), state

    @cached_property
    def _landed(self) -> KDTree:
        return KDTree(self.landings)

    @cached_property
    def _tried(self) -> KDTree:
        return KDTree(self.stretches)

    def recall(self, stretches: np.ndarray) -> np.ndarray:
        """Where stored hops, or their images, of just these stretches (n, n_actuators) landed, not-a-number where there are
        none, shape (n, 2) [m]."""
        away, which = self._tried.query(stretches)
        return np.where(away[:, None] == 0.0, self.landings[which], np.nan)

    def slope(self, stretches: np.ndarray) -> np.ndarray:
        """Of the plane fitted to the landings of the nearest stored hops and their images; see ``SlopedPlanner``."""
        near = self._tried.query(stretches, min(NEIGHBOURS, self._tried.n))[1].reshape(len(stretches), -1)
        away = self.stretches[near] - np.asarray(stretches)[:, None]
        plane = np.linalg.pinv(np.concatenate([np.ones((*near.shape, 1)), away], axis=2)) @ self.landings[near]
        return plane[:, 1:].swapaxes(1, 2)


class Proposer(Protocol):
    """A planner that can name several different answers to each target."""

    def propose(self, targets: np.ndarray, count: int) -> np.ndarray:
        """Targets (n, 2) [m] to ``count`` different stretches each, best first, shape (n, count, n_actuators)."""
        ...


class BestOfPlanner:
    """Simulate ``tries`` of a planner's proposals and answer with the one that landed nearest to the target."""

    def __init__(self, proposer: Proposer, land: Land, tries: int = 8) -> None:
        if tries < 1:
            raise InvalidParameterError(f"tries: expected an integer >= 1, got {tries}")
        self.proposer, self.land, self.tries = proposer, land, tries
        #: Hops simulated for answers so far.
        self.simulator_calls = 0

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4); each costs ``tries`` simulator calls."""
        targets = targets_of(observation)
        proposed = self.proposer.propose(targets, self.tries)  # (n, tries, n_actuators)
        landings = np.asarray(self.land(proposed.reshape(-1, proposed.shape[2]))).reshape(*proposed.shape[:2], 2)
        self.simulator_calls += proposed.shape[0] * proposed.shape[1]
        error = np.linalg.norm(landings - targets[:, None], axis=2)
        best = np.where(np.isfinite(error), error, np.inf).argmin(axis=1)
        chosen = proposed[np.arange(len(targets)), best]
        return (chosen[0] if np.ndim(observation) == 1 else chosen), state
