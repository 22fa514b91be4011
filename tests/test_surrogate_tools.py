"""What is made of hop files: descriptions, merges, exports, reports, epochs."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from surrogate import dataset, generate
from surrogate.check import check
from surrogate.dataset import Configuration, HopData
from surrogate.describe import describe
from surrogate.evaluate import EvaluateConfig
from surrogate.export import ExportConfig
from surrogate.export import main as export
from surrogate.merge import merge
from surrogate.report import ReportConfig, findings, report
from surrogate.scenes import comparable
from surrogate.storage import beside_data
from tensegrity_gym import Scene, task
from tensegrity_gym.errors import DataFileError, InvalidParameterError

CONFIGURATION = Configuration(scene=Scene(duration=1.2), precision="float32")
DOCS = Path(__file__).parents[1] / "docs" / "data.md"


@pytest.fixture(scope="module")
def hops(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tools") / "hops.h5"
    generate.fill(path, 24, CONFIGURATION, progress=False)
    return path


def test_shards_merge_into_what_one_run_gives(tmp_path: Path) -> None:
    short = Configuration(scene=Scene(duration=0.01))
    whole = generate.generate(tmp_path / "whole.h5", 11, short, progress=False)
    shards = [tmp_path / f"shard{k}.h5" for k in range(3)]
    for shard, (first, count) in zip(shards, ((8, 3), (0, 5), (5, 3)), strict=True):
        generate.fill(shard, count, short, first=first, progress=False)
    out = merge(tmp_path / "merged.h5", shards)
    assert dataset.read(out).digest == whole.digest
    assert check(out) == []
    with pytest.raises(DataFileError, match="not to be there"):
        merge(out, shards)
    with pytest.raises(DataFileError, match="hop 0 is in"):
        merge(tmp_path / "twice.h5", [*shards, shards[1]])
    generate.fill(tmp_path / "foreign.h5", 3, Configuration(scene=Scene(duration=0.01), seed=1), first=20, progress=False)
    with pytest.raises(DataFileError, match="seed: expected 0, got 1"):
        merge(tmp_path / "mixed.h5", [*shards, tmp_path / "foreign.h5"])
    assert not (tmp_path / "twice.h5").exists()


def test_description_names_everything(hops: Path) -> None:
    text = describe(hops)
    for name in (*dataset.COLUMNS, "configuration_hash", "float32", "m/s", "RESTED", "TIME_LIMIT"):
        if name not in ("RESTED", "TIME_LIMIT"):
            assert name in text
    assert re.search(r"(RESTED|TIME_LIMIT) +\d+", text)


def test_csv_gives_every_number_back(hops: Path, tmp_path: Path) -> None:
    export(ExportConfig(hops, tmp_path / "hops.csv"))
    data = dataset.read(hops)
    with open(tmp_path / "hops.csv", encoding="utf-8") as text:
        rows = list(csv.DictReader(text))
    assert len(rows) == 24
    assert [float(r["landing_1"]) for r in rows] == data["landing"][:, 1].tolist()
    assert [float(r["energies_3_6"]) for r in rows] == data["energies"][:, 3, 6].tolist()
    with pytest.raises(DataFileError, match="not to be there"):
        export(ExportConfig(hops, tmp_path / "hops.csv"))
    with pytest.raises(InvalidParameterError, match=r"\.csv or \.parquet"):
        export(ExportConfig(hops, tmp_path / "hops.xls"))


def test_parquet_gives_every_number_back(hops: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    import pyarrow.parquet

    export(ExportConfig(hops, tmp_path / "hops.parquet"))
    table = pyarrow.parquet.read_table(tmp_path / "hops.parquet")
    data = dataset.read(hops)
    assert table["stretches_2"].to_numpy().tobytes() == data["stretches"][:, 2].tobytes()
    assert json.loads(table.schema.metadata[b"configuration"]) == data.configuration


def test_minari_layout(hops: Path, tmp_path: Path) -> None:
    export(ExportConfig(hops, tmp_path / "hops-v0", minari=True))
    metadata = json.loads((tmp_path / "hops-v0" / "data" / "metadata.json").read_text())
    assert metadata["total_episodes"] == 24
    data = dataset.read(hops)
    with h5py.File(tmp_path / "hops-v0" / "data" / "main_data.hdf5") as file:
        episode = file["episode_5"]
        np.testing.assert_array_equal(episode["observations"][0], data["landing"][5].astype("f4"))
        np.testing.assert_array_equal(episode["actions"][0], data["stretches"][5].astype("f4"))
        assert episode["terminations"][()].tolist() == [True]
    with pytest.raises(DataFileError, match="not to be there"):
        export(ExportConfig(hops, tmp_path / "hops-v0", minari=True))


@pytest.mark.parametrize("ranges", [{}, {"gravity": (5.0, 9.0), "friction": (0.4, 0.4)}], ids=["one scene", "ranges"])
def test_minari_plays_the_episodes_again(tmp_path: Path, ranges: dict[str, tuple[float, float]]) -> None:
    """Minari itself reads the episodes and makes their env, in which they come out as they are written."""
    minari = pytest.importorskip("minari")
    scene = Scene(duration=1.3, landing="touchdown")
    path = tmp_path / "hops.h5"
    generate.fill(path, 3, Configuration(scene=scene, scene_ranges=ranges, hops_per_scene=2), progress=False)
    export(ExportConfig(path, tmp_path / "hops-v0", minari=True))
    back = minari.MinariDataset(str(tmp_path / "hops-v0" / "data"))
    env = back.recover_environment()
    assert (env.observation_space, env.action_space) == (back.observation_space, back.action_space)
    data = dataset.read(path)
    for k in range(len(back)):
        episode = back[k]
        np.testing.assert_array_equal(episode.actions[0], data["stretches"][k].astype("f4"))
        assert back.observation_space.contains(episode.observations[0])
        options: dict = {"target": data["landing"][k]}
        if ranges:
            options["scene"] = {"gravity": float(data["scene_gravity"][k])}
        np.testing.assert_array_equal(env.reset(options=options)[0], episode.observations[0])
        # actions and targets are float32, and a hop moves by 16 times (0.16 mm of 10 um) what its start does
        assert env.step(episode.actions[0])[1] == pytest.approx(episode.rewards[0], abs=1e-3)


def test_equilibria_are_no_minari_episodes(tmp_path: Path) -> None:
    generate.fill(tmp_path / "found.h5", 2, Configuration(content="equilibria"), progress=False)
    with pytest.raises(DataFileError, match="expected a file of hops, got one of equilibria"):
        export(ExportConfig(tmp_path / "found.h5", tmp_path / "hops-v0", minari=True))
    assert not (tmp_path / "hops-v0").exists()


@pytest.mark.parametrize("settings", [ReportConfig, lambda file, floor: EvaluateConfig(file, file, floor=floor)])
def test_a_floor_of_less_than_no_hops_is_refused(settings: Callable[..., Any], hops: Path) -> None:
    with pytest.raises(InvalidParameterError, match="floor: expected a number of hops >= 0, got -1"):
        settings(hops, floor=-1)


def test_time_of_hops_is_that_of_those_returned(hops: Path) -> None:
    """A file may hold more of them than were asked for."""
    data = dataset.read(hops)
    some = generate.generate(hops, 6, CONFIGURATION, progress=False)
    assert some.seconds == pytest.approx(data.seconds * 6 / len(data))


def test_hops_that_no_env_makes_are_no_minari_episodes(tmp_path: Path) -> None:
    configuration = Configuration(scene=Scene(duration=0.01), scene_ranges={"restitution": (0.0, 0.5)})
    generate.fill(tmp_path / "hops.h5", 2, configuration, progress=False)
    with pytest.raises(InvalidParameterError, match=r"--minari: .*other ranges of restitution; export .csv"):
        export(ExportConfig(tmp_path / "hops.h5", tmp_path / "hops-v0", minari=True))
    assert not (tmp_path / "hops-v0").exists()


def test_report_is_one_page_with_its_pictures(hops: Path, tmp_path: Path) -> None:
    page = report(hops, tmp_path / "report", floor=2)
    text = page.read_text(encoding="utf-8")
    assert text.count("data:image/png;base64,") == 5
    assert len(list((tmp_path / "report").glob("*.png"))) == 5
    assert not re.search(r'(src|href)="(?!data:)', text)
    assert "touchdown: floor" in text
    said = findings(dataset.read(hops))
    assert "0/90/180/270°" in said["rest: axes against diagonals"]


def test_report_compares_hops_of_scenes_that_vary(tmp_path: Path) -> None:
    ranges = {"gravity": (3.0, 9.8), "slope": (0.0, 0.1)}
    configuration = Configuration(scene=Scene(duration=1.3, landing="touchdown"), scene_ranges=ranges, hops_per_scene=8)
    path = tmp_path / "hops.h5"
    generate.fill(path, 24, configuration, progress=False)
    text = report(path, tmp_path / "report").read_text(encoding="utf-8")
    assert text.count("data:image/png;base64,") == 6
    assert "gravity 3 to 9.8, slope 0 to 0.1" in text
    data = dataset.read(path)
    shown = comparable(data)
    for k in (0, 10, 20):
        scene = Scene(gravity=data["scene_gravity"][k], slope=data["scene_slope"][k], landing="touchdown")
        away = data["touchdown"][k] - task.reachable_middle(scene)
        np.testing.assert_allclose(shown["touchdown"][k], away / task.reach(scene), rtol=1e-12)
        assert shown["apex"][k] == pytest.approx(data["apex"][k] * scene.gravity / 9.80665, rel=1e-12)
    with pytest.raises(InvalidParameterError, match="floor: expected a file of one scene"):
        report(path, tmp_path / "again", floor=2)


def test_reach_by_direction_finds_the_far_direction() -> None:
    from surrogate.figures import alternating, reach_by_direction

    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    landing = (1 + 0.5 * np.cos(4 * angle))[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    middle, high, top = reach_by_direction(landing)
    assert {round(float(np.degrees(a))) for a in middle[np.argsort(high)[-4:]]} == {0, 90, 180, 270}
    assert (top >= high).all()
    np.testing.assert_allclose(alternating(np.array([[0.2, 0.3, 0.4, 0.8]])), [-0.5])


def test_documented_snippets_run(hops: Path, tmp_path: Path) -> None:
    """The Python of docs/data.md, each block on its own, beside a file called hops.h5."""
    (tmp_path / "hops.h5").write_bytes(hops.read_bytes())
    blocks = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), flags=re.S)
    assert len(blocks) >= 3
    for block in blocks:
        for package in ("pandas", "xarray", "torch"):
            if f"import {package}" in block:
                pytest.importorskip(package)
        done = subprocess.run([sys.executable, "-c", block], cwd=tmp_path, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, block + done.stderr


@pytest.mark.slow
def test_an_epoch_over_a_million_rows(tmp_path: Path) -> None:
    """Printed, not asserted: how long reading and an epoch of shuffled batches take, and how much CPU."""
    n, rng = 1_000_000, np.random.default_rng(0)
    configuration = CONFIGURATION.as_dict()
    schema = dataset.columns_of(configuration)
    rows = 50_000

    def part(k: int) -> HopData:
        columns = {}
        for name, column in schema.items():
            shape = dataset.expected_shape(column, rows, configuration)
            columns[name] = rng.normal(size=shape) if column.dtype == "f8" else np.full(shape, k)
        return HopData(columns, configuration)

    path = tmp_path / "large.h5"
    dataset.write_blocks(path, configuration, (part(k) for k in range(n // rows)))
    started, work = time.perf_counter(), time.process_time()
    data = dataset.read(path, columns=["stretches", "landing", "touchdown", "apex", "takeoff_velocity", "flight_time"])
    read, reading = time.perf_counter() - started, time.process_time() - work
    inputs = data["stretches"].astype("f4")
    wanted = ("landing", "touchdown", "apex", "takeoff_velocity", "flight_time")
    targets = np.column_stack([data[k] for k in wanted]).astype("f4")
    started, work, total = time.perf_counter(), time.process_time(), 0.0
    order = rng.permutation(n)
    for first in range(0, n, 4096):
        batch = order[first : first + 4096]
        total += float(inputs[batch].sum() + targets[batch].sum())
    epoch, batching = time.perf_counter() - started, time.process_time() - work
    print(f"\n1e6 rows, {path.stat().st_size / 1e6:.0f} MB: read and checked in {read:.2f} s ({reading:.2f} s of CPU)")
    print(f"an epoch of shuffled batches: {epoch:.2f} s ({batching:.2f} s of CPU)")
    assert np.isfinite(total)


@pytest.mark.parametrize(
    ("file", "beside"),
    [
        ("hops.h5", "hops.report"),
        ("hops.hdf5", "hops.report"),
        ("hops_0.5", "hops_0.5.report"),
        ("hops_0.5.h5", "hops_0.5.report"),
    ],
)
def test_files_whose_names_hold_a_dot_share_nothing(file: str, beside: str) -> None:
    assert beside_data(Path("runs") / file, ".report") == Path("runs") / beside
