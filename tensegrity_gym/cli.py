"""``python -m tensegrity_gym``: a hop, the reach of a scene, or what the lattice is made of."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from tqdm import tqdm

from tensegrity_gym import calibration, reachable
from tensegrity_gym.design import Design
from tensegrity_gym.errors import InvalidParameterError, OutputFolderError, TensegrityError
from tensegrity_gym.hops import HopResult
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.simulate import simulate
from tensegrity_gym.types import ENERGY_NAMES, HopStatus

EVENTS = ("release", "take-off", "touchdown", "end")


def hop(
    stretches: tuple[float, float, float, float] = (0.3, 0.3, 0.3, 0.3),
    scene: str = "earth",
    landing: str = "rest",
    fidelity: str = "paper",
    tolerance: float | None = None,
    picture: Annotated[Path | None, tyro.conf.arg(metavar="PNG")] = None,
    video: Annotated[Path | None, tyro.conf.arg(metavar="GIF|MP4")] = None,
) -> None:
    """Simulate one hop of the 2x2 lattice and print what it did.

    Args:
        stretches: rest lengths of the four actuated cables over the height of the unloaded cell, each in [0.2, 0.8].
        scene: name of a scene preset.
        landing: where the landing is read, rest or touchdown.
        fidelity: paper, single (the same in float32), flown (that, rigid in flight, no further than the landing), reference
            (converged in time), or auto.
        tolerance: on the landing [m], with auto; the scene's floor if not given.
        picture: write a filmstrip of the hop here.
        video: write a film of the hop, at half speed, here.
    """
    where = Scene.preset(scene, landing=landing)
    for path in (picture, video):
        check_writable(path)
    if picture is not None and picture.suffix.lower() not in (".png", ".jpg", ".jpeg", ".webp"):
        raise InvalidParameterError(f"--picture: expected a path that ends in .png, .jpg or .webp, got {str(picture)!r}")
    if video is not None:
        from tensegrity_gym.render import check_film

        check_film(video, "--video")
    result = simulate(stretches, scene=where, fidelity=fidelity, tolerance=tolerance, trajectory_rate=240.0 if picture else None)
    print(summary(result, where))
    if picture is not None and result.trajectory is not None:
        from PIL import Image

        from tensegrity_gym.render import filmstrip, whole_hop

        Image.fromarray(filmstrip(whole_hop(result), design=result.fidelity.design(Design()))).save(picture)
        print(f"picture: {picture}")
    if video is not None:
        from tensegrity_gym.render import record_hop

        print(f"video: {record_hop(stretches, video, scene=where, fidelity=result.fidelity)}")


def info() -> None:
    """Print the counts of the 2x2 lattice and the numbers of the default design."""
    lattice, design = Lattice(2, 2), Design()
    structure = design.structure(lattice)
    counts = {
        "nodes": lattice.n_nodes,
        "bars": len(lattice.bars),
        "unactuated cables": len(lattice.cables),
        "actuated cables": len(lattice.actuators),
        "point masses": lattice.n_masses,
    }
    numbers = {
        "total mass": f"{structure.mass.sum():.4g} kg",
        "cell height": f"{design.cell_height:.4g} m",
        "bar length": f"{design.bar_length:.4g} m",
        "bar's Euler load": f"{design.critical_load:.4g} N",
        "bar's prestress load": f"{design.prestress_load:.4g} N",
        "bar's axial rigidity EA": f"{design.bar_rigidity:.4g} N",
        "bar's bending rigidity EI": f"{design.bending_rigidity:.4g} N m^2",
        "cable's axial rigidity EA": f"{design.cable_rigidity:.4g} N",
        "cable prestrain": f"{design.prestrain:.4g}",
    }
    for title, rows in (("Lattice 2x2", counts), ("Design (default)", numbers)):
        print(title)
        for name, value in rows.items():
            print(f"  {name:<26} {value}")


def reach(scene: str = "earth", hops: int = 256, seed: int = 0, save: bool = False) -> None:
    """Measure how far hops go: where hops with Sobol stretches land.

    Args:
        scene: name of a scene preset.
        hops: how many hops to simulate.
        seed: of the Sobol sequence.
        save: replace the reach that the package stores for this preset, which targets and rewards follow.
    """
    calibration.check_sample(hops, seed)  # before a progress bar is drawn
    where = Scene.preset(scene)
    with tqdm(total=hops, desc=f"hops, {scene}", unit="hop") as bar:
        measured = reachable.measure_reach(where, hops, seed, bar.update)
    for landing, found in measured.items():
        stored = reachable.stored_reach(scene, landing)
        print(
            f"{scene:<6} {landing:<9}  radius {found.radius:.3f} m, boundary {min(found.boundary):.3f} to "
            f"{max(found.boundary):.3f} m, downhill {found.downhill:.3f} m   (stored: radius {stored.radius:.3f} m)"
        )
    if save:
        print(f"saved: {reachable.save_reach(scene, measured, hops, seed)}")


def calibrate(scene: str = "earth", samples: int = 64, seed: int = 1, save: bool = False) -> None:
    """Measure what each model of the ladder costs and how far from the converged landing it ends.

    Args:
        scene: name of a scene preset.
        samples: hops to measure on.
        seed: of the Sobol sequence that their stretches are from.
        save: replace the calibration that the package stores for this preset, which `fidelity="auto"` chooses by.
    """
    calibration.check_sample(samples, seed)
    where = Scene.preset(scene)
    batches = 2 + calibration.UNKNOWNS + sum(len(models) for models in calibration.LADDER.values())
    with tqdm(total=batches, desc=f"models, {scene}", unit="batch") as bar:
        measured = calibration.calibrate(where, samples, seed, progress=bar.update)
    for landing, found in measured.items():
        print(f"{scene}, {landing}: floor {1e3 * found.floor:.3g} mm")
        print("  cost   median [mm]  97 % [mm]  model")
        for rung in found.rungs:
            print(f"  {rung.cost:.3f}  {1e3 * rung.median:11.3g}  {1e3 * rung.error:9.3g}  {rung.fidelity}")
    if save:
        print(f"saved: {calibration.save_calibration(scene, measured, seed)}")


def summary(result: HopResult, scene: Scene) -> str:
    """The first hop of ``result``, readable."""
    status = HopStatus(int(result.status[0]))
    x, y = result.landing[0]
    tx, ty = result.touchdown[0]
    speed = result.takeoff_velocity[0]
    lines = [
        f"stretches         {' '.join(f'{s:.3f}' for s in result.stretches[0])}",
        f"status            {status.name.lower().replace('_', ' ')}",
        f"landing           ({x:+.4f}, {y:+.4f}) m, {np.hypot(x, y):.4f} m from the start, read at {scene.landing}",
        f"touchdown         ({tx:+.4f}, {ty:+.4f}) m",
        f"apex rise         {result.apex[0]:.4f} m",
        f"take-off          at {result.takeoff_time[0]:.4f} s with ({speed[0]:+.3f}, {speed[1]:+.3f}, {speed[2]:+.3f}) m/s",
        f"flight time       {result.flight_time[0]:.4f} s",
        f"stored energy     {result.stored_energy[0]:.3f} J",
        f"time step         {result.dt * 1e6:.3g} us",
        f"fidelity          {result.fidelity}",
        "",
        "energies [J]".ljust(24) + "".join(f"{event:>12}" for event in EVENTS),
    ]
    rows = [(name.replace("_", ", "), result.energies[0, :, k]) for k, name in enumerate(ENERGY_NAMES)]
    rows.append(("sum", result.energies[0].sum(axis=1)))
    lines += [f"  {name:<22}" + "".join(f"{energy:12.4f}" for energy in values) for name, values in rows]
    return "\n".join(lines)


def check_writable(path: Path | None) -> None:
    """OutputFolderError for a ``path`` that no file can be written to: better before a simulation than after it."""
    if path is None:
        return
    folder = path.resolve().parent
    if not folder.is_dir():
        raise OutputFolderError(f"expected an existing folder to write {path.name} to, got {folder}; make it first")
    if path.is_dir():
        raise OutputFolderError(f"expected a file's name to write to, got the folder {path}; add a name")
    if not os.access(folder, os.W_OK):
        raise OutputFolderError(f"expected a folder that may be written to, got {folder}; choose another")


def main(args: list[str] | None = None) -> int:
    """Run the command; errors of this project's own are printed as one line, with exit status 2."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            {"hop": hop, "info": info, "reach": reach, "calibrate": calibrate},
            prog="python -m tensegrity_gym",
            description=__doc__,
            args=args,
        )
    except TensegrityError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 2
    return 0
