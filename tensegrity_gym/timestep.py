"""The largest stable time step of a design, from its tangent stiffness and damping."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from tensegrity_gym.design import Design
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.types import Floats, Structure

if TYPE_CHECKING:  # SciPy takes longer to import than the rest of this package: functions import it when called
    from scipy.sparse import csr_matrix

#: Default step over the critical one.
MARGIN = 0.8


def spring_matrix(structure: Structure, positions: Floats, weights: tuple[Floats, Floats, Floats]) -> csr_matrix:
    """sum of w n n^T over cables, actuated cables and bar segments, mass-normalised, shape (3 n_masses, 3 n_masses).

    ``weights`` are the stiffnesses [N/m] or dampings [N s/m] of the three classes; all members count as taut.
    """
    from scipy.sparse import csr_matrix

    n = len(structure.mass)
    segments = np.stack([structure.bars[:, :-1], structure.bars[:, 1:]], axis=-1)
    pairs = np.concatenate([structure.cables, structure.actuators, segments.reshape(-1, 2)])
    weight = np.concatenate([weights[0], weights[1], np.repeat(weights[2], segments.shape[1])])
    axis = positions[pairs[:, 1]] - positions[pairs[:, 0]]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(pairs)), 6)
    columns = (3 * pairs[:, :, None] + np.arange(3)).reshape(-1)
    scale = np.sqrt(weight)[:, None] * axis
    values = np.stack([-scale, scale], axis=1) / np.sqrt(structure.mass[pairs])[:, :, None]
    strain = csr_matrix((values.reshape(-1), (rows, columns)), shape=(len(pairs), 3 * n))
    return (strain.T @ strain).tocsr()


def critical_time_step(structure: Structure, positions: Floats) -> float:
    """Largest dt [s] at which symplectic Euler with lagged damping is stable in the given posture, every member taut.

    The condition is that dt^2/4 K + dt/2 C has no eigenvalue (over the masses) above one; for a single mode it reads
    dt < 2/omega (sqrt(1 + zeta^2) - zeta). Bars' axial modes set it; bending and geometric stiffness are 1e-3 of theirs.
    """
    from scipy.optimize import brentq
    from scipy.sparse.linalg import eigsh

    actuator_stiffness = structure.actuator_rigidity / structure.actuator_length
    stiffness = spring_matrix(structure, positions, (structure.cable_stiffness, actuator_stiffness, structure.segment_stiffness))
    dampings = (structure.cable_damping, structure.actuator_damping * actuator_stiffness, structure.segment_damping)
    damping = spring_matrix(structure, positions, dampings)
    start = np.random.default_rng(0).normal(size=stiffness.shape[0])

    def largest(matrix: csr_matrix) -> float:
        return float(eigsh(matrix, k=1, which="LA", v0=start, tol=1e-6, return_eigenvectors=False)[0])

    undamped = 2.0 / np.sqrt(largest(stiffness))

    def excess(dt: float) -> float:
        return largest(dt**2 / 4 * stiffness + dt / 2 * damping) - 1.0

    return float(brentq(excess, 1e-4 * undamped, undamped * (1 + 1e-5), rtol=1e-6))


def round_down(value: float, digits: int = 3) -> float:
    """``value`` > 0 cut to ``digits`` significant digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - digits + 1)
    return float(f"{math.floor(value / unit * (1 + 1e-12)) * unit:.{digits}g}")


@lru_cache(maxsize=64)
def default_time_step(design: Design, lattice: Lattice) -> float:
    """MARGIN times the critical step of the unloaded lattice [s].

    Cut to three digits, so that the eigenvalue solver's last digits, which differ between machines, move no landing.
    """
    structure = design.structure(lattice)
    return round_down(MARGIN * critical_time_step(structure, design.unloaded_positions(lattice)))
