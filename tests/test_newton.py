"""Newton's steps, shifts and load path on energies with closed forms: Rosenbrock's valley and the von Mises truss."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import brentq

from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import load, load1, select, sqrt, store
from tensegrity_gym.core.newton import EquilibriumRecords, NewtonSettings, find_minima
from tensegrity_gym.stability import last_share
from tensegrity_gym.types import BlockPattern
from tensegrity_gym.workspaces import newton_lanes, without_lanes

NO = np.zeros(0, dtype=np.int64)
#: One mass, no members.
PATTERN = BlockPattern(
    np.zeros(1, np.int64), np.ones(2, np.int64), NO, NO, NO, NO, np.zeros((0, 0, 2), np.int64), NO.reshape(0, 0, 2)
)
SETTINGS = NewtonSettings(
    load_step=0.5,
    path_tolerance=1e-6,
    tolerance=1e-10,
    max_iterations=2000,
    longest_step=0.5,
    least_shift=1e-12,
    unload=1.0,
    soft_ground=0.0,
    most_compression=1e300,
    patience=12,
    first_shift=1.0,
    max_rounds=5,
)


class Problem(NamedTuple):
    """What the energies below depend on."""

    load: np.ndarray  #: of the truss [N], shape (1[, lanes])
    held: np.ndarray  #: 1.0 where the mass lies on the ground, shape (1[, lanes])


@jit
def no_tensions(problem, most_compression, x, d, tensions):
    """Nothing to predict without members."""


@jit
def largest(f):
    """The force on the only mass."""
    fx, fy, fz = load(f, 0, 0), load(f, 0, 1), load(f, 0, 2)
    return sqrt(fx * fx + fy * fy + fz * fz)


# ------------------------------------------------------------------------------------- Rosenbrock's valley
@jit
def valley(problem, x):
    """(1 - a)^2 + 100 (b - a^2)^2 + (c - 1)^2 / 2."""
    a, b, c = load(x, 0, 0), load(x, 0, 1), load(x, 0, 2)
    off, rise = 1.0 - a, b - a * a
    return off * off + 100.0 * rise * rise + 0.5 * (c - 1.0) * (c - 1.0)


@jit
def valley_forces(problem, x, f):
    """Minus its gradient."""
    a, b = load(x, 0, 0), load(x, 0, 1)
    rise = b - a * a
    store(f, 0, 0, 2.0 * (1.0 - a) + 400.0 * a * rise)
    store(f, 0, 1, -200.0 * rise)
    store(f, 0, 2, 1.0 - load(x, 0, 2))
    return largest(f)


@jit
def valley_tangent(problem, pattern, x, tensions, h):
    """Its Hessian."""
    a, b = load(x, 0, 0), load(x, 0, 1)
    zero = a * 0.0
    entries = (2.0 - 400.0 * b + 1200.0 * a * a, -400.0 * a, zero, -400.0 * a, zero + 200.0, zero, zero, zero, zero + 1.0)
    for k in range(9):
        store(h, 0, k, entries[k])


def newton_on(energy, forces, tangent):
    """Newton on an energy without members, compiled."""

    @jit(cache=False, forceinline=False, _nrt=True)
    def run(problem, pattern, settings, stretches, records, lanes, work, n, count):
        find_minima(
            energy, forces, tangent, no_tensions, problem, pattern, settings, stretches, records, lanes, work, 0, n, count
        )

    return run


run_valley = newton_on(valley, valley_forces, valley_tangent)


@jit
def sunken(problem, x):
    """The valley with a constant pull of 1.7 down."""
    return valley(problem, x) + 1.7 * load(x, 0, 2)


@jit
def sunken_forces(problem, x, f):
    """Minus its gradient; what the ground takes off the mass that lies on it does not count."""
    valley_forces(problem, x, f)
    store(f, 0, 2, load(f, 0, 2) - 1.7)
    rest = load(f, 0, 2)
    on_ground = load1(problem.held, 0) > 0.0
    fx, fy, fz = load(f, 0, 0), load(f, 0, 1), select(on_ground, rest * 0.0, rest)
    return sqrt(fx * fx + fy * fy + fz * fz)


run_sunken = newton_on(sunken, sunken_forces, valley_tangent)


# ------------------------------------------------------------------------------------- von Mises truss
#: Two bars from supports at x = -1 and 1, height BASE, to a common mass that carries a load downwards [m, m, N/m].
BASE, NATURAL, STIFFNESS = 10.0, np.hypot(1.0, 0.3), 1000.0
SIDEWAYS = 50.0


@jit
def truss(problem, x):
    """Energy of both bars, of a spring that holds the mass sideways, and of the load."""
    a, b, z = load(x, 0, 0), load(x, 0, 1), load(x, 0, 2) - BASE
    left, right = sqrt((a + 1.0) * (a + 1.0) + z * z) - NATURAL, sqrt((a - 1.0) * (a - 1.0) + z * z) - NATURAL
    return 0.5 * STIFFNESS * (left * left + right * right) + 0.5 * SIDEWAYS * b * b + load1(problem.load, 0) * z


@jit
def truss_forces(problem, x, f):
    """Minus its gradient."""
    a, b, z = load(x, 0, 0), load(x, 0, 1), load(x, 0, 2) - BASE
    left, right = sqrt((a + 1.0) * (a + 1.0) + z * z), sqrt((a - 1.0) * (a - 1.0) + z * z)
    p, q = STIFFNESS * (1.0 - NATURAL / left), STIFFNESS * (1.0 - NATURAL / right)
    store(f, 0, 0, -(p * (a + 1.0) + q * (a - 1.0)))
    store(f, 0, 1, -SIDEWAYS * b)
    store(f, 0, 2, -((p + q) * z + load1(problem.load, 0)))
    return largest(f)


@jit
def truss_tangent(problem, pattern, x, tensions, h):
    """Its Hessian."""
    a, z = load(x, 0, 0), load(x, 0, 2) - BASE
    zero = a * 0.0
    xx, xz, zz = zero, zero, zero
    for side in range(2):
        u = a + 1.0 - 2.0 * side
        length = sqrt(u * u + z * z)
        geometric = STIFFNESS * (1.0 - NATURAL / length)
        rest = (STIFFNESS - geometric) / (length * length)
        xx, xz, zz = xx + rest * u * u + geometric, xz + rest * u * z, zz + rest * z * z + geometric
    entries = (xx, zero, xz, zero, zero + SIDEWAYS, zero, xz, zero, zz)
    for k in range(9):
        store(h, 0, k, entries[k])


run_truss = newton_on(truss, truss_forces, truss_tangent)


# ------------------------------------------------------------------------------------- tests
def search(
    run, starts: np.ndarray, loads: np.ndarray, settings: NewtonSettings = SETTINGS, lanes: bool = True
) -> EquilibriumRecords:
    """Minima from ``starts`` (n, 3) under ``loads`` (n,), in units of the load at stretch 1."""
    n = len(starts)
    records = EquilibriumRecords(
        np.array(starts, dtype=float).reshape(n, 1, 3),
        np.zeros((n, 1, 3)),
        np.zeros(n),
        np.zeros(n, np.int64),
        np.zeros(n, np.bool_),
        np.zeros(n),
    )
    whole = newton_lanes(1, 0, np.ones(1), 1, 8 if lanes else 1)
    work = whole if lanes else without_lanes(whole)
    stretches = np.asarray(loads, dtype=float).reshape(n, 1)
    run(Problem(work.actuator_length, work.held), PATTERN, settings, stretches, records, whole, work, n, np.zeros(1, np.int64))
    return records


def test_newton_follows_rosenbrocks_valley_also_from_where_the_hessian_is_indefinite() -> None:
    starts = np.array([[-1.2, 1.0, 0.5], [0.0, 1.0, 2.0], [2.0, -3.0, 1.0], [-1.9, 2.0, 3.0]])
    indefinite = (2 - 400 * starts[:, 1] + 1200 * starts[:, 0] ** 2) * 200 - (400 * starts[:, 0]) ** 2 < 0
    assert indefinite.any()
    assert not indefinite.all()
    found = search(run_valley, starts, np.ones(4))
    assert found.converged.all()
    np.testing.assert_allclose(found.positions, 1.0, atol=1e-10)
    assert (found.iterations < 200).all()


def test_one_lattice_without_lanes_gives_the_bits_of_lanes() -> None:
    starts = np.array([[-1.2, 1.0, 0.5], [0.0, 1.0, 2.0]])
    lanes, alone = search(run_valley, starts, np.ones(2)), search(run_valley, starts, np.ones(2), lanes=False)
    np.testing.assert_array_equal(alone.positions, lanes.positions)
    np.testing.assert_array_equal(alone.iterations, lanes.iterations)


def test_newton_stops_at_the_ground() -> None:
    """The valley's minimum shifted below z = 0 leaves the mass on the ground, the force on it as it was."""
    found = search(run_sunken, np.array([[-1.2, 1.0, 0.5]]), np.ones(1))
    assert found.converged.all()
    np.testing.assert_allclose(found.positions[0, 0], [1.0, 1.0, 0.0], atol=1e-9)
    assert found.forces[0, 0, 2] == pytest.approx(-0.7, abs=1e-12)


def load_at(z: float) -> float:
    """Load [N] under which the truss rests at the height z [m]: 2 k (L0 / L - 1) z."""
    return 2 * STIFFNESS * (NATURAL / np.hypot(1.0, z) - 1) * z


#: L^3 = L0 at the limit point: dP/dz = 0.
LIMIT_HEIGHT = np.sqrt(NATURAL ** (2 / 3) - 1)
LIMIT_LOAD = load_at(LIMIT_HEIGHT)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999, -0.5])
def test_the_truss_below_its_limit_load_rests_on_the_upper_branch(share: float) -> None:
    load = share * LIMIT_LOAD
    found = search(run_truss, [[0.0, 0.0, BASE + 0.3]], [load])
    expected = brentq(lambda z: load_at(z) - load, LIMIT_HEIGHT, 0.6, xtol=1e-15)
    assert found.converged.all()
    assert found.positions[0, 0, 2] - BASE == pytest.approx(expected, abs=1e-8)
    assert expected > LIMIT_HEIGHT


@pytest.mark.parametrize("share", [1.001, 1.1, 2.0])
def test_the_truss_above_its_limit_load_has_snapped_through(share: float) -> None:
    load = share * LIMIT_LOAD
    found = search(run_truss, [[0.0, 0.0, BASE + 0.3]], [load])
    expected = brentq(lambda z: load_at(z) - load, -2.0, -0.3, xtol=1e-15)
    assert found.converged.all()
    assert found.positions[0, 0, 2] - BASE == pytest.approx(expected, abs=1e-8)


def test_bisection_closes_in_on_the_limit_load() -> None:
    """Above it Newton finds an equilibrium, too, the snapped one: that the way back does not end at the start tells."""
    careful = SETTINGS._replace(unload=0.0, longest_step=0.02)

    def solve(load: float, height: float) -> float | None:
        found = search(run_truss, [[0.0, 0.0, height]], [load], careful)
        return float(found.positions[0, 0, 2]) if found.converged[0] else None

    start = solve(0.5 * LIMIT_LOAD, BASE + 0.3)
    assert start is not None
    found = last_share(solve, lambda a, b: abs(a - b) < 1e-6, 0.5 * LIMIT_LOAD, start, 1.5 * LIMIT_LOAD, 1e-5 * LIMIT_LOAD)
    assert found == pytest.approx(LIMIT_LOAD, rel=1e-4)


def test_a_cap_below_what_is_needed_is_reported() -> None:
    found = search(run_truss, [[0.0, 0.0, BASE + 0.3]], [2 * LIMIT_LOAD], SETTINGS._replace(max_iterations=4))
    assert not found.converged.any()
    assert found.iterations[0] == 4
    assert found.residual[0] > SETTINGS.tolerance
