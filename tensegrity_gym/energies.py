"""Energies and member forces of given states, in plain NumPy: a second opinion on the kernels and what results report."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.types import Floats, Ints, Structure


class MemberForces(NamedTuple):
    """Forces along members [N]."""

    cables: Floats  #: tension, shape (n, n_cables)
    actuators: Floats  #: tension, shape (n, n_actuators)
    bars: Floats  #: compression, mean over the segments, shape (n, n_bars)


def _lengths(positions: Floats, pairs: Ints) -> Floats:
    return np.linalg.norm(positions[:, pairs[:, 1]] - positions[:, pairs[:, 0]], axis=2)


def _segments(positions: Floats, bars: Ints) -> Floats:
    """Segment vectors, shape (n, n_bars, n_segments, 3)."""
    return np.diff(positions[:, bars], axis=2)


def _added(energies: Floats) -> Floats:
    """Sum over the members of each state, (n, ...) -> (n,): one after the other, in the same order for every n.

    ``sum`` goes by the arrays' strides, so that a batch of one would differ from a larger one in the last bit.
    """
    return np.cumsum(energies.reshape(len(energies), -1), axis=1)[:, -1] if energies.size else np.zeros(len(energies))


def hinge_angles(positions: Floats, bars: Ints) -> Floats:
    """Angles between consecutive segments [rad], shape (n, n_bars, n_segments - 1).

    A segment whose masses coincide has no direction: its angles are not numbers.
    """
    vectors = _segments(positions, bars)
    with np.errstate(invalid="ignore"):
        units = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    half = np.linalg.norm(units[:, :, 1:] - units[:, :, :-1], axis=-1) / 2
    return 2 * np.arcsin(np.clip(half, 0.0, 1.0))


def elastic_energies(structure: Structure, positions: Floats, actuator_lengths: Floats) -> dict[str, Floats]:
    """Elastic energy of "bars", "cables" and "actuators" [J], shape (n,) each.

    ``positions`` [m] has shape (n, n_masses, 3), ``actuator_lengths`` [m] shape (n, n_actuators).
    """
    segments = np.linalg.norm(_segments(positions, structure.bars), axis=-1)
    axial = 0.5 * structure.segment_stiffness[:, None] * (segments - structure.segment_length[:, None]) ** 2
    bending = 0.5 * structure.hinge_stiffness[:, None] * hinge_angles(positions, structure.bars) ** 2
    cables = np.maximum(_lengths(positions, structure.cables) - structure.cable_length, 0.0)
    actuators = np.maximum(_lengths(positions, structure.actuators) - actuator_lengths, 0.0)
    return {
        "bars": _added(axial) + _added(bending),
        "cables": _added(0.5 * structure.cable_stiffness * cables**2),
        "actuators": _added(0.5 * structure.actuator_rigidity / actuator_lengths * actuators**2),
    }


def member_forces(structure: Structure, positions: Floats, actuator_lengths: Floats) -> MemberForces:
    """Elastic member forces [N] of states of shape (n, n_masses, 3) [m]."""
    segments = np.linalg.norm(_segments(positions, structure.bars), axis=-1)
    compression = structure.segment_stiffness[:, None] * (structure.segment_length[:, None] - segments)
    cables = structure.cable_stiffness * (_lengths(positions, structure.cables) - structure.cable_length)
    actuators = structure.actuator_rigidity * (_lengths(positions, structure.actuators) / actuator_lengths - 1.0)
    return MemberForces(np.maximum(cables, 0.0), np.maximum(actuators, 0.0), compression.mean(axis=2))


def kinetic_energy(structure: Structure, velocities: Floats) -> Floats:
    """Kinetic energy [J] of velocities of shape (n, n_masses, 3) [m/s], shape (n,)."""
    return 0.5 * np.einsum("m,nmc,nmc->n", structure.mass, velocities, velocities)


def gravitational_energy(structure: Structure, gravity: Floats, positions: Floats) -> Floats:
    """-sum m g . x [J], shape (n,)."""
    return -np.einsum("m,nmc,c->n", structure.mass, positions, gravity)


def centre_of_mass(structure: Structure, states: Floats) -> Floats:
    """Mass-weighted mean over the masses of positions or velocities (..., n_masses, 3), shape (..., 3)."""
    return np.einsum("m,...mc->...c", structure.mass, states) / structure.mass.sum()
