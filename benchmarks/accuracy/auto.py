"""Does the chosen fidelity hold its tolerance? On stretches that it was not calibrated on, in five scenes."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from benchmarks.accuracy.part import Data, Options, Part, kept, table
from tensegrity_gym import Design, Fidelity, Lattice, Scene, form_find, simulate
from tensegrity_gym.auto import choose_fidelity
from tensegrity_gym.calibration import REFERENCE, stored_calibration
from tensegrity_gym.fidelity import named_fidelity
from tensegrity_gym.hops import hop

#: Tolerances over the floor.
TOLERANCES = (0.5, 1.0, 4.0, 10.0)
#: "rest" is checked where its hops are short.
CASES = (*((name, "touchdown") for name in ("earth", "slope", "mars", "moon", "titan")), ("earth", "rest"))


def landings(options: Options, scene_name: str, landing: str, n: int, model: Fidelity) -> Data:
    """Landings [m], and processor time of a hop with its equilibrium [s]."""

    def measure() -> Data:
        scene, design, lattice = Scene.preset(scene_name, landing=landing), Design(), Lattice()
        stretches = np.random.default_rng(2026).uniform(0.2, 0.8, (n, 4))
        start = time.process_time()
        found = form_find(stretches, design=model.design(design), scene=scene, threads=1)
        r = hop(found, design=design, scene=scene, lattice=lattice, fidelity=model, threads=1)
        return {"landing": np.where(r.failed[:, None], np.inf, r.landing), "seconds": np.array((time.process_time() - start) / n)}

    return kept(options, f"auto-{scene_name}-{landing}", measure, n=n, levers=model.levers())


def motion(options: Options, scene_name: str, landing: str, n: int) -> Data:
    """How long hops last from their release until their landing is read, median [s]."""

    def measure() -> Data:
        scene, model = Scene.preset(scene_name, landing=landing), named_fidelity("flown")
        r = simulate(np.random.default_rng(2026).uniform(0.2, 0.8, (n, 4)), scene=scene, fidelity=model, threads=1)
        return {"motion": np.array(np.median(r.end_time))}

    return kept(options, f"auto-motion-{scene_name}-{landing}", measure, n=n)


def measure(options: Options) -> Data:
    """Of each case and tolerance: share of the hops within it, cost, and that of the cheapest that would have done."""
    rows: dict[str, list] = {name: [] for name in ("case", "tolerance", "share", "cost", "cheapest", "model", "realtime")}
    for scene_name, landing in CASES[: options.size(len(CASES), 1)]:
        n = options.size(200 if landing == "touchdown" else 100, 8)
        floor = stored_calibration(scene_name, landing)
        if floor is None:
            raise SystemExit(f"auto: expected a calibration of {scene_name}; run python -m tensegrity_gym calibrate --save")
        scene, exact_model = Scene.preset(scene_name, landing=landing), replace(REFERENCE, stop="landing")
        wanted = {f: choose_fidelity(Design(), scene, Lattice(), None if f == 1.0 else f * floor.floor) for f in TOLERANCES}
        exact = landings(options, scene_name, landing, n, exact_model)["landing"]
        lasts = float(motion(options, scene_name, landing, n)["motion"])
        tried = {}
        dearest = max((rung.cost for rung in floor.rungs if rung.fidelity in wanted.values()), default=0.0)
        for rung in floor.rungs:
            if rung.cost <= dearest:  # what costs more than any choice is not "the cheapest that would have done"
                r = landings(options, scene_name, landing, n, rung.fidelity)
                tried[rung.fidelity] = (np.linalg.norm(r["landing"] - exact, axis=1), float(r["seconds"]))
        for factor, chosen in wanted.items():
            tolerance = factor * floor.floor
            away, seconds = tried.get(chosen, (np.zeros(n), np.nan))
            enough = [s for a, s in tried.values() if (a <= tolerance).mean() >= 0.95]
            rows["case"].append(f"{scene_name}, {landing}")
            rows["tolerance"].append(tolerance)
            rows["share"].append((away <= tolerance).mean())
            rows["cost"].append(seconds)
            rows["cheapest"].append(min(enough, default=np.nan))
            rows["model"].append(str(replace(chosen, reason="")))
            rows["realtime"].append(lasts / seconds)
    return {name: np.array(values) for name, values in rows.items()}


def report(d: Data) -> list[str]:
    """One line a case and tolerance."""
    rows = [
        [
            str(d["case"][k]),
            f"{1e3 * d['tolerance'][k]:.3g}",
            f"{100 * d['share'][k]:.1f} %",
            f"{1e3 * d['cost'][k]:.3g}",
            f"{d['cost'][k] / d['cheapest'][k]:.2f}",
            f"{d['realtime'][k]:.0f}",
            str(d["model"][k]),
        ]
        for k in range(len(d["case"]))
    ]
    head = "scene, landing  tolerance [mm]  within it  CPU [ms]  over the cheapest that would do  times real time  model"
    return table(head, rows)


PART = Part("auto", measure, report)
