"""Elastic, kinetic and gravitational energy of a batch of lattices, by member class [J]."""

from __future__ import annotations

from tensegrity_gym.core.forces import between, dot
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import fma, load, load1, select, splat, sqrt
from tensegrity_gym.core.members import angle_squared


@jit
def bar_energy(structure, x):
    """Axial and bending energy of all bars [J]: sum of k (l - l0)^2 / 2 and kappa theta^2 / 2."""
    bars = structure.bars
    zero = load(x, 0, 0) * 0.0
    total = zero
    for b in range(bars.shape[0]):
        ux = uy = uz = zero
        for j in range(bars.shape[1] - 1):
            dx, dy, dz = between(x, bars[b, j], bars[b, j + 1])
            length = sqrt(dot(dx, dy, dz, dx, dy, dz))
            inv = 1.0 / length
            nx, ny, nz = dx * inv, dy * inv, dz * inv
            stretch = length - structure.segment_length[b]
            total = fma(0.5 * structure.segment_stiffness[b] * stretch, stretch, total)
            if j > 0:
                bx, by, bz = ux - nx, uy - ny, uz - nz
                s = 0.25 * dot(bx, by, bz, bx, by, bz)
                total = fma(0.5 * structure.hinge_stiffness[b], angle_squared(s), total)
            ux, uy, uz = nx, ny, nz
    return total


@jit
def _one_cable_energy(i, j, stiffness, natural, x):
    dx, dy, dz = between(x, i, j)
    stretch = sqrt(dot(dx, dy, dz, dx, dy, dz)) - natural
    return select(stretch > 0.0, 0.5 * stiffness * stretch * stretch, splat(0.0, stretch))


@jit
def cable_energy(structure, x):
    """Energy of the taut unactuated cables [J]."""
    total = load(x, 0, 0) * 0.0
    for k in range(structure.cables.shape[0]):
        i, j = structure.cables[k, 0], structure.cables[k, 1]
        total = total + _one_cable_energy(i, j, structure.cable_stiffness[k], structure.cable_length[k], x)
    return total


@jit
def actuator_energy(structure, actuator_length, x):
    """Energy of the taut actuated cables of natural length ``actuator_length`` [J]."""
    total = load(x, 0, 0) * 0.0
    for k in range(structure.actuators.shape[0]):
        natural = load1(actuator_length, k)
        i, j = structure.actuators[k, 0], structure.actuators[k, 1]
        total = total + _one_cable_energy(i, j, structure.actuator_rigidity[k] / natural, natural, x)
    return total


@jit
def gravitational_energy(structure, gravity, x):
    """-sum m g . x [J]; zero where the ground's origin is."""
    total = load(x, 0, 0) * 0.0
    for i in range(structure.mass.shape[0]):
        height = dot(gravity[0], gravity[1], gravity[2], load(x, i, 0), load(x, i, 1), load(x, i, 2))
        total = fma(-structure.mass[i], height, total)
    return total


@jit
def kinetic_energy(structure, v):
    """sum m |v|^2 / 2 [J]."""
    total = load(v, 0, 0) * 0.0
    for i in range(structure.mass.shape[0]):
        vx, vy, vz = load(v, i, 0), load(v, i, 1), load(v, i, 2)
        total = fma(0.5 * structure.mass[i], dot(vx, vy, vz, vx, vy, vz), total)
    return total
