"""The floor: how far a landing moves when the start is known no better than anything can be known.

Maps over the stretches, for touchdown and rest, and what makes a hop predictable or not; on Earth, on the Moon and on a slope.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from benchmarks.accuracy.part import Data, Options, Part, kept, table
from benchmarks.accuracy.samples import hop_perturbed, stretches
from tensegrity_gym import Design, HopStatus, Scene, form_find
from tensegrity_gym.types import Floats

KINDS = ("positions", "actuators", "material")
FIELDS = ("takeoff_time", "takeoff_velocity", "apex", "flight_time", "touchdown_time", "touchdown", "rest", "end_time", "status")
PLACES = {"earth": "on Earth", "moon": "on the Moon", "slope": "on a slope"}


def hops(options: Options, n: int, kind: str, seed: int, precision: str = "float32", **changes: Any) -> Data:
    """Events of ``n`` hops with one unknown.

    ``changes``: a preset of the scene, the name of a fidelity, fields of the design or of the scene.
    """

    def measure() -> Data:
        design = Design(**{k: v for k, v in changes.items() if k in Design.__dataclass_fields__})
        scene = Scene.preset(changes.get("preset", "earth"))
        scene = replace(scene, **{k: v for k, v in changes.items() if k in Scene.__dataclass_fields__})
        found = form_find(stretches(n), design=design, scene=scene, threads=1)
        model = {"precision": precision, "fidelity": changes.get("fidelity", "paper")}
        r = hop_perturbed(kind, seed, found, design=design, scene=scene, **model)
        return {name: getattr(r, name) for name in FIELDS}

    return kept(options, "floor-hops", measure, n=n, kind=kind, seed=seed, precision=precision, **changes)


def spread(base: Floats, moved: list[Floats]) -> Floats:
    """Root mean square distance of the perturbed hops from the unperturbed one, shape (n,)."""
    return np.sqrt(np.mean([((m - base) ** 2).reshape(len(base), -1).sum(axis=1) for m in moved], axis=0))


def floors(options: Options, n: int, **changes: Any) -> Data:
    """Floors of every hop of a sample and of every kind."""
    base = hops(options, n, "none", 0, **changes)
    data: Data = {"stretches": stretches(n), **{f"base/{k}": v for k, v in base.items()}}
    for kind, most in zip(KINDS, (4, 2, 2), strict=True):
        moved = [hops(options, n, kind, seed, **changes) for seed in range(1, options.size(most, 1) + 1)]
        for name in ("touchdown", "rest", "touchdown_time", "apex"):
            data[f"{kind}/{name}"] = spread(base[name], [m[name] for m in moved])
        level = base["takeoff_velocity"][:, :2]  # level, as the vertical one depends on which foot leaves last, and when
        data[f"{kind}/level_speed"] = spread(level, [m["takeoff_velocity"][:, :2] for m in moved])
    return data


def measure_earth(options: Options) -> Data:
    """Floors on Earth, and whether float32 has the same."""
    data = floors(options, options.size(256, 16))
    small, seeds = options.size(32, 8), (1, 2)
    for precision in ("float32", "float64"):
        start = hops(options, small, "none", 0, precision)
        moved = [hops(options, small, "positions", seed, precision) for seed in seeds]
        for name in ("touchdown", "rest"):
            data[f"{precision}/{name}"] = spread(start[name], [m[name] for m in moved])
            data[f"{precision}/base/{name}"] = start[name]
    return data


def measure_elsewhere(options: Options, preset: str) -> Data:
    """Floors in another scene; and those of the touchdowns of the same hops if their flights are rigid."""
    n = options.size(128, 4)
    rigid = floors(options, n, preset=preset, fidelity="flown", landing="touchdown")
    return floors(options, n, preset=preset) | {f"rigid/{kind}": rigid[f"{kind}/touchdown"] for kind in KINDS}


def flew(d: Data) -> np.ndarray:
    """Which hops have a landing, shape (n,)."""
    return d["base/status"] <= HopStatus.TIME_LIMIT


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


def report(d: Data, preset: str) -> list[str]:
    """Percentiles of the floors, where they come from, and which hops they belong to."""
    there = flew(d)
    rows = []
    for kind in KINDS:
        cells = [kind]
        for name in ("touchdown", "rest"):
            cells += [f"{1e3 * v:.3g}" for v in np.percentile(d[f"{kind}/{name}"][there], (10, 50, 95, 100))]
        cells.append(f"{1e3 * np.median(d[f'{kind}/apex'][there]):.2g}")
        rows.append(cells)
    head = "unknown  touchdown 10 % [mm]  50 %  95 %  worst  rest 10 % [mm]  50 %  95 %  worst  apex 50 % [mm]"
    rested = (d["base/status"][there] == HopStatus.RESTED).mean()
    lines = [
        f"{there.sum()} hops {PLACES[preset]} ({rested:.0%} rested), root mean square over the perturbed starts",
        *table(head, rows),
    ]
    speed = np.median(d["positions/level_speed"][there] * d["base/flight_time"][there])
    # along the ground when it touches down: on a slope the flight gathers speed downhill
    along = d["base/takeoff_velocity"][:, :2] + d["base/flight_time"][:, None] * Scene.preset(preset).ground.gravity[:2]
    pace = np.hypot(along[:, 0], along[:, 1])
    late, fast = np.median((d["positions/touchdown_time"] * pace)[there]), np.median(pace[there])
    worst = [np.argmax(d[f"{kind}/touchdown"] * there) for kind in KINDS]
    instants = [f"{kind} {1e3 * d[f'{kind}/touchdown_time'][i]:.2g} ms" for kind, i in zip(KINDS, worst, strict=True)]
    lines += [
        "",
        f"touchdown, positions: level take-off speed's spread x flight time {1e3 * speed:.3g} mm, "
        f"spread of the instant x speed along the ground ({fast:.2g} m/s) {1e3 * late:.3g} mm (medians)",
        f"spread of the instant in the worst hop: {', '.join(instants)}",
    ]
    rows = []
    for name, values in causes(d).items():
        cells = [name]
        for landing in ("touchdown", "rest"):
            cells.append(f"{spearmanr(values[there], d[f'positions/{landing}'][there]).statistic:+.2f}")
        rows.append(cells)
    lines += ["", *table("rank correlation with the floor of  touchdown  rest", rows)]
    return lines + (compare_precisions(d) if preset == "earth" else compare_flights(d))


def compare_flights(d: Data) -> list[str]:
    """Touchdown floors of hops with rigid flights over those of the same hops in full."""
    rows = []
    for kind in KINDS:
        rigid, full = d[f"rigid/{kind}"][flew(d)], d[f"{kind}/touchdown"][flew(d)]
        ratios = [f"{v:.2f}" for v in (*np.percentile(rigid / full, (5, 50, 95)), np.median(rigid) / np.median(full))]
        rows.append([kind, *ratios])
    return ["", *table("touchdown floor, rigid flight over full  5 %  50 %  95 %  of the medians", rows)]


def compare_precisions(d: Data) -> list[str]:
    """Floors of the same hops in float32 and float64."""
    lines = []
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
    figure, axes = plt.subplots(1, 3, figsize=(11.5, 3.6), layout="constrained")
    for axis, name in zip(axes, ("touchdown", "rest"), strict=False):
        lam, values = d["stretches"][flew(d)], d[f"positions/{name}"][flew(d)]
        limits = np.percentile(values, (2, 98))
        points = axis.scatter(
            lam @ [1.0, -1.0, 1.0, -1.0],
            lam.mean(axis=1),
            c=np.clip(values, *limits),
            norm=plt.matplotlib.colors.LogNorm(*limits),
            s=14,
            cmap="viridis",
        )
        figure.colorbar(points, ax=axis, label="floor [m]")
        axis.set(xlabel="λ₁ − λ₂ + λ₃ − λ₄", ylabel="mean stretch", title=f"{name}, positions ± 10 µm")
    for kind, colour in zip(KINDS, ("C0", "C1", "C2"), strict=True):
        for name, style in (("touchdown", "-"), ("rest", "--")):
            values = np.sort(d[f"{kind}/{name}"][flew(d)])
            axes[2].semilogx(values, np.linspace(0, 1, len(values)), style, color=colour, label=kind if style == "-" else None)
    axes[2].set(xlabel="floor [m], dashed at rest", ylabel="share of hops below")
    axes[2].legend(fontsize=7)
    axes[2].grid(alpha=0.3)
    return figure


PART = Part("floor", measure_earth, partial(report, preset="earth"), plot)
OTHERS = tuple(
    Part(f"floor_{preset}", partial(measure_elsewhere, preset=preset), partial(report, preset=preset), plot)
    for preset in ("moon", "slope")
)
