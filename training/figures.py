"""The demo's pictures."""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no window

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from surrogate.dataset import HopData
from surrogate.figures import COLOURS, STYLE, write_png
from surrogate.model import OUTPUTS, target_columns
from surrogate.storage import atomic_path
from tensegrity_gym import ENERGY_NAMES, HopResult, render
from training.score import Score


def _style() -> AbstractContextManager[None]:
    return plt.rc_context(STYLE)  # type: ignore[arg-type]


def filmstrip(result: HopResult, path: Path) -> Path:
    """The recorded hop as a strip of postures."""
    assert result.trajectory is not None, "a filmstrip is drawn of a hop simulated with a trajectory"
    picture = io.BytesIO()
    Image.fromarray(render.filmstrip(result.trajectory)).save(picture, format="PNG")
    with atomic_path(path) as temporary:
        temporary.write_bytes(picture.getvalue())
    return path


def energies(result: HopResult, path: Path) -> float:
    """Energies of the recorded hop over time; returns the largest departure of their sum [% of the stored energy]."""
    trajectory = result.trajectory
    assert trajectory is not None, "energies are drawn of a hop simulated with a trajectory"
    count = int(trajectory.frames[0])
    times, parts = trajectory.times[0, :count], trajectory.energies[0, :count]
    total = parts.sum(axis=1)
    closure = 100 * float(np.abs(total - total[0]).max() / result.stored_energy[0])
    with _style():
        figure, axes = plt.subplots(figsize=(9, 4.8))
        for k, name in enumerate(ENERGY_NAMES):
            label = name.replace("dissipated_", "dissipated by ").replace("_", " ")
            label = f"elastic, {label}" if k < 3 else label
            axes.plot(times, parts[:, k], color=COLOURS[k], lw=1.8, ls="--" if "dissipated" in name else "-", label=label)
        axes.plot(times, total, color="#888888", lw=3, alpha=0.6, label=f"sum (constant to {closure:.2g} % of stored)")
        for when, what in ((result.takeoff_time[0], "take-off"), (result.touchdown_time[0], "touchdown")):
            if np.isfinite(when):
                axes.axvline(when, color="#888888", lw=0.8, ls=":")
                axes.annotate(
                    what,
                    (when, 1.0),
                    xycoords=("data", "axes fraction"),
                    xytext=(3, -2),
                    textcoords="offset points",
                    va="top",
                    fontsize=9,
                )
        axes.set(xlabel="time since release [s]", ylabel="energy [J]", xlim=(0, times[-1]))
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        write_png(figure, path)
    return closure


def landing_map(data: HopData, path: Path) -> Path:
    """Rest and touchdown of stored hops, coloured by the alternating sum of their stretches."""
    alternating = data["stretches"] @ np.array([(-1.0) ** k for k in range(data["stretches"].shape[1])])
    with _style():
        figure, axes = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained")
        for ax, name, title in zip(axes, ("rest", "touchdown"), ("at rest", "at touchdown"), strict=True):
            marks = ax.scatter(
                *data[name].T, c=alternating, cmap="coolwarm", vmin=-1.2, vmax=1.2, s=26, edgecolors="#444444", linewidths=0.3
            )
            ax.plot(0, 0, "+", color="black", ms=10)
            ax.set(title=f"{title}, {len(data)} hops", xlabel="x [m]", ylabel="y [m]")
            ax.set_aspect("equal", adjustable="datalim")
        figure.colorbar(marks, ax=axes, label="λ1 − λ2 + λ3 − λ4", shrink=0.9)
        return write_png(figure, path)


def predicted_against_simulated(predicted: np.ndarray, held_out: HopData, path: Path) -> Path:
    """Scatter of predictions, shape (n, len(OUTPUTS)), against the held-out hops."""
    simulated = target_columns(held_out)
    chosen = [k for k, o in enumerate(OUTPUTS) if not o.name.startswith("takeoff_velocity")]
    with _style():
        figure, axes = plt.subplots(2, 3, figsize=(11, 7), layout="constrained")
        for ax, k in zip(axes.flat, chosen, strict=True):
            output, known = OUTPUTS[k], np.isfinite(simulated[:, k])
            ax.scatter(simulated[known, k], predicted[known, k], s=18, color=COLOURS[0], alpha=0.8)
            ends = np.array([simulated[known, k].min(), simulated[known, k].max()]) if known.any() else np.zeros(2)
            ax.plot(ends, ends, color="#888888", lw=1)
            error = np.sqrt(np.mean((predicted[known, k] - simulated[known, k]) ** 2)) if known.any() else float("nan")
            ax.set(title=f"{output.name.replace('_', ' ')}: RMSE {error:.3g} {output.unit}")
            ax.set(xlabel=f"simulated [{output.unit}]", ylabel=f"predicted [{output.unit}]")
        return write_png(figure, path)


def plans(targets: np.ndarray, scores: Mapping[str, Score], path: Path) -> Path:
    """Targets and where each method's answers landed from their moved starts, joined by lines."""
    with _style():
        figure, axes = plt.subplots(
            1, len(scores), figsize=(4 * len(scores), 4.2), layout="constrained", sharex=True, sharey=True
        )
        for k, (ax, (label, found)) in enumerate(zip(np.atleast_1d(axes), scores.items(), strict=True)):
            meant = np.repeat(targets, found.starts, axis=0)
            landed = found.landings.reshape(-1, 2)
            ax.plot(*np.stack([meant, landed]).transpose(2, 0, 1), color="#999999", lw=0.4)
            ax.plot(*targets.T, "o", mfc="none", mec="black", ms=6, label="target")
            ax.plot(*landed.T, ".", color=COLOURS[k], ms=4, label="landings from moved starts")
            median = float(f"{1e3 * np.median(found.errors):.2g}")  # two digits, and no exponent where they are metres
            ax.set(title=f"{label}\nmedian error {median:g} mm", xlabel="x [m]", aspect="equal")
            ax.title.set_fontsize(11)
        np.atleast_1d(axes)[0].set(ylabel="y [m]")
        np.atleast_1d(axes)[0].legend(loc="upper left", bbox_to_anchor=(0, 0), borderaxespad=4.5, fontsize=9)
        return write_png(figure, path)


def error_against_calls(scores: Mapping[str, Mapping[int, Score]], reach: float, floor: float, path: Path) -> Path:
    """Landing error of each method against the simulator calls that it learnt from, above the ``floor`` [m]."""

    def percent(metre: Any) -> Any:
        return 100 * metre / reach

    def metres(percentage: Any) -> Any:
        return percentage * reach / 100

    with _style():
        figure, axes = plt.subplots(figsize=(7.5, 5.4), layout="constrained")
        for k, (label, by_calls) in enumerate(scores.items()):
            calls = np.array(sorted(by_calls))
            low, middle, high = np.array([np.quantile(by_calls[c].errors, (0.25, 0.5, 0.75)) for c in calls]).T
            axes.plot(calls, middle, "o-", color=COLOURS[k], label=label)
            axes.fill_between(calls, np.maximum(low, 1e-6), high, color=COLOURS[k], alpha=0.13, lw=0)
        axes.axhline(floor, color="#888888", ls=":", label="floor: start moved by 10 µm")
        axes.set(xscale="log", yscale="log", xlabel="simulator calls learnt from", ylabel="landing error [m]")
        every = sorted(set().union(*scores.values()))
        axes.set_xticks(every, [str(c) for c in every])
        axes.minorticks_off()
        right = axes.secondary_yaxis("right", functions=(percent, metres))
        right.set_ylabel("landing error [% of reach]")
        for axis in (axes.yaxis, right.yaxis):
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter("")
        figure.legend(loc="outside lower center", ncols=2)
        return write_png(figure, path)
