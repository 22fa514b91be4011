"""A lattice as it would be built and set up: no two members quite alike, no mass quite where it should be."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tensegrity_gym.design import Design
from tensegrity_gym.formfinding import Equilibria
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.types import Structure

#: Standard deviation of a coordinate that nobody can know [m].
POSITION = 1e-5
#: Masses lower than this lie on the ground, and stay there [m].
LYING = 1e-3


def moved_start(found: Equilibria, seed: int = 0, size: float = POSITION) -> Equilibria:
    """The equilibria with each coordinate of the masses above the ground moved by a normal ``size`` [m]."""
    noise = np.random.default_rng(seed).normal(0.0, size, found.positions.shape)
    return replace(found, positions=found.positions + noise * (found.positions[:, :, 2:] > LYING))


@dataclass(frozen=True)
class Specimen(Design):
    """A design whose members differ: every stiffness is its own, with a normal scatter.

    Dampings scatter with the stiffnesses they belong to, so that loss factors stay.
    """

    scatter: float = 1e-3
    """Standard deviation of a member's stiffness over its mean [-]."""
    seed: int = 1
    """Which specimen, from 1 on."""

    def structure(self, lattice: Lattice) -> Structure:
        """One specimen of ``lattice``."""
        rng, nominal, changed = np.random.default_rng(self.seed), super().structure(lattice), {}
        for name in ("cable_stiffness", "segment_stiffness", "hinge_stiffness"):
            factor = 1.0 + self.scatter * rng.standard_normal(len(getattr(nominal, name)))
            other = name.replace("stiffness", "damping")
            changed[name] = getattr(nominal, name) * factor
            changed[other] = getattr(nominal, other) * factor
        factor = 1.0 + self.scatter * rng.standard_normal(len(nominal.actuator_rigidity))
        return nominal._replace(**changed, actuator_rigidity=nominal.actuator_rigidity * factor)

    @classmethod
    def of(cls, design: Design, seed: int, scatter: float = 1e-3) -> Specimen:
        """The specimen number ``seed`` of ``design``."""
        return cls(**{name: getattr(design, name) for name in Design.__dataclass_fields__}, scatter=scatter, seed=seed)
