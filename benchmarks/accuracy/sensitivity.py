"""The floor against damping, friction and restitution: what decides how far a hop can be predicted."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.accuracy.floor import hops, spread
from benchmarks.accuracy.part import Data, Options, Part, table
from tensegrity_gym import Design, HopStatus, Scene

#: Each lever alone; everything else at its default.
LEVERS = {
    "hinge_damping": (0.0, 4e-5, 1.2e-4, 4e-4, 1.2e-3),
    "cable_damping": (0.0, 1e-5, 1e-4, 3e-4),
    "friction": (0.0, 0.3, 0.5, 1.0, 5.0),
    "restitution": (0.0, 0.3, 0.6, 0.9),
}
#: About what rods and wire rope lose by themselves: damping ratios of 0.5 % at a bar's first mode, of 1 to 5 % at the cables'.
BARE = {"hinge_damping": 4e-5, "cable_damping": 1e-5}


def default(lever: str) -> float:
    """The value that this project uses."""
    return float(getattr(Design() if lever in Design.__dataclass_fields__ else Scene(), lever))


def settings(quick: bool) -> list[tuple[str, float]]:
    """Every lever with every value; in a quick run only with the ends and the default."""
    few = {lever: sorted({values[0], default(lever), values[-1]}) for lever, values in LEVERS.items()}
    return [(lever, value) for lever, values in (few if quick else LEVERS).items() for value in values]


def measured(d: Data, lever: str) -> list[float]:
    """The values of a lever that there are data of."""
    return [value for value in LEVERS[lever] if f"{lever}/{value:g}/status" in d]


def measure(options: Options) -> Data:
    """Floors (positions, 10 micrometres) of a sample of hops for every value of every lever."""
    n, seeds, data = options.size(48, 16), options.size(2, 1), {}
    cases = {f"{lever}/{value:g}": {lever: value} for lever, value in settings(options.quick)} | {"bare/0": BARE}
    for case, values in cases.items():
        changes = {lever: value for lever, value in values.items() if value != default(lever)}
        base = hops(options, n, "none", 0, **changes)
        moved = [hops(options, n, "positions", seed, **changes) for seed in range(1, seeds + 1)]
        for name in ("touchdown", "rest"):
            data[f"{case}/{name}"] = spread(base[name], [m[name] for m in moved])
        data[f"{case}/status"] = base["status"]
        data[f"{case}/travel"] = np.linalg.norm(base["rest"], axis=1)
        data[f"{case}/apex"] = base["apex"]
    return data


def report(d: Data) -> list[str]:
    """Floors and what else the lever changes."""
    rows = []
    pairs = [(lever, value) for lever in LEVERS for value in measured(d, lever)]
    for lever, value in [*pairs, ("bare", 0.0)]:
        at = f"{lever}/{value:g}"
        flew = d[f"{at}/status"] <= HopStatus.TIME_LIMIT
        marked = lever != "bare" and value == default(lever)
        cells = [lever, f"{value:g} *" if marked else f"{value:g}  "]
        for name in ("touchdown", "rest"):
            cells += [f"{1e3 * v:.3g}" for v in np.percentile(d[f"{at}/{name}"][flew], (50, 95))]
        cells.append(f"{np.median(d[f'{at}/apex'][flew]):.2f}")
        cells.append(f"{np.median(d[f'{at}/travel'][flew]):.2f}")
        cells.append(f"{(d[f'{at}/status'] == HopStatus.RESTED).mean():.0%}")
        rows.append(cells)
    head = "lever  value  touchdown 50 % [mm]  95 %  rest 50 % [mm]  95 %  apex [m]  travel at rest [m]  rested in 3 s"
    return [f"* default; bare: {BARE}; medians over the hops that flew", *table(head, rows)]


def plot(d: Data) -> Figure:
    """Medians and 95 % of the floors, one panel for each lever."""
    figure, axes = plt.subplots(1, 4, figsize=(12, 3.3), layout="constrained", sharey=True)
    for axis, lever in zip(axes, LEVERS, strict=True):
        values = measured(d, lever)
        place = np.arange(len(values))
        for name, colour in (("touchdown", "C0"), ("rest", "C3")):
            flew = [d[f"{lever}/{v:g}/status"] <= HopStatus.TIME_LIMIT for v in values]
            marks = np.array([np.percentile(d[f"{lever}/{v:g}/{name}"][f], (50, 95)) for v, f in zip(values, flew, strict=True)])
            axis.semilogy(place, marks[:, 0], "o-", color=colour, label=f"{name}, median")
            axis.semilogy(place, marks[:, 1], "^:", color=colour, lw=0.8, label=f"{name}, 95 %")
        axis.axvline(values.index(default(lever)), color="0.8", lw=6, zorder=0)
        axis.set(xlabel=lever.replace("_", " "), xticks=place, xticklabels=[f"{v:g}" for v in values])
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("floor [m]; the bar marks the default")
    axes[0].legend(fontsize=7)
    return figure


PART = Part("sensitivity", measure, report, plot)
