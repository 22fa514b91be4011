"""Equilibria beyond float64: Newton's last steps with residuals in extended precision, written down independently in NumPy."""

from __future__ import annotations

import numpy as np

from tensegrity_gym import Design, Equilibria, Lattice, Scene
from tensegrity_gym.elimination import lattice_pattern
from tensegrity_gym.formfinding import imperfection_forces
from tensegrity_gym.stability import rigid_motions, tangent_matrix
from tensegrity_gym.types import Structure

#: 64 bits of mantissa on x86; where long double is float64 the reference is no better than what it judges.
Extended = np.longdouble


def forces(structure: Structure, lengths: np.ndarray, loads: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Forces of springs, hinges and dead loads [N] at x (n_masses, 3), all in extended precision."""
    f = loads.astype(Extended)
    pairs = np.concatenate([structure.cables, structure.actuators])
    stiffness = np.concatenate([structure.cable_stiffness.astype(Extended), structure.actuator_rigidity / lengths])
    natural = np.concatenate([structure.cable_length.astype(Extended), lengths])
    along = x[pairs[:, 1]] - x[pairs[:, 0]]
    length = np.sqrt((along**2).sum(axis=1))
    pull = (np.maximum(length - natural, 0) * stiffness / length)[:, None] * along
    np.add.at(f, pairs[:, 0], pull)
    np.add.at(f, pairs[:, 1], -pull)
    along = np.diff(x[structure.bars], axis=1)
    length = np.sqrt((along**2).sum(axis=2, keepdims=True))
    unit = along / length
    pull = structure.segment_stiffness.astype(Extended)[:, None, None] * (length - structure.segment_length[:, None, None]) * unit
    before, after = unit[:, :-1], unit[:, 1:]
    half = np.sqrt(((before - after) ** 2).sum(axis=2, keepdims=True)) / 2
    angle = 2 * np.arcsin(half)
    sine = 2 * half * np.sqrt(1 - half**2)
    # U = kappa theta^2 / 2, dU/d(u . v) = -kappa theta / sin theta, du/dx = (I - u u^T) / l
    factor = structure.hinge_stiffness.astype(Extended)[:, None, None] * np.where(
        sine > 0, angle / np.where(sine > 0, sine, 1), 1
    )
    cosine = (before * after).sum(axis=2, keepdims=True)
    pull[:, :-1] -= factor * (after - cosine * before) / length[:, :-1]
    pull[:, 1:] -= factor * (before - cosine * after) / length[:, 1:]
    for k in range(along.shape[1]):
        np.add.at(f, structure.bars[:, k], pull[:, k])
        np.add.at(f, structure.bars[:, k + 1], -pull[:, k])
    return f


def refined(found: Equilibria, lattice: Lattice, design: Design, scene: Scene, steps: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, n_masses, 3) [m] of the same equilibria in extended precision and their residuals (n,) [N].

    Newton with a tangent of float64 and residuals of 64 bits converges to the residuals' rounding; what the ground holds stays.
    """
    structure, pattern = design.structure(lattice), lattice_pattern(lattice, int(design.bar_segments))
    loads = imperfection_forces(design, structure) + structure.mass[:, None] * scene.gravity_vector
    positions = found.positions.astype(Extended)
    residuals = np.zeros(len(positions))
    for row, x in enumerate(positions):
        lengths = found.stretches[row] * structure.actuator_length
        free = np.ones(x.shape, dtype=bool)
        free[:, 2] = found.contact_force[row] == 0.0
        free = free.ravel()
        tangent = tangent_matrix(structure, pattern, lengths, found.positions[row]).toarray()[np.ix_(free, free)]
        rigid, _ = np.linalg.qr(rigid_motions(found.positions[row])[free])
        inverse = np.linalg.inv(tangent + tangent.diagonal().max() * rigid @ rigid.T)
        for _ in range(steps):
            f = forces(structure, lengths.astype(Extended), loads, x)
            x.ravel()[free] += inverse @ f.ravel()[free].astype(np.float64)
        f = forces(structure, lengths.astype(Extended), loads, x).ravel() * free
        residuals[row] = np.sqrt((f.reshape(-1, 3) ** 2).sum(axis=1)).max()
    return positions, residuals
