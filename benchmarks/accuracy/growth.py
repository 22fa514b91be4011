"""How fast two hops that start 0.1 micrometres apart part, phase by phase: release, flight, tumble."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from benchmarks.accuracy.part import Data, Options, Part, kept, table
from benchmarks.accuracy.samples import hop_perturbed, stretches
from tensegrity_gym import Design, HopResult, HopStatus, Lattice, Scene, form_find
from tensegrity_gym.types import Floats

#: Starts this far apart: far below the floor's, so that the distance stays small for long [m].
APART = 1e-7
PHASES = ("release", "flight", "tumble")


def distances(a: HopResult, b: HopResult, n_nodes: int) -> tuple[Floats, Floats]:
    """Root mean square distance of the nodes and of their means [m], shape (n, n_frames); NaN past either's end."""
    assert a.trajectory is not None
    assert b.trajectory is not None
    apart = a.trajectory.positions[:, :, :n_nodes] - b.trajectory.positions[:, :, :n_nodes]
    frames = np.minimum(a.trajectory.frames, b.trajectory.frames)
    past = np.arange(apart.shape[1])[None] >= frames[:, None]
    nodes, centre = np.sqrt((apart**2).sum(axis=-1).mean(axis=-1)), np.linalg.norm(apart.mean(axis=2), axis=-1)
    return np.where(past, np.nan, nodes), np.where(past, np.nan, centre)


def turned(r: HopResult, n_nodes: int) -> Floats:
    """Angle by which the lattice turns from take-off to touchdown [rad], best fit of its nodes, shape (n,)."""
    assert r.trajectory is not None
    angles = np.zeros(len(r.stretches))
    for hop in range(len(angles)):
        t = r.trajectory.times[hop, : r.trajectory.frames[hop]]
        nodes = r.trajectory.positions[
            hop, [np.searchsorted(t, r.takeoff_time[hop]), np.searchsorted(t, r.touchdown_time[hop]) - 1]
        ]
        first, last = (x[:n_nodes] - x[:n_nodes].mean(axis=0) for x in nodes)
        angles[hop] = Rotation.align_vectors(last, first)[0].magnitude()
    return angles


def measure(options: Options) -> Data:
    """Distances over time at two rates: the first 0.15 s finely, the whole hop coarsely."""
    n = options.size(32, 8)

    def follow(duration: float, rate: float) -> Data:
        design, scene, n_nodes = Design(), Scene(duration=duration), Lattice().n_nodes
        found = form_find(stretches(n), design=design, scene=scene, threads=1)
        options_ = {"design": design, "scene": scene, "rate": rate, "precision": "float64"}
        base = hop_perturbed("none", 0, found, **options_)  # type: ignore[arg-type]
        pairs = [hop_perturbed("positions", s, found, size=APART, **options_) for s in (1, 2)]  # type: ignore[arg-type]
        both = [distances(base, pair, n_nodes) for pair in pairs]
        assert base.trajectory is not None
        data = {
            "times": base.trajectory.times[np.argmax(base.trajectory.frames)],
            "nodes": np.exp(np.mean([np.log(np.maximum(b[0], 1e-12)) for b in both], axis=0)),
            "centre": np.exp(np.mean([np.log(np.maximum(b[1], 1e-12)) for b in both], axis=0)),
        }
        if duration > 1:
            data |= {k: getattr(base, k) for k in ("takeoff_time", "touchdown_time", "end_time", "status")}
            data["turned"] = turned(base, n_nodes)
        return data

    short = kept(options, "growth-release", lambda: follow(0.15, 1500.0), n=n)
    long = kept(options, "growth-hop", lambda: follow(3.0, 100.0), n=n)
    return {f"short/{k}": v for k, v in short.items()} | {f"long/{k}": v for k, v in long.items()}


def rates(d: Data) -> dict[str, Floats]:
    """Growth of the logarithm of the nodes' distance in each phase, per second, and its factor, shape (n, 2)."""
    fine, coarse = (d["short/times"], d["short/nodes"]), (d["long/times"], d["long/nodes"])
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in PHASES}
    for hop in range(len(d["long/nodes"])):
        off, down = d["long/takeoff_time"][hop], d["long/touchdown_time"][hop]
        for name, (t, apart), begin, end in (
            ("release", fine, 2e-3, off),
            ("flight", coarse, off + 0.02, down - 0.02),
            ("tumble", coarse, down + 0.02, min(down + 1.0, t_end(d, hop))),
        ):
            i, j = np.searchsorted(t, begin), min(np.searchsorted(t, end), len(t) - 1)
            ok = j > i and np.isfinite(apart[hop, [i, j]]).all()
            growth = np.log(apart[hop, j] / apart[hop, i]) if ok else np.nan
            found[name].append((growth / (t[j] - t[i]) if ok else np.nan, np.exp(growth)))
    return {name: np.array(values) for name, values in found.items()}


def flight_power(d: Data) -> Floats:
    """p of distance ~ (time since take-off)^p over the flight from 0.1 s on: 1 for mere drift and turning, shape (n,)."""
    t, found = d["long/times"], []
    for hop in range(len(d["long/nodes"])):
        off, down = d["long/takeoff_time"][hop], d["long/touchdown_time"][hop]
        inside = (t > off + 0.1) & (t < down) & np.isfinite(d["long/nodes"][hop])
        found.append(np.polyfit(np.log(t[inside] - off), np.log(d["long/nodes"][hop, inside]), 1)[0])
    return np.array(found)


def t_end(d: Data, hop: int) -> float:
    """Last time at which both hops of a pair have a frame [s]."""
    return float(d["long/times"][np.flatnonzero(np.isfinite(d["long/nodes"][hop]))[-1]])


def report(d: Data) -> list[str]:
    """Rates and factors by phase, and the part that turning plays."""
    flew = d["long/status"] <= HopStatus.TIME_LIMIT
    rows = []
    for name, values in rates(d).items():
        good = values[flew & np.isfinite(values[:, 0])]
        rows.append([name, *[f"{v:.1f}" for v in np.percentile(good[:, 0], (10, 50, 90))], f"{np.median(good[:, 1]):.3g}"])
    head = "phase  rate 10 % [1/s]  50 %  90 %  factor 50 %"
    degrees = np.degrees(d["long/turned"][flew])
    return [
        f"{flew.sum()} hops, starts {APART:g} m apart, nodes' distance; the tumble's first second",
        *table(head, rows),
        f"in flight distance ~ time^p since take-off, p = {np.median(flight_power(d)[flew]):.2f} (10 to 90 %: "
        f"{np.percentile(flight_power(d)[flew], 10):.2f} to {np.percentile(flight_power(d)[flew], 90):.2f})",
        f"turned in flight: median {np.median(degrees):.0f} degrees, 10 to 90 %: {np.percentile(degrees, 10):.0f} to "
        f"{np.percentile(degrees, 90):.0f}",
    ]


def plot(d: Data) -> Figure:
    """Distances over time, aligned at release and at touchdown."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11.5, 3.4), layout="constrained", sharey=True)
    left.semilogy(1e3 * d["short/times"], d["short/nodes"].T, color="C0", lw=0.5, alpha=0.5)
    left.semilogy(1e3 * d["short/times"], np.nanmedian(d["short/nodes"], axis=0), "k", lw=1.5, label="median")
    left.axvline(1e3 * np.median(d["long/takeoff_time"]), color="C3", ls=":", label="take-off (median)")
    left.set(xlabel="since release [ms]", ylabel="distance of the nodes [m]", title="release")
    left.legend(fontsize=8)
    t = d["long/times"]
    for hop in range(len(d["long/nodes"])):
        off, down = d["long/takeoff_time"][hop], d["long/touchdown_time"][hop]
        flight = (t > off) & (t < down)
        middle.semilogy((t[flight] - off) / (down - off), d["long/nodes"][hop, flight], color="C0", lw=0.5, alpha=0.6)
        after = t > down - 0.1
        right.semilogy(t[after] - down, d["long/nodes"][hop, after], color="C0", lw=0.5, alpha=0.6)
    middle.set(xlabel="share of the flight", title="flight")
    right.set(xlabel="since touchdown [s]", title="tumble")
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
    return figure


PART = Part("growth", measure, report, plot)
