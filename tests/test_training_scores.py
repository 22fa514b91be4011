"""Scores that are kept beside the tables made of them: whole, gone on from, and saying what the documents say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from tensegrity_gym import MODEL_VERSION
from tensegrity_gym.errors import DataFileError
from training.compare import report, run
from training.compare.config import CompareConfig
from training.compare.results import Outcome
from training.compare.scores import Latency, Line, Scores, rounded

ROOT = Path(__file__).parent.parent
TASK = {"fidelity": "flown", "scene": {"gravity": 9.8, "friction": 0.5}, "places": {"inside": 1, "beyond": 1}}
KEPT = sorted((ROOT / "docs" / "scores").glob("*.jsonl"))


def line(method: str = "sac", budget: int = 100, seed: int = 0, settings: str = "a") -> Line:
    return Line(method, budget, seed, (0.1, 0.02), 1e-4, 1.5, settings, "2026-11-26", "torch 2.13.0")


def filled() -> Scores:
    scores = Scores(TASK)
    scores.floor = 3e-4
    scores.latencies["sac"] = Latency("b", 100, 20, 1e-4, 2e-4, "2026-11-26")
    for seed in (2, 0, 10):
        scores.add(line(seed=seed))
    scores.add(replace(line("oracle", 1000), calls_per_answer=160.0, scatter=None))
    return scores


def test_what_is_written_is_read_again_and_the_same_scores_give_the_same_text(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "scores.jsonl"
    scores = filled()
    scores.write(path)
    again = Scores.read(path, TASK)
    assert vars(again) == vars(scores)
    assert [row.seed for row in again.of("sac", 100)] == [0, 2, 10]
    assert path.read_text() == again.text() == scores.text()
    assert again.digest == scores.digest
    again.add(line(seed=3))
    assert again.digest != scores.digest
    assert Scores.read(tmp_path / "none.jsonl", TASK).lines == {}


def test_scores_of_other_settings_are_of_another_method() -> None:
    """At whichever budget: one curve must not be drawn through two methods."""
    scores = filled()
    scores.add(line(budget=1000))
    assert scores.methods == ["sac", "oracle"]
    scores.add(line(budget=1000, settings="b"))
    assert list(scores.lines) == [("oracle", 1000, 0), ("sac", 1000, 0)]
    assert scores.settings("sac") == "b"
    assert scores.settings("td3") is None
    assert scores.drop("sac") == 1
    assert scores.methods == ["oracle"]


def test_what_others_have_added_meanwhile_stays_and_what_is_stale_does_not_come_back(tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"
    filled().write(path)
    mine, other = Scores.read(path, TASK), Scores.read(path, TASK)
    other.add(line("td3"))
    other.add(line(seed=1))
    other.write(path)
    mine.add(line(seed=4))
    mine.write(path)
    assert [row.seed for row in Scores.read(path, TASK).of("sac", 100)] == [0, 1, 2, 4, 10]
    assert Scores.read(path, TASK).of("td3", 100)
    stale = Scores.read(path, TASK)
    stale.drop("sac")
    stale.write(path)
    assert Scores.read(path, TASK).methods == ["oracle", "td3"]
    assert set(Scores.read(path, TASK).latencies) == {"sac"}  # has settings of its own
    stale.drop_latency("sac")
    stale.write(path)
    assert Scores.read(path, TASK).latencies == {}
    filled().write(path, anew=True)
    assert Scores.read(path, TASK).lines == filled().lines


def test_damaged_scores_and_those_of_another_task_are_named(tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"
    filled().write(path)
    whole = path.read_text()
    with pytest.raises(DataFileError, match=r"expected scores with fidelity 'paper', got 'flown'"):
        Scores.read(path, TASK | {"fidelity": "paper"})
    with pytest.raises(DataFileError, match=r"expected scores with scene: friction 0.3, got 0.5; choose options that fit"):
        Scores.read(path, TASK | {"scene": {"gravity": 9.8, "friction": 0.3}})
    lines = whole.splitlines()
    head, first = json.loads(lines[0]), json.loads(lines[1])
    damaged = {
        "cut": whole[:-30],
        "empty": "",
        "list": "[]\n",
        "format": json.dumps(head | {"format": 0}) + "\n",
        "head": lines[1],
        "row": lines[0] + '\n{"method": "sac"}\n',
        "latencies": json.dumps(head | {"latencies": {"sac": 3}}) + "\n",
        "twice": whole + lines[-1] + "\n",
        "mixed": whole + json.dumps(first | {"seed": 77, "settings": "b"}) + "\n",
        "length": whole + json.dumps(first | {"seed": 77, "errors": [0.1]}) + "\n",
        "words": whole + json.dumps(first | {"seed": 77, "scatter": "x"}) + "\n",
    }
    for text in damaged.values():
        path.write_text(text)
        with pytest.raises(DataFileError, match=r"scores\.jsonl: expected .* take --anew"):
            Scores.read(path, TASK)


def test_digits_that_are_kept() -> None:
    assert rounded(0.00031415926) == 0.0003142
    assert rounded(2.0) == 2.0


def small(out: str, **changes: object) -> CompareConfig:
    """A quick comparison that writes: planners of one seed and one budget, and one policy."""
    quick = CompareConfig(out=Path(out), quick=True, progress=False).shortened()
    fewer = {"budgets": (16,), "seeds": (1,), "refine": (), "quick": False, "write": True} | changes
    return replace(quick, **fewer)  # type: ignore[arg-type]


def done(config: CompareConfig) -> set[str]:
    """Run a comparison; stages that were not found done."""
    comparison = run.comparison_of(config)
    comparison.run()
    comparison.scores.write(config.kept_path, anew=config.anew)
    return set(comparison.stages.results) - set(comparison.stages.skipped)


def test_kept_scores_are_gone_on_from_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run.main(small("first"))
    kept, page = Path("docs/scores/earth_touchdown.jsonl"), Path("docs/results.md")
    assert kept.read_bytes() == Path("first/quick/scores.jsonl").read_bytes()
    told, text = kept.read_bytes(), page.read_bytes()
    assert len(list(Path("docs/images").glob("*.png"))) == 3
    # all is there: nothing is run, and the page is the same to the byte
    run.main(small("second"))
    assert not list(Path("second/quick/stages").glob("*.json"))
    assert (kept.read_bytes(), page.read_bytes()) == (told, text)
    # one more seed of the policies alone, then one of the planners, with what they need
    assert done(small("third", policy_seeds=(2,))) == {"policy_sac_1_16", "score_sac_1_16"}
    planners = done(small("fourth", seeds=(2,), policy_seeds=(1,)))
    assert {"floor", "net_1_16", "score_ensemble_1_16", "score_best2_1_16"} <= planners
    # seed 1's hops begin with number 0
    assert {name for name in planners if "_0_16" in name or "sac" in name} == {"hops_1_0_16"}
    both = Scores.read(kept, run.comparison_of(small("fifth")).task)
    assert [row.seed for row in both.of("sac", 16)] == [row.seed for row in both.of("ensemble", 16)] == [0, 1]
    # a method more is run and timed with what it takes, and the others are not
    more = done(small("sixth", refine=(2,), policy_budgets=()))
    assert {"net_0_16", "plan_ensemble_0_16", "score_refine2_0_16", "score_repeat2_0_16", "latency_refine2_16"} <= more
    assert not {"score_ensemble_0_16", "latency_ensemble_16", "oracle"} & more
    # one that needs no net trains none
    hops = {"hops_0_0_16", "hops_0_16", "floor"}
    needed = {"plan_nearest_0_16", "repeat3_0_16", "score_repeat3_0_16"}
    with monkeypatch.context() as patched:
        patched.setattr(run.Comparison, "starts", ("nearest",))
        assert done(small("unlearnt", refine=(3,), policy_budgets=(), latencies=0)) == hops | needed
    # times of fewer hops do not replace those of more
    timed = set(Scores.read(kept, both.task).latencies)
    assert {"nearest", "ensemble", "best2", "refine2", "cma", "sac"} <= timed
    assert not [name for name in done(small("seventh", budgets=(8,))) if name.startswith("latency")]
    assert set(Scores.read(kept, both.task).latencies) == timed
    # another task is refused, unless all is to be anew
    with pytest.raises(DataFileError, match=r"expected scores with perturbations 3, got 2.*--anew"):
        run.comparison_of(small("eighth", perturbations=3))
    assert not run.comparison_of(small("eighth", perturbations=3, anew=True)).scores.lines
    # in --out as well, and before any work
    with pytest.raises(DataFileError, match=r"first/quick/scores\.jsonl: expected scores with perturbations 3, got 2.*--anew"):
        run.main(small("first", perturbations=3, write=False))


def test_other_settings_replace_what_they_make_stale_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    few = {"policy_seeds": (2,), "latencies": 0, "tries": ()}
    done(small("first", **few))
    assert done(small("second", **few)) == set()
    committed = small("third", **few | {"policy_seeds": (1,)})
    folder = tmp_path / "hyperparameters"
    folder.mkdir()
    text = (ROOT / "training" / "hyperparameters" / "sac.toml").read_text()
    (folder / "sac.toml").write_text(text.replace("updates = 4 ", "updates = 3 "))
    with monkeypatch.context() as patched:
        patched.setattr("training.algorithms.FOLDER", folder)
        assert done(committed) == {"policy_sac_0_16", "score_sac_0_16"}
        scores = run.comparison_of(committed).scores
    assert [row.seed for row in scores.of("sac", 16)] == [0]
    assert len(scores.of("ensemble", 16)) == 1
    # and by what is no setting of a planner but changes its answers
    for changes, stale in (
        ({"search": 32}, {"score_cma_0_16"}),
        ({"data": Path("hops.h5"), "algorithms": ()}, {"score_nearest_0_16", "score_oracle_0_16", "score_ensemble_0_16"}),
    ):
        comparison = run.comparison_of(replace(committed, out=Path("first/quick"), **changes))  # type: ignore[arg-type]
        gone = {f"score_{method}_0_16" for method in scores.methods} - {
            f"score_{method}_0_16" for method in comparison.scores.methods
        }
        assert stale <= gone
    assert "oracle" in run.comparison_of(replace(committed, oracle=0)).scores.methods  # not asked for, and no worse for that
    monkeypatch.setattr(run, "PLANNERS_VERSION", 999)
    assert run.comparison_of(committed).scores.methods == []  # SAC's were of other hyper-parameters


def test_there_are_scores_of_the_table_that_readme_shows() -> None:
    assert ROOT / "docs" / "scores" / "earth_touchdown.jsonl" in KEPT
    assert "<!-- begin earth_touchdown -->" in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.stem)
def test_documents_show_what_the_kept_scores_say(path: Path, tmp_path: Path) -> None:
    """README's and docs' tables and figures are those that the command would make, of today's physics and targets."""
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
    for name, text in (("docs/results.md", report.section(outcome, "images")), ("README.md", report.short(outcome))):
        if name == "README.md" and path.stem != "earth_touchdown":
            continue  # the only table that README has
        copy = tmp_path / Path(name).name
        copy.write_bytes((ROOT / name).read_bytes())
        assert report.replace_between(copy, path.stem, text)
        assert copy.read_bytes() == (ROOT / name).read_bytes()
    for kind in ("calls", "profile", "pareto"):
        with Image.open(ROOT / "docs" / "images" / f"results_{path.stem}_{kind}.png") as picture:
            assert picture.info["Source"] == comparison.scores.digest
