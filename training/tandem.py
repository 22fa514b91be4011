"""A tandem network: the inverse learned once and for all, through the surrogate, so that an answer is one pass of a net.

Targets have many answers, and a net that regressed stretches on targets would average them. Trained through the frozen
surrogate it needs only find one: the loss is the landing error that the surrogate expects of its answer (Liu et al. 2018).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from surrogate.model import one_thread
from tensegrity_gym import STRETCH_RANGE
from training.planner import Prediction, targets_of

#: Training targets are landings stretched by up to this: beyond the reachable region the net must answer too.
FARTHEST = 1.5


@dataclass(frozen=True)
class TandemConfig:
    """Training of the inverse net."""

    hidden: tuple[int, ...] = (64, 64)
    """Widths of its hidden layers."""
    steps: int = 1500
    """Adam steps."""
    batch: int = 256
    """Targets per step."""
    lr: float = 1e-2
    """Adam's learning rate at the first step; it falls to zero along a cosine."""
    seed: int = 0
    """Seed of weights and targets."""


class TandemPlanner:
    """Targets through an MLP to stretches.

    Args:
        see: stretches (n, n_actuators) to the mean landing (n, 2) [m] and its variance (n,) [m^2], differentiable; where
            scenes vary, also of scene values (n, k).
        landings: where hops are known to land, shape (m, 2) [m]; training targets are drawn around them.
        permutations: symmetries of the map, f(s[p]) = sign * f(s), shape (g, n_actuators); the identity first.
        signs: shape (g, 2).
        scene_values: how many scene values follow a target in observations, each from -1 to 1.
    """

    def __init__(
        self,
        see: Callable[..., tuple[Tensor, Tensor]],
        landings: np.ndarray,
        config: TandemConfig | None = None,
        *,
        permutations: np.ndarray | None = None,
        signs: np.ndarray | None = None,
        n_actuators: int = 4,
        scene_values: int = 0,
    ) -> None:
        config = config or TandemConfig()
        self.scene_values = scene_values
        self.permutations = np.arange(n_actuators)[None] if permutations is None else np.asarray(permutations)
        self.signs = np.ones((1, 2)) if signs is None else np.asarray(signs)
        landings = np.asarray(landings, dtype=np.float64)
        self.scale = float(np.quantile(np.linalg.norm(landings, axis=1), 0.95)) or 1.0
        torch.manual_seed(config.seed)
        widths = (2 + scene_values, *config.hidden, n_actuators)
        layers: list[nn.Module] = []
        for k in range(len(widths) - 1):
            layers += [nn.Linear(widths[k], widths[k + 1]), nn.SiLU()]
        self.net = nn.Sequential(*layers[:-1])
        self._train(see, landings, config)

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m], scene values after them, to stretches (4,) or (n, 4)."""
        targets, which = self._folded(targets_of(observation))
        values = np.atleast_2d(np.asarray(observation))[:, 2 : 2 + self.scene_values]
        with torch.no_grad():
            folded = self._stretches(*_tensors(targets, values)).numpy().astype(np.float64)
        chosen = np.clip(np.take_along_axis(folded, self.permutations[which], axis=1), *STRETCH_RANGE)
        return (chosen[0] if np.ndim(observation) == 1 else chosen), state

    def _folded(self, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The image of each target with the largest x, then y, and by which symmetry it got there."""
        images = targets[:, None] * self.signs
        which = (images @ np.array([1.0, 1e-3])).argmax(axis=1)
        return images[np.arange(len(targets)), which], which

    def _stretches(self, targets: Tensor, scene: Tensor) -> Tensor:
        low, high = STRETCH_RANGE
        inputs = torch.cat([targets / self.scale, scene], dim=1)
        return (low + high) / 2 + (high - low) / 2 * torch.tanh(self.net(inputs))

    @one_thread()
    def _train(self, see: Callable[..., tuple[Tensor, Tensor]], landings: np.ndarray, config: TandemConfig) -> None:
        rng = np.random.default_rng(config.seed)
        optimiser = torch.optim.Adam(self.net.parameters(), lr=config.lr)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps)
        for _ in range(config.steps):
            drawn = landings[rng.integers(len(landings), size=config.batch)] * rng.uniform(0.5, FARTHEST, (config.batch, 1))
            drawn += rng.normal(0, 0.05 * self.scale, drawn.shape)
            scenes = rng.uniform(-1, 1, (config.batch, self.scene_values))
            targets, scene = _tensors(self._folded(drawn)[0], scenes)
            stretches = self._stretches(targets, scene)
            mean, variance = see(stretches, scene) if self.scene_values else see(stretches)
            # the root, not the square: few targets beyond reach must not outweigh the many within it
            loss = torch.sqrt(((mean - targets) ** 2).sum(dim=1) + variance + 1e-10).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()


def _tensors(*arrays: np.ndarray) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(a.astype(np.float32)) for a in arrays)
