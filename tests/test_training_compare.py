"""The comparison: its statistics, its targets, and the whole of it from end to end, killed and resumed."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from surrogate import dataset
from surrogate.dataset import HopData
from surrogate.frozen import FrozenLanding
from surrogate.generate import GenerateConfig, configuration_of
from tensegrity_gym import Scene, form_find, simulate
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tensegrity_gym.fidelity import FIDELITIES
from tensegrity_gym.scene_ranges import scene_ranges
from tensegrity_gym.specimen import POSITION, moved_start
from tensegrity_gym.task import TARGET_LIMIT, reach, reachable
from training.compare import policies, report, run
from training.compare import targets as registered
from training.compare.config import CompareConfig
from training.compare.figures import looks
from training.compare.latency import question_times
from training.compare.methods import LABELS, PLANNERS
from training.compare.results import Outcome
from training.compare.scores import errors_and_scatter
from training.compare.statistics import interquartile_mean, interval, performance_profile, probability_of_improvement
from training.hops import Hops, VariedHops, repeated
from training.inverse import InversePlanner
from training.policies import ActorPolicy
from training.symmetry import Symmetry

QUICK = Scene(duration=0.05)


def test_no_two_methods_of_a_figure_look_alike() -> None:
    """With all that may be in one: some have the same colour, and tell themselves apart by line and mark."""
    methods = [*LABELS, "best8", "best32", "repeat4", "repeat8", "refine4", "refine8", "bayes8"]
    drawn = looks(methods)
    assert len({(look["color"], look["ls"]) for look in drawn.values()}) == len(methods)
    assert len({(look["color"], look["marker"]) for look in drawn.values()}) == len(methods)


def test_interquartile_mean_leaves_out_a_quarter_at_each_end() -> None:
    assert interquartile_mean(np.array([-1e6, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1e9])) == pytest.approx(3.5)


def test_interval_covers_the_truth_as_often_as_it_says() -> None:
    """Errors of 10 seeds on 8 targets of different difficulty: the interval must hold the mean of many seeds.

    Also where half of a seed's deviation is common to all its targets, as when a training went badly.
    """
    rng = np.random.default_rng(0)
    difficulty = np.linspace(1, 2, 8)

    def run_seeds(seeds: int, common: float) -> np.ndarray:
        return difficulty + rng.normal(0, common, (seeds, 1)) + rng.normal(0, 0.3, (seeds, 8))

    for common in (0.0, 0.3):
        truth = interquartile_mean(run_seeds(200_000, common))
        held = [low <= truth <= high for low, high in (interval(run_seeds(10, common), draws=400) for _ in range(200))]
        # 95 % asked for; the bootstrap of 10 seeds is known to be a little narrow
        assert 0.85 <= np.mean(held) <= 1.0, common
    with pytest.raises(InvalidParameterError, match="seeds, targets"):
        interval(np.zeros(3))


def test_few_seeds_have_a_range_and_one_has_none() -> None:
    errors = np.array([[1.0, 1.0, 1.0, 1.0], [3.0, 3.0, 3.0, 3.0], [2.0, 2.0, 2.0, 2.0]])
    assert interval(errors) == (1.0, 3.0)
    assert interval(errors[:1]) == (1.0, 1.0)
    same = interval(np.ones((10, 4)))
    assert same == (1.0, 1.0)


def test_probability_of_improvement_and_profile() -> None:
    ours, theirs = np.array([[1.0, 5.0], [1.0, 5.0]]), np.array([[2.0, 5.0]])
    assert probability_of_improvement(ours, theirs) == pytest.approx(0.75)  # always better on one, always equal on the other
    assert probability_of_improvement(theirs, ours) == pytest.approx(0.25)
    with pytest.raises(InvalidParameterError, match="same targets"):
        probability_of_improvement(ours, theirs[:, :1])
    np.testing.assert_allclose(performance_profile(ours, np.array([0.5, 1.0, 9.0])), [0.0, 0.5, 1.0])


def test_registered_targets_are_what_their_seed_draws() -> None:
    for path, seed in registered.FILES.items():
        assert json.loads(path.read_text(encoding="utf-8")) == registered.draw(seed)
    assert not np.isin(
        registered.read("earth", "rest", path=registered.SECOND)["inside"], registered.read("earth", "rest")["inside"]
    ).any()
    places = registered.read("earth", "touchdown")
    assert {p: len(t) for p, t in places.items()} == registered.COUNTS
    with pytest.raises(InvalidParameterError, match="registered"):
        registered.read("mars", "rest")


def test_a_moved_start_moves_what_stands_by_ten_micrometres_each_way_and_nothing_that_lies() -> None:
    found = form_find(np.array([(0.3, 0.4, 0.5, 0.6), (0.5, 0.5, 0.4, 0.3)]), scene=QUICK)
    moved = moved_start(found).positions - found.positions
    lying = found.positions[:, :, 2] < 1e-3
    assert 4 <= lying.sum() < 0.2 * lying.size
    assert (moved[lying] == 0).all()
    assert moved[~lying].std(axis=0) == pytest.approx([1e-5] * 3, rel=0.12)  # of some 350 masses: 4 % standard deviation
    assert np.array_equal(moved_start(found).positions, moved_start(found, 0).positions)
    assert not np.array_equal(moved_start(found).positions, moved_start(found, 1).positions)


def test_moved_starts_are_moved_by_what_is_said_and_the_first_not_at_all() -> None:
    stretches = np.array([(0.3, 0.4, 0.5, 0.6), (0.5, 0.5, 0.4, 0.3)])
    hops = Hops(QUICK, {})
    landings = hops.perturbed(stretches, 3)
    assert landings.shape == (2, 4, 2)
    assert hops.calls == 8
    np.testing.assert_array_equal(landings[:, 0], simulate(stretches, scene=QUICK).landing)
    np.testing.assert_array_equal(landings[:, 1:], hops.moved(stretches, 3))
    moved = np.linalg.norm(landings[:, 1:] - landings[:, :1], axis=2)
    assert (moved > 0).all()
    assert (moved < 100 * POSITION).all()
    twice = repeated(form_find(stretches, scene=QUICK), 2)
    np.testing.assert_array_equal(twice.stretches, stretches[[0, 0, 1, 1]])
    np.testing.assert_array_equal(twice.energies["bars"][::2], twice.energies["bars"][1::2])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished quick comparison."""
    folder = tmp_path_factory.mktemp("compare")
    run.main(CompareConfig(out=folder, quick=True, symmetric=("sac",), progress=False))
    return folder / "quick"


def test_quick_comparison_tells_all_and_repeats_its_bits_after_a_loss(folder: Path) -> None:
    text = (folder / "results.md").read_text(encoding="utf-8")
    said = (
        "nearest stored hop, 2 simulated in turn",
        "best of 2 simulated",
        "SAC | 0 | 2, 2 |",
        "SAC, knowing the symmetry | 0 | 2, 2 |",
        "p95",
        "boundary",
        "fidelity flown",
    )
    assert all(words in text for words in (*said, "floor", "hops per answer"))
    pictures = sorted(p.name for p in folder.glob("*.png"))
    assert pictures == [f"results_earth_touchdown_{kind}.png" for kind in ("calls", "pareto", "profile")]
    kept = json.loads((folder / "stages" / "score_ensemble_1_32.json").read_text())
    for lost in ("score_ensemble_1_32", "plan_ensemble_1_32", "net_1_32"):
        (folder / "stages" / f"{lost}.json").unlink()
    config = replace(CompareConfig(out=folder.parent, symmetric=("sac",), progress=False), quick=True).shortened()
    again = run.Comparison(config)
    again.run()
    assert set(again.stages.results) - set(again.stages.skipped) == {"score_ensemble_1_32", "plan_ensemble_1_32", "net_1_32"}
    assert json.loads((folder / "stages" / "score_ensemble_1_32.json").read_text())["results"] == kept["results"]
    outcome = Outcome(again)
    assert outcome.methods[:6] == ["nearest", "repeat2", "single", "ensemble", "best2", "refine2"]
    assert 0 < outcome.scatter < 1.0
    # errors are distances of the stored landings, those from the unmoved start left out
    landings = np.array(kept["results"]["landings"])[:2, 1:]
    wanted = np.linalg.norm(landings - again.places["inside"][:, None], axis=2).mean(axis=1)
    np.testing.assert_allclose(outcome.errors("ensemble", 32)[1], wanted, rtol=5e-4)  # four digits are kept


def test_records_of_policies_name_the_least_gradient_steps_only_where_these_bind(tmp_path: Path) -> None:
    comparison = run.Comparison(CompareConfig(out=tmp_path, progress=False))
    asked = [(algorithm, budget) for algorithm in ("sac", "td3", "ppo") for budget in (10_000, 40_000, 100_000)]
    bound = {a for a in asked if "least_updates" in policies.content_of(comparison, a[0], 0, a[1])}
    assert bound == {("sac", 100_000), ("td3", 100_000)}  # else all of fewer hops would be trained again


def test_policies_that_know_the_symmetries_say_so(folder: Path) -> None:
    told = {
        name: json.loads((folder / "stages" / f"policy_{name}_0_16.json").read_text())["config"]["config"]
        for name in ("sac", "sac_symmetric")
    }
    assert not told["sac"]["symmetric"]
    assert told["sac_symmetric"] == told["sac"] | {"symmetric": True}
    signs = {name: ActorPolicy.load(folder / f"policy_{name}_0_16.safetensors").symmetry for name in told}
    assert signs["sac"] is None
    assert signs["sac_symmetric"] == Symmetry.of(scene_ranges("earth"))
    with pytest.raises(InvalidParameterError, match=r"symmetric: expected some of"):
        CompareConfig(symmetric=("a2c",))


def test_scores_keep_errors_to_targets_and_scatter_about_the_answers_own_mean() -> None:
    """Landings with a known deviation, far off their targets: two starts tell as much of it as many."""
    rng = np.random.default_rng(0)
    for starts in (2, 64):
        targets, units = np.zeros((5000, 2)), np.full(5000, 0.5)
        landings = np.array([3.0, 4.0]) + rng.normal(0, 1e-3, (5000, starts, 2))
        landings[1::2] += rng.normal(0, 1.0, (2500, starts, 2))  # of targets that are not inside
        inside = np.arange(5000) % 2 == 0
        errors, scatter = errors_and_scatter(landings, targets, np.ones(5000), units, inside)
        assert errors[0] == pytest.approx(10.0, rel=1e-3)  # 5 m, in units of half a metre
        # mean length of a plane normal vector: sqrt(pi / 2) deviations; trimming skews the mean of two by some per cent
        assert scatter == pytest.approx(2e-3 * np.sqrt(np.pi / 2), rel=0.08 if starts == 2 else 0.02)
    landings[0, 3] = np.nan  # a failed hop counts as one that landed two reaches away, and tells nothing of scatter
    with_failed, again = errors_and_scatter(landings, targets, np.ones(5000), units, inside)
    assert with_failed[0] == pytest.approx((63 * 10.0 + TARGET_LIMIT / 0.5) / 64, rel=1e-3)
    assert again == pytest.approx(scatter, rel=0.01)
    assert errors_and_scatter(landings[:, :1], targets, np.ones(5000), units, inside)[1] is None


def test_more_seeds_keep_what_was_run(folder: Path) -> None:
    config = replace(CompareConfig(out=folder.parent, quick=True, progress=False).shortened(), seeds=(3,), latencies=0)
    more = run.Comparison(replace(config, algorithms=()))
    more.run()
    done = set(more.stages.results) - set(more.stages.skipped)
    assert done
    assert all("_2_" in name for name in done)


def test_text_is_put_between_its_markers_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- begin a -->\nold\n<!-- end a -->\nafter\n")
    assert report.replace_between(page, "a", r"new \1")
    assert page.read_text() == "before\n<!-- begin a -->\nnew \\1\n<!-- end a -->\nafter\n"
    assert not report.replace_between(page, "b", "text")
    assert report.replace_between(page, "b", "text", append=True)
    assert page.read_text().endswith("<!-- begin b -->\ntext\n<!-- end b -->\n")


def test_data_of_another_scene_and_impossible_settings_are_named(tmp_path: Path, folder: Path) -> None:
    small = CompareConfig(
        out=tmp_path, progress=False, fidelity="flown", data=folder / "hops_0_0_32.h5", budgets=(8,), duration=0.06
    )
    with pytest.raises(DataFileError, match="expected hops in"):
        run.Comparison(replace(small, scene="moon")).pool(0)
    with pytest.raises(DataFileError, match="at least 64"):
        run.Comparison(replace(small, budgets=(64,))).pool(0)
    for changes in ({"budgets": (2,)}, {"seeds": (0,)}, {"seeds": (1, 2)}, {"policy_seeds": (1, 2)}, {"algorithms": ("dqn",)}):
        with pytest.raises(InvalidParameterError, match=next(iter(changes))):
            CompareConfig(**changes)  # type: ignore[arg-type]
    with pytest.raises(InvalidParameterError, match=r"cut off after 0.06 s would overwrite"):
        CompareConfig(quick=True, write=True)
    with pytest.raises(InvalidParameterError, match="first targets"):
        CompareConfig(second=True, write=True)
    assert not CompareConfig(quick=True).shortened().write


def test_hops_that_are_no_calls_of_their_own_or_were_cut_off_are_not_learnt_from(tmp_path: Path, folder: Path) -> None:
    data, path = dataset.read(folder / "hops_0_0_32.h5"), tmp_path / "hops.h5"
    config = CompareConfig(out=tmp_path, progress=False, fidelity="flown", data=path, budgets=(8,), duration=0.06)
    image = np.arange(32) % 4  # three of four are images of the hop before
    dataset.write(path, HopData(data.columns | {"image": image}, data.configuration))
    found = run.Comparison(config).pool(0)
    np.testing.assert_array_equal(found["stretches"], data["stretches"][image == 0])
    with pytest.raises(DataFileError, match="at least 9 hops, got 8"):
        run.Comparison(replace(config, budgets=(9,))).pool(0)
    dataset.write(path, data)
    with pytest.raises(DataFileError, match=r"expected hops in .*duration=3\.0"):  # these were followed for 0.06 s
        run.Comparison(replace(config, duration=None)).pool(0)
    assert len(run.Comparison(config).pool(9)) == 8
    with pytest.raises(InvalidParameterError, match="at most 10 with a file"):  # the eleventh would learn what the first does
        run.Comparison(config).pool(10)


def test_what_plans_depend_on_is_in_their_record(folder: Path) -> None:
    """Another number of looks, or of descents, and they are made again, and timed again; those of other planners are not."""
    config = replace(CompareConfig(out=folder.parent, quick=True, progress=False).shortened(), algorithms=())
    inverse = {"single", "ensemble", "best2", "refine2"}
    for changes, stale in (({"search": 32}, {"cma"}), ({"inverse": replace(config.inverse, starts=3)}, inverse)):
        copy = folder.parent / f"changed_{next(iter(changes))}"
        shutil.copytree(folder, copy)
        again = run.Comparison(replace(config, out=copy, **changes))
        again.run()
        done = set(again.stages.results) - set(again.stages.skipped)
        plans = {f"plan_{p}_{s}_{b}" for p in stale & set(PLANNERS) for s, b in config.planner_runs}
        tries = {f"{m}_{s}_{b}" for m in stale - set(PLANNERS) for s, b in config.planner_runs}
        scores = {f"score_{m}_{s}_{b}" for m in stale for s, b in config.planner_runs}
        assert done == plans | tries | scores | {f"latency_{method}_32" for method in stale}


@pytest.mark.parametrize(
    ("name", "bad", "good"),
    [
        ("oracle", (1, -1), (0, 2)),
        ("tries", ((0,), (8, -1)), ((), (1,))),
        ("refine", ((0,), (4, 0)), ((), (1,))),
        ("policy_seeds", ((0,), (3, 2, 0), ()), (None, (3,))),
        ("policy_budgets", ((0,), (-100,)), (None, (), (100,))),
        ("targets", (0, -1), (None, 1)),
        ("tries_seeds", (-1,), (None, 0)),
        ("bayes_seeds", (-1,), (None, 0)),
        ("latencies", (-1,), (0,)),
        ("search", (7,), (8,)),
        ("updates", (0,), (1,)),
    ],
)
def test_counts_that_mean_nothing_are_refused(name: str, bad: tuple[Any, ...], good: tuple[Any, ...]) -> None:
    for value in bad:
        with pytest.raises(InvalidParameterError, match=rf"^{name}: expected .* >= \d"):
            CompareConfig(**{name: value})
    for value in good:
        CompareConfig(**{name: value})


def test_data_of_another_physics_are_refused(tmp_path: Path, folder: Path) -> None:
    """What planners learn from must be made as their answers are scored."""
    data, path = dataset.read(folder / "hops_0_0_32.h5"), tmp_path / "hops.h5"
    config = CompareConfig(out=tmp_path, progress=False, fidelity="flown", data=path, budgets=(8,), duration=0.06)

    def pool(asked: str = "flown", **changes: object) -> HopData:
        dataset.write(path, HopData(data.columns, data.configuration | changes))
        return run.Comparison(replace(config, fidelity=asked)).pool(0)

    assert len(pool()) == 8
    made, _, _ = configuration_of(GenerateConfig(path, landing="touchdown", fidelity="flown"))
    assert len(pool(**made.as_dict())) == 8
    usual, _, _ = configuration_of(GenerateConfig(path, landing="touchdown"))  # the paper's model, in single precision
    assert len(pool("single", **usual.as_dict())) == 8
    with pytest.raises(DataFileError, match=r"expected fidelity .*'precision': 'float64'.*compare with --fidelity single"):
        pool("paper", **usual.as_dict())
    with pytest.raises(DataFileError, match=r"expected fidelity .*scored with --fidelity paper.*compare with --fidelity flown"):
        pool("paper")
    others = {"model_version": "1", "dt": 1e-5, "design": data.configuration["design"] | {"bar_density": 1500.0}}
    for name, value in others.items():
        with pytest.raises(DataFileError, match=f"expected {name} .*use another file"):
            pool(**{name: value})


def test_older_files_of_a_comparison_are_known_by_its_record(tmp_path: Path, folder: Path) -> None:
    """They named the paper's model whichever it was."""
    shutil.copytree(folder, tmp_path / "quick")
    path = tmp_path / "quick" / "hops_0_0_32.h5"
    data = dataset.read(path)
    assert data.configuration["fidelity"] == FIDELITIES["flown"].levers()
    paper = {"fidelity": FIDELITIES["paper"].levers(), "precision": "float64"}
    dataset.write(path, HopData(data.columns, data.configuration | paper))
    again = run.Comparison(CompareConfig(out=tmp_path, quick=True, progress=False).shortened())
    assert again.pool(0).configuration == data.configuration
    assert again.stages.skipped == ["hops_0_0_32"]


def test_what_is_left_out_without_cma_is_said(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(folder, tmp_path / "quick")
    monkeypatch.setattr(run, "find_spec", lambda name: None)
    config = replace(
        CompareConfig(out=tmp_path, quick=True, progress=False).shortened(), budgets=(32,), seeds=(1,), policy_budgets=()
    )
    comparison, said = run.Comparison(config), []
    comparison.stages.say = said.append
    comparison.run()
    assert "pip install 'tensegrity-gym[cma]'" in said[0]
    assert not {"oracle", "score_cma_0_32", "score_oracle_0_32"} & set(comparison.stages.results)
    timed = {name for name in comparison.stages.results if name.startswith("latency_")}  # no policies where they have no budget
    assert timed == {f"latency_{name}_32" for name in ("nearest", "single", "ensemble", "tandem", "best2", "repeat2", "refine2")}


def test_every_method_is_timed_on_one_thread_and_often_enough() -> None:
    class Asked:
        def __init__(self) -> None:
            self.threads: list[int] = []

        def predict(self, target: np.ndarray) -> None:
            self.threads.append(torch.get_num_threads())

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        for name, count in (("tandem", 40), ("best8", 20), ("refine8", 20)):
            asked = Asked()
            assert len(question_times(asked, name, np.zeros((3, 2)), 40)) == count  # type: ignore[arg-type]
            assert asked.threads == [1] * (count + 2)
        assert len(question_times(Asked(), "best8", np.zeros((3, 2)), 4)) == 10  # type: ignore[arg-type]
    finally:
        torch.set_num_threads(before)


def test_one_net_is_asked_alone_and_cards_tell_what_it_learnt_from(folder: Path) -> None:
    comparison = run.Comparison(CompareConfig(out=folder.parent, quick=True, progress=False).shortened())
    comparison.measure_floor()
    fitted = comparison.fitted(1, 32)
    stretches = torch.rand(50, 4, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.2
    for known, net in zip(fitted.images, fitted.net.landing_images, strict=True):
        np.testing.assert_array_equal(known, net)  # the nearest stored hop knows the symmetries that the net does
    single = fitted["single"]
    assert isinstance(single, InversePlanner)
    assert isinstance(single.landing, FrozenLanding)
    assert len(single.landing.first) == single.landing(stretches).shape[0] == 1
    torch.testing.assert_close(single.landing(stretches), fitted.landing(stretches)[:1], rtol=0, atol=1e-6)
    card = json.loads((folder / "net_1_32.json").read_text())
    assert card["data_digest"] == comparison.learnt(1, 32).digest
    assert card["train"]["seed"] == 1
    assert set(card["rmse"]) >= {"train"}
    assert card["configuration"]["fidelity"] == FIDELITIES["flown"].levers()


def test_targets_of_varied_scenes_lie_where_they_should_in_their_own_scene() -> None:
    places = registered.read("varied", "touchdown")
    assert {p: len(t) for p, t in places.items()} == registered.COUNTS
    scenes = registered.scenes_of("varied", "touchdown")
    hops = VariedHops(scenes, {})
    low, high = scenes.bounds()
    for place, rows in places.items():
        assert ((rows[:, 2:] >= low) & (rows[:, 2:] <= high)).all()
        there = [bool(reachable(row[:2] * (0.99 if place == "boundary" else 1), hops.at(row[2:]))) for row in rows]
        assert there == [place != "beyond"] * len(rows)
    with pytest.raises(InvalidParameterError, match="varied at touchdown"):
        registered.read("varied", "rest")


def test_each_hop_is_simulated_in_its_own_scene() -> None:
    scenes = scene_ranges({"gravity": (1.6, 9.81), "friction": (0.3, 0.8), "duration": 0.05})
    asked = np.array([(0.1, 0.0, 9.0, 0.4), (0.5, 0.0, 2.0, 0.7), (0.2, 0.0, 9.0, 0.4)])
    stretches = np.array([(0.3, 0.4, 0.5, 0.6), (0.5, 0.5, 0.4, 0.3), (0.6, 0.3, 0.3, 0.6)])
    hops = VariedHops(scenes, {})
    landings = hops.land(stretches, asked)
    earthly, lunar = (replace(scenes.base, gravity=g, friction=mu) for g, mu in ((9.0, 0.4), (2.0, 0.7)))
    np.testing.assert_array_equal(landings[[0, 2]], simulate(stretches[[0, 2]], scene=earthly).landing)
    np.testing.assert_array_equal(landings[[1]], simulate(stretches[[1]], scene=lunar).landing)
    moved = hops.perturbed(stretches, 2, asked)
    np.testing.assert_array_equal(moved[:, 0], landings)
    np.testing.assert_array_equal(moved[[1]], Hops(lunar, {}).perturbed(stretches[[1]], 2))
    assert hops.calls == 3 + 9


@pytest.fixture(scope="module")
def varied_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished quick comparison where scenes vary."""
    folder = tmp_path_factory.mktemp("varied")
    run.main(CompareConfig(out=folder, scene="varied", quick=True, progress=False))
    return folder / "quick"


def test_comparison_of_varied_scenes_tells_all_in_reaches_and_goes_on_after_a_loss(varied_folder: Path) -> None:
    text = (varied_folder / "results.md").read_text(encoding="utf-8")
    for said in ("nearest stored hop", "best of 2 simulated", "2 simulated in turn", "tandem", "SAC", "[% of reach]", "m/s²"):
        assert said in text
    assert "gravity 1.6 to 9.81, friction 0.3 to 0.8" in text
    lost = ("score_sac_1_32", "policy_sac_1_32", "net_1_32", "plan_ensemble_1_32", "score_ensemble_1_32", "score_tandem_1_32")
    kept = {n: json.loads((varied_folder / "stages" / f"{n}.json").read_text())["results"] for n in lost}
    for name in lost:
        (varied_folder / "stages" / f"{name}.json").unlink()
    config = replace(CompareConfig(out=varied_folder.parent, scene="varied", progress=False), quick=True).shortened()
    again = run.comparison_of(config)
    again.run()
    assert set(again.stages.results) - set(again.stages.skipped) == set(lost)
    for name in lost:
        if name.startswith("score"):
            assert again.stages.results[name] == kept[name]
    outcome = Outcome(again)
    assert outcome.methods == ["nearest", "single", "ensemble", "best2", "refine2", "tandem", "cma", "sac"]
    # errors are distances of the stored landings over the reach of each target's own scene
    landings = np.array(kept["score_ensemble_1_32"]["landings"])[:2, 1:]
    inside = again.places["inside"]
    own = [reach(again.hops.at(row[2:])) for row in inside]
    wanted = np.linalg.norm(landings - inside[:, None, :2], axis=2).mean(axis=1) / own
    np.testing.assert_allclose(outcome.errors("ensemble", 32)[1], wanted, rtol=5e-4)  # four digits are kept


def test_one_net_is_asked_alone_in_each_scene(varied_folder: Path) -> None:
    config = CompareConfig(out=varied_folder.parent, scene="varied", quick=True, progress=False).shortened()
    comparison = run.comparison_of(config)
    comparison.measure_floor()
    fitted = comparison.fitted(0, 32)
    stretches = torch.rand(50, 4, generator=torch.Generator().manual_seed(0)) * 0.6 + 0.2
    for values in (np.array([9.0, 0.4]), np.array([2.0, 0.7])):
        landing, whole = fitted._of_one_net(values).landing, fitted.landing.at(values)(stretches)
        assert isinstance(landing, FrozenLanding)
        assert len(landing.first) == landing(stretches).shape[0] == 1
        torch.testing.assert_close(landing(stretches), whole[:1], rtol=0, atol=1e-6)


def test_data_of_varied_scenes_are_taken_from_a_file_that_fits(varied_folder: Path, tmp_path: Path) -> None:
    config = CompareConfig(out=tmp_path, scene="varied", quick=True, progress=False).shortened()
    fits = run.comparison_of(replace(config, data=varied_folder / "hops_0_0_32.h5"))
    np.testing.assert_array_equal(fits.pool(0)["scene_gravity"], dataset.read(varied_folder / "hops_0_0_32.h5")["scene_gravity"])
    # planners learn from lengths as they would be on Earth
    raw, alike = fits.pool(0).rows(slice(0, 16)), fits.learnt(0, 16)
    np.testing.assert_allclose(alike["landing"], raw["landing"] * (raw["scene_gravity"] / 9.80665)[:, None])
    with pytest.raises(DataFileError, match="gravity from"):  # hops cut off in flight
        run.comparison_of(replace(config, data=varied_folder / "hops_0_0_32.h5", duration=1.0)).pool(0)
    with pytest.raises(DataFileError, match="gravity from"):
        run.comparison_of(replace(config, scene="moon", data=varied_folder / "hops_0_0_32.h5")).pool(0)
