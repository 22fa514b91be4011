"""The flat HDF5 file of hops: schema, reading with every check, atomic writing, splits that cannot leak."""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from surrogate.storage import atomic_path, ensure_folder, hash_of, package_versions
from tensegrity_gym import ENERGY_NAMES, MODEL_VERSION, Design, HopResult, HopStatus, Lattice, Scene
from tensegrity_gym.errors import DataFileError

SCHEMA_VERSION = 1
EVENTS = ("release", "take-off", "touchdown", "end")
SPLITS = ("train", "validation", "test")


class Column(NamedTuple):
    """One data set of the file: the shape after the hop axis (-1: one per actuator), its type, unit and meaning."""

    shape: tuple[int, ...]
    dtype: str
    unit: str
    description: str


COLUMNS: dict[str, Column] = {
    "stretches": Column((-1,), "f8", "1", "lambda: rest length of each actuated cable over the cell's height"),
    "landing": Column((2,), "f8", "m", "horizontal displacement of the centre of mass, read as scene.landing says"),
    "rest": Column((2,), "f8", "m", "horizontal displacement of the centre of mass when the hop is over"),
    "touchdown": Column((2,), "f8", "m", "horizontal displacement of the centre of mass at the first impact after flight"),
    "rest_nodes": Column((2,), "f8", "m", "as rest, of the mean of the nodes"),
    "touchdown_nodes": Column((2,), "f8", "m", "as touchdown, of the mean of the nodes"),
    "apex": Column((), "f8", "m", "rise of the centre of mass above its start"),
    "takeoff_time": Column((), "f8", "s", "when the last mass leaves the ground"),
    "takeoff_velocity": Column((3,), "f8", "m/s", "velocity of the centre of mass at take-off"),
    "touchdown_time": Column((), "f8", "s", "first impact after flight"),
    "flight_time": Column((), "f8", "s", "touchdown_time - takeoff_time"),
    "end_time": Column((), "f8", "s", "when the hop is over"),
    "energies": Column((len(EVENTS), len(ENERGY_NAMES)), "f8", "J", f"at {', '.join(EVENTS)}; columns {', '.join(ENERGY_NAMES)}"),
    "stored_energy": Column((), "f8", "J", "elastic energy of the equilibrium above that of the unloaded lattice"),
    "equilibrium_energy": Column((), "f8", "J", "total potential energy of the equilibrium"),
    "residual": Column((), "f8", "N", "largest force left on a mass in the equilibrium"),
    "iterations": Column((), "i8", "1", "iterations of form-finding"),
    "status": Column((), "i8", "1", ", ".join(f"{s.value} {s.name}" for s in HopStatus)),
    "steps": Column((), "i8", "1", "time steps of the hop"),
}


@dataclass(frozen=True)
class Configuration:
    """All that decides what hop number k of a file is; how many hops there are is left out, so that a file can grow."""

    design: Design = field(default_factory=Design)
    scene: Scene = field(default_factory=Scene)
    lattice: Lattice = field(default_factory=Lattice)
    seed: int = 0
    sampler: str = "sobol"
    dt: float | None = None  #: [s]; None lets the simulator choose

    def as_dict(self) -> dict[str, Any]:
        """JSON-like content, with the versions of schema and physics."""
        return {
            "schema_version": SCHEMA_VERSION,
            "model_version": MODEL_VERSION,
            "design": asdict(self.design),
            "scene": asdict(self.scene),
            "lattice": asdict(self.lattice),
            "seed": self.seed,
            "sampler": self.sampler,
            "dt": self.dt,
        }


@dataclass(frozen=True)
class HopData:
    """Hops as columns (batch first) and the configuration they were made with."""

    columns: dict[str, np.ndarray]
    configuration: dict[str, Any]
    seconds: float = 0.0  #: wall time that simulating them took [s]

    def __len__(self) -> int:
        return len(self.columns["stretches"])

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def rows(self, which: slice | np.ndarray) -> HopData:
        """Some of the hops, by slice, mask or index."""
        return HopData({name: values[which] for name, values in self.columns.items()}, self.configuration, self.seconds)

    @property
    def usable(self) -> np.ndarray:
        """True where the hop is an answer of the physics (it did not blow up and had an equilibrium), shape (n,)."""
        return ~np.isin(self["status"], (HopStatus.UNSTABLE, HopStatus.NOT_CONVERGED))

    @property
    def digest(self) -> str:
        """SHA-256 of the columns' bytes, so that a flipped bit shows: 64 hex digits."""
        total = hashlib.sha256()
        for name in COLUMNS:
            total.update(name.encode())
            total.update(np.ascontiguousarray(self.columns[name]).tobytes())
        return total.hexdigest()

    def split(self, validation: float = 0.1, test: float = 0.1) -> dict[str, np.ndarray]:
        """Indices of the usable hops of each split, decided by each hop's own stretches.

        Stretches and their images under the lattice's symmetries hash alike, so no hop's image sits in another split.
        """
        share = _hash_share(self["stretches"], Lattice(**self.configuration["lattice"]).symmetries)
        bins = np.digitize(share, (1 - validation - test, 1 - test))
        return {name: np.nonzero((bins == k) & self.usable)[0] for k, name in enumerate(SPLITS)}


def _hash_share(stretches: np.ndarray, symmetries: np.ndarray) -> np.ndarray:
    """A number in [0, 1) per hop from the hash of the lexicographically least of its images, shape (n,)."""
    images = np.round(stretches[:, symmetries], 9)  # (n, n_symmetries, n_actuators)
    share = np.empty(len(stretches))
    for k, group in enumerate(images):
        least = min(tuple(row) for row in group.tolist())
        share[k] = int.from_bytes(hashlib.sha256(np.array(least).tobytes()).digest()[:7], "big") / 2**56
    return share


def from_result(result: HopResult, configuration: Configuration, seconds: float = 0.0) -> HopData:
    """Columns of a simulated batch."""
    found = result.equilibria
    columns = {"equilibrium_energy": found.energy, "residual": found.residual, "iterations": found.iterations}
    columns |= {name: getattr(result, name) for name in COLUMNS if name not in columns}
    columns = {name: np.ascontiguousarray(columns[name], dtype=COLUMNS[name].dtype) for name in COLUMNS}
    return HopData(columns, configuration.as_dict(), seconds)


def concatenate(parts: list[HopData]) -> HopData:
    """Join hops of one configuration."""
    for part in parts[1:]:
        _check_configuration(part.configuration, parts[0].configuration, "the second part")
    columns = {name: np.concatenate([p[name] for p in parts]) for name in COLUMNS}
    return HopData(columns, parts[0].configuration, sum(p.seconds for p in parts))


def write(path: Path | str, data: HopData) -> Path:
    """Write the whole file beside ``path`` and rename it: at every moment there is the old file, or the new one."""
    path = Path(path)
    ensure_folder(path.parent)
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        for name, column in COLUMNS.items():
            values = data[name]
            kept = file.create_dataset(
                name, data=values, chunks=values.shape if values.size else None, compression="gzip" if values.size else None
            )
            kept.attrs["unit"] = column.unit
            kept.attrs["description"] = column.description
        file.attrs.update(
            {
                "schema_version": SCHEMA_VERSION,
                "model_version": data.configuration["model_version"],
                "hops": len(data),
                "wall_seconds": data.seconds,
                "configuration": json.dumps(data.configuration, sort_keys=True),
                "configuration_hash": hash_of(data.configuration),
                "packages": json.dumps(package_versions()),
                "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
                "date": datetime.now(UTC).isoformat(timespec="seconds"),
                "digest": data.digest,
            }
        )
    return path


def read(path: Path | str, expect: Configuration | None = None) -> HopData:
    """Read and check a file: schema, damage and, where ``expect`` is given, that it was made with that configuration.

    Raises DataFileError, which names the file, what was expected and what came.
    """
    path = Path(path)
    if not path.is_file():
        raise DataFileError(f"expected a data file at {path}, found none; make it with `python -m surrogate generate {path}`")
    try:
        with h5py.File(path, "r") as file:
            attributes = dict(file.attrs)
            columns = {name: file[name][()] for name in COLUMNS if name in file}
    except (OSError, KeyError, RuntimeError) as error:
        raise DataFileError(
            f"{path}: expected a whole HDF5 file of hops, but it cannot be read ({error}); generate it again"
        ) from error
    data = _checked(path, columns, attributes)
    if expect is not None:
        _check_configuration(data.configuration, expect.as_dict(), str(path))
    return data


def _checked(path: Path, columns: dict[str, np.ndarray], attributes: dict[str, Any]) -> HopData:
    version = int(attributes.get("schema_version", -1))
    if version != SCHEMA_VERSION:
        raise DataFileError(
            f"{path}: expected a hop file of schema {SCHEMA_VERSION}, got {version if version >= 0 else None}; generate anew"
        )
    missing = sorted(set(COLUMNS) - set(columns))
    if missing:
        raise DataFileError(f"{path}: expected the columns {sorted(COLUMNS)}, missing {missing}; generate it again")
    try:
        configuration = json.loads(attributes["configuration"])
        n_actuators = Lattice(**configuration["lattice"]).n_cells
    except (KeyError, TypeError, ValueError) as error:
        raise DataFileError(
            f"{path}: expected its configuration as JSON among its attributes ({error}); generate it again"
        ) from error
    hops = len(columns["stretches"])
    for name, column in COLUMNS.items():
        shape = (hops, *(n_actuators if k < 0 else k for k in column.shape))
        if columns[name].shape != shape or columns[name].dtype != np.dtype(column.dtype):
            came = f"{columns[name].dtype}{columns[name].shape}"
            raise DataFileError(f"{path}: expected column {name} as {column.dtype}{shape}, got {came}; generate it again")
    data = HopData(columns, configuration, float(attributes.get("wall_seconds", 0.0)))
    if data.digest != attributes.get("digest"):
        raise DataFileError(
            f"{path}: expected checksum {attributes.get('digest')}, got {data.digest}: damaged; generate it again"
        )
    return data


def _check_configuration(came: dict[str, Any], expected: dict[str, Any], where: str) -> None:
    if came == expected:
        return
    different = [k for k in sorted(set(came) | set(expected)) if came.get(k) != expected.get(k)]
    pairs = "; ".join(f"{k}: expected {expected.get(k)!r}, got {came.get(k)!r}" for k in different)
    raise DataFileError(
        f"{where} was made from configuration {hash_of(came)}, this run is configuration {hash_of(expected)} ({pairs}); "
        "choose another file name, or the settings it was made with"
    )
