"""Stages: what is kept, what is run again, and what is said of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tensegrity_gym.errors import FileInUseError
from training.stages import Results, Stages


class Runs:
    """One stage in a folder, which counts how often it worked."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.worked = folder, 0
        self.said: list[str] = []

    def __call__(self) -> Results:
        return Stages(self.folder, say=self.said.append).run("stage", {"a": 1}, self._work)

    def _work(self) -> Results:
        self.worked += 1
        return {"errors": [0.125, float("nan"), 1e-300], "by_tries": {8: (1, 2), 32: (3, 4)}, "seconds": 2.0}

    @property
    def record(self) -> Path:
        return self.folder / "stages" / "stage.json"


@pytest.fixture
def run(tmp_path: Path) -> Runs:
    run = Runs(tmp_path)
    run()
    return run


def test_whole_records_are_kept(run: Runs) -> None:
    run()
    assert run.worked == 1
    assert run.said[-1] == "stage: done before, kept"


@pytest.mark.parametrize(("old", "new"), [("0.125", "0.124"), ('"seconds": 2.0', '"seconds": 1.0')])
def test_results_that_were_changed_are_run_again_and_told(run: Runs, old: str, new: str) -> None:
    whole = run.record.read_text()
    assert old in whole
    run.record.write_text(whole.replace(old, new))
    results = run()
    assert run.worked == 2
    assert "its record holds others: run again" in run.said[1]
    assert results["errors"][0] == 0.125
    run()
    assert run.worked == 2  # and it is whole again


@pytest.mark.parametrize("part", ["results", "seconds", "date"])
def test_records_without_a_hash_of_their_results_count_as_whole_but_not_without_a_part(run: Runs, part: str) -> None:
    record = json.loads(run.record.read_text())
    del record["results_hash"]
    run.record.write_text(json.dumps(record))
    run()
    assert run.worked == 1
    del record[part]
    run.record.write_text(json.dumps(record))
    run()
    assert run.worked == 2


def test_a_stage_that_another_process_works_on_is_left_to_it(tmp_path: Path) -> None:
    stages, others = Stages(tmp_path, say=lambda _: None), Stages(tmp_path, say=lambda _: None)

    def work() -> Results:
        with pytest.raises(FileInUseError, match=r"stage\.json, but process \d+ is at it"):
            others.run("stage", {}, lambda: {"by": "other"})
        assert others.run("another", {}, lambda: {"by": "other"}) == {"by": "other"}
        return {"by": "first"}

    assert stages.run("stage", {}, work) == {"by": "first"}
    assert others.run("stage", {}, lambda: {"by": "other"}) == {"by": "first"}
    with pytest.raises(ZeroDivisionError):
        stages.run("broken", {}, lambda: {"value": 1 / 0})
    assert others.run("broken", {}, lambda: {"by": "other"}) == {"by": "other"}  # who fails lets go
    assert sorted(p.name for p in (tmp_path / "stages").iterdir()) == ["another.json", "broken.json", "stage.json"]
