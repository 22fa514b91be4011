"""A picture under way: a camera, the ground, shadows and members in metres; Pillow draws what stays, kernels what moves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from tensegrity_gym import raster
from tensegrity_gym.energies import member_forces
from tensegrity_gym.types import Floats, Structure

Colour = tuple[int, int, int]
SKY, HORIZON, SAND, GRID, SHADE = (236, 242, 248), (250, 251, 252), (226, 219, 206), (206, 197, 181), (92, 84, 76)
#: Bars from no load (or tension) over half to the full critical load.
BAR_COLOURS: tuple[Colour, ...] = ((38, 70, 118), (126, 84, 142), (222, 52, 58))
#: Cables: slack, barely taut, and at FULL_TENSION.
SLACK = (186, 196, 202)
CABLE_COLOURS: tuple[Colour, ...] = ((126, 184, 160), (20, 104, 92))
ACTUATOR, ACTUATOR_SLACK = (242, 140, 40), (236, 206, 172)
NODE, INK, TRAIL, TARGET = (32, 38, 52), (52, 60, 74), (120, 110, 150), (200, 30, 80)
#: Tension from which a cable is drawn in its darkest colour [critical loads of a bar].
FULL_TENSION = 2.0
#: Drawn thicknesses [m]; members are drawn thicker than they are, to be seen.
BAR_WIDTH, CABLE_WIDTH, ACTUATOR_WIDTH, NODE_RADIUS = 0.014, 0.005, 0.012, 0.011
#: Where the light comes from: horizontal displacement of a shadow per height [-].
LIGHT = (0.35, 0.25)
#: The background is drawn this many times larger and reduced, against jagged lines.
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

    def __init__(self, size: tuple[int, int], camera: Camera, legend: bool = False) -> None:
        self.size = size
        self.camera = camera
        self.pixels_per_metre = size[0] / camera.width
        self.pixels = (_legend_background if legend else _background)(size, camera).copy()

    def project(self, points: Floats) -> Floats:
        """Pixels, shape (n, 2), of points, shape (n, 3) [m]."""
        return self.camera.project(points, self.size)[0]

    def strokes(self, ends: Floats, metres: ArrayLike, colour: ArrayLike) -> None:
        """Strokes between pixels (n, 4), as wide as so many metres at the centre, (n,) or one, in colours (n, 3) or one."""
        radius = np.broadcast_to(np.asarray(metres, dtype=float) * (0.5 * self.pixels_per_metre), len(ends))
        colours = np.broadcast_to(np.asarray(colour, dtype=float), (len(ends), 3))
        raster.draw_strokes(self.pixels, np.ascontiguousarray(ends), np.ascontiguousarray(radius), np.ascontiguousarray(colours))

    def shadow(self, positions: Floats, structure: Structure) -> None:
        """The bars' shadow on the ground, softer the higher the lattice is."""
        masses = positions[structure.bars]
        pixels = self.project(masses - masses[..., 2:] * np.array((LIGHT[0], LIGHT[1], 1.0)))
        if pixels[..., 1].min() > self.size[1]:
            return
        height = max(float(positions[:, 2].min()), 0.0)
        soft = max((0.012 + 0.02 * min(height, 1.5)) * self.pixels_per_metre, 0.5)
        mask = np.zeros(self.pixels.shape[:2], dtype=np.float32)
        radius = 1.1 * BAR_WIDTH * self.pixels_per_metre
        raster.draw_shade(self.pixels, mask, _pairs(pixels), radius, soft, np.array(SHADE, dtype=float), 0.4)

    def lattice(self, positions: Floats, structure: Structure, actuator_length: Floats | None = None) -> None:
        """Members and nodes, the far ones first and paler; bars coloured by load, cables by tension."""
        pixels, near = self.camera.project(positions, self.size)
        curves = _pairs(self.project(bar_curves(positions, structure))).reshape(len(structure.bars), -1, 4)
        rest = structure.actuator_length if actuator_length is None else actuator_length
        load, tension, pull = member_loads(positions, structure, rest)
        paleness = 0.62 * (near.max() - near) / (float(np.ptp(near)) or 1.0)
        pieces, inner = curves.shape[1], structure.bars
        nodes = np.unique(inner[:, [0, -1]])
        ends = [curves.reshape(-1, 4), pixels[structure.cables].reshape(-1, 4), pixels[structure.actuators].reshape(-1, 4)]
        ends.append(np.concatenate([pixels[nodes], pixels[nodes]], axis=1))
        pale = [np.repeat(paleness[inner].mean(axis=1), pieces), paleness[structure.cables].mean(axis=1)]
        pale += [paleness[structure.actuators].mean(axis=1), paleness[nodes] - 1e-9]
        colour = [np.repeat(_shades(BAR_COLOURS, load), pieces, axis=0)]
        colour += [np.where(tension[:, None] > 0, _shades(CABLE_COLOURS, tension / FULL_TENSION), SLACK)]
        colour += [np.where(pull[:, None] > 0, ACTUATOR, ACTUATOR_SLACK), np.tile(NODE, (len(nodes), 1))]
        width = [np.full(len(ends[0]), BAR_WIDTH), np.where(tension > 0, CABLE_WIDTH, 0.7 * CABLE_WIDTH)]
        width += [np.where(pull > 0, ACTUATOR_WIDTH, CABLE_WIDTH), np.full(len(nodes), 2 * NODE_RADIUS)]
        far = np.concatenate(pale)
        mixed = np.concatenate(colour) + far[:, None] * (np.array(HORIZON) - np.concatenate(colour))
        order = np.argsort(-far, kind="stable")
        self.strokes(np.concatenate(ends)[order], np.concatenate(width)[order], mixed[order])

    def target(self, point: ArrayLike) -> None:
        """Rings on the ground around the target, of 4 and 8 cm radius or, seen from afar, 6 and 12 pixels."""
        turn = np.linspace(0, 2 * np.pi, 49)
        middle = np.array((*np.asarray(point, dtype=float)[:2], 0.0))
        for radius in (0.04, 0.08):
            radius = max(radius, 150 * radius / self.pixels_per_metre)
            ring = middle + radius * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
            self.strokes(_pairs(self.project(ring)), max(0.01, 1.6 / self.pixels_per_metre), TARGET)

    def trail(self, path: Floats, dot: float = 0.009, every: float = 0.06) -> None:
        """Dots ``every`` metres along a path, shape (n, 3) [m]; seen from afar, fewer."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        at = np.arange(0.0, along[-1], max(every, 6 / self.pixels_per_metre))
        dots = self.project(np.column_stack([np.interp(at, along, path[:, k]) for k in range(3)]))
        self.strokes(np.concatenate([dots, dots], axis=1), max(2 * dot, 2.2 / self.pixels_per_metre), TRAIL)

    def text(self, where: tuple[float, float], words: str, height: int, colour: Colour = INK, left: bool = False) -> None:
        """Words whose top is at ``where``, in fractions of the picture's width and height: centred, or ``left`` aligned."""
        glyphs = [_glyph(letter, height) for letter in words]
        x = where[0] * self.size[0] - (0.0 if left else 0.5 * sum(glyph[3] for glyph in glyphs))
        ink = np.array(colour, dtype=float)
        for cover, dx, dy, advance in glyphs:
            raster.draw_mask(self.pixels, cover, round(x) + dx, round(where[1] * self.size[1]) + dy, ink)
            x += advance

    def array(self) -> np.ndarray:
        """The finished picture, shape (h, w, 3) uint8."""
        return self.pixels


def colour_chart(width: int, height: int = 12) -> np.ndarray:
    """All that members are coloured with, from near to far, as stripes (h, width, 3) uint8: thin lines count for little in a
    picture, so a palette is chosen from this beside it."""
    along = np.linspace(0, 1, width)
    near = [_shades(BAR_COLOURS, along), _shades(CABLE_COLOURS, along)]
    near += [np.tile(np.array(colour, dtype=float), (width, 1)) for colour in (ACTUATOR, TRAIL, TARGET, NODE)]
    stripes = [row + pale * (np.array(HORIZON) - row) for row in near for pale in (0.0, 0.3, 0.6)]
    return np.repeat(np.array(stripes), height, axis=0).astype(np.uint8)


def member_loads(positions: Floats, structure: Structure, actuator_length: Floats) -> tuple[Floats, Floats, Floats]:
    """Elastic loads over a bar's critical load [-]: bars (compression > 0), cables and actuated cables (tension > 0).

    Positions (n_masses, 3) [m]; shapes (n_bars,), (n_cables,), (n_actuators,).
    """
    forces = member_forces(structure, positions[None], np.asarray(actuator_length, dtype=float)[None])
    segments = structure.bars.shape[1] - 1
    critical = structure.hinge_stiffness * (2 * np.sin(np.pi / (2 * segments))) ** 2 / structure.segment_length
    critical = np.where(critical > 0, critical, 1.0)
    typical = float(critical.mean())
    return forces.bars[0] / critical, forces.cables[0] / typical, forces.actuators[0] / typical


def bar_curves(positions: Floats, structure: Structure, samples: int = 4) -> Floats:
    """Points along each bar, ``samples`` per segment, shape (n_bars, n_points, 3) [m]."""
    return np.einsum("pm,bmk->bpk", _spline(structure.bars.shape[1], samples), positions[structure.bars])


@lru_cache(maxsize=8)
def _spline(masses: int, samples: int) -> Floats:
    """Values at the sampled points of the natural cubic splines that are 1 at one mass and 0 at the others."""
    if masses == 2:
        return np.eye(2)
    at = np.linspace(0, masses - 1, samples * (masses - 1) + 1)
    from scipy.interpolate import CubicSpline  # heavy to import

    return np.asarray(CubicSpline(np.arange(masses), np.eye(masses), bc_type="natural")(at))


def _shades(colours: tuple[Colour, ...], share: Floats) -> Floats:
    """Colours (n, 3) at shares (n,) of the way through ``colours``; beyond its ends, the ends."""
    at = np.linspace(0, 1, len(colours))
    return np.column_stack([np.interp(share, at, channel) for channel in np.array(colours, dtype=float).T])


def _pairs(points: Floats) -> Floats:
    """Strokes (n, 4) between consecutive pixels of curves, shape (..., n_points, 2)."""
    return np.concatenate([points[..., :-1, :], points[..., 1:, :]], axis=-1).reshape(-1, 4)


@lru_cache(maxsize=1024)
def _glyph(letter: str, height: int) -> tuple[np.ndarray, int, int, float]:
    """A letter as a mask (h, w) uint8, where its corner lies from its top left anchor, and its width [pixels]."""
    font = _font(height)
    left, top, right, bottom = (int(edge) for edge in font.getbbox(letter))
    mask = Image.new("L", (max(right - left, 0) + 2, max(bottom - top, 0) + 2))
    ImageDraw.Draw(mask).text((1 - left, 1 - top), letter, fill=255, font=font)
    return np.array(mask), left - 1, top - 1, float(font.getlength(letter))


@lru_cache(maxsize=4)
def _legend_background(size: tuple[int, int], camera: Camera) -> np.ndarray:
    """The background, and in its lower left corner what the colours of bars and cables mean."""
    canvas = Canvas(size, camera)
    height = max(size[1] // 40, 9)
    scales = ((BAR_COLOURS, "bars: load / critical load, 0 to 1"), (CABLE_COLOURS, "cables: tension; pale: slack"))
    for row, (colours, words) in enumerate(scales):
        y = size[1] - (2.8 - 1.5 * row) * height
        x = np.linspace(height, 5 * height, 25)
        ends = np.column_stack([x[:-1], np.full(24, y), x[1:], np.full(24, y)])
        canvas.strokes(ends, 0.45 * height / canvas.pixels_per_metre, _shades(colours, np.linspace(0, 1, 24)))
        canvas.text((5.8 * height / size[0], (y - 0.6 * height) / size[1]), words, height, left=True)
    return canvas.pixels


@lru_cache(maxsize=4)
def _background(final: tuple[int, int], camera: Camera) -> np.ndarray:
    """Sky, and a strip of ground across the picture with a grid of squares, shape (h, w, 3) uint8."""
    size = (final[0] * SUPERSAMPLING, final[1] * SUPERSAMPLING)
    spacing = 0.5 if camera.width < 8 else 2.0 if camera.width < 32 else 10.0
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
    return np.array(picture.reduce(SUPERSAMPLING))


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
