"""Pictures of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no window

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from surrogate.figures import COLOURS, STYLE, write_png
from training.compare.methods import algorithm_of, begins_from, label
from training.compare.results import Outcome
from training.compare.statistics import performance_profile

#: Colours, numbers of ``COLOURS``, by what answers rest on: methods that rest on the same are told apart by their lines.
COLOUR_OF = {"nearest": 0, "ensemble": 5, "in turn": 1, "single": 3, "tandem": 3, "cma": 3, "sac": 2, "td3": 6, "ppo": 4}
LINES = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"), ((0, (5, 1, 1, 1, 1, 1)), "v"))


def _style() -> AbstractContextManager[None]:
    return plt.rc_context(STYLE | {"figure.dpi": 95})  # type: ignore[arg-type]


def looks(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour, line and marker of each method: no two are alike."""
    found: dict[str, dict[str, Any]] = {}
    used: dict[str, int] = {}
    for method in methods:
        in_turn = begins_from(method) == "ensemble" and not method.startswith(("ensemble", "best"))
        colour = COLOURS[COLOUR_OF["in turn" if in_turn else begins_from(algorithm_of(method)[0])]]
        line, marker = LINES[used.get(colour, 0) % len(LINES)]
        used[colour] = used.get(colour, 0) + 1
        found[method] = {"color": colour, "ls": line, "marker": marker, "ms": 5}
    return found


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
        for method, look in looks(outcome.methods).items():
            budgets = outcome.budgets(method)
            found = [outcome.summary(method, b) for b in budgets]
            axes.plot(budgets, [outcome.factor * s.mean for s in found], label=label(method), **look)
            if found[0].seeds > 1:
                low, high = [outcome.factor * s.low for s in found], [outcome.factor * s.high for s in found]
                axes.fill_between(budgets, low, high, color=look["color"], alpha=0.15, lw=0)
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
        for method, look in looks(outcome.methods).items():
            if budget in outcome.budgets(method):
                share = performance_profile(outcome.errors(method, budget), radii)
                axes.plot(outcome.factor * radii, 100 * share, label=label(method), markevery=(0.02, 0.1), **look)
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
        for method, look in looks(outcome.methods).items():
            budgets = outcome.budgets(method)
            seconds = [max(outcome.learning_seconds(method, b), 1e-3) for b in budgets]
            errors = [outcome.factor * outcome.summary(method, b).mean for b in budgets]
            axes.plot(seconds, errors, label=label(method), lw=0.8, **look)
            sizes = [12 * np.log10(b) ** 1.5 for b in budgets]
            axes.scatter(
                seconds, errors, s=sizes, color=look["color"], marker=look["marker"], edgecolor="white", lw=0.5, zorder=3
            )
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
