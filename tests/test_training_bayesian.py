"""Bayesian optimisation of answers by BoTorch: known inverses, calls, repeatability, failed hops, its part in the comparison.

What needs BoTorch is skipped where it is not installed: `pip install 'tensegrity-gym[learn,botorch]'`.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from maps import throw

from surrogate.generate import sample_stretches
from tensegrity_gym.errors import InvalidParameterError, MissingExtraError
from training.bayesian import BayesianConfig, BayesianPlanner
from training.compare import run
from training.compare.config import CompareConfig
from training.compare.methods import label
from training.compare.results import Outcome
from training.inverse import InversePlanner
from training.planner import Land


def real(stretches: np.ndarray) -> np.ndarray:
    """The throw with waves of 10 mm about it, of which the surrogate, ``throw``, knows nothing."""
    wave = np.column_stack([np.sin(30 * stretches[:, 0] + 10 * stretches[:, 2]), np.cos(25 * stretches[:, 1])])
    return throw(torch.from_numpy(stretches))[0].numpy() + 0.01 * wave


def failing(stretches: np.ndarray) -> np.ndarray:
    """As ``real``; hops whose first stretch is over 0.6 fail."""
    landings = real(stretches)
    landings[stretches[:, 0] > 0.6] = np.nan
    return landings


def planner_of(land: Land, tries: int, hops: int = 300, config: BayesianConfig | None = None) -> BayesianPlanner:
    """The planner that knows ``throw`` and those of ``hops`` stored hops of ``land`` that did not fail."""
    pytest.importorskip("botorch")
    stretches = sample_stretches(hops, 2)
    landings = land(stretches)
    flew = np.isfinite(landings).all(axis=1)
    return BayesianPlanner(InversePlanner(throw), land, stretches[flew], landings[flew], tries, config)


@pytest.fixture(scope="module")
def targets() -> np.ndarray:
    """Where eight hidden throws land."""
    return real(np.random.default_rng(5).uniform(0.25, 0.55, (8, 4)))


def errors_of(answers: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Distances of what the answers' hops do to the targets, shape (n,) [m]."""
    return np.linalg.norm(real(answers) - targets, axis=1)


def test_six_hops_recover_the_inverse_of_a_map_that_the_surrogate_misses_by_a_centimetre(targets: np.ndarray) -> None:
    planner = planner_of(real, 6)
    answers, state = planner.predict(targets)
    assert state is None
    assert planner.simulator_calls == 8 * 6
    assert ((answers >= 0.2) & (answers <= 0.8)).all()
    assert np.median(errors_of(planner.inverse.predict(targets)[0], targets)) > 5e-3
    assert np.median(errors_of(answers, targets)) < 2e-4
    assert errors_of(answers, targets).max() < 1e-3


def test_one_try_is_the_plan_and_each_try_is_one_call_a_target(targets: np.ndarray) -> None:
    asked: list[np.ndarray] = []

    def land(stretches: np.ndarray) -> np.ndarray:
        asked.append(stretches)
        return real(stretches)

    planner = planner_of(real, 1)
    np.testing.assert_array_equal(planner.predict(targets)[0], planner.inverse.plan(targets).stretches)
    planner.land, planner.tries, planner.simulator_calls = land, 3, 0
    answers, _ = planner.predict(targets[:2])
    assert [a.shape for a in asked] == [(2, 4)] * 3
    assert planner.simulator_calls == 6
    simulated = np.stack(asked, axis=1)  # (2, 3, 4)
    nearest = [errors_of(simulated[k], targets[k]).argmin() for k in range(2)]
    np.testing.assert_array_equal(answers, simulated[np.arange(2), nearest])
    assert (np.abs(simulated[:, 1] - simulated[:, 0]) <= BayesianConfig().radius + 1e-12).all()


def test_same_question_same_answer_alone_or_among_others_and_no_trace_in_torch(targets: np.ndarray) -> None:
    planner = planner_of(real, 4)
    torch.manual_seed(1)
    before, threads = torch.get_rng_state(), torch.get_num_threads()
    first, _ = planner.predict(targets[:3])
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.get_num_threads() == threads
    assert torch.get_default_dtype() == torch.float32
    torch.manual_seed(2)
    np.testing.assert_array_equal(planner.predict(targets[:3])[0], first)
    alone, _ = planner.predict(targets[1])
    assert alone.shape == (4,)
    np.testing.assert_allclose(alone, first[1], atol=1e-3)  # plans themselves differ by rounding
    other = planner_of(real, 4, config=BayesianConfig(seed=1)).predict(targets[:3])[0]
    assert not np.array_equal(other, first)
    assert np.median(errors_of(other, targets[:3])) < 1e-3


def test_failed_hops_are_gone_round() -> None:
    """Some plans fail, one of them far from all that flies."""
    reached = failing(np.random.default_rng(8).uniform(0.25, 0.55, (6, 4)))
    planner = planner_of(failing, 8)
    plans = planner.inverse.plan(reached).stretches
    assert np.isnan(failing(plans)).any()
    answers, _ = planner.predict(reached)
    errors = np.linalg.norm(failing(answers) - reached, axis=1)
    assert np.isfinite(errors).all()
    assert np.median(errors) < 1e-3
    # nothing ever flies: the plan is the answer
    lost = planner_of(real, 3)
    lost.land = lambda s: np.full((len(s), 2), np.nan)
    np.testing.assert_array_equal(lost.predict(reached)[0], plans)


def test_few_stored_hops_and_a_perfect_surrogate_are_no_trouble(targets: np.ndarray) -> None:
    planner = planner_of(real, 3, hops=1)
    assert errors_of(planner.predict(targets[0])[0][None], targets[:1]).max() < 5e-3
    planner = planner_of(lambda s: throw(torch.from_numpy(s))[0].numpy(), 3)
    reached = planner.land(np.full((1, 4), 0.4))
    answer, _ = planner.predict(reached)
    assert np.linalg.norm(planner.land(answer) - reached) < 1e-4


def test_without_botorch_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "botorch", None)
    stretches = sample_stretches(8, 2)
    with pytest.raises(MissingExtraError, match=r"expected botorch .*pip install 'tensegrity-gym\[botorch\]'"):
        BayesianPlanner(InversePlanner(throw), real, stretches, real(stretches))
    with pytest.raises(MissingExtraError, match="botorch"):
        run.comparison_of(CompareConfig(out=tmp_path, bayes=2))
    run.comparison_of(CompareConfig(out=tmp_path, progress=False))  # not asked for: not missed


def test_impossible_settings_are_named() -> None:
    for changes in ({"neighbours": 0}, {"candidates": 0}, {"samples": 0}, {"length": 0.0}, {"noise": -1.0}, {"radius": 0.0}):
        with pytest.raises(InvalidParameterError, match=next(iter(changes))):
            BayesianConfig(**changes)  # type: ignore[arg-type]
    with pytest.raises(InvalidParameterError, match="bayes: expected 0 where scenes vary, got 8"):
        CompareConfig(scene="varied", bayes=8)
    with pytest.raises(InvalidParameterError, match="bayes: expected an integer >= 0"):
        CompareConfig(bayes=-1)
    pytest.importorskip("botorch")
    stretches = sample_stretches(8, 2)
    inverse = InversePlanner(throw)
    with pytest.raises(InvalidParameterError, match="tries"):
        BayesianPlanner(inverse, real, stretches, real(stretches), tries=0)
    with pytest.raises(InvalidParameterError, match="as many stretches as landings"):
        BayesianPlanner(inverse, real, stretches, real(stretches)[:7])


def test_a_comparison_that_asks_for_it_adds_it_and_keeps_all_else(tmp_path: Path) -> None:
    pytest.importorskip("botorch")
    small = {"algorithms": (), "oracle": 0, "tries": (), "budgets": (16,)}
    quick = replace(CompareConfig(out=tmp_path, progress=False).shortened(), **small)  # type: ignore[arg-type]
    assert quick.bayes == 0
    before = run.Comparison(quick)
    before.run()
    asked = run.Comparison(replace(quick, bayes=2, bayes_seeds=1))
    asked.run()
    added = {"bayes_0_16", "score_bayes2_0_16", "latency_bayes2_16"}
    assert set(asked.stages.results) - set(asked.stages.skipped) == added
    assert set(asked.stages.skipped) == set(before.stages.results)
    outcome = Outcome(asked)
    assert outcome.methods == ["nearest", "repeat2", "single", "ensemble", "refine2", "bayes2", "tandem", "cma"]
    assert label("bayes2") == "the same, 2 simulated in turn by BoTorch"
    assert [score.seed for score in outcome.scores["bayes2", 16]] == [0]
    assert outcome.latency("bayes2") is not None
    assert outcome.learning_seconds("bayes2", 16) > 0
    answers = json.loads((tmp_path / "quick" / "stages" / "bayes_0_16.json").read_text())["results"]["stretches"]
    plans = json.loads((tmp_path / "quick" / "stages" / "plan_ensemble_0_16.json").read_text())["results"]["stretches"]
    assert np.abs(np.array(answers) - np.array(plans)).max() <= BayesianConfig().radius + 1e-12
