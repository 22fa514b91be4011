"""Dynamic relaxation, for any force function: fictitious masses swing to rest under viscous or kinetic damping.

Viscous: central differences with a damping near critical for the slowest mode present, whose frequency the Rayleigh quotient
of the velocities tells. Kinetic: undamped, and every mass is stopped whenever the kinetic energy has passed a peak. Each lane
relaxes a system of its own, with its own damping.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import fma, load, load1, select, splat, store, store1


class RelaxationSettings(NamedTuple):
    """Damping and end of a relaxation; time is counted in steps."""

    tolerance: float  #: residual force at which the relaxation ends [N]
    max_iterations: int  #: steps
    kinetic: bool  #: kinetic instead of viscous damping
    softest: float  #: viscous: never damp as for a slower mode than this [rad/step]
    longest_step: float  #: no coordinate moves further in one step [m]


class RelaxationLanes(NamedTuple):
    """Work arrays of one thread.

    Kernels take them as they are, or a single system's without their lane axis: the same numbers, an eighth of the work.
    """

    x: np.ndarray  #: positions, shape (n, k, lanes)
    f: np.ndarray  #: forces, shape (n, k, lanes)
    old: np.ndarray  #: forces one step before, shape (n, k, lanes)
    v: np.ndarray  #: velocities [m/step], shape (n, k, lanes)
    mass: np.ndarray  #: at least a quarter of the row sum of the tangent stiffness [N step^2/m], shape (n, lanes)
    scalars: np.ndarray  #: rows named below, shape (N_SCALARS, lanes)
    steps: np.ndarray  #: taken since the start, shape (lanes,)
    busy: np.ndarray  #: whether the lane relaxes anything, shape (lanes,)


RESIDUAL, KEEP, PUSH, KINETIC, KINETIC_BEFORE, WORK = 0, 1, 2, 3, 4, 5
N_SCALARS = 6


@jit(forceinline=False)
def move(settings, lanes):
    """v = KEEP v + PUSH f / m, no faster than the longest step, and x += v; sets KINETIC = v . m v."""
    keep, push = load1(lanes.scalars, KEEP), load1(lanes.scalars, PUSH)
    fastest, kinetic = splat(settings.longest_step, keep), keep * 0.0
    for i in range(lanes.x.shape[0]):
        mass = load1(lanes.mass, i)
        share = push / mass
        for c in range(lanes.x.shape[1]):
            f = load(lanes.f, i, c)
            v = fma(keep, load(lanes.v, i, c), share * f)
            v = select(v > fastest, fastest, v)
            v = select(v < -fastest, -fastest, v)
            kinetic = fma(mass * v, v, kinetic)
            store(lanes.v, i, c, v)
            store(lanes.old, i, c, f)
            store(lanes.x, i, c, load(lanes.x, i, c) + v)
    store1(lanes.scalars, KINETIC, kinetic)


@jit(forceinline=False)
def work_on_the_way(lanes):
    """Set WORK = v . (old - f): over KINETIC it is the squared frequency of the motion."""
    work = load1(lanes.scalars, WORK) * 0.0
    for i in range(lanes.x.shape[0]):
        for c in range(lanes.x.shape[1]):
            work = fma(load(lanes.v, i, c), load(lanes.old, i, c) - load(lanes.f, i, c), work)
    store1(lanes.scalars, WORK, work)


@jit(forceinline=False)
def start(lanes, lane):
    """Put a lane at rest where it stands; without velocities and forces its first step goes nowhere."""
    for i in range(lanes.x.shape[0]):
        for c in range(lanes.x.shape[1]):
            lanes.v[i, c, lane] = 0.0
            lanes.f[i, c, lane] = 0.0
    for row in range(N_SCALARS):
        lanes.scalars[row, lane] = 0.0
    lanes.steps[lane] = -1
    lanes.busy[lane] = True


@jit(forceinline=False)
def choose_damping(settings, lanes, lane):
    """KEEP and PUSH of a lane's next step."""
    s = lanes.scalars
    keep, push = 1.0, 1.0
    # from rest, a velocity at half a step takes half a step's push: a whole one may overshoot and run away
    if lanes.steps[lane] == 0:
        push = 0.5
    elif settings.kinetic:
        if s[KINETIC, lane] < s[KINETIC_BEFORE, lane]:
            keep, push, s[KINETIC, lane] = 0.0, 0.5, 0.0
    else:
        frequency = settings.softest
        if s[KINETIC, lane] > 0.0 and s[WORK, lane] > 0.0:
            frequency = max(frequency, (s[WORK, lane] / s[KINETIC, lane]) ** 0.5)
        drag = min(frequency, 1.0)
        keep, push = (1.0 - drag) / (1.0 + drag), 1.0 / (1.0 + drag)
    s[KINETIC_BEFORE, lane] = s[KINETIC, lane]
    s[KEEP, lane], s[PUSH, lane] = keep, push


@jit
def relax(forces, next_case, problem, queue, settings, lanes, work):
    """Bring system after system to rest in each lane; ``forces(problem, x, f)`` fills f and returns its norm.

    ``next_case(problem, queue, lane, residual, steps, evaluations)`` is called with what a lane's relaxation ended with (at
    first with nothing), and puts the next positions and masses into the lane; False where there are none.
    ``work`` is ``lanes``, or of a single lane the same memory without its axis: kernels then compute one system only.
    """
    count = lanes.steps.shape[0]
    running = 0
    for lane in range(count):
        start(lanes, lane)
        lanes.busy[lane] = next_case(problem, queue, lane, 0.0, 0, 0)
        running += 1 if lanes.busy[lane] else 0
    while running > 0:
        move(settings, work)
        store1(work.scalars, RESIDUAL, forces(problem, work.x, work.f))
        if not settings.kinetic:
            work_on_the_way(work)
        for lane in range(count):
            if not lanes.busy[lane]:
                continue
            lanes.steps[lane] += 1
            steps, residual = lanes.steps[lane], lanes.scalars[RESIDUAL, lane]
            if steps < settings.max_iterations and not residual <= settings.tolerance and residual < 1e300:
                choose_damping(settings, lanes, lane)
            elif next_case(problem, queue, lane, residual, steps, steps + 1):
                start(lanes, lane)
            else:
                start(lanes, lane)  # a lane at rest stays where it is
                lanes.busy[lane] = False
                running -= 1
