"""The demo from end to end with few hops, its resume, and the errors that its user may meet."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate import dataset, model
from surrogate.model import NetConfig
from surrogate.train import TrainConfig
from tensegrity_gym import Scene
from tensegrity_gym.errors import DataFileError, InvalidParameterError, OutputFolderError
from tensegrity_gym.task import reach
from training import algorithms, demo, report
from training.demo import DemoConfig
from training.hops import Hops
from training.inverse import InverseConfig
from training.planner import with_images
from training.score import Score, distances

SMALL = DemoConfig(
    hops=16,
    targets=4,
    surrogate=TrainConfig(net=NetConfig(hidden=(16,), members=2), epochs=20, test=0.0),
    planner=InverseConfig(pool=64, starts=2, steps=5),
    gradient_steps=1,
    progress=False,
)
PICTURES = ("hop.png", "energies.png", "landing_map.png", "scatter.png", "plans.png", "error_calls.png")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished small demo."""
    folder = tmp_path_factory.mktemp("demo")
    demo.run(replace(SMALL, out=folder))
    return folder


def test_whole_chain_leaves_data_models_pictures_and_a_closed_report(folder: Path) -> None:
    for name in (*PICTURES, "data.h5", "targets.h5", "surrogate_16.safetensors", "policy.safetensors", "report.html"):
        assert (folder / name).stat().st_size > 1000, name
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == len(PICTURES)
    assert not re.search(r"(src|href)=\"(?!data:)", page)  # nothing is fetched from elsewhere
    for text in (*demo.METHODS.values(), "of reach", "of the stored energy", "from 8 starts", "Floor: "):
        assert text in page
    assert not list(folder.glob("**/*.partial"))


def test_rerun_keeps_all_and_goes_on_where_something_is_missing(folder: Path) -> None:
    before = (folder / "report.html").read_bytes()
    again = demo.run(replace(SMALL, out=folder))
    assert set(again.skipped) == set(again.results)
    assert (folder / "report.html").read_bytes() == before
    (folder / "surrogate_16.safetensors").unlink()
    (folder / "stages" / "plans.json").write_text("{ damaged")
    (folder / "plans.png").unlink()
    third = demo.run(replace(SMALL, out=folder))
    assert set(third.results) - set(third.skipped) == {"surrogate_16", "plans", "report"}
    rows = [{k: v for k, v in row.items() if "seconds" not in k} for row in again.results["report"]["rows"]]
    assert rows == [{k: v for k, v in row.items() if "seconds" not in k} for row in third.results["report"]["rows"]]


def test_errors_of_every_method_are_counted_in_metres_and_reaches(folder: Path) -> None:
    rows = demo.run(replace(SMALL, out=folder)).results["report"]["rows"]
    assert [row["simulator_calls"] for row in rows] == [16, 16, 16 + 8 * 4, 16]
    for row in rows:
        assert row["median_percent"] / row["median_error"] == pytest.approx(row["mean_percent"] / row["mean_error"])


def test_no_answer_is_scored_on_the_hop_that_chose_it(folder: Path) -> None:
    """Each is scored from eight moved starts, of which none repeats the unmoved hop: neither the stored nor the tried one."""
    found = demo.run(replace(SMALL, out=folder)).results["evaluation"]
    data, targets = dataset.read(folder / "data.h5"), dataset.read(folder / "targets.h5")
    unmoved = Hops(Scene.preset("earth", landing="touchdown"), {"fidelity": "flown"})
    for method in demo.METHODS:
        score = Score.from_dict(found[method]["16"])
        assert score.landings.shape == (4, 8, 2)
        assert len(np.unique(score.landings.reshape(-1, 2), axis=0)) == len(np.unique(score.stretches, axis=0)) * 8
        alike = np.linalg.norm(score.landings - unmoved.land(score.stretches)[:, None], axis=2)
        assert (alike > 0).all()
        assert np.median(alike) < 2e-3  # moved by little all the same
        wanted = np.linalg.norm(score.landings - targets["landing"][:, None], axis=2).mean(axis=1)
        np.testing.assert_allclose(score.errors, wanted)
    nearest = Score.from_dict(found["nearest"]["16"])
    images = model.load(folder / "surrogate_16.safetensors")[0].landing_images
    stretches, landings = with_images(data["stretches"], data["landing"], images)
    rows = [int(np.flatnonzero((stretches == asked).all(axis=1))[0]) for asked in nearest.stretches]
    assert (np.linalg.norm(nearest.landings - landings[rows][:, None], axis=2) > 1e-6).all()
    assert len(found["floor"]) == 4
    assert 0 < min(found["floor"]) <= max(found["floor"]) < 2e-3


def test_a_failed_hop_counts_as_two_reaches() -> None:
    landings = np.array([[(0.0, 3.0), (np.nan, np.nan)], [(4.0, 0.0), (0.0, 0.0)]])
    np.testing.assert_allclose(distances(landings, np.zeros((2, 2)), 5.0), [[3, 10], [4, 0]])
    score = Score(np.zeros((2, 4)), landings, np.array([6.5, 2.0]))
    assert score.summary(5.0)["failed_percent"] == 25
    assert Score.from_dict(score.as_dict()).summary(5.0) == score.summary(5.0)


def test_floor_is_told_below_the_table(folder: Path) -> None:
    run = demo.run(replace(SMALL, out=folder))
    told = run.results["report"]
    floor = np.median(run.results["evaluation"]["floor"])
    assert f"by {1e3 * floor:.2g} mm" in told["caption"]
    assert report.text_table(told["rows"], told["caption"]).splitlines()[-1] == told["caption"]
    assert told["caption"].replace("'", "&#x27;") in (folder / "report.html").read_text(encoding="utf-8")
    assert reach(Scene.preset("earth", landing="touchdown")) > 10 * floor


def test_another_scoring_scores_anew_and_keeps_the_rest(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(folder, tmp_path / "demo")
    monkeypatch.setattr(demo, "STARTS", 2)
    again = demo.run(replace(SMALL, out=tmp_path / "demo"))
    assert set(again.results) - set(again.skipped) == {"evaluation", "report"}
    assert np.shape(again.results["evaluation"]["policy"]["16"]["landings"]) == (4, 2, 2)


def test_other_hyperparameters_train_another_policy(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(folder, tmp_path / "demo")
    values = algorithms.hyperparameters("sac") | {"warmup": 0.5}
    monkeypatch.setattr("training.train_policy.hyperparameters", lambda *_: values)
    again = demo.run(replace(SMALL, out=tmp_path / "demo"))
    assert set(again.results) - set(again.skipped) == {"policy", "evaluation", "report"}


def test_another_seed_in_the_same_folder_is_refused(folder: Path) -> None:
    before = (folder / "data.h5").read_bytes()
    with pytest.raises(DataFileError, match="seed: expected 7, got 0"):
        demo.run(replace(SMALL, out=folder, seed=7))
    assert (folder / "data.h5").read_bytes() == before


def test_bad_sizes_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="hops >= 4"):
        demo.run(replace(SMALL, out=tmp_path, hops=1))
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OutputFolderError, match="--out"):
        demo.run(replace(SMALL, out=tmp_path / "file" / "demo"))


def test_command_line_says_the_error_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    command = [sys.executable, "-m", "training", "demo", "--out", str(tmp_path / "file" / "demo")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ, cwd=Path(__file__).parents[1])
    assert done.returncode == 1
    assert done.stderr.strip().startswith("OutputFolderError: expected a folder")
    assert "Traceback" not in done.stderr
