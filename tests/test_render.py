"""Pictures and films: shapes, what is drawn where, and input that cannot be drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tensegrity_gym import Design, Lattice, Scene, simulate
from tensegrity_gym.canvas import FULL_BOW, LIGHT, Camera, bar_bow, bar_curves
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.render import choose_moments, draw_posture, filmstrip, record_hop, watching_camera
from tensegrity_gym.simulate import HopResult

LATTICE, DESIGN = Lattice(2, 2), Design()
STRUCTURE = DESIGN.structure(LATTICE)


@pytest.fixture(scope="module")
def standing() -> np.ndarray:
    points = DESIGN.unloaded_positions(LATTICE)
    points[:, 2] -= points[:, 2].min()
    return points


@pytest.fixture(scope="module")
def hop() -> HopResult:
    return simulate([0.3, 0.4, 0.3, 0.4], trajectory_rate=100.0)


def test_a_posture_is_a_picture_of_the_size_asked_for(standing: np.ndarray) -> None:
    picture = draw_posture(standing, size=(320, 240), target=(0.2, 0.1), caption="0.00 s")
    assert picture.shape == (240, 320, 3)
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, draw_posture(standing, size=(320, 240), target=(0.2, 0.1), caption="0.00 s"))


def test_the_lattice_is_seen_where_the_camera_projects_it(standing: np.ndarray) -> None:
    size = (400, 300)
    empty = draw_posture(standing + (0, 0, 50), size=size).astype(int)
    seen = np.abs(draw_posture(standing, size=size).astype(int) - empty).sum(axis=2) > 60
    pixels, _ = Camera().project(standing, size)
    shadow, _ = Camera().project(standing - standing[:, 2:] * (*LIGHT, 1.0), size)
    x = np.concatenate([pixels, shadow])[:, 0]
    columns = np.nonzero(seen.any(axis=0))[0]
    assert columns.min() >= x.min() - 8  # the shadow is blurred
    assert columns.max() <= x.max() + 8
    for x, y in pixels[: LATTICE.n_nodes].astype(int):
        assert seen[y - 2 : y + 3, x - 2 : x + 3].any()


@pytest.mark.parametrize("distance", [7.0, np.inf])
def test_what_the_camera_looks_at_is_in_the_middle(distance: float) -> None:
    camera = Camera(centre=(1.0, -2.0, 0.5), distance=distance)
    pixels, near = camera.project(np.array(((1.0, -2.0, 0.5), (1.0, -2.0, 0.6))), (640, 480))
    np.testing.assert_allclose(pixels[0], (320, 240), atol=1e-9)
    assert pixels[1, 1] < 240  # higher things are higher up
    assert near[1] > near[0]  # and, seen from above, nearer
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-15)


def test_bars_are_drawn_through_their_masses(standing: np.ndarray) -> None:
    bent = standing + 0.01 * np.random.default_rng(0).standard_normal(standing.shape)
    curves = bar_curves(bent, STRUCTURE, samples=4)
    np.testing.assert_allclose(curves[:, ::4], bent[STRUCTURE.bars], atol=1e-14)


def test_bow_is_the_distance_from_the_chord_over_the_length(standing: np.ndarray) -> None:
    assert bar_bow(standing, STRUCTURE).max() < 1e-12
    bent = standing.copy()
    first = STRUCTURE.bars[0]
    chord = bent[first[-1]] - bent[first[0]]
    aside = np.cross(chord, (0.3, 0.2, 0.9))
    bent[first[1:3]] += 0.05 * aside / np.linalg.norm(aside)
    assert bar_bow(bent, STRUCTURE)[0] == pytest.approx(0.05 / DESIGN.bar_length, rel=1e-4)
    assert bar_bow(bent, STRUCTURE)[0] < FULL_BOW


def test_filmstrip_of_a_hop(hop: HopResult) -> None:
    assert hop.trajectory is not None
    picture = filmstrip(hop.trajectory, size=(800, 240), target=(0.2, 0.1))
    assert picture.shape == (240, 800, 3)
    # something dark stands in each of the eight columns
    dark = picture.astype(int).sum(axis=2) < 330
    assert all(column.any() for column in np.array_split(dark, 8, axis=1))


def test_moments_tell_the_hop_in_order(hop: HopResult) -> None:
    assert hop.trajectory is not None
    frames = int(hop.trajectory.frames[0])
    times, points = hop.trajectory.times[0][:frames], hop.trajectory.positions[0][:frames]
    named = choose_moments(times, points, 8)
    assert len(named) == 8
    order = [named[frame] for frame in sorted(named) if named[frame]]
    assert order == ["release", "take-off", "apex", "touchdown", "end"]
    by_name = {name: times[frame] for frame, name in named.items()}
    # frames are 10 ms apart
    assert by_name["take-off"] == pytest.approx(hop.takeoff_time[0], abs=0.025)
    assert by_name["touchdown"] == pytest.approx(hop.touchdown_time[0], abs=0.025)


def test_moments_of_what_never_flies_are_even(standing: np.ndarray) -> None:
    named = choose_moments(np.arange(11) / 10, np.repeat(standing[None], 11, axis=0), 6)
    assert sorted(named) == [0, 2, 4, 6, 8, 10]


def test_the_watching_camera_has_the_whole_hop_in_view(hop: HopResult) -> None:
    assert hop.trajectory is not None
    size = (300, 400)
    points = hop.trajectory.positions[0][: int(hop.trajectory.frames[0])]
    pixels, _ = watching_camera(points, size).project(points, size)
    assert pixels.min() > 0
    assert (pixels < np.array(size)).all()


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_has_all_frames(suffix: str, tmp_path: Path) -> None:
    scene = Scene(duration=0.5)
    path = record_hop([0.4, 0.4, 0.4, 0.4], tmp_path / f"hop{suffix}", scene=scene, fps=10, speed=0.5, size=(120, 120))
    expected = 0.5 * 10 / 0.5 + 1
    if suffix == ".gif":
        with Image.open(path) as film:
            assert abs(film.n_frames - expected) <= 1
            assert film.size == (120, 120)
    else:
        frames, _ = pytest.importorskip("imageio_ffmpeg").count_frames_and_secs(str(path))
        assert abs(frames - expected) <= 1


def test_what_cannot_be_drawn_is_refused_by_name(standing: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match=r"positions: expected shape \(184, 3\).*got \(183, 3\)"):
        draw_posture(standing[:-1])
    with pytest.raises(InvalidParameterError, match="positions: expected finite numbers"):
        draw_posture(standing * np.nan)
    with pytest.raises(InvalidParameterError, match=r"expected a path that ends in \.gif or \.mp4"):
        record_hop([0.3] * 4, tmp_path / "hop.avi")
    with pytest.raises(InvalidParameterError, match="expected fps > 0"):
        record_hop([0.3] * 4, tmp_path / "hop.gif", fps=0)
