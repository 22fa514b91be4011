"""The surrogate: exact symmetry, checkpoints, learning of a known map, and the symmetry of the simulator itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from surrogate import dataset, descent, evaluate, model
from surrogate.dataset import COLUMNS, Configuration, HopData, split_share
from surrogate.descent import Descent, Rows
from surrogate.generate import sample_stretches
from surrogate.kriging import fit_kriging
from surrogate.model import OUTPUTS, HopNet, NetConfig
from surrogate.outputs import LANDING
from surrogate.scores import LEVELS, calibrate, coverage, of_data, rmse, spread
from surrogate.storage import beside
from surrogate.symmetry import with_images
from surrogate.train import TrainCommand, TrainConfig, _start, train
from surrogate.train import main as train_command
from tensegrity_gym import Lattice, Scene, simulate
from tensegrity_gym.errors import DataFileError, InvalidParameterError, InvalidStretchesError, OutputFolderError

LATTICE = Lattice()
QUICK = TrainConfig(net=NetConfig(hidden=(32,), members=2), epochs=150)


def output_signs(lattice_signs: np.ndarray) -> np.ndarray:
    return np.array([1 if o.axis is None else lattice_signs[o.axis] for o in OUTPUTS])


def closed_form_data(hops: int, seed: int = 0) -> HopData:
    """Hops of a smooth map with the lattice's symmetry, in the shape of a file."""
    stretches = sample_stretches(hops, seed)
    centred = (stretches - 0.5) / 0.3
    cells = LATTICE.cells - LATTICE.cells.mean(axis=0)
    columns = {name: np.zeros((hops, *(4 if k < 0 else k for k in c.shape)), dtype=c.dtype) for name, c in COLUMNS.items()}
    columns["stretches"] = stretches
    columns["split_share"] = split_share(stretches, LATTICE)
    columns["landing"] = 0.4 * (centred @ cells) * (1 - 0.3 * centred.mean(axis=1, keepdims=True))
    columns["touchdown"] = 0.2 * columns["landing"]
    columns["apex"] = 1.0 - 0.5 * centred.mean(axis=1)
    columns["takeoff_velocity"] = np.column_stack([columns["touchdown"], 4 * np.sqrt(columns["apex"])])
    columns["flight_time"] = columns["takeoff_velocity"][:, 2] / 4.9
    return HopData(columns, Configuration().as_dict())


@pytest.mark.parametrize("scene", ["earth", "slope"])
def test_net_is_equivariant_to_rounding_whatever_its_weights(scene: str) -> None:
    permutations, signs = model.scene_symmetries(LATTICE, Scene.preset(scene))
    assert len(permutations) == (4 if scene == "earth" else 2)  # a slope along x leaves E and the reflection of y
    torch.manual_seed(1)
    net = HopNet(NetConfig(), permutations, signs).double()
    net.fit_normalisers(torch.randn(40, len(OUTPUTS), dtype=torch.float64))
    stretches = torch.rand(50, 4, dtype=torch.float64) * 0.6 + 0.2
    with torch.no_grad():
        plain = net(stretches)
        for perm, sign in zip(permutations, signs, strict=True):
            image = net(stretches[:, perm]) * torch.as_tensor(output_signs(sign))
            torch.testing.assert_close(image, plain, rtol=0, atol=1e-13)
    free = HopNet(NetConfig(symmetric=False), permutations, signs).double()
    assert not torch.allclose(free(stretches[:, permutations[1]]) * torch.as_tensor(output_signs(signs[1])), free(stretches))


def test_simulator_has_the_symmetry_that_is_built_into_the_net() -> None:
    """Image hops start from mirrored equilibria, so they may differ by form-finding's residual, amplified in flight."""
    stretches = np.array((0.3, 0.42, 0.55, 0.36))
    result = simulate(stretches[LATTICE.symmetries], scene=Scene(duration=1.0))
    for g, signs in enumerate(LATTICE.symmetry_signs):
        # the lattice with stretches s moves as the image of the one with s[perm]; up to take-off nothing amplifies
        velocity = result.takeoff_velocity[g] * (*signs, 1)
        np.testing.assert_allclose(velocity, result.takeoff_velocity[0], atol=1e-3 * np.linalg.norm(result.takeoff_velocity[0]))
        np.testing.assert_allclose(result.stored_energy[g], result.stored_energy[0], rtol=1e-6)
    assert np.linalg.norm(result.takeoff_velocity[0, :2]) > 0.01  # or the test would say nothing


def test_learns_a_closed_form_map_and_same_seed_gives_same_bits() -> None:
    data = closed_form_data(160)
    net, card = train(data, replace(QUICK, epochs=400), progress=False)
    unseen = closed_form_data(100, seed=9)
    errors, spreads = rmse(net, unseen), spread(unseen)
    assert all(errors[o.name] < 0.1 * spreads[o.name] for o in OUTPUTS), errors
    assert card["stopped_on"] == "validation"
    first, second = (train(data, QUICK, progress=False)[0] for _ in range(2))
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name])


def test_correction_repeats_stored_hops_stays_equivariant_and_doubts_what_is_far() -> None:
    data = closed_form_data(120)
    net, _ = train(data, replace(QUICK, epochs=3), progress=False)  # hardly trained: much is left to correct
    unseen = closed_form_data(60, seed=9)
    correction = fit_kriging(net, data, 0.1, 0.1)
    assert correction is not None
    scale = correction.scale
    split = data.split()
    with torch.no_grad():
        seen = torch.from_numpy(data["stretches"][split["train"]].astype(np.float32))
        shift, variance = correction(seen)
        error = (net.landing(seen).mean(dim=0) + shift).numpy() - data["landing"][split["train"]]
        assert np.abs(error).max() < 0.1 * scale.sigma
        assert (variance <= scale.sigma**2).all()
        other = torch.from_numpy(unseen["stretches"].astype(np.float32))
        plain = np.linalg.norm(net.landing(other).mean(dim=0).numpy() - unseen["landing"], axis=1)
        shift, far = correction(other)
        mended = np.linalg.norm((net.landing(other).mean(dim=0) + shift).numpy() - unseen["landing"], axis=1)
        assert mended.mean() < 0.5 * plain.mean()
        assert far.mean() > variance.mean()
        for perm, signs in zip(LATTICE.symmetries, LATTICE.symmetry_signs, strict=True):
            image = correction(other[:, perm])[0] * torch.as_tensor(signs)
            torch.testing.assert_close(image, shift, rtol=0, atol=1e-3 * float(shift.abs().max()))
    assert fit_kriging(net, data.rows(slice(0, 1)), 0.1, 0.1) is None
    tested = data.rows(split["test"])
    left = np.linalg.norm(net.predict(tested["stretches"]).mean[:, LANDING] - tested["landing"], axis=1)
    alone = evaluate.mended(net, tested, data, (0.1, 0.1))
    assert alone["landing"]["rms"] < 0.5 * np.sqrt((left**2).mean())
    # stored images of hops are what the net's symmetries bring back by themselves
    assert evaluate.mended(net, tested, with_images(data, Configuration(symmetry=True)), (0.1, 0.1)) == alone
    assert evaluate.mended(net, tested, data.rows(slice(0, 1)), (0.1, 0.1)) == {}


def test_hops_that_lack_an_output_train_the_others() -> None:
    data = closed_form_data(64)
    data.columns["touchdown"][::2] = np.nan
    net, _ = train(data, QUICK, progress=False)
    assert np.isfinite(net.predict(data["stretches"])[0]).all()
    assert np.isfinite(list(rmse(net, data).values())).all()


def test_data_without_a_usable_hop_is_refused() -> None:
    data = closed_form_data(8)
    data.columns["status"][:] = 3
    with pytest.raises(InvalidParameterError, match="usable"):
        train(data, QUICK, progress=False)


def test_predictions_outside_the_trained_range_are_refused() -> None:
    net = HopNet(NetConfig(), LATTICE.symmetries, LATTICE.symmetry_signs)
    for bad in ((0.1, 0.3, 0.3, 0.3), (np.nan, 0.3, 0.3, 0.3), (0.3, 0.3)):
        with pytest.raises(InvalidStretchesError, match=r"\[0.2, 0.8\]"):
            net.predict(np.array(bad))


def test_checkpoint_round_trip_and_refusals(tmp_path: Path) -> None:
    net, card = train(closed_form_data(40), replace(QUICK, epochs=5), progress=False)
    path = model.save(net, tmp_path / "net.safetensors", card)
    back, back_card = model.load(path)
    stretches = sample_stretches(16, 2)
    assert np.array_equal(back.predict(stretches)[0], net.predict(stretches)[0])
    assert back_card["data_digest"] == card["data_digest"]

    whole, whole_card = path.read_bytes(), path.with_suffix(".json").read_text()
    for damage in (whole[:-1], whole[: len(whole) // 2] + b"\x01" + whole[len(whole) // 2 + 1 :], b""):
        path.write_bytes(damage)
        with pytest.raises(DataFileError, match="train it again"):
            model.load(path)
    path.write_bytes(whole)
    foreign = whole_card.replace(f'"model_version": "{card["configuration"]["model_version"]}"', '"model_version": "other"')
    for text, named in ((foreign, "'other'"), ("{}", "format"), ("[]", "format"), ("{", "readable JSON.*train it again")):
        path.with_suffix(".json").write_text(text)
        with pytest.raises(DataFileError, match=named):
            model.load(path)
    with pytest.raises(DataFileError, match="found none; see whether"):
        model.load(tmp_path / "absent.safetensors")


def test_names_with_dots_are_names_of_their_own(tmp_path: Path) -> None:
    assert beside("runs/net.safetensors", ".json") == Path("runs/net.json")
    assert beside(Path("runs/net"), ".json") == Path("runs/net.json")
    assert beside("runs/net.v2.safetensors", ".training") == Path("runs/net.v2.training")
    net, _ = train(closed_form_data(40), replace(QUICK, epochs=1), progress=False)
    rates = (0.001, 0.003)
    for rate in rates:
        model.save(net, tmp_path / f"net_lr{rate}", {"rate": rate})
    assert [model.load(tmp_path / f"net_lr{rate}")[1]["rate"] for rate in rates] == list(rates)


@pytest.mark.parametrize("name", ["net.json", "net.training", "net.state.safetensors", ".json"])
def test_names_of_files_beside_a_checkpoint_are_refused_before_anything_is_done(name: str, tmp_path: Path) -> None:
    net = HopNet(QUICK.net, *model.scene_symmetries(LATTICE, Scene()))
    tries = (
        lambda: train_command(TrainCommand(data=tmp_path / "absent.h5", out=tmp_path / name)),
        lambda: model.save(net, tmp_path / name, {}),
        lambda: model.load(tmp_path / name),
    )
    for attempt in tries:
        with pytest.raises(
            InvalidParameterError, match=r"such as .*/net\.safetensors, got .*what ends in .* is .*; choose another"
        ):
            attempt()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("config", [NetConfig(hidden=(32, 16)), NetConfig(hidden=(16, 16, 16))])
def test_net_is_equivariant_with_scenes_as_inputs_the_slope_turning_along(config: NetConfig) -> None:
    ranges = {"gravity": (1.6, 9.81), "friction": (0.3, 0.8), "slope": (0.0, 0.3), "slope_direction": (0.0, 6.0)}
    permutations, signs = model.scene_symmetries(LATTICE, Scene.preset("slope"), list(ranges))
    assert len(permutations) == 4  # a slope that is an input breaks no symmetry
    torch.manual_seed(2)
    net = HopNet(config, permutations, signs, Scene.preset("slope"), ranges).double()
    net.fit_normalisers(torch.randn(40, len(OUTPUTS), dtype=torch.float64))
    stretches = torch.rand(50, 4, dtype=torch.float64) * 0.6 + 0.2
    low, high = torch.tensor(list(ranges.values()), dtype=torch.float64).T
    scene = low + (high - low) * torch.rand(50, 4, dtype=torch.float64)
    names = net.scene_names
    scene = scene[:, [list(ranges).index(name) for name in names]]
    with torch.no_grad():
        mean, variance = net.moments(stretches, scene)
        for perm, sign in zip(permutations, signs, strict=True):
            azimuth = scene[:, names.index("slope_direction")]
            turned = scene.clone()
            turned[:, names.index("slope_direction")] = torch.atan2(sign[1] * torch.sin(azimuth), sign[0] * torch.cos(azimuth))
            image_mean, image_variance = net.moments(stretches[:, perm], turned)
            torch.testing.assert_close(image_mean * torch.as_tensor(output_signs(sign)), mean, rtol=0, atol=1e-12)
            torch.testing.assert_close(image_variance, variance, rtol=1e-12, atol=0)
        assert not torch.allclose(net(stretches, scene), net(stretches, scene.flip(0)))
    for bad in (None, {"gravity": 5.0}, {"gravity": 99.0, "friction": 0.5, "slope": 0.1, "slope_direction": 0.0}, (1.0, 2.0)):
        with pytest.raises(InvalidParameterError, match=r"gravity in \[1.6, 9.81\] m/s"):
            net.float().predict(np.full((2, 4), 0.5), bad)
    one = net.predict(np.full((2, 4), 0.5), Scene.preset("slope", friction=0.4)).mean
    asked = {"gravity": 9.80665, "friction": 0.4, "slope": np.radians(10), "slope_direction": [0.0, 0.0]}
    assert np.array_equal(net.predict(np.full((2, 4), 0.5), asked).mean, one)
    assert one.shape == (2, 9)
    for other, said in (({"restitution": 0.5}, "restitution 0.0, got 0.5"), ({"landing": "touchdown"}, "landing 'rest', got")):
        with pytest.raises(InvalidParameterError, match=said):
            net.predict(np.full((2, 4), 0.5), Scene.preset("slope", friction=0.4, **other))
    net.predict(np.full((2, 4), 0.5), Scene.preset("slope", friction=0.4, duration=9.0))


def test_a_net_of_one_scene_answers_for_no_other() -> None:
    net, points = HopNet(NetConfig(), LATTICE.symmetries, LATTICE.symmetry_signs), np.full((2, 4), 0.5)
    same = net.predict(points).mean
    for scene in (Scene(), Scene(duration=9.0), {}):
        assert np.array_equal(net.predict(points, scene).mean, same)
    for scene, said in (
        (Scene.preset("moon"), "gravity 9.80665, got 1.625"),
        ({"gravity": 9.80665}, "no values, as the surrogate was trained in one, got"),
        (np.zeros((2, 1)), "no values"),
    ):
        with pytest.raises(InvalidParameterError, match=said):
            net.predict(points, scene)


def test_learns_how_landings_depend_on_a_varied_scene() -> None:
    """Ballistic throw: landings fall as 1/gravity; a net blind to gravity could not tell them apart."""
    data = closed_form_data(400)
    ranges = {"gravity": (2.0, 10.0)}
    gravity = 2.0 + 8.0 * np.random.default_rng(0).random(len(data))
    columns = data.columns | {"scene_gravity": gravity}
    columns["landing"] = columns["landing"] * (2.0 / gravity)[:, None]
    varied = HopData(columns, Configuration(scene_ranges=ranges).as_dict())
    config = replace(QUICK, net=NetConfig(hidden=(32, 32), members=2), epochs=300, batch=64)
    net, card = train(varied, config, progress=False)
    assert net.scene_names == ("gravity",)
    assert card["rmse"]["test"]["landing_x"] < 0.2 * spread(varied)["landing_x"]
    point = np.full((1, 4), 0.5) + [[0.1, -0.1, 0.1, -0.1]]
    apart = [net.predict(point, {"gravity": g}).mean[0, 4] for g in (2.0, 10.0)]
    assert abs(apart[0] - apart[1]) < 0.1 * spread(varied)["apex"]  # the apex of this map knows no gravity


@pytest.mark.parametrize("beta", [0.0, 0.5])
def test_predicted_scatter_is_the_scatter_of_the_hops_and_calibrated(beta: float) -> None:
    """Noise whose deviation grows tenfold over the range of the mean stretch, by a known law."""
    data, unseen = closed_form_data(2000), closed_form_data(1200, seed=9)
    for part, seed in ((data, 1), (unseen, 2)):
        noise = np.random.default_rng(seed).normal(size=(len(part), 2))
        part.columns["landing"] = part["landing"] + noise * true_scatter(part)[:, None]
    net, card = train(data, replace(QUICK, epochs=250, beta=beta, validation=0.3), progress=False)
    said = of_data(net, unseen)
    ratio = said.deviation[:, :2] / true_scatter(unseen)[:, None]
    assert np.abs(np.log(np.median(ratio))) < 0.15
    assert np.percentile(np.abs(np.log(ratio)), 90) < 0.4
    blind = said.deviation[:, :2].mean() / true_scatter(unseen)
    assert np.percentile(np.abs(np.log(blind)), 90) > 0.5  # one deviation for all hops would not pass
    covered = coverage(said, model.target_columns(unseen))[:, :2]
    assert np.abs(covered - LEVELS[:, None]).max() < 0.05
    np.testing.assert_allclose(net.doubt(unseen["stretches"]), np.hypot(*said.deviation[:, :2].T), rtol=1e-6)
    assert len(card["variance_factor"]) == len(OUTPUTS)


def true_scatter(data: HopData) -> np.ndarray:
    return 0.02 * np.exp(4 * data["stretches"].mean(axis=1) - 0.8)


def test_calibration_mends_a_net_that_is_too_sure() -> None:
    data = closed_form_data(400)
    net, _ = train(data, QUICK, progress=False)
    with torch.no_grad():
        net.biases[-1][..., len(OUTPUTS) :] -= 3.0
    net.variance_factor.fill_(1.0)
    gaps = []
    for mend in (False, True):
        if mend:
            calibrate(net, data)
        covered = coverage(of_data(net, data), model.target_columns(data))
        gaps.append(np.abs(covered - LEVELS[:, None]).mean(axis=0).max())
    assert gaps[0] > 0.2
    assert gaps[1] < 0.1


def test_killed_training_goes_on_with_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, state = closed_form_data(120), tmp_path / "net.state.safetensors"
    config = replace(QUICK, epochs=30, batch=32)
    whole, whole_card = train(data, config, progress=False)
    monkeypatch.setattr(descent, "SAVE_SECONDS", 0.0)
    run_epoch = Descent.run_epoch

    def killed(self: Descent) -> float:
        if self.epoch == 17:
            raise KeyboardInterrupt
        return run_epoch(self)

    monkeypatch.setattr(Descent, "run_epoch", killed)
    with pytest.raises(KeyboardInterrupt):
        train(data, config, progress=False, state=state)
    assert state.exists()
    ran = []
    monkeypatch.setattr(Descent, "run_epoch", lambda self: ran.append(self.epoch) or run_epoch(self))
    resumed, card = train(data, config, progress=False, state=state)
    assert ran == list(range(17, 30))
    assert state.exists()  # for the caller to remove, when the net is written
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    assert card["validation_error"] == whole_card["validation_error"]


def test_a_net_that_cannot_be_written_is_trained_already_on_the_next_try(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = dataset.write(tmp_path / "hops.h5", closed_form_data(60))
    out, state = tmp_path / "net.safetensors", tmp_path / "net.state.safetensors"
    command = TrainCommand(**{**vars(QUICK), "epochs": 6, "data": data, "out": out})
    whole, _ = train(dataset.read(data), command, progress=False)
    monkeypatch.setattr(descent, "SAVE_SECONDS", 0.0)
    with monkeypatch.context() as patch:
        patch.setattr(model, "save", full_disk)
        with pytest.raises(OutputFolderError):
            train_command(command)
    assert state.exists()
    with monkeypatch.context() as patch:
        patch.setattr(Descent, "run_epoch", None)  # there is none left to run
        train_command(command)
    assert not state.exists()
    for name, value in whole.state_dict().items():
        assert torch.equal(value, model.load(out)[0].state_dict()[name]), name
    ran, run_epoch = [], Descent.run_epoch
    monkeypatch.setattr(Descent, "run_epoch", lambda self: ran.append(self.epoch) or run_epoch(self))
    train_command(command)
    assert ran == list(range(6))  # one that was finished trains anew


def full_disk(*_: object) -> None:
    raise OutputFolderError("no room")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"batch": -1}, r"batch: expected an integer >= 1, got -1"),
        ({"batch": 0}, r"batch: expected an integer >= 1, got 0"),
        ({"patience": 0}, r"patience: expected an integer >= 1, got 0"),
        ({"epochs": 0}, r"epochs: expected an integer >= 1, got 0"),
        ({"steps": 0}, r"steps: expected an integer >= 1, got 0"),
        ({"lr": 0.0}, r"lr: expected a finite number > 0, got 0; 0.003 is usual"),
        ({"lr": float("nan")}, r"lr: expected a finite number > 0, got nan"),
        ({"weight_decay": -1.0}, r"weight_decay: expected a finite number >= 0, got -1"),
        ({"beta": 2.0}, r"beta: expected a number from 0 to 1, got 2"),
        ({"validation": 0.8, "test": 0.5}, r"validation and test: expected shares .*, got 0.8 and 0.5; .* below 1"),
        ({"validation": -0.1}, r"validation and test: expected shares >= 0"),
        ({"test": float("nan")}, r"validation and test: expected shares >= 0"),
        ({"seed": -1}, r"seed: expected an integer from 0"),
    ],
)
def test_settings_that_teach_nothing_are_named(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidParameterError, match=said):
        replace(QUICK, **wrong)


@pytest.mark.parametrize("good", [4, 0])
def test_weights_that_are_no_numbers_are_never_the_best(good: int, monkeypatch: pytest.MonkeyPatch) -> None:
    data, config, losses = closed_form_data(40), replace(QUICK, epochs=8), iter(range(8))
    beta_nll = descent.beta_nll
    # one batch an epoch; no gradient of what is no number is one
    monkeypatch.setattr(descent, "beta_nll", lambda *a: beta_nll(*a) * (1.0 if next(losses) < good else torch.nan))
    if not good:
        with pytest.raises(InvalidParameterError, match=r"lr: expected one small enough.*none of 8 epochs.*choose a smaller"):
            train(data, config, progress=False)
        return
    net, card = train(data, config, progress=False)
    assert card["epochs"] == 8
    assert 0 < card["validation_error"] < 10
    assert all(torch.isfinite(p).all() for p in net.parameters())


def test_validation_error_looks_at_all_that_is_known_and_at_nothing_else() -> None:
    torch.manual_seed(3)
    targets = torch.randn(50, len(OUTPUTS))
    targets[::3, 4], targets[:, 7] = torch.nan, torch.nan
    rows = Rows(torch.zeros(50, 4), torch.zeros(50, 0), targets)

    class Says(torch.nn.Module):
        output_scale = torch.rand(len(OUTPUTS)) + 0.5
        said = torch.randn(3, 50, len(OUTPUTS))

        def forward(self, stretches: torch.Tensor, scene: torch.Tensor) -> torch.Tensor:
            return self.said

    net = Says()
    square = torch.nanmean(((net.said.mean(dim=0) - targets) / net.output_scale) ** 2, dim=0)
    square = square[torch.isfinite(square)]
    assert len(square) == len(OUTPUTS) - 1
    expected = float(torch.exp(0.5 * torch.log(square).mean()))
    assert descent.validation_error(net, rows) == expected  # type: ignore[arg-type]
    net.said[:, 0, 4], net.said[0, 1, 7] = torch.nan, torch.inf  # of targets that nobody knows
    assert descent.validation_error(net, rows) == expected  # type: ignore[arg-type]
    for wrong in (torch.nan, torch.inf, 1e30):  # the square of the last is no number of 32 bits
        net.said[1, 1, 4] = wrong
        assert descent.validation_error(net, rows) == np.inf  # type: ignore[arg-type]


def test_saved_training_of_other_settings_is_not_continued_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    data, state = closed_form_data(60), tmp_path / "net.state.safetensors"
    net, rows = _start(data, QUICK)
    train_rows = data.split()["train"]
    first = Descent(net, rows, train_rows, train_rows, QUICK)
    first.run_epoch()
    first.save(state, "this one")
    second = Descent(net, rows, train_rows, train_rows, QUICK)
    second.resume(state, "another one")
    assert second.epoch == 0
    second.resume(state, "this one")
    assert second.epoch == 1
    whole = state.read_bytes()
    state.write_bytes(whole[:-5])
    with pytest.raises(DataFileError, match="start anew"):
        second.resume(state, "this one")
    state.write_bytes(unsealed(whole))  # as versions before wrote it
    with pytest.raises(DataFileError, match="an older version wrote it"):
        second.resume(state, "this one")
    assert state.exists()


def unsealed(whole: bytes) -> bytes:
    return whole.split(b"\n", 1)[1]


@pytest.mark.parametrize("share", [0.0, 0.01, 0.05, 0.5, 0.999])
def test_one_flipped_bit_of_a_saved_training_is_noticed(share: float, tmp_path: Path) -> None:
    data, state = closed_form_data(60), tmp_path / "net.state.safetensors"
    net, rows = _start(data, QUICK)
    some = data.split()["train"]
    first = Descent(net, rows, some, some, QUICK)
    first.run_epoch()
    first.save(state, "this one")
    content = bytearray(state.read_bytes())
    content[int(share * len(content))] ^= 4
    state.write_bytes(content)
    with pytest.raises(DataFileError, match="damaged"):
        Descent(net, rows, some, some, QUICK).resume(state, "this one")


def test_training_stops_when_nothing_helps_and_keeps_the_best_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = [0.9, 0.5, 0.7, 0.4, 0.6, 0.41, 0.8]  # best after the fourth epoch; the fifth to the seventh do not help
    left, kept = iter(errors), []
    monkeypatch.setattr(descent, "validation_error", lambda net, rows: next(left))
    run_epoch = Descent.run_epoch

    def watched(self: Descent) -> float:
        loss = run_epoch(self)
        kept.append([p.detach().clone() for p in self.net.parameters()])
        return loss

    monkeypatch.setattr(Descent, "run_epoch", watched)
    net, card = train(closed_form_data(60), replace(QUICK, patience=3), progress=False)
    assert card["epochs"] == len(kept) == 7 < QUICK.epochs
    assert card["validation_error"] == 0.4
    for value, best, last in zip(net.parameters(), kept[3], kept[-1], strict=True):
        assert torch.equal(value, best)
        assert not torch.equal(value, last)


def test_tensorboard_gets_loss_and_error(tmp_path: Path) -> None:
    train(closed_form_data(40), replace(QUICK, epochs=4), progress=False, log=tmp_path)
    read = EventAccumulator(str(tmp_path)).Reload()
    assert [e.step for e in read.Scalars("error/validation")] == [1, 2, 3, 4]
    assert set(read.Tags()["scalars"]) == {"loss/train", "error/validation", "lr"}


def test_images_give_a_free_net_what_a_symmetric_one_has() -> None:
    data = closed_form_data(60)
    free = replace(QUICK, net=replace(QUICK.net, symmetric=False))
    _, blind = train(data, free, progress=False)
    _, told = train(data, replace(free, images=True), progress=False)
    assert told["hops"]["train"] == 4 * blind["hops"]["train"]
    assert told["validation_error"] < blind["validation_error"]


def test_sizes_and_devices_that_cannot_be_are_refused() -> None:
    with pytest.raises(InvalidParameterError, match="multiples of 4"):
        HopNet(NetConfig(hidden=(30,)), LATTICE.symmetries, LATTICE.symmetry_signs)
    with pytest.raises(InvalidParameterError, match="device"):
        train(closed_form_data(20), replace(QUICK, device="abacus"), progress=False)
