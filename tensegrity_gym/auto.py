"""The cheapest model that holds a tolerance."""

from __future__ import annotations

from tensegrity_gym.design import Design
from tensegrity_gym.fidelity import FIDELITIES, Fidelity
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene


def choose_fidelity(design: Design, scene: Scene, lattice: Lattice, tolerance: float | None) -> Fidelity:
    return FIDELITIES["paper"]
