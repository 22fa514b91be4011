"""3x3 blocks as 9-tuples (row by row) of scalars or lanes, stored as ``h[slot, 9]`` or ``h[slot, 9, lane]``."""

from __future__ import annotations

from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import load, store


@jit
def load_block(h, slot):
    """The nine entries of a block."""
    return (
        load(h, slot, 0),
        load(h, slot, 1),
        load(h, slot, 2),
        load(h, slot, 3),
        load(h, slot, 4),
        load(h, slot, 5),
        load(h, slot, 6),
        load(h, slot, 7),
        load(h, slot, 8),
    )


@jit
def add_block(h, slot, m):
    """h[slot] += m."""
    for k in range(9):
        store(h, slot, k, load(h, slot, k) + m[k])


@jit
def subtract_block(h, slot, m, transposed):
    """h[slot] -= m, or its transpose."""
    if transposed:
        subtract_block_plain(h, slot, (m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]))
    else:
        subtract_block_plain(h, slot, m)


@jit
def subtract_block_plain(h, slot, m):
    """h[slot] -= m."""
    for k in range(9):
        store(h, slot, k, load(h, slot, k) - m[k])


@jit
def add(a, b):
    """a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5], a[6] + b[6], a[7] + b[7], a[8] + b[8])


@jit
def subtract(a, b):
    """a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] - b[3], a[4] - b[4], a[5] - b[5], a[6] - b[6], a[7] - b[7], a[8] - b[8])


@jit
def transpose(a):
    """a^T."""
    return (a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8])


@jit
def outer(scale, a, b):
    """scale * a b^T of two 3-tuples."""
    x, y, z = scale * a[0], scale * a[1], scale * a[2]
    return (x * b[0], x * b[1], x * b[2], y * b[0], y * b[1], y * b[2], z * b[0], z * b[1], z * b[2])


@jit
def scaled_identity(scale):
    """scale * I."""
    zero = scale * 0.0
    return (scale, zero, zero, zero, scale, zero, zero, zero, scale)


@jit
def scale(factor, a):
    """factor * a."""
    return (
        factor * a[0],
        factor * a[1],
        factor * a[2],
        factor * a[3],
        factor * a[4],
        factor * a[5],
        factor * a[6],
        factor * a[7],
        factor * a[8],
    )


@jit
def multiply(a, b):
    """a b."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


@jit
def multiply_transposed(a, b):
    """a b^T of two blocks."""
    return (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
        a[0] * b[3] + a[1] * b[4] + a[2] * b[5],
        a[0] * b[6] + a[1] * b[7] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[1] + a[5] * b[2],
        a[3] * b[3] + a[4] * b[4] + a[5] * b[5],
        a[3] * b[6] + a[4] * b[7] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[1] + a[8] * b[2],
        a[6] * b[3] + a[7] * b[4] + a[8] * b[5],
        a[6] * b[6] + a[7] * b[7] + a[8] * b[8],
    )
