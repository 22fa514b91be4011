"""Hop files for other tools: CSV, Parquet, and the layout of a Minari data set."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import h5py
import numpy as np
import tyro

from surrogate import dataset
from surrogate.hops import HopData
from surrogate.storage import atomic_path, ensure_folder
from tensegrity_gym import Design, Lattice, __version__
from tensegrity_gym.env import HopTask
from tensegrity_gym.errors import DataFileError, InvalidParameterError, MissingExtraError
from tensegrity_gym.scene_ranges import SCENE_VALUES
from tensegrity_gym.task import TARGET_LIMIT, observe, reach, reachable_middle

#: Version of Minari whose layout is written.
MINARI = "0.5.3"


@dataclass(frozen=True)
class ExportConfig:
    """Write a file of hops for other tools; the ending of OUT, or --minari, says which."""

    file: Annotated[Path, tyro.conf.Positional]
    """File of hops."""
    out: Annotated[Path, tyro.conf.Positional]
    """name.csv, name.parquet, or with --minari a folder; it must not be there."""
    minari: bool = False
    """Write a Minari data set: one episode a usable hop, whose target is where it landed."""


def flat(data: HopData) -> dict[str, np.ndarray]:
    """Columns of plain numbers: ``landing`` becomes ``landing_0`` and ``landing_1``, and so on."""
    columns = {}
    for name, values in data.columns.items():
        if values.ndim == 1:
            columns[name] = values
            continue
        for k, place in enumerate(product(*(range(n) for n in values.shape[1:]))):
            columns["_".join([name, *map(str, place)])] = values.reshape(len(values), -1)[:, k]
    return columns


def to_csv(path: Path, out: Path) -> None:
    """One line a hop; numbers read back bit by bit."""
    with atomic_path(out) as temporary, open(temporary, "w", newline="", encoding="utf-8") as text:
        writer = csv.writer(text)
        for k, part in enumerate(dataset.blocks(path)):
            columns = flat(part)
            if k == 0:
                writer.writerow(columns)
            writer.writerows(zip(*(v.tolist() for v in columns.values()), strict=True))


def to_parquet(path: Path, out: Path) -> None:
    """One row a hop, root attributes as metadata of the schema; needs pyarrow."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtraError(
            "export: expected pyarrow for Parquet, it is not installed; pip install 'tensegrity-gym[export]', or export .csv"
        ) from error
    about = {k: str(v) for k, v in dataset.attributes(path).items() if k != "configuration"}
    about["configuration"] = json.dumps(dataset.attributes(path)["configuration"])
    with atomic_path(out) as temporary:
        writer = None
        for part in dataset.blocks(path):
            table = pyarrow.table(flat(part)).replace_schema_metadata(about)
            writer = writer or pyarrow.parquet.ParquetWriter(temporary, table.schema)
            writer.write_table(table)
        if writer is None:
            raise DataFileError(f"{path}: expected hops to export, got none")
        writer.close()


def to_minari(path: Path, folder: Path) -> None:
    """One-step episodes of the env with the target set, in hindsight, to where the hop landed: reward 0, the best there is.

    Files as Minari 0.5 keeps them: data/main_data.hdf5 and data/metadata.json. Simulated hops alone, no symmetry images, and
    none whose landing lies farther than targets of the env may.
    """
    about = dataset.attributes(path)
    arguments = _env_arguments(about["configuration"])
    task = HopTask(**arguments)
    data = ensure_folder(folder / "data")
    episodes = 0
    with atomic_path(data / "main_data.hdf5") as temporary, h5py.File(temporary, "w") as file:
        for part in dataset.blocks(path):
            seen = _observations(part, task)
            for row in np.flatnonzero(part.usable & (part["image"] == 0) & np.isfinite(seen).all(axis=1)):
                _episode(file.create_group(f"episode_{episodes}"), part, int(row), episodes, seen[row])
                episodes += 1
    spec = json.loads(gymnasium.spec("TensegrityHop-v0").to_json())
    spec["kwargs"] = arguments
    metadata = {
        "dataset_id": f"tensegrity/{path.stem}-v0",
        "total_episodes": episodes,
        "total_steps": episodes,
        "data_format": "hdf5",
        "observation_space": json.dumps(_box(task.observation_space)),
        "action_space": json.dumps(_box(task.action_space)),
        "env_spec": json.dumps(spec),
        "minari_version": MINARI,
        "requirements": [f"tensegrity-gym=={__version__}"],
        "algorithm_name": f"stretches by {about['configuration']['sampler']}",
        "description": "Hops of a soft tensegrity lattice; each target is, in hindsight, the landing.",
        "dataset_size": (data / "main_data.hdf5").stat().st_size / 1e6,
        "configuration_hash": about["configuration_hash"],
        "digest": about["digest"],
    }
    with atomic_path(data / "metadata.json") as temporary:
        temporary.write_text(json.dumps(metadata, indent=1), encoding="utf-8")


def _env_arguments(configuration: dict[str, Any]) -> dict[str, Any]:
    """Arguments of the env that makes these hops; InvalidParameterError where none does."""
    ranges = configuration["scene_ranges"]
    foreign = [k for k, made in (("design", Design()), ("lattice", Lattice(2, 2))) if type(made)(**configuration[k]) != made]
    foreign += [f"ranges of {name}" for name in ranges if name not in SCENE_VALUES]
    if foreign:
        raise InvalidParameterError(
            f"--minari: expected hops that TensegrityHop-v0 can make, got other {' and '.join(foreign)}; export .csv or .parquet"
        )
    levers = {k: configuration[k] for k in ("dt", "precision")} | configuration.get("fidelity", {})
    values = {k: low if low == high else [low, high] for k, (low, high) in ranges.items()}
    return {"scene": configuration["scene"] | values, "fidelity": {k: value for k, value in levers.items() if value is not None}}


def _observations(part: HopData, task: HopTask) -> np.ndarray:
    """What each hop's episode observed, its landing being the target, shape (n, 2 + k); NaN where no target may lie."""
    names = task.scenes.observed
    seen = np.full((len(part), 2 + len(names)), np.nan, dtype=np.float32)
    for row, landing in enumerate(part["landing"]):
        scene = task.scenes.changed(task.scenes.base, {name: float(part[f"scene_{name}"][row]) for name in names})
        if np.hypot(*(landing - reachable_middle(scene))) <= TARGET_LIMIT * reach(scene):
            seen[row] = observe(landing, scene, names)
    return seen


def _episode(group: h5py.Group, part: HopData, row: int, number: int, seen: np.ndarray) -> None:
    group.attrs["id"] = number
    group.attrs["total_steps"] = 1
    group.create_dataset("observations", data=np.stack([seen, seen]))
    group.create_dataset("actions", data=part["stretches"][row : row + 1].astype(np.float32))
    group.create_dataset("rewards", data=np.zeros(1))
    group.create_dataset("terminations", data=np.ones(1, dtype=bool))
    group.create_dataset("truncations", data=np.zeros(1, dtype=bool))
    infos = group.create_group("infos")
    for name in ("index", "status", "apex"):
        infos.create_dataset(name, data=np.repeat(part[name][row : row + 1], 2))


def _box(space: gymnasium.spaces.Box) -> dict[str, Any]:
    low, high = space.low.tolist(), space.high.tolist()
    return {"type": "Box", "dtype": str(space.dtype), "shape": list(space.shape), "low": low, "high": high}


def main(config: ExportConfig) -> None:
    """Entry of ``python -m surrogate export``."""
    if config.out.exists():
        raise DataFileError(f"export: expected {config.out} not to be there yet, it is; choose another name")
    # nothing damaged is passed on, and equilibria are no episodes
    dataset.read(config.file, content="hops" if config.minari else None)
    ensure_folder(config.out.parent)
    if config.minari:
        to_minari(config.file, config.out)
    elif config.out.suffix == ".csv":
        to_csv(config.file, config.out)
    elif config.out.suffix == ".parquet":
        to_parquet(config.file, config.out)
    else:
        raise InvalidParameterError(f"export: expected OUT to end in .csv or .parquet, or --minari, got {config.out}")
    print(f"{config.out}: written")
