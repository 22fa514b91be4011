"""The ladder: every lever of a hop's model on one chart of landing error against processor time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.accuracy.part import Data, Options, Part, kept, table
from tensegrity_gym import Design, Fidelity, Lattice, Scene, form_find
from tensegrity_gym.calibration import perturbed, sample_stretches
from tensegrity_gym.hops import hop
from tensegrity_gym.types import Floats

SINGLE = Fidelity(precision="float32")
RIGID = replace(SINGLE, flight="rigid", clearance=0.1, stop="landing")
REFERENCE = Fidelity(step=0.1)
SCENES = ("earth", "moon", "slope")
#: Fields kept of every hop.
FIELDS = ("touchdown", "rest", "apex", "takeoff_velocity", "takeoff_time", "stored_energy", "status")


class Point(NamedTuple):
    """One model on the chart."""

    lever: str
    label: str
    fidelity: Fidelity
    changes: tuple[tuple[str, float], ...] = ()  # of the design's fields


def points() -> Iterator[Point]:
    """All models, lever by lever; each lever's curve starts from the paper's model in float64 or float32."""
    for step in (0.2, 0.4, 0.6, 0.8, 0.95):
        yield Point("step, float64", f"{step:g}", Fidelity(step=step))
    for step in (0.2, 0.4, 0.8):
        yield Point("step, float32", f"{step:g}", replace(SINGLE, step=step))
    for step in (0.4, 0.8):
        yield Point("velocity Verlet", f"{step:g}", Fidelity(integrator="velocity_verlet", step=step))
    for step in (0.4, 0.8, 1.2):
        yield Point("Runge-Kutta", f"{step:g}", Fidelity(integrator="runge_kutta", step=step))
    for softening in (2, 4, 8, 16, 32, 64):
        yield Point("softened bars", f"{softening}x", replace(SINGLE, bar_softening=softening))
    for segments in (1, 2, 5, 9, 17):
        yield Point("bar segments", f"{segments}", replace(SINGLE, bar_segments=segments))
    for clearance in (0.0, 0.05, 0.1, 0.25, 0.5, 1.0):
        yield Point("rigid flight", f"from {clearance:g} l", replace(RIGID, clearance=clearance))
    yield Point("rigid flight", "to rest", replace(RIGID, stop="rest"))
    yield Point("contact", "at nodes", replace(SINGLE, contact="nodes"))
    yield Point("stop", "at touchdown", replace(SINGLE, stop="landing"))
    for name, value in (("bar_damping", 0.0), ("bar_damping", 1e-5), ("cable_damping", 3e-5), ("hinge_damping", 0.0)):
        yield Point("damping", f"{name.removesuffix('_damping')}s {value:g} s", SINGLE, ((name, value),))
    for softening, step in ((4, 0.8), (16, 0.8), (64, 0.8), (1, 0.4)):
        model = replace(RIGID, bar_softening=softening, step=step)
        yield Point("all together", f"{softening}x, {step:g}, rigid", model)


def run(options: Options, scene_name: str, n: int, point: Point) -> Data:
    """Hops of one model: FIELDS, and processor time of equilibria and hops together [s]."""

    def measure() -> Data:
        design, lattice = Design(**dict(point.changes)), Lattice()
        scene = Scene.preset(scene_name, landing="touchdown" if point.fidelity.stop == "landing" else "rest")
        stretches = sample_stretches(n, 5)
        hop_briefly(stretches, design, scene, lattice, point.fidelity)  # compiles
        start = time.process_time()
        found = form_find(stretches, design=point.fidelity.design(design), scene=scene, lattice=lattice, threads=1)
        middle = time.process_time()
        r = hop(found, design=design, scene=scene, lattice=lattice, fidelity=point.fidelity, threads=1)
        seconds = np.array([middle - start, time.process_time() - middle]) / n
        return {"seconds": seconds} | {name: getattr(r, name) for name in FIELDS}

    return kept(options, f"ladder-{scene_name}", measure, n=n, levers=point.fidelity.levers(), changes=point.changes)


def hop_briefly(stretches: Floats, design: Design, scene: Scene, lattice: Lattice, fidelity: Fidelity) -> None:
    """The start of all the hops, so that nothing compiles while time is taken: one alone would run kernels of its own."""
    short = replace(scene, duration=0.1)
    found = form_find(stretches, design=fidelity.design(design), scene=short, lattice=lattice, threads=1)
    hop(found, design=design, scene=short, lattice=lattice, fidelity=fidelity, threads=1)


def floors(options: Options, scene_name: str, n: int, unknowns: int) -> Data:
    """By how much what no one can know moves each hop, the largest of ``unknowns`` [m], shape (n,) each."""

    def measure() -> Data:
        scene, design, lattice = Scene.preset(scene_name), Design(), Lattice()
        how: dict[str, Any] = {"design": design, "scene": scene, "lattice": lattice, "fidelity": SINGLE, "threads": 1}
        base = hop(form_find(sample_stretches(n, 5), scene=scene, threads=1), **how)
        moved = [perturbed(base.equilibria, k + 1, **how) for k in range(unknowns)]
        shifts = {name: [np.linalg.norm(getattr(m, name) - getattr(base, name), axis=1) for m in moved] for name in LANDINGS}
        return {name: np.max(values, axis=0) for name, values in shifts.items()}

    return kept(options, f"ladder-floor-{scene_name}", measure, n=n, unknowns=unknowns)


LANDINGS = ("touchdown", "rest")
#: Where `python -m surrogate train` leaves its net; one trained on hops on Earth is the cheapest model of all.
SURROGATE = Path("runs/surrogate.safetensors")


def surrogate_row(n: int, exact: Data) -> dict[str, Any] | None:
    """The learned model as a point of the chart, if there is one: its landings' errors and seconds a hop, in a batch of 4096."""
    if not SURROGATE.exists():
        return None
    from surrogate.model import load
    from surrogate.outputs import OUTPUTS

    net, card = load(SURROGATE)
    if card["configuration"]["scene"]["gravity"] != Scene.preset(SCENES[0]).gravity:
        return None
    many = sample_stretches(4096, 6)
    net.predict(many)
    start = time.process_time()
    net.predict(many)
    seconds = (time.process_time() - start) / len(many)
    seen, _ = net.predict(sample_stretches(n, 5))
    names = [o.name for o in OUTPUTS]
    row: dict[str, Any] = {"scene": SCENES[0], "lever": "surrogate", "label": "net", "seconds": seconds, "statics": 0.0}
    row |= dict.fromkeys(ERRORS, np.nan) | {"blown up": 0.0}
    for name, column in (("touchdown", "touchdown"), ("rest", "landing")):
        if name == "rest" and card["configuration"]["scene"]["landing"] != "rest":
            continue
        at = seen[:, [names.index(f"{column}_x"), names.index(f"{column}_y")]]
        away = np.linalg.norm(at - exact[name], axis=1)
        row |= {f"{name} {q}": float(np.percentile(away, q)) for q in (50, 95)}
    return row


def measure(options: Options) -> Data:
    """Errors and costs of all points in all scenes; columns of rows (scene, point)."""
    chosen = list(points())
    if options.quick:
        dear = ("velocity Verlet", "Runge-Kutta", "bar segments")
        chosen = [p for p in chosen if p.lever not in dear][::5]
    rows: dict[str, list[Any]] = {name: [] for name in ("scene", "lever", "label", "seconds", "statics", *ERRORS)}
    data: Data = {}
    for scene_name in SCENES[: options.size(3, 1)]:
        n = options.size(32 if scene_name != "moon" else 16, 8)
        floor = floors(options, scene_name, n, options.size(3, 1))
        exact = run(options, scene_name, n, Point("", "", REFERENCE))
        for name in LANDINGS:
            data[f"floor/{scene_name}/{name}"] = floor[name]
        learned = surrogate_row(n, exact) if scene_name == SCENES[0] else None
        for name, value in (learned or {}).items():
            rows[name].append(value)
        for point in chosen:
            if scene_name == "moon" and (point.fidelity.integrator == "runge_kutta" or point.fidelity.bar_segments in (9, 17)):
                continue
            r = run(options, scene_name, n, point)
            rows["scene"].append(scene_name)
            rows["lever"].append(point.lever)
            rows["label"].append(point.label)
            rows["seconds"].append(r["seconds"].sum())
            rows["statics"].append(r["seconds"][0])
            for name, values in errors(r, exact).items():
                rows[name].append(values)
    return data | {name: np.array(values) for name, values in rows.items()}


ERRORS = ("touchdown 50", "touchdown 95", "rest 50", "rest 95", "apex 50", "speed 50", "energy 50", "blown up")


def errors(r: Data, exact: Data) -> dict[str, float]:
    """Percentiles of the distances from the reference; not a number where a model does not follow hops to rest."""
    ok = (r["status"] != 3) & (r["status"] != 4) & (exact["status"] < 3)
    found = {"blown up": float((~ok).mean())}
    for name in LANDINGS:
        away = np.linalg.norm(r[name] - exact[name], axis=1)[ok]
        for q in (50, 95):
            found[f"{name} {q}"] = float(np.percentile(away, q)) if len(away) else np.nan
    speed = np.linalg.norm(r["takeoff_velocity"] - exact["takeoff_velocity"], axis=1)[ok]
    for name, values in (("apex", r["apex"] - exact["apex"]), ("energy", r["stored_energy"] - exact["stored_energy"])):
        found[f"{name} 50"] = float(np.median(np.abs(values[ok]))) if ok.any() else np.nan
    found["speed 50"] = float(np.median(speed)) if ok.any() else np.nan
    return found


def front(cost: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Indices of the points that nothing beats in both, by cost."""
    order = [k for k in np.argsort(cost) if np.isfinite(error[k])]
    best, kept_ = np.inf, []
    for k in order:
        if error[k] < best:
            best = error[k]
            kept_.append(k)
    return np.array(kept_, dtype=int)


def report(d: Data) -> list[str]:
    """One line a point; stars mark the Pareto front of the median error."""
    lines = []
    for scene_name in dict.fromkeys(d["scene"].tolist()):
        here = np.flatnonzero(d["scene"] == scene_name)
        fronts = {name: set(here[front(d["seconds"][here], d[f"{name} 50"][here])]) for name in LANDINGS}
        floor = {name: np.percentile(d[f"floor/{scene_name}/{name}"], (50, 95)) for name in LANDINGS}
        lines.append(
            f"{scene_name}, floor 50 and 95 % [mm]: "
            + ", ".join(f"{name} {1e3 * v[0]:.3g} and {1e3 * v[1]:.3g}" for name, v in floor.items())
        )
        rows = []
        for k in here:
            cells = [str(d["lever"][k]), str(d["label"][k]), f"{1e3 * d['seconds'][k]:.3g}"]
            for name in LANDINGS:
                star = "*" if k in fronts[name] else ""
                value, floor_50 = d[f"{name} 50"][k], floor[name][0]
                cells += [f"{star}{1e3 * value:.3g}", f"{1e3 * d[f'{name} 95'][k]:.3g}", f"{value / floor_50:.2g}"]
            cells += [f"{1e3 * d['apex 50'][k]:.2g}", f"{1e3 * d['speed 50'][k]:.2g}", f"{1e3 * d['energy 50'][k]:.2g}"]
            cells.append(f"{100 * d['blown up'][k]:.0f} %")
            rows.append(cells)
        head = (
            "lever  value  CPU [ms]  touchdown 50 % [mm]  95 %  in floors  rest 50 % [mm]  95 %  in floors  "
            "apex [mm]  take-off [mm/s]  stored [mJ]  failed"
        )
        lines += [*table(head, rows), ""]
    return lines


def plot(d: Data) -> Figure:
    """Error against processor time for both landings; one colour a lever, the front, the floor."""
    names = list(dict.fromkeys(d["scene"].tolist()))
    figure, axes = plt.subplots(2, len(names), figsize=(3.9 * len(names), 7.0), layout="constrained", squeeze=False)
    levers = list(dict.fromkeys(d["lever"].tolist()))
    colours = {lever: f"C{k}" if k < 10 else ("k", "magenta", "y")[k - 10] for k, lever in enumerate(levers)}
    for column, scene_name in enumerate(names):
        for axis, name in zip(axes[:, column], LANDINGS, strict=True):
            here = np.flatnonzero(d["scene"] == scene_name)
            for lever in levers:
                rows = here[d["lever"][here] == lever]
                rows = rows[np.isfinite(d[f"{name} 50"][rows])]
                middle, high = d[f"{name} 50"][rows], d[f"{name} 95"][rows]
                spread = [np.zeros_like(middle), high - middle]
                cost = 1e3 * d["seconds"][rows]
                axis.errorbar(cost, middle, yerr=spread, fmt="o-", ms=4, lw=1, elinewidth=0.6, color=colours[lever], label=lever)
                failed = d["blown up"][rows] > 0
                axis.plot(cost[failed], middle[failed], "x", color="r", ms=9)
            edge = here[front(d["seconds"][here], d[f"{name} 50"][here])]
            axis.step(1e3 * d["seconds"][edge], d[f"{name} 50"][edge], "k:", where="post", lw=1.5)
            low, high = np.percentile(d[f"floor/{scene_name}/{name}"], (50, 95))
            axis.axhspan(low, high, color="0.85", zorder=0, label="floor, 50 to 95 %")
            axis.set(xscale="log", yscale="log", title=f"{scene_name}, {name}", xlabel="processor time [ms a hop]")
            axis.grid(alpha=0.3, which="both", lw=0.4)
    for axis in axes[:, 0]:
        axis.set_ylabel("distance from the converged landing [m]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, loc="outside lower center", ncols=5)
    return figure


PART = Part("ladder", measure, report, plot)
