"""Forces of the lattice: the gradient of the energy, the NumPy twin, lanes, and the balances that internal forces keep."""

from __future__ import annotations

from typing import NamedTuple

import kernels
import naive
import numpy as np
import pytest

from tensegrity_gym import Design, Lattice
from tensegrity_gym.types import Ground, Structure

EPS = naive.EPS
EARTH = np.array([0.0, 0.0, -9.80665])
NONE = np.zeros(3)


class Case(NamedTuple):
    """A structure in a posture, in motion."""

    structure: Structure
    lengths: np.ndarray
    x: np.ndarray
    v: np.ndarray
    memory: np.ndarray


def case(size: tuple[int, int] = (2, 2), segments: int = 3, noise: float = 3e-3, seed: int = 0) -> Case:
    """The unloaded lattice with every mass off its place by ``noise`` [m] and moving at 1 m/s, actuators tightened."""
    design, lattice = Design(bar_segments=segments), Lattice(*size)
    structure, rng = design.structure(lattice), np.random.default_rng(seed)
    x = design.unloaded_positions(lattice) + rng.normal(size=(len(structure.mass), 3)) * noise
    lengths = structure.actuator_length * rng.uniform(0.5, 1.05, size=lattice.n_cells)
    c = Case(structure, lengths, x, rng.normal(size=x.shape), rng.normal(size=structure.n_axial_members))
    if noise > 0:  # differences want no cable about to go slack: those are cut shorter
        close = np.abs(cable_stretch(c)) < 1e-4
        structure.cable_length[close] -= 2e-4
    return c


def eight_of_one_structure(noises: list[float]) -> list[Case]:
    """A posture for each lane, of one and the same cell."""
    group = [case((1, 1), noise=noise, seed=k) for k, noise in enumerate(noises)]
    return [c._replace(structure=group[0].structure) for c in group]


def cable_stretch(c: Case) -> np.ndarray:
    """Length of the unactuated cables over their natural length [m]."""
    ends = c.x[c.structure.cables]
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) - c.structure.cable_length


def distance_from_slack(c: Case) -> float:
    """How far the cable nearest to the kink of its law is from it [m]."""
    return float(np.abs(cable_stretch(c)).min())


def hinges_first(c: Case) -> Case:
    """The same with axial stiffness, damping and gravity's masses so small that nothing hides the hinges."""
    s = c.structure
    names = ("segment_stiffness", "segment_damping", "cable_stiffness", "cable_damping", "actuator_rigidity", "mass")
    soft = s._replace(**{name: 1e-6 * getattr(s, name) for name in names}, inverse_mass=1e6 * s.inverse_mass)
    return c._replace(structure=soft)


CASES = [
    hinges_first(case((1, 1), noise=0.01, seed=10)),
    hinges_first(case((1, 1), segments=5, noise=0.01, seed=11)),
    case((1, 1)),
    case((2, 1), seed=1),
    case((2, 2), noise=0.02, seed=2),
    case((1, 1), noise=0.06, seed=3),  # hinges folded past 90 degrees
    case((1, 1), segments=1, seed=4),
    case((1, 1), segments=2, seed=5),
    case((1, 1), segments=5, seed=6),
]
cases = pytest.mark.parametrize(
    "c", CASES, ids=lambda c: f"{len(c.structure.mass)} masses, {c.structure.bars.shape[1] - 1} segments"
)


def core_forces(
    c: Case, gravity: np.ndarray, v: np.ndarray, memory: np.ndarray | None = None
) -> tuple[np.ndarray, float, np.ndarray]:
    """(forces [N], dissipated power [W], damping memory [N])."""
    f, power = np.full_like(c.x, np.nan), np.zeros(1)
    memory = np.zeros(c.structure.n_axial_members) if memory is None else memory.copy()
    kernels.forces(c.structure, c.lengths, gravity, c.x, v, f, memory, power)
    return f, float(power[0]), memory


def potential(c: Case, x: np.ndarray) -> float:
    """Elastic and gravitational energy by the core [J]."""
    parts = np.zeros(5)
    kernels.energies(c.structure, c.lengths, EARTH, x, np.zeros_like(x), parts)
    return float(parts.sum())


def test_the_cases_bend_past_a_right_angle_and_have_slack_and_taut_cables() -> None:
    angles = [naive.hinge_angle(c.x[j] - c.x[i], c.x[k] - c.x[j]) for c in CASES for i, j, k, *_ in naive.hinges(c.structure)]
    assert min(angles) < np.radians(2) < np.radians(95) < max(angles)
    for c in CASES:
        assert cable_stretch(c).min() < 0 < cable_stretch(c).max()


@cases
def test_forces_are_minus_the_gradient_of_the_energy(c: Case) -> None:
    """F = -dU/dx; the five-point difference errs by h^4/30 U^(5) (here < 1e-12 N) and by rounding of U over h."""
    h = 2e-6
    f, _, _ = core_forces(c, EARTH, np.zeros_like(c.x))
    difference = np.zeros_like(f)
    for place in np.ndindex(f.shape):
        weights = {1: 8.0, -1: -8.0, 2: -1.0, -2: 1.0}
        for step, weight in weights.items():
            x = c.x.copy()
            x[place] += step * h
            difference[place] -= weight * potential(c, x) / (12 * h)
    magnitude = naive.forces(c.structure, c.lengths, EARTH, c.x, np.zeros_like(c.x)).magnitude
    # U is a sum of that many terms, each with the rounding of the lengths that go in
    terms = c.structure.n_axial_members + 2 * len(c.structure.mass)
    rounding = EPS * (terms * potential(c, c.x) + np.abs(f).sum()) * 18 / (12 * h)
    assert distance_from_slack(c) > 2 * h  # no kink within the stencil
    assert rounding < 1e-8 * magnitude.max()
    np.testing.assert_allclose(f, difference, atol=rounding + naive.POLYNOMIAL_ERROR * magnitude.max(), rtol=0)


@cases
def test_forces_and_power_match_the_twin(c: Case) -> None:
    f, power, memory = core_forces(c, EARTH, c.v, c.memory)
    twin = naive.forces(c.structure, c.lengths, EARTH, c.x, c.v, c.memory)
    excess = np.linalg.norm(f - twin.f, axis=1) / (EPS * twin.magnitude)
    assert excess.max() < 4
    assert abs(power - twin.power) < 4 * EPS * twin.power_magnitude
    stiffness = max(c.structure.segment_stiffness.max(), c.structure.cable_stiffness.max())
    np.testing.assert_allclose(memory, twin.drags, rtol=16 * EPS, atol=16 * EPS * stiffness)


@cases
def test_energies_match_the_twin(c: Case) -> None:
    parts = np.zeros(5)
    kernels.energies(c.structure, c.lengths, EARTH, c.x, c.v, parts)
    expected = naive.energies(c.structure, c.lengths, EARTH, c.x, c.v)
    magnitude = naive.forces(c.structure, c.lengths, EARTH, c.x, np.zeros_like(c.x)).magnitude
    # dU = F dl with l known to eps |x|, and a sum of some hundred terms
    tolerance = EPS * (np.abs(expected) * 100 + np.abs(core_forces(c, NONE, 0 * c.v)[0]).sum())
    tolerance[4] += EPS * c.structure.mass.sum() * 9.81 * np.abs(c.x).max()
    tolerance[0] += naive.POLYNOMIAL_ERROR * expected[0]
    assert magnitude.max() > 0
    assert (np.abs(parts - expected) <= tolerance).all()


def test_every_lane_has_the_bits_of_the_scalar() -> None:
    group = eight_of_one_structure([0.0, 1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.06, 0.09])
    x, v, memory = (kernels.stack([getattr(c, name) for c in group]) for name in ("x", "v", "memory"))
    lengths, f, power = kernels.stack([c.lengths for c in group]), np.zeros_like(x), kernels.stack([np.zeros(1)])
    kernels.forces(group[0].structure, lengths, EARTH, x, v, f, memory, power)
    parts = kernels.stack([np.zeros(5)])
    kernels.energies(group[0].structure, lengths, EARTH, x, v, parts)
    for lane, c in enumerate(group):
        alone_f, alone_power, alone_memory = core_forces(c, EARTH, c.v, c.memory)
        np.testing.assert_array_equal(f[..., lane], alone_f)
        np.testing.assert_array_equal(power[0, lane], alone_power)
        np.testing.assert_array_equal(memory[:, lane], alone_memory)
        alone = np.zeros(5)
        kernels.energies(c.structure, c.lengths, EARTH, c.x, c.v, alone)
        np.testing.assert_array_equal(parts[:, lane], alone)


def test_lanes_and_scalar_agree_bit_for_bit_over_many_steps() -> None:
    """Cables go slack and taut in some lanes only, and masses touch the ground in some: nothing may leak between lanes."""
    group = eight_of_one_structure([4e-3] * 8)
    for k, c in enumerate(group):
        c.x[:, 2] -= c.x[:, 2].min() - 0.002 * k
    ground, dt, steps = Ground(EARTH, 0.5, 0.2), 1e-5, 400
    structure = group[0].structure
    x, v, memory = (kernels.stack([getattr(c, name) for c in group]) for name in ("x", "v", "memory"))
    losses, lengths = kernels.stack([np.zeros(3)]), kernels.stack([c.lengths for c in group])
    kernels.advance(structure, lengths, ground, dt, dt, steps, x, v, np.zeros_like(x), memory, losses)
    slack = 0
    for lane, c in enumerate(group):
        ax, av, amemory, alosses = c.x.copy(), c.v.copy(), c.memory.copy(), np.zeros(3)
        kernels.advance(structure, c.lengths, ground, dt, dt, steps, ax, av, np.zeros_like(ax), amemory, alosses)
        for lanes, alone in ((x, ax), (v, av), (memory, amemory), (losses, alosses)):
            np.testing.assert_array_equal(lanes[..., lane], alone)
        slack += int((amemory == 0).sum())
    assert slack > 0
    assert (losses[1] > 0).any()


@cases
def test_a_step_matches_the_twin(c: Case) -> None:
    ground, dt = Ground(np.array([1.7, 0.4, -9.6]), 0.6, 0.3), 1e-5
    x, v, memory = c.x.copy(), c.v.copy(), c.memory.copy()
    x[:, 2] -= np.median(x[:, 2])  # half of the masses in contact, some coming and some leaving
    expected_x, expected_v, expected_memory = naive.step(c.structure, c.lengths, ground, dt, dt, x, v, memory)
    twin = naive.forces(c.structure, c.lengths, ground.gravity, x, v, memory)
    losses = np.zeros(3)
    kernels.advance(c.structure, c.lengths, ground, dt, dt, 1, x, v, np.zeros_like(x), memory, losses)
    # the friction impulse may pass on what rounding does to the normal one: times (1 + mu (1 + e))
    blur = 16 * EPS * (2 * dt * twin.magnitude / c.structure.mass + 4 * np.abs(c.v).max())[:, None]
    assert (np.abs(v - expected_v) <= blur).all()
    assert (np.abs(x - expected_x) <= dt * blur + 2 * EPS * np.abs(x)).all()
    stiffness = max(c.structure.segment_stiffness.max(), c.structure.cable_stiffness.max())
    np.testing.assert_allclose(memory, expected_memory, rtol=16 * EPS, atol=16 * EPS * stiffness)
    assert losses[2] == x[:, 2].min()


@cases
def test_a_rigid_motion_is_not_damped(c: Case) -> None:
    """v = V + omega x r has no member rate and no angle rate: damping is objective."""
    rigid = np.array([3.0, -2.0, 1.0]) + np.cross([4.0, 5.0, -6.0], c.x)
    twin = naive.forces(c.structure, c.lengths, NONE, c.x, rigid)
    moving, power, _ = core_forces(c, NONE, rigid)
    still, _, _ = core_forces(c, NONE, 0 * rigid)
    assert (np.linalg.norm(moving - still, axis=1) <= 4 * EPS * twin.magnitude).all()
    assert abs(power) <= 4 * EPS * twin.power_magnitude
    assert core_forces(c, NONE, c.v)[1] > 1.0  # while a vibration loses watts


@cases
def test_internal_forces_have_no_resultant_and_no_moment(c: Case) -> None:
    """Newton's third law, damping included: sum f = 0 and sum r x f = 0."""
    f, _, _ = core_forces(c, NONE, c.v)
    magnitude = naive.forces(c.structure, c.lengths, NONE, c.x, c.v).magnitude
    reach = np.linalg.norm(c.x, axis=1)
    assert np.linalg.norm(f.sum(axis=0)) <= 4 * EPS * magnitude.sum()
    assert np.linalg.norm(np.cross(c.x, f).sum(axis=0)) <= 4 * EPS * (reach * magnitude).sum()


def test_damping_takes_the_work_that_its_forces_do() -> None:
    """A spring and a damper along a line: the leapfrog audit closes to rounding, not to the order of the step.

    With E = m v^2/2 + (U_n + U_{n+1})/2 - k dt^2 v^2/4, which leapfrog keeps exactly without damping, a damping force D_n
    between half steps with rates r_n, r_{n+1} takes -D_n (r_n + r_{n+1})/2 dt; the core adds it up as (D_{n-1} + D_n)/2 r_n dt.
    """
    stiffness, damping, mass, dt, steps = 4.0e4, 6.0, 0.02, 1.5e-4, 200
    s = naive.make_structure(
        [mass, mass], bars=[[0, 1]], segment_stiffness=stiffness, segment_length=0.3, segment_damping=damping
    )
    x, v = np.array([[0.0, 0, 1], [0.34, 0, 1]]), np.zeros((2, 3))
    memory, losses, f = np.zeros(1), np.zeros(3), np.zeros((2, 3))
    ground = Ground(np.zeros(3), 0.0, 0.0)

    def energy() -> float:
        rate = v[1, 0] - v[0, 0]
        stretch = np.array([x[1, 0] - x[0, 0], x[1, 0] - x[0, 0] - dt * rate]) - 0.3
        kinetic = 0.5 * mass * (v**2).sum()
        return kinetic + 0.25 * stiffness * (stretch**2).sum() - 0.25 * stiffness * dt**2 * rate**2

    kernels.advance(s, np.zeros(0), ground, dt, 0.5 * dt, 1, x, v, f, memory, losses)
    start = energy() + losses[0]
    for _ in range(steps):
        kernels.advance(s, np.zeros(0), ground, dt, dt, 1, x, v, f, memory, losses)
        # the last force's work at the newest rate is booked in the next step
        pending = 0.5 * memory[0] * (v[1, 0] - v[0, 0]) * dt
        assert abs(energy() + losses[0] + pending - start) < 64 * steps * EPS * start
    assert losses[0] > 0.9 * start  # it has come to rest by damping


def test_the_damping_power_of_a_lattice_is_the_twins_work_to_first_order_in_the_step() -> None:
    """Work of damping forces D_n over a step, D_n . (v_n + v_{n+1})/2 dt, by the twin; bars turn by O(dt) between steps."""
    c = case((1, 1), noise=1e-3, seed=8)
    ground, duration = Ground(np.array([0.0, 0.0, 0.0]), 0.0, 0.0), 6e-4
    errors = []
    for dt in (2e-5, 1e-5):
        x, v, f = c.x + [0, 0, 5], 0.1 * c.v, np.zeros_like(c.x)
        memory, losses, work = np.zeros_like(c.memory), np.zeros(3), 0.0
        for _ in range(round(duration / dt)):
            before = v.copy()
            twin = naive.forces(c.structure, c.lengths, NONE, x, v)
            damping = twin.f - naive.forces(c.structure, c.lengths, NONE, x, 0 * v).f
            kernels.advance(c.structure, c.lengths, ground, dt, dt, 1, x, v, f, memory, losses)
            work -= dt * (damping * (before + v) / 2).sum()
        errors.append(abs(losses[0] - work) / work)
    assert errors[0] < 0.05
    assert errors[1] < 0.7 * errors[0]
