"""The floor in every preset scene, touchdown and rest: lower gravity means longer flights for the same uncertain start."""

from __future__ import annotations

import numpy as np

from benchmarks.accuracy.floor import spread
from benchmarks.accuracy.part import Data, Options, Part, kept, table
from benchmarks.accuracy.samples import hop_perturbed, stretches
from tensegrity_gym import Design, HopStatus, Scene, form_find

FIELDS = ("touchdown", "rest", "flight_time", "status")


def measure(options: Options) -> Data:
    """Floors (positions, 10 micrometres, two of them) of the same stretches in each scene."""
    n, data = options.size(32, 8), {}
    for name in ("earth", "slope") if options.quick else Scene.PRESETS:
        scene = Scene.preset(name)

        def hops(kind: str, seed: int, scene: Scene = scene) -> Data:
            found = form_find(stretches(n), scene=scene, threads=1)
            r = hop_perturbed(kind, seed, found, design=Design(), scene=scene)
            return {field: getattr(r, field) for field in FIELDS}

        runs = [
            kept(options, "scenes-hops", lambda k=kind, s=seed, h=hops: h(k, s), n=n, scene=scene, kind=kind, seed=seed)  # type: ignore[misc]
            for kind, seed in (("none", 0), ("positions", 1), ("positions", 2))
        ]
        for landing in ("touchdown", "rest"):
            data[f"{name}/{landing}"] = spread(runs[0][landing], [run[landing] for run in runs[1:]])
        data |= {f"{name}/{k}": runs[0][k] for k in ("flight_time", "status")}
    return data


def report(d: Data) -> list[str]:
    """Medians and 95 % by scene."""
    rows = []
    for name in (n for n in Scene.PRESETS if f"{n}/status" in d):
        flew = d[f"{name}/status"] <= HopStatus.TIME_LIMIT
        cells = [name, str(flew.sum()), f"{np.median(d[f'{name}/flight_time'][flew]):.2f}"]
        for landing in ("touchdown", "rest"):
            cells += [f"{1e3 * v:.3g}" for v in np.percentile(d[f"{name}/{landing}"][flew], (50, 95))]
        rows.append([*cells, f"{(d[f'{name}/status'] == HopStatus.RESTED).mean():.0%}"])
    return table("scene  flew  flight [s]  touchdown 50 % [mm]  95 %  rest 50 % [mm]  95 %  rested in time", rows)


PART = Part("scenes", measure, report)
