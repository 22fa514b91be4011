"""How fast a step is, against the scalar twin, MuJoCo, the core's ceiling, more threads and larger lattices.

Run: ``python -m benchmarks.speed`` (about two minutes; ``--quick`` for one). Prints tables and writes docs/images/speed.png.
All figures are CPU time of one thread unless stated, best of several interleaved runs: compare ratios, not machines.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from tensegrity_gym import Design, Lattice, Scene, form_find, simulate
from tensegrity_gym.core.forces import lattice_forces
from tensegrity_gym.core.integrators import symplectic_euler_step
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import fma, lane_count, lanes_empty, load1, splat, sqrt, store1
from tensegrity_gym.mjcf import to_mjcf
from tensegrity_gym.types import Ground

#: Vector operations of one step, counted by hand from core/forces.py and core/integrators: (arithmetic, divisions, roots).
SEGMENT, HINGE, BAR_SUM_PER_SEGMENT = (28, 1, 1), (44, 1, 0), (22, 0, 0)
CABLE, MASS = (46, 1, 1), (14, 0, 0)


@dataclass(frozen=True)
class SpeedConfig:
    """What to measure."""

    quick: bool = False
    """Fewer repetitions."""
    figure: Path = Path("docs/images/speed.png")
    """Where the figure goes."""


@jit(cache=True)
def run_steps(structure, actuator_length, ground, dt, steps, x, v, f, memory, work):
    """Symplectic Euler steps in lanes or, for arrays without the lane axis, of one lattice."""
    kick = splat(dt, load1(actuator_length, 0))
    for _ in range(steps):
        symplectic_euler_step(lattice_forces, structure, actuator_length, ground, dt, kick, x, v, f, memory, work)


@jit(cache=True)
def run_fma(numbers, turns):
    """Eight independent chains of fused multiply-adds."""
    a, b, c, d = load1(numbers, 0), load1(numbers, 1), load1(numbers, 2), load1(numbers, 3)
    e, g, h, k = load1(numbers, 4), load1(numbers, 5), load1(numbers, 6), load1(numbers, 7)
    s = load1(numbers, 8)
    for _ in range(turns):
        a, b, c, d = fma(a, s, s), fma(b, s, s), fma(c, s, s), fma(d, s, s)
        e, g, h, k = fma(e, s, s), fma(g, s, s), fma(h, s, s), fma(k, s, s)
    store1(numbers, 9, a + b + c + d + e + g + h + k)


@jit(cache=True)
def run_division(numbers, turns):
    """Four independent chains of divisions."""
    a, b, c, d = load1(numbers, 0), load1(numbers, 1), load1(numbers, 2), load1(numbers, 3)
    s = load1(numbers, 8)
    for _ in range(turns):
        a, b, c, d = s / a, s / b, s / c, s / d
    store1(numbers, 9, a + b + c + d)


@jit(cache=True)
def run_root(numbers, turns):
    """Four independent chains of square roots."""
    a, b, c, d = load1(numbers, 0), load1(numbers, 1), load1(numbers, 2), load1(numbers, 3)
    for _ in range(turns):
        a, b, c, d = sqrt(a), sqrt(b), sqrt(c), sqrt(d)
    store1(numbers, 9, a + b + c + d)


class Bench:
    """One lattice, flying or standing, in lanes of ``dtype`` (or alone, ``lanes=False``), ready to be stepped."""

    def __init__(self, lattice: Lattice, dtype: type = np.float64, lanes: bool = True, height: float = 2.0) -> None:
        design = Design()
        self.structure = design.structure(lattice).astype(np.dtype(dtype))
        n, self.lanes = len(self.structure.mass), lane_count(dtype) if lanes else 1
        rng = np.random.default_rng(0)
        x = design.unloaded_positions(lattice) + np.array((0.0, 0.0, height + design.cell_height / 2))

        def array(*shape: int) -> np.ndarray:
            return lanes_empty(shape, dtype) if lanes else np.zeros(shape, dtype)

        self.x, self.v, self.f = array(n, 3), array(n, 3), array(n, 3)
        self.memory, self.work = array(self.structure.n_axial_members), array(4 * n, 3)
        self.length = array(lattice.n_cells)
        noise = rng.normal(0, 1e-3, x.shape)
        self.x[:] = (x + noise)[:, :, None] if lanes else x + noise
        self.length[:] = design.cell_height
        self.ground = Ground(np.array((0.0, 0.0, -9.8), dtype), 0.5, 0.0)

    def step(self, steps: int) -> None:
        """Advance by ``steps``."""
        run_steps(self.structure, self.length, self.ground, 1e-5, steps, self.x, self.v, self.f, self.memory, self.work)


def interleaved(jobs: dict[str, Callable[[], object]], turns: int) -> dict[str, float]:
    """Least CPU time [s] of each job over ``turns`` rounds in which every job runs once; one round more to warm up."""
    best = dict.fromkeys(jobs, np.inf)
    for turn in range(turns + 1):
        for name, job in jobs.items():
            start = time.process_time()
            job()
            if turn:
                best[name] = min(best[name], time.process_time() - start)
    return best


def ceiling(structure, dtype: type, turns: int) -> dict[str, float]:
    """Least time of one vector step [s] if nothing but its arithmetic counted, from measured throughputs of one core."""
    numbers = lanes_empty((10,), dtype)
    numbers[:] = 0.9
    count = 200_000
    best = interleaved(
        {
            "fma": lambda: run_fma(numbers, count),
            "division": lambda: run_division(numbers, count),
            "root": lambda: run_root(numbers, count),
        },
        turns,
    )
    each = {"fma": best["fma"] / count / 8, "division": best["division"] / count / 4, "root": best["root"] / count / 4}
    bars, per_bar = structure.bars.shape[0], structure.bars.shape[1] - 1
    kinds = [
        (SEGMENT, bars * per_bar),
        (HINGE, bars * (per_bar - 1)),
        (BAR_SUM_PER_SEGMENT, bars * per_bar),
        (CABLE, len(structure.cables) + len(structure.actuators)),
        (MASS, len(structure.mass)),
    ]
    total = np.sum([np.array(ops) * n for ops, n in kinds], axis=0)
    return {
        "arithmetic": total[0] * each["fma"],
        "with divisions and roots": total[0] * each["fma"] + total[1] * each["division"] + total[2] * each["root"],
    }


def mujoco_job(lattice: Lattice, steps: int) -> Callable[[], object]:
    """Steps of the same springs (no hinges, no contact) in MuJoCo."""
    import mujoco

    design = Design(bar_damping=0.0, cable_damping=0.0, hinge_damping=0.0)
    x = design.unloaded_positions(lattice) + np.array((0.0, 0.0, 2.0))
    model = mujoco.MjModel.from_xml_string(to_mjcf(lattice, design, x, gravity=np.array((0.0, 0.0, -9.8)), dt=1e-5))
    data = mujoco.MjData(model)
    return lambda: mujoco.mj_step(model, data, nstep=steps)


def first_minutes() -> dict[str, float]:
    """Wall time of a fresh interpreter: importing the package, and a first short hop with a warm compile cache [s]."""
    code = (
        "import time; t = time.perf_counter(); import tensegrity_gym as tg; a = time.perf_counter() - t;"
        "t = time.perf_counter(); tg.simulate([0.3] * 4, scene=tg.Scene(duration=0.001)); print(a, time.perf_counter() - t)"
    )
    runs = [[float(v) for v in subprocess.check_output([sys.executable, "-c", code]).split()] for _ in range(4)]
    imported, hop = np.median(np.array(runs[1:]), axis=0)
    return {"import tensegrity_gym": imported, "first hop, warm cache": hop}


def threads_gain(turns: int) -> float:
    """Hops per wall second with two threads over one."""
    stretches = np.full((32, 4), 0.4)
    equilibria = form_find(stretches)
    scene = Scene(duration=0.1)
    best = {1: np.inf, 2: np.inf}
    for _ in range(turns):
        for threads in best:
            start = time.perf_counter()
            simulate(stretches, equilibria=equilibria, scene=scene, threads=threads)
            best[threads] = min(best[threads], time.perf_counter() - start)
    return best[1] / best[2]


def landing_errors(hops: int) -> dict[str, dict[str, np.ndarray]]:
    """Quartiles and maximum of the landing error [mm] that each cheaper choice costs, with the floor beside it."""
    stretches = np.random.default_rng(0).uniform(0.2, 0.8, (hops, 4))
    equilibria = form_find(stretches)
    standard = simulate(stretches, equilibria=equilibria)
    half = simulate(stretches, equilibria=equilibria, dt=standard.dt / 2)
    quarter = simulate(stretches, equilibria=equilibria, dt=standard.dt / 4)
    single = simulate(stretches, equilibria=equilibria, precision="float32")
    # what no one can know: every mass above the ground moved by 10 micrometres
    noise = np.random.default_rng(1).normal(0, 1e-5, equilibria.positions.shape)
    moved = equilibria.positions + noise * (equilibria.positions[:, :, 2:] > 1e-3)
    perturbed = simulate(stretches, equilibria=replace(equilibria, positions=moved))
    pairs = {
        "default step against dt/4": (standard, quarter),
        "half step against dt/4": (half, quarter),
        "float32 against float64": (single, standard),
        "floor: 10 um at the start": (perturbed, standard),
    }
    quantiles = (0.0, 0.25, 0.5, 0.75, 1.0)
    return {
        name: {
            landing: np.quantile(1e3 * np.linalg.norm(getattr(a, landing) - getattr(b, landing), axis=1), quantiles)
            for landing in ("touchdown", "rest")
        }
        for name, (a, b) in pairs.items()
    }


def measure(config: SpeedConfig) -> dict[str, dict[str, float]]:
    """All tables, in microseconds per step of one lattice unless the name says otherwise."""
    turns, steps = (3, 300) if config.quick else (7, 600)
    paper = Lattice(2, 2)
    wide, narrow, alone = Bench(paper), Bench(paper, np.float32), Bench(paper, lanes=False)
    standing = Bench(paper, height=0.0)
    best = interleaved(
        {
            "MuJoCo Euler, springs only": mujoco_job(paper, steps // 10),
            "scalar twin, float64": lambda: alone.step(steps),
            "lanes, float64 x 8": lambda: wide.step(steps),
            "lanes, float64 x 8, standing": lambda: standing.step(steps),
            "lanes, float32 x 16": lambda: narrow.step(steps),
        },
        turns,
    )
    scale = {
        "MuJoCo Euler, springs only": 1e6 / (steps // 10),
        "scalar twin, float64": 1e6 / steps,
        "lanes, float64 x 8": 1e6 / steps / wide.lanes,
        "lanes, float64 x 8, standing": 1e6 / steps / wide.lanes,
        "lanes, float32 x 16": 1e6 / steps / narrow.lanes,
    }
    engines = {name: value * scale[name] for name, value in best.items()}
    for name, bench, dtype in (("float64", wide, np.float64), ("float32", narrow, np.float32)):
        for kind, seconds in ceiling(bench.structure, dtype, turns).items():
            engines[f"ceiling {name}, {kind}"] = seconds * 1e6 / bench.lanes
    sizes = [(1, 1), (2, 1), (2, 2), (3, 2), (3, 3), (5, 4)]
    benches = {f"{nx}x{ny}": Bench(Lattice(nx, ny)) for nx, ny in sizes}
    cells = interleaved({name: (lambda b=b: b.step(steps // 4)) for name, b in benches.items()}, turns)
    per_cell = {
        name: cells[name] * 1e6 / (steps // 4) / benches[name].lanes / (nx * ny)
        for (nx, ny), name in zip(sizes, benches, strict=True)
    }
    return {"engines": engines, "per cell": per_cell, "first": first_minutes(), "threads": {"two over one": threads_gain(turns)}}


def report(tables: dict[str, dict[str, float]]) -> str:
    """The tables as text."""
    engines = tables["engines"]
    base, single = engines["lanes, float64 x 8"], engines["lanes, float32 x 16"]
    lines = ["us per step of the 2x2 lattice (184 masses), one thread:"]
    lines += [f"  {name:48s} {value:8.3f}" for name, value in engines.items()]
    lines += [
        f"float64 lanes over scalar twin  {engines['scalar twin, float64'] / base:6.1f} x",
        f"float32 lanes over scalar twin  {engines['scalar twin, float64'] / single:6.1f} x",
        f"float64 lanes over MuJoCo       {engines['MuJoCo Euler, springs only'] / base:6.1f} x",
        f"float32 lanes over MuJoCo       {engines['MuJoCo Euler, springs only'] / single:6.1f} x",
        f"over the ceiling, float64       {base / engines['ceiling float64, with divisions and roots']:6.2f} x",
        f"over the ceiling, float32       {single / engines['ceiling float32, with divisions and roots']:6.2f} x",
        f"two threads over one            {tables['threads']['two over one']:6.2f} x",
        "us per step and cell: " + ", ".join(f"{name} {value:.3f}" for name, value in tables["per cell"].items()),
        ", ".join(f"{name} {value:.2f} s" for name, value in tables["first"].items()),
        "a 3 s hop at the default step is "
        f"{3.0 / (base * 1e-6 * 3.0 / 1.926e-5):.0f} x faster than real time per core in float64 flight, "
        f"{3.0 / (single * 1e-6 * 3.0 / 1.926e-5):.0f} x in float32",
    ]
    return "\n".join(lines)


def draw(tables: dict[str, dict[str, float]], path: Path) -> None:
    """Bars of the engines, and the cost per cell."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.8), gridspec_kw={"width_ratios": [3, 2]})
    names = list(tables["engines"])
    left.barh(names, [tables["engines"][n] for n in names], color=["#888" if "ceiling" in n else "#3566a8" for n in names])
    left.set_xscale("log")
    left.invert_yaxis()
    left.set_xlabel("time per step of one 2x2 lattice [µs], one core")
    for k, name in enumerate(names):
        left.text(tables["engines"][name] * 1.05, k, f"{tables['engines'][name]:.2f}", va="center", fontsize=8)
    right.plot(list(tables["per cell"]), list(tables["per cell"].values()), "o-", color="#3566a8")
    right.set_ylim(0)
    right.set_xlabel("lattice")
    right.set_ylabel("time per step and cell [µs]")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main(config: SpeedConfig) -> None:
    """Measure, print and draw."""
    tables = measure(config)
    print(report(tables))
    print("landing error [mm], minimum, quartiles, maximum:")
    for name, errors in landing_errors(8 if config.quick else 32).items():
        for landing, values in errors.items():
            print(f"  {name:28s} {landing:10s}" + " ".join(f"{v:8.2f}" for v in values))
    draw(tables, config.figure)


if __name__ == "__main__":
    main(tyro.cli(SpeedConfig))
