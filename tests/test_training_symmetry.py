"""Policies that know the symmetries: what they see, what their envs simulate, and that copies and files know as much."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from tensegrity_gym import Lattice, Scene, simulate
from tensegrity_gym.scene_ranges import SceneRanges, scene_ranges
from training.policies import ActorPolicy, _mlp
from training.sb3_vec_env import BatchedHopVecEnv, make_env
from training.similarity import Scaling
from training.symmetry import FoldedTargets, Symmetry
from training.train_policy import PolicyConfig, train_policy

QUICK = Scene(duration=0.05)
LEVEL = Symmetry.of(SceneRanges(QUICK))


@pytest.mark.parametrize(
    ("scenes", "count"),
    [
        (SceneRanges(Scene()), 4),
        (scene_ranges({"gravity": (1.6, 9.81), "friction": (0.3, 0.8)}), 4),
        (SceneRanges(Scene.preset("slope")), 2),
        (SceneRanges(Scene(slope=0.1, slope_direction=0.5)), 1),
        (scene_ranges({"slope": (0.0, 0.2)}), 2),
    ],
)
def test_only_symmetries_that_all_scenes_share_are_known(scenes: SceneRanges, count: int) -> None:
    found = Symmetry.of(scenes)
    assert len(found.permutations) == len(found.signs) == count
    assert found.permutations[0] == (0, 1, 2, 3)
    assert found.signs[0] == (1.0, 1.0)


def test_targets_are_folded_into_one_quadrant_and_images_into_one_point() -> None:
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(50, 4)).astype(np.float32)
    folded, which = LEVEL.fold(seen)
    np.testing.assert_array_equal(folded[:, :2], np.abs(seen[:, :2]))
    np.testing.assert_array_equal(folded[:, 2:], seen[:, 2:])
    assert folded.dtype == np.float32
    assert set(which) == {0, 1, 2, 3}
    half = Symmetry.of(SceneRanges(Scene.preset("slope"))).fold(seen)[0]
    np.testing.assert_array_equal(half[:, :2], np.column_stack([seen[:, 0], np.abs(seen[:, 1])]))
    on_axis = np.array([(0.0, 0.0), (0.0, -0.1), (-0.1, 0.0)])
    np.testing.assert_array_equal(np.abs(LEVEL.fold(on_axis)[0]), np.abs(on_axis))


def test_answers_to_mirrored_targets_are_mirrored() -> None:
    policy = ActorPolicy(_mlp([2, 16, 4]), Scaling((0.2,)), symmetry=LEVEL)
    target = np.array((0.07, 0.03))
    asked = target * np.array(LEVEL.signs)
    answers, _ = policy.predict(asked)
    plain, _ = ActorPolicy(policy.layers, policy.scaling).predict(target)
    for answer, permutation in zip(answers, LEVEL.permutations, strict=True):
        np.testing.assert_allclose(answer, plain[list(permutation)], atol=1e-6)  # batches may be summed in another order
    assert len(np.unique(answers, axis=0)) == 4
    np.testing.assert_allclose(policy.predict(asked[3])[0], answers[3], atol=1e-6)


@pytest.mark.parametrize("preset", ["earth", "slope"])
def test_what_answers_the_folded_target_lands_at_the_target_when_unfolded(preset: str) -> None:
    """The group's convention against the physics: one wrong sign, swapped index or, on a slope, axis lands elsewhere."""
    scene = Scene.preset(preset, landing="touchdown")
    group = Symmetry.of(SceneRanges(scene))
    count = len(group.signs)
    answer = np.array((0.31, 0.52, 0.44, 0.67))  # to some folded target, the landing
    landing = simulate(answer, scene=scene).landing[0]
    landings = simulate(group.unfold(np.tile(answer, (count, 1)), np.arange(count)), scene=scene).landing
    np.testing.assert_allclose(landings * np.array(group.signs), np.tile(landing, (count, 1)), atol=2e-3)  # the floor, manifold
    assert np.abs(landing).min() > 5e-3


def test_folded_envs_simulate_what_answers_their_own_targets() -> None:
    plain = DummyVecEnv([lambda: FoldedTargets(make_env(QUICK, 0.5), LEVEL)] * 3)
    batched, bare = BatchedHopVecEnv(QUICK, 0.5, 3, symmetry=LEVEL), BatchedHopVecEnv(QUICK, 0.5, 3)
    bare.seed(5)
    plain._seeds = list(batched.seed(5))  # seeds of its own would be others
    seen, folded, own = (np.asarray(venv.reset()) for venv in (plain, batched, bare))
    quadrants = set()
    for action in (np.linspace(-1, 1, 12), np.linspace(0.5, -1, 12), np.linspace(-1, 0, 12)):
        actions = action.reshape(3, 4).astype(np.float32)
        np.testing.assert_array_equal(seen, folded)
        np.testing.assert_array_equal(folded, np.abs(own))
        which = LEVEL.fold(own)[1]
        quadrants |= set(which)
        (seen, one, _, told), (folded, other, _, same) = plain.step(actions), batched.step(actions)  # type: ignore[assignment]
        after, wanted, _, infos = bare.step(LEVEL.unfold(actions, which))
        own = np.asarray(after)
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(other, wanted)
        for a, b, c in zip(told, same, infos, strict=True):
            np.testing.assert_array_equal(a["landing"], b["landing"])
            np.testing.assert_array_equal(b["landing"], c["landing"])
            np.testing.assert_array_equal(a["terminal_observation"], b["terminal_observation"])
            np.testing.assert_array_equal(b["terminal_observation"], np.abs(c["terminal_observation"]))
    assert len(quadrants) > 1  # else nothing was folded


def test_trained_and_kept_policies_know_what_they_were_trained_with(tmp_path: Path) -> None:
    config = PolicyConfig("sac", calls=8, updates=1, envs=4, symmetric=True)
    actors, card = train_policy(QUICK, config, progress=False)
    assert actors[8].symmetry == LEVEL
    path = actors[8].save(tmp_path / "policy.safetensors", card)
    kept = ActorPolicy.load(path)
    assert kept.symmetry == LEVEL
    targets = np.random.default_rng(0).uniform(-0.1, 0.1, (6, 2))
    np.testing.assert_array_equal(kept.predict(targets)[0], actors[8].predict(targets)[0])
    mirrored = kept.predict(-targets)[0]
    np.testing.assert_array_equal(mirrored, kept.predict(targets)[0][:, Lattice().symmetries[1]])
    plain, _ = train_policy(QUICK, PolicyConfig("sac", calls=8, updates=1, envs=4), progress=False)
    assert plain[8].symmetry is None


def test_actors_from_before_symmetries_are_read(tmp_path: Path) -> None:
    policy = ActorPolicy(_mlp([2, 8, 4]), Scaling((0.2,)))
    policy.save(tmp_path / "policy.safetensors", {})
    card = json.loads((tmp_path / "policy.json").read_text())
    del card["symmetry"]
    (tmp_path / "policy.json").write_text(json.dumps(card | {"format": "tensegrity_gym.actor/3"}))
    kept = ActorPolicy.load(tmp_path / "policy.safetensors")
    assert kept.symmetry is None
    np.testing.assert_array_equal(kept.predict(np.ones(2))[0], policy.predict(np.ones(2))[0])
