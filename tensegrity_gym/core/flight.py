"""Free flight of a lattice whose vibration is frozen: a parabola and the torque-free rotation of a rigid body.

The body is the unloaded lattice in its best fit to the state at hand (polar decomposition, mass-weighted). Momentum and
angular momentum go on exactly; the energy of the vibration, which damping would take before long, is taken at once.
"""

from __future__ import annotations

import numpy as np

from tensegrity_gym.core.jit import jit

#: Angle turned in one step of the rotation [rad]: Runge-Kutta's error is its fifth power over 120, 1e-9 a step.
STEP_ANGLE = 0.04
#: Longest step [s], for bodies that hardly turn.
LONGEST_STEP = 5e-3
#: Halvings of the step in which the ground is met: 5e-3 s / 2^30 is 5e-12 s.
HALVINGS = 30


@jit(forceinline=False)
def centre(mass, points, out):
    """out = mass-weighted mean of points (n_masses, 3)."""
    total = 0.0
    out[:] = 0.0
    for i in range(mass.shape[0]):
        total += mass[i]
        for c in range(3):
            out[c] += mass[i] * points[i, c]
    for c in range(3):
        out[c] /= total


@jit(forceinline=False)
def _adjugate(a, out):
    """out = adjugate of the 3x3 matrix a; returns the determinant."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            out[c, i] = a[j, d] * a[k, e] - a[j, e] * a[k, d]
    return a[0, 0] * out[0, 0] + a[0, 1] * out[1, 0] + a[0, 2] * out[2, 0]


@jit(forceinline=False)
def nearest_rotation(a, adjugate):
    """Replace the 3x3 matrix a by the orthogonal factor of its polar decomposition: Newton's a <- (a + a^-T) / 2."""
    for _ in range(60):
        determinant = _adjugate(a, adjugate)
        scale = abs(determinant) ** (-1.0 / 3.0)
        change = 0.0
        for i in range(3):
            for c in range(3):
                new = 0.5 * (scale * a[i, c] + adjugate[c, i] / (scale * determinant))
                change = max(change, abs(new - a[i, c]))
                a[i, c] = new
        if change < 1e-15:
            break


@jit(forceinline=False)
def _spin(q, inverse_inertia, momentum, rotation, rate, dq):
    """dq = rate of the unit quaternion q of a body of constant angular momentum; fills its rotation matrix and rate [rad/s]."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    a = rotation[0, 0] * momentum[0] + rotation[1, 0] * momentum[1] + rotation[2, 0] * momentum[2]
    b = rotation[0, 1] * momentum[0] + rotation[1, 1] * momentum[1] + rotation[2, 1] * momentum[2]
    c = rotation[0, 2] * momentum[0] + rotation[1, 2] * momentum[1] + rotation[2, 2] * momentum[2]
    inv = inverse_inertia
    u = inv[0, 0] * a + inv[0, 1] * b + inv[0, 2] * c
    v = inv[1, 0] * a + inv[1, 1] * b + inv[1, 2] * c
    t = inv[2, 0] * a + inv[2, 1] * b + inv[2, 2] * c
    for k in range(3):
        rate[k] = rotation[k, 0] * u + rotation[k, 1] * v + rotation[k, 2] * t
    dq[0] = 0.5 * (-x * u - y * v - z * t)
    dq[1] = 0.5 * (w * u + y * t - z * v)
    dq[2] = 0.5 * (w * v + z * u - x * t)
    dq[3] = 0.5 * (w * t + x * v - y * u)


@jit(forceinline=False)
def _turn(q, h, inverse_inertia, momentum, rotation, rate, stages, out):
    """out = q after a classical Runge-Kutta step h [s], of unit length."""
    for stage in range(4):
        ahead = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
        for k in range(4):
            out[k] = q[k] + (ahead * stages[stage - 1, k] if stage > 0 else 0.0)
        _spin(out, inverse_inertia, momentum, rotation, rate, stages[stage])
    norm = 0.0
    for k in range(4):
        out[k] = q[k] + h / 6.0 * (stages[0, k] + 2.0 * stages[1, k] + 2.0 * stages[2, k] + stages[3, k])
        norm += out[k] * out[k]
    norm = 1.0 / np.sqrt(norm)
    for k in range(4):
        out[k] *= norm


@jit(forceinline=False)
def _lowest(q, shape, masses):
    """Lowest z of the first ``masses`` points of a body turned by q, its centre at the origin."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    a, b, c = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    low = 1e30
    for i in range(min(masses, shape.shape[0])):
        low = min(low, a * shape[i, 0] + b * shape[i, 1] + c * shape[i, 2])
    return low


@jit(forceinline=False)
def _quaternion(r, q):
    """The unit quaternion of a rotation matrix (Shepperd: the largest of the four first)."""
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    best, value = -1, trace
    for k in range(3):
        if r[k, k] > value:
            best, value = k, r[k, k]
    if best < 0:
        q[0] = 1.0 + trace
        q[1], q[2], q[3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    else:
        j, k = (best + 1) % 3, (best + 2) % 3
        q[0] = r[k, j] - r[j, k]
        q[1 + best] = 1.0 + 2.0 * r[best, best] - trace
        q[1 + j], q[1 + k] = r[j, best] + r[best, j], r[k, best] + r[best, k]
    norm = 1.0 / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for k in range(4):
        q[k] *= norm


@jit(forceinline=False)
def _place(shape, gravity, x, v, t, rotation, rate, state):
    """Positions and velocities of the body at time t of its flight, from its rotation matrix and its rate of rotation."""
    for i in range(shape.shape[0]):
        ax = rotation[0, 0] * shape[i, 0] + rotation[0, 1] * shape[i, 1] + rotation[0, 2] * shape[i, 2]
        ay = rotation[1, 0] * shape[i, 0] + rotation[1, 1] * shape[i, 1] + rotation[1, 2] * shape[i, 2]
        az = rotation[2, 0] * shape[i, 0] + rotation[2, 1] * shape[i, 1] + rotation[2, 2] * shape[i, 2]
        for c in range(3):
            state[0, i, c] = x[c] + v[c] * t + 0.5 * gravity[c] * t**2 + (ax if c == 0 else (ay if c == 1 else az))
            state[1, i, c] = v[c] + gravity[c] * t
        state[1, i, 0] += rate[1] * az - rate[2] * ay
        state[1, i, 1] += rate[2] * ax - rate[0] * az
        state[1, i, 2] += rate[0] * ay - rate[1] * ax


@jit(cache=True)
def fly_rigidly(mass, shape, gravity, masses, state, time_limit, frame_times, frames):
    """Fly one lattice from its state to the ground as a rigid body.

    Args:
        mass: [kg], shape (n_masses,).
        shape: the unloaded lattice about its centre of mass [m], shape (n_masses, 3).
        gravity: [m/s^2], shape (3,).
        masses: only the first so many masses meet the ground.
        state: positions [m] and velocities [m/s], shape (2, n_masses, 3); left at the end of the flight.
        time_limit: longest flight [s].
        frame_times: since its start, rising [s], shape (k,); states at those before its end go to ``frames``, shape
            (k, 2, n_masses, 3).

    Returns (duration of the flight [s], whether it met the ground while falling, frames filled).
    """
    x, v, momentum = np.zeros(3), np.zeros(3), np.zeros(3)
    inertia, inverse, a, adjugate = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    centre(mass, state[0], x)
    centre(mass, state[1], v)
    square = 0.0
    for i in range(mass.shape[0]):
        rx, ry, rz = state[0, i, 0] - x[0], state[0, i, 1] - x[1], state[0, i, 2] - x[2]
        ux, uy, uz = state[1, i, 0] - v[0], state[1, i, 1] - v[1], state[1, i, 2] - v[2]
        momentum[0] += mass[i] * (ry * uz - rz * uy)
        momentum[1] += mass[i] * (rz * ux - rx * uz)
        momentum[2] += mass[i] * (rx * uy - ry * ux)
        square = mass[i] * (shape[i, 0] ** 2 + shape[i, 1] ** 2 + shape[i, 2] ** 2)
        for c in range(3):
            inertia[c, c] += square
            a[0, c] += mass[i] * rx * shape[i, c]
            a[1, c] += mass[i] * ry * shape[i, c]
            a[2, c] += mass[i] * rz * shape[i, c]
            for d in range(3):
                inertia[c, d] -= mass[i] * shape[i, c] * shape[i, d]
    determinant = _adjugate(inertia, inverse)
    inverse /= determinant
    nearest_rotation(a, adjugate)
    q, new, stages, rotation, rate = np.zeros(4), np.zeros(4), np.zeros((4, 4)), np.zeros((3, 3)), np.zeros(3)
    _quaternion(a, q)
    _spin(q, inverse, momentum, rotation, rate, stages[0])
    step = min(LONGEST_STEP, STEP_ANGLE / (np.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2) + 1e-12))
    t, landed, frame = 0.0, False, 0
    while t < time_limit and not landed:
        h = min(step, time_limit - t)
        _turn(q, h, inverse, momentum, rotation, rate, stages, new)
        ahead = t + h
        falling = v[2] + gravity[2] * ahead < 0.0
        if falling and x[2] + v[2] * ahead + 0.5 * gravity[2] * ahead**2 + _lowest(new, shape, masses) <= 0.0:
            low, high = 0.0, h
            for _ in range(HALVINGS):
                middle = 0.5 * (low + high)
                _turn(q, middle, inverse, momentum, rotation, rate, stages, new)
                ahead = t + middle
                if x[2] + v[2] * ahead + 0.5 * gravity[2] * ahead**2 + _lowest(new, shape, masses) <= 0.0:
                    high = middle
                else:
                    low = middle
            h, landed = high, True
        while frame < frame_times.shape[0] and frame_times[frame] < t + h:
            ahead = frame_times[frame]
            _turn(q, ahead - t, inverse, momentum, rotation, rate, stages, new)
            _spin(new, inverse, momentum, rotation, rate, stages[0])
            _place(shape, gravity, x, v, ahead, rotation, rate, frames[frame])
            frame += 1
        _turn(q, h, inverse, momentum, rotation, rate, stages, new)
        for k in range(4):
            q[k] = new[k]
        t += h
    _spin(q, inverse, momentum, rotation, rate, stages[0])
    _place(shape, gravity, x, v, t, rotation, rate, state)
    return t, landed, frame
