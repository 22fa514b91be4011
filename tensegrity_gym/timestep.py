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


def hinge_matrix(structure: Structure, positions: Floats, weight: Floats) -> csr_matrix:
    """Second derivative of the hinges' energy at zero angle, mass-normalised, shape (3 n_masses, 3 n_masses).

    The angle's vector at mass j is P (u_j - u_(j-1)), P across the bar's axis there: ``weight`` [N m/rad or N m s/rad] per
    bar on its square.
    """
    from scipy.sparse import csr_matrix

    bars = structure.bars
    n, hinges = len(structure.mass), bars.shape[1] - 2
    if hinges < 1:
        return csr_matrix((3 * n, 3 * n))
    triples = np.stack([bars[:, :-2], bars[:, 1:-1], bars[:, 2:]], axis=-1).reshape(-1, 3)
    near = positions[triples[:, 1]] - positions[triples[:, 0]]
    far = positions[triples[:, 2]] - positions[triples[:, 1]]
    lengths = np.linalg.norm(near, axis=1), np.linalg.norm(far, axis=1)
    axis = near / lengths[0][:, None] + far / lengths[1][:, None]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    shares = np.stack([1 / lengths[0], -1 / lengths[0] - 1 / lengths[1], 1 / lengths[1]], axis=1)
    shares /= np.sqrt(structure.mass[triples])
    scale = np.sqrt(np.repeat(weight, hinges))
    values = scale[:, None, None, None] * across[:, :, None, :] * shares[:, None, :, None]  # hinge, row, mass, column
    rows = np.repeat(np.arange(3 * len(triples)), 9)
    columns = np.broadcast_to((3 * triples[:, None, :, None] + np.arange(3)), values.shape)
    bend = csr_matrix((values.reshape(-1), (rows, columns.reshape(-1))), shape=(3 * len(triples), 3 * n))
    return (bend.T @ bend).tocsr()


def critical_time_step(structure: Structure, positions: Floats) -> float:
    """Largest dt [s] at which symplectic Euler with lagged damping is stable in the given posture, every member taut.

    The condition is that dt^2/4 K + dt/2 C has no eigenvalue (over the masses) above one; for a single mode it reads
    dt < 2/omega (sqrt(1 + zeta^2) - zeta). Bars' axial modes set it in the paper's model; hinges count too, as they set it in
    softened or finely divided bars. Geometric stiffness, of the order of strains, is left out.
    """
    from scipy.optimize import brentq
    from scipy.sparse.linalg import eigsh

    actuator_stiffness = structure.actuator_rigidity / structure.actuator_length
    stiffness = spring_matrix(structure, positions, (structure.cable_stiffness, actuator_stiffness, structure.segment_stiffness))
    stiffness += hinge_matrix(structure, positions, structure.hinge_stiffness)
    dampings = (structure.cable_damping, structure.actuator_damping * actuator_stiffness, structure.segment_damping)
    damping = spring_matrix(structure, positions, dampings) + hinge_matrix(structure, positions, structure.hinge_damping)
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
def default_time_step(design: Design, lattice: Lattice, share: float = MARGIN) -> float:
    """``share`` times the critical step of the unloaded lattice [s].

    Cut to three digits, so that the eigenvalue solver's last digits, which differ between machines, move no landing.
    """
    structure = design.structure(lattice)
    return round_down(share * critical_time_step(structure, design.unloaded_positions(lattice)))
