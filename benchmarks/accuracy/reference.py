"""Where a hop converges to: steps halved, other integrators, more segments, and DOP853 between contact events as a witness."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.accuracy.part import Data, Options, Part, kept, table
from benchmarks.accuracy.samples import stretches
from benchmarks.accuracy.witness import EventHop, WitnessedHop
from tensegrity_gym import Design, HopResult, Lattice, Scene, form_find, simulate
from tensegrity_gym.timestep import default_time_step
from tensegrity_gym.types import Floats

#: Longer than any first flight of the sample on Earth [s].
AIRBORNE = Scene(duration=1.7, landing="touchdown")
EVENTS = ("takeoff_time", "takeoff_velocity", "apex", "touchdown_time", "touchdown")
#: Halvings of the default step: (integrator, halvings, followed to rest).
RUNS = [("symplectic_euler", k, k <= 3) for k in range(5)] + [("runge_kutta", k, False) for k in range(3)]
SEGMENTS = (3, 5, 9, 17)
#: Hops that DOP853 follows; each takes minutes.
WITNESSED = 3


def run(options: Options, integrator: str, halvings: int, to_rest: bool, segments: int = 3, n: int | None = None) -> Data:
    """Events of the sample's hops with one method and step."""
    n = options.size(16, 8) if n is None else n
    scene = Scene() if to_rest else AIRBORNE
    key = {"integrator": integrator, "halvings": halvings, "scene": scene, "segments": segments, "n": n}

    def hops() -> Data:
        design = replace(Design(), bar_segments=segments)
        dt = default_time_step(design, Lattice()) / 2**halvings
        batch = {"design": design, "scene": scene, "threads": 1}
        found = form_find(stretches(n), **batch)  # type: ignore[arg-type]
        r = simulate(stretches(n), equilibria=found, dt=dt, integrator=integrator, **batch)  # type: ignore[arg-type]
        return {name: getattr(r, name) for name in (*EVENTS, "rest", "status", "dt")} | {"launch": launch(r)}

    return kept(options, "reference-run", hops, **key)


def launch(r: HopResult | WitnessedHop) -> Floats:
    """Velocity of the flight's parabola drawn back to release [m/s]: the take-off velocity without the take-off's instant,
    which jumps by a millisecond when another foot leaves last."""
    time = np.asarray(r.takeoff_time)
    return r.takeoff_velocity - time[..., None] * AIRBORNE.gravity_vector


def witness(options: Options, hop: int, tightness: float = 1.0) -> Data:
    """What DOP853 between events makes of one hop of the sample, its tolerances divided by ``tightness``."""

    def follow() -> Data:
        design, lattice = Design(), Lattice()
        found = form_find(stretches(16)[hop : hop + 1], scene=AIRBORNE, threads=1)
        flight_speed = np.sqrt(2 * AIRBORNE.gravity * 1e-3 * design.cell_height)  # as simulate: a rise of 1e-3 l
        event_hop = EventHop(design.structure(lattice), AIRBORNE.ground, found.positions[0], tightness)
        r = event_hop.run(AIRBORNE.duration, flight_speed)
        return {k: np.array(v) for k, v in vars(r).items() if k != "positions"} | {"launch": launch(r)}

    return kept(options, "witness", follow, hop=hop, **({} if tightness == 1.0 else {"tightness": tightness}))


def measure(options: Options) -> Data:
    """All runs."""
    last = options.size(4, 2)
    data: Data = {"stretches": stretches(options.size(16, 8))}
    for integrator, halvings, to_rest in RUNS:
        if halvings <= last - (integrator == "runge_kutta"):
            found = run(options, integrator, halvings, to_rest and not options.quick)
            for name, values in found.items():
                data[f"{integrator}/{halvings}/{name}"] = values
    data["last"] = np.array(last)
    for segments in SEGMENTS[: options.size(4, 2)]:
        found = run(options, "symplectic_euler", 0, False, segments, n=8)
        for name, values in found.items():
            data[f"segments/{segments}/{name}"] = values
    for hop in range(options.size(WITNESSED, 0)):
        for name, values in witness(options, hop).items():
            data[f"witness/{hop}/{name}"] = values
    if not options.quick:
        data |= {f"tight/{name}": values for name, values in witness(options, 0, tightness=10.0).items()}
    return data


def error(a: Floats, b: Floats) -> Floats:
    """Distance hop by hop."""
    return np.linalg.norm(a - b, axis=-1) if a.ndim > 1 else np.abs(a - b)


def convergence(d: Data, integrator: str, name: str) -> tuple[list[int], list[Floats]]:
    """Halvings and, hop by hop, the distance to the smallest step of symplectic Euler."""
    best = d[f"symplectic_euler/{int(d['last'])}/{name}"]
    levels = [k for k in range(5) if f"{integrator}/{k}/{name}" in d and (integrator != "symplectic_euler" or k < d["last"])]
    return levels, [error(d[f"{integrator}/{k}/{name}"], best) for k in levels]


def report(d: Data) -> list[str]:
    """Convergence hop by hop, over hops, with segments, and against the witness."""
    lines = [f"{len(d['stretches'])} Sobol stretches, Earth; distance to the smallest step, default step / {2 ** int(d['last'])}"]
    rows = []
    for integrator in ("symplectic_euler", "runge_kutta"):
        levels, speed = convergence(d, integrator, "launch")
        for j, k in enumerate(levels):
            apex, down = convergence(d, integrator, "apex")[1][j], convergence(d, integrator, "touchdown")[1][j]
            cells = [f"{1e3 * f(values):.3f}" for values in (speed[j], apex, down) for f in (np.median, np.max)]
            rows.append([integrator, f"{1e6 * d[f'{integrator}/{k}/dt']:.2f}", *cells])
    head = "integrator  dt [us]  launch [mm/s]  worst  apex [mm]  worst  touchdown [mm]  worst"
    lines += [*table(head, rows), "", "touchdown, hop by hop [mm]"]
    levels, down = convergence(d, "symplectic_euler", "touchdown")
    lines += table(
        "lambda  " + "  ".join(f"dt/{2**k}" for k in levels),
        [[np.array2string(s, precision=2), *[f"{1e3 * e[i]:.3f}" for e in down]] for i, s in enumerate(d["stretches"])],
    )
    lines += _rest_lines(d) + _segment_lines(d) + _witness_lines(d)
    return lines


def _rest_lines(d: Data) -> list[str]:
    levels = [k for k in range(4) if f"symplectic_euler/{k}/rest" in d]
    scenes = [d[f"symplectic_euler/{k}/rest"] for k in levels]
    moved = [error(a, b) for a, b in pairwise(scenes)]
    text = ", ".join(f"dt/{2**k} to dt/{2 ** (k + 1)} {1e3 * np.median(m):.1f}" for k, m in zip(levels, moved, strict=False))
    return ["", f"rest does not converge, it scatters [mm, median]: {text}"] if moved and len(d["stretches"]) > 8 else []


def _segment_lines(d: Data) -> list[str]:
    found = [n for n in SEGMENTS if f"segments/{n}/touchdown" in d]
    best, rows = found[-1], []
    for n in found[:-1]:
        cells = []
        for name in ("launch", "apex", "touchdown"):
            e = 1e3 * error(d[f"segments/{n}/{name}"], d[f"segments/{best}/{name}"])
            cells += [f"{np.median(e):.2f}", f"{e.max():.2f}"]
        rows.append([str(n), *cells])
    head = "segments  launch [mm/s]  worst  apex [mm]  worst  touchdown [mm]  worst"
    return [
        "",
        f"bar model: {len(d[f'segments/{best}/apex'])} hops, each model at its own default step, against {best} segments",
    ] + table(head, rows)


def _witness_lines(d: Data) -> list[str]:
    rows = []
    for hop in range(WITNESSED):
        if f"witness/{hop}/touchdown" not in d:
            continue
        for k in (0, 2, int(d["last"])):
            row = [str(hop), f"dt/{2**k}"]
            for name, unit, digits in (
                ("takeoff_time", 1e6, 2),
                ("launch", 1e3, 3),
                ("touchdown_time", 1e6, 1),
                ("touchdown", 1e3, 4),
            ):
                distance = np.linalg.norm(np.atleast_1d(d[f"symplectic_euler/{k}/{name}"][hop] - d[f"witness/{hop}/{name}"]))
                row.append(f"{unit * distance:.{digits}f}")
            rows.append([*row, str(int(d[f"witness/{hop}/events"]))])
    head = "hop  step  take-off [us]  launch [mm/s]  touchdown [us]  touchdown [mm]  contact events"
    if not rows:
        return []
    own = [float(np.linalg.norm(d[f"tight/{name}"] - d[f"witness/0/{name}"])) for name in ("launch", "touchdown")]
    lines = [f"DOP853 with tenfold tolerances from itself, hop 0: {1e3 * own[0]:.2g} mm/s, {1e3 * own[1]:.2g} mm at touchdown"]
    return ["", "against DOP853 between contact events", *table(head, rows), *lines]


def plot(d: Data) -> Figure:
    """Errors against the step, every hop and the median; and what more segments change."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.5), layout="constrained")
    for axis, (name, label) in zip(
        axes, (("launch", "launch velocity [m/s]"), ("touchdown", "touchdown [m]"), ("rest", "rest [m]")), strict=True
    ):
        for integrator, colour in (("symplectic_euler", "C0"), ("runge_kutta", "C1")):
            if name == "rest":
                continue
            levels, errors = convergence(d, integrator, name)
            steps = 1e6 * np.array([d[f"{integrator}/{k}/dt"] for k in levels])
            axis.loglog(steps, np.maximum(errors, 1e-9), ".", color=colour, ms=3, alpha=0.6)
            axis.loglog(steps, np.median(errors, axis=1), "-o", color=colour, label=integrator.replace("_", " "))
        if name == "rest" and len(d["stretches"]) > 8:
            scenes = {k: d[f"symplectic_euler/{k}/rest"] for k in range(4)}
            errors = [error(scenes[k], scenes[3]) for k in range(3)]
            steps = 1e6 * np.array([d[f"symplectic_euler/{k}/dt"] for k in range(3)])
            axis.loglog(steps, errors, ".", color="C0", ms=3, alpha=0.6)
            axis.loglog(steps, np.median(errors, axis=1), "-o", color="C0", label="symplectic euler, to dt/8")
        if name == "touchdown":
            for n, colour in ((3, "C3"), (5, "C4"), (9, "C5")):
                if f"segments/{n}/touchdown" in d:
                    best = max(k for k in SEGMENTS if f"segments/{k}/touchdown" in d)
                    moved = np.median(error(d[f"segments/{n}/{name}"], d[f"segments/{best}/{name}"]))
                    axis.axhline(moved, color=colour, ls=":", lw=1, label=f"{n} against {best} segments")
        ticks = 19.2 / 2.0 ** np.arange(4)
        axis.set(xlabel="time step [µs]", title=label, xticks=ticks, xticklabels=[f"{t:g}" for t in ticks])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7, loc="lower right")
    return figure


PART = Part("reference", measure, report, plot)
