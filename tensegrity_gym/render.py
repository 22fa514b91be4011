"""Pictures and videos of postures and hops, drawn with Pillow: no window, no graphics card.

Bars are drawn as the natural cubic spline through their masses (a pinned rod has no moment at its ends) and turn from
blue to red as their load nears the critical one; cables are green, the darker the tenser, and pale while slack; actuated
cables are orange.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from tensegrity_gym.canvas import TRAIL, Camera, Canvas, colour_chart
from tensegrity_gym.checks import is_number, or_default
from tensegrity_gym.design import Design
from tensegrity_gym.errors import InvalidParameterError, MissingExtraError
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.hops import HopResult, Trajectory
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.simulate import simulate
from tensegrity_gym.types import Floats, Structure

#: Size of a frame of a film, by default [pixels].
FRAME_SIZE = (640, 480)
#: Most frames a second of a .gif: what lasts less than two ticks of its clock viewers show for longer.
FASTEST_GIF = 50
#: A lattice whose lowest mass is above this is off the ground [m].
ALOFT = 1e-3


def draw_posture(
    positions: ArrayLike,
    *,
    lattice: Lattice | None = None,
    design: Design | None = None,
    camera: Camera | None = None,
    size: tuple[int, int] = (960, 720),
    actuator_length: ArrayLike | None = None,
    target: ArrayLike | None = None,
    trail: ArrayLike | None = None,
    caption: str | None = None,
    legend: bool = False,
) -> np.ndarray:
    """Draw one posture, positions of shape (n_masses, 3) [m]; returns a picture of shape (h, w, 3), uint8.

    ``target`` [m], shape (2,), is a point on the ground; ``trail`` [m], shape (n, 3), a path that is dotted; ``legend`` says
    what the colours mean. ``actuator_length`` [m], shape (n_actuators,), are the actuated cables' rest lengths (default:
    unlocked).
    """
    structure = _structure(lattice or Lattice(2, 2), design or Design())
    points = check_positions(positions, structure, 2)
    canvas = Canvas(size, camera or Camera(), legend)
    if target is not None:
        canvas.target(target)
    canvas.shadow(points, structure)
    if trail is not None and len(np.asarray(trail)) > 1:
        canvas.trail(np.asarray(trail, dtype=float))
    canvas.lattice(points, structure, None if actuator_length is None else np.asarray(actuator_length, dtype=float))
    if caption:
        canvas.text((0.5, 0.03), caption, height=max(size[1] // 26, 10))
    return canvas.array()


def filmstrip(
    trajectory: Trajectory,
    *,
    hop: int = 0,
    moments: int = 8,
    lattice: Lattice | None = None,
    design: Design | None = None,
    size: tuple[int, int] = (2000, 560),
    target: ArrayLike | None = None,
) -> np.ndarray:
    """One wide picture of a hop: ``moments`` postures side by side, with the path of the centre of mass between them.

    ``hop`` picks one out of the trajectory's batch; ``target`` [m], shape (2,), is relative to the start. Each posture is
    moved, not turned, to the middle of its column; how far the hop got by then is written below it.
    Returns shape (h, w, 3), uint8.
    """
    structure = _structure(lattice or Lattice(2, 2), design or Design())
    frames = int(trajectory.frames[hop])
    times = np.asarray(trajectory.times[hop][:frames], dtype=float)
    points = check_positions(trajectory.positions[hop][:frames], structure, 3)
    if moments < 1:
        raise InvalidParameterError(f"filmstrip: moments: expected at least 1, got {moments}")
    named = choose_moments(times, points, moments)
    shown = np.array(sorted(named))
    com = _centre_of_mass(points, structure)

    camera = _strip_camera(float(points[..., 2].max()), len(shown), size)
    width = camera.width
    right = camera.axes[0]
    columns = ((np.arange(len(shown)) + 0.5) / len(shown) - 0.5) * (width - 0.5)
    flat = com * (1, 1, 0)
    offsets = columns[:, None] * right - flat[shown]

    canvas = Canvas(size, camera)
    if target is not None:
        canvas.target(flat[0] + np.append(target, 0.0) + offsets[-1])
    for frame, offset in zip(shown, offsets, strict=True):
        canvas.shadow(points[frame] + offset, structure)
    across = np.interp(times, times[shown], columns)
    canvas.trail(((com - flat) + across[:, None] * right)[shown[0] : shown[-1] + 1])
    for k, (frame, offset) in enumerate(zip(shown, offsets, strict=True)):
        canvas.lattice(points[frame] + offset, structure, _held_lengths(points[0], structure) if frame == 0 else None)
        middle, gone = 0.5 + columns[k] / width, np.linalg.norm(flat[frame] - flat[0])
        canvas.text((middle, 0.875), f"{times[frame]:.2f} s", height=max(size[1] // 24, 9))
        said = f"{named[frame]}, {gone:.2f} m away" if named[frame] in ("touchdown", "end") else named[frame]
        canvas.text((middle, 0.93), said, height=max(size[1] // 30, 8), colour=TRAIL)
    return canvas.array()


def _strip_camera(top: float, columns: int, size: tuple[int, int]) -> Camera:
    """A parallel view of ``columns`` postures up to ``top`` [m], the lower sixth of the picture left for words."""
    camera = Camera(azimuth=np.radians(-75.0), distance=np.inf)
    deep = 0.2  # what lies nearer than the middle of the lattice appears below it [m]
    width = max(1.5 * columns + 0.5, (top + 2 * deep) / 0.76 * size[0] / size[1])
    height = width * size[1] / size[0]
    centre = (0.33 * height - deep) / np.cos(camera.elevation)
    return replace(camera, width=width, centre=(0.0, 0.0, float(centre)))


def choose_moments(times: Floats, positions: Floats, moments: int) -> dict[int, str]:
    """The frames that tell a hop, at most ``moments`` of them, each with the name of its moment or "".

    Shapes (f,) [s] and (f, n_masses, 3) [m]. A hop that never leaves the ground is divided evenly.
    """
    last = len(times) - 1
    clearance = positions[..., 2].min(axis=1)
    aloft = np.flatnonzero(clearance > ALOFT)
    if len(aloft) < 2 or moments < 4:
        return {int(frame): f"{'release' if frame == 0 else ''}" for frame in np.linspace(0, last, moments).astype(int)}
    apex = int(np.argmax(positions[..., 2].mean(axis=1)))
    takeoff = int(aloft[0])
    grounded = np.flatnonzero(clearance[apex:] <= ALOFT)
    touchdown = apex + int(grounded[0]) if len(grounded) else last
    settling = int(np.searchsorted(times, times[touchdown] + 0.12 * (times[last] - times[touchdown])))
    # most telling first: where there is room for fewer, the rest is left out
    wanted = [(0, "release"), (last, "end"), (apex, "apex"), (touchdown, "touchdown"), (takeoff, "take-off")]
    wanted += [((takeoff + apex) // 2, ""), ((apex + touchdown) // 2, ""), (settling, "")]
    wanted += [(int(frame), "") for frame in np.linspace(settling, last, max(moments - 6, 2))[1:-1]]
    chosen: dict[int, str] = {}
    for frame, name in wanted:
        if len(chosen) < moments:
            chosen.setdefault(frame, name)
    return chosen


def record_hop(
    stretches: ArrayLike,
    path: str | Path,
    *,
    scene: Scene | None = None,
    design: Design | None = None,
    lattice: Lattice | None = None,
    fidelity: Fidelity | str = "paper",
    target: ArrayLike | None = None,
    fps: int = 30,
    speed: float = 0.5,
    size: tuple[int, int] = FRAME_SIZE,
) -> Path:
    """Simulate one hop and write it as ``.gif`` or ``.mp4`` (which needs the extra "video"); returns the path.

    ``fidelity`` is as for ``simulate``. ``speed`` is real time over film time [-]: 0.5 is slow motion; it is kept whatever whole
    steps and a format's clock make of ``fps``, at most 50 of a .gif. ``target`` [m] is relative to the start. The camera holds
    the whole hop in view.
    """
    path = Path(path)
    check_film(path, "record_hop")
    for name, value in (("fps", fps), ("speed", speed)):
        if not is_number(value) or value <= 0:
            raise InvalidParameterError(f"record_hop: expected {name} to be a finite number > 0, got {value!r}")
    if path.suffix.lower() == ".gif" and fps > FASTEST_GIF:
        raise InvalidParameterError(
            f"record_hop: expected at most {FASTEST_GIF} fps of a .gif, which viewers play no faster, got {fps!r}; write an .mp4"
        )
    if target is not None and (np.shape(target) != (2,) or not np.isfinite(np.asarray(target, dtype=float)).all()):
        raise InvalidParameterError(f"record_hop: expected target to be two finite numbers (x, y) [m], got {target!r}")
    scene, design = Scene.of(scene, "record_hop"), or_default(design, Design, "record_hop")
    lattice = or_default(lattice, Lattice, "record_hop")
    one = np.atleast_2d(np.asarray(stretches, dtype=float))[:1]
    hop = simulate(one, scene=scene, design=design, lattice=lattice, fidelity=fidelity, trajectory_rate=fps / speed)
    design = hop.fidelity.design(design)  # what was simulated may have fewer masses
    trajectory = whole_hop(hop)
    if target is not None:  # targets are relative to where the centre of mass started
        start = trajectory.positions[0, :1]
        target = np.asarray(target, dtype=float) + _centre_of_mass(start, _structure(lattice, design))[0, :2]
    pictures = hop_frames(trajectory, lattice=lattice, design=design, size=size, target=target)
    _write_video(pictures, path, trajectory.times[0] / speed)
    return path


def check_film(path: Path, caller: str) -> None:
    """InvalidParameterError, in the name of ``caller``, for a path that is no .gif or .mp4; MissingExtraError for an .mp4
    without the extra "video": better before a simulation than after it."""
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise InvalidParameterError(f"{caller}: expected a path that ends in .gif or .mp4, got {str(path)!r}")
    if path.suffix.lower() == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401 (whether it is there)
        except ImportError:
            raise MissingExtraError(
                f"{caller}: .mp4 needs imageio-ffmpeg: pip install 'tensegrity-gym[video]', or write a .gif"
            ) from None


def hop_frames(
    trajectory: Trajectory,
    *,
    hop: int = 0,
    lattice: Lattice | None = None,
    design: Design | None = None,
    camera: Camera | None = None,
    size: tuple[int, int] = FRAME_SIZE,
    target: ArrayLike | None = None,
) -> list[np.ndarray]:
    """All frames of a hop as pictures of shape (h, w, 3), uint8, with its trail, time and height of the centre of mass.

    ``target`` [m], shape (2,), is a point on the ground. The camera (default) has the whole hop and the target in view.
    """
    lattice, design = lattice or Lattice(2, 2), design or Design()
    structure = _structure(lattice, design)
    frames = int(trajectory.frames[hop])
    points, times = check_positions(trajectory.positions[hop][:frames], structure, 3), trajectory.times[hop][:frames]
    com = _centre_of_mass(points, structure)
    held = _held_lengths(points[0], structure)
    camera = camera or watching_camera(points, size, target)
    return [
        draw_posture(
            points[k],
            lattice=lattice,
            design=design,
            camera=camera,
            size=size,
            actuator_length=held if times[k] <= 0 else None,
            target=target,
            trail=com[: k + 1],
            caption=f"{times[k]:.2f} s      {com[k, 2]:.2f} m high",
            legend=True,
        )
        for k in range(frames)
    ]


def watching_camera(positions: Floats, size: tuple[int, int], target: ArrayLike | None = None) -> Camera:
    """A camera that has all of a hop, positions of shape (f, n_masses, 3) [m], and its target in view."""
    points = positions.reshape(-1, 3)
    if target is not None:
        points = np.concatenate([points, [(*np.asarray(target, dtype=float)[:2], 0.0)]])
    camera = Camera()
    seen = points @ camera.axes.T
    spread = np.ptp(seen[:, :2], axis=0)
    width = 1.25 * max(spread[0], spread[1] * size[0] / size[1]) + 0.3
    middle = camera.axes.T @ ((seen.max(axis=0) + seen.min(axis=0)) / 2)
    x, y, z = (float(c) for c in middle)
    return replace(camera, centre=(x, y, z), width=float(width), distance=4 * float(width))


def waiting_picture(
    lattice: Lattice, *, target: ArrayLike | None = None, size: tuple[int, int] = (2000, 560), camera: Camera | None = None
) -> np.ndarray:
    """The unloaded lattice standing on the ground, and the target: what there is to see before a hop; (h, w, 3) uint8."""
    points = standing_positions(lattice)
    camera = camera or watching_camera(points + (0, 0, 0.6), size, target)
    return draw_posture(points, lattice=lattice, camera=camera, size=size, target=target)


@lru_cache(maxsize=8)
def standing_positions(lattice: Lattice) -> Floats:
    """Positions of the unloaded lattice of the default design, standing on the ground, shape (n_masses, 3) [m]."""
    points = Design().unloaded_positions(lattice)
    points[:, 2] -= points[:, 2].min()
    return points


def check_positions(positions: ArrayLike, structure: Structure, dimensions: int) -> Floats:
    """Positions as float64; InvalidParameterError if their shape isn't that of the structure, or one isn't finite."""
    points = np.asarray(positions, dtype=np.float64)
    shape = (len(structure.mass), 3)
    if points.ndim != dimensions or points.shape[-2:] != shape or points.shape[0] == 0:
        expected = shape if dimensions == 2 else ("frames", *shape)
        raise InvalidParameterError(f"positions: expected shape {expected} for this lattice and design, got {points.shape}")
    if not np.isfinite(points).all():
        raise InvalidParameterError("positions: expected finite numbers [m], got some that are not")
    return points


def whole_hop(result: HopResult, hop: int = 0) -> Trajectory:
    """One hop's frames, from the moment of release on; the result must have a trajectory."""
    if result.trajectory is None:
        raise InvalidParameterError("whole_hop: expected a hop with frames, got none; give simulate a trajectory_rate")
    frames = int(result.trajectory.frames[hop])
    first = (np.zeros(1), result.start_positions[hop][None], result.energies[hop, :1])
    later = (getattr(result.trajectory, name)[hop][:frames] for name in ("times", "positions", "energies"))
    joined = [np.concatenate(pair)[None] for pair in zip(first, later, strict=True)]
    return Trajectory(joined[0], joined[1], joined[2], np.array([frames + 1]))


@lru_cache(maxsize=8)
def _structure(lattice: Lattice, design: Design) -> Structure:
    return design.structure(lattice)


def _centre_of_mass(points: Floats, structure: Structure) -> Floats:
    return np.einsum("m,fmk->fk", structure.mass / structure.mass.sum(), points)


def _held_lengths(positions: Floats, structure: Structure) -> Floats:
    """Rest lengths with which every actuated cable counts as taut: what it was held at before release [m]."""
    lower, upper = structure.actuators.T
    return 0.99 * np.linalg.norm(positions[upper] - positions[lower], axis=1)


def _write_video(pictures: list[np.ndarray], path: Path, times: Floats) -> None:
    """Pictures that begin at ``times`` [s] of the film, evenly but for the first."""
    interval = float(times[-1] - times[1]) / (len(times) - 2) if len(times) > 2 else 1.0
    if path.suffix.lower() == ".gif":
        # whose clock ticks in hundredths of a second: rounded where each picture begins, so that no error adds up
        ticks = np.round(100 * np.append(times, times[-1] + interval)).astype(int)
        durations = [10 * int(tick) for tick in np.diff(ticks)]
        # one palette for all frames: the colours are few and must not flicker
        first = Image.fromarray(np.concatenate([pictures[len(pictures) // 2], colour_chart(pictures[0].shape[1])])).quantize(256)
        frames = [Image.fromarray(p).quantize(palette=first, dither=Image.Dither.NONE) for p in pictures]
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=False)
        return
    import imageio_ffmpeg

    height, width = pictures[0].shape[:2]
    writer = imageio_ffmpeg.write_frames(str(path), (width, height), fps=1 / interval, macro_block_size=2, quality=8)
    writer.send(None)
    for picture in pictures:
        writer.send(np.ascontiguousarray(picture))
    writer.close()
