"""Rigid flight, drops and the fidelity's levers: against closed forms, against the full model, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tensegrity_gym import Design, Fidelity, HopStatus, InvalidParameterError, Lattice, Scene, drop, form_find, simulate
from tensegrity_gym.core.flight import fly_rigidly, nearest_rotation
from tensegrity_gym.energies import centre_of_mass
from tensegrity_gym.fidelity import FIDELITIES

LATTICE, DESIGN = Lattice(), Design()
STRUCTURE = DESIGN.structure(LATTICE)
SHAPE = DESIGN.unloaded_positions(LATTICE) - centre_of_mass(STRUCTURE, DESIGN.unloaded_positions(LATTICE))
MASS, G = STRUCTURE.mass, np.array([0.0, 0.0, -9.80665])
NONE, NO_FRAMES = np.zeros(0), np.zeros((0, 2, len(MASS), 3))
STRETCHES = np.random.default_rng(3).uniform(0.2, 0.6, size=(8, 4))
TOUCHDOWN = Scene(landing="touchdown")


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' matrix."""
    k = np.cross(np.eye(3), axis / np.linalg.norm(axis))
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def flying(turn: np.ndarray, spin: np.ndarray, velocity: np.ndarray, height: float) -> np.ndarray:
    """State of the unloaded lattice, turned and spinning, its centre of mass at ``height`` [m]."""
    arms = SHAPE @ turn.T
    return np.stack([arms + [0, 0, height], velocity + np.cross(spin, arms)])


def momenta(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Momentum and angular momentum about the centre of mass."""
    arms = state[0] - centre_of_mass(STRUCTURE, state[0])
    return (MASS[:, None] * state[1]).sum(axis=0), (MASS[:, None] * np.cross(arms, state[1])).sum(axis=0)


def test_nearest_rotation_is_the_polar_factor() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        a = rotation(rng.normal(size=3), rng.uniform(0, 3)) @ np.diag(rng.uniform(0.3, 3, 3)) + 0.05 * rng.normal(size=(3, 3))
        u, _, vt = np.linalg.svd(a)
        nearest_rotation(a, np.zeros((3, 3)))
        np.testing.assert_allclose(a, u @ vt, rtol=0, atol=1e-13)


@pytest.mark.parametrize("axis", np.eye(3))
def test_a_body_that_spins_about_a_principal_axis_turns_by_rate_times_time(axis: np.ndarray) -> None:
    """The 2x2 lattice's axes are principal by symmetry; 2e-9 rad are lost in a step of 0.04."""
    rate, seconds, velocity = 7.0, 0.6, np.array([0.3, -0.2, 1.0])
    turn = rotation(np.array([1.0, 0.3, -0.2]), 0.4)
    spin = rate * turn @ axis
    state = flying(turn, spin, velocity, 50.0)
    flown, landed, frames = fly_rigidly(MASS, SHAPE, G, len(MASS), state, seconds, NONE, NO_FRAMES)
    assert (flown, landed, frames) == (seconds, False, 0)
    expected = flying(rotation(spin, rate * seconds) @ turn, spin, velocity + G * seconds, 50.0)
    expected[0] += velocity * seconds + 0.5 * G * seconds**2
    np.testing.assert_allclose(state, expected, rtol=0, atol=1e-6)


def test_a_tumbling_body_keeps_momentum_angular_momentum_and_energy() -> None:
    state = flying(rotation(np.array([1.0, 2.0, 3.0]), 1.0), np.array([9.0, -4.0, 6.0]), np.zeros(3), 50.0)
    before = momenta(state)
    start = 0.5 * (MASS[:, None] * state[1] ** 2).sum()
    fly_rigidly(MASS, SHAPE, np.zeros(3), len(MASS), state, 2.0, NONE, NO_FRAMES)
    for now, then in zip(momenta(state), before, strict=True):
        np.testing.assert_allclose(now, then, rtol=0, atol=1e-12)
    assert 0.5 * (MASS[:, None] * state[1] ** 2).sum() == pytest.approx(start, rel=1e-6)  # rate from the matrix: 2e-9 a step


def test_a_falling_body_lands_when_its_lowest_mass_meets_the_ground() -> None:
    turn = rotation(np.array([1.0, 0.5, 0.2]), 0.7)
    state = flying(turn, np.zeros(3), np.array([1.0, 0.0, 2.0]), 1.5)
    lowest = state[0, :, 2].min()
    seconds = (2.0 + np.sqrt(4.0 + 2 * 9.80665 * lowest)) / 9.80665
    flown, landed, _ = fly_rigidly(MASS, SHAPE, G, len(MASS), state, 10.0, NONE, NO_FRAMES)
    assert landed
    assert flown == pytest.approx(seconds, abs=1e-9)
    assert abs(state[0, :, 2].min()) < 1e-9


@pytest.fixture(scope="module")
def hops():
    """The same hops in full and with a rigid flight, as far as touchdown."""
    equilibria = form_find(STRETCHES)
    levers = {"full": Fidelity(stop="landing"), "rigid": Fidelity(stop="landing", flight="rigid")}
    runs = {
        k: simulate(STRETCHES, scene=TOUCHDOWN, equilibria=equilibria, fidelity=f, trajectory_rate=100) for k, f in levers.items()
    }
    return equilibria, runs


def test_rigid_flight_lands_where_the_vibrating_lattice_does(hops) -> None:
    """It moves touchdown by what a foot's vibration, millimetres, changes of the flight's time."""
    _, runs = hops
    full, rigid = runs["full"], runs["rigid"]
    assert (full.status == HopStatus.STOPPED).all()
    assert (rigid.status == HopStatus.STOPPED).all()
    np.testing.assert_array_equal(rigid.takeoff_velocity, full.takeoff_velocity)
    np.testing.assert_allclose(rigid.touchdown, full.touchdown, rtol=0, atol=1e-2)
    np.testing.assert_allclose(rigid.touchdown_time, full.touchdown_time, rtol=0, atol=2e-2)
    assert (rigid.steps < full.steps / 4).all()
    assert np.isnan(rigid.rest).all()
    np.testing.assert_array_equal(rigid.landing, rigid.touchdown)


def test_frames_of_a_rigid_flight_follow_on_and_keep_the_energy(hops) -> None:
    _, runs = hops
    r = runs["rigid"]
    for hop in range(len(STRETCHES)):
        count = r.trajectory.frames[hop]
        times = r.trajectory.times[hop, :count]
        assert np.ptp(np.diff(times)) < 1e-9
        assert abs(times[-1] - r.touchdown_time[hop]) < 0.02
        total = r.trajectory.energies[hop, :count].sum(axis=1)
        assert np.abs(total - r.energies[hop, 0].sum()).max() < 1e-3 * r.stored_energy[hop]
        assert (r.trajectory.positions[hop, :count, :, 2].min(axis=1) > -1e-3).all()


def test_what_a_hop_stops_at_does_not_change_what_came_before(hops) -> None:
    equilibria, runs = hops
    whole = simulate(STRETCHES, scene=TOUCHDOWN, equilibria=equilibria)
    for name in ("touchdown", "touchdown_time", "takeoff_velocity", "apex"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(runs["full"], name), err_msg=name)
    assert np.isfinite(whole.rest).all()
    late = whole.impacts[:, 0] > whole.touchdown_time
    assert late[whole.impact_count > 0].all()


def test_rigid_hops_followed_to_rest_close_their_audit_and_come_to_rest_on_the_ground(hops) -> None:
    equilibria, runs = hops
    r = simulate(STRETCHES, scene=Scene(), equilibria=equilibria, fidelity=Fidelity(flight="rigid"), trajectory_rate=50)
    np.testing.assert_array_equal(r.touchdown, runs["rigid"].touchdown)
    total = r.energies.sum(axis=2)
    assert (np.abs(total - total[:, :1]) < 1e-3 * r.stored_energy[:, None]).all()
    assert np.isin(r.status, (HopStatus.RESTED, HopStatus.TIME_LIMIT)).all()
    assert (r.end_time <= 3.0 + 32 * r.dt).all()
    for hop in range(len(STRETCHES)):
        frames = r.trajectory.energies[hop, : r.trajectory.frames[hop]].sum(axis=1)
        assert np.abs(frames - total[hop, 0]).max() < 1e-3 * r.stored_energy[hop]
        assert (np.diff(r.trajectory.times[hop, : r.trajectory.frames[hop]]) > 0).all()


def test_a_rigid_hop_has_the_same_bits_alone(hops) -> None:
    _, runs = hops
    alone = simulate(STRETCHES[3], scene=TOUCHDOWN, fidelity=Fidelity(stop="landing", flight="rigid"))
    for name in ("landing", "touchdown_time", "takeoff_velocity"):
        np.testing.assert_array_equal(getattr(alone, name)[0], getattr(runs["rigid"], name)[3], err_msg=name)


def test_a_drop_falls_freely_and_comes_to_rest_below() -> None:
    """Touchdown after (sqrt(v^2 + 2 g h) - v) / g, with sideways drift v_x t: the lattice keeps its shape on the way."""
    height, velocity = 0.7, np.array([[0.5, 0.0, -3.0], [0.0, 0.0, 0.0]])
    r = drop(velocity, height=height, scene=Scene(duration=2.0))
    speed = -velocity[:, 2]
    seconds = (np.sqrt(speed**2 + 2 * 9.80665 * height) - speed) / 9.80665
    np.testing.assert_allclose(r.touchdown_time, seconds, rtol=0, atol=r.dt)
    np.testing.assert_allclose(r.touchdown[0], [0.5 * seconds[0], 0.0], rtol=0, atol=1e-4)
    assert np.isin(r.status, (HopStatus.RESTED, HopStatus.TIME_LIMIT)).all()
    total = r.energies.sum(axis=2)
    assert (np.abs(total - total[:, :1]) < 1e-3 * total[:, :1]).all()
    assert r.equilibria is None


@pytest.mark.parametrize("fidelity", ["paper", "flown"])
@pytest.mark.parametrize("restitution", [0.0, 0.8])
def test_a_drop_from_the_very_ground_touches_down_at_once(fidelity: str, restitution: float) -> None:
    """Height 0 is the limit of small ones: it falls for (sqrt(v^2 + 2 g h) - v) / g, and then does the same.

    At 1 um over the ground a drop at 5 m/s comes down 0.2 us later, a hundredth of a step; one let go, after 20 steps.
    """
    scene = Scene(landing="touchdown", duration=0.05, restitution=restitution)
    speed, height = np.array([5.0, 0.0]), 1e-6
    ground, near = (
        drop(np.outer(-speed, [0, 0, 1]), height=h, scene=scene, lattice=Lattice(1, 1), fidelity=fidelity, threads=1)
        for h in (0.0, height)
    )
    fall = (np.sqrt(speed**2 + 2 * 9.80665 * height) - speed) / 9.80665
    for r, seconds in ((ground, 0.0), (near, fall)):
        assert (r.takeoff_time == 0).all()
        np.testing.assert_allclose(r.touchdown_time, seconds, rtol=0, atol=0.5 * r.dt)
        assert np.abs(r.touchdown).max() < 1e-9
    np.testing.assert_array_equal(ground.status, near.status)
    assert (ground.touchdown_time <= near.touchdown_time).all()
    np.testing.assert_allclose(ground.energies[0, 2], near.energies[0, 2], rtol=0, atol=1e-3)  # at touchdown, of 9 J


def test_what_follows_a_drop_from_the_very_ground_is_what_follows_one_from_near_it() -> None:
    """The same steps but for the time of the first impact, 0.2 us: what rebounds differs by what 1 um at the start may do."""
    scene = Scene(duration=0.05, restitution=0.5)
    ground, near = (drop([0.3, 0, -5.0], height=h, scene=scene, lattice=Lattice(1, 1), threads=1) for h in (0.0, 1e-6))
    np.testing.assert_allclose(ground.rest, near.rest, rtol=0, atol=1e-3)
    np.testing.assert_allclose(ground.energies[:, 2], near.energies[:, 2], rtol=0, atol=1e-3)
    assert np.abs(ground.energies.sum(axis=2) - ground.energies[:, :1].sum(axis=2)).max() < 1e-2


@pytest.mark.parametrize("fidelity", ["paper", "flown"])
def test_a_drop_is_highest_where_it_stops_rising_or_at_its_start(fidelity: str) -> None:
    """v^2/2g above the start and v/g after the release where it is thrown upwards; where it only falls, its start."""
    speed = np.array([2.0, 0.0, -5.0])
    scene = Scene(duration=0.25, landing="touchdown")
    r = drop(np.outer(speed, [0, 0, 1]), height=0.5, scene=scene, lattice=Lattice(1, 1), fidelity=fidelity, threads=1)
    rising = np.maximum(speed, 0.0)
    np.testing.assert_allclose(r.apex, rising**2 / (2 * 9.80665), rtol=0, atol=1e-6)
    np.testing.assert_allclose(r.apex_time, rising / 9.80665, rtol=0, atol=1e-6)
    assert (r.apex_time <= r.touchdown_time).all()


def test_a_turned_drop_falls_turned() -> None:
    """Attitude and spin as Rodrigues' matrix has them; a lattice that spins at 2 rad/s bulges by less than 0.1 mm."""
    axis, rate = np.array([1.0, 2.0, -0.5]), 2.0
    axis /= np.linalg.norm(axis)
    half = 0.4
    r = drop([0, 0, 0], height=1, attitude=[np.cos(half), *(np.sin(half) * axis)], spin=rate * axis, scene=Scene(duration=0.05),
             trajectory_rate=200)  # fmt: skip
    time, positions = r.trajectory.times[0, 3], r.trajectory.positions[0, 3]
    arms = positions - centre_of_mass(STRUCTURE, positions)
    # the axis is no principal one: it precesses by about (rate t)^2 = 1e-3
    np.testing.assert_allclose(arms, SHAPE @ rotation(axis, 2 * half + rate * time).T, rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocity": [0, 0]}, "velocity finite, of shape"),
        ({"velocity": [0, 0, np.nan]}, "velocity finite"),
        ({"velocity": ["a", 0, -1]}, r"velocity as an array of finite numbers, got \['a', 0, -1\]"),
        ({"velocity": [[0, 0, 1], [0, 0]]}, "velocity as an array of finite numbers"),
        ({"velocity": [0, 0, 1], "spin": {"x": 1.0}}, "spin as an array of finite numbers"),
        ({"velocity": [0, 0, 1], "height": -1.0}, "height to be a finite number >= 0"),
        ({"velocity": [0, 0, 1], "height": "1"}, "height to be a finite number >= 0 .* got '1'"),
        ({"velocity": [0, 0, 1], "height": np.array([1.0, 2.0])}, "height to be a finite number >= 0 .* got array"),
        ({"velocity": [0, 0, 1], "height": np.nan}, "height to be a finite number >= 0"),
        ({"velocity": [0, 0, 1], "fidelity": "auto"}, r"one of \('paper', 'single', 'flown', 'reference'\), got 'auto'"),
        ({"velocity": [0, 0, 1], "fidelity": "papr"}, r"one of \('paper', 'single', 'flown', 'reference'\), got 'papr'"),
        ({"velocity": [0, 0, 1], "attitude": [1, 1, 0, 0]}, "unit quaternions"),
        ({"velocity": [0, 0, 1], "spin": [[0, 0, 0]] * 3, "attitude": [[1, 0, 0, 0]] * 2}, "attitude finite, of shape"),
    ],
)
def test_bad_drops_are_refused(change: dict, message: str) -> None:
    with pytest.raises(InvalidParameterError, match=message):
        drop(**change)


@pytest.mark.parametrize(
    ("levers", "message"),
    [
        ({"integrator": "euler"}, "integrator: expected one of"),
        ({"flight": "ballistic"}, "flight: expected one of"),
        ({"step": 0.0}, "step: expected a finite number > 0"),
        ({"bar_softening": 0.5}, "bar_softening: expected a finite number >= 1"),
        ({"bar_segments": 0}, "bar_segments: expected an integer >= 1"),
        ({"bar_segments": 2.5}, "bar_segments: expected an integer >= 1"),
        ({"clearance": -1}, "clearance: expected a finite number >= 0"),
    ],
)
def test_bad_levers_are_refused(levers: dict, message: str) -> None:
    with pytest.raises(InvalidParameterError, match=message):
        Fidelity(**levers)


def test_a_fidelity_says_what_it_is_in_one_line() -> None:
    for fidelity in (
        *FIDELITIES.values(),
        Fidelity(bar_segments=5, bar_softening=4, flight="rigid", contact="nodes", stop="landing"),
    ):
        assert "\n" not in str(fidelity)
    assert "paper" in str(FIDELITIES["paper"])
    assert str(replace(FIDELITIES["paper"], reason="why")).endswith("(why)")
    with pytest.raises(InvalidParameterError, match="fidelity: expected a Fidelity or one of"):
        simulate(STRETCHES[0], fidelity="papr")


def test_bars_of_another_fidelity_need_their_own_equilibria(hops) -> None:
    equilibria, _ = hops
    five = Fidelity(bar_segments=5)
    with pytest.raises(
        InvalidParameterError,
        match="expected equilibria of a design with bar_segments 5, got some with bar_segments 3; find them",
    ):
        simulate(STRETCHES, equilibria=equilibria, fidelity=five)
    own = form_find(STRETCHES[:2], design=five.design(DESIGN))
    r = simulate(STRETCHES[:2], equilibria=own, fidelity=five, scene=Scene(duration=0.1))
    assert (r.status == HopStatus.IN_FLIGHT).all()


def test_a_step_past_the_critical_one_is_refused_as_a_lever_too() -> None:
    with pytest.raises(InvalidParameterError, match="above the critical step"):
        simulate(STRETCHES[0], fidelity=Fidelity(step=1.1))


def test_softened_bars_keep_the_buckling_load_and_the_unloaded_shape() -> None:
    soft = Fidelity(bar_softening=16).design(DESIGN)
    assert soft.critical_load == DESIGN.critical_load
    assert soft.bar_rigidity == DESIGN.bar_rigidity / 16
    np.testing.assert_array_equal(soft.unloaded_positions(LATTICE), DESIGN.unloaded_positions(LATTICE))
    np.testing.assert_allclose(soft.structure(LATTICE).hinge_stiffness, STRUCTURE.hinge_stiffness)


def test_contact_at_nodes_lets_bars_through_the_ground() -> None:
    """The bars of a lattice that falls flat bow downwards, and nothing stops their inner masses."""
    r = {
        c: drop([0, 0, -6.0], scene=Scene(duration=0.3), fidelity=Fidelity(contact=c), trajectory_rate=400)
        for c in ("all", "nodes")
    }
    inner = slice(LATTICE.n_nodes + 2 * LATTICE.n_cells, None)
    lowest = {c: run.trajectory.positions[0, : run.trajectory.frames[0], inner, 2].min() for c, run in r.items()}
    assert lowest["nodes"] < lowest["all"]
    assert lowest["all"] > -1e-3
