"""Nonlinear conjugate gradients as the paper uses them, for any smooth energy, a search in each lane.

Polak-Ribiere directions, beta clipped so that the slope stays sufficiently negative; the line search brackets a minimum by
three points with E1 < E0 and E1 < E2 and closes in by the minimum of the parabola through them, which replaces one of the
three (four cases: left or right of the middle point, lower or higher).

Each lane is a state machine of its own: every energy evaluated is that of all lanes, each at the step that it tries next. A
lane at the end of its line search waits until half of them are there, since forces too are evaluated for all at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import fma, load, load1, select, store, store1


class DescentSettings(NamedTuple):
    """When the search and each of its line searches end."""

    tolerance: float  #: largest component group of the forces at which the search ends [N]
    max_iterations: int  #: directions
    line_tolerance: float  #: change of the best step, over it, at which a line search ends [-]; 1 takes the first parabola
    line_cap: int  #: parabolas per line search
    longest_step: float  #: no coordinate moves further in one step [m]
    sufficient: float  #: least share of |g|^2 that the slope keeps along a direction [-]


class DescentLanes(NamedTuple):
    """Work arrays of one thread.

    Kernels take them as they are, or a single search's without their lane axis: the same numbers, an eighth of the work.
    """

    x: np.ndarray  #: positions, shape (n, k, lanes)
    f: np.ndarray  #: forces, shape (n, k, lanes)
    old: np.ndarray  #: forces one direction before, shape (n, k, lanes)
    d: np.ndarray  #: direction, shape (n, k, lanes)
    trial: np.ndarray  #: positions tried, shape (n, k, lanes)
    scalars: np.ndarray  #: rows named below, shape (N_SCALARS, lanes)
    stage: np.ndarray  #: what the lane does, shape (lanes,)
    steepest: np.ndarray  #: whether d = f, shape (lanes,)
    tries: np.ndarray  #: energies of this line search, shape (lanes,)
    parabolas: np.ndarray  #: of this line search, shape (lanes,)
    iterations: np.ndarray  #: directions since the start, shape (lanes,)
    evaluations: np.ndarray  #: energies since the start, shape (lanes,)


# of the search: norm of the forces, energy at x, f . d now and one direction before, |f|^2, step taken last, longest step
RESIDUAL, ENERGY, SLOPE, SIZE, SQUARE, STEP, CAP = 0, 1, 2, 3, 4, 5, 6
# of the line search: three steps and their energies, the step tried and its energy
A, EA, B, EB, C, EC, T, ET = 7, 8, 9, 10, 11, 12, 13, 14
# of a turn: 1 where a lane turns, f . f, f . d, f . old, beta, longest component of d
TURNS, NEW_SQUARE, ALONG, OVERLAP, BETA, LONGEST = 15, 16, 17, 18, 19, 20
N_SCALARS = 21
#: Energies are tried up to WAIT, from which on lanes wait for forces: at the start, to move and turn, to go down the slope.
IDLE, OPEN, FIRST, GROW, SHRINK, PARABOLA, WAIT = 0, 1, 2, 3, 4, 5, 6
START, TURN, RESTART, STUCK = 6, 7, 8, 9


@jit
def parabola_minimum(a, ea, b, eb, c, ec):
    """Abscissa of the minimum of the parabola through three points with a < b < c, eb < ea, eb < ec."""
    left, right = (b - a) * (eb - ec), (b - c) * (eb - ea)
    below = left - right
    if below == 0.0:
        return b
    return b - 0.5 * ((b - a) * left - (b - c) * right) / below


# --------------------------------------------------------------------------------------------- all lanes at once
@jit(forceinline=False)
def try_step(lanes):
    """trial = x + T d."""
    t = load1(lanes.scalars, T)
    for i in range(lanes.x.shape[0]):
        for c in range(lanes.x.shape[1]):
            store(lanes.trial, i, c, fma(t, load(lanes.d, i, c), load(lanes.x, i, c)))


@jit(forceinline=False)
def take_step(lanes):
    """x += STEP d and old = f in lanes that turn after a step."""
    step = load1(lanes.scalars, STEP)
    moves = (load1(lanes.scalars, TURNS) > 0.0) & (step > 0.0)
    for i in range(lanes.x.shape[0]):
        for c in range(lanes.x.shape[1]):
            x = load(lanes.x, i, c)
            store(lanes.x, i, c, select(moves, fma(step, load(lanes.d, i, c), x), x))
            store(lanes.old, i, c, select(moves, load(lanes.f, i, c), load(lanes.old, i, c)))


@jit(forceinline=False)
def compare_forces(lanes):
    """Set NEW_SQUARE, ALONG and OVERLAP: f . f, f . d, f . old."""
    square = along = overlap = load1(lanes.scalars, RESIDUAL) * 0.0
    for i in range(lanes.x.shape[0]):
        for c in range(lanes.x.shape[1]):
            f = load(lanes.f, i, c)
            square = fma(f, f, square)
            along = fma(f, load(lanes.d, i, c), along)
            overlap = fma(f, load(lanes.old, i, c), overlap)
    store1(lanes.scalars, NEW_SQUARE, square)
    store1(lanes.scalars, ALONG, along)
    store1(lanes.scalars, OVERLAP, overlap)


@jit(forceinline=False)
def turn(lanes):
    """d = f + BETA d in lanes that turn; sets SLOPE = f . d and LONGEST."""
    turns, beta = load1(lanes.scalars, TURNS) > 0.0, load1(lanes.scalars, BETA)
    slope = longest = beta * 0.0
    for i in range(lanes.x.shape[0]):
        for c in range(lanes.x.shape[1]):
            f, d = load(lanes.f, i, c), load(lanes.d, i, c)
            d = select(turns, select(beta > 0.0, fma(beta, d, f), f), d)
            store(lanes.d, i, c, d)
            slope = fma(f, d, slope)
            size = select(d < 0.0, -d, d)
            longest = select(size > longest, size, longest)
    store1(lanes.scalars, SLOPE, slope)
    store1(lanes.scalars, LONGEST, longest)


# ---------------------------------------------------------------------------------------------------- one lane
@jit(forceinline=False)
def start(lanes, lane):
    """A lane begins where it stands."""
    for row in range(N_SCALARS):
        lanes.scalars[row, lane] = 0.0
    lanes.stage[lane] = START
    lanes.iterations[lane] = 0
    lanes.evaluations[lane] = 0


@jit(forceinline=False)
def open_line(settings, lanes, lane):
    """First step of a line search: as long as the last one, as the slopes foretell."""
    s = lanes.scalars
    s[CAP, lane] = settings.longest_step / s[LONGEST, lane]
    guess = s[STEP, lane] * s[SIZE, lane] / s[SLOPE, lane] if s[STEP, lane] > 0.0 else 1e-3 * s[CAP, lane]
    s[A, lane], s[EA, lane] = 0.0, s[ENERGY, lane]
    s[B, lane] = s[T, lane] = min(guess, s[CAP, lane])
    lanes.tries[lane] = lanes.parabolas[lane] = 0
    lanes.stage[lane] = FIRST


@jit(forceinline=False)
def close_line(lanes, lane, step):
    """End a line search at ``step``, of energy EB; 0 where the energy does not fall."""
    lanes.iterations[lane] += 1
    lanes.scalars[STEP, lane] = step
    if step > 0.0:
        lanes.scalars[ENERGY, lane] = lanes.scalars[EB, lane]
        lanes.stage[lane] = TURN
    else:
        lanes.stage[lane] = STUCK if lanes.steepest[lane] else RESTART


@jit(forceinline=False)
def grow(lanes, lane):
    """Try a step twice as long as C, or take B, the longest allowed."""
    s = lanes.scalars
    if s[C, lane] >= s[CAP, lane] or lanes.tries[lane] >= 60:
        close_line(lanes, lane, s[B, lane])
    else:
        s[C, lane] = s[T, lane] = min(2.0 * s[C, lane], s[CAP, lane])
        lanes.stage[lane] = GROW


@jit(forceinline=False)
def shrink(lanes, lane):
    """Try a quarter of B, or give up."""
    s = lanes.scalars
    s[C, lane], s[EC, lane] = s[B, lane], s[EB, lane]
    s[B, lane] = s[T, lane] = 0.25 * s[B, lane]
    lanes.stage[lane] = SHRINK
    if lanes.tries[lane] > 30:
        close_line(lanes, lane, 0.0)


@jit(forceinline=False)
def close_in(settings, lanes, lane):
    """Try the minimum of the parabola, or take B."""
    s = lanes.scalars
    a, b, c = s[A, lane], s[B, lane], s[C, lane]
    t = parabola_minimum(a, s[EA, lane], b, s[EB, lane], c, s[EC, lane])
    if lanes.parabolas[lane] >= settings.line_cap or not (a < t < c) or abs(t - b) <= 1e-12 * c:
        close_line(lanes, lane, b)
    else:
        lanes.parabolas[lane] += 1
        s[T, lane] = t
        lanes.stage[lane] = PARABOLA


@jit(forceinline=False)
def replace_one(lanes, lane):
    """The parabola's minimum replaces one of the three steps. Returns how far it lies from the best one before."""
    s = lanes.scalars
    t, et = s[T, lane], s[ET, lane]
    b, eb = s[B, lane], s[EB, lane]
    if et < eb:
        if t < b:
            s[C, lane], s[EC, lane] = b, eb
        else:
            s[A, lane], s[EA, lane] = b, eb
        s[B, lane], s[EB, lane] = t, et
    elif t < b:
        s[A, lane], s[EA, lane] = t, et
    else:
        s[C, lane], s[EC, lane] = t, et
    return abs(t - b)


@jit(forceinline=False)
def advance_line(settings, lanes, lane):
    """Bring a lane's line search on by the energy ET of the step T that it tried."""
    s = lanes.scalars
    stage, et = lanes.stage[lane], s[ET, lane]
    lanes.evaluations[lane] += 1
    lanes.tries[lane] += 1
    if stage == OPEN:
        s[ENERGY, lane] = et
        open_line(settings, lanes, lane)
    elif stage == FIRST or stage == SHRINK:
        s[EB, lane] = et
        if not et < s[EA, lane]:
            shrink(lanes, lane)
        elif stage == SHRINK:
            close_in(settings, lanes, lane)
        else:
            s[C, lane], s[EC, lane] = s[B, lane], et
            grow(lanes, lane)
    elif stage == GROW:
        s[EC, lane] = et
        if et < s[EB, lane]:
            s[A, lane], s[EA, lane] = s[B, lane], s[EB, lane]
            s[B, lane], s[EB, lane] = s[C, lane], et
            grow(lanes, lane)
        else:
            close_in(settings, lanes, lane)
    elif replace_one(lanes, lane) <= settings.line_tolerance * s[B, lane]:
        close_line(lanes, lane, s[B, lane])
    else:
        close_in(settings, lanes, lane)


@jit(forceinline=False)
def choose_beta(settings, lanes, lane):
    """Polak-Ribiere's beta of a lane that turns, clipped to f . (f + beta d) >= sufficient |f|^2; 0 without a step."""
    s = lanes.scalars
    square, beta = s[NEW_SQUARE, lane], 0.0
    if lanes.stage[lane] == TURN:
        s[SIZE, lane] = s[SLOPE, lane]
        beta = max(0.0, (square - s[OVERLAP, lane]) / s[SQUARE, lane])
        if s[ALONG, lane] < 0.0:
            beta = min(beta, (settings.sufficient - 1.0) * square / s[ALONG, lane])
    s[SQUARE, lane], s[BETA, lane] = square, beta
    lanes.steepest[lane] = beta == 0.0


@jit(forceinline=False)
def ended(settings, lanes, lane):
    """Whether a lane that has turned is at its end: at the tolerance, the cap, where nothing falls, or out of numbers."""
    s = lanes.scalars
    going = lanes.iterations[lane] < settings.max_iterations and lanes.stage[lane] != STUCK
    finite = 0.0 < s[LONGEST, lane] < 1e300 and s[SQUARE, lane] < 1e300
    return not going or not finite or s[RESIDUAL, lane] <= settings.tolerance


@jit
def conjugate_gradient(energy, forces, next_case, problem, queue, settings, lanes, work):
    """Minimise ``energy(problem, x)`` for start after start in each lane; ``forces(problem, x, f)`` fills f = -gradient and
    returns its norm.

    A search ends at the tolerance, at the cap, or where steepest descent finds no lower energy: then the energy's rounding
    hides the slope. ``next_case(problem, queue, lane, residual, directions, evaluations)`` is called with what it ended with
    (at first with nothing), and puts the next start into the lane; False where there is none.
    ``work`` is ``lanes``, or of a single lane the same memory without its axis: kernels then compute one search only.
    """
    count = lanes.stage.shape[0]
    running = 0
    for lane in range(count):
        start(lanes, lane)
        if next_case(problem, queue, lane, 0.0, 0, 0):
            running += 1
        else:
            lanes.stage[lane] = IDLE
    while running > 0:
        waiting = 0
        for lane in range(count):
            lanes.scalars[TURNS, lane] = 1.0 if lanes.stage[lane] >= WAIT else 0.0
            waiting += 1 if lanes.stage[lane] >= WAIT else 0
        if 2 * waiting < running:
            try_step(work)
            store1(work.scalars, ET, energy(problem, work.trial))
            for lane in range(count):
                if IDLE < lanes.stage[lane] < WAIT:
                    advance_line(settings, lanes, lane)
            continue
        take_step(work)
        store1(work.scalars, RESIDUAL, forces(problem, work.x, work.f))
        compare_forces(work)
        for lane in range(count):
            if lanes.stage[lane] >= WAIT:
                choose_beta(settings, lanes, lane)
        turn(work)
        for lane in range(count):
            stage = lanes.stage[lane]
            if stage < WAIT:
                continue
            if not ended(settings, lanes, lane):
                if stage == START:
                    lanes.stage[lane] = OPEN
                else:
                    open_line(settings, lanes, lane)
            elif next_case(problem, queue, lane, lanes.scalars[RESIDUAL, lane], lanes.iterations[lane], lanes.evaluations[lane]):
                start(lanes, lane)
            else:
                lanes.stage[lane] = IDLE
                running -= 1
