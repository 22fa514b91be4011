"""Stretches to look at, and starts and designs perturbed by what no one can know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import qmc

from tensegrity_gym import Design, Equilibria, HopResult, Lattice, Scene, form_find, simulate
from tensegrity_gym.calibration import MATERIAL, POSITION
from tensegrity_gym.specimen import Specimen
from tensegrity_gym.timestep import default_time_step
from tensegrity_gym.types import Floats


def stretches(n: int, actuators: int = 4, seed: int = 0) -> Floats:
    """``n`` scrambled Sobol points over the paper's range, shape (n, actuators)."""
    points = qmc.Sobol(actuators, seed=seed).random_base2(int(np.ceil(np.log2(n))))[:n]
    return 0.2 + 0.6 * points


def hop_perturbed(
    kind: str,
    seed: int,
    found: Equilibria,
    *,
    design: Design,
    scene: Scene,
    precision: str = "float32",
    fidelity: str = "paper",
    rate: float | None = None,
    size: float | None = None,
    lattice: Lattice | None = None,
) -> HopResult:
    """The hops of ``found`` with one unknown added: "none", "positions", "actuators" or "material" (seeds from 1).

    * "positions": each coordinate of each mass by a normal of 10 micrometres.
    * "actuators": each actuated cable's length by a normal of 10 micrometres; the lattice settles again.
    * "material": each member's stiffness by a normal of 0.1 %; the lattice settles again.

    ``size`` replaces these numbers.
    """
    lattice = lattice or Lattice()
    model = {"fidelity": fidelity, "precision": precision}
    options = {"lattice": lattice, "scene": scene, "trajectory_rate": rate, "threads": 1, **model}
    rng = np.random.default_rng([seed, 99])
    if kind == "none":
        return simulate(found.stretches, design=design, equilibria=found, **options)  # type: ignore[arg-type]
    if kind == "positions":
        noise = rng.normal(0.0, POSITION if size is None else size, found.positions.shape)
        moved = replace(found, positions=found.positions + noise)
        return simulate(found.stretches, design=design, equilibria=moved, **options)  # type: ignore[arg-type]
    if kind == "actuators":
        noise = rng.normal(0.0, (POSITION if size is None else size) / design.cell_height, found.stretches.shape)
        again = form_find(found.stretches + noise, design=design, scene=scene, lattice=lattice, threads=1, outside=True)
        return simulate(again.stretches, design=design, equilibria=again, **options)  # type: ignore[arg-type]
    if kind == "material":
        specimen = Specimen.of(design, seed, MATERIAL if size is None else size)
        again = form_find(found.stretches, design=specimen, scene=scene, lattice=lattice, threads=1)
        step = default_time_step(design, lattice)  # one step for all: a specimen's own critical step differs in the last digit
        return simulate(found.stretches, design=specimen, equilibria=again, dt=step, **options)  # type: ignore[arg-type]
    raise ValueError(f"hop_perturbed: expected none, positions, actuators or material, got {kind!r}")
