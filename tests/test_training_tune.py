"""The search for hyper-parameters: what it draws, that luck does not win its final, and what it writes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tensegrity_gym import Scene
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from training import tune
from training.algorithms import FOLDER, hyperparameters
from training.compare import run
from training.compare.config import CompareConfig
from training.compare.targets import read
from training.train_policy import PolicyConfig, train_policy
from training.tune import Search, TuneConfig, choices, draw, write_toml


class Steered:
    """A policy that lands off its targets by as much as its settings, and luck, say."""

    def __init__(self, off: float) -> None:
        self.off = off

    def predict(self, targets: np.ndarray) -> tuple[np.ndarray, None]:
        return np.pad(targets + [self.off, 0.0], ((0, 0), (0, 2))), None


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[PolicyConfig]:
    """What was trained. Small steps err less, but those with 128 hops in a batch are lucky with the first two seeds."""
    asked: list[PolicyConfig] = []

    def train(scenes: Any, config: PolicyConfig, **_: Any) -> tuple[dict[int, Steered], dict[str, float]]:
        asked.append(config)
        values = hyperparameters(config.algorithm, config.hyperparameters)["model"]
        lucky = values["batch_size"] == 128 and config.seed < 2
        return {config.calls: Steered(0.001 if lucky else values["learning_rate"] * 10)}, {"seconds": 1.0}

    monkeypatch.setattr(tune, "train_policy", train)
    monkeypatch.setattr(tune.Hops, "land", lambda self, stretches: stretches[:, :2])
    return asked


def test_calls_that_some_settings_cannot_take_are_refused_before_the_first_training(
    trained: list[PolicyConfig], tmp_path: Path
) -> None:
    """1030 hops go into rollouts of 10, enough for the committed 80 and too few for the 160 that a setting may ask for."""
    config = TuneConfig(out=tmp_path, algorithm="ppo", calls=1030, settings=12, targets=8, progress=False)
    assert {80, 160} <= {values["rollout"] for values in Search(config).values}
    with pytest.raises(InvalidParameterError, match=r"rollouts of about 160 hops.*got 1030"):
        Search(config).run()
    assert trained == []


def test_the_best_settings_win_the_final_and_lucky_ones_do_not(
    trained: list[PolicyConfig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = TuneConfig(out=tmp_path, settings=12, targets=8, progress=False)
    tried, final = Search(config).run()
    assert len(tried) == 12
    assert tried[0].values["model"]["batch_size"] == 128
    assert tried[0].mean == pytest.approx(0.001)
    assert final[0].values["model"]["learning_rate"] == min(t.values["model"]["learning_rate"] for t in final)
    assert final[0].mean == pytest.approx(0.003 if final[0].values["model"]["learning_rate"] == 3e-4 else 0.01)
    assert final[0].number != tried[0].number in {trial.number for trial in final}
    assert 0 in {trial.number for trial in final}
    assert 3 <= len(final) <= 4
    assert {c.seed for c in trained} == set(range(6))
    assert {(c.calls, c.fidelity) for c in trained} == {(1000, "flown")}
    # a rerun trains nothing, and keeps the best as a file that policies are trained with
    before = len(trained)
    assert before == 2 * 12 + 4 * len(final)
    tune.main(config)
    assert len(trained) == before
    said = capsys.readouterr().out
    assert "as committed" in said
    assert "learning_rate 0.0003" in said
    assert hyperparameters("sac", tmp_path / "sac.toml") == final[0].values
    assert f"{before * (1000 + 8)} hops" in (tmp_path / "sac.toml").read_text()


@pytest.mark.parametrize("algorithm", ["sac", "td3", "ppo"])
def test_settings_are_drawn_from_the_choices_and_written_whole(algorithm: str, tmp_path: Path) -> None:
    committed, among = hyperparameters(algorithm), choices(algorithm)
    drawn = draw(committed, among, 60, seed=0)
    assert drawn == draw(committed, among, 60, seed=0) != draw(committed, among, 60, seed=1)
    for name, options in among.items():
        for key, listed in options.items() if name == "model" else [(None, options)]:
            found = [values[name] if key is None else values[name][key] for values in drawn]
            assert {str(f) for f in found} == {str(o) for o in listed}
            assert (committed[name] if key is None else committed[name][key]) in listed  # the committed are among them
    for values in drawn:
        path = write_toml(tmp_path / "x.toml", values, "two\nlines")
        assert hyperparameters(algorithm, path) == values
        kept = {k for k in values if k not in among}
        assert {k: values[k] for k in kept} == {k: committed[k] for k in kept}


@pytest.mark.parametrize(
    "path", sorted(p for p in FOLDER.glob("*/*.toml") if p.parent.name != "choices"), ids=lambda p: p.parent.name
)
def test_committed_folders_of_hyperparameters_train_a_policy(path: Path) -> None:
    values = hyperparameters(path.stem, path)
    assert values != hyperparameters(path.stem)
    config = PolicyConfig(path.stem, calls=16, hyperparameters=path)
    actors, card = train_policy(Scene(duration=0.05), config, progress=False)
    assert card["train"]["hyperparameters"] == values
    assert [layer.out_features for layer in list(actors[16].layers)[::2]] == [*values["hidden"], 4]


def test_settings_are_judged_on_targets_that_are_not_registered(tmp_path: Path) -> None:
    targets = Search(TuneConfig(out=tmp_path, progress=False)).targets
    assert targets.shape == (32, 2)
    assert np.linalg.norm(targets[:, None] - read("earth", "touchdown")["inside"][None], axis=2).min() > 1e-5


def test_impossible_searches_are_named(tmp_path: Path) -> None:
    for name in ("settings", "seeds", "finalists", "final_seeds", "targets"):
        with pytest.raises(InvalidParameterError, match=name):
            TuneConfig(**{name: 0})
    with pytest.raises(InvalidParameterError, match="scenes vary"):
        TuneConfig(scene="varied")
    with pytest.raises(InvalidParameterError, match="algorithm"):
        _ = Search(TuneConfig(out=tmp_path, algorithm="dqn")).values


def test_a_comparison_takes_hyperparameters_from_a_folder(tmp_path: Path) -> None:
    values = hyperparameters("sac") | {"hidden": [16], "updates": 1}
    (tmp_path / "mine").mkdir()
    write_toml(tmp_path / "mine" / "sac.toml", values, "mine")
    small = replace(
        CompareConfig(out=tmp_path / "compare", quick=True, progress=False, hyperparameters=tmp_path / "mine").shortened(),
        seeds=(1,),
        policy_seeds=(1,),
        latencies=0,
    )

    def policy(config: CompareConfig) -> run.Comparison:
        comparison = run.Comparison(config)
        comparison.policy("sac", 0, 16)
        return comparison

    first = policy(small)
    assert first.stages.results["policy_sac_0_16"]["values"] == values
    shutil.copytree(tmp_path / "mine", tmp_path / "moved")
    assert policy(replace(small, hyperparameters=tmp_path / "moved")).stages.skipped == ["policy_sac_0_16", "score_sac_0_16"]
    # the committed ones are others
    assert policy(replace(small, hyperparameters=FOLDER)).stages.skipped == []
    assert policy(replace(small, hyperparameters=None)).stages.skipped == ["policy_sac_0_16", "score_sac_0_16"]
    # what no policy could be trained with is refused at once
    with pytest.raises(DataFileError, match="TOML file"):
        run.Comparison(replace(small, hyperparameters=tmp_path))
    with pytest.raises(InvalidParameterError, match="the nearest that is fine"):
        run.Comparison(replace(small, hyperparameters=None, algorithms=("sac", "ppo"), policy_budgets=(254,)))
    with pytest.raises(InvalidParameterError, match="committed ones"):
        CompareConfig(hyperparameters=FOLDER, write=True)
