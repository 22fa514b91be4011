"""Scenes: presets, the slope as tilted gravity, and values that no planet has."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from surrogate.generate import GenerateConfig, configuration_of
from tensegrity_gym.errors import InvalidParameterError, TensegrityError, UnknownPresetError
from tensegrity_gym.scene import Scene, usual_duration
from tensegrity_gym.scene_ranges import scene_ranges


@pytest.mark.parametrize("name", sorted(Scene.PRESETS))
def test_presets_are_scenes(name: str) -> None:
    scene = Scene.preset(name)
    assert scene.gravity == Scene.PRESETS[name]["gravity"]
    assert scene.ground.friction == scene.friction
    assert np.linalg.norm(scene.gravity_vector) == pytest.approx(scene.gravity, rel=1e-15)


def test_presets_can_be_changed_by_keyword() -> None:
    scene = Scene.preset("moon", friction=0.3, landing="touchdown")
    assert (scene.gravity, scene.friction, scene.landing) == (1.625, 0.3, "touchdown")


def test_an_unknown_preset_names_those_there_are() -> None:
    with pytest.raises(UnknownPresetError, match=r"expected one of \['earth', .*got 'pluto'") as caught:
        Scene.preset("pluto")
    assert isinstance(caught.value, TensegrityError)
    assert isinstance(caught.value, KeyError)


@pytest.mark.parametrize("azimuth", [0.0, 0.7, -2.0])
def test_slope_tilts_gravity_downhill(azimuth: float) -> None:
    """On a plane inclined by theta, g has g sin(theta) along the plane and -g cos(theta) along its normal."""
    theta, g = 0.2, 3.7208
    x, y, z = Scene(gravity=g, slope=theta, slope_direction=azimuth).gravity_vector
    assert z == pytest.approx(-g * np.cos(theta), rel=1e-14)
    assert np.hypot(x, y) == pytest.approx(g * np.sin(theta), rel=1e-14)
    assert np.arctan2(y, x) == pytest.approx(azimuth, abs=1e-14)


def test_flat_ground_has_vertical_gravity() -> None:
    np.testing.assert_array_equal(Scene.preset("earth").gravity_vector, (0, 0, -9.80665))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gravity", -1.0),
        ("gravity", 0.0),
        ("gravity", float("nan")),
        ("gravity", "high"),
        ("slope", 2.0),
        ("slope", np.pi / 2),
        ("slope", -0.1),
        ("friction", -0.5),
        ("friction", float("inf")),
        ("restitution", 1.1),
        ("duration", 0.0),
        ("duration", True),
        ("landing", "orbit"),
    ],
)
def test_values_that_no_scene_has_are_refused_by_name(field: str, value: object) -> None:
    with pytest.raises(InvalidParameterError, match=rf"Scene\.{field}.*expected.*got"):
        Scene(**{field: value})  # type: ignore[arg-type]


def test_scenes_are_frozen_and_hashable() -> None:
    assert len({Scene(), Scene(), Scene.preset("earth")}) == 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        Scene().gravity = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("name", sorted(Scene.PRESETS))
def test_hops_are_followed_longer_where_gravity_is_weaker(name: str) -> None:
    """Flights last as 1/g; what a gravity takes is close to what its preset was given by hand."""
    preset = Scene.preset(name)
    assert Scene(gravity=preset.gravity).duration == pytest.approx(preset.duration, rel=0.05)
    assert Scene(gravity=preset.gravity, duration=0.2).duration == 0.2
    assert Scene.preset(name, gravity=0.5).duration == usual_duration(0.5) > preset.duration
    assert Scene.preset(name, gravity=0.5, duration=1.0).duration == 1.0
    assert Scene.preset(name, gravity=50.0).duration == preset.duration


def test_scenes_drawn_are_followed_long_enough_unless_a_duration_is_given() -> None:
    rng = np.random.default_rng(0)
    drawn = [scene_ranges({"gravity": (1.6, 9.8)}).sample(rng) for _ in range(20)]
    assert [scene.duration for scene in drawn] == [usual_duration(scene.gravity) for scene in drawn]
    assert len({scene.duration for scene in drawn}) == 20
    assert {scene_ranges({"gravity": (1.6, 9.8), "duration": 0.2}).sample(rng).duration for _ in range(5)} == {0.2}
    assert scene_ranges({"gravity": 1.625}).base.duration == usual_duration(1.625)
    assert scene_ranges({"preset": "moon", "gravity": (1.6, 9.8)}).sample(rng).duration == 12.0
    heavy = scene_ranges({"gravity": (1.6, 9.8)}, landing="touchdown")
    assert heavy.changed(heavy.changed(heavy.base, {"gravity": 1.6}), {"gravity": 9.8}).duration == usual_duration(9.8)


def test_gravity_next_to_nothing_is_a_scene_and_none_is_not() -> None:
    assert Scene(gravity=1e-6).duration == 1e4  # what a scene may have, at most
    for text in ("gravity=0:9.8", "gravity=-1:9.8"):
        with pytest.raises(InvalidParameterError, match=r"Scene\.gravity"):
            configuration_of(GenerateConfig(Path("hops.h5"), ranges=(text,)))
