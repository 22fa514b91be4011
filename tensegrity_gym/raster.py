"""Strokes on a picture, with smooth edges at the picture's own size: kernels for :mod:`tensegrity_gym.canvas`."""

from __future__ import annotations

import numpy as np

from tensegrity_gym.core.jit import jit


@jit
def _span(x0, y0, x1, y1, margin, y, width):
    """First and last pixel of row ``y`` that can lie within ``margin`` of the stroke."""
    low, high = min(x0, x1), max(x0, x1)
    rise = y1 - y0
    if abs(rise) > 1e-9:
        a, b = (y - margin - y0) / rise, (y + margin - y0) / rise
        xa = x0 + min(max(a, 0.0), 1.0) * (x1 - x0)
        xb = x0 + min(max(b, 0.0), 1.0) * (x1 - x0)
        low, high = min(xa, xb), max(xa, xb)
    return max(int(np.floor(low - margin)), 0), min(int(np.ceil(high + margin)), width - 1)


@jit
def _distance(x0, y0, dx, dy, inverse, x, y):
    """Distance of a pixel from a stroke that starts at (x0, y0) and goes (dx, dy); ``inverse`` is 1/(dx^2 + dy^2)."""
    along = min(max(((x - x0) * dx + (y - y0) * dy) * inverse, 0.0), 1.0)
    ex, ey = x - x0 - along * dx, y - y0 - along * dy
    return np.sqrt(ex * ex + ey * ey)


@jit(cache=True, fastmath=True)
def draw_strokes(picture, ends, radius, colour):
    """Paint strokes with round ends over a picture (h, w, 3) uint8, in order.

    ``ends`` (n, 4) are x, y of both ends, ``radius`` (n,) half the width, all in pixels; ``colour`` is (n, 3), 0 to 255.
    What is thinner than a pixel is painted one pixel wide and accordingly paler.
    """
    height, width = picture.shape[0], picture.shape[1]
    for k in range(ends.shape[0]):
        x0, y0, x1, y1 = ends[k, 0], ends[k, 1], ends[k, 2], ends[k, 3]
        strength = min(1.0, 2.0 * radius[k])
        r = max(radius[k], 0.5)
        margin = r + 0.5
        dx, dy = x1 - x0, y1 - y0
        inverse = 1.0 / max(dx * dx + dy * dy, 1e-12)
        red, green, blue = colour[k, 0], colour[k, 1], colour[k, 2]
        first = max(int(np.floor(min(y0, y1) - margin)), 0)
        last = min(int(np.ceil(max(y0, y1) + margin)), height - 1)
        for y in range(first, last + 1):
            left, right = _span(x0, y0, x1, y1, margin, y, width)
            for x in range(left, right + 1):
                cover = strength * min(margin - _distance(x0, y0, dx, dy, inverse, x, y), 1.0)
                if cover > 0.0:
                    picture[y, x, 0] = np.uint8(picture[y, x, 0] + cover * (red - picture[y, x, 0]) + 0.5)
                    picture[y, x, 1] = np.uint8(picture[y, x, 1] + cover * (green - picture[y, x, 1]) + 0.5)
                    picture[y, x, 2] = np.uint8(picture[y, x, 2] + cover * (blue - picture[y, x, 2]) + 0.5)


@jit(cache=True, fastmath=True)
def draw_shade(picture, mask, ends, radius, soft, colour, strength):
    """Darken a picture (h, w, 3) uint8 where strokes (n, 4) lie, towards ``colour`` (3,); where they cross, once.

    Edges fade over ``soft`` pixels. ``mask`` is scratch of shape (h, w), float32 zeros, and left so.
    """
    height, width = picture.shape[0], picture.shape[1]
    top, bottom, west, east = height, -1, width, -1
    for k in range(ends.shape[0]):
        x0, y0, x1, y1 = ends[k, 0], ends[k, 1], ends[k, 2], ends[k, 3]
        margin = radius + soft
        dx, dy = x1 - x0, y1 - y0
        inverse = 1.0 / max(dx * dx + dy * dy, 1e-12)
        first = max(int(np.floor(min(y0, y1) - margin)), 0)
        last = min(int(np.ceil(max(y0, y1) + margin)), height - 1)
        for y in range(first, last + 1):
            left, right = _span(x0, y0, x1, y1, margin, y, width)
            for x in range(left, right + 1):
                cover = min((margin - _distance(x0, y0, dx, dy, inverse, x, y)) / (2.0 * soft), 1.0)
                if cover > mask[y, x]:
                    mask[y, x] = cover
            west, east = min(west, left), max(east, right)
        top, bottom = min(top, first), max(bottom, last)
    for y in range(max(top, 0), bottom + 1):
        for x in range(west, east + 1):
            share = strength * mask[y, x]
            if share > 0.0:
                for c in range(3):
                    picture[y, x, c] = np.uint8(picture[y, x, c] + share * (colour[c] - picture[y, x, c]) + 0.5)
                mask[y, x] = 0.0


@jit(cache=True, fastmath=True)
def draw_mask(picture, cover, left, top, colour):
    """Paint ``colour`` (3,) through a mask (h, w) uint8 whose upper left corner is at (left, top)."""
    for y in range(max(0, -top), min(cover.shape[0], picture.shape[0] - top)):
        for x in range(max(0, -left), min(cover.shape[1], picture.shape[1] - left)):
            share = cover[y, x] / 255.0
            if share > 0.0:
                for c in range(3):
                    old = picture[top + y, left + x, c]
                    picture[top + y, left + x, c] = np.uint8(old + share * (colour[c] - old) + 0.5)
