"""Nonlinear conjugate gradients as the paper uses them, for any smooth energy.

Polak-Ribiere directions, beta clipped so that the slope stays sufficiently negative; the line search brackets a minimum by
three points with E1 < E0 and E1 < E2 and closes in by the minimum of the parabola through them, which replaces one of the
three (four cases: left or right of the middle point, lower or higher).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.jit import jit


class DescentSettings(NamedTuple):
    """When the search and each of its line searches end."""

    tolerance: float  #: largest component group of the forces at which the search ends [N]
    max_iterations: int  #: directions
    line_tolerance: float  #: change of the best step, over it, at which a line search ends [-]; 1 takes the first parabola
    line_cap: int  #: parabolas per line search
    longest_step: float  #: no coordinate moves further in one step [m]
    sufficient: float  #: least share of |g|^2 that the slope keeps along a direction [-]


class DescentWork(NamedTuple):
    """Scratch of one search."""

    f: np.ndarray  #: forces, shape (n, k)
    old: np.ndarray  #: forces one direction before, shape (n, k)
    d: np.ndarray  #: direction, shape (n, k)
    trial: np.ndarray  #: positions tried, shape (n, k)


@jit(forceinline=False)
def inner(a, b):
    """Sum of products of two (n, k) arrays."""
    total = 0.0
    for i in range(a.shape[0]):
        for c in range(a.shape[1]):
            total += a[i, c] * b[i, c]
    return total


@jit
def _energy_at(energy, problem, x, work, step):
    for i in range(x.shape[0]):
        for c in range(x.shape[1]):
            work.trial[i, c] = x[i, c] + step * work.d[i, c]
    return energy(problem, work.trial)


@jit
def parabola_minimum(a, ea, b, eb, c, ec):
    """Abscissa of the minimum of the parabola through three points with a < b < c, eb < ea, eb < ec."""
    left, right = (b - a) * (eb - ec), (b - c) * (eb - ea)
    below = left - right
    if below == 0.0:
        return b
    return b - 0.5 * ((b - a) * left - (b - c) * right) / below


@jit
def line_search(energy, problem, x, work, e0, first, longest, settings):
    """Step along work.d that minimises the energy to ``line_tolerance``, or 0 where it does not fall; and its evaluations."""
    a, ea, b = 0.0, e0, min(first, longest)
    eb = _energy_at(energy, problem, x, work, b)
    calls = 1
    c, ec = b, eb
    if eb < ea:
        while calls < 60:
            if c >= longest:
                return b, eb, calls
            c = min(2.0 * c, longest)
            ec = _energy_at(energy, problem, x, work, c)
            calls += 1
            if not ec < eb:
                break
            a, ea, b, eb = b, eb, c, ec
    else:
        while not eb < ea:
            c, ec = b, eb
            b *= 0.25
            if calls > 30:
                return 0.0, e0, calls
            eb = _energy_at(energy, problem, x, work, b)
            calls += 1
    for _ in range(settings.line_cap):
        t = parabola_minimum(a, ea, b, eb, c, ec)
        if not (a < t < c) or abs(t - b) <= 1e-12 * c:
            break
        et = _energy_at(energy, problem, x, work, t)
        calls += 1
        moved = abs(t - b)
        if et < eb:
            if t < b:
                c, ec = b, eb
            else:
                a, ea = b, eb
            b, eb = t, et
        elif t < b:
            a, ea = t, et
        else:
            c, ec = t, et
        if moved <= settings.line_tolerance * b:
            break
    return b, eb, calls


@jit
def conjugate_gradient(energy, forces, problem, x, work, settings):
    """Minimise ``energy(problem, x)`` from x, in place; ``forces(problem, x, f)`` fills f = -gradient and returns its norm.

    Returns (residual, directions, energy evaluations). Ends at the tolerance, at the cap, or where steepest descent finds no
    lower energy: then the energy's rounding hides the slope.
    """
    residual = forces(problem, x, work.f)
    e = energy(problem, x)
    calls, step, size = 1, 0.0, 1.0
    steepest = True
    iterations = 0
    for i in range(x.shape[0]):
        for c in range(x.shape[1]):
            work.d[i, c] = work.f[i, c]
    while iterations < settings.max_iterations and not residual <= settings.tolerance:
        longest = 0.0
        for i in range(x.shape[0]):
            for c in range(x.shape[1]):
                longest = max(longest, abs(work.d[i, c]))
        if not 0.0 < longest < 1e300:
            break
        cap = settings.longest_step / longest
        slope = inner(work.f, work.d)
        guess = step * size / slope if step > 0.0 else 1e-3 * cap
        step, e, used = line_search(energy, problem, x, work, e, guess, cap, settings)
        calls += used
        iterations += 1
        if step == 0.0:
            if steepest:
                break
            steepest = True
            for i in range(x.shape[0]):
                for c in range(x.shape[1]):
                    work.d[i, c] = work.f[i, c]
            continue
        size = slope
        for i in range(x.shape[0]):
            for c in range(x.shape[1]):
                x[i, c] += step * work.d[i, c]
                work.old[i, c] = work.f[i, c]
        residual = forces(problem, x, work.f)
        square, along = inner(work.f, work.f), inner(work.f, work.d)
        beta = max(0.0, (square - inner(work.f, work.old)) / inner(work.old, work.old))
        # f . (f + beta d) >= sufficient |f|^2
        if along < 0.0:
            beta = min(beta, (settings.sufficient - 1.0) * square / along)
        steepest = beta == 0.0
        for i in range(x.shape[0]):
            for c in range(x.shape[1]):
                work.d[i, c] = work.f[i, c] + beta * work.d[i, c]
    return residual, iterations, calls
