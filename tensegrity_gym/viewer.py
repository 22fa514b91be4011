"""What an env shows of itself: one picture, all frames, or a window."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from tensegrity_gym.design import Design
from tensegrity_gym.errors import InvalidParameterError, MissingExtraError
from tensegrity_gym.hops import HopResult, Trajectory
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.types import Floats

#: Frames per second of films and in the window: hops are shown in real time.
RENDER_FPS = 30
#: Rate at which a hop is recorded for each render mode [1/s]; a filmstrip finds take-off and touchdown by it.
RATES: dict[str | None, float | None] = {None: None, "rgb_array": 120.0, "rgb_array_list": RENDER_FPS, "human": RENDER_FPS}
RENDER_MODES = [mode for mode in RATES if mode]


def check_render_mode(mode: Any) -> Any:
    """``mode`` if it's None or one of ``RENDER_MODES``."""
    if mode not in RATES:
        raise InvalidParameterError(f"render_mode: expected None or one of {RENDER_MODES}, got {mode!r}")
    return mode


class Viewer:
    """Keeps what happened since the last look, and draws it when asked to (human: at once).

    Pillow is loaded only when something is drawn.
    """

    def __init__(self, mode: str | None, lattice: Lattice) -> None:
        self.mode = mode
        self.rate = RATES[mode]
        self.lattice = lattice
        self._last: Trajectory | None = None
        self._design = Design()
        self._target: Floats = np.zeros(2)
        self._pending: list[np.ndarray] = []
        self._window: Window | None = None

    def wait(self, target: Floats, place: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """An episode begins, the lattice stands at ``place`` (x, y [m], heading [rad]), target (2,) [m] of the world."""
        self._last, self._target, self._pending = None, target.copy(), []
        if self.mode in ("rgb_array_list", "human"):
            from tensegrity_gym import render

            points = moved(render.standing_positions(self.lattice), place)
            camera = render.watching_camera(points + (0, 0, 0.6), render.FRAME_SIZE, target)
            picture = render.draw_posture(points, lattice=self.lattice, camera=camera, size=render.FRAME_SIZE, target=target)
            self._show([picture])

    def hop(self, result: HopResult, row: int, place: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """A hop happened from ``place``."""
        if self.mode is None:
            return
        from tensegrity_gym import render

        film = render.whole_hop(result, row)
        self._design = result.fidelity.design(Design())
        self._last = Trajectory(film.times, moved(film.positions, place), film.energies, film.frames)
        if self.mode != "rgb_array":
            self._show(render.hop_frames(self._last, lattice=self.lattice, design=self._design, target=self._target))

    def picture(self) -> np.ndarray:
        """The posture before a hop, or the filmstrip of the last one, shape (h, w, 3) uint8."""
        from tensegrity_gym import render

        if self._last is None:
            return render.waiting_picture(self.lattice, target=self._target)
        target = self._target - self._start()
        return render.filmstrip(self._last, lattice=self.lattice, design=self._design, target=target)

    def frames(self) -> list[np.ndarray]:
        """All frames since the last look, shape (h, w, 3) uint8 each."""
        pending, self._pending = self._pending, []
        return pending

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _start(self) -> Floats:
        assert self._last is not None
        return self._last.positions[0, 0, :, :2].mean(axis=0)

    def _show(self, pictures: list[np.ndarray]) -> None:
        if self.mode == "rgb_array_list":
            self._pending += pictures
            return
        if self._window is None:
            self._window = Window(pictures[0].shape[1], pictures[0].shape[0])
        self._window.play(pictures, RENDER_FPS)


def moved(positions: Floats, place: tuple[float, float, float]) -> Floats:
    """Positions (..., 3) [m] of a lattice at the origin, turned to a heading [rad] and shifted by x, y [m]."""
    x, y, heading = place
    c, s = np.cos(heading), np.sin(heading)
    return positions @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + np.array((x, y, 0.0))


class Window:
    """A window with the standard library's Tk: nothing to install, but it needs a display."""

    def __init__(self, width: int, height: int) -> None:
        try:
            import tkinter
        except ImportError:
            raise MissingExtraError(
                "render_mode 'human' needs Python's tkinter: install your system's package python3-tk, or use "
                "render_mode='rgb_array_list'"
            ) from None
        try:
            self._root = tkinter.Tk()
        except tkinter.TclError as error:
            raise MissingExtraError(
                f"render_mode 'human' needs a display, got none ({error}); use render_mode='rgb_array_list'"
            ) from None
        self._root.title("tensegrity_gym")
        self._label = tkinter.Label(self._root, width=width, height=height)
        self._label.pack()

    def play(self, pictures: list[np.ndarray], fps: float) -> None:
        """Show pictures one after the other, in real time."""
        from PIL import Image, ImageTk

        start = time.perf_counter()
        for k, picture in enumerate(pictures):
            image = ImageTk.PhotoImage(Image.fromarray(picture), master=self._root)
            self._label.configure(image=image)  # type: ignore[arg-type]
            self._root.update()
            time.sleep(max(0.0, start + k / fps - time.perf_counter()))
        self._image = image  # Tk shows it only as long as we keep it

    def close(self) -> None:
        """Close the window."""
        self._root.destroy()
