"""Scenes and designs at the ends of what can be asked: gravity, stiffness, friction and restitution, steps too large."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.accuracy.part import Data, Options, Part, kept, table
from benchmarks.accuracy.samples import stretches
from tensegrity_gym import Design, HopStatus, Lattice, Scene, form_find, simulate
from tensegrity_gym.rollouts import LEAST_RISE
from tensegrity_gym.timestep import critical_time_step, default_time_step
from tensegrity_gym.types import Floats

G = 9.80665
GRAVITIES = (1e-4, 1e-3, 1e-2, 0.1, 1.0, 3.0, 10.0, 30.0)
STIFFNESSES = (10**-1.5, 0.1, 10**-0.5, 1.0, 10**0.5, 10.0, 10**1.5)
FRICTIONS, RESTITUTIONS = (0.0, 0.3, 1.0, 5.0), (0.0, 0.5, 0.9, 1.0)
STEPS = (0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0, 1.02, 1.05)


def audit(energies: Floats, stored: Floats) -> Floats:
    """Worst gap of the energy balance over the events, over the stored energy, shape (n,)."""
    total = energies.sum(axis=2)
    return np.abs(total - total[:, :1]).max(axis=1) / stored


def gravities(n: int) -> Data:
    """Take-off in the first 0.3 s under each gravity."""
    data: Data = {}
    for g in GRAVITIES:
        scene = Scene(gravity=g * G, duration=0.3)
        found = form_find(stretches(n), scene=scene, threads=1)
        r = simulate(stretches(n), scene=scene, equilibria=found, threads=1)
        data[f"{g:g}/converged"], data[f"{g:g}/status"] = found.converged, r.status
        data[f"{g:g}/speed"], data[f"{g:g}/audit"] = r.takeoff_velocity[:, 2], audit(r.energies, r.stored_energy)
        data[f"{g:g}/can_fly"] = r.stored_energy > lifting_energy(found.positions, scene)
    return data


def lifting_energy(positions: Floats, scene: Scene) -> Floats:
    """Least energy that takes each lattice off the ground: what lifts its masses into the unloaded shape, and a flight's rise."""
    design, lattice = Design(), Lattice()
    mass, unloaded = design.structure(lattice).mass, design.unloaded_positions(lattice)
    height = mass @ (unloaded[:, 2] - unloaded[:, 2].min()) / mass.sum() + LEAST_RISE * design.cell_height
    return mass.sum() * scene.gravity * (height - positions[:, :, 2] @ mass / mass.sum())


def stiffnesses(n: int) -> Data:
    """Bars and cables stiffer and softer together: step, equilibria, audit, height."""
    data: Data = {}
    for factor in STIFFNESSES:
        base = Design()
        design = replace(base, bar_modulus=factor * base.bar_modulus, cable_modulus=factor * base.cable_modulus)
        scene = Scene(duration=0.3)
        found = form_find(stretches(n), design=design, scene=scene, threads=1)
        r = simulate(stretches(n), design=design, scene=scene, equilibria=found, threads=1)
        data[f"{factor:g}/converged"], data[f"{factor:g}/status"] = found.converged, r.status
        data[f"{factor:g}/dt"], data[f"{factor:g}/audit"] = np.array(r.dt), audit(r.energies, r.stored_energy)
        data[f"{factor:g}/rise"] = r.apex
    return data


def contacts(n: int) -> Data:
    """Every friction with every restitution, to rest or 3 s."""
    data: Data = {}
    found = form_find(stretches(n), threads=1)
    for mu in FRICTIONS:
        for e in RESTITUTIONS:
            scene = Scene(friction=mu, restitution=e)
            r = simulate(stretches(n), scene=scene, equilibria=found, threads=1, precision="float32", trajectory_rate=100.0)
            assert r.trajectory is not None
            key = f"{mu:g}/{e:g}"
            data[f"{key}/status"], data[f"{key}/audit"] = r.status, audit(r.energies, r.stored_energy)
            data[f"{key}/depth"] = -r.trajectory.positions[..., 2].min(axis=(1, 2))
            data[f"{key}/apex"] = r.apex
            data[f"{key}/contact"] = r.energies[:, -1, 5] / r.stored_energy
    return data


def steps(n: int) -> Data:
    """Hops at steps around the critical one, and that one anew along the frames of hops."""
    data: Data = {}
    design, lattice, scene = Design(), Lattice(), Scene(duration=1.7)
    structure = design.structure(lattice)
    critical = critical_time_step(structure, design.unloaded_positions(lattice))
    found = form_find(stretches(n), threads=1)
    for share in STEPS:
        r = simulate(stretches(n), scene=scene, equilibria=found, threads=1, dt=share * critical, allow_unstable=True)
        data[f"{share:g}/status"], data[f"{share:g}/touchdown"] = r.status, r.touchdown
        data[f"{share:g}/audit"] = audit(r.energies, r.stored_energy)
    r = simulate(stretches(n)[:4], scene=scene, threads=1, trajectory_rate=100.0)
    assert r.trajectory is not None
    along = [
        [critical_time_step(structure, x) for x in hop[: r.trajectory.frames[i] : 4]]
        for i, hop in enumerate(r.trajectory.positions)
    ]
    data["along"] = np.array([c for hop in along for c in hop]) / critical
    data["default"] = np.array(default_time_step(design, lattice) / critical)
    return data


def measure(options: Options) -> Data:
    """The four questions."""
    n = options.size(16, 8)
    parts = {"gravity": gravities, "stiffness": stiffnesses, "contact": contacts, "step": steps}
    data: Data = {}
    for name, question in parts.items():
        found = kept(options, f"limits-{name}", lambda q=question: q(n), n=n)  # type: ignore[misc]
        data |= {f"{name}/{k}": v for k, v in found.items()}
    return data


def statuses(codes: Floats) -> str:
    """How many hops ended how."""
    return ", ".join(f"{(codes == s).sum()} {HopStatus(s).name.lower()}" for s in np.unique(codes))


def report(d: Data) -> list[str]:
    """A table for each question."""
    lines = ["gravity: 0.3 s, energy can fly = stored energy above what lifts the lattice into its unloaded shape"]
    rows = []
    for g in GRAVITIES:
        at = f"gravity/{g:g}"
        rows.append(
            [
                f"{g:g} g",
                f"{d[f'{at}/converged'].sum()}",
                f"{d[f'{at}/can_fly'].sum()}",
                f"{(d[f'{at}/status'] <= HopStatus.TIME_LIMIT).sum()}",
                f"{np.median(d[f'{at}/speed'][d[f'{at}/converged']]):.3f}",
                f"{d[f'{at}/audit'].max():.1e}",
                statuses(d[f"{at}/status"]),
            ]
        )
    lines += table("gravity  equilibria  can fly  fly  take-off speed [m/s]  worst audit  status", rows)
    rows = []
    for f in STIFFNESSES:
        at = f"stiffness/{f:g}"
        scaled = d[f"{at}/dt"] * np.sqrt(f) / d["stiffness/1/dt"]
        cells = [f"{f:.3g}", f"{d[f'{at}/converged'].sum()}", f"{1e6 * d[f'{at}/dt']:.2f}", f"{scaled:.3f}"]
        rows.append([*cells, f"{np.median(d[f'{at}/rise']):.3f}", f"{d[f'{at}/audit'].max():.1e}", statuses(d[f"{at}/status"])])
    lines += ["", *table("stiffness  equilibria  dt [us]  dt sqrt(E) over its own  rise [m]  worst audit  status", rows)]
    rows = []
    for mu in FRICTIONS:
        for e in RESTITUTIONS:
            at = f"contact/{mu:g}/{e:g}"
            cells = [f"{mu:g}", f"{e:g}", f"{np.median(d[f'{at}/apex']):.3f}", f"{np.median(d[f'{at}/contact']):.2f}"]
            cells += [f"{1e3 * d[f'{at}/depth'].max():.2f}", f"{d[f'{at}/audit'].max():.1e}", statuses(d[f"{at}/status"])]
            rows.append(cells)
    head = "friction  restitution  apex [m]  lost in contact  deepest [mm]  worst audit  status"
    lines += ["", "3 s in float32; energies over the stored one", *table(head, rows)]
    rows = []
    for share in STEPS:
        at = f"step/{share:g}"
        moved = np.linalg.norm(d[f"{at}/touchdown"] - d[f"step/{STEPS[0]:g}/touchdown"], axis=1)
        fine = d[f"{at}/status"] <= HopStatus.TIME_LIMIT
        cells = [f"{share:g}", f"{1e3 * np.median(moved[fine]):.2f}" if fine.any() and share > STEPS[0] else "-"]
        rows.append([*cells, f"{d[f'{at}/audit'][fine].max():.1e}" if fine.any() else "-", statuses(d[f"{at}/status"])])
    lines += ["", *table("dt over critical  touchdown from the first's [mm]  worst audit of these  status", rows)]
    along = d["step/along"]
    lines.append(
        f"critical step along {len(along)} frames of 4 hops, every member taut, over that of the unloaded lattice: "
        f"{along.min():.4f} to {along.max():.4f}; the default step is {float(d['step/default']):.3f} of it"
    )
    return lines


def plot(d: Data) -> Figure:
    """Take-off speed under gravity, step and audit over stiffness, critical step along hops."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.3), layout="constrained")
    speeds = np.array([np.percentile(d[f"gravity/{g:g}/speed"][d[f"gravity/{g:g}/converged"]], (5, 50, 95)) for g in GRAVITIES])
    axes[0].semilogx(GRAVITIES, speeds[:, 1], "o-")
    axes[0].fill_between(GRAVITIES, speeds[:, 0], speeds[:, 2], alpha=0.2)
    axes[0].set(xlabel="gravity / g", ylabel="take-off speed, 0 without flight [m/s]")
    steps_ = np.array([d[f"stiffness/{f:g}/dt"] for f in STIFFNESSES])
    axes[1].loglog(STIFFNESSES, 1e6 * steps_, "o-", label="default step")
    axes[1].loglog(STIFFNESSES, 1e6 * d["stiffness/1/dt"] / np.sqrt(STIFFNESSES), "k:", label="1 / √stiffness")
    axes[1].set(xlabel="stiffness of bars and cables / default", ylabel="step [µs]")
    axes[1].legend(fontsize=8)
    axes[2].hist(d["step/along"], bins=40)
    axes[2].axvline(float(d["step/default"]), color="C3", label="default step")
    axes[2].set(xlabel="critical step / that of the unloaded lattice", ylabel="frames of four hops")
    axes[2].legend(fontsize=8)
    return figure


PART = Part("limits", measure, report, plot)
