"""The floor: how far a landing moves when the start is known no better than anything can be known.

Maps over the stretches, for touchdown and rest, and what makes a hop predictable or not.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from benchmarks.accuracy.part import Data, Options, Part, kept, table
from benchmarks.accuracy.samples import hop_perturbed, stretches
from tensegrity_gym import Design, HopStatus, Scene, form_find
from tensegrity_gym.types import Floats

SCENE = Scene()
KINDS = ("positions", "actuators", "material")
FIELDS = ("takeoff_time", "takeoff_velocity", "apex", "flight_time", "touchdown_time", "touchdown", "rest", "end_time", "status")


def hops(options: Options, n: int, kind: str, seed: int, precision: str = "float32", **changes: float) -> Data:
    """Events of ``n`` hops with one unknown; ``changes`` are of the design's or the scene's fields."""

    def measure() -> Data:
        design = Design(**{k: v for k, v in changes.items() if k in Design.__dataclass_fields__})
        scene = Scene(**{k: v for k, v in changes.items() if k in Scene.__dataclass_fields__})  # type: ignore[arg-type]
        found = form_find(stretches(n), design=design, scene=scene, threads=1)
        r = hop_perturbed(kind, seed, found, design=design, scene=scene, precision=precision)
        return {name: getattr(r, name) for name in FIELDS}

    return kept(options, "floor-hops", measure, n=n, kind=kind, seed=seed, precision=precision, **changes)


def spread(base: Floats, moved: list[Floats]) -> Floats:
    """Root mean square distance of the perturbed hops from the unperturbed one, shape (n,)."""
    return np.sqrt(np.mean([((m - base) ** 2).reshape(len(base), -1).sum(axis=1) for m in moved], axis=0))


def measure(options: Options) -> Data:
    """Floors of every hop of the sample and of every kind."""
    n, small = options.size(256, 16), options.size(32, 8)
    base = hops(options, n, "none", 0)
    data: Data = {"stretches": stretches(n), **{f"base/{k}": v for k, v in base.items()}}
    for kind, most in zip(KINDS, (4, 2, 2), strict=True):
        moved = [hops(options, n, kind, seed) for seed in range(1, options.size(most, 2) + 1)]
        for name in ("touchdown", "rest", "touchdown_time", "apex"):
            data[f"{kind}/{name}"] = spread(base[name], [m[name] for m in moved])
        level = base["takeoff_velocity"][:, :2]  # level, as the vertical one depends on which foot leaves last, and when
        data[f"{kind}/level_speed"] = spread(level, [m["takeoff_velocity"][:, :2] for m in moved])
    seeds = (1, 2)
    for precision in ("float32", "float64"):
        start = hops(options, small, "none", 0, precision)
        moved = [hops(options, small, "positions", seed, precision) for seed in seeds]
        for name in ("touchdown", "rest"):
            data[f"{precision}/{name}"] = spread(start[name], [m[name] for m in moved])
            data[f"{precision}/base/{name}"] = start[name]
    return data


def causes(d: Data) -> dict[str, Floats]:
    """What might make a hop unpredictable, each of shape (n,)."""
    lam, velocity = d["stretches"], d["base/takeoff_velocity"]
    return {
        "apex": d["base/apex"],
        "take-off time": d["base/takeoff_time"],
        "flight time": d["base/flight_time"],
        "horizontal speed at take-off": np.hypot(velocity[:, 0], velocity[:, 1]),
        "mean stretch": lam.mean(axis=1),
        "spread of the stretches": lam.std(axis=1),
        "chirality |l1-l2+l3-l4|": np.abs(lam @ [1.0, -1.0, 1.0, -1.0]),
        "distance at touchdown": np.linalg.norm(d["base/touchdown"], axis=1),
        "distance at rest": np.linalg.norm(d["base/rest"], axis=1),
        "travel after touchdown": np.linalg.norm(d["base/rest"] - d["base/touchdown"], axis=1),
        "time after touchdown": d["base/end_time"] - d["base/touchdown_time"],
    }


def report(d: Data) -> list[str]:
    """Percentiles of the floors, where they come from, and which hops they belong to."""
    flew = d["base/status"] <= HopStatus.TIME_LIMIT
    rows = []
    for kind in KINDS:
        cells = [kind]
        for name in ("touchdown", "rest"):
            cells += [f"{1e3 * v:.3g}" for v in np.percentile(d[f"{kind}/{name}"][flew], (10, 50, 95, 100))]
        cells.append(f"{1e3 * np.median(d[f'{kind}/apex'][flew]):.2g}")
        rows.append(cells)
    head = "unknown  touchdown 10 % [mm]  50 %  95 %  worst  rest 10 % [mm]  50 %  95 %  worst  apex 50 % [mm]"
    lines = [f"{flew.sum()} hops on Earth, root mean square over the perturbed starts", *table(head, rows)]
    speed = np.median(d["positions/level_speed"][flew] * d["base/flight_time"][flew])
    late = d["positions/touchdown_time"] * np.hypot(d["base/takeoff_velocity"][:, 0], d["base/takeoff_velocity"][:, 1])
    lines += [
        "",
        f"touchdown, positions: level take-off speed's spread x flight time {1e3 * speed:.3g} mm, "
        f"spread of the instant x horizontal speed {1e3 * np.median(late[flew]):.3g} mm (medians)",
    ]
    rows = []
    for name, values in causes(d).items():
        cells = [name]
        for landing in ("touchdown", "rest"):
            cells.append(f"{spearmanr(values[flew], d[f'positions/{landing}'][flew]).statistic:+.2f}")
        rows.append(cells)
    lines += ["", *table("rank correlation with the floor of  touchdown  rest", rows)]
    for name in ("touchdown", "rest"):
        single, double = d[f"float32/{name}"], d[f"float64/{name}"]
        apart = np.linalg.norm(d[f"float32/base/{name}"] - d[f"float64/base/{name}"], axis=1)
        lines.append(
            f"{name}: floor in float32 {1e3 * np.median(single):.3g}, in float64 {1e3 * np.median(double):.3g}; "
            f"float32 from float64 {1e3 * np.median(apart):.3g} mm (medians of {len(single)})"
        )
    return lines


def plot(d: Data) -> Figure:
    """Floors over the plane of the two largest effects: mean stretch and chirality; and their distributions."""
    flew = d["base/status"] <= HopStatus.TIME_LIMIT
    lam = d["stretches"][flew]
    figure, axes = plt.subplots(1, 3, figsize=(11.5, 3.6), layout="constrained")
    for axis, name, limits in zip(axes, ("touchdown", "rest"), ((3e-5, 2e-3), (3e-3, 0.3)), strict=False):
        points = axis.scatter(
            lam @ [1.0, -1.0, 1.0, -1.0],
            lam.mean(axis=1),
            c=np.clip(d[f"positions/{name}"][flew], *limits),
            norm=plt.matplotlib.colors.LogNorm(*limits),
            s=14,
            cmap="viridis",
        )
        figure.colorbar(points, ax=axis, label="floor [m]")
        axis.set(xlabel="λ₁ − λ₂ + λ₃ − λ₄", ylabel="mean stretch", title=f"{name}, positions ± 10 µm")
    for kind, colour in zip(KINDS, ("C0", "C1", "C2"), strict=True):
        for name, style in (("touchdown", "-"), ("rest", "--")):
            values = np.sort(d[f"{kind}/{name}"][flew])
            axes[2].semilogx(values, np.linspace(0, 1, len(values)), style, color=colour, label=f"{name}, {kind}")
    axes[2].set(xlabel="floor [m]", ylabel="share of hops below")
    axes[2].legend(fontsize=7, loc="lower right")
    axes[2].grid(alpha=0.3)
    return figure


PART = Part("floor", measure, report, plot)
