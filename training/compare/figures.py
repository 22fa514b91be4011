"""Pictures of a comparison."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no window

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from surrogate.figures import COLOURS, STYLE, write_png
from training.compare.methods import label
from training.compare.results import Outcome
from training.compare.statistics import performance_profile

MARKERS = ("o", "s", "^", "v", "D", "P", "X", "<", ">", "*")


def _style() -> AbstractContextManager[None]:
    return plt.rc_context(STYLE | {"figure.dpi": 95})  # type: ignore[arg-type]


def _look(k: int) -> dict[str, object]:
    return {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)], "ls": "-" if k < len(COLOURS) else "--"}


def _levels(axes: Axes, outcome: Outcome, along: str = "y") -> None:
    draw = axes.axhline if along == "y" else axes.axvline
    draw(outcome.factor * outcome.floor, color="#888888", ls=":", label="floor: start moved by 10 µm")
    if outcome.scatter is not None:
        draw(outcome.factor * outcome.scatter, color="#888888", ls=(0, (1, 4)), label="scatter of the best answers")
    if outcome.oracle_error is not None:
        draw(outcome.factor * outcome.oracle_error, color="#888888", ls="--", label="CMA-ES on the simulator")


def sample_efficiency(outcome: Outcome, path: Path) -> Path:
    """Interquartile mean error against simulator calls, with its interval."""
    with _style():
        figure, axes = plt.subplots(figsize=(9, 4.6), layout="constrained")
        for k, method in enumerate(outcome.methods):
            budgets = outcome.budgets(method)
            found = [outcome.summary(method, b) for b in budgets]
            axes.plot(budgets, [outcome.factor * s.mean for s in found], label=label(method), ms=5, **_look(k))  # type: ignore[arg-type]
            if found[0].seeds > 1:
                low, high = [outcome.factor * s.low for s in found], [outcome.factor * s.high for s in found]
                axes.fill_between(budgets, low, high, color=COLOURS[k % len(COLOURS)], alpha=0.15, lw=0)
        _levels(axes, outcome)
        axes.set(xscale="log", yscale="log", xlabel="simulator calls learnt from", ylabel=f"landing error, IQM [{outcome.shown}]")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9)
        return write_png(figure, path, outcome.all.digest)


def profiles(outcome: Outcome, budget: int, path: Path) -> Path:
    """Share of answers that err by less than a radius, at one budget."""
    radii = np.geomspace(6e-4, 2, 200) * float((outcome.reaches / outcome.unit).max())
    with _style():
        figure, axes = plt.subplots(figsize=(9, 4.2), layout="constrained")
        for method in (m for m in outcome.methods if budget in outcome.budgets(m)):
            share = performance_profile(outcome.errors(method, budget), radii)
            look = _look(outcome.methods.index(method)) | {"marker": None}
            axes.plot(outcome.factor * radii, 100 * share, label=label(method), **look)  # type: ignore[arg-type]
        _levels(axes, outcome, along="x")
        axes.set(
            xscale="log", xlabel=f"radius around the target [{outcome.shown}]", ylabel="answers within it [%]", ylim=(0, 101)
        )
        axes.xaxis.set_major_formatter("{x:g}")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9)
        return write_png(figure, path, outcome.all.digest)


def pareto(outcome: Outcome, path: Path) -> Path:
    """Time spent learning against error, one point per method and budget; larger marks are larger budgets."""
    with _style():
        figure, axes = plt.subplots(figsize=(9, 4.6), layout="constrained")
        for k, method in enumerate(outcome.methods):
            budgets = outcome.budgets(method)
            seconds = [max(outcome.learning_seconds(method, b), 1e-3) for b in budgets]
            errors = [outcome.factor * outcome.summary(method, b).mean for b in budgets]
            axes.plot(seconds, errors, label=label(method), lw=0.8, ms=0, **(_look(k) | {"marker": None}))  # type: ignore[arg-type]
            sizes = [12 * np.log10(b) ** 1.5 for b in budgets]
            axes.scatter(seconds, errors, s=sizes, color=COLOURS[k % len(COLOURS)], marker=MARKERS[k % len(MARKERS)])
        _levels(axes, outcome)
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="wall time of learning, simulating left out [s]",
            ylabel=f"landing error, IQM [{outcome.shown}]",
        )
        axes.yaxis.set_major_formatter("{x:g}")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9)
        return write_png(figure, path, outcome.all.digest)
