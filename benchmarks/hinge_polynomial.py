"""Regenerate the coefficients of theta / sin(theta) in ``tensegrity_gym/core/members.py`` and print their error.

Run: ``python -m benchmarks.hinge_polynomial`` (needs mpmath, which comes with torch).
"""

from __future__ import annotations

import mpmath as mp


def angle_over_sine(s: mp.mpf) -> mp.mpf:
    """theta / sin(theta) for s = sin^2(theta / 2), exact."""
    return mp.mpf(1) if s == 0 else mp.asin(mp.sqrt(s)) / mp.sqrt(s * (1 - s))


def coefficients(degree: int = 16, digits: int = 60) -> list[float]:
    """Monomial coefficients of the Chebyshev interpolant on [0, 1/2], rounded to double."""
    mp.mp.dps = digits
    n = degree + 1
    nodes = [mp.mpf(1) / 4 + mp.cos(mp.pi * (2 * k + 1) / (2 * n)) / 4 for k in range(n)]
    vandermonde = mp.matrix(n, n)
    values = mp.matrix(n, 1)
    for i, s in enumerate(nodes):
        values[i] = angle_over_sine(s)
        for j in range(n):
            vandermonde[i, j] = s**j
    return [float(c) for c in mp.lu_solve(vandermonde, values)]


def main() -> None:
    """Print the coefficients and the largest relative error on [0, 1/2]."""
    found = coefficients()
    grid = mp.linspace(0, mp.mpf(1) / 2, 501)
    error = max(abs(mp.polyval(found[::-1], s) / angle_over_sine(s) - 1) for s in grid)
    print(f"largest relative error {mp.nstr(error, 3)}")
    print("\n".join(repr(c) for c in found))


if __name__ == "__main__":
    main()
