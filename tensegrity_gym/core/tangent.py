"""Tangent stiffness d2U/dx2 of a batch of lattices, assembled into the blocks of a ``BlockPattern``."""

from __future__ import annotations

from tensegrity_gym.core.blocks import (
    add,
    add_block,
    multiply,
    outer,
    scale,
    scaled_identity,
    subtract,
    subtract_block,
    transpose,
)
from tensegrity_gym.core.forces import between, dot
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import load, load1, select, splat, sqrt, store, store1
from tensegrity_gym.core.members import HINGE_COEFFICIENTS, angle_over_sine

_C = HINGE_COEFFICIENTS


@jit
def angle_over_sine_derivative(s):
    """d(theta / sin theta)/ds for s = sin^2(theta / 2) in [0, 1]."""
    low = select(s < 0.5, s, splat(0.5, s))
    polynomial = splat(16.0 * _C[16], s)
    for k in range(15, 0, -1):
        polynomial = polynomial * low + k * _C[k]
    high = select(s > 0.25, s, splat(0.25, s))
    high = select(high < 0.999999, high, splat(0.999999, s))
    identity = (1.0 - (1.0 - 2.0 * high) * angle_over_sine(high)) / (2.0 * high * (1.0 - high))
    return select(s < 0.5, polynomial, identity)


@jit
def spring_block(stiffness, tension, inverse, n):
    """k n n^T + (T / l) (I - n n^T): tangent of a spring of unit vector n and 1/length ``inverse`` [N/m]."""
    geometric = tension * inverse
    return add(outer(stiffness - geometric, n, n), scaled_identity(geometric))


@jit
def add_pair(h, i, j, slot, block):
    """Add a symmetric block of a member between masses i and j."""
    add_block(h, i, block)
    add_block(h, j, block)
    subtract_block(h, slot, block, False)


@jit
def cable_tangent(i, j, slot, stiffness, natural, x, h, tensions, row):
    """Add one tension-only cable; ``tensions``: see :func:`lattice_tangent`."""
    dx, dy, dz = between(x, i, j)
    length = sqrt(dot(dx, dy, dz, dx, dy, dz))
    zero = splat(0.0, length)
    taut = length > natural
    inv = 1.0 / select(taut, length, splat(1.0, length))
    if tensions is None:
        tension = select(taut, stiffness * (length - natural), zero)
    else:
        tension = select(taut, load1(tensions, row), zero)
    n = (dx * inv, dy * inv, dz * inv)
    add_pair(h, i, j, slot, spring_block(select(taut, splat(1.0, length) * stiffness, zero), tension, inv, n))


@jit
def hinge_blocks(kappa, u, inverse_u, v, inverse_v):
    """Blocks (H_aa, H_ab, H_bb) of U = kappa theta^2 / 2 over the two segment vectors a = |a| u, b = |b| v."""
    cx, cy, cz = u[0] - v[0], u[1] - v[1], u[2] - v[2]
    s = 0.25 * dot(cx, cy, cz, cx, cy, cz)
    c = 1.0 - 2.0 * s
    first = -kappa * angle_over_sine(s)  # dU/dc
    second = 0.5 * kappa * angle_over_sine_derivative(s)  # d2U/dc2
    pu = (v[0] - c * u[0], v[1] - c * u[1], v[2] - c * u[2])
    pv = (u[0] - c * v[0], u[1] - c * v[1], u[2] - c * v[2])
    zero = c * 0.0
    project_u = subtract(scaled_identity(zero + 1.0), outer(zero + 1.0, u, u))
    project_v = subtract(scaled_identity(zero + 1.0), outer(zero + 1.0, v, v))
    aa = outer(second * inverse_u * inverse_u, pu, pu)
    bb = outer(second * inverse_v * inverse_v, pv, pv)
    ab = outer(second * inverse_u * inverse_v, pu, pv)
    scale_u, scale_v = -first * inverse_u * inverse_u, -first * inverse_v * inverse_v
    skew_u, skew_v = outer(scale_u, u, pu), outer(scale_v, v, pv)
    aa = add(aa, add(add(skew_u, transpose(skew_u)), scale(scale_u * c, project_u)))
    bb = add(bb, add(add(skew_v, transpose(skew_v)), scale(scale_v * c, project_v)))
    ab = add(ab, scale(first * inverse_u * inverse_v, multiply(project_u, project_v)))
    return aa, ab, bb


@jit
def bar_tangent(structure, pattern, b, x, h, tensions):
    """Add one bar: its segments' springs and its hinges."""
    bars = structure.bars
    stiffness = structure.segment_stiffness[b]
    row = b * (bars.shape[1] - 1)
    zero = load(x, 0, 0) * 0.0
    previous = (zero, zero, zero)
    inverse_previous = zero
    for j in range(bars.shape[1] - 1):
        near, far = bars[b, j], bars[b, j + 1]
        dx, dy, dz = between(x, near, far)
        length = sqrt(dot(dx, dy, dz, dx, dy, dz))
        inv = 1.0 / length
        n = (dx * inv, dy * inv, dz * inv)
        if tensions is None:
            tension = stiffness * (length - structure.segment_length[b])
        else:
            tension = load1(tensions, row + j)
        block = spring_block(zero + stiffness, tension, inv, n)
        add_pair(h, near, far, pattern.near_slots[b, j, 0], block)
        if j > 0:
            aa, ab, bb = hinge_blocks(structure.hinge_stiffness[b], previous, inverse_previous, n, inv)
            behind = bars[b, j - 1]
            slots, far_slots = pattern.near_slots, pattern.far_slots
            # a = x_near - x_behind, b = x_far - x_near
            add_block(h, behind, aa)
            add_block(h, far, bb)
            add_block(h, near, subtract(add(aa, bb), add(ab, transpose(ab))))
            subtract_block(h, slots[b, j - 1, 0], subtract(aa, ab), slots[b, j - 1, 1] == 1)
            subtract_block(h, slots[b, j, 0], subtract(bb, ab), slots[b, j, 1] == 1)
            subtract_block(h, far_slots[b, j - 1, 0], ab, far_slots[b, j - 1, 1] == 1)
        previous = n
        inverse_previous = inv


@jit
def lattice_tangent(structure, pattern, actuator_length, x, h, tensions=None):
    """Fill h with the tangent stiffness of all members [N/m], fill slots zero.

    The geometric stiffness is made with ``tensions`` [N] of the axial members (bar segments, cables, actuated cables) where
    they are given, as a mixed Newton step needs it (see ``newton.py``); with those at x, the default, it is d2U/dx2.
    """
    zero = load(x, 0, 0) * 0.0
    for slot in range(h.shape[0]):
        for k in range(9):
            store(h, slot, k, zero)
    row = structure.bars.shape[0] * (structure.bars.shape[1] - 1)
    for k in range(structure.cables.shape[0]):
        i, j = structure.cables[k, 0], structure.cables[k, 1]
        stiffness, natural = structure.cable_stiffness[k], structure.cable_length[k]
        cable_tangent(i, j, pattern.cable_slots[k], stiffness, natural, x, h, tensions, row + k)
    row += structure.cables.shape[0]
    for k in range(structure.actuators.shape[0]):
        natural = load1(actuator_length, k)
        i, j = structure.actuators[k, 0], structure.actuators[k, 1]
        cable_tangent(i, j, pattern.actuator_slots[k], structure.actuator_rigidity[k] / natural, natural, x, h, tensions, row + k)
    for b in range(structure.bars.shape[0]):
        bar_tangent(structure, pattern, b, x, h, tensions)


@jit
def _predicted_length(i, j, x, d):
    """Length of a member after the step d as its linearisation at x has it: l + n . (d_j - d_i)."""
    dx, dy, dz = between(x, i, j)
    ex, ey, ez = between(d, i, j)
    length = sqrt(dot(dx, dy, dz, dx, dy, dz))
    positive = select(length > 0.0, length, splat(1.0, length))
    return length + dot(dx, dy, dz, ex, ey, ez) / positive


@jit
def axial_tensions(structure, actuator_length, x, d, tensions):
    """Tensions [N] of all axial members after the step d, linearised at x: with d = 0 their tensions at x."""
    segments = structure.bars.shape[1] - 1
    for b in range(structure.bars.shape[0]):
        for j in range(segments):
            length = _predicted_length(structure.bars[b, j], structure.bars[b, j + 1], x, d)
            store1(tensions, b * segments + j, structure.segment_stiffness[b] * (length - structure.segment_length[b]))
    row = structure.bars.shape[0] * segments
    for k in range(structure.cables.shape[0]):
        length = _predicted_length(structure.cables[k, 0], structure.cables[k, 1], x, d)
        stretch = length - structure.cable_length[k]
        store1(tensions, row + k, structure.cable_stiffness[k] * select(stretch > 0.0, stretch, stretch * 0.0))
    row += structure.cables.shape[0]
    for k in range(structure.actuators.shape[0]):
        natural = load1(actuator_length, k)
        length = _predicted_length(structure.actuators[k, 0], structure.actuators[k, 1], x, d)
        stretch = length - natural
        stiffness = structure.actuator_rigidity[k] / natural
        store1(tensions, row + k, stiffness * select(stretch > 0.0, stretch, stretch * 0.0))
