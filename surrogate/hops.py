"""Hops as columns, and the configuration that decides what each of them is."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from surrogate.sampling import SAMPLERS
from surrogate.schema import (
    CHUNK_BYTES,
    CHUNK_ROWS,
    COLUMNS,
    CONTENTS,
    SCENE_VALUES,
    SCHEMA_VERSION,
    SPLITS,
    TRAJECTORIES,
    Column,
    columns_of,
)
from surrogate.storage import hash_of
from tensegrity_gym import MODEL_VERSION, Design, Equilibria, HopResult, HopStatus, Lattice, Scene
from tensegrity_gym.energies import centre_of_mass
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tensegrity_gym.fidelity import Fidelity, changed, named_fidelity
from tensegrity_gym.types import Floats, Ints

#: Parts of a configuration that, with scene and ranges, decide where a hop of given stretches lands.
PHYSICS = ("fidelity", "dt", "model_version", "design", "lattice")


@dataclass(frozen=True)
class Configuration:
    """All that decides what hop number k is; how many hops a file holds is left out, so that it can grow and be cut up."""

    design: Design = field(default_factory=Design)
    scene: Scene = field(default_factory=Scene)
    lattice: Lattice = field(default_factory=Lattice)
    seed: int = 0
    sampler: str = "sobol"
    sampler_size: int = 0
    """Points of a Latin hypercube or a file, points per axis of a grid; 0 for the endless samplers."""
    stretches_hash: str = ""
    """Of the stretches, where they come from a file."""
    dt: float | None = None
    """Time step [s]; None lets the simulator choose."""
    fidelity: Fidelity | str = "paper"
    """How finely a hop is modelled; a name out of ``tensegrity_gym.fidelity.FIDELITIES`` or a Fidelity."""
    precision: str | None = None
    """Of the simulator's lanes; None for the fidelity's."""
    content: str = "hops"
    """hops, or equilibria alone."""
    scene_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Values of the scene that vary, each uniform in (low, high)."""
    hops_per_scene: int = 16
    """Hops in a row that share a scene: as many as the simulator takes at once."""
    symmetry: bool = False
    """Add each hop's images under the symmetries of lattice and scene."""
    node_positions: bool = False
    """Keep the nodes of the equilibria."""
    trajectory: str = "none"
    """none, the centre of mass, or (full) all masses."""
    trajectory_rate: float = 60.0
    """Frames per second [Hz]."""

    def __post_init__(self) -> None:
        _ = self.model  # an unknown fidelity or precision is refused here
        for name, allowed in (("sampler", SAMPLERS), ("content", CONTENTS), ("trajectory", TRAJECTORIES)):
            if getattr(self, name) not in allowed:
                raise InvalidParameterError(f"{name}: expected one of {allowed}, got {getattr(self, name)!r}")
        if self.sampler in ("lhs", "grid", "file") and self.sampler_size < 1:
            raise InvalidParameterError(f"sampler_size: expected an integer >= 1 for {self.sampler}, got {self.sampler_size}")
        if self.hops_per_scene < 1:
            raise InvalidParameterError(f"hops_per_scene: expected an integer >= 1, got {self.hops_per_scene}")
        if not 0 <= self.seed < 2**64:
            raise InvalidParameterError(f"seed: expected an integer from 0 to 2^64 - 1, got {self.seed}")
        for name, bounds in self.scene_ranges.items():
            if name not in SCENE_VALUES or len(bounds) != 2 or not bounds[0] <= bounds[1]:
                raise InvalidParameterError(
                    f"scene_ranges: expected low <= high for names out of {sorted(SCENE_VALUES)}, got {name}: {bounds}"
                )
            for bound in bounds:  # a value that no scene can have is refused now, not in some later chunk
                replace(self.scene, **{name: bound})  # type: ignore[arg-type]
        if self.symmetry and {"slope", "slope_direction"} & set(self.scene_ranges):
            raise InvalidParameterError(
                "symmetry: expected scenes of one slope, which keep their symmetries; got a range of slopes"
            )

    def as_dict(self) -> dict[str, Any]:
        """JSON-like content, with the versions of schema and physics."""
        plain = {
            k: getattr(self, k)
            for k in self.__dataclass_fields__
            if k not in ("design", "scene", "lattice", "scene_ranges", "fidelity", "precision")
        }
        return {
            "schema_version": SCHEMA_VERSION,
            "model_version": MODEL_VERSION,
            "design": asdict(self.design),
            "scene": asdict(self.scene),
            "lattice": asdict(self.lattice),
            "fidelity": self.model.levers(),
            "precision": self.model.precision,
            "scene_ranges": {name: [float(b) for b in bounds] for name, bounds in sorted(self.scene_ranges.items())},
            **plain,
        }

    @property
    def model(self) -> Fidelity:
        """The fidelity with all its levers."""
        return changed(named_fidelity(self.fidelity), {"precision": self.precision})

    @property
    def modelled(self) -> Design:
        """The design as the fidelity models it: what decides shapes and masses."""
        return self.model.design(self.design)

    @property
    def symmetries(self) -> tuple[Ints, Ints]:
        """Permutations (g, n_actuators) and signs (g, 2) that leave lattice and gravity as they are; the identity first."""
        return self.lattice.symmetries_keeping(self.scene.gravity_vector[:2] / self.scene.gravity)

    @property
    def rows_per_hop(self) -> int:
        """Rows of the file for each hop that is simulated."""
        return len(self.symmetries[0]) if self.symmetry else 1


def simulate_arguments(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """What ``simulate`` makes a file's hops with again, from its configuration; where scenes vary, ``scene`` is their base."""
    return {
        "design": Design(**configuration["design"]),
        "scene": Scene(**configuration["scene"]),
        "lattice": Lattice(**configuration["lattice"]),
        # files from before fidelities say the precision alone
        "fidelity": Fidelity(**configuration.get("fidelity", {"precision": configuration["precision"]})),
        "dt": configuration["dt"],
    }


@dataclass(frozen=True)
class HopData:
    """Hops as columns (batch first) and the configuration they were made with."""

    columns: dict[str, np.ndarray]
    configuration: dict[str, Any]
    seconds: float = 0.0  #: wall time that simulating them took [s]

    def __len__(self) -> int:
        return len(self.columns["index"])

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def rows(self, which: slice | np.ndarray) -> HopData:
        """Some of the hops, by slice, mask or index."""
        return HopData({name: values[which] for name, values in self.columns.items()}, self.configuration, self.seconds)

    @property
    def usable(self) -> np.ndarray:
        """True where the hop is an answer of the physics (it did not blow up and had an equilibrium), shape (n,)."""
        if "status" not in self.columns:
            return self["converged"] == 1
        return ~np.isin(self["status"], (HopStatus.UNSTABLE, HopStatus.NOT_CONVERGED))

    @property
    def digest(self) -> str:
        """SHA-256 of all that a rerun must repeat bit by bit, from the chunks' checksums: 64 hex digits."""
        schema = columns_of(self.configuration)
        return digest_of({name: checksums(values, schema[name]) for name, values in self.columns.items()}, schema)

    def split(self, validation: float = 0.1, test: float = 0.1) -> dict[str, np.ndarray]:
        """Row numbers of the usable hops of each split, decided by each hop's own stretches.

        Stretches and their images under the lattice's symmetries hash alike, so no hop's image sits in another split; images
        themselves are training rows or nothing.
        """
        bins = np.digitize(self["split_share"], (1 - validation - test, 1 - test))
        taken = self.usable & ((self["image"] == 0) | (bins == 0))
        return {name: np.nonzero((bins == k) & taken)[0] for k, name in enumerate(SPLITS)}


def chunk_rows(values: np.ndarray) -> int:
    """Rows of a column that are stored, compressed and checked together: a power of two."""
    row = max(1, int(np.prod(values.shape[1:], dtype=np.int64)) * values.dtype.itemsize)
    return int(max(1, min(CHUNK_ROWS, 2 ** int(np.log2(max(1, CHUNK_BYTES // row))))))


def checksums(values: np.ndarray, column: Column) -> np.ndarray:
    """BLAKE2b of each chunk's bytes, as stored (little endian), shape (n_chunks,) uint64."""
    data = np.ascontiguousarray(values, dtype=np.dtype(column.dtype).newbyteorder("<"))
    rows = chunk_rows(data)
    sums = [hashlib.blake2b(data[k : k + rows].data, digest_size=8).digest() for k in range(0, len(data), rows)]
    return np.frombuffer(b"".join(sums), dtype="<u8")


def digest_of(sums: Mapping[str, np.ndarray], schema: Mapping[str, Column]) -> str:
    """The digest of a file from its columns' checksums."""
    total = hashlib.sha256()
    for name, column in schema.items():
        if name in sums and not column.measured:
            total.update(name.encode() + sums[name].astype("<u8").tobytes())
    return total.hexdigest()


def split_share(stretches: Floats, lattice: Lattice) -> Floats:
    """A number in [0, 1) per hop from a hash of its stretches' least image under the lattice's symmetries, shape (n,)."""
    images = np.round(stretches[:, lattice.symmetries], 9)  # (n, n_symmetries, n_actuators)
    least = images[:, 0]
    for k in range(1, images.shape[1]):
        other = images[:, k]
        differs = other != least
        first = np.argmax(differs, axis=1)[:, None]
        smaller = np.take_along_axis(other < least, first, axis=1)[:, 0] & differs.any(axis=1)
        least = np.where(smaller[:, None], other, least)
    rows = np.ascontiguousarray(least, dtype="<f8")
    hashes = [int.from_bytes(hashlib.sha256(row.data).digest()[:6], "big") for row in rows]
    return np.array(hashes, dtype=np.float64) / 2**48


def from_result(
    result: HopResult,
    configuration: Configuration,
    seconds: float = 0.0,
    *,
    index: Ints | None = None,
    cpu_seconds: float = 0.0,
    scene_values: Mapping[str, float] | None = None,
) -> HopData:
    """Columns of a simulated batch; ``index`` numbers its hops (default: from 0), ``cpu_seconds`` is for all of them."""
    found = result.equilibria
    columns = {name: getattr(result, name) for name in COLUMNS if hasattr(result, name)}
    if configuration.trajectory != "none" and result.trajectory is not None:
        track = result.trajectory
        positions = track.positions
        if configuration.trajectory == "centre":
            positions = centre_of_mass(result.structure, positions)
            positions[np.arange(positions.shape[1]) >= track.frames[:, None]] = 0.0
        columns |= {"frames": track.frames, "frame_times": track.times, "trajectory": positions}
    columns |= _common(found, configuration, index, cpu_seconds, scene_values or {})
    return _typed(columns, configuration, seconds)


def from_equilibria(
    found: Equilibria,
    configuration: Configuration,
    seconds: float = 0.0,
    *,
    index: Ints | None = None,
    cpu_seconds: float = 0.0,
    scene_values: Mapping[str, float] | None = None,
) -> HopData:
    """Columns of a batch of equilibria that are not released."""
    columns = {"stretches": found.stretches, "stored_energy": found.stored_energy, "converged": found.converged}
    return _typed(columns | _common(found, configuration, index, cpu_seconds, scene_values or {}), configuration, seconds)


def _common(
    found: Equilibria, configuration: Configuration, index: Ints | None, cpu_seconds: float, scene_values: Mapping[str, float]
) -> dict[str, np.ndarray]:
    n = len(found.stretches)
    return {
        "index": np.arange(n) if index is None else index,
        "image": np.zeros(n),
        "split_share": split_share(found.stretches, configuration.lattice),
        "equilibrium_energy": found.energy,
        "residual": found.residual,
        "iterations": found.iterations,
        "cpu_seconds": np.full(n, cpu_seconds / max(n, 1)),
        "node_positions": found.positions[:, : configuration.lattice.n_nodes],
        **{f"scene_{name}": np.full(n, value) for name, value in scene_values.items()},
    }


def _typed(columns: Mapping[str, np.ndarray], configuration: Configuration, seconds: float) -> HopData:
    plain = configuration.as_dict()
    typed = {name: np.ascontiguousarray(columns[name], dtype=c.dtype) for name, c in columns_of(plain).items()}
    return HopData(typed, plain, seconds)


def concatenate(parts: list[HopData]) -> HopData:
    """Join hops of one configuration."""
    for part in parts[1:]:
        check_configuration(part.configuration, parts[0].configuration, "the second part")
    columns = {name: np.concatenate([p[name] for p in parts]) for name in parts[0].columns}
    return HopData(columns, parts[0].configuration, sum(p.seconds for p in parts))


def check_parts(
    came: Mapping[str, Any], expected: Mapping[str, Any], names: Iterable[str], where: str, why: str, fix: str
) -> None:
    """DataFileError for the first of the parts ``names`` that two configurations have different.

    ``why`` says whose the expected one is, ``fix`` what to do.
    """
    for name in names:
        theirs, ours = came.get(name), expected.get(name)
        if theirs == ours:
            continue
        if isinstance(theirs, Mapping) and isinstance(ours, Mapping):  # only what differs is worth reading
            different = [k for k in sorted({*theirs, *ours}) if theirs.get(k) != ours.get(k)]
            theirs, ours = ({k: part.get(k) for k in different} for part in (theirs, ours))
        raise DataFileError(f"{where}: expected {name} {ours!r}, {why}, got {theirs!r}; {fix}")


def check_configuration(came: dict[str, Any], expected: dict[str, Any], where: str) -> None:
    """DataFileError, which names every difference, unless two configurations are the same."""
    if came == expected:
        return
    different = [k for k in sorted(set(came) | set(expected)) if came.get(k) != expected.get(k)]
    pairs = "; ".join(f"{k}: expected {expected.get(k)!r}, got {came.get(k)!r}" for k in different)
    raise DataFileError(
        f"{where} was made from configuration {hash_of(came)}, this run is configuration {hash_of(expected)} ({pairs}); "
        "choose another file name, or the settings it was made with"
    )
