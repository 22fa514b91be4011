"""The tangent stiffness of one lattice, for analysis outside the kernels."""

from __future__ import annotations

from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.tangent import lattice_tangent


@jit(cache=True)
def assemble_tangent(structure, pattern, actuator_length, x, h):
    """Fill h (n_slots, 9) with d2U/dx2 [N/m] at x (n_masses, 3)."""
    lattice_tangent(structure, pattern, actuator_length, x, h)
