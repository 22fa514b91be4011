"""The hop file: round trip, resume, growth, refusal of what is foreign or damaged, splits that do not leak."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surrogate import chunks, dataset, generate
from surrogate.dataset import COLUMNS, Configuration, HopData
from tensegrity_gym import Lattice, Scene, simulate
from tensegrity_gym.errors import DataFileError, InvalidParameterError, OutputFolderError

SHORT = Scene(duration=0.05)  # the schema does not care how long a hop is
CONFIGURATION = Configuration(scene=SHORT, seed=3)


def random_data(hops: int, seed: int = 0) -> HopData:
    """Columns of the right shapes and types, filled with noise: what a file must give back bit by bit."""
    rng = np.random.default_rng(seed)
    columns = {}
    for name, column in COLUMNS.items():
        shape = (hops, *(4 if k < 0 else k for k in column.shape))
        columns[name] = rng.normal(size=shape) if column.dtype == "f8" else rng.integers(0, 3, size=shape)
    columns["stretches"] = rng.uniform(0.2, 0.8, size=(hops, 4))
    columns["split_share"] = dataset.split_share(columns["stretches"], Lattice())
    columns["index"], columns["image"] = np.arange(hops), np.zeros(hops, dtype=int)
    return HopData(columns, CONFIGURATION.as_dict())


def same(first: HopData, second: HopData) -> bool:
    return all(first[name].tobytes() == second[name].tobytes() for name, c in COLUMNS.items() if not c.measured)


@given(hops=st.integers(0, 40), seed=st.integers(0, 2**31))
@settings(max_examples=15, deadline=None)
def test_round_trip_keeps_every_bit(tmp_path_factory: pytest.TempPathFactory, hops: int, seed: int) -> None:
    data = random_data(hops, seed)
    path = dataset.write(tmp_path_factory.mktemp("data") / "hops.h5", data)
    back = dataset.read(path, expect=CONFIGURATION)
    assert same(data, back)
    assert back.configuration == data.configuration


def test_file_says_what_it_holds(tmp_path: Path) -> None:
    path = dataset.write(tmp_path / "hops.h5", random_data(5))
    with h5py.File(path) as file:
        assert {name: (file[name].attrs["unit"], file[name].attrs["description"]) for name in file if name != "checksums"} == {
            name: (c.unit, c.description) for name, c in COLUMNS.items()
        }
        assert file.attrs["hops"] == 5
        for name in ("configuration", "configuration_hash", "model_version", "packages", "command", "date", "digest"):
            assert file.attrs[name]


def test_interrupted_run_goes_on_and_gives_the_same_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = generate.generate(tmp_path / "whole.h5", 20, CONFIGURATION, chunk=8, progress=False)
    calls: list[int] = []

    def dies_at_second(stretches, **options):
        calls.append(len(stretches))
        if len(calls) == 2:
            raise KeyboardInterrupt
        return simulate(stretches, **options)

    path = tmp_path / "resumed.h5"
    monkeypatch.setattr(chunks, "simulate", dies_at_second)
    with pytest.raises(KeyboardInterrupt):
        generate.generate(path, 20, CONFIGURATION, chunk=8, progress=False)
    assert not path.exists()
    resumed = generate.generate(path, 20, CONFIGURATION, chunk=8, progress=False)
    assert calls == [8, 8, 8, 4]  # the first chunk was kept
    assert same(whole, resumed)
    assert same(whole, dataset.read(path))
    assert [p.name for p in tmp_path.iterdir() if p.suffix != ".h5"] == []
    generate.generate(path, 20, CONFIGURATION, progress=False)
    assert len(calls) == 4  # whole: nothing to do


def test_a_file_grows_into_what_one_run_gives(tmp_path: Path) -> None:
    whole = generate.generate(tmp_path / "whole.h5", 18, CONFIGURATION, chunk=8, progress=False)
    generate.generate(tmp_path / "grown.h5", 6, CONFIGURATION, chunk=8, progress=False)
    grown = generate.generate(tmp_path / "grown.h5", 18, CONFIGURATION, chunk=8, progress=False)
    assert same(whole, grown)
    assert same(generate.generate(tmp_path / "grown.h5", 6, CONFIGURATION, progress=False), whole.rows(slice(0, 6)))


@pytest.mark.parametrize(
    ("change", "named"),
    [({"seed": 4}, "seed: expected 4, got 3"), ({"scene": Scene.preset("moon")}, "'gravity': 1.625"), ({"dt": 1e-6}, "dt")],
)
def test_file_of_another_configuration_is_refused_and_kept(tmp_path: Path, change: dict, named: str) -> None:
    path = dataset.write(tmp_path / "hops.h5", random_data(4))
    before = path.read_bytes()
    with pytest.raises(DataFileError, match=r"was made from configuration \w+, this run is configuration \w+") as caught:
        generate.generate(path, 4, replace(CONFIGURATION, **change), progress=False)
    assert named in str(caught.value)
    assert path.read_bytes() == before


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    path = dataset.write(tmp_path / "hops.h5", random_data(30))
    whole = path.read_bytes()
    with pytest.raises(DataFileError, match="found none"):
        dataset.read(tmp_path / "absent.h5")
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataFileError, match="cannot be read"):
        dataset.read(path)
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        file["landing"][7, 1] = np.nextafter(file["landing"][7, 1], np.inf)  # the least change there is
    with pytest.raises(DataFileError, match=r"checksum.*move it out of the way"):
        dataset.read(path)
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        del file["apex"]
    with pytest.raises(DataFileError, match=r"missing.*apex"):
        dataset.read(path)
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = 99
    with pytest.raises(DataFileError, match=r"schema 2, got 99.*upgrade"):
        dataset.read(path)


def test_unwritable_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OutputFolderError, match="choose another"):
        generate.generate(tmp_path / "file" / "hops.h5", 4, CONFIGURATION, progress=False)


def test_samples_are_prefixes_of_longer_ones_and_in_range() -> None:
    assert np.array_equal(generate.sample_stretches(37, 5), generate.sample_stretches(300, 5)[:37])
    sample = generate.sample_stretches(512, 0)
    assert sample.min() >= 0.2
    assert sample.max() <= 0.8
    with pytest.raises(InvalidParameterError, match="hops"):
        generate.sample_stretches(0, 0)


def test_splits_cover_all_and_keep_symmetric_images_together() -> None:
    data = random_data(400)
    split = data.split(0.2, 0.2)
    assert np.array_equal(np.sort(np.concatenate(list(split.values()))), np.arange(400))
    assert 40 < len(split["test"]) < 120
    for perm in Lattice().symmetries:
        share = dataset.split_share(data["stretches"][:, perm], Lattice())
        image = HopData(data.columns | {"split_share": share}, data.configuration)
        assert all(np.array_equal(split[name], rows) for name, rows in image.split(0.2, 0.2).items())


def test_failed_hops_are_kept_in_the_file_and_out_of_the_splits() -> None:
    data = random_data(50)
    data.columns["status"][:] = 0
    data.columns["status"][[3, 9]] = (3, 4)
    used = np.concatenate(list(data.split().values()))
    assert not {3, 9} & set(used.tolist())
    assert len(used) == 48
