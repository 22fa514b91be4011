"""Policies that know the symmetries of lattice and ground: each target is turned into one part of the plane, the answer back.

Mirrored stretches land at the mirrored place (Van der Pol et al. 2020, arXiv:2006.16908, call such a policy equivariant). So a
policy need learn but one quadrant on level ground, or half the plane on a slope, and each hop teaches all the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from tensegrity_gym import Lattice
from tensegrity_gym.scene_ranges import SceneRanges


@dataclass(frozen=True)
class Symmetry:
    """A group of symmetries, the identity first: stretches[permutation] land at landing * sign."""

    permutations: tuple[tuple[int, ...], ...]
    """(g, n_actuators)"""
    signs: tuple[tuple[float, float], ...]
    """(g, 2)"""

    @classmethod
    def of(cls, scenes: SceneRanges, lattice: Lattice | None = None) -> Symmetry:
        """Those that the lattice and all of the scenes share."""
        horizontal = [corner.gravity_vector[:2] / corner.gravity for corner in scenes.corners()]
        permutations, signs = (lattice or Lattice()).symmetries_keeping(horizontal)
        return cls(tuple(map(tuple, permutations.tolist())), tuple((float(x), float(y)) for x, y in signs))

    @property
    def images(self) -> tuple[np.ndarray, np.ndarray]:
        """As arrays: permutations of stretches (g, n_actuators) and signs of landings (g, 2)."""
        return np.array(self.permutations, dtype=np.int64), np.array(self.signs)

    def fold(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Observations (n, d), target first, with the image of their target that has the greatest x, then y; and which it is.

        Shapes (n, d) and (n,); numbers change their sign alone.
        """
        images = observations[:, None, :2] * np.array(self.signs, dtype=observations.dtype)
        which = np.lexsort((-images[..., 1], -images[..., 0]), axis=1)[:, 0]
        folded = observations.copy()
        folded[:, :2] = images[np.arange(len(images)), which]
        return folded, which

    def unfold(self, stretches: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Stretches (n, n_actuators) that answer folded observations to those that answer the observations themselves."""
        return np.take_along_axis(stretches, np.array(self.permutations)[which], axis=1)


class FoldedTargets(gym.ActionWrapper):
    """An env whose policy sees the folded targets alone."""

    def __init__(self, env: gym.Env, symmetry: Symmetry) -> None:
        super().__init__(env)
        self.symmetry = symmetry
        self._which = np.zeros(1, dtype=np.int64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """As the env's, with the folded observation; info holds the target as it is."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._folded(observation), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """As the env's, of the unfolded action; the observation is folded."""
        observation, *rest = super().step(action)
        return self._folded(observation), *rest  # type: ignore[return-value]

    def action(self, action: np.ndarray) -> np.ndarray:
        """The action that answers the target as it is, shape as it came."""
        return self.symmetry.unfold(np.asarray(action)[None], self._which)[0]

    def _folded(self, observation: np.ndarray) -> np.ndarray:
        folded, self._which = self.symmetry.fold(observation[None])
        return folded[0]
