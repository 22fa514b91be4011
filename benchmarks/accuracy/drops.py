"""The uncompressed lattice thrown at the ground: bars buckle, fold and snap back. What the step and the model stand."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.accuracy.part import Data, Options, Part, table
from benchmarks.accuracy.stepping import Motion
from tensegrity_gym import Design, Lattice, Scene
from tensegrity_gym.energies import elastic_energies, gravitational_energy, hinge_angles, kinetic_energy
from tensegrity_gym.timestep import critical_time_step

SPEEDS = (1.0, 3.0, 10.0, 30.0)
SHARES = (0.4, 0.8, 0.95, 1.05)
#: Long enough for the rebound to begin at every speed [s].
DURATION = 0.15


def energy(motion: Motion, scene: Scene) -> float:
    """Elastic, kinetic and gravitational energy at the velocities' half step, potentials as means over the step [J]."""
    s, total = motion.structure, float(kinetic_energy(motion.structure, motion.v[None])[0])
    for back in (0.0, 1.0):
        x = (motion.x - back * motion.dt * motion.v)[None]
        parts = elastic_energies(s, x, s.actuator_length[None])
        total += 0.5 * (sum(float(e[0]) for e in parts.values()) + float(gravitational_energy(s, scene.gravity_vector, x)[0]))
    return total


def drop(speed: float, share: float, duration: float = DURATION, lattice: Lattice | None = None) -> dict[str, float]:
    """Extremes of a drop at ``speed`` [m/s] with a step of ``share`` of the critical one; NaN where it blew up."""
    design, lattice, scene = Design(), lattice or Lattice(), Scene()
    structure = design.structure(lattice)
    x = design.unloaded_positions(lattice)
    x[:, 2] += 1e-6 - x[:, 2].min()
    # straight bars need an imperfection to buckle: the first mode, a thousandth of a length, each to its own side
    inner = structure.bars[:, 1:-1]
    chord = x[structure.bars[:, -1]] - x[structure.bars[:, 0]]
    side = np.cross(chord, np.random.default_rng(0).normal(size=chord.shape))
    x[inner] += 1e-3 * design.bar_length * (side / np.linalg.norm(side, axis=1, keepdims=True))[:, None]
    critical = critical_time_step(structure, x)
    motion = Motion(structure, scene.ground, share * critical, x, np.zeros_like(x) + [0.0, 0.0, -speed])
    motion.moved = True  # thrown at half a step before: the first kick is a whole one
    motion.run(1)
    start, lost = energy(motion, scene), motion.losses.sum()
    fold = crush = strain = 0.0
    tightest = np.inf
    while motion.moved and duration > 0:
        motion.run(max(1, round(1e-3 / motion.dt)))
        duration -= 1e-3
        if not np.isfinite(motion.v).all() or np.abs(motion.v).max() > 1e4:
            return {"audit": np.nan, "fold": np.nan, "crush": np.nan, "strain": np.nan, "critical": np.nan, "rebound": np.nan}
        fold = max(fold, float(hinge_angles(motion.x[None], structure.bars).max()))
        crush = max(crush, 1 - float(motion.x[:, 2].max() - motion.x[:, 2].min()) / design.cell_height)
        length = np.linalg.norm(np.diff(motion.x[structure.bars], axis=1), axis=-1)
        strain = max(strain, float(np.abs(length / structure.segment_length[:, None] - 1).max()))
        tightest = min(tightest, critical_time_step(structure, motion.x) / critical)
    gap = energy(motion, scene) + motion.losses.sum() - start - lost
    up = float(structure.mass @ motion.v[:, 2] / structure.mass.sum())
    return {"audit": abs(gap) / start, "fold": fold, "crush": crush, "strain": strain, "critical": tightest, "rebound": up}


def measure(options: Options) -> Data:
    """All speeds with all steps."""
    lattice = Lattice(1, 1) if options.quick else Lattice()
    duration, data = 0.06 if options.quick else DURATION, {}
    for speed in SPEEDS:
        for share in SHARES:
            data |= {f"{speed:g}/{share:g}/{k}": np.array(v) for k, v in drop(speed, share, duration, lattice).items()}
    return data


def report(d: Data) -> list[str]:
    """Extremes for each speed and step."""
    rows = []
    for speed in SPEEDS:
        for share in SHARES:
            at = f"{speed:g}/{share:g}"
            if np.isnan(d[f"{at}/audit"]):
                rows.append([f"{speed:g}", f"{share:g}", "blew up", *["-"] * 5])
                continue
            rows.append(
                [
                    f"{speed:g}",
                    f"{share:g}",
                    f"{d[f'{at}/audit']:.1e}",
                    f"{np.degrees(d[f'{at}/fold']):.0f}",
                    f"{100 * d[f'{at}/crush']:.0f}",
                    f"{1e3 * d[f'{at}/strain']:.2f}",
                    f"{d[f'{at}/critical']:.3f}",
                    f"{d[f'{at}/rebound']:+.2f}",
                ]
            )
    head = "speed [m/s]  dt over critical  audit  largest hinge [deg]  crushed [%]  bar strain [1e-3]  "
    head += "least critical step  rising at the end [m/s]"
    return ["critical step: along the drop, over that of the start; audit over the energy at impact", *table(head, rows)]


def plot(d: Data) -> Figure:
    """How far hinges fold, how far the lattice is crushed, and how the audit closes."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.3), layout="constrained")
    at = [f"{speed:g}/{SHARES[0]:g}" for speed in SPEEDS]
    left.semilogx(SPEEDS, [np.degrees(d[f"{k}/fold"]) for k in at], "o-", label="largest hinge angle [°]")
    left.semilogx(SPEEDS, [100 * d[f"{k}/crush"] for k in at], "s-", label="crushed height [%]")
    left.axhline(180, color="k", lw=0.6, ls=":")
    left.set(xlabel="impact speed [m/s]")
    left.legend(fontsize=8)
    for share in SHARES[:-1]:  # with the last one all blow up
        right.loglog(SPEEDS, [d[f"{speed:g}/{share:g}/audit"] for speed in SPEEDS], "o-", label=f"dt = {share:g} critical")
    right.set(xlabel="impact speed [m/s]", ylabel="audit gap / energy at impact")
    right.legend(fontsize=8, title=f"with {SHARES[-1]:g} all blow up", title_fontsize=8)
    for axis in (left, right):
        axis.grid(alpha=0.3)
    return figure


PART = Part("drops", measure, report, plot)
