"""Block-sparse Cholesky factorisation and solution of a batch of tangent stiffnesses, one a lane.

The symbolic work is done before, once per topology (``elimination.py``): here is only arithmetic, the same in every lane.
"""

from __future__ import annotations

from tensegrity_gym.core.blocks import load_block, multiply_transposed, subtract_block_plain
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import load, select, splat, sqrt, store


@jit
def _pivot(value, worst, floor):
    """1 / sqrt(value), and the worst pivot so far; a pivot at or below ``floor`` is replaced by one, its lane has failed."""
    worst = select(value < worst, value, worst)
    safe = select(value > floor, value, splat(1.0, value))
    return 1.0 / sqrt(safe), worst


@jit
def _factor_diagonal(h, i, worst, floor):
    """Replace a diagonal block by its Cholesky factor, diagonal stored inverted: (1/l00, l10, 1/l11, l20, l21, 1/l22)."""
    r0, worst = _pivot(load(h, i, 0), worst, floor)
    l10, l20 = load(h, i, 3) * r0, load(h, i, 6) * r0
    r1, worst = _pivot(load(h, i, 4) - l10 * l10, worst, floor)
    l21 = (load(h, i, 7) - l20 * l10) * r1
    r2, worst = _pivot(load(h, i, 8) - l20 * l20 - l21 * l21, worst, floor)
    store(h, i, 0, r0)
    store(h, i, 3, l10)
    store(h, i, 4, r1)
    store(h, i, 6, l20)
    store(h, i, 7, l21)
    store(h, i, 8, r2)
    return worst


@jit
def _divide_rows(h, slot, r0, l10, r1, l20, l21, r2):
    """h[slot] <- h[slot] L^-T with the factor L of its column's diagonal block."""
    for r in range(3):
        a = load(h, slot, 3 * r) * r0
        b = (load(h, slot, 3 * r + 1) - a * l10) * r1
        c = (load(h, slot, 3 * r + 2) - a * l20 - b * l21) * r2
        store(h, slot, 3 * r, a)
        store(h, slot, 3 * r + 1, b)
        store(h, slot, 3 * r + 2, c)


@jit
def factorise(pattern, h, floor):
    """Cholesky factor of h in place. Returns each lane's smallest pivot [N/m]; at or below ``floor`` the factor is void."""
    worst = splat(1e300, load(h, 0, 0))
    update = 0
    for k in range(pattern.order.shape[0]):
        i = pattern.order[k]
        worst = _factor_diagonal(h, i, worst, floor)
        r0, l10, r1 = load(h, i, 0), load(h, i, 3), load(h, i, 4)
        l20, l21, r2 = load(h, i, 6), load(h, i, 7), load(h, i, 8)
        for slot in range(pattern.starts[k], pattern.starts[k + 1]):
            _divide_rows(h, slot, r0, l10, r1, l20, l21, r2)
            left = load_block(h, slot)
            for other in range(pattern.starts[k], slot + 1):
                subtract_block_plain(h, pattern.targets[update], multiply_transposed(left, load_block(h, other)))
                update += 1
    return worst


@jit
def solve(pattern, h, y):
    """Solve L L^T y = y in place for y of shape (n_masses, 3[, lanes])."""
    n = pattern.order.shape[0]
    for k in range(n):
        i = pattern.order[k]
        a = load(y, i, 0) * load(h, i, 0)
        b = (load(y, i, 1) - load(h, i, 3) * a) * load(h, i, 4)
        c = (load(y, i, 2) - load(h, i, 6) * a - load(h, i, 7) * b) * load(h, i, 8)
        store(y, i, 0, a)
        store(y, i, 1, b)
        store(y, i, 2, c)
        for slot in range(pattern.starts[k], pattern.starts[k + 1]):
            row = pattern.rows[slot - n]
            for r in range(3):
                product = load(h, slot, 3 * r) * a + load(h, slot, 3 * r + 1) * b + load(h, slot, 3 * r + 2) * c
                store(y, row, r, load(y, row, r) - product)
    for k in range(n - 1, -1, -1):
        i = pattern.order[k]
        a, b, c = load(y, i, 0), load(y, i, 1), load(y, i, 2)
        for slot in range(pattern.starts[k], pattern.starts[k + 1]):
            row = pattern.rows[slot - n]
            p, q, s = load(y, row, 0), load(y, row, 1), load(y, row, 2)
            a = a - (load(h, slot, 0) * p + load(h, slot, 3) * q + load(h, slot, 6) * s)
            b = b - (load(h, slot, 1) * p + load(h, slot, 4) * q + load(h, slot, 7) * s)
            c = c - (load(h, slot, 2) * p + load(h, slot, 5) * q + load(h, slot, 8) * s)
        c = c * load(h, i, 8)
        b = (b - load(h, i, 7) * c) * load(h, i, 4)
        a = (a - load(h, i, 3) * b - load(h, i, 6) * c) * load(h, i, 0)
        store(y, i, 0, a)
        store(y, i, 1, b)
        store(y, i, 2, c)
