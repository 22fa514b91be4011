"""What each model of the ladder costs and how far from the converged landing it ends, scene by scene: measured and stored."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tensegrity_gym.batch import Progress
from tensegrity_gym.design import Design
from tensegrity_gym.errors import InvalidParameterError, UnknownPresetError
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.formfinding import STRETCH_RANGE, Equilibria, form_find
from tensegrity_gym.hops import HopResult, hop
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import LANDINGS, Scene
from tensegrity_gym.specimen import POSITION, Specimen
from tensegrity_gym.timestep import default_time_step
from tensegrity_gym.types import Floats
from tensegrity_gym.version import MODEL_VERSION

FOLDER = Path(__file__).parent / "calibrations"
#: What no one can know, besides positions (``POSITION``): stiffnesses of the members [-], standard deviation.
MATERIAL = 1e-3
#: Starts, each unknown in its own way, whose largest shift of the landing is a hop's floor.
UNKNOWNS = 4
#: Share of the sampled hops whose error a model's ``error`` bounds.
SHARE = 0.97
#: The model that errors are distances from; a step half as long moves a touchdown by 0.05 mm (docs/accuracy.md).
REFERENCE = Fidelity(step=0.2)
_FAST = Fidelity(precision="float32", flight="rigid", clearance=0.1, stop="landing")
_SINGLE = Fidelity(precision="float32", stop="landing")
#: Models from cheap to dear, for landings read at touchdown and at rest.
LADDER: dict[str, tuple[Fidelity, ...]] = {
    "touchdown": (
        replace(_FAST, bar_softening=16.0),
        replace(_FAST, bar_softening=4.0),
        replace(_FAST, bar_softening=2.0),
        _FAST,
        replace(_FAST, step=0.4),
        replace(_FAST, step=0.4, clearance=0.5),
        _SINGLE,
        replace(_SINGLE, step=0.4),
        Fidelity(stop="landing", step=0.4),
    ),
    "rest": (
        replace(_SINGLE, bar_softening=16.0, stop="rest"),
        replace(_SINGLE, bar_softening=4.0, stop="rest"),
        replace(_FAST, stop="rest"),
        replace(_SINGLE, stop="rest"),
        Fidelity(),
        Fidelity(step=0.4),
    ),
}


@dataclass(frozen=True)
class Rung:
    """One model of the ladder in one scene."""

    fidelity: Fidelity
    cost: float  #: processor time of a hop, equilibrium included, over that of the paper's model [-]
    median: float  #: median distance of its landings from the converged ones [m]
    error: float  #: distance that ``SHARE`` of them stay within [m]


@dataclass(frozen=True)
class Calibration:
    """The ladder in one scene, for one kind of landing."""

    floor: float  #: what no one can know moves 95 % of the landings by less [m]
    rungs: tuple[Rung, ...]  #: by cost
    samples: int  #: hops it was measured on


def sample_stretches(n: int, seed: int, n_actuators: int = 4) -> Floats:
    """Sobol stretches over the range, shape (n, n_actuators); ``n`` and ``seed`` as :func:`check_sample` has them."""
    check_sample(n, seed)
    from scipy.stats import qmc  # heavy to import, and only calibration needs it

    low, high = STRETCH_RANGE
    return low + (high - low) * qmc.Sobol(n_actuators, seed=seed).random_base2(int(np.ceil(np.log2(n))))[:n]


def check_sample(n: int, seed: int) -> None:
    """InvalidParameterError for a number of hops, or a seed, that :func:`sample_stretches` cannot draw stretches for."""
    if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 1:
        raise InvalidParameterError(f"stretches: expected an integer >= 1 of hops to draw them for, got {n!r}; ask for more hops")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InvalidParameterError(f"stretches: expected an integer seed >= 0, got {seed!r}; any such number will do")


def perturbed(
    found: Equilibria, seed: int, *, design: Design, scene: Scene, lattice: Lattice, fidelity: Fidelity, threads: int | None
) -> HopResult:
    """The hops of ``found`` in another specimen of the lattice, whose masses are not quite where they should be.

    ``design`` is the nominal one; all hops take its step.
    """
    modelled = fidelity.design(design)
    specimen = Specimen.of(design, seed, MATERIAL)
    moved = form_find(found.stretches, design=fidelity.design(specimen), scene=scene, lattice=lattice, threads=threads)
    noise = np.random.default_rng([seed, 99]).normal(0.0, POSITION, moved.positions.shape)
    step = default_time_step(modelled, lattice, fidelity.step)
    start = replace(moved, positions=moved.positions + noise)
    return hop(start, design=specimen, scene=scene, lattice=lattice, fidelity=fidelity, dt=step, threads=threads)


def calibrate(
    scene: Scene,
    samples: int,
    seed: int = 1,
    *,
    design: Design | None = None,
    lattice: Lattice | None = None,
    ladder: dict[str, tuple[Fidelity, ...]] | None = None,
    unknowns: int = UNKNOWNS,
    reference: Fidelity = REFERENCE,
    threads: int | None = 1,
    progress: Progress | None = None,
) -> dict[str, Calibration]:
    """Measure the ladder's errors, costs and the floor on ``samples`` hops, for each kind of landing in ``ladder``.

    ``progress`` is called with the number of batches newly done, of 2 + unknowns + all models of the ladder.
    """
    design, lattice, ladder = design or Design(), lattice or Lattice(), ladder or LADDER
    stretches = sample_stretches(samples, seed, lattice.n_cells)
    last = "rest" if "rest" in ladder else "touchdown"

    def run(model: Fidelity, landing: str) -> tuple[HopResult, float]:
        read = replace(scene, landing=landing)
        start = time.process_time()
        found = form_find(stretches, design=model.design(design), scene=scene, lattice=lattice, threads=threads)
        result = hop(found, design=design, scene=read, lattice=lattice, fidelity=model, threads=threads)
        seconds = time.process_time() - start
        if progress:
            progress(1)
        return result, seconds

    def shift(result: HopResult, base: HopResult, landing: str) -> Floats:
        return np.linalg.norm(getattr(result, landing) - getattr(base, landing), axis=1)

    for model in {model for models in ladder.values() for model in models}:  # compiles and loads, before time is taken
        short = replace(scene, duration=0.1)  # with a take-off
        # as many hops over as many threads as are timed: one hop alone runs kernels of its own, without lanes
        first = form_find(stretches, design=model.design(design), scene=short, lattice=lattice, threads=threads)
        hop(first, design=design, scene=short, lattice=lattice, fidelity=replace(model, clearance=0.0), threads=threads)
    plain = Fidelity(stop="landing")
    exact = run(replace(reference, stop="landing"), last)[0]
    paper, paper_seconds = run(plain, last)
    where = {"design": design, "scene": replace(scene, landing=last), "lattice": lattice, "fidelity": plain, "threads": threads}
    moved = []
    for k in range(unknowns):
        moved.append(perturbed(paper.equilibria, k + 1, **where))  # type: ignore[arg-type]
        if progress:
            progress(1)
    usable = ~exact.failed & ~paper.failed & ~np.any([m.failed for m in moved], axis=0)
    if not usable.any():
        why = next(iter(paper.describe_failures()), "they fail when moved a little")
        raise InvalidParameterError(
            f"fidelity 'auto': expected hops to measure models on, but none of {samples} has a landing ({why}); name a fidelity"
        )
    found = {}
    for landing, models in ladder.items():
        largest = np.max([shift(m, paper, landing) for m in moved], axis=0)
        rungs = []
        for model in models:
            result, seconds = run(model, landing)
            errors = np.where(result.failed, np.inf, shift(result, exact, landing))[usable]
            rungs.append(Rung(model, seconds / paper_seconds, float(np.median(errors)), float(np.quantile(errors, SHARE))))
        rungs.sort(key=lambda rung: rung.cost)
        found[landing] = Calibration(float(np.quantile(largest[usable], 0.95)), tuple(rungs), samples)
    return found


def save_calibration(preset: str, measured: dict[str, Calibration], seed: int, folder: Path = FOLDER) -> Path:
    """Write what :func:`calibrate` found for a preset, with what it was made by; returns the file's path."""
    samples = max(c.samples for c in measured.values())
    content: dict[str, Any] = {
        "command": f"python -m tensegrity_gym calibrate --scene {preset} --samples {samples} --seed {seed} --save",
        "model_version": MODEL_VERSION,
        "scene": asdict(replace(Scene.preset(preset), landing="rest")),
        "units": "m",
    }
    for landing, calibration in measured.items():
        rungs = [
            {
                "levers": rung.fidelity.levers(),
                "cost": float(f"{rung.cost:.3g}"),
                "median": float(f"{rung.median:.3g}"),
                "error": float(f"{rung.error:.3g}"),
            }
            for rung in calibration.rungs
        ]
        content[landing] = {"floor": float(f"{calibration.floor:.3g}"), "samples": calibration.samples, "rungs": rungs}
    folder.mkdir(exist_ok=True)
    path = folder / f"{preset}.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    return path


@lru_cache(maxsize=32)
def stored_calibration(preset: str, landing: str, folder: Path = FOLDER) -> Calibration | None:
    """What the package knows of a preset's ladder; None where it was made with another version of the physics or scene.

    Raises UnknownPresetError for a name that is no preset.
    """
    if preset not in Scene.PRESETS or landing not in LANDINGS:
        raise UnknownPresetError(
            f"stored_calibration: expected one of {sorted(Scene.PRESETS)}, {LANDINGS}, got {preset!r}, {landing!r}"
        )
    path = folder / f"{preset}.json"
    content = json.loads(path.read_text()) if path.exists() else {}
    known = content.get("model_version") == MODEL_VERSION and content.get("scene") == asdict(Scene.preset(preset))
    if not known or landing not in content:
        return None
    part = content[landing]
    rungs = tuple(Rung(Fidelity(**r["levers"]), r["cost"], r["median"], r["error"]) for r in part["rungs"])
    return Calibration(part["floor"], rungs, part["samples"])
