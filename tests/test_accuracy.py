"""The accuracy benchmark's own yardsticks against closed forms: the elastica, the witness, its contact events, its limits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import naive
import numpy as np
import pytest

from benchmarks.accuracy import bars, floor, stability
from benchmarks.accuracy.part import Options, Part, kept, table
from benchmarks.accuracy.samples import hop_perturbed, stretches
from benchmarks.accuracy.stepping import forces
from benchmarks.accuracy.witness import EventHop, Witness
from tensegrity_gym import Design, Lattice, Scene, form_find
from tensegrity_gym.types import Ground

G = 9.80665


@pytest.mark.parametrize(("shortening", "load"), [(0.01, 1.00503), (0.1, 1.05299), (0.3, 1.18070), (0.5, 1.34945)])
def test_elastica_is_the_literatures(shortening: float, load: float) -> None:
    """(2K/pi)^2 at 2 - 2E/K, tabulated to five digits (Timoshenko and Gere, Theory of Elastic Stability, 2.7)."""
    assert bars.elastica(shortening)[0] == pytest.approx(load, abs=1e-5)


@pytest.mark.parametrize("shortening", [0.05, 0.4])
def test_the_thirds_bar_follows_its_own_closed_form(shortening: float) -> None:
    """P/P_cr = theta/sin theta; axial strain of 3e-5 and the geometry it changes stay below 1e-4."""
    load, bow = bars.buckled(Design(), shortening)
    theta = np.arccos(1 - 1.5 * shortening)
    assert load == pytest.approx(theta / np.sin(theta), rel=1e-4)
    assert bow == pytest.approx(np.sin(theta) / 3, rel=1e-3)


@pytest.mark.parametrize("segments", [2, 3, 9])
def test_buckling_loads_of_a_chain_of_rigid_links(segments: int) -> None:
    """P_k = (4 kappa / a) sin^2(k pi / 2n), the first of which is Euler's: the second is 4 cos^2(pi / 2n) of it."""
    from scipy.linalg import eigh

    design = replace(Design(), bar_segments=segments)
    stiffness, geometric, _ = bars.bending_matrices(design)
    loads = np.sort(1 / eigh(geometric, stiffness, eigvals_only=True)) / design.critical_load
    expected = [1.0, 4 * np.cos(np.pi / (2 * segments)) ** 2][: segments - 1]
    np.testing.assert_allclose(loads[:2], expected, rtol=2e-3)  # the geometric part is a difference of 1e-3 of the forces


def test_the_witness_has_the_forces_of_the_twin_and_of_the_core() -> None:
    """Three codes, one law; each sums what the twin's magnitudes say, to a few eps of it."""
    lattice, design = Lattice(1, 1), Design()
    s, gravity, rng = design.structure(lattice), np.array([0.3, 0.0, -G]), np.random.default_rng(0)
    x = design.unloaded_positions(lattice) + rng.normal(0, 5e-3, (lattice.n_masses, 3))
    v = rng.normal(0, 0.5, x.shape)
    found, twin = Witness(s, gravity)(x, v), naive.forces(s, s.actuator_length, gravity, x, v)
    assert (np.abs(found - twin.f).max(axis=1) < 32 * naive.EPS * twin.magnitude).all()
    assert (np.abs(found - forces(s, x, v, gravity)).max(axis=1) < 32 * naive.EPS * twin.magnitude).all()


def block(gravity: np.ndarray, friction: float, velocity: list[float], height: float = 0.0) -> EventHop:
    """One mass of 0.3 kg on or over the ground."""
    hop = EventHop(naive.make_structure([0.3]), Ground(gravity, friction, 0.0), np.array([[0.0, 0.0, height]]))
    hop.v[0] = velocity
    hop._settle()
    return hop


def follow(hop: EventHop, time: float) -> None:
    while hop.t < time:
        hop._advance(time)
        hop._settle()


def test_events_stop_a_sliding_block_after_v_squared_over_2_mu_g() -> None:
    hop = block(np.array([0.0, 0.0, -G]), 0.4, [0.0, 0.0, 0.0])
    hop.v[0, :2], hop.mode[0] = [0.6, 0.8], 2
    follow(hop, 0.5)
    # it is held from HOLD = 1e-4 m/s on: (1e-4)^2 / 2 mu g short
    np.testing.assert_allclose(hop.x[0], [0.6 / (0.8 * G), 0.8 / (0.8 * G), 0.0], atol=1e-6)
    assert hop.v.tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_events_hold_a_block_up_to_the_angle_of_friction_and_not_beyond(factor: float) -> None:
    angle = np.arctan(0.5 * factor)
    hop = block(G * np.array([np.sin(angle), 0.0, -np.cos(angle)]), 0.5, [0.0, 0.0, 0.0])
    follow(hop, 0.2)
    acceleration = max(0.0, G * (np.sin(angle) - 0.5 * np.cos(angle)))
    assert hop.x[0, 0] == pytest.approx(0.5 * acceleration * 0.04, abs=1e-9)


def test_events_find_an_impact_at_its_instant_and_take_its_momentum() -> None:
    """Falls 0.1 m at 1 m/s sideways: lands after sqrt(2h/g), with mu v_n of its sideways speed gone."""
    hop = block(np.array([0.0, 0.0, -G]), 0.3, [1.0, 0.0, 0.0], height=0.1)
    hop._advance(1.0)
    assert hop.t == pytest.approx(np.sqrt(0.2 / G), abs=1e-12)
    hop._settle()
    np.testing.assert_allclose(hop.v[0], [1.0 - 0.3 * np.sqrt(0.2 * G), 0.0, 0.0], atol=1e-12)


def test_runge_kuttas_limits_are_the_textbooks() -> None:
    """2 sqrt 2 on the imaginary axis, 2.78529 on the real one (Hairer and Wanner, IV.2)."""
    assert stability.runge_kutta_limit(0.0) == pytest.approx(2 * np.sqrt(2), rel=1e-6)
    fastest = 5.0 + np.sqrt(24.0)  # of the two real eigenvalues at a damping ratio of 5
    assert fastest * stability.runge_kutta_limit(5.0) == pytest.approx(2.78529, rel=1e-4)


@pytest.mark.parametrize("kind", ["positions", "actuators", "material"])
def test_an_unknown_moves_a_hop_and_its_absence_does_not(kind: str) -> None:
    cell, design, scene = Lattice(1, 1), Design(), Scene(duration=0.02)
    found = form_find(stretches(2, 1), lattice=cell, design=design, scene=scene, threads=1)
    options = {"design": design, "scene": scene, "precision": "float64", "lattice": cell}
    still, same, moved = (
        hop_perturbed(k, 1, found, **options).apex  # type: ignore[arg-type]
        for k in ("none", "none", kind)
    )
    np.testing.assert_array_equal(still, same)
    assert (np.abs(moved - still) > 1e-9).all()
    assert (np.abs(moved - still) < 1e-2 * still).all()


def test_floors_elsewhere_are_of_that_scene_once_in_full_and_once_with_rigid_flights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hops made up here: a perturbed one lands 3 and 4 mm away, in full, and 30 and 40 mm with a rigid flight."""
    asked = []

    def made_up(kind: str, seed: int, found: object, *, scene: Scene, fidelity: str, **_: object) -> SimpleNamespace:
        asked.append((scene, fidelity))
        n, moved = 4, kind != "none"
        values = {name: np.full(n, 1.0 + 0.001 * moved) for name in floor.FIELDS} | {"status": np.zeros(n, int)}
        offset = moved * np.array([0.003, 0.004]) * (10 if fidelity == "flown" else 1)
        lands = dict.fromkeys(("touchdown", "rest"), np.arange(n)[:, None] + offset)
        return SimpleNamespace(**values | lands | {"takeoff_velocity": np.ones((n, 3))})

    monkeypatch.setattr(floor, "hop_perturbed", made_up)
    monkeypatch.setattr(floor, "form_find", lambda *_, **__: None)
    d = floor.measure_elsewhere(Options(quick=True, runs=tmp_path), "moon")
    assert set(asked) == {(Scene.preset("moon"), "paper"), (Scene.preset("moon", landing="touchdown"), "flown")}
    for kind in floor.KINDS:
        np.testing.assert_allclose(d[f"{kind}/touchdown"], 0.005)
        np.testing.assert_allclose(d[f"{kind}/rest"], 0.005)
        np.testing.assert_allclose(d[f"rigid/{kind}"], 0.05)
    assert [line.split() for line in floor.compare_flights(d)[2:]] == [[kind, *["10.00"] * 4] for kind in floor.KINDS]


def test_measurements_are_kept_under_their_key_and_run_once(tmp_path: Path) -> None:
    options, calls = Options(runs=tmp_path, images=tmp_path), []

    def measure() -> dict[str, np.ndarray]:
        calls.append(1)
        return {"a": np.arange(3)}

    for key in (1, 1, 2):
        np.testing.assert_array_equal(kept(options, "thing", measure, key=key)["a"], [0, 1, 2])
    assert len(calls) == 2
    Part("whole", lambda _: measure(), lambda d: table("a  b", [["1", str(d["a"].sum())]])).run(options)
    assert (tmp_path / "full" / "whole.txt").read_text().splitlines()[1:] == ["a  b", "1  3"]
