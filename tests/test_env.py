"""``TensegrityHop-v0`` and its task: what gymnasium and SB3 expect, scoring, seeding, and every refusal."""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.save_video import save_video
from scipy.stats import qmc

import tensegrity_gym  # noqa: F401 (registers the env)
from tensegrity_gym import ENERGY_NAMES, MODEL_VERSION, HopStatus, Scene, reachable, simulate, task, viewer
from tensegrity_gym import task as task_module
from tensegrity_gym.env import TensegrityHopEnv, register_envs
from tensegrity_gym.errors import (
    InvalidParameterError,
    InvalidStretchesError,
    MissingExtraError,
    ResetNeededError,
    UnknownPresetError,
)
from tensegrity_gym.fidelity import Fidelity, named_fidelity
from tensegrity_gym.reachable import LANDINGS, measure_reach, reach_of, save_reach, stored_reach
from tensegrity_gym.scene_ranges import SCENE_VALUES, scene_ranges
from tensegrity_gym.travel import TensegrityTravelEnv
from tensegrity_gym.video import RecordVideo

MIDDLE = np.full(4, 0.5, dtype=np.float32)
#: Hops that are over soon, for tests in which the physics plays no part.
SHORT = Scene(duration=0.3)
#: What measure_reach simulates with eight hops.
STRETCHES_OF_8 = 0.2 + 0.6 * qmc.Sobol(d=4, seed=0).random_base2(3)
RANGES = {"gravity": (6.0, 9.8), "friction": (0.4, 0.6), "slope": (0.0, 0.1), "duration": 0.3}


@pytest.mark.parametrize("mode", [None, "rgb_array", "rgb_array_list"])
@pytest.mark.parametrize("scene", [SHORT, RANGES], ids=["one scene", "ranges"])
def test_gymnasium_check_env(scene: Any, mode: str | None) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # the one warning we cannot avoid: actions are stretches, not in [-1, 1], see docs
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        # check_env wants an env that gym.make has made, without wrappers
        check_env(gym.make("TensegrityHop-v0", scene=scene, render_mode=mode).unwrapped, skip_render_check=True)


def test_sb3_check_env() -> None:
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        sb3.check_env(TensegrityHopEnv(scene=SHORT))


def test_make_imports_by_module_and_registering_twice_is_harmless() -> None:
    register_envs()
    env = gym.make("tensegrity_gym:TensegrityHop-v0")
    assert isinstance(env.unwrapped, TensegrityHopEnv)
    assert env.spec is not None
    assert env.spec.max_episode_steps is None


def test_one_hop_ends_the_episode_and_tells_all() -> None:
    env = TensegrityHopEnv()
    observation, info = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    assert info["reach"] == task.reach(Scene())
    after, reward, terminated, truncated, info = env.step(np.array((0.3, 0.4, 0.3, 0.4), dtype=np.float32))
    assert (terminated, truncated) == (True, False)
    assert env.observation_space.contains(after)
    hop = simulate(np.array((0.3, 0.4, 0.3, 0.4), dtype=np.float32).astype(float))
    np.testing.assert_array_equal(info["landing"], hop.landing[0])
    np.testing.assert_array_equal(info["touchdown"], hop.touchdown[0])
    assert info["energies"].shape == (4, len(ENERGY_NAMES))
    assert info["status"] is HopStatus(int(hop.status[0]))
    assert info["apex"] == hop.apex[0]
    assert info["error"] == pytest.approx(np.linalg.norm(hop.landing[0] - observation.astype(float)), rel=1e-12)
    assert reward == pytest.approx(-info["error"] / task.reach(Scene()), rel=1e-12)
    assert info["success"] == (info["error"] <= task.SUCCESS_RADIUS * task.reach(Scene()))
    assert (info["simulator_calls"], env.simulator_calls) == (1, 1)


def test_landing_on_the_target_is_the_best_reward_and_a_success() -> None:
    landing = simulate(MIDDLE.astype(float)).landing[0]
    env = TensegrityHopEnv()
    env.reset(options={"target": landing})
    _, reward, _, _, info = env.step(MIDDLE)
    assert info["error"] < 1e-6  # the target is observed as float32
    assert -1e-5 < reward <= 0
    assert info["success"] is True


def test_where_the_landing_is_read_is_an_option() -> None:
    hop = simulate(MIDDLE.astype(float))
    for landing, expected in (("rest", hop.rest), ("touchdown", hop.touchdown)):
        env = TensegrityHopEnv(landing=landing)
        _, info = env.reset(seed=0)
        assert info["reach"] == stored_reach("earth", landing).radius
        np.testing.assert_allclose(env.step(MIDDLE)[4]["landing"], expected[0], atol=1e-12)


def test_seeds_fix_targets_and_scenes_exactly() -> None:
    for scene in ("earth", {"gravity": (1.6, 9.8)}):
        one, other = TensegrityHopEnv(scene=scene), TensegrityHopEnv(scene=scene)
        first = [one.reset(seed=7 if k == 0 else None)[0] for k in range(5)]
        second = [other.reset(seed=7 if k == 0 else None)[0] for k in range(5)]
        np.testing.assert_array_equal(first, second)
        assert len({tuple(f) for f in first}) == 5
        assert not np.array_equal(one.reset(seed=8)[0], first[0])


def test_numpys_integers_are_seeds_too() -> None:
    for make in (TensegrityHopEnv, TensegrityTravelEnv):
        np.testing.assert_array_equal(make().reset(seed=np.int64(3))[0], make().reset(seed=3)[0])


def test_the_same_action_has_the_same_bits() -> None:
    env = TensegrityHopEnv(scene=SHORT)
    found = []
    for _ in range(2):
        env.reset(seed=3)
        found.append(env.step(MIDDLE))
    assert found[0][1] == found[1][1]
    np.testing.assert_array_equal(found[0][4]["energies"], found[1][4]["energies"])


def test_observations_are_fresh_arrays() -> None:
    env = TensegrityHopEnv(scene=SHORT)
    observation, _ = env.reset(seed=0)
    kept = observation.copy()
    observation[:] = 99
    np.testing.assert_array_equal(env.step(MIDDLE)[0], kept)


def test_a_randomised_scene_is_observed_and_simulated() -> None:
    env = TensegrityHopEnv(scene=RANGES)
    assert env.observation_space.shape == (5,)
    observation, _ = env.reset(seed=0)
    for value, name in zip(observation[2:], SCENE_VALUES, strict=True):
        low, high = RANGES[name]  # type: ignore[misc]
        assert low <= value <= high
    scene = env.scene
    assert scene is not None
    np.testing.assert_allclose([scene.gravity, scene.friction, scene.slope], observation[2:], rtol=1e-6)
    info = env.step(MIDDLE)[4]
    np.testing.assert_array_equal(info["landing"], simulate(MIDDLE.astype(float), scene=scene).landing[0])
    unseen = TensegrityHopEnv(scene={"preset": "moon", "gravity": (1.0, 2.0)})
    assert unseen.scenes.base.duration == Scene.preset("moon").duration


def test_a_failed_hop_gets_the_worst_reward(monkeypatch: pytest.MonkeyPatch) -> None:
    real = simulate(MIDDLE.astype(float), scene=SHORT)
    broken = replace(real, status=np.array([int(HopStatus.UNSTABLE)]))
    monkeypatch.setattr(task_module, "simulate", lambda *_, **__: broken)
    env = TensegrityHopEnv(scene=SHORT)
    env.reset(seed=0, options={"target": real.landing[0]})
    _, reward, terminated, _, info = env.step(MIDDLE)
    assert (reward, terminated, info["status"], info["success"]) == (task.WORST_REWARD, True, HopStatus.UNSTABLE, False)


def test_rewards_are_finite_and_never_below_the_worst() -> None:
    landing = np.array([(0, 0), (0.3, 0.4), (1e6, 0), (np.nan, 0), (0, 0)])
    status = np.array([0, 1, 0, 0, int(HopStatus.NOT_CONVERGED)])
    found = task.reward(landing, np.zeros((5, 2)), status, 0.5)
    np.testing.assert_allclose(found, [0, -1, task.WORST_REWARD, task.WORST_REWARD, task.WORST_REWARD], rtol=1e-15)


@pytest.mark.parametrize("landing", ["rest", "touchdown"])
def test_targets_fill_the_reachable_region_evenly(landing: str) -> None:
    scene = Scene.preset("slope", slope_direction=0.5, landing=landing)
    targets = task.sample_targets(np.random.default_rng(0), 4000, scene)
    away = targets - task.reachable_middle(scene)
    angle = np.arctan2(away[:, 1], away[:, 0]) - 0.5
    share = np.linalg.norm(away, axis=1) / reach_of(scene).distance(angle)
    assert share.max() <= 1 + 1e-9
    assert task.reachable(targets * (1 - 1e-9) + 1e-9 * task.reachable_middle(scene), scene).all()
    # uniform in area: P(share < x) = x^2; the Kolmogorov-Smirnov statistic is below 1.95/sqrt(n) but once in a thousand
    assert np.abs(np.sort(share) ** 2 - (np.arange(4000) + 0.5) / 4000).max() < 1.95 / np.sqrt(4000)
    # and the half of the directions that is downhill holds its share of the area
    fine = np.linspace(-np.pi, np.pi, 2001)[:-1] + np.pi / 2000
    area = reach_of(scene).distance(fine) ** 2
    expected = area[np.abs(fine) < np.pi / 2].sum() / area.sum()
    downhill = (np.cos(angle) > 0).mean()
    assert abs(downhill - expected) < 4 * np.sqrt(expected * (1 - expected) / 4000)


def test_targets_come_from_the_boundary_or_beyond_on_request() -> None:
    scene = Scene()
    rng = np.random.default_rng(0)
    edge = task.sample_targets(rng, 200, scene, "boundary")
    angle = np.arctan2(edge[:, 1], edge[:, 0])
    np.testing.assert_allclose(np.linalg.norm(edge, axis=1), reach_of(scene).distance(angle), rtol=1e-12)
    far = task.sample_targets(rng, 200, scene, "beyond")
    assert not task.reachable(far, scene).any()
    assert np.linalg.norm(far, axis=1).max() <= task.TARGET_LIMIT * task.reach(scene)
    for place, known in (("inside", True), ("beyond", False)):
        env = TensegrityHopEnv(target=place)
        assert env.reset(seed=0)[1]["reachable"] is known
        assert env.reset(options={"target": "inside"})[1]["reachable"] is True
    fixed = TensegrityHopEnv(target=(0.3, -0.2))
    assert {tuple(fixed.reset(seed=k)[0]) for k in range(3)} == {(np.float32(0.3), np.float32(-0.2))}


@pytest.mark.parametrize("scene", ["earth", "slope", {"gravity": (1.3, 9.8)}, {"slope": (0.0, 0.2)}], ids=str)
def test_targets_lie_within_the_observation_space(scene: Any) -> None:
    env = TensegrityHopEnv(scene=scene)
    assert all(env.observation_space.contains(env.reset(seed=seed)[0]) for seed in range(200))


def test_bonus_and_cost_are_options() -> None:
    env = TensegrityHopEnv(scene=SHORT, success_bonus=2.0, energy_cost=0.01, success_radius=0.5)
    env.reset(options={"target": (0.0, 0.0)})
    _, reward, _, _, info = env.step(MIDDLE)
    assert info["success"]
    assert info["stored_energy"] > 1
    expected = -info["error"] / task.reach(SHORT) + 2.0 - 0.01 * info["stored_energy"]
    assert reward == pytest.approx(expected, rel=1e-12)
    miserly = TensegrityHopEnv(scene=SHORT, energy_cost=1e3)
    miserly.reset(seed=0)
    assert miserly.step(MIDDLE)[1] == task.WORST_REWARD


def test_a_scene_can_be_asked_for_at_reset() -> None:
    env = TensegrityHopEnv(scene={**RANGES, "slope": 0.0})
    env.reset(seed=0, options={"scene": {"gravity": 7.0}})
    assert env.scene is not None
    assert env.scene.gravity == 7.0
    assert env.scene.duration == RANGES["duration"]
    assert 0.4 <= env.scene.friction <= 0.6  # drawn as ever
    env.reset(options={"scene": replace(SHORT, gravity=8.0)})
    assert env.scene == replace(SHORT, gravity=8.0)
    with pytest.raises(InvalidParameterError, match=r"expected gravity in \[6.0, 9.8\], got 3.7208"):
        env.reset(options={"scene": "mars"})
    moon = TensegrityHopEnv(scene="moon", landing="touchdown")
    moon.reset(options={"scene": "earth"})  # known, if unobserved: whoever asks for it knows it
    assert moon.scene == Scene(landing="touchdown")


def test_fidelity_is_what_simulate_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []
    real = simulate(MIDDLE.astype(float), scene=SHORT)

    def noted(*_: Any, **arguments: Any) -> Any:
        asked.append(arguments)
        return real

    monkeypatch.setattr(task_module, "simulate", noted)
    rough = Fidelity(step=0.9, stop="landing")
    for fidelity, expected in (
        ("paper", {"fidelity": "paper"}),
        ("reference", {"fidelity": "reference"}),
        ("auto", {"fidelity": "auto"}),
        ("single", {"fidelity": "single"}),
        (rough, {"fidelity": rough}),
        ({"step": 0.9, "stop": "landing"}, {"fidelity": rough}),
        ({"dt": 1e-6, "integrator": "velocity_verlet"}, {"dt": 1e-6, "fidelity": Fidelity(integrator="velocity_verlet")}),
    ):
        env = TensegrityHopEnv(scene=SHORT, fidelity=fidelity)
        env.reset(seed=0)
        env.step(MIDDLE)
        assert {k: v for k, v in asked[-1].items() if k in ("dt", "precision", "fidelity")} == expected


@pytest.mark.parametrize("mode", [None, "rgb_array_list"])
def test_a_hop_need_not_be_followed_past_its_touchdown(mode: str | None) -> None:
    """The same landing and reward, for less work."""
    found = []
    for fidelity in ("paper", {"stop": "landing"}):
        env = TensegrityHopEnv(scene=Scene(duration=1.6), landing="touchdown", fidelity=fidelity, render_mode=mode)
        env.reset(seed=0)
        _, reward, terminated, _, info = env.step(MIDDLE)
        found.append((reward, terminated, info["landing"].tolist(), info["apex"], len(env.render() or []) if mode else 0))
        assert all(np.isfinite(value).all() for value in info.values())
    assert found[0][:4] == found[1][:4]
    assert info["status"] is HopStatus.STOPPED
    assert mode is None or 20 < found[1][4] < found[0][4]


@pytest.mark.parametrize("mode", ["rgb_array", "rgb_array_list"])
def test_fewer_segments_are_drawn_too(mode: str) -> None:
    env = TensegrityHopEnv(scene=SHORT, fidelity={"bar_segments": 1}, render_mode=mode)
    env.reset(seed=0)
    before = env.render()
    env.step(MIDDLE)
    assert not np.array_equal(np.asarray(env.render())[-1], np.asarray(before)[-1])


@pytest.mark.parametrize("preset", Scene.PRESETS)
def test_stored_reaches_say_what_they_were_made_by(preset: str) -> None:
    stored = json.loads((reachable.FOLDER / f"{preset}.json").read_text())
    again = f"python -m tensegrity_gym reach --scene {preset} --save"
    assert stored["model_version"] == MODEL_VERSION, f"made with another model; run {again}"
    assert stored["scene"] == asdict(Scene.preset(preset)), f"made in another scene; run {again}"
    assert stored["command"].startswith(f"python -m tensegrity_gym reach --scene {preset} ")
    for landing in LANDINGS:
        region = stored_reach(preset, landing)
        assert len(region.boundary) == reachable.DIRECTIONS
        assert 0 < min(region.boundary) <= region.radius <= max(region.boundary) < task.TARGET_LIMIT * region.radius


def test_reach_is_measured_and_saved(tmp_path: Path) -> None:
    scene = Scene(duration=1.2)
    measured = measure_reach(scene, hops=8)
    landings = simulate(STRETCHES_OF_8, scene=scene).touchdown
    assert measured["touchdown"].radius <= np.linalg.norm(landings, axis=1).max() + 1e-9  # stretches differ by an ulp
    assert measured["touchdown"].radius >= np.median(np.linalg.norm(landings, axis=1))
    symmetric = np.array(measured["touchdown"].boundary)
    np.testing.assert_allclose(symmetric, np.roll(symmetric[::-1], 1), rtol=1e-9)  # y to -y
    saved = json.loads(save_reach("earth", measured, 8, 0, tmp_path).read_text())
    assert saved["rest"]["radius"] == round(measured["rest"].radius, 5)


@pytest.mark.parametrize("hops", [0, -1, 2.5])
def test_a_reach_of_no_hops_is_refused(hops: Any) -> None:
    with pytest.raises(InvalidParameterError, match=f"expected an integer >= 1 of hops .* got {hops}"):
        measure_reach(Scene(), hops)


def test_reaches_grow_as_gravity_shrinks() -> None:
    for landing in LANDINGS:
        for slope in (0.0, 0.1):
            gravities = np.linspace(1.0, 12.0, 45)
            found = [task.reach(Scene(gravity=g, slope=slope, landing=landing)) for g in gravities]
            assert (np.diff(found) <= 0).all()
        assert reach_of(Scene(gravity=3.7208, landing=landing)) == stored_reach("mars", landing)


def test_pictures_before_and_after_the_hop() -> None:
    env = TensegrityHopEnv(scene=SHORT, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    env.step(MIDDLE)
    after = env.render()
    assert isinstance(before, np.ndarray)
    assert isinstance(after, np.ndarray)
    assert before.shape == after.shape
    assert before.dtype == after.dtype == np.uint8
    assert (before != after).any()


def test_all_frames_of_the_hop_are_a_list() -> None:
    env = TensegrityHopEnv(scene=SHORT, render_mode="rgb_array_list")
    env.reset(seed=0)
    env.step(MIDDLE)
    frames = env.render()
    assert isinstance(frames, list)
    # the standing lattice, the release, and 30 frames a second
    assert abs(len(frames) - (2 + SHORT.duration * env.metadata["render_fps"])) <= 1
    assert {frame.shape for frame in frames} == {(480, 640, 3)}
    assert all((a != b).any() for a, b in pairwise(frames))
    assert env.render() == []  # gymnasium's convention: each frame is given once
    env.reset()
    assert len(env.render() or []) == 1


def test_a_video_has_the_whole_hop(tmp_path: Path) -> None:
    """From our RecordVideo, and from gymnasium's save_video; gymnasium's RecordVideo keeps one picture a call."""
    pytest.importorskip("moviepy")
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")

    def film(folder: str) -> tuple[int, float]:
        (path,) = (tmp_path / folder).glob("*.mp4")
        return imageio_ffmpeg.count_frames_and_secs(str(path))

    def hop(env: gym.Env) -> None:
        env.reset(seed=0)
        env.step(MIDDLE)

    env: gym.Env = RecordVideo(gym.make("TensegrityHop-v0", scene=SHORT, render_mode="rgb_array_list"), str(tmp_path / "all"))
    hop(env)
    env.close()
    frames, seconds = film("all")
    assert abs(frames - (2 + SHORT.duration * 30)) <= 1
    assert seconds == pytest.approx(frames / 30, abs=0.02)
    env = gym.make("TensegrityHop-v0", scene=SHORT, render_mode="rgb_array_list")
    hop(env)
    pictures: Any = env.render()
    save_video(pictures, str(tmp_path / "saved"), fps=env.metadata["render_fps"])
    assert film("saved") == (frames, seconds)
    for mode, wrapper in (("rgb_array", RecordVideo), ("rgb_array", gym.wrappers.RecordVideo)):
        env = wrapper(gym.make("TensegrityHop-v0", scene=SHORT, render_mode=mode), str(tmp_path / wrapper.__module__))
        hop(env)
        assert len(env.recorded_frames) == 2  # a picture and a filmstrip
        env.close()


def test_a_person_sees_all_frames_in_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[int] = []

    class Fake:
        def __init__(self, width: int, height: int) -> None:
            assert (width, height) == (640, 480)

        def play(self, pictures: list[np.ndarray], fps: float) -> None:
            assert fps == 30
            shown.append(len(pictures))

        def close(self) -> None:
            shown.append(-1)

    monkeypatch.setattr(viewer, "Window", Fake)
    env = gym.make("TensegrityHop-v0", scene=SHORT, render_mode="human")
    env.reset(seed=0)
    env.step(MIDDLE)
    assert env.render() is None
    env.close()
    assert shown[0] == 1
    assert abs(shown[1] - (1 + SHORT.duration * 30)) <= 1
    assert shown[2] == -1


def test_a_window_without_a_display_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    if sys.platform != "linux":
        pytest.skip("other systems always have a display")
    with pytest.raises(MissingExtraError, match=r"render_mode 'human' needs .*use.*rgb_array_list"):
        TensegrityHopEnv(scene=SHORT, render_mode="human").reset(seed=0)


@pytest.mark.parametrize(
    "action",
    [
        [0.5, 0.5, 0.5, np.nan],
        [0.5, 0.5, 0.5, np.inf],
        [0.5, 0.5, 0.5, 0.81],
        [0.5, 0.5, 0.5, 0.199],
        [0.5, 0.5, 0.5],
        [[0.5] * 4],
        [[0.5], [0.5, 0.5]],
        ["0.5", "0.5", "0.5", "0.5"],
        [True, True, True, True],
        np.full(4, 0.5 + 0j),
        "jump",
        None,
    ],
)
def test_actions_that_are_no_stretches_are_refused(action: Any) -> None:
    env = TensegrityHopEnv(scene=SHORT)
    env.reset(seed=0)
    with pytest.raises(InvalidStretchesError, match=r"action: expected .*, got "):
        env.step(action)
    assert env.simulator_calls == 0
    env.step(MIDDLE)  # the episode still runs


def test_the_bounds_themselves_are_actions_in_either_precision() -> None:
    for dtype in (np.float32, np.float64):
        for bound in (0.2, 0.8):
            checked = task.check_action(np.full(4, bound, dtype=dtype), (4,))
            assert checked.dtype == np.float64
            np.testing.assert_allclose(checked, bound, rtol=2e-8)  # half a unit in the last place of float32
            simulate(checked, scene=Scene(duration=0.01))  # and the simulator takes them


@pytest.mark.parametrize("bound", [-1.0, 1.0])
def test_rescaled_actions_reach_the_ends_of_the_range(bound: float) -> None:
    """gymnasium's own wrapper rounds 0.8 to 0.80000007."""
    env = gym.wrappers.RescaleAction(gym.make("TensegrityHop-v0", scene=SHORT), np.float32(-1), np.float32(1))
    env.reset(seed=0)
    _, reward, *_ = env.step(np.full(4, bound, dtype=np.float32))
    plain = gym.make("TensegrityHop-v0", scene=SHORT)
    plain.reset(seed=0)
    assert plain.step(np.full(4, 0.2 if bound < 0 else 0.8))[1] == pytest.approx(reward, rel=1e-6)
    over = np.full(4, 0.8 + 2 * task.ROUNDING)
    with pytest.raises(InvalidStretchesError, match=r"expected finite stretches in \[0.2, 0.8\]"):
        task.check_action(over, (4,))


def test_gymnasium_check_env_renders_every_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a window that needs no display."""
    monkeypatch.setattr(viewer, "Window", NoWindow)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        check_env(gym.make("TensegrityHop-v0", scene=SHORT, render_mode="rgb_array").unwrapped)


class NoWindow:
    def __init__(self, width: int, height: int) -> None:
        pass

    def play(self, pictures: list[np.ndarray], fps: float) -> None:
        assert pictures

    def close(self) -> None:
        pass


def test_step_needs_a_running_episode() -> None:
    env = TensegrityHopEnv(scene=SHORT)
    with pytest.raises(ResetNeededError, match="call reset"):
        env.step(MIDDLE)
    env.reset(seed=0)
    env.step(MIDDLE)
    with pytest.raises(ResetNeededError, match="one hop ends an episode"):
        env.step(MIDDLE)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"goal": (0, 0)}, r"reset options: expected keys out of \['scene', 'target'\], got \['goal'\]"),
        ({"scene": 3}, "scene: expected a preset's name, a Scene or a mapping, got 3"),
        ({"scene": {"air": 1.0}}, "scene: expected keys out of"),
        ({"scene": "moon"}, "targets would lie up to .* make the env with this scene"),
        ({"target": "here"}, "target: expected one of"),
        ({"target": None, "scene": None, "more": 1}, "expected keys out of"),
        ({"target": (0.1,)}, "target: expected two finite numbers"),
        ({"target": (0.1, np.nan)}, "target: expected two finite numbers"),
        ({"target": (100.0, 0.0)}, r"target: expected within .* reaches.*got"),
    ],
)
def test_options_that_mean_nothing_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidParameterError, match=said):
        TensegrityHopEnv().reset(options=options)


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"scene": "pluto"}, UnknownPresetError, "expected one of"),
        ({"scene": 9.8}, InvalidParameterError, "scene: expected a preset's name"),
        ({"scene": {"air": 1.0}}, InvalidParameterError, "scene: expected keys out of"),
        ({"scene": {"PRESETS": 1.0}}, InvalidParameterError, "scene: expected keys out of"),  # of the class, not of a scene
        ({"scene": {"duration": (1.0, 2.0)}}, InvalidParameterError, "scene ranges: expected keys out of"),
        ({"scene": {"gravity": (9.8, 1.6)}}, InvalidParameterError, "expected low < high"),
        ({"scene": {"gravity": (1.6, np.nan)}}, InvalidParameterError, "two finite numbers"),
        ({"scene": {"gravity": (1.6, 3.7, 9.8)}}, InvalidParameterError, "two finite numbers"),
        ({"scene": {"friction": (-1.0, 0.5)}}, InvalidParameterError, r"Scene\.friction: expected"),
        ({"landing": "orbit"}, InvalidParameterError, r"Scene\.landing: expected one of"),
        ({"success_radius": -1.0}, InvalidParameterError, "success_radius: expected"),
        ({"success_bonus": np.nan}, InvalidParameterError, "success_bonus: expected a finite number"),
        ({"energy_cost": "much"}, InvalidParameterError, "energy_cost: expected a finite number"),
        ({"target": "everywhere"}, InvalidParameterError, "target: expected one of"),
        ({"target": (9.0, 9.0)}, InvalidParameterError, r"target: expected within .* reaches"),
        ({"fidelity": "perfect"}, InvalidParameterError, "fidelity: expected one of"),
        ({"fidelity": {"gravity": 1}}, InvalidParameterError, "fidelity: expected one of"),
        ({"fidelity": {"step": -1.0}}, InvalidParameterError, r"Fidelity\.step: expected a finite number > 0"),
        ({"fidelity": {"dt": 0.0}}, InvalidParameterError, "expected dt to be a finite number > 0"),
        ({"fidelity": None}, InvalidParameterError, "fidelity: expected one of"),
        ({"render_mode": "hologram"}, InvalidParameterError, "render_mode: expected"),
    ],
)
def test_arguments_that_mean_nothing_are_refused(arguments: dict[str, Any], error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        TensegrityHopEnv(**arguments)


def test_unknown_planets_are_hopped_on_until_the_hop_comes_down() -> None:
    """On the Moon a flight lasts twice the time that hops are followed on Earth."""
    env = gym.make("TensegrityHop-v0", scene={"gravity": (1.6, 9.8)}, landing="touchdown", fidelity="flown")
    env.reset(seed=0, options={"scene": {"gravity": 1.62}, "target": (0.5, 0.0)})
    info = env.step(np.array([0.3, 0.5, 0.25, 0.5]))[4]
    assert info["status"] == HopStatus.STOPPED
    env.reset(seed=0, options={"scene": {"gravity": 1.62, "duration": 3.0}, "target": (0.5, 0.0)})
    assert env.step(np.array([0.3, 0.5, 0.25, 0.5]))[4]["status"] == HopStatus.IN_FLIGHT


@pytest.mark.parametrize("fidelity", [{"dt": 1e-3}, {"step": 1.5}, {"bar_segments": 64}, Fidelity(step=1.5)])
def test_a_fidelity_that_no_hop_can_have_is_refused_when_the_env_is_made(fidelity: Any) -> None:
    with pytest.raises(InvalidParameterError, match=r"^fidelity: dt|bar_segments"):
        gym.make("TensegrityHop-v0", fidelity=fidelity)


@pytest.mark.parametrize(
    ("name", "value"),
    [("fidelity", Fidelity(stop="landing", reason="why")), ("scene", scene_ranges({"gravity": (3.7, 9.8), "preset": "mars"}))],
)
def test_an_env_can_be_made_from_what_its_spec_says_in_json(name: str, value: Any) -> None:
    env = gym.make("TensegrityHop-v0", **{name: value})
    assert env.spec is not None
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    ours, theirs = (cast(TensegrityHopEnv, e.unwrapped).task for e in (env, again))
    assert ours.scenes == theirs.scenes
    assert named_fidelity(ours.levers["fidelity"]).levers() == named_fidelity(theirs.levers["fidelity"]).levers()
