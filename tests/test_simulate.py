"""Hops: energy audit, momentum in flight, symmetry, reproducibility, and what a hop that fails says.

Tolerances on landings name the scatter they stand above: after touchdown a hop amplifies a perturbation by orders of
magnitude (docs/physics.md), so only touchdown is compared where round-off enters differently.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import kernels
import numpy as np
import pytest

from tensegrity_gym import (
    ENERGY_NAMES,
    Design,
    Equilibria,
    Fidelity,
    HopResult,
    HopStatus,
    InvalidParameterError,
    InvalidStretchesError,
    Lattice,
    Scene,
    drop,
    form_find,
    simulate,
)
from tensegrity_gym.batch import dealt, shares, thread_count
from tensegrity_gym.energies import centre_of_mass
from tensegrity_gym.types import Ground

DESIGN, LATTICE, EARTH = Design(), Lattice(2, 2), Scene(duration=1.5)
STRUCTURE = DESIGN.structure(LATTICE)
MASS = float(STRUCTURE.mass.sum())
G = EARTH.gravity
#: Uniform, random ones, and the images of the second by the lattice's symmetries.
RANDOM = np.random.default_rng(3).uniform(0.2, 0.6, size=(4, 4))
STRETCHES = np.vstack([np.full(4, 0.3), RANDOM, RANDOM[0][LATTICE.symmetries[1:]]])
KINETIC, GRAVITATIONAL, CONTACT, DAMPING = (ENERGY_NAMES.index(n) for n in ENERGY_NAMES[3:])


@lru_cache(maxsize=1)
def equilibria() -> Equilibria:
    return form_find(STRETCHES, threads=1)


@lru_cache(maxsize=1)
def hops() -> HopResult:
    """The eight hops most tests look at, with frames."""
    return simulate(STRETCHES, scene=EARTH, equilibria=equilibria(), trajectory_rate=250.0, threads=1)


def flight_frames(hop: int) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and centres of mass [m] of the frames in flight."""
    r = hops()
    t = r.trajectory.times[hop, : r.trajectory.frames[hop]]
    inside = (t > r.takeoff_time[hop]) & (t < r.touchdown_time[hop])
    return t[inside], centre_of_mass(STRUCTURE, r.trajectory.positions[hop, : len(t)][inside])


def subset(e: Equilibria, rows: list[int]) -> Equilibria:
    """Some of the equilibria."""
    parts = {k: v[rows] for k, v in vars(e).items() if isinstance(v, np.ndarray)}
    return replace(e, energies={k: v[rows] for k, v in e.energies.items()}, **parts)


def test_every_hop_flies_and_comes_down() -> None:
    r = hops()
    assert (r.status <= HopStatus.TIME_LIMIT).all()
    assert (r.takeoff_time > 0).all()
    assert (r.takeoff_time < r.touchdown_time).all()
    assert (r.touchdown_time <= r.end_time).all()
    np.testing.assert_array_equal(r.flight_time, r.touchdown_time - r.takeoff_time)
    assert not r.failed.any()
    assert np.isfinite(r.landing).all()


def test_the_uniform_hop_rises_between_one_and_two_metres() -> None:
    assert 1.0 < hops().apex[0] < 2.0
    # no higher than all of its stored energy could lift it
    assert (hops().apex < hops().stored_energy / (MASS * G)).all()


def test_the_uniform_hop_goes_straight_up() -> None:
    """C2 and the mirrors fix the vertical axis; until touchdown round-off has grown to far below a micrometre."""
    assert np.abs(hops().touchdown[0]).max() < 1e-6
    assert np.abs(hops().takeoff_velocity[0, :2]).max() < 1e-6


def test_the_energy_audit_closes_to_a_thousandth_of_the_stored_energy() -> None:
    """Elastic + kinetic + gravitational + dissipated = constant, at the four events and in every frame."""
    r = hops()
    total = r.energies.sum(axis=2)
    assert (np.abs(total - total[:, :1]) < 1e-3 * r.stored_energy[:, None]).all()
    for hop in range(len(STRETCHES)):
        frames = r.trajectory.energies[hop, : r.trajectory.frames[hop]].sum(axis=1)
        assert np.abs(frames - total[hop, 0]).max() < 1e-3 * r.stored_energy[hop]


def test_the_audit_closes_at_first_order_through_contacts_and_slack_cables() -> None:
    """Impacts and kinks happen within a step: halving the step twice leaves at most a quarter of the gap, in the median."""
    scene, gaps = Scene(duration=0.1), []
    for dt in (1.6e-5, 4e-6):
        r = simulate(STRETCHES, scene=scene, equilibria=equilibria(), dt=dt, trajectory_rate=500.0, threads=1)
        frames = r.trajectory.energies[:, : r.trajectory.frames.min()].sum(axis=2)
        gaps.append(np.abs(frames - r.energies[:, :1].sum(axis=2)).max(axis=1))
    assert np.median(gaps[0] / gaps[1]) > 4


def test_a_hop_starts_with_the_equilibriums_energy_and_loose_actuators() -> None:
    r = hops()
    start = r.energies[:, 0]
    for name in ("bars", "cables", "gravitational"):
        np.testing.assert_allclose(start[:, ENERGY_NAMES.index(name)], equilibria().energies[name], rtol=1e-12)
    assert (start[:, ENERGY_NAMES.index("actuators")] == 0).all()
    assert (start[:, KINETIC:] == 0)[:, [0, 2, 3]].all()
    np.testing.assert_array_equal(r.stored_energy, equilibria().stored_energy)


def test_dissipation_never_runs_backwards() -> None:
    """Second law, up to the half-step bookkeeping of damping: 1e-6 of the stored energy between frames."""
    r = hops()
    for hop in range(len(STRETCHES)):
        lost = r.trajectory.energies[hop, : r.trajectory.frames[hop], CONTACT:]
        assert (np.diff(lost, axis=0) > -1e-6 * r.stored_energy[hop]).all()
        assert (lost[-1] > 0).all()


def test_in_flight_the_centre_of_mass_follows_the_parabola() -> None:
    """Second differences are -g dt^2: leapfrog is exact for a constant force, rounding is 1e-16 m a step and grows by n^2."""
    for hop in range(len(STRETCHES)):
        t, centre = flight_frames(hop)
        assert len(t) > 50
        u = (t - t[0]) / (t[-1] - t[0])
        for c, acceleration in ((0, 0.0), (1, 0.0), (2, -G)):
            free = centre[:, c] - 0.5 * acceleration * (t - t[0]) ** 2
            straight = free[0] + u * (free[-1] - free[0])
            assert np.abs(free - straight).max() < 1e-9 * hops().apex[hop]


def test_take_off_and_touchdown_lie_on_that_parabola() -> None:
    """Displacement at touchdown = that of any flight frame + v t; the apex is the parabola's, start to top."""
    r = hops()
    for hop in range(len(STRETCHES)):
        t, centre = flight_frames(hop)
        start = centre_of_mass(STRUCTURE, equilibria().positions[hop])
        velocity = r.takeoff_velocity[hop]
        down = centre[-1, :2] - start[:2] + velocity[:2] * (r.touchdown_time[hop] - t[-1])
        np.testing.assert_allclose(r.touchdown[hop], down, rtol=0, atol=1e-9)
        # the velocity at take-off and the height at the middle of that step meet to g dt^2/8
        since = t - r.takeoff_time[hop]
        top = (centre[:, 2] - velocity[2] * since + 0.5 * G * since**2).mean() + velocity[2] ** 2 / (2 * G) - start[2]
        assert r.apex[hop] == pytest.approx(top, abs=G * r.dt**2)
        assert (centre[:, 2] - start[2]).max() <= r.apex[hop] + 1e-9


def test_in_flight_nothing_touches_the_ground_and_at_touchdown_something_does() -> None:
    r = hops()
    for hop in range(len(STRETCHES)):
        times = r.trajectory.times[hop, : r.trajectory.frames[hop]]
        lowest = r.trajectory.positions[hop, : len(times), :, 2].min(axis=1)
        inside = (times > r.takeoff_time[hop] + r.dt) & (times < r.touchdown_time[hop] - r.dt)
        assert (lowest[inside] > 0).all()
        after = np.flatnonzero(times > r.touchdown_time[hop])[0]
        assert lowest[after] < 0.02  # m; within one frame of 4 ms of the ground


def test_take_off_and_touchdown_are_when_a_plain_loop_sees_them() -> None:
    """The hop again, step by step: positions are of n dt; contact is where the lowest mass's straight path meets z = 0."""
    hop, r = 2, hops()
    x, dt, ground = equilibria().positions[hop].copy(), r.dt, EARTH.ground
    v, f, losses, memory = np.zeros_like(x), np.zeros_like(x), np.zeros(3), np.zeros(STRUCTURE.n_axial_members)
    lengths, done, seen = STRUCTURE.actuator_length, 0, []
    for event in (r.takeoff_time[hop], r.touchdown_time[hop]):
        near = int(event / dt) - 20
        kernels.advance(STRUCTURE, lengths, ground, dt, dt if done else 0.5 * dt, near - done, x, v, f, memory, losses)
        done = near
        for _ in range(40):
            before = x[:, 2].min()
            kernels.advance(STRUCTURE, lengths, ground, dt, dt, 1, x, v, f, memory, losses)
            done += 1
            after = x[:, 2].min()
            if (before > 0) != (after > 0):
                seen.append((done, before, after))
    (took_off, depth, height), (landed, before, after) = seen[0], seen[-1] if len(seen) == 2 else seen[1]
    assert height > 0 >= after
    ground_share = depth / (depth - height)
    assert r.takeoff_time[hop] == pytest.approx((took_off - 1 + ground_share) * dt, rel=1e-12)
    assert r.touchdown_time[hop] == pytest.approx((landed - 1 + before / (before - after)) * dt, rel=1e-12)


@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_momentum_and_angular_momentum_of_a_lattice_in_space(spin: float) -> None:
    """Released from compression without ground or gravity: P and L about the centre keep to 1e-9 while it vibrates.

    Leapfrog keeps L for central forces; damping along members and in hinges is internal too. L is read at the velocities'
    half step, positions drawn back to it.
    """
    x = equilibria().positions[1] + [0, 0, 5.0]
    v = np.cross([0.3 * spin, spin, -spin], x - centre_of_mass(STRUCTURE, x)) + [0.2, 0, 0.1]
    dt, f, losses = 1.5e-5, np.zeros_like(x), np.zeros(3)
    memory, space = np.zeros(STRUCTURE.n_axial_members), Ground(np.zeros(3), 0.0, 0.0)
    kernels.advance(STRUCTURE, STRUCTURE.actuator_length, space, dt, 0.5 * dt, 1, x, v, f, memory, losses)

    def momenta() -> tuple[np.ndarray, np.ndarray, float]:
        middle = x - 0.5 * dt * v
        arm = middle - centre_of_mass(STRUCTURE, middle)
        moments = np.cross(arm, STRUCTURE.mass[:, None] * v)
        return (STRUCTURE.mass[:, None] * v).sum(axis=0), moments.sum(axis=0), float(np.abs(moments).sum())

    before = momenta()
    largest = 0.0
    for _ in range(20):
        kernels.advance(STRUCTURE, STRUCTURE.actuator_length, space, dt, dt, 200, x, v, f, memory, losses)
        after = momenta()
        largest = max(largest, after[2])
        assert np.abs(after[0] - before[0]).max() < 1e-9 * MASS * np.abs(v).max()
        assert np.abs(after[1] - before[1]).max() < 1e-9 * largest
    assert losses[0] > 1.0  # joules: it did vibrate


@pytest.mark.parametrize("fidelity", ["paper", "flown"])
def test_a_hop_has_the_same_bits_whatever_runs_beside_it(fidelity: str) -> None:
    """Alone, in another order, over two threads, without frames; here for the first 0.15 s, take-off included.

    Flown hops are begun in an order of their own, what stores least first.
    """
    short, e = Scene(duration=0.15), equilibria()
    whole = simulate(STRETCHES, scene=short, equilibria=e, threads=1, fidelity=fidelity, trajectory_rate=100.0)
    order = [5, 2, 7, 0, 1, 3, 4, 6] * 2
    runs = {
        "alone": ([3], 1),
        "reversed": ([7, 6, 5, 4, 3, 2, 1, 0], 1),
        "two threads": (order, 2),
    }
    for name, (rows, threads) in runs.items():
        r = simulate(STRETCHES[rows], scene=short, equilibria=subset(e, rows), threads=threads, fidelity=fidelity)
        for field in ("rest", "rest_nodes", "apex", "takeoff_time", "takeoff_velocity", "end_time", "status", "steps"):
            np.testing.assert_array_equal(getattr(r, field), getattr(whole, field)[rows], err_msg=f"{name}: {field}")
        np.testing.assert_array_equal(r.energies[:, :, CONTACT:], whole.energies[rows][:, :, CONTACT:])


@pytest.mark.parametrize(("n", "threads"), [(0, 2), (1, 2), (33, 1), (64, 2), (80, 3)])
def test_shares_begin_with_what_the_order_begins_with(n: int, threads: int) -> None:
    cut = shares(n, threads, 8)
    order = dealt(np.arange(n), len(cut))
    np.testing.assert_array_equal(np.sort(order), np.arange(n))
    if n == 64:  # two equal shares
        np.testing.assert_array_equal([order[first] for first, _ in cut], [0, 1])


def test_a_queued_hop_starts_afresh_in_a_used_lane() -> None:
    """Twelve hops in eight lanes: the last four enter lanes where others ended, and must not notice."""
    rows = list(range(8)) + [0, 1, 2, 3]
    r = simulate(STRETCHES[rows], scene=Scene(duration=0.05), equilibria=subset(equilibria(), rows), threads=1)
    for field in ("rest", "apex", "energies", "steps", "end_time"):
        first, again = getattr(r, field)[:4], getattr(r, field)[8:]
        np.testing.assert_allclose(first, again, rtol=1e-14, atol=0, err_msg=field)
    np.testing.assert_array_equal(r.rest[:4], r.rest[8:])


@pytest.mark.parametrize("element", [1, 2, 3])
def test_permuted_stretches_land_at_the_image(element: int) -> None:
    """d(s)[x, y] = signs * d(s[symmetry]): starts agree to 1e-8 m, and flight amplifies that by some hundreds (docs/physics.md).

    Only touchdown: after it, tumbling amplifies round-off a million times.
    """
    signs = LATTICE.symmetry_signs[element]
    r = hops()
    image = r.touchdown[4 + element] * signs
    np.testing.assert_allclose(r.touchdown[1], image, rtol=0, atol=1e-5)
    assert r.apex[1] == pytest.approx(r.apex[4 + element], abs=1e-5)
    assert np.linalg.norm(r.touchdown[1]) > 5e-3  # it does go somewhere


def test_on_the_moon_it_rises_by_the_ratio_of_gravities_and_a_little_more() -> None:
    """h = v^2/2g with v^2 larger by what lifting costs less: m (g_earth - g_moon) times the rise at take-off, < l, of energy."""
    moon = Scene.preset("moon", duration=7.5, landing="touchdown")
    r = simulate(STRETCHES[:1], scene=moon, threads=1)
    ratio = G / moon.gravity
    high = r.takeoff_velocity[0, 2] ** 2 / (2 * moon.gravity)
    low = hops().takeoff_velocity[0, 2] ** 2 / (2 * G)
    assert high > ratio * low
    assert high < ratio * (low + DESIGN.cell_height)
    assert r.status[0] <= HopStatus.TIME_LIMIT
    # ballistic: 2 v/g and the fall from the height of take-off to that of touchdown, which is no more than l
    slowest = 2 * r.takeoff_velocity[0, 2] / moon.gravity
    assert abs(r.flight_time[0] - slowest) < DESIGN.cell_height / r.takeoff_velocity[0, 2]
    assert np.abs(r.touchdown[0]).max() < 1e-6


def test_too_much_gravity_is_no_flight() -> None:
    """Stored 0.1 J cannot lift 200 N by a millimetre's take-off: it stays, and says so."""
    r = simulate(np.full(4, 0.8), scene=Scene(gravity=200.0, duration=0.2), threads=1)
    assert r.status.tolist() == [HopStatus.NO_FLIGHT]
    assert r.flight_time.tolist() == [0.0]
    assert (r.takeoff_velocity == 0).all()
    assert np.isfinite(r.landing).all()


def test_an_equilibrium_that_was_not_found_is_not_simulated_and_disturbs_nobody() -> None:
    rows, short = [0, 1, 2, 3], Scene(duration=0.05)
    good = subset(equilibria(), rows)
    bad = replace(good, converged=np.array([True, False, True, True]))
    r, expected = (simulate(STRETCHES[rows], scene=short, equilibria=e, threads=1) for e in (bad, good))
    assert r.status[1] == HopStatus.NOT_CONVERGED
    assert r.failed.tolist() == [False, True, False, False]
    assert r.landing[1].tolist() == [0.0, 0.0]
    for k in (0, 2, 3):
        np.testing.assert_array_equal(r.rest[k], expected.rest[k])
        np.testing.assert_array_equal(r.energies[k, :, CONTACT:], expected.energies[k, :, CONTACT:])


def test_a_step_far_above_the_critical_one_is_unstable_and_says_so() -> None:
    scene = Scene(duration=0.1)
    with pytest.raises(InvalidParameterError, match=r"dt = .* is above the critical step"):
        simulate(STRETCHES[:2], scene=scene, equilibria=subset(equilibria(), [0, 1]), dt=6e-5)
    r = simulate(STRETCHES[:2], scene=scene, equilibria=subset(equilibria(), [0, 1]), dt=6e-5, allow_unstable=True)
    assert (r.status == HopStatus.UNSTABLE).all()
    assert r.landing.tolist() == [[0.0, 0.0], [0.0, 0.0]]
    for field in ("rest", "touchdown", "apex", "takeoff_velocity", "energies", "end_time"):
        assert np.isfinite(getattr(r, field)).all(), field


def test_a_hop_that_hardly_takes_off_jumps() -> None:
    """The command in docs/physics.md: a thousandth less in one stretch, and a foot touches again while the body still rises.

    Both leave the ground at the same time and speed; the one falls back at once, the other tumbles on and lands far off.
    """
    page = (Path(__file__).parent.parent / "docs" / "physics.md").read_text(encoding="utf-8")
    command = re.search(r"tensegrity_gym hop --stretches ([\d. ]+)`", page)
    assert command
    one = np.array(command[1].split(), dtype=float)
    scene, followed = Scene.preset("earth", landing="touchdown"), Fidelity(stop="landing")
    r = simulate([one, one - [0.001, 0, 0, 0]], scene=scene, fidelity=followed, threads=1)
    np.testing.assert_allclose(r.takeoff_time, 0.42, rtol=0, atol=0.01)
    assert (r.takeoff_velocity[:, 2] < 0.3).all()  # which ballistic flight would outlast by 0.06 s
    assert r.flight_time[0] < 0.05
    assert r.flight_time[1] > 0.5
    near, far = np.linalg.norm(r.touchdown, axis=1)
    assert near < 0.1
    assert far > near + 0.3


@pytest.mark.parametrize("landing", ["rest", "touchdown"])
def test_landing_is_read_where_the_scene_says(landing: str) -> None:
    r = simulate(STRETCHES[3], scene=Scene(duration=1.2, landing=landing), equilibria=subset(equilibria(), [3]), threads=1)
    np.testing.assert_array_equal(r.landing, getattr(r, landing))
    assert np.linalg.norm(r.rest - r.touchdown) > 1e-4


def test_the_nodes_at_the_end_are_those_that_displacements_are_read_from() -> None:
    result = hops()
    assert result.end_nodes.shape == (len(STRETCHES), LATTICE.n_nodes, 3)
    moved = (result.end_nodes - result.start_positions[:, : LATTICE.n_nodes]).mean(axis=1)
    np.testing.assert_allclose(moved[:, :2], result.rest_nodes, atol=1e-12)


def test_frames_come_at_the_asked_rate_and_time() -> None:
    r = hops()
    for hop in range(len(STRETCHES)):
        t = r.trajectory.times[hop, : r.trajectory.frames[hop]]
        np.testing.assert_allclose(np.diff(t), 1 / 250.0, rtol=32 * r.dt * 250.0)  # frames come every whole number of strides
        assert t[-1] <= r.end_time[hop] + r.dt
        assert t[-1] > r.end_time[hop] - 2 / 250.0
    assert simulate(STRETCHES[0], scene=Scene(duration=0.01), threads=1).trajectory is None


def test_progress_counts_every_hop() -> None:
    seen: list[int] = []
    e = subset(equilibria(), [0, 1, 2])
    simulate(STRETCHES[:3], scene=Scene(duration=0.01), equilibria=e, progress=seen.append, threads=1)
    assert sum(seen) == 3


@pytest.mark.parametrize("name", ["dt", "trajectory_rate"])
@pytest.mark.parametrize("value", [0.0, -1e-5, np.nan, np.inf, "fast", True])
def test_steps_and_rates_that_cannot_be_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(InvalidParameterError, match=rf"expected {name} to be a finite number > 0, got"):
        simulate(STRETCHES[0], equilibria=subset(equilibria(), [0]), **{name: value})  # type: ignore[arg-type]


def test_bad_stretches_are_refused_before_anything_runs() -> None:
    with pytest.raises(InvalidStretchesError, match="expected finite values"):
        simulate([0.3, 0.3, 0.3, 0.95])
    with pytest.raises(InvalidStretchesError, match=r"expected shape \(1,\)"):
        simulate(np.full(4, 0.3), lattice=Lattice(1, 1))


@pytest.mark.parametrize("fidelity", ["paper", "flown"])
def test_an_empty_batch_is_an_empty_result(fidelity: str) -> None:
    r = simulate(np.empty((0, 4)), scene=Scene(duration=0.1), fidelity=fidelity, trajectory_rate=100.0)
    assert (r.landing.shape, r.energies.shape, r.failed.shape) == ((0, 2), (0, 4, 7), (0,))
    assert r.trajectory is not None
    assert r.trajectory.positions.shape[0] == 0
    assert r.describe_failures() == []


@pytest.mark.parametrize(
    ("scene", "fix"), [("earth", r"use Scene.preset\('earth'\)"), ("venus", r"of \['earth', "), ({"gravity": 9.8}, "use Scene")]
)
def test_scenes_that_are_none_are_refused_by_name(scene: Any, fix: str) -> None:
    calls: dict[str, Callable[[], object]] = {
        "simulate": lambda: simulate(STRETCHES[0], scene=scene),
        "form_find": lambda: form_find(STRETCHES[0], scene=scene),
        "drop": lambda: drop((0.0, 0.0, 0.0), scene=scene),
    }
    for name, call in calls.items():
        with pytest.raises(InvalidParameterError, match=rf"{name}: expected scene to be a Scene or None, got .*{fix}"):
            call()


def test_other_lattices_hop() -> None:
    for lattice in (Lattice(1, 1), Lattice(2, 1)):
        r = simulate(np.full(lattice.n_cells, 0.3), lattice=lattice, scene=Scene(duration=1.6), threads=1)
        assert r.status[0] <= HopStatus.TIME_LIMIT
        total = r.energies.sum(axis=2)
        assert (np.abs(total - total[:, :1]) < 1e-3 * r.stored_energy).all()


@pytest.mark.parametrize("fidelity", ["paper", "flown"])
def test_a_hop_that_has_not_come_down_says_so(fidelity: str) -> None:
    """Its touchdown is where it was: an answer to no question about landings."""
    r = simulate(STRETCHES[:2], scene=Scene(gravity=1.62, duration=0.3), fidelity=fidelity, threads=1)
    assert r.status.tolist() == [HopStatus.IN_FLIGHT] * 2
    assert not r.failed.any()
    assert (r.takeoff_velocity[:, 2] > 0).all()
    np.testing.assert_allclose(r.touchdown_time, 0.3, atol=1e-3)


def test_equilibria_of_something_else_are_refused() -> None:
    def refused(said: str, equilibria: Equilibria, **options: Any) -> None:
        with pytest.raises(InvalidParameterError, match=said):
            simulate(STRETCHES[:1], equilibria=equilibria, **options)

    own = subset(equilibria(), [0])
    refused(r"under 1\.625 m/s\^2 along the ground's normal, got some under 9\.80665", own, scene=Scene.preset("moon"))
    refused("a design with prestrain 0.002, got some with prestrain 0.0005", own, design=Design(prestrain=2e-3))
    refused(r"equilibria of Lattice\(nx=4, ny=1\), got some of Lattice\(nx=2, ny=2\)", own, lattice=Lattice(4, 1))
    short = Scene(duration=0.01)
    simulate(STRETCHES[:1], equilibria=own, design=Design(bar_damping=0.0), scene=short, threads=1)  # which rest does not know
    steep = Scene(slope=0.1, gravity=G / np.cos(0.1), duration=0.01)
    simulate(STRETCHES[:1], equilibria=own, scene=steep, threads=1)  # friction holds the rest


def test_what_is_no_design_lattice_or_start_is_refused_by_name() -> None:
    for call in (simulate, form_find):
        for name, value in (("design", {"prestrain": 1e-3}), ("lattice", (2, 2))):
            with pytest.raises(InvalidParameterError, match=rf"{call.__name__}: expected a {name.title()} or None, got"):
                call(STRETCHES[0], **{name: value})  # type: ignore[arg-type]
    with pytest.raises(InvalidParameterError, match="form_find: expected a SearchOptions or None, got"):
        form_find(STRETCHES[0], options={"tolerance": 1e-6})  # type: ignore[arg-type]
    with pytest.raises(InvalidParameterError, match="form_find: expected start of"):
        form_find(STRETCHES[0], start="abc")  # type: ignore[arg-type]
    with pytest.raises(InvalidStretchesError, match="expected numbers"):
        form_find(STRETCHES[0] + 0.1j)
    with pytest.raises(InvalidParameterError, match="threads: expected an integer or None, got 'x'"):
        simulate(STRETCHES[0], threads="x")  # type: ignore[arg-type]


def test_drops_are_not_told_of_options_that_they_have_not() -> None:
    with pytest.raises(InvalidParameterError, match=r"^drop: dt = 0.001 s is above the critical step .* use dt <= [-\de.]+$"):
        drop([0, 0, -5], dt=1e-3)
    with pytest.raises(InvalidParameterError, match=r"^drop: expected trajectory_rate"):
        drop([0, 0, -5], trajectory_rate=-1.0)


@pytest.mark.parametrize("fidelity", [Fidelity(), Fidelity(flight="rigid")])
def test_progress_counts_hops_that_never_begin_or_end_early(fidelity: Fidelity) -> None:
    e = subset(equilibria(), [0, 1, 2])
    lost = replace(e, converged=np.array([True, False, False]))
    seen: list[int] = []
    simulate(STRETCHES[:3], equilibria=lost, scene=Scene(duration=0.02), fidelity=fidelity, progress=seen.append, threads=1)
    assert sum(seen) == 3


def test_threads_are_counted_where_no_system_tells_which_cores_are_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("os.sched_getaffinity")  # as on macOS and Windows
    monkeypatch.setattr("os.cpu_count", lambda: 6)
    assert thread_count(None) == 6
    assert thread_count(2) == 2
