"""From targets to stretches. Every planner has stable-baselines3's ``predict`` signature, so that one scorer fits all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from surrogate.generate import sample_stretches
from surrogate.model import one_thread
from tensegrity_gym import STRETCH_RANGE
from tensegrity_gym.errors import InvalidParameterError

Prediction = tuple[np.ndarray, Any]


class Planner(Protocol):
    """Anything that answers observations with stretches: the planners here, and policies."""

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Observations whose first two numbers are the target [m], (2,) or (n, 2), to stretches (4,) or (n, 4)."""
        ...


def targets_of(observation: np.ndarray) -> np.ndarray:
    """The targets in one observation or a batch of them, shape (n, 2) [m]; InvalidParameterError if they are none."""
    targets = np.atleast_2d(np.asarray(observation, dtype=np.float64))
    if targets.ndim != 2 or targets.shape[1] < 2 or not np.isfinite(targets).all():
        raise InvalidParameterError(f"observation: expected finite targets (2,) or (n, 2) [m], got {observation!r}")
    return targets[:, :2]


class NearestHopPlanner:
    """Repeat the stored hop that landed nearest to the target: the baseline that every other planner must beat."""

    def __init__(self, stretches: np.ndarray, landings: np.ndarray) -> None:
        if len(stretches) == 0 or len(stretches) != len(landings):
            raise InvalidParameterError(
                f"expected as many stretches as landings, at least one, got {len(stretches)} and {len(landings)}"
            )
        self.stretches = np.asarray(stretches, dtype=np.float64)
        self.landings = np.asarray(landings, dtype=np.float64)

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4)."""
        distance = np.linalg.norm(targets_of(observation)[:, None] - self.landings, axis=2)
        chosen = self.stretches[distance.argmin(axis=1)]
        return (chosen[0] if np.ndim(observation) == 1 else chosen), state


@dataclass(frozen=True)
class InverseConfig:
    """Multi-start gradient descent through the surrogate."""

    pool: int = 4096
    """Spread-out stretches that the starts are chosen from."""
    starts: int = 8
    """Descents per target."""
    steps: int = 120
    """Adam steps per descent."""
    lr: float = 0.02
    """Adam's learning rate at the first step, in stretches; it falls to zero along a cosine."""


class InversePlanner:
    """Find the stretches whose expected squared landing error is least.

    Expected are the error of the members' mean, their spread and, with a ``correction``, the variance that distance from
    the stored hops brings: among equals it takes the stretches that it is surest of. Descent is on the stretches
    themselves, put back into the box after every step, so that answers on its boundary are reached (a sigmoid would stall
    there).

    Args:
        landing: stretches, shape (n, n_actuators), to landings as each member sees them, shape (members, n, 2) [m].
        correction: stretches to a shift of the landing, shape (n, 2) [m], and a variance, shape (n,) [m^2].
        stored: stretches to start from besides the spread-out ones, shape (m, n_actuators).
    """

    def __init__(
        self,
        landing: Callable[[Tensor], Tensor],
        config: InverseConfig | None = None,
        *,
        correction: Callable[[Tensor], tuple[Tensor, Tensor]] | None = None,
        stored: np.ndarray | None = None,
        n_actuators: int = 4,
        seed: int = 0,
    ) -> None:
        self.landing, self.correction = landing, correction
        self.config = config or InverseConfig()
        pool = sample_stretches(self.config.pool, seed, n_actuators)
        self.pool = torch.from_numpy((pool if stored is None else np.concatenate([pool, stored])).astype(np.float32))
        with torch.no_grad():
            self.pool_seen = self._see(self.pool)

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4); unreachable ones get the nearest landing it knows."""
        stretches, _ = self.plan(targets_of(observation))
        return (stretches[0] if np.ndim(observation) == 1 else stretches), state

    @one_thread()
    def plan(self, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Targets (n, 2) [m] to stretches (n, n_actuators) and the expected landing error (rms) of each, (n,) [m]."""
        goal = torch.from_numpy(np.asarray(targets, dtype=np.float32))[:, None]  # (n, 1, 2)
        with torch.no_grad():
            landings, variance = self.pool_seen
            cost = expected_square(landings[:, None], variance, goal)  # (n, pool)
            first = cost.topk(min(self.config.starts, len(self.pool)), largest=False).indices
        stretches = self._descend(self.pool[first], goal)
        with torch.no_grad():
            cost = self._cost(stretches, goal)
            best = cost.argmin(dim=1)
        rows = torch.arange(len(best))
        # float32 cannot hold 0.2 and 0.8: cut the overshoot off
        chosen = np.clip(stretches[rows, best].numpy().astype(np.float64), *STRETCH_RANGE)
        return chosen, np.sqrt(cost[rows, best].numpy())

    def _descend(self, start: Tensor, goal: Tensor) -> Tensor:
        stretches = start.clone().requires_grad_(True)
        optimiser = torch.optim.Adam([stretches], lr=self.config.lr, betas=(0.9, 0.99))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, self.config.steps)
        for _ in range(self.config.steps):
            cost = self._cost(stretches, goal).sum()
            (stretches.grad,) = torch.autograd.grad(cost, [stretches])
            optimiser.step()
            schedule.step()
            with torch.no_grad():
                stretches.clamp_(*STRETCH_RANGE)
        return stretches.detach()

    def _see(self, stretches: Tensor) -> tuple[Tensor, Tensor]:
        """Landings (members, n, 2) [m] and variance (n,) [m^2] at stretches (n, n_actuators)."""
        landings = self.landing(stretches)
        if self.correction is None:
            return landings, torch.zeros(len(stretches))
        shift, variance = self.correction(stretches)
        return landings + shift, variance

    def _cost(self, stretches: Tensor, goal: Tensor) -> Tensor:
        """Expected squared error [m^2] of stretches (n, starts, n_actuators), shape (n, starts)."""
        batch = stretches.shape[:2]
        landings, variance = self._see(stretches.reshape(-1, stretches.shape[-1]))
        return expected_square(landings.reshape(-1, *batch, 2), variance.reshape(batch), goal)


def expected_square(landings: Tensor, variance: Tensor, goal: Tensor) -> Tensor:
    """Mean over members (first axis) of the squared distance to ``goal``, and ``variance`` in both directions [m^2]."""
    return ((landings - goal) ** 2).sum(dim=-1).mean(dim=0) + 2 * variance
