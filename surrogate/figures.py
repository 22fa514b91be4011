"""Pictures of a file of hops."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from surrogate.hops import HopData
from surrogate.scenes import unit_of
from surrogate.schema import EVENTS, SCENE_VALUES
from surrogate.storage import atomic_path
from tensegrity_gym import ENERGY_NAMES, STRETCH_RANGE, HopStatus
from tensegrity_gym.errors import MissingExtraError
from tensegrity_gym.events import flew
from tensegrity_gym.types import Floats

try:
    import matplotlib

    matplotlib.use("Agg")  # no window
    import matplotlib.pyplot as plt
    from matplotlib.figure import Figure
except ImportError as missing:
    raise MissingExtraError(
        "report: expected matplotlib to be installed, it is not; pip install 'tensegrity-gym[learn]'"
    ) from missing

STYLE = {
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "figure.dpi": 130,
}
# colours that people with any colour vision tell apart (Okabe and Ito)
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#000000")
#: Equal sectors of the compass that reach is measured in; eight of them centre on the lattice's axes and diagonals.
SECTORS = 24


def alternating(stretches: Floats) -> Floats:
    """lambda1 - lambda2 + lambda3 - lambda4 [-], shape (n,)."""
    return stretches @ np.array([(-1.0) ** k for k in range(stretches.shape[1])])


def reach_by_direction(landing: Floats, sectors: int = SECTORS) -> tuple[Floats, Floats, Floats]:
    """Middle of each sector [rad], and the 95th percentile and the largest landing distance in it [m], shape (sectors,).

    Sectors without landings read 0.
    """
    angle, distance = np.arctan2(landing[:, 1], landing[:, 0]), np.hypot(*landing.T)
    width = 2 * np.pi / sectors
    number = np.round(angle / width).astype(int) % sectors
    inside = [distance[number == k] for k in range(sectors)]
    high = np.array([np.percentile(d, 95) if len(d) else 0.0 for d in inside])
    top = np.array([d.max() if len(d) else 0.0 for d in inside])
    return np.arange(sectors) * width, high, top


def places(data: HopData) -> list[str]:
    """Where hops landed: "rest", unless they were not followed so far, and "touchdown"."""
    return [name for name in ("rest", "touchdown") if np.isfinite(data[name]).all()]


def landing_map(data: HopData) -> Figure:
    """Rest and touchdown, coloured by the alternating sum of the stretches (the paper's figure)."""
    colour = alternating(data["stretches"])
    names = places(data)
    figure, axes = plt.subplots(1, len(names), figsize=(6 * len(names), 5.4), layout="constrained", squeeze=False)
    size = float(np.clip(4e4 / max(len(data), 1), 3, 26))
    for axis, name in zip(axes[0], names, strict=True):
        dots = axis.scatter(*data[name].T, c=colour, cmap="coolwarm", vmin=-1.2, vmax=1.2, s=size, linewidths=0)
        axis.plot(0, 0, "+", color="black", ms=10)
        side = 1.05 * float(np.abs(data[name]).max() or 1.0)
        unit = unit_of(data)
        axis.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", title=f"{name} of {len(data)} hops", aspect="equal")
        axis.set(xlim=(-side, side), ylim=(-side, side))
    figure.colorbar(dots, ax=axes, label="λ1 − λ2 + λ3 − λ4 [-]")
    return figure


def reach(data: HopData) -> Figure:
    """How far hops go in each direction."""
    names = places(data)
    polar = {"projection": "polar"}
    figure, axes = plt.subplots(
        1, len(names), figsize=(5.5 * len(names), 5), subplot_kw=polar, layout="constrained", squeeze=False
    )
    for axis, name in zip(axes[0], names, strict=True):
        middle, high, top = reach_by_direction(data[name])
        around = np.append(middle, middle[0] + 2 * np.pi)
        axis.fill(around, np.append(high, high[0]), color=COLOURS[0], alpha=0.25, label="95 % of hops")
        axis.plot(around, np.append(high, high[0]), color=COLOURS[0], lw=1.5)
        axis.plot(around, np.append(top, top[0]), color=COLOURS[5], lw=1.5, label="farthest hop")
        axis.set_title(f"{name}: distance [{unit_of(data)}] by direction")
        axis.set_rlabel_position(22.5)
    axes[0, -1].legend(loc="lower left", bbox_to_anchor=(0.9, 0.9))
    return figure


def apex(data: HopData) -> Figure:
    """Apex against the mean stretch."""
    figure, axis = plt.subplots(figsize=(7, 4.6), layout="constrained")
    size = float(np.clip(4e4 / max(len(data), 1), 3, 26))
    spread = np.ptp(data["stretches"], axis=1)
    dots = axis.scatter(data["stretches"].mean(axis=1), data["apex"], c=spread, s=size, cmap="viridis", linewidths=0)
    scaled = "" if unit_of(data) == "m" else ", times g over the Earth's"
    axis.set(xlabel="mean stretch λ [-]", ylabel=f"apex: rise of the centre of mass [m]{scaled}")
    figure.colorbar(dots, ax=axis, label="largest − least λ of the hop [-]")
    return figure


def energies(data: HopData) -> Figure:
    """Where the stored energy is at each event, mean over hops that flew."""
    up = data.rows(flew(data["status"]))
    share = up["energies"] / up["stored_energy"][:, None, None]
    # gravitational energy counts from the start of the hop
    lift = ENERGY_NAMES.index("gravitational")
    share[:, :, lift] -= share[:, :1, lift].copy()
    mean = 100 * share.mean(axis=0) if len(up) else np.zeros((len(EVENTS), len(ENERGY_NAMES)))
    figure, axis = plt.subplots(figsize=(9, 4.6), layout="constrained")
    bottom = np.zeros(len(EVENTS))
    for k, name in enumerate(ENERGY_NAMES):
        label = name.replace("dissipated_", "dissipated by ")
        axis.bar(EVENTS, mean[:, k], 0.6, bottom=bottom, color=COLOURS[k], label=f"elastic, {label}" if k < 3 else label)
        bottom += np.maximum(mean[:, k], 0.0)
    axis.set(ylabel="share of the stored energy [%]")
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def outcomes(data: HopData) -> Figure:
    """How hops end, by mean stretch."""
    edges = np.linspace(*STRETCH_RANGE, 13)
    mean = data["stretches"].mean(axis=1)
    total = np.maximum(np.histogram(mean, edges)[0], 1)
    figure, axis = plt.subplots(figsize=(9, 4.2), layout="constrained")
    bottom = np.zeros(len(edges) - 1)
    for k, status in enumerate(HopStatus):
        count = np.histogram(mean[data["status"] == status], edges)[0]
        label = f"{status.name.lower().replace('_', ' ')}: {int((data['status'] == status).sum())}"
        axis.bar(edges[:-1], 100 * count / total, np.diff(edges), bottom, align="edge", color=COLOURS[k], label=label)
        bottom += 100 * count / total
    axis.set(xlabel="mean stretch λ [-]", ylabel="share of hops [%]")
    axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def across_scenes(data: HopData) -> Figure:
    """How far hops land [m] against each value of the scene that varies."""
    ranges, names = data.configuration["scene_ranges"], places(data)
    size = (5.5 * len(ranges), 3.8 * len(names))
    figure, axes = plt.subplots(len(names), len(ranges), figsize=size, layout="constrained", squeeze=False)
    for row, name in zip(axes, names, strict=True):
        distance = np.hypot(*data[name].T)
        for axis, (value, (low, high)) in zip(row, ranges.items(), strict=True):
            came = data[f"scene_{value}"]
            axis.scatter(came, distance, s=3, color=COLOURS[0], alpha=0.3, linewidths=0)
            edges = np.linspace(low, high, 9)
            number = np.clip(np.digitize(came, edges) - 1, 0, 7)
            for share, colour in ((50, COLOURS[1]), (95, COLOURS[5])):
                level = [np.percentile(distance[number == k], share) if (number == k).any() else np.nan for k in range(8)]
                axis.stairs(level, edges, color=colour, lw=1.5, baseline=None, label=f"{share} % of hops land nearer")
            axis.set(xlabel=f"{value} [{SCENE_VALUES[value]}]", ylabel=f"{name}: distance [m]", ylim=(0, None))
    axes[0, 0].legend()
    return figure


#: Pictures of a report, in their order, with what each shows.
PICTURES: dict[str, tuple[Callable[[HopData], Figure], str]] = {
    "landing_map.png": (
        landing_map,
        "Where hops came to rest and where they first touched down, coloured by λ1 − λ2 + λ3 − λ4 (the paper's figure).",
    ),
    "reach.png": (reach, "How far hops go in each direction."),
    "apex.png": (apex, "Apex against the mean stretch, coloured by how unequal the four stretches are."),
    "energies.png": (
        energies,
        "Where the stored energy is at release, take-off, touchdown and end: mean over the hops that flew; gravitational "
        "energy counts from the start.",
    ),
    "outcomes.png": (outcomes, "How hops end, by mean stretch."),
}

#: Beside them, where scenes vary.
VARIED: dict[str, tuple[Callable[[HopData], Figure], str]] = {
    "scenes.png": (across_scenes, "How far hops land from their start against each value of the scene that varies."),
}


def save(draw: Callable[[HopData], Figure], data: HopData, path: Path) -> Path:
    """Draw a picture into a PNG."""
    with plt.rc_context(STYLE):  # type: ignore[arg-type]
        return write_png(draw(data), path)


def write_png(figure: Figure, path: Path, made_of: str | None = None) -> Path:
    """Write a PNG atomically and close the figure; ``made_of`` tells, in its text "Source", what it shows."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", bbox_inches="tight", metadata=None if made_of is None else {"Source": made_of})
    plt.close(figure)
    with atomic_path(path) as temporary:
        temporary.write_bytes(picture.getvalue())
    return path
