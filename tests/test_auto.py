"""The cheapest model that holds a tolerance: from a stored calibration, from a pilot, and when nothing does."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tensegrity_gym import (
    Design,
    Fidelity,
    InvalidParameterError,
    Lattice,
    Scene,
    UnknownPresetError,
    auto,
    calibration,
    form_find,
    simulate,
)
from tensegrity_gym.auto import _suits, choose_fidelity, pilot, preset_of
from tensegrity_gym.calibration import LADDER, Calibration, Rung, calibrate, save_calibration, stored_calibration
from tensegrity_gym.fidelity import FIDELITIES
from tensegrity_gym.specimen import Specimen

TOUCHDOWN = Scene(landing="touchdown")
CHEAP, MIDDLE, DEAR = Fidelity(bar_softening=16.0), Fidelity(precision="float32"), Fidelity()
KNOWN = Calibration(2e-3, (Rung(CHEAP, 0.1, 5e-3, 2e-2), Rung(MIDDLE, 0.3, 3e-4, 1.5e-3), Rung(DEAR, 1.0, 1e-4, 1e-3)), 64)


@pytest.fixture
def stored(monkeypatch: pytest.MonkeyPatch) -> None:
    """A calibration known by heart in place of the package's."""
    monkeypatch.setattr(auto, "stored_calibration", lambda name, landing: KNOWN)


@pytest.mark.parametrize(
    ("tolerance", "expected"), [(None, MIDDLE), (1.0, CHEAP), (2e-2, CHEAP), (1.99e-2, MIDDLE), (1.2e-3, DEAR), (1e-4, None)]
)
def test_the_cheapest_model_within_the_tolerance_is_taken(
    stored: None, tolerance: float | None, expected: Fidelity | None
) -> None:
    chosen = choose_fidelity(Design(), TOUCHDOWN, Lattice(), tolerance)
    assert chosen == (expected or FIDELITIES["reference"])
    assert "\n" not in str(chosen)
    assert ("floor" in chosen.reason) == (tolerance is None)
    assert ("nothing cheaper is known" in chosen.reason) == (expected is None)


@pytest.mark.parametrize("tolerance", [0.0, -1.0, np.nan, np.inf, True, "x", np.array([1e-3, 1e-2])])
def test_a_tolerance_that_is_none_is_refused(stored: None, tolerance: float) -> None:
    with pytest.raises(InvalidParameterError, match="expected tolerance to be a finite number > 0"):
        choose_fidelity(Design(), TOUCHDOWN, Lattice(), tolerance)


def test_a_tolerance_belongs_to_auto() -> None:
    with pytest.raises(InvalidParameterError, match="expected a tolerance only with fidelity='auto'"):
        simulate(np.full(4, 0.5), tolerance=0.1)


def test_levers_override_the_choice(stored: None) -> None:
    r = simulate(np.full(4, 0.8), scene=TOUCHDOWN, fidelity="auto", tolerance=1.0, precision="float32")
    assert r.fidelity.precision == "float32"
    assert r.fidelity.bar_softening == 16.0
    assert r.fidelity.reason.startswith("auto")
    assert r.fidelity.reason.endswith("then by hand: precision")


def test_presets_are_known_wherever_their_landing_is_read() -> None:
    for name in Scene.PRESETS:
        assert preset_of(Scene.preset(name, landing="touchdown")) == name
    assert preset_of(Scene(gravity=9.0)) is None
    assert preset_of(Scene(duration=2.0)) is None


@pytest.mark.parametrize("preset", sorted(Scene.PRESETS))
@pytest.mark.parametrize("landing", ["rest", "touchdown"])
def test_the_package_knows_its_presets(preset: str, landing: str) -> None:
    """A calibration of this version of the physics, with rungs by cost; a model of more precision is no farther off."""
    found = stored_calibration(preset, landing)
    assert found is not None
    costs = [rung.cost for rung in found.rungs]
    assert costs == sorted(costs)
    assert {rung.fidelity for rung in found.rungs} == set(LADDER[landing])
    assert all(0 <= rung.median <= rung.error for rung in found.rungs)
    assert found.floor > 0
    soft, stiff = (next(r for r in found.rungs if r.fidelity == m) for m in (LADDER[landing][0], LADDER[landing][-1]))
    assert stiff.median < soft.median
    assert stiff.cost > soft.cost


def test_a_calibration_comes_back_from_its_file_and_one_of_other_physics_does_not(tmp_path, monkeypatch) -> None:
    path = save_calibration("moon", {"touchdown": KNOWN}, 1, tmp_path)
    assert stored_calibration("moon", "touchdown", tmp_path) == KNOWN
    assert stored_calibration("moon", "rest", tmp_path) is None
    content = json.loads(path.read_text())
    assert "--scene moon" in content["command"]
    path.write_text(json.dumps(content | {"model_version": "0"}))
    stored_calibration.cache_clear()
    assert stored_calibration("moon", "touchdown", tmp_path) is None
    with pytest.raises(UnknownPresetError, match="expected one of"):
        stored_calibration("pluto", "rest")


def test_calibration_measures_what_a_model_costs_and_how_far_off_it_is() -> None:
    """The reference itself is at distance 0, a coarser step further off, and softer bars further still; it repeats its bits."""
    to_landing = Fidelity(stop="landing")
    models = (replace(to_landing, bar_softening=16.0), to_landing, replace(calibration.REFERENCE, stop="landing"))
    how = {"lattice": Lattice(2, 1), "ladder": {"touchdown": models}, "unknowns": 2}
    done: list[int] = []
    first = calibrate(Scene(), 8, progress=done.append, **how)["touchdown"]
    again = calibrate(Scene(), 8, **how)["touchdown"]
    assert sum(done) == 2 + 2 + 3
    by = {rung.fidelity: rung for rung in first.rungs}
    soft, paper, exact = (by[m] for m in models)
    assert exact.error == 0
    assert 0 < paper.median < soft.median
    assert soft.cost < paper.cost < exact.cost
    assert first.floor == again.floor
    assert {r.fidelity: r.error for r in first.rungs} == {r.fidelity: r.error for r in again.rungs}


def test_time_is_taken_of_kernels_that_have_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lone hop runs kernels of its own, without lanes: warmed up are as many hops, on as many threads, as are timed."""
    asked: dict[str, list[tuple]] = {"form_find": [], "hop": []}
    form, follow = calibration.form_find, calibration.hop

    def noted_form_find(stretches, **how):
        asked["form_find"].append((how["design"], len(stretches), how["threads"]))
        return form(stretches, **how)

    def noted_hop(found, **how):
        kernel = replace(how["fidelity"], clearance=0.0)
        asked["hop"].append((how["scene"].duration, kernel, len(found.stretches), how["threads"]))
        return follow(found, **how)

    monkeypatch.setattr(calibration, "form_find", noted_form_find)
    monkeypatch.setattr(calibration, "hop", noted_hop)
    single = Fidelity(precision="float32", stop="landing")
    models = (single, replace(single, flight="rigid"), Fidelity(stop="landing"))
    calibrate(Scene(duration=0.5), 5, lattice=Lattice(1, 1), ladder={"touchdown": models}, unknowns=1, threads=2)
    kernels = {(replace(model, clearance=0.0), 5, 2) for model in models}
    warm, timed = asked["hop"][:3], asked["hop"][-3:]
    assert {one[0] for one in warm} == {0.1}
    assert {one[0] for one in timed} == {0.5}
    assert {one[1:] for one in warm} == {one[1:] for one in timed} == kernels
    assert set(asked["form_find"][:3]) == set(asked["form_find"][-3:])


@pytest.mark.parametrize("seed", [-1, 0.5, "x", True, None])
def test_a_seed_that_no_sample_has_is_refused(seed: object) -> None:
    with pytest.raises(InvalidParameterError, match="expected an integer seed >= 0, got"):
        calibration.sample_stretches(4, seed)  # type: ignore[arg-type]


def test_a_calibration_on_no_hops_is_refused() -> None:
    with pytest.raises(InvalidParameterError, match=r"expected an integer >= 1 of hops .* got 0"):
        calibrate(Scene(), 0)


def test_bars_that_never_buckle_may_be_single_springs() -> None:
    """Bars of 12 mm carry 80 times the load: the pilot offers one-spring bars; the default's do buckle, and it does not."""
    one = Lattice(1, 1)
    thick = pilot(Design(bar_diameter=12e-3), replace(TOUCHDOWN, duration=1.0), one)
    thin = pilot(Design(), replace(TOUCHDOWN, duration=1.0), one)
    segments = [{rung.fidelity.bar_segments for rung in found.rungs} for found in (thick, thin)]
    assert segments == [{1, None}, {None}]


def test_a_specimen_scatters_by_what_it_says_and_keeps_loss_factors() -> None:
    nominal, built = Design().structure(Lattice()), Specimen.of(Design(), 3).structure(Lattice())
    for name in ("cable", "segment", "hinge"):
        ratio = getattr(built, f"{name}_stiffness") / getattr(nominal, f"{name}_stiffness") - 1
        assert ratio.std() == pytest.approx(1e-3, rel=0.35)  # 48 bars: 3 standard errors
        np.testing.assert_allclose(getattr(built, f"{name}_damping") / getattr(nominal, f"{name}_damping") - 1, ratio, atol=1e-12)
    np.testing.assert_array_equal(built.mass, nominal.mass)
    again = Specimen.of(Design(), 3).structure(Lattice())
    np.testing.assert_array_equal(built.cable_stiffness, again.cable_stiffness)
    assert form_find(np.array([0.5]), design=Specimen.of(Design(), 3), lattice=Lattice(1, 1)).converged.all()


def test_a_design_of_which_no_hop_lands_is_told_so() -> None:
    """Under bars of 0.15 mm, which nothing holds up, no equilibrium is found to hop from."""
    with pytest.raises(InvalidParameterError, match=r"none of 2 has a landing .*no equilibrium.*name a fidelity"):
        calibrate(Scene(duration=0.05), 2, design=Design(bar_diameter=1.5e-4), ladder={"touchdown": ()}, unknowns=1)
    soft = Design(bar_modulus=5e6)  # which the ladder's softened bars could not be made of
    assert [model.bar_softening for model in LADDER["touchdown"] if _suits(model, soft)] == [1.0] * len(
        [model for model in LADDER["touchdown"] if model.bar_softening == 1.0]
    )
