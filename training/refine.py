"""Plan, simulate the plan, correct it by what it missed: a few simulator calls an answer, each chosen by what the last one told.

Between the stored hops the map is rough, and a surrogate errs by millimetres there; close by it runs much as the slope of the
surrogate, or of the nearest stored hops, says. So the answer is corrected by least-norm steps of that slope, which itself is
corrected by every hop (Broyden's rank-one update; Nocedal and Wright 2006, eq. 11.26).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tensegrity_gym import STRETCH_RANGE
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.types import Floats
from training.planner import Land, Prediction, SlopedPlanner, targets_of

#: Longest step in one stretch: beyond it the slope says nothing.
LONGEST_STEP = 0.05
#: Length of steps, in stretches, over which landings scatter as much as they run: shorter ones hardly correct the slope.
SCATTER_STEP = 1e-3


class Refined(NamedTuple):
    """The best hops simulated for n targets."""

    stretches: np.ndarray  #: shape (n, n_actuators) [-]
    landings: np.ndarray  #: where they landed, not-a-number where none flew, shape (n, 2) [m]
    errors: np.ndarray  #: distance to the targets, infinite where none flew, shape (n,) [m]


class RefiningPlanner:
    """Answer with the best of ``tries`` hops, the first as ``start`` plans it, each other a secant step from the best so far.

    A start that can ``recall`` its answers' landings, as the nearest stored hop can, is not simulated again: all hops are then
    steps, and the start itself is among those that the best is chosen from.
    """

    def __init__(self, start: SlopedPlanner, land: Land, tries: int = 8) -> None:
        if tries < 1:
            raise InvalidParameterError(f"tries: expected an integer >= 1, got {tries}")
        self.start, self.land, self.tries = start, land, tries
        #: Hops simulated for answers so far.
        self.simulator_calls = 0

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4); each costs ``tries`` simulator calls."""
        best = self.refine(observation).stretches
        return (best[0] if np.ndim(observation) == 1 else best), state

    def refine(self, targets: np.ndarray) -> Refined:
        """As :meth:`predict`, and where the best hops for targets (n, 2) [m] landed."""
        targets = targets_of(targets)
        asked, _ = self.start.predict(targets)
        slope = self.start.slope(asked)
        best, there = asked, self._recalled(asked)
        least = _distance(there, targets)
        asked = np.where(np.isfinite(least)[:, None], _stepped(best, slope, targets - there), asked)
        for k in range(self.tries):
            landings = np.asarray(self.land(asked), dtype=np.float64)
            self.simulator_calls += len(asked)
            error = _distance(landings, targets)
            flew, known = np.isfinite(error), np.isfinite(least)
            slope = np.where((flew & known)[:, None, None], _updated(slope, asked - best, landings - there), slope)
            better = flew & (error < least)
            best, there = np.where(better[:, None], asked, best), np.where(better[:, None], landings, there)
            least = np.where(better, error, least)
            if k + 1 < self.tries:
                # after a failed hop: half the way back to the best, or to the middle of the range where there is none
                back = 0.5 * (asked + np.where(np.isfinite(least)[:, None], best, sum(STRETCH_RANGE) / 2))
                asked = np.where(flew[:, None], _stepped(best, slope, targets - there), back)
        return Refined(best, there, least)

    def _recalled(self, asked: Floats) -> Floats:
        """Where hops of ``asked`` (n, n_actuators) are known to land, not-a-number where they are not, shape (n, 2) [m]."""
        recall = getattr(self.start, "recall", None)
        return np.full((len(asked), 2), np.nan) if recall is None else np.asarray(recall(asked), dtype=np.float64)


def _distance(landings: Floats, targets: Floats) -> Floats:
    """From landings to targets (n, 2) [m], infinite where none is known, shape (n,) [m]."""
    return np.nan_to_num(np.linalg.norm(landings - targets, axis=1), nan=np.inf)


def _stepped(best: Floats, slope: Floats, wanted: Floats) -> Floats:
    """What to try next: stretches (n, n_actuators) that land ``wanted`` (n, 2) [m] from ``best``, as far as the slope says."""
    return np.clip(best + _step(best, slope, np.nan_to_num(wanted)), *STRETCH_RANGE)


def _updated(slope: Floats, moved: Floats, came: Floats) -> Floats:
    """Slopes (n, 2, n_actuators) that agree with the last move (n, n_actuators) and what came of it (n, 2) [m]."""
    missed = np.nan_to_num(came - (slope @ moved[..., None])[..., 0])
    square = (moved**2).sum(axis=1) + SCATTER_STEP**2
    return slope + missed[..., None] * moved[:, None] / square[:, None, None]


def _step(at: Floats, slope: Floats, wanted: Floats) -> Floats:
    """Least-norm steps (n, n_actuators) that move landings by ``wanted`` (n, 2) [m], where the range of stretches lets them.

    Stretches that would leave their range go to its end, and the others do the rest: a step cut off there would land elsewhere
    than the slope says, teach nothing, and be tried again.
    """
    low, high = STRETCH_RANGE
    step = _least_norm(slope, wanted)
    share = _shortening(step)
    step, wanted = step * share, wanted * share
    free, held = np.ones(at.shape, dtype=bool), np.zeros(at.shape)
    for _ in range(at.shape[1]):
        leaving = free & ((at + step < low) | (at + step > high))
        if not leaving.any():
            break
        held = np.where(leaving, np.clip(at + step, low, high) - at, held)
        free &= ~leaving
        step = held + free * _least_norm(slope * free[:, None], wanted - (slope @ held[..., None])[..., 0])
    return step * _shortening(step)


def _least_norm(slope: Floats, wanted: Floats) -> Floats:
    return (np.linalg.pinv(slope, rcond=1e-3) @ wanted[..., None])[..., 0]


def _shortening(step: Floats) -> Floats:
    """What steps are multiplied by to be no longer than ``LONGEST_STEP`` in any stretch, shape (n, 1)."""
    return np.minimum(1.0, LONGEST_STEP / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
