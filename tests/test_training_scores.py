"""Scores that are kept beside the tables made of them: whole, gone on from, and saying what the documents say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tensegrity_gym import MODEL_VERSION
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from training.compare import report, run
from training.compare.config import CompareConfig
from training.compare.results import Outcome
from training.compare.scores import Latencies, Score, Scores, rounded

ROOT = Path(__file__).parent.parent
TASK = {"fidelity": "flown", "ranges": {"gravity": (1.6, 9.81)}}


def score(method: str = "sac", budget: int = 100, seed: int = 0, settings: str = "a") -> Score:
    return Score(method, budget, seed, (0.1, 0.02), 1e-4, 1.5, settings, "2026-11-26", "torch 2.13.0")


def filled() -> Scores:
    scores = Scores(TASK)
    scores.floor = 3e-4
    scores.latencies["latency"] = Latencies("b", {"sac": (1e-4, 2e-4)})
    for seed in (2, 0, 10):
        scores.add(score(seed=seed))
    scores.add(replace(score("oracle", 1000), calls_per_answer=160.0))
    return scores


def test_what_is_written_is_read_again_and_the_same_scores_give_the_same_text(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "scores.jsonl"
    scores = filled()
    scores.write(path)
    again = Scores.read(path, TASK)
    assert vars(again) == vars(scores)
    assert [row.seed for row in again.of("sac", 100)] == [0, 2, 10]
    again.write(tmp_path / "again.jsonl")
    assert (tmp_path / "again.jsonl").read_bytes() == path.read_bytes()
    assert Scores.read(tmp_path / "none.jsonl", TASK).rows == {}


def test_scores_of_other_settings_are_of_another_method() -> None:
    scores = filled()
    assert scores.holds("sac", 100, 2, "a")
    assert not scores.holds("sac", 100, 2, "b")
    assert not scores.holds("sac", 100, 3, "a")
    scores.add(score(budget=1000, settings="b"))
    assert len(scores.of("sac", 100)) == 3
    scores.add(score(seed=0, settings="b"))
    assert [row.settings for row in scores.of("sac", 100)] == ["b"]
    assert len(scores.of("oracle", 1000)) == 1


def test_damaged_scores_and_those_of_another_task_are_named(tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"
    filled().write(path)
    whole = path.read_text()
    with pytest.raises(DataFileError, match=r"expected scores with fidelity 'paper', got 'flown'"):
        Scores.read(path, TASK | {"fidelity": "paper"})
    lines = whole.splitlines()
    head = json.loads(lines[0])
    damaged = {
        "cut": whole[:-30],
        "empty": "",
        "list": "[]\n",
        "format": json.dumps(head | {"format": 0}) + "\n",
        "head": lines[1],
        "row": lines[0] + '\n{"method": "sac"}\n',
        "latencies": json.dumps(head | {"latencies": {"latency": 3}}) + "\n",
    }
    for text in damaged.values():
        path.write_text(text)
        with pytest.raises(DataFileError, match=r"scores\.jsonl: expected .* take --anew"):
            Scores.read(path, TASK)


def test_digits_that_are_kept() -> None:
    assert rounded(0.00031415926) == 0.0003142
    assert rounded(2.0) == 2.0


def small(out: Path, **changes: object) -> CompareConfig:
    """A quick comparison that writes, of two planners' budgets and one policy's."""
    quick = CompareConfig(out=out, quick=True, progress=False).shortened()
    fewer = {"budgets": (16,), "seeds": (1,), "refine": (), "quick": False, "write": True} | changes
    return replace(quick, **fewer)  # type: ignore[arg-type]


def done(config: CompareConfig) -> set[str]:
    """Run a comparison; stages that were not found done."""
    comparison = run.comparison_of(config)
    comparison.run()
    comparison.scores.write(config.kept_path)
    return set(comparison.stages.results) - set(comparison.stages.skipped)


def test_kept_scores_are_gone_on_from_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run.main(small(Path("first")))
    kept, page = Path("docs/scores/earth_touchdown.jsonl"), Path("docs/results.md")
    assert kept.read_bytes() == Path("first/quick/scores.jsonl").read_bytes()
    told, text = kept.read_bytes(), page.read_bytes()
    assert len(list(Path("docs/images").glob("*.png"))) == 3
    # all is there: nothing is run, and the page is the same to the byte
    run.main(small(Path("second")))
    assert not list(Path("second/quick/stages").glob("*.json"))
    assert (kept.read_bytes(), page.read_bytes()) == (told, text)
    # one more seed of the policies alone, then one of the planners, with what they need
    assert done(small(Path("third"), policy_seeds=(2,))) == {"policy_sac_1_16", "score_sac_1_16"}
    planners = done(small(Path("fourth"), seeds=(2,), policy_seeds=(1,)))
    assert {"floor", "net_1_16", "score_ensemble_1_16", "score_best2_1_16"} <= planners
    assert {name for name in planners if "_0_16" in name or "sac" in name} == {"hops_1_0_16"}  # seed 1's hops from number 0 on
    both = Scores.read(kept, run.comparison_of(small(Path("fifth"))).task)
    assert [row.seed for row in both.of("sac", 16)] == [row.seed for row in both.of("ensemble", 16)] == [0, 1]
    # times are measured again where there are others to measure, on the files that this takes
    timed = done(small(Path("sixth"), refine=(2,), policy_budgets=()))
    assert {"latency", "net_0_16", "score_refine2_0_16"} <= timed
    # another task is refused, unless all is to be anew
    with pytest.raises(DataFileError, match=r"expected scores with perturbations 3, got 2.*--anew"):
        run.comparison_of(small(Path("seventh"), perturbations=3))
    assert not run.comparison_of(small(Path("eighth"), perturbations=3, anew=True)).scores.rows
    with pytest.raises(InvalidParameterError, match="anew: expected it with --write"):
        CompareConfig(anew=True)


def test_other_hyperparameters_replace_the_scores_of_all_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    few = {"seeds": (1,), "policy_seeds": (2,), "latencies": 0, "oracle": 0, "tries": ()}
    done(small(Path("first"), **few))
    assert done(small(Path("second"), **few)) == set()
    folder = tmp_path / "hyperparameters"
    folder.mkdir()
    committed = (ROOT / "training" / "hyperparameters" / "sac.toml").read_text()
    (folder / "sac.toml").write_text(committed.replace("updates = 4 ", "updates = 3 "))
    monkeypatch.setattr("training.algorithms.FOLDER", folder)
    assert "policy_sac_0_16" in done(small(Path("third"), **few | {"policy_seeds": (1,)}))
    scores = Scores.read(Path("docs/scores/earth_touchdown.jsonl"), run.comparison_of(small(Path("fourth"))).task)
    assert [row.seed for row in scores.of("sac", 16)] == [0]


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "scores").glob("*.jsonl")), ids=lambda path: path.stem)
def test_documents_show_what_the_kept_scores_say(path: Path, tmp_path: Path) -> None:
    """README's and docs' tables are those that the command would write, of today's physics and targets."""
    scene, landing = path.stem.rsplit("_", 1)
    task = json.loads(path.read_text(encoding="utf-8").splitlines()[0])["task"]
    assert task["model_version"] == MODEL_VERSION
    config = CompareConfig(
        out=tmp_path,
        scene=scene,
        landing=landing,
        fidelity=task["fidelity"],
        targets=max(task["places"].values()),
        perturbations=task["perturbations"],
        policy_budgets=(),
        progress=False,
    )
    comparison = run.comparison_of(config)
    comparison.scores = Scores.read(path, comparison.task)
    outcome = Outcome(comparison)
    page = tmp_path / "page.md"
    page.write_text((ROOT / "docs" / "results.md").read_text(encoding="utf-8"), encoding="utf-8")
    readme = tmp_path / "README.md"
    readme.write_text((ROOT / "README.md").read_text(encoding="utf-8"), encoding="utf-8")
    before = page.read_bytes(), readme.read_bytes()
    report.replace_between(page, path.stem, report.section(outcome, "images"), append=True)
    report.replace_between(readme, path.stem, report.short(outcome))
    assert (page.read_bytes(), readme.read_bytes()) == before
    for kind in ("calls", "profile", "pareto"):
        assert (ROOT / "docs" / "images" / f"results_{path.stem}_{kind}.png").is_file()
