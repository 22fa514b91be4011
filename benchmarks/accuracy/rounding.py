"""Single precision over long flights: where float32 lands beside float64, on Earth and on the Moon."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.accuracy.part import Data, Options, Part, kept, table
from benchmarks.accuracy.samples import hop_perturbed, stretches
from tensegrity_gym import Design, Scene, form_find
from tensegrity_gym.types import Floats

SCENES = ("earth", "mars", "moon")
FIELDS = ("takeoff_velocity", "takeoff_time", "apex", "touchdown_time", "touchdown", "flight_time", "energies", "stored_energy")


def measure(options: Options) -> Data:
    """The same hops in both precisions, and the floor in float64, up to touchdown."""
    n, data = options.size(16, 8), {}
    for name in ("earth", "moon") if options.quick else SCENES:
        scene = Scene.preset(name, landing="touchdown")
        scene = Scene.preset(name, duration=scene.duration * (0.55 if name == "earth" else 0.8))  # as long as first flights
        for precision, kind in (("float64", "none"), ("float32", "none"), ("float64", "positions")):

            def follow(scene: Scene = scene, precision: str = precision, kind: str = kind) -> Data:
                found = form_find(stretches(n), scene=scene, threads=1)
                r = hop_perturbed(kind, 1, found, design=Design(), scene=scene, precision=precision)
                return {field: getattr(r, field) for field in FIELDS}

            found = kept(options, "rounding-hops", follow, n=n, scene=scene, precision=precision, kind=kind)
            data |= {f"{name}/{precision}/{kind}/{k}": v for k, v in found.items()}
    return data


def apart(d: Data, name: str, other: str, field: str) -> Floats:
    """Distance of float32 or of the perturbed hops from float64, hop by hop."""
    difference = d[f"{name}/{other}/{field}"] - d[f"{name}/float64/none/{field}"]
    return np.linalg.norm(difference, axis=1) if difference.ndim > 1 else np.abs(difference)


def report(d: Data) -> list[str]:
    """Rounding beside the floor."""
    rows = []
    for name in (n for n in SCENES if f"{n}/float32/none/apex" in d):
        cells = [name, f"{np.median(d[f'{name}/float64/none/flight_time']):.1f}", f"{d[f'{name}/float64/none/apex'].max():.1f}"]
        for field in ("touchdown", "apex", "touchdown_time"):
            for other in ("float32/none", "float64/positions"):
                e = 1e3 * apart(d, name, other, field)
                cells += [f"{np.median(e):.3g}", f"{e.max():.3g}"]
        rows.append(cells)
    head = "scene  flight [s]  apex [m]  touchdown f32 [mm]  worst  floor [mm]  worst  apex f32 [mm]  worst  floor [mm]  worst"
    head += "  instant f32 [ms]  worst  floor [ms]  worst"
    return ["distance from float64, medians; the floor is that of 10 micrometres at the start", *table(head, rows)]


def plot(d: Data) -> Figure:
    """Rounding against the floor, hop by hop."""
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained", sharex=True, sharey=True)
    for axis, name in zip(axes, [n for n in SCENES if f"{n}/float32/none/apex" in d], strict=False):
        axis.loglog(apart(d, name, "float64/positions", "touchdown"), apart(d, name, "float32/none", "touchdown"), "o", ms=4)
        axis.plot([1e-6, 1e-2], [1e-6, 1e-2], color="k", lw=0.6)
        axis.set(title=name, xlabel="moved by 10 µm at the start [m]")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("touchdown: float32 from float64 [m]")
    return figure


PART = Part("rounding", measure, report, plot)
