"""A picture under way: a camera, the ground, shadows and members in metres, drawn with Pillow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFilter, ImageFont
from scipy.interpolate import CubicSpline

from tensegrity_gym.types import Floats, Structure

Colour = tuple[int, int, int]
SKY, HORIZON, SAND, GRID = (236, 242, 248), (250, 251, 252), (226, 219, 206), (206, 197, 181)
STRAIGHT, BOWED, ACTUATOR = (38, 70, 118), (214, 64, 69), (242, 140, 40)
TAUT, SLACK, NODE, INK, TRAIL, TARGET = (
    (66, 138, 124),
    (178, 190, 196),
    (32, 38, 52),
    (52, 60, 74),
    (120, 110, 150),
    (200, 30, 80),
)
#: Bow (largest distance from the chord over length) from which a bar is drawn fully red [-].
FULL_BOW = 0.15
#: Drawn thicknesses [m]; members are drawn thicker than they are, to be seen.
BAR_WIDTH, CABLE_WIDTH, ACTUATOR_WIDTH, NODE_RADIUS = 0.014, 0.005, 0.012, 0.011
#: Where the light comes from: horizontal displacement of a shadow per height [-].
LIGHT = (0.35, 0.25)
#: Pictures are drawn this many times larger and reduced, against jagged lines.
SUPERSAMPLING = 2


@dataclass(frozen=True)
class Camera:
    """A camera that looks at ``centre``; what lies there appears in the middle of the picture."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.35)
    """Point looked at [m]."""
    width: float = 2.2
    """What the picture's width spans at the centre [m]."""
    azimuth: float = np.radians(-62.0)
    """Direction in which the camera stands, seen from the centre, from +x towards +y [rad]."""
    elevation: float = np.radians(13.0)
    """How far the camera stands above the horizontal [rad]."""
    distance: float = 7.0
    """Between camera and centre [m]; infinite for parallel projection."""

    @property
    def axes(self) -> Floats:
        """Unit vectors to the right, upwards in the picture, and towards the camera, shape (3, 3)."""
        ca, sa, ce, se = np.cos(self.azimuth), np.sin(self.azimuth), np.cos(self.elevation), np.sin(self.elevation)
        return np.array([[-sa, ca, 0.0], [-ca * se, -sa * se, ce], [ca * ce, sa * ce, se]])

    def project(self, points: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
        """Pixels, shape (..., 2), and nearness to the camera [m], shape (...,), of points, shape (..., 3) [m]."""
        seen = (np.asarray(points) - np.array(self.centre)) @ self.axes.T
        shrink = 1.0 / np.maximum(1.0 - seen[..., 2] / self.distance, 0.05)
        scale = size[0] / self.width * shrink
        pixels = np.stack([size[0] / 2 + scale * seen[..., 0], size[1] / 2 - scale * seen[..., 1]], axis=-1)
        return pixels, seen[..., 2]


class Canvas:
    """A picture under way: everything is given in metres and drawn through the camera."""

    def __init__(self, size: tuple[int, int], camera: Camera) -> None:
        self.size = (size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING)
        self.camera = camera
        self.pixels_per_metre = self.size[0] / camera.width
        self.image = _background(self.size, camera).copy()
        self.draw = ImageDraw.Draw(self.image)

    def project(self, points: Floats) -> list[tuple[float, float]]:
        """Pixels of points, shape (n, 3) [m]."""
        return _corners(self.camera.project(points, self.size)[0])

    def line_width(self, metres: float) -> int:
        return max(round(metres * self.pixels_per_metre), SUPERSAMPLING)

    def shadow(self, positions: Floats, structure: Structure) -> None:
        """The bars' shadow on the ground, softer the higher the lattice is."""
        curves = bar_curves(positions, structure)
        curves = curves - curves[..., 2:] * np.array((LIGHT[0], LIGHT[1], 1.0))
        pixels, _ = self.camera.project(curves, self.size)
        if pixels[..., 1].min() > self.size[1]:
            return
        mask = Image.new("L", self.size)
        pen = ImageDraw.Draw(mask)
        for curve in pixels:
            pen.line(_corners(curve), fill=105, width=self.line_width(2.2 * BAR_WIDTH), joint="curve")
        height = max(float(positions[:, 2].min()), 0.0)
        blur = (0.012 + 0.02 * min(height, 1.5)) * self.pixels_per_metre
        self.image.paste((92, 84, 76), mask=mask.filter(ImageFilter.BoxBlur(blur)))

    def lattice(self, positions: Floats, structure: Structure, actuator_length: Floats | None = None) -> None:
        """Members and nodes, the far ones first and paler."""
        pixels, near = self.camera.project(positions, self.size)
        curves = self.camera.project(bar_curves(positions, structure), self.size)[0]
        paleness = 0.62 * (near.max() - near) / (float(np.ptp(near)) or 1.0)
        rest = structure.actuator_length if actuator_length is None else actuator_length
        items: list[tuple[float, Floats, Colour, float]] = []
        bow = np.minimum(bar_bow(positions, structure) / FULL_BOW, 1.0)
        for curve, share, pale in zip(curves, bow, paleness[structure.bars].mean(axis=1), strict=True):
            items.append((pale, curve, _mix(STRAIGHT, BOWED, share), BAR_WIDTH))
        for members, natural, colours, widths in (
            (structure.cables, structure.cable_length, (SLACK, TAUT), (CABLE_WIDTH, CABLE_WIDTH)),
            (structure.actuators, rest, (ACTUATOR, ACTUATOR), (CABLE_WIDTH, ACTUATOR_WIDTH)),
        ):
            taut = _taut(positions, members, natural)
            for ends, pale, tight in zip(pixels[members], paleness[members].mean(axis=1), taut, strict=True):
                items.append((pale, ends, colours[int(tight)], widths[int(tight)]))
        for pale, points, colour, metres in sorted(items, key=lambda item: -item[0]):
            self.draw.line(
                points.ravel().tolist(), fill=_mix(colour, HORIZON, pale), width=self.line_width(metres), joint="curve"
            )
        nodes = np.unique(structure.bars[:, [0, -1]])
        r = NODE_RADIUS * self.pixels_per_metre
        for node in nodes[np.argsort(near[nodes])]:
            x, y = pixels[node]
            self.draw.ellipse((x - r, y - r, x + r, y + r), fill=_mix(NODE, HORIZON, paleness[node]))

    def target(self, point: ArrayLike) -> None:
        """Rings on the ground around the target, of 4 and 8 cm radius."""
        turn = np.linspace(0, 2 * np.pi, 49)
        middle = np.array((*np.asarray(point, dtype=float)[:2], 0.0))
        for radius in (0.04, 0.08):
            ring = middle + radius * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
            self.draw.line(self.project(ring), fill=TARGET, width=self.line_width(0.01), joint="curve")

    def trail(self, path: Floats, dot: float = 0.009, every: float = 0.06) -> None:
        """Dots ``every`` metres along a path, shape (n, 3) [m]."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        at = np.arange(0.0, along[-1], every)
        dots = np.column_stack([np.interp(at, along, path[:, k]) for k in range(3)])
        r = dot * self.pixels_per_metre
        for x, y in self.project(dots):
            self.draw.ellipse((x - r, y - r, x + r, y + r), fill=TRAIL)

    def text(self, where: tuple[float, float], words: str, height: int, colour: Colour = INK, anchor: str = "ma") -> None:
        """Words at ``where``, in fractions of the picture's width and height."""
        x, y = where[0] * self.size[0], where[1] * self.size[1]
        self.draw.text((x, y), words, fill=colour, font=_font(height * SUPERSAMPLING), anchor=anchor)

    def array(self) -> np.ndarray:
        """The finished picture, shape (h, w, 3) uint8."""
        return np.array(self.image.reduce(SUPERSAMPLING))


def bar_curves(positions: Floats, structure: Structure, samples: int = 4) -> Floats:
    """Points along each bar, ``samples`` per segment, shape (n_bars, n_points, 3) [m]."""
    return np.einsum("pm,bmk->bpk", _spline(structure.bars.shape[1], samples), positions[structure.bars])


def bar_bow(positions: Floats, structure: Structure) -> Floats:
    """Largest distance of a bar's masses from its chord, over the bar's length, shape (n_bars,) [-]."""
    along = positions[structure.bars]
    start, chord = along[:, :1], along[:, -1:] - along[:, :1]
    chord = chord / np.maximum(np.linalg.norm(chord, axis=-1, keepdims=True), 1e-12)
    off = along - start
    off = off - (off * chord).sum(axis=-1, keepdims=True) * chord
    length = structure.segment_length * (structure.bars.shape[1] - 1)
    return np.linalg.norm(off, axis=-1).max(axis=1) / length


@lru_cache(maxsize=8)
def _spline(masses: int, samples: int) -> Floats:
    """Values at the sampled points of the natural cubic splines that are 1 at one mass and 0 at the others."""
    if masses == 2:
        return np.eye(2)
    at = np.linspace(0, masses - 1, samples * (masses - 1) + 1)
    return np.asarray(CubicSpline(np.arange(masses), np.eye(masses), bc_type="natural")(at))


def _taut(positions: Floats, pairs: np.ndarray, natural_length: Floats) -> np.ndarray:
    length = np.linalg.norm(positions[pairs[:, 1]] - positions[pairs[:, 0]], axis=1)
    return length > natural_length * (1 + 1e-6)


def _mix(a: Colour, b: Colour, share: float) -> Colour:
    return (
        round(a[0] + share * (b[0] - a[0])),
        round(a[1] + share * (b[1] - a[1])),
        round(a[2] + share * (b[2] - a[2])),
    )


@lru_cache(maxsize=4)
def _background(size: tuple[int, int], camera: Camera, spacing: float = 0.5) -> Image.Image:
    """Sky, and a strip of ground across the picture with a grid of squares of ``spacing`` [m]."""
    down = np.linspace(0, 1, size[1])[:, None, None]
    column = np.array(SKY) + np.minimum(1.4 * down, 1.0) * (np.array(HORIZON) - np.array(SKY))
    picture = Image.fromarray(np.broadcast_to(column, (size[1], size[0], 3)).astype(np.uint8))

    strip = _ground_strip(size, camera)
    outline = _corners(camera.project(strip, size)[0])
    mask = Image.new("L", size)
    ImageDraw.Draw(mask).polygon(outline, fill=255)
    ground = Image.new("RGB", size, SAND)
    pen = ImageDraw.Draw(ground)
    middle = np.array(camera.centre[:2])
    span = float(np.linalg.norm(strip[:, :2] - middle, axis=1).max())
    for k in range(-int(np.ceil(span / spacing)), int(np.ceil(span / spacing)) + 1):
        x, y = (np.round(middle / spacing) + k) * spacing
        for ends in (((x, middle[1] - span, 0), (x, middle[1] + span, 0)), ((middle[0] - span, y, 0), (middle[0] + span, y, 0))):
            pen.line(_corners(camera.project(np.array(ends, dtype=float), size)[0]), fill=GRID, width=SUPERSAMPLING)
    # the far edge fades into the sky
    top = min(y for _, y in outline)
    rows = np.clip((np.arange(size[1]) - top) / (0.09 * size[1]), 0, 1)
    fade = Image.fromarray(np.repeat((255 * rows).astype(np.uint8)[:, None], size[0], axis=1))
    picture.paste(ground, mask=Image.composite(fade, Image.new("L", size), mask))
    return picture


def _ground_strip(size: tuple[int, int], camera: Camera) -> Floats:
    """Corners of the ground that is drawn, shape (4, 3) [m]: wider than the picture, and down to its lower edge."""
    right, _, towards = camera.axes
    back = -np.array((towards[0], towards[1], 0.0)) / np.hypot(*towards[:2])
    middle = np.array((*camera.centre[:2], 0.0))
    parallel = not np.isfinite(camera.distance)
    half = camera.width * (0.6 if parallel else 2.0)
    below = camera.width * size[1] / size[0] / 2 + camera.centre[2]
    deep = below / max(float(towards[2]), 0.05) + 0.5
    front = -(deep if parallel else min(deep, 0.85 * camera.distance))
    rear = 2.0 if parallel else max(2.0, 0.9 * camera.width)
    return np.array([middle + s * half * right + d * back for s, d in ((-1, front), (1, front), (1, rear), (-1, rear))])


def _corners(pixels: Floats) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in pixels]


@lru_cache(maxsize=8)
def _font(height: int) -> Any:
    return ImageFont.load_default(height)
