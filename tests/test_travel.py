"""``TensegrityTravel-v0``: poses, the chain of hops, and every refusal."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import tensegrity_gym  # noqa: F401 (registers the env)
from tensegrity_gym import Design, Fidelity, HopStatus, Lattice, Scene, auto, simulate, task, travel
from tensegrity_gym.calibration import Calibration, Rung
from tensegrity_gym.errors import InvalidParameterError, InvalidStretchesError, ResetNeededError
from tensegrity_gym.travel import FLIP, PATIENCE, TensegrityTravelEnv, read_pose, turned

LATTICE = Lattice(2, 2)
NODES = Design().unloaded_nodes(LATTICE)
UNEVEN = np.array((0.25, 0.6, 0.35, 0.5), dtype=np.float32)
#: Hops that are over soon, for tests in which the physics plays no part.
SHORT = Scene(duration=0.15)


def turn_about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_upside_down_the_lattice_is_itself_with_its_cells_renumbered() -> None:
    """Half a turn about the diagonal maps nodes onto nodes, bars onto bars and actuated cables onto actuated cables."""
    centred = NODES - NODES.mean(axis=0)
    distance = np.linalg.norm((centred @ FLIP.T)[:, None] - centred[None], axis=2)
    image = distance.argmin(axis=1)
    assert distance.min(axis=1).max() < 1e-12
    for members in (LATTICE.bars, LATTICE.edges):
        assert {frozenset(image[m]) for m in members} == {frozenset(m) for m in members}
    cells = [set(LATTICE.cell_node_indices(c)) for c in range(4)]
    assert all({int(image[n]) for n in cell} in cells for cell in cells)


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.9, 3.1])
@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_the_pose_of_a_turned_lattice_is_read(heading: float, upside_down: bool, tilt: float) -> None:
    c, s = np.cos(tilt), np.sin(tilt)
    lean = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    turn = lean @ turn_about_z(heading) @ (FLIP if upside_down else np.eye(3))
    bent = NODES * (1.0, 1.0, 0.97)
    pose = read_pose(bent @ turn.T + (3.0, -2.0, 0.5), LATTICE)
    assert pose.upside_down is upside_down
    assert pose.tilt == pytest.approx(tilt, abs=1e-7)
    if tilt == 0:
        assert pose.heading == pytest.approx(heading, abs=1e-9)
    else:  # the nearest upright pose: half of the lean's foreshortening goes into neither axis
        upright = turn @ FLIP if upside_down else turn
        best = max(np.linspace(-np.pi, np.pi, 7201), key=lambda a: np.trace(turn_about_z(a).T @ upright))
        assert abs(np.angle(np.exp(1j * (pose.heading - best)))) < 1e-3


def test_hops_are_chained_where_and_how_the_last_one_came_to_rest() -> None:
    scene = Scene.preset("slope", slope_direction=0.4, duration=1.2)
    env = TensegrityTravelEnv(scene=scene, distance=4.0)
    observation, info = env.reset(seed=0)
    np.testing.assert_allclose(observation[:2], info["goal"], rtol=1e-6)
    position, heading = np.zeros(2), 0.0
    for k in range(2):
        # to the last bit the angle that the env takes: tumbling hops multiply a difference by more than 1e10
        there = replace(scene, slope_direction=travel._wrapped(0.4 - heading), duration=PATIENCE * 1.2)
        hop = simulate(UNEVEN.astype(float), scene=there)
        before = np.linalg.norm(info["goal"] - position)
        position = position + turned(hop.rest[0], heading)
        pose = read_pose(hop.end_nodes[0], LATTICE)
        heading = travel._wrapped(heading + pose.heading)
        observation, reward, terminated, truncated, info = env.step(UNEVEN)
        np.testing.assert_allclose(info["position"], position, atol=1e-9)
        assert np.angle(np.exp(1j * (info["heading"] - heading))) == pytest.approx(0, abs=1e-9)
        assert (info["hops"], info["upside_down"], info["tilt"]) == (k + 1, pose.upside_down, pose.tilt)
        assert info["distance"] == pytest.approx(np.linalg.norm(info["goal"] - position))
        assert reward == pytest.approx((before - info["distance"]) / task.reach(scene) - 0.1, rel=1e-9)
        assert not terminated
        assert not truncated
        # what is observed is the goal in the lattice's own frame, and the way down
        np.testing.assert_allclose(turned(observation[:2], heading), info["goal"] - position, atol=1e-5)
        expected = np.sin(scene.slope) * np.array((np.cos(0.4), np.sin(0.4)))
        np.testing.assert_allclose(turned(observation[2:4], heading), expected, atol=1e-6)
    assert env.simulator_calls == 2


@pytest.mark.parametrize("scene", [SHORT, {"gravity": (6.0, 9.8), "slope": (0.0, 0.1), "duration": 0.15}], ids=["one", "ranges"])
@pytest.mark.parametrize("mode", [None, "rgb_array", "rgb_array_list"])
def test_gymnasium_check_env(scene: Any, mode: str | None) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        check_env(gym.make("TensegrityTravel-v0", scene=scene, render_mode=mode).unwrapped, skip_render_check=True)


def test_sb3_check_env() -> None:
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        sb3.check_env(TensegrityTravelEnv(scene=SHORT))


def test_seeds_fix_goals_and_hops_exactly() -> None:
    runs = []
    for _ in range(2):
        env = TensegrityTravelEnv(scene=SHORT)
        first, _ = env.reset(seed=5)
        runs.append((first, env.step(UNEVEN)[0], env.reset()[0]))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0][0], runs[0][2])


@pytest.mark.parametrize("duration", [0.15, 0.01])  # the second: too short for a frame at any rate
def test_rendering_changes_nothing_that_is_observed(duration: float) -> None:
    """The heading is the one where the hop ended, as the position is; no frame is as late as that, and frames follow the mode."""
    seen = []
    for mode in (None, "rgb_array", "rgb_array_list"):
        env = TensegrityTravelEnv(scene=Scene(duration=duration), render_mode=mode)
        env.reset(seed=4)
        observation, reward, *_, info = env.step(UNEVEN)
        seen.append((*observation, reward, info["heading"], info["tilt"], info["upside_down"]))
    assert seen[0] == seen[1] == seen[2]


def test_an_episode_ends_on_arrival_or_after_the_last_hop() -> None:
    env = TensegrityTravelEnv(scene=SHORT, max_hops=2)
    env.reset(options={"goal": (0.05, 0.0)})
    _, reward, terminated, truncated, info = env.step(UNEVEN)
    assert (terminated, truncated, info["success"]) == (True, False, True)
    assert reward > 0.5  # the bonus
    with pytest.raises(ResetNeededError, match="call reset"):
        env.step(UNEVEN)
    env.reset(seed=0)
    ends = [env.step(UNEVEN)[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    with pytest.raises(ResetNeededError, match="call reset"):
        env.step(UNEVEN)


def test_every_option_does_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []
    real = travel.simulate

    def noted(*given: Any, **named: Any) -> Any:
        asked.append(named)
        return real(*given, **named)

    monkeypatch.setattr(travel, "simulate", noted)
    env = TensegrityTravelEnv(scene=SHORT, distance=3.0, success_radius=2.999, success_bonus=4.0, hop_cost=0.7, fidelity="single")
    _, first = env.reset(seed=0)
    assert first["distance"] == pytest.approx(3.0 * first["reach"], rel=1e-12)
    goal = 3.01 * first["reach"]  # too far to have arrived, unless the hop brings it nearer
    env.reset(options={"goal": (-goal, 0.0)})
    for sign in (-1, 1):  # away from the goal by chance, or towards it
        _, info = env.reset(options={"goal": (sign * goal, 0.0)})
        _, reward, arrived, _, after = env.step(UNEVEN)
        nearer = (info["distance"] - after["distance"]) / info["reach"]
        assert arrived == (after["distance"] <= 2.999 * info["reach"])
        assert reward == pytest.approx(nearer - 0.7 + 4.0 * arrived, rel=1e-12)
    assert {one["fidelity"] for one in asked} == {"single"}


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Scene]]:
    """The scenes that models were tried out in, by a stand-in for the calibration that finds one known by heart."""
    scenes: list[Scene] = []

    def calibrate(scene: Scene, *_: Any, **__: Any) -> dict[str, Calibration]:
        scenes.append(scene)
        return {scene.landing: Calibration(2e-3, (Rung(Fidelity(precision="float32"), 0.3, 3e-4, 1.5e-3),), 16)}

    monkeypatch.setattr(auto, "calibrate", calibrate)
    auto.pilot.cache_clear()
    yield scenes
    auto.pilot.cache_clear()


@pytest.mark.parametrize(
    ("scene", "pilots"),
    [
        (SHORT, 1),
        (replace(SHORT, slope=0.1, slope_direction=0.4), 1),
        ("earth", 0),
        ("slope", 0),
        ({"gravity": (6.0, 9.8), "duration": 0.15}, 2),
    ],
    ids=["flat", "sloping", "preset", "sloping preset", "ranges"],
)
def test_auto_is_chosen_once_an_episode_for_the_scene_as_drawn(
    scene: Any, pilots: int, tried: list[Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each hop is simulated on ground turned into the lattice's frame, and for longer: not in scenes of their own."""
    asked: list[dict[str, Any]] = []
    hop = simulate(UNEVEN.astype(float), scene=SHORT)

    def noted(*_: Any, **named: Any) -> Any:
        asked.append(named)
        return hop

    monkeypatch.setattr(travel, "simulate", noted)
    env = TensegrityTravelEnv(scene=scene, fidelity="auto")
    for _ in range(2):
        env.reset(seed=3 if pilots < 2 else None)
        for _ in range(3):
            env.step(UNEVEN)
        expected = auto.choose_fidelity(Design(), env.scene, LATTICE)
        assert {str(one["fidelity"]) for one in asked[-3:]} == {str(expected)}
    assert len(tried) == pilots
    headings = {one["scene"].slope_direction for one in asked[:3]}
    assert headings == {0.0} if env.scene.slope == 0 else len(headings) == 3


def test_a_failed_hop_gets_the_worst_reward_and_ends_the_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    real = simulate(UNEVEN.astype(float), scene=SHORT)
    broken = replace(real, status=np.array([int(HopStatus.UNSTABLE)]), rest=np.full((1, 2), np.nan))
    monkeypatch.setattr(travel, "simulate", lambda *_, **__: broken)
    env = TensegrityTravelEnv(scene=SHORT)
    env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(UNEVEN)
    assert (reward, terminated, truncated) == (task.WORST_REWARD, True, False)
    assert (info["status"], info["success"]) == (HopStatus.UNSTABLE, False)
    assert np.isfinite(observation).all()


def test_all_hops_are_shown_in_one_world() -> None:
    env = TensegrityTravelEnv(scene=SHORT, render_mode="rgb_array_list")
    env.reset(seed=0)
    env.step(UNEVEN)
    env.step(UNEVEN)
    frames = env.render()
    assert isinstance(frames, list)
    per_hop = 1 + PATIENCE * SHORT.duration * 30
    assert abs(len(frames) - (1 + 2 * per_hop)) <= 2
    picture = TensegrityTravelEnv(scene=SHORT, render_mode="rgb_array")
    picture.reset(seed=0)
    assert isinstance(picture.render(), np.ndarray)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"distance": -1}, "distance: expected a finite number >= 0"),
        ({"max_hops": 0}, "max_hops: expected an integer >= 1"),
        ({"success_radius": np.nan}, "success_radius: expected"),
        ({"success_bonus": "x"}, "success_bonus: expected"),
        ({"hop_cost": np.inf}, "hop_cost: expected"),
        ({"fidelity": "perfect"}, "fidelity: expected one of"),
        ({"render_mode": "hologram"}, "render_mode: expected"),
    ],
)
def test_arguments_that_mean_nothing_are_refused(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidParameterError, match=said):
        TensegrityTravelEnv(**arguments)


def test_options_actions_and_orders_that_mean_nothing_are_refused() -> None:
    env = TensegrityTravelEnv(scene=SHORT)
    with pytest.raises(ResetNeededError, match="call reset"):
        env.step(UNEVEN)
    for options, said in (
        ({"target": (1, 1)}, r"expected keys out of \['goal'\], got \['target'\]"),
        ({"goal": (np.nan, 0)}, "goal: expected two finite numbers"),
        ({"goal": (1e6, 0)}, "goal: expected two finite numbers .* within"),
        ({"goal": "there"}, "goal: expected two finite numbers"),
    ):
        with pytest.raises(InvalidParameterError, match=said):
            env.reset(options=options)
    env.reset(seed=0)
    with pytest.raises(InvalidStretchesError, match="action: expected"):
        env.step(np.full(4, np.nan))
