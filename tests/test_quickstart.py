"""The quickstart of docs/env.md, README's section on planning and docs/planning.md run as they stand."""

from __future__ import annotations

import importlib
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro

ROOT = Path(__file__).parent.parent
PAGE, PLANNING, README = ROOT / "docs" / "env.md", ROOT / "docs" / "planning.md", ROOT / "README.md"


def test_the_quickstart_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(blocks) == 5
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in blocks:
        if "stable_baselines3" in block:
            pytest.importorskip("stable_baselines3")
        exec(compile(block, str(PAGE), "exec"), names)
    assert (tmp_path / "hop.gif").stat().st_size > 10_000
    assert len(names["frames"]) > 60  # type: ignore[arg-type]


def section(page: Path, heading: str) -> str:
    """What stands under a heading of README."""
    return page.read_text(encoding="utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]


def run_lines(text: str, folder: Path, smaller: dict[str, str]) -> str:
    """Run the shell block of ``text`` in ``folder``, each line with some of its words replaced; what the last one printed."""
    (block,) = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    said = ""
    for line in block.splitlines():
        for word, other in smaller.items():
            line = line.replace(word, other)
        program, *words = shlex.split(line)
        assert program == "python"
        done = subprocess.run(
            [sys.executable, *words], cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
        )
        assert done.returncode == 0, line + done.stderr
        said = done.stdout
    return said


def shape(text: str) -> list[str]:
    """Lines without their numbers and without what only some targets have."""
    return [re.sub(r"-?\d+(\.\d+)?", "#", line.split("; out of")[0]) for line in text.strip().splitlines()]


def printed(text: str) -> str:
    (block,) = re.findall(r"```text\n(.*?)```", text, re.DOTALL)
    return block


@pytest.fixture(scope="module", params=["small", pytest.param("as it stands", marks=pytest.mark.slow)])
def asked(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder in which README's section on planning was run, with fewer hops and epochs, and what it printed."""
    pytest.importorskip("torch")
    folder = tmp_path_factory.mktemp("asked")
    smaller = {"--hops 1000": "--hops 48", "--out runs/net": "--epochs 20 --out runs/net", "--tries 8": "--tries 2"}
    return folder, run_lines(section(README, "Ask it where to land"), folder, smaller if request.param == "small" else {})


@pytest.mark.timeout(1200)
def test_readme_asks_where_to_land(asked: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    folder, said = asked
    text = section(README, "Ask it where to land")
    assert shape(said) == shape(printed(text))
    monkeypatch.chdir(folder)
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(block, str(README), "exec"), names)
    assert names["best"].stretches.shape == (2, 4)
    assert "simulated" in said


@pytest.mark.timeout(1200)
def test_the_page_on_planning_runs(asked: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stable_baselines3")
    folder, _ = asked
    text = PLANNING.read_text(encoding="utf-8")
    said = run_lines(text, folder, {"--calls 512": "--calls 32", "--evaluate-every 128": "--evaluate-every 8 --envs 8"})
    assert shape(said) == shape(printed(text))
    monkeypatch.chdir(folder)
    _write_varied(folder / "runs")
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(block, str(PLANNING), "exec"), names)
    assert np.shape(names["stretches"]) == (4,)
    from training.plan import PlanCommand
    from training.train_policy import PolicyCommand

    # every class and setting that the page names is there
    for module, name in re.findall(r"`(training\.[a-z_]+)\.(\w+)[`(]", text):
        assert hasattr(importlib.import_module(module), name), name
    for flag in set(re.findall(r"`(--[a-z.-]+)", text)) - {"--planner.miss"}:
        fields = {*PlanCommand.__dataclass_fields__, *PolicyCommand.__dataclass_fields__}
        assert flag[2:].replace("-", "_") in fields, flag


def _write_varied(folder: Path) -> None:
    """A net and hops of a closed form whose scenes vary."""
    from dataclasses import replace

    from surrogate import dataset, model
    from surrogate.train import train
    from tests.test_surrogate_model import QUICK
    from tests.test_training_plan import varied_data

    path = dataset.write(folder / "varied.h5", varied_data(200))
    net, card = train(dataset.read(path), replace(QUICK, epochs=2), progress=False)
    model.save(net, folder / "varied_net.safetensors", card)


def commands_of(text: str) -> list[list[str]]:
    """Commands of training and surrogate in a page, in its shell blocks or in a sentence, without those that only name one."""
    joined = text.replace("\\\n", " ")
    lines = [line.strip() for line in joined.splitlines() if re.match(r" *python -m", line)]
    lines += re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", joined, flags=re.DOTALL))
    found = [shlex.split(line.replace("$scene", "moon"), comments=True) for line in lines if "python -m" in line]
    return [words[2:] for words in found if words[:2] == ["python", "-m"] and words[2] in ("training", "surrogate") and words[4:]]


PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_commands_of_a_page_are_understood(page: Path) -> None:
    pytest.importorskip("stable_baselines3")
    for program, name, *words in commands_of(page.read_text(encoding="utf-8")):
        module, settings = importlib.import_module(f"{program}.__main__").COMMANDS[name]
        tyro.cli(getattr(importlib.import_module(module), settings), args=words)  # SystemExit for a flag that is not there


def test_commands_are_found_in_pages() -> None:
    assert len(commands_of(README.read_text(encoding="utf-8"))) >= 3
    assert len(commands_of((ROOT / "docs" / "results.md").read_text(encoding="utf-8"))) >= 8
