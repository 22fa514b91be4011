"""Pictures and films: shapes, what is drawn where, and input that cannot be drawn."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tensegrity_gym import Design, Fidelity, Lattice, Scene, form_find, render, simulate
from tensegrity_gym.canvas import BAR_COLOURS, CABLE_COLOURS, LIGHT, SLACK, Camera, Canvas, bar_curves, member_loads
from tensegrity_gym.cli import main
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.hops import HopResult, Trajectory
from tensegrity_gym.render import choose_moments, draw_posture, filmstrip, hop_frames, record_hop, watching_camera, whole_hop

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


def test_loads_are_those_of_form_finding_over_the_critical_load() -> None:
    found = form_find([0.3, 0.4, 0.3, 0.4])
    held = found.stretches[0] * DESIGN.cell_height
    bars, cables, actuators = member_loads(found.positions[0], STRUCTURE, held)
    np.testing.assert_allclose(bars, found.bar_load[0] / DESIGN.critical_load, rtol=1e-4)
    np.testing.assert_allclose(cables, found.cable_tension[0] / DESIGN.critical_load, rtol=1e-4)
    np.testing.assert_allclose(actuators, found.actuator_tension[0] / DESIGN.critical_load, rtol=1e-4)


@pytest.mark.parametrize("segments", [1, 2, 3, 4])
def test_the_load_of_a_bar_is_the_same_however_finely_it_is_divided(segments: int) -> None:
    """The prestress load over Euler's, to the strain by which a bar's natural length is longer: 2e-5."""
    design = Design(bar_segments=segments)
    structure = design.structure(LATTICE)
    bars, cables, _ = member_loads(design.unloaded_positions(LATTICE), structure, structure.actuator_length)
    np.testing.assert_allclose(bars, DESIGN.prestress_load / DESIGN.critical_load, rtol=1e-4)
    between = ~LATTICE.edge_is_square  # which no two cells share
    tension = DESIGN.cable_rigidity * DESIGN.prestrain
    np.testing.assert_allclose(cables[: len(between)][between], tension / DESIGN.critical_load, rtol=1e-4)


def test_bars_are_coloured_by_load_and_cables_by_tension(standing: np.ndarray) -> None:
    colours = np.array(BAR_COLOURS, dtype=float)
    for shrink, expected in ((1.0, None), (0.99, colours[-1]), (1.01, colours[0])):
        points = np.concatenate([standing[: LATTICE.n_nodes] * shrink, standing[LATTICE.n_nodes :]])
        inner = STRUCTURE.bars
        for k in (1, 2):
            points[inner[:, k]] = points[inner[:, 0]] + k / 3 * (points[inner[:, 3]] - points[inner[:, 0]])
        load = member_loads(points, STRUCTURE, STRUCTURE.actuator_length)[0]
        if expected is None:  # the unloaded lattice: prestress, below the critical load
            np.testing.assert_allclose(load, DESIGN.prestress_load / DESIGN.critical_load, rtol=0.02)
        else:  # a 1 % shorter bar is far beyond its critical load, a longer one in tension
            assert (load > 1).all() if shrink < 1 else (load < 0).all()
    seen = {tuple(c) for c in _stroke_colours(standing * 0.9)}
    assert tuple(SLACK) in seen  # all cables are slack in a lattice shrunk by a tenth
    assert tuple(SLACK) not in {tuple(c) for c in _stroke_colours(standing * 1.01)}
    assert any(c == CABLE_COLOURS[-1] for c in {tuple(c) for c in _stroke_colours(standing * 1.1)})


def _stroke_colours(points: np.ndarray) -> np.ndarray:
    """Colours that a lattice is drawn with, without the paleness of what is far."""
    kept: list[np.ndarray] = []

    class Flat(Camera):
        def project(self, points: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
            pixels, near = super().project(points, size)
            return pixels, np.zeros_like(near)

    class Noted(Canvas):
        def strokes(self, ends: object, metres: object, colour: object) -> None:
            kept.append(np.asarray(colour))

    Noted((200, 150), Flat()).lattice(points, STRUCTURE)
    return np.round(kept[-1]).astype(int)


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


def test_frames_begin_at_release_and_follow_the_centre_of_mass(hop: HopResult) -> None:
    film = whole_hop(hop)
    assert film.times[0, 0] == 0
    np.testing.assert_array_equal(film.positions[0, 0], hop.equilibria.positions[0])
    np.testing.assert_array_equal(film.energies[0, 0], hop.energies[0, 0])
    few = replace(film, frames=np.array([20]))
    pictures = hop_frames(few, size=(160, 120), target=(3.0, 1.0))
    assert len(pictures) == 20
    assert all((a != b).any() for a, b in pairwise(pictures))
    camera = watching_camera(film.positions[0, :20], (160, 120), (3.0, 1.0))
    seen, _ = camera.project(np.array([[3.0, 1.0, 0.0]]), (160, 120))
    assert ((seen > 0) & (seen < (160, 120))).all()  # the target too is in view
    with pytest.raises(InvalidParameterError, match="give simulate a trajectory_rate"):
        whole_hop(replace(hop, trajectory=None))


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_has_all_frames(suffix: str, tmp_path: Path) -> None:
    scene = Scene(duration=0.5)
    path = record_hop([0.4, 0.4, 0.4, 0.4], tmp_path / f"hop{suffix}", scene=scene, fps=10, speed=0.5, size=(120, 120))
    expected = 0.5 * 10 / 0.5 + 1  # with the posture at release
    if suffix == ".gif":
        with Image.open(path) as film:
            assert abs(film.n_frames - expected) <= 1
            assert film.size == (120, 120)
    else:
        frames, _ = pytest.importorskip("imageio_ffmpeg").count_frames_and_secs(str(path))
        assert abs(frames - expected) <= 1


@pytest.mark.parametrize(("fps", "speed"), [(30, 0.5), (50, 1.0), (24, 2.0)])
def test_a_film_runs_at_the_speed_asked_for(fps: int, speed: float, tmp_path: Path) -> None:
    """Whatever whole strides make of a frame's interval, and hundredths of a second of its delay."""
    path = record_hop([0.4] * 4, tmp_path / "hop.gif", scene=Scene(duration=1.0), fps=fps, speed=speed, size=(32, 32))
    with Image.open(path) as film:
        seconds = sum(film.seek(k) or film.info["duration"] for k in range(film.n_frames)) / 1000
    frame = 1.0 / fps + 0.01  # the last picture's, and a tick
    assert 1.0 / speed - frame <= seconds <= 1.0 / speed + frame


def test_a_film_is_of_the_model_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the command line too; rests differ by centimetres between precisions, and other bars have fewer masses."""
    filmed: list[Trajectory] = []

    def noted(trajectory: Trajectory, **_: object) -> list[np.ndarray]:
        filmed.append(trajectory)
        return [np.zeros((8, 8, 3), dtype=np.uint8)] * 2

    monkeypatch.setattr(render, "hop_frames", noted)
    assert main(["hop", "--fidelity", "single", "--video", str(tmp_path / "hop.gif")]) == 0
    expected = whole_hop(simulate([0.3] * 4, scene=Scene.preset("earth"), fidelity="single", trajectory_rate=60.0))
    np.testing.assert_array_equal(filmed[0].positions, expected.positions)
    monkeypatch.undo()
    one = Fidelity(bar_segments=1)
    path = record_hop([0.4] * 4, tmp_path / "one.gif", scene=Scene(duration=0.2), fidelity=one, fps=10, size=(120, 120))
    assert path.exists()


def test_what_cannot_be_drawn_is_refused_by_name(standing: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match=r"positions: expected shape \(184, 3\).*got \(183, 3\)"):
        draw_posture(standing[:-1])
    with pytest.raises(InvalidParameterError, match="positions: expected finite numbers"):
        draw_posture(standing * np.nan)
    with pytest.raises(InvalidParameterError, match=r"expected a path that ends in \.gif or \.mp4"):
        record_hop([0.3] * 4, tmp_path / "hop.avi")
    with pytest.raises(InvalidParameterError, match="expected fps to be a finite number > 0"):
        record_hop([0.3] * 4, tmp_path / "hop.gif", fps=0)
    with pytest.raises(InvalidParameterError, match=r"at most 50 fps of a \.gif"):
        record_hop([0.3] * 4, tmp_path / "hop.gif", fps=60)
    with pytest.raises(InvalidParameterError, match="target to be two finite numbers"):
        record_hop([0.3] * 4, tmp_path / "hop.gif", target=(np.nan, 0.0))
