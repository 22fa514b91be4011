"""Pictures of how good a surrogate is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import EngFormatter, FormatStrFormatter, LogLocator, NullFormatter

from surrogate.dataset import HopData
from surrogate.figures import COLOURS, STYLE, Figure, plt, write_png
from surrogate.model import HopNet
from surrogate.outputs import OUTPUTS, target_columns
from surrogate.scores import PLANES, of_data

if TYPE_CHECKING:
    from surrogate.evaluate import Evaluation

Studies = dict[str, dict[str, Any]]
FLOOR = "start moved by 1e-05 m"


def draw(net: HopNet, rows: HopData, found: Evaluation, studies: Studies, folder: Path) -> list[Path]:
    """Draw what there are numbers for into ``folder``; returns the pictures' paths."""
    pictures: dict[str, Callable[[], Figure]] = {
        "surrogate_calibration.png": lambda: calibration(found),
        "surrogate_error_map.png": lambda: error_map(net, rows),
        "surrogate_doubt.png": lambda: doubt(net, rows, found),
    }
    if studies.get("sizes"):
        pictures["surrogate_data_size.png"] = lambda: data_size(studies["sizes"], found)
    if studies.get("nets"):
        pictures["surrogate_nets.png"] = lambda: nets(studies["nets"])
    if found.floor:
        pictures["surrogate_roughness.png"] = lambda: roughness(found)
    return [_save(make, folder / name) for name, make in pictures.items()]


def _save(make: Callable[[], Figure], path: Path) -> Path:
    with plt.rc_context(STYLE | {"figure.dpi": 100}):  # type: ignore[arg-type]
        return write_png(make(), path)


def calibration(found: Evaluation) -> Figure:
    """Reliability: share of hops inside each predicted interval against what it should be."""
    figure, axis = plt.subplots(figsize=(5.2, 5), layout="constrained")
    levels = 100 * np.array(found.levels)
    axis.fill_between(levels, levels - 5, levels + 5, color="0.9", label="within 5 %")
    axis.plot(levels, levels, color="0.5", lw=1)
    for k, output in enumerate(OUTPUTS):
        covered = 100 * np.array(found.coverage[output.name])
        axis.plot(levels, covered, ".-", ms=4, lw=1, color=COLOURS[k % len(COLOURS)], label=output.name.replace("_", " "))
    axis.set(xlabel="predicted interval [%]", ylabel=f"{found.split} hops inside it [%]", aspect="equal")
    axis.legend(fontsize=8)
    return figure


def error_map(net: HopNet, rows: HopData) -> Figure:
    """Error over the plane of landings, as medians of hexagons."""
    prediction, targets = of_data(net, rows).mean, target_columns(rows)
    figure, axes = plt.subplots(1, 2, figsize=(8.6, 3.9), layout="constrained")
    for axis, (name, (x, y)) in zip(axes, PLANES.items(), strict=True):
        error = 1e3 * np.hypot(*(prediction - targets)[:, [x, y]].T)
        known = np.isfinite(error)
        side = 1.05 * float(np.percentile(np.abs(targets[known][:, [x, y]]), 99.5) or 1.0)
        hexes = axis.hexbin(
            targets[known, x], targets[known, y], C=error[known], reduce_C_function=np.median, gridsize=18, cmap="viridis",
            extent=(-side, side, -side, side),
        )  # fmt: skip
        axis.set(xlabel="x [m]", ylabel="y [m]", title=_title(name, rows), aspect="equal", xlim=(-side, side), ylim=(-side, side))
        figure.colorbar(hexes, ax=axis, label="median error [mm]", shrink=0.85)
    return figure


def _title(name: str, rows: HopData) -> str:
    read = rows.configuration["scene"]["landing"]
    return f"landing (read at {read})" if name == "landing" else name


def doubt(net: HopNet, rows: HopData, found: Evaluation) -> Figure:
    """Real error of hops sorted by the error that the surrogate expected, in twenty equal groups."""
    prediction, targets = of_data(net, rows), target_columns(rows)
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for axis, (name, (x, y)) in zip(axes, PLANES.items(), strict=True):
        error = 1e3 * np.hypot(*(prediction.mean - targets)[:, [x, y]].T)
        expected = 1e3 * np.hypot(*prediction.deviation[:, [x, y]].T)
        known = np.isfinite(error)
        error, expected = error[known], expected[known]
        groups = np.array_split(np.argsort(expected), min(20, len(error)))
        axis.loglog(expected, np.maximum(error, 1e-6), ".", ms=2, alpha=0.3, color=COLOURS[4])
        means = [(np.sqrt((expected[g] ** 2).mean()), np.sqrt((error[g] ** 2).mean())) for g in groups]
        axis.loglog(*np.transpose(means), "o-", color=COLOURS[0], label="rms of groups of 5 %")
        ends = [expected.min(), expected.max()]
        axis.loglog(ends, ends, "--", color="0.4", label="as expected")
        axis.set(xlabel="expected error (doubt) [mm]", ylabel="real error [mm]", ylim=(0.02 * ends[0], 10 * ends[1]))
        axis.set_title(f"{_title(name, rows)}: Spearman {found.ranking[name]['deviation']:.2f}")
        axis.legend()
    return figure


def data_size(cells: dict[str, Any], found: Evaluation) -> Figure:
    """Test error against how many hops were trained on, with the floor."""
    hops = np.array([c["hops"] for c in cells.values()])
    figure, axis = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for k, (name, (x, y)) in enumerate(PLANES.items()):
        error = np.array([c["rms_distance"][name] for c in cells.values()])
        slope = np.polyfit(np.log(hops), np.log(error), 1)[0]
        axis.loglog(hops, 1e3 * error, "o-", color=COLOURS[k], label=f"{name}: falls as hops to the {slope:.2f}")
        axis.axhline(10 * found.reach[name], color=COLOURS[k], lw=1, ls=":", label=f"1 % of {name}'s reach")
        if found.floor:
            least = float(np.hypot(found.floor[FLOOR][OUTPUTS[x].name], found.floor[FLOOR][OUTPUTS[y].name]))
            axis.axhline(1e3 * least, color=COLOURS[k], lw=1, ls="--", label=f"{name}'s floor (rms)")
    axis.set_xticks(hops, [f"{n}" for n in hops], rotation=45)
    axis.minorticks_off()
    axis.set(xlabel="hops trained on", ylabel="rms error of test hops [mm]")
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def nets(cells: dict[str, Any]) -> Figure:
    """Speed against accuracy over widths and depths."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for axis, name in zip(axes, PLANES, strict=True):
        depths = sorted({len(c["hidden"]) for c in cells.values()})
        for k, depth in enumerate(depths):
            chosen = sorted((c for c in cells.values() if len(c["hidden"]) == depth), key=lambda c: c["hidden"])
            rate = [c["speed"]["landings_per_second_member"] for c in chosen]
            error = [1e3 * c["rms_distance"][name] for c in chosen]
            axis.loglog(rate, error, "o-", color=COLOURS[k], label=f"{depth} hidden layers")
            for c, x, y in zip(chosen, rate, error, strict=True):
                axis.annotate(str(c["hidden"][0]), (x, y), textcoords="offset points", xytext=(4, 4), fontsize=8)
        axis.axvline(1e6, color="0.5", lw=1, ls=":")
        for each, form, ticks in ((axis.xaxis, EngFormatter(), (1, 2, 5)), (axis.yaxis, FormatStrFormatter("%g"), range(1, 10))):
            each.set_major_locator(LogLocator(subs=tuple(ticks)))
            each.set_major_formatter(form)
            each.set_minor_formatter(NullFormatter())
        axis.set(xlabel="landings of one member in a second of one core", ylabel="rms error of test hops [mm]", title=name)
        axis.legend()
    return figure


def roughness(found: Evaluation) -> Figure:
    """What a straight line through two near hops misses of a third: how fine a grid of hops the map would need."""
    figure, axis = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    steps = {float(k.rsplit(" ", 1)[1]): v for k, v in found.floor.items() if k.startswith("rough")}
    for k, (name, (x, y)) in enumerate(PLANES.items()):
        apart = [1e3 * float(np.hypot(v[OUTPUTS[x].name], v[OUTPUTS[y].name])) for v in steps.values()]
        axis.loglog(list(steps), apart, "o-", color=COLOURS[k], label=f"{name}: departure from a line")
        axis.axhline(1e3 * found.distance[name]["rms"], color=COLOURS[k], ls=":", lw=1, label=f"{name}: surrogate's error")
        least = float(np.hypot(found.floor[FLOOR][OUTPUTS[x].name], found.floor[FLOOR][OUTPUTS[y].name]))
        axis.axhline(1e3 * least, color=COLOURS[k], lw=1, ls="--", label=f"{name}: floor")
    axis.set(xlabel="distance of neighbours' stretches [-]", ylabel="rms [mm]")
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure
