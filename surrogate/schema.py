"""What a hop file holds: its columns, their shapes, types, units and meanings, and the version of all that.

Version 1 had no per-hop index, no split share, no checksums per chunk and no checksum of the file.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, NamedTuple

from tensegrity_gym import ENERGY_NAMES, HopStatus, Lattice

SCHEMA_VERSION = 2
EVENTS = ("release", "take-off", "touchdown", "end")
SPLITS = ("train", "validation", "test")
CONTENTS = ("hops", "equilibria")
TRAJECTORIES = ("none", "centre", "full")
#: Values of a scene that may vary from hop to hop, with units.
SCENE_VALUES = {"gravity": "m/s^2", "slope": "rad", "slope_direction": "rad", "friction": "1", "restitution": "1"}

#: Stand-ins in column shapes for lengths that the lattice, or the run, decides.
ACTUATORS, NODES, MASSES, FRAMES = -1, -2, -3, -4
#: Rows that are compressed and checked together, at most; fewer where rows are long.
CHUNK_ROWS = 1024
CHUNK_BYTES = 2**20


class Column(NamedTuple):
    """One data set of the file: shape after the hop axis (negative: see ``ACTUATORS`` ...), type, unit and meaning."""

    shape: tuple[int, ...]
    dtype: str
    unit: str
    description: str
    measured: bool = False  #: a measurement of the run, which no rerun repeats; left out of the digest


def _said(statuses: Iterable[HopStatus]) -> str:
    return ", ".join(f"{s.value} {s.name}" for s in statuses)


#: Columns of every file of hops, in their order.
COLUMNS: dict[str, Column] = {
    "index": Column((), "i8", "1", "number of the hop in its sampler's sequence; unique but for symmetry images"),
    "image": Column((), "i8", "1", "0 simulated, k > 0 image of it under the lattice's k-th symmetry"),
    "split_share": Column((), "f8", "1", "number in [0, 1) from a hash of the stretches up to symmetry; splits cut it"),
    "stretches": Column((ACTUATORS,), "f8", "1", "lambda: rest length of each actuated cable over the cell's height"),
    "landing": Column((2,), "f8", "m", "horizontal displacement of the centre of mass, read as scene.landing says"),
    "rest": Column((2,), "f8", "m", "horizontal displacement of the centre of mass when the hop is over"),
    "touchdown": Column((2,), "f8", "m", "horizontal displacement of the centre of mass at the first impact after flight"),
    "rest_nodes": Column((2,), "f8", "m", "as rest, of the mean of the nodes"),
    "touchdown_nodes": Column((2,), "f8", "m", "as touchdown, of the mean of the nodes"),
    "apex": Column((), "f8", "m", "rise of the centre of mass above its start"),
    "takeoff_time": Column((), "f8", "s", "when the last mass leaves the ground"),
    "takeoff_velocity": Column((3,), "f8", "m/s", "velocity of the centre of mass at take-off"),
    "touchdown_time": Column((), "f8", "s", "first impact after flight"),
    "flight_time": Column((), "f8", "s", "touchdown_time - takeoff_time, 0 without flight"),
    "end_time": Column((), "f8", "s", "when the hop is over"),
    "energies": Column((len(EVENTS), len(ENERGY_NAMES)), "f8", "J", f"at {', '.join(EVENTS)}; columns {', '.join(ENERGY_NAMES)}"),
    "stored_energy": Column((), "f8", "J", "elastic energy of the equilibrium above that of the unstrained members"),
    "equilibrium_energy": Column((), "f8", "J", "total potential energy of the equilibrium"),
    "residual": Column((), "f8", "N", "largest force left on a mass in the equilibrium"),
    "iterations": Column((), "i8", "1", "iterations of form-finding"),
    "status": Column((), "i8", "1", _said(HopStatus)),
    "steps": Column((), "i8", "1", "time steps of the hop"),
    "cpu_seconds": Column((), "f8", "s", "CPU time per hop, mean over its chunk; 0 for symmetry images", measured=True),
}
#: Columns of a file of equilibria.
EQUILIBRIUM_COLUMNS: dict[str, Column] = {
    **{name: COLUMNS[name] for name in ("index", "image", "split_share", "stretches", "stored_energy", "equilibrium_energy")},
    **{name: COLUMNS[name] for name in ("residual", "iterations")},
    "converged": Column((), "i1", "1", "1 where the residual is below the tolerance of form-finding; use no others"),
    "cpu_seconds": COLUMNS["cpu_seconds"],
}
_NODE_POSITIONS = Column((NODES, 3), "f4", "m", "nodes of the equilibrium, centre of mass over the origin")
_FRAMES = {
    "frames": Column((), "i8", "1", "valid frames of the trajectory; those past them are zero"),
    "frame_times": Column((FRAMES,), "f4", "s", "time of each frame since release"),
}
_CENTRE = Column((FRAMES, 3), "f4", "m", "centre of mass in each frame")
_POSITIONS = Column((FRAMES, MASSES, 3), "f4", "m", "all point masses in each frame; order as tensegrity_gym.types.Structure")


def columns_of(configuration: dict[str, Any]) -> dict[str, Column]:
    """Columns, in order, of a file made with ``configuration`` (see ``Configuration.as_dict``)."""
    content = configuration.get("content", "hops")
    columns = dict(COLUMNS if content == "hops" else EQUILIBRIUM_COLUMNS)
    if content == "hops" and "fidelity" not in configuration:  # a file from before fidelities, when no hop was stopped
        known = [s for s in HopStatus if s is not HopStatus.STOPPED]
        columns["status"] = columns["status"]._replace(description=_said(known))
    for name in sorted(configuration.get("scene_ranges") or {}):
        columns[f"scene_{name}"] = Column((), "f8", SCENE_VALUES[name], f"Scene.{name} of this hop")
    if configuration.get("node_positions"):
        columns["node_positions"] = _NODE_POSITIONS
    trajectory = configuration.get("trajectory", "none")
    if content == "hops" and trajectory != "none":
        columns |= _FRAMES
        columns["trajectory"] = _CENTRE if trajectory == "centre" else _POSITIONS
    return columns


def expected_shape(column: Column, hops: int, configuration: dict[str, Any], frames: int = 0) -> tuple[int, ...]:
    """Shape of a column's whole data set."""
    fidelity = configuration.get("fidelity") or {}  # files from before there were any have the paper's
    segments = int(fidelity.get("bar_segments") or configuration["design"]["bar_segments"])
    lengths = {FRAMES: frames, **_lengths(**configuration["lattice"], bar_segments=segments)}
    return (hops, *(lengths.get(k, k) for k in column.shape))


@lru_cache(maxsize=8)
def _lengths(nx: int, ny: int, bar_segments: int) -> dict[int, int]:
    """What stands for what in column shapes; kept, since a lattice takes milliseconds to make."""
    lattice = Lattice(nx, ny)
    return {ACTUATORS: lattice.n_cells, NODES: lattice.n_nodes, MASSES: lattice.mass_count(bar_segments)}
