"""Dynamic relaxation, for any force function: fictitious masses swing to rest under viscous or kinetic damping.

Viscous: central differences with a damping near critical for the slowest mode present, whose frequency the Rayleigh quotient
of the velocities tells. Kinetic: undamped, and every mass is stopped whenever the kinetic energy has passed a peak.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.jit import jit


class RelaxationSettings(NamedTuple):
    """Damping and end of a relaxation; time is counted in steps."""

    tolerance: float  #: residual force at which the relaxation ends [N]
    max_iterations: int  #: steps
    kinetic: bool  #: kinetic instead of viscous damping
    softest: float  #: viscous: never damp as for a slower mode than this [rad/step]
    longest_step: float  #: no coordinate moves further in one step [m]


class RelaxationWork(NamedTuple):
    """Scratch of one relaxation."""

    f: np.ndarray  #: forces, shape (n, k)
    old: np.ndarray  #: forces one step before, shape (n, k)
    v: np.ndarray  #: velocities [m/step], shape (n, k)


@jit
def relax(forces, problem, mass, x, work, settings):
    """Bring x to rest in place; ``forces(problem, x, f)`` fills f and returns its norm.

    ``mass`` [N step^2/m], shape (n,): at least a quarter of the row sum of the tangent stiffness. Returns (residual, steps).
    """
    v, f, old = work.v, work.f, work.old
    for i in range(x.shape[0]):
        for c in range(x.shape[1]):
            v[i, c] = 0.0
    residual = forces(problem, x, f)
    kinetic_before, frequency = 0.0, 0.0
    share = 0.5  # from rest, a velocity at half a step takes half a step's push: a whole one may overshoot and run away
    iterations = 0
    while iterations < settings.max_iterations and not residual <= settings.tolerance and residual < 1e300:
        drag = 0.0 if settings.kinetic else min(frequency, 1.0)
        kinetic = 0.0
        for i in range(x.shape[0]):
            for c in range(x.shape[1]):
                speed = ((1.0 - drag) * v[i, c] + share * f[i, c] / mass[i]) / (1.0 + drag)
                speed = min(max(speed, -settings.longest_step), settings.longest_step)
                v[i, c] = speed
                kinetic += mass[i] * speed * speed
                x[i, c] += speed
                old[i, c] = f[i, c]
        residual = forces(problem, x, f)
        iterations += 1
        share = 1.0
        if settings.kinetic:
            if kinetic < kinetic_before:
                for i in range(x.shape[0]):
                    for c in range(x.shape[1]):
                        v[i, c] = 0.0
                kinetic = 0.0
                share = 0.5
            kinetic_before = kinetic
        else:
            work_done = 0.0
            for i in range(x.shape[0]):
                for c in range(x.shape[1]):
                    work_done += v[i, c] * (old[i, c] - f[i, c])
            frequency = settings.softest
            if kinetic > 0.0 and work_done > 0.0:
                frequency = max(settings.softest, (work_done / kinetic) ** 0.5)
    return residual, iterations
