"""The set-up: what is public, what an import costs, what the command line says of mistakes."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import pytest

import tensegrity_gym
from tensegrity_gym.cli import main
from tensegrity_gym.core import jit
from tensegrity_gym.errors import MissingExtraError
from tensegrity_gym.render import record_hop

ROOT = Path(__file__).parent.parent
HEAVY = ("torch", "matplotlib", "stable_baselines3", "tensorboard", "PIL.Image")
PUBLIC = ("MODEL_VERSION", "Lattice", "Design", "Scene", "HopStatus", "ENERGY_NAMES", "STRETCH_RANGE", "form_find", "simulate")


def test_import_is_light() -> None:
    code = f"import sys, tensegrity_gym; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_have_one_import_path(name: str) -> None:
    assert hasattr(tensegrity_gym, name)


def test_every_direct_dependency_is_pinned() -> None:
    """An unpinned torch would be fetched with gigabytes of CUDA."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = list(project["dependencies"])
    for extra in project["optional-dependencies"].values():
        wanted += extra
    names = {re.split(r"[<>=!~ \[]", requirement)[0].lower() for requirement in wanted}
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {line.split("==")[0].lower() for line in lines if "==" in line}
    assert names <= pinned


def test_info_prints_the_lattice_and_the_design(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"point masses\s+184\n", printed)
    assert re.search(r"Euler load\s+4[78]\.\d+ N", printed)


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["hop", "--scene", "pluto"], "UnknownPresetError: .*expected one of .*got 'pluto'"),
        (["hop", "--stretches", "0.1", "0.3", "0.3", "0.3"], "InvalidStretchesError: .*expected.*got"),
        (["hop", "--stretches", "nan", "0.3", "0.3", "0.3"], "InvalidStretchesError: .*expected.*got"),
        (["hop", "--picture", "no/such/folder/hop.png"], "OutputFolderError: expected an existing folder"),
        (["hop", "--picture", "hop.pdf"], "InvalidParameterError: --picture: expected a path that ends in"),
        (["hop", "--video", "hop.avi"], "InvalidParameterError: --video: expected a path that ends in .gif or .mp4"),
        (["reach", "--scene", "nowhere"], "UnknownPresetError: .*got 'nowhere'"),
        (["calibrate", "--scene", "nowhere"], "UnknownPresetError: .*got 'nowhere'"),
        (["reach", "--seed", "-1"], "InvalidParameterError: .*expected an integer seed >= 0, got -1"),
        (["calibrate", "--seed", "-1"], "InvalidParameterError: .*expected an integer seed >= 0, got -1"),
        (["reach", "--hops", "0"], "InvalidParameterError: .*expected an integer >= 1 of hops .*got 0"),
    ],
)
def test_mistakes_are_told_in_one_line(
    args: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if "--video" in args:  # known without a simulation
        monkeypatch.delattr("tensegrity_gym.cli.simulate")
    assert main(args) == 2
    error = capsys.readouterr().err
    assert re.match(said, error)
    assert error.count("\n") == 1


def test_a_film_that_cannot_be_written_is_known_before_the_hop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    for module in ("cli", "render"):
        monkeypatch.delattr(f"tensegrity_gym.{module}.simulate")
    assert main(["hop", "--video", str(tmp_path / "hop.mp4")]) == 2
    assert re.match(
        r"MissingExtraError: --video: \.mp4 needs imageio-ffmpeg: pip install .* or write a \.gif", capsys.readouterr().err
    )
    with pytest.raises(MissingExtraError, match=r"record_hop: \.mp4 needs imageio-ffmpeg"):
        record_hop([0.3] * 4, tmp_path / "hop.mp4")


def test_kernels_are_cached_among_temporary_files_where_there_is_no_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As for a user that is not in the list of users, in a container."""

    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("TENSEGRITY_GYM_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", home)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = Path(jit._cache_folder())
    assert folder.is_dir()
    assert tmp_path in folder.parents


def test_pictures_are_not_written_over_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delattr("tensegrity_gym.cli.simulate")  # known without a simulation
    (tmp_path / "hop.png").mkdir()
    assert main(["hop", "--picture", str(tmp_path / "hop.png")]) == 2
    assert re.match("OutputFolderError: expected a file's name to write to, got the folder", capsys.readouterr().err)
