"""Evaluation of the surrogate: numbers that are known beforehand, the command from end to end, and its refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate import dataset, evaluate, model, studies
from surrogate.dataset import Configuration, HopData
from surrogate.evaluate import EvaluateConfig
from surrogate.floor import measure_floor
from surrogate.model import OUTPUTS, Prediction
from surrogate.scores import LEVELS, coverage, disagreement, nearest_hop_noise, of_data, ranking, rmse, speed
from surrogate.train import train
from tensegrity_gym import Scene
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tests.test_surrogate_model import LATTICE, QUICK, closed_form_data

PNG = b"\x89PNG\r\n\x1a\n"


def with_noise(data: HopData, deviation: float, seed: int = 3) -> HopData:
    """The same hops, their landings scattered by white noise [m]."""
    noise = np.random.default_rng(seed).normal(scale=deviation, size=(len(data), 2))
    return HopData(data.columns | {"landing": data["landing"] + noise}, data.configuration)


def test_nearest_hop_noise_is_the_noise_that_was_put_in() -> None:
    smooth = closed_form_data(1500)
    found = nearest_hop_noise(with_noise(smooth, 0.05))
    for name in ("landing_x", "landing_y"):
        assert found[name] == pytest.approx(0.05, rel=0.12)
        assert nearest_hop_noise(smooth)[name] < 0.01
    varied = HopData(smooth.columns, Configuration(scene_ranges={"gravity": (1.0, 9.0)}).as_dict())
    assert np.isnan(list(nearest_hop_noise(varied).values())).all()


def test_nearest_hop_noise_meets_a_hop_with_the_images_of_others() -> None:
    """Hops that lie near nothing but images of each other: the estimate must turn those landings back."""
    half = closed_form_data(400)
    near = half["stretches"] + 1e-3 * np.random.default_rng(0).normal(size=(400, 4))
    image = {
        "stretches": np.clip(near, 0.2, 0.8)[:, LATTICE.symmetries[1]],
        "landing": half["landing"] * LATTICE.symmetry_signs[1],
        "touchdown": half["touchdown"] * LATTICE.symmetry_signs[1],
    }
    columns = {k: np.concatenate([v, image.get(k, v)]) for k, v in half.columns.items()}
    both = HopData(columns, half.configuration)
    assert nearest_hop_noise(both)["landing_x"] < 0.01
    wrong = HopData(columns | {"landing": np.concatenate([half["landing"], -image["landing"]])}, half.configuration)
    assert nearest_hop_noise(wrong, pairs=1)["landing_x"] > 0.05


def test_coverage_and_ranking_of_a_prediction_that_is_right() -> None:
    random = np.random.default_rng(0)
    deviation = np.exp(random.normal(size=(20_000, len(OUTPUTS))))
    targets = deviation * random.normal(size=deviation.shape)
    targets[::3, 4] = np.nan
    said = Prediction(np.zeros_like(deviation), deviation)
    assert np.abs(coverage(said, targets) - LEVELS[:, None]).max() < 0.02
    assert (coverage(said._replace(deviation=0.5 * deviation), targets)[9] < 0.35).all()
    order = ranking(said, 0.1 * deviation, targets)
    assert order["touchdown"]["deviation"] > 0.4
    assert order["touchdown"]["disagreement"] == pytest.approx(order["touchdown"]["deviation"])
    blind = ranking(said._replace(deviation=random.permutation(deviation)), random.permutation(deviation), targets)
    assert abs(blind["touchdown"]["deviation"]) < 0.05


def test_members_are_the_ensemble() -> None:
    net, _ = train(closed_form_data(30), replace(QUICK, epochs=2), progress=False)
    data = closed_form_data(10, seed=4)
    members = [net.member(k) for k in range(net.config.members)]
    mean = np.mean([of_data(one, data).mean for one in members], axis=0)
    np.testing.assert_allclose(of_data(net, data).mean, mean, atol=1e-6)
    apart = np.std([of_data(one, data).mean for one in members], axis=0)
    np.testing.assert_allclose(disagreement(net, data), apart * np.sqrt(net.variance_factor.numpy()), atol=1e-6)
    found = speed(net, batch=64, seconds=0.05)
    assert min(found.values()) > 0


def test_command_writes_numbers_and_pictures_and_goes_on_with_its_studies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(studies, "WIDTHS", (4, 8))
    monkeypatch.setattr(studies, "DEPTHS", (1, 2))
    monkeypatch.setattr(studies, "SHARES", (0.5, 1.0))
    path = dataset.write(tmp_path / "hops.h5", closed_form_data(150))
    data = dataset.read(path)
    net, card = train(data, replace(QUICK, epochs=30), progress=False)
    checkpoint = model.save(net, tmp_path / "net.safetensors", card)
    out = tmp_path / "out"
    config = EvaluateConfig(checkpoint, path, out=out, studies=("sizes", "nets", "symmetry"), study_steps=3)
    evaluate.main(config)
    assert "Spearman" in capsys.readouterr().out
    found = json.loads((out / "evaluation.json").read_text())
    test = data.rows(data.split()["test"])
    assert found["rmse"] == pytest.approx(rmse(net, test))
    assert found["hops"] == len(test)
    assert len(found["studies"]["nets"]) == 4
    assert set(found["studies"]["symmetry"]) == {"built in", "none", "images as data"}
    for name in ("calibration", "error_map", "doubt", "data_size", "nets"):
        assert (out / f"surrogate_{name}.png").read_bytes().startswith(PNG)
    monkeypatch.setattr(studies, "train", lambda *_, **__: pytest.fail("trained again what was kept"))
    evaluate.main(config)
    assert json.loads((out / "evaluation.json").read_text())["studies"] == found["studies"]

    for bad, error in (
        (replace(config, split="none"), "split"),
        (replace(config, out=None), "--out"),
    ):
        with pytest.raises(InvalidParameterError, match=error):
            evaluate.main(bad)
    moon = HopData(data.columns, Configuration(scene=Scene.preset("moon")).as_dict())
    with pytest.raises(DataFileError, match="expected scene"):
        evaluate.main(replace(config, data=dataset.write(tmp_path / "moon.h5", moon)))


def test_study_of_sizes_tests_all_nets_on_the_same_hops() -> None:
    data = closed_form_data(100)
    test = set(map(tuple, data["stretches"][data.split()["test"]]))
    for _, config, hops in studies.cells_of("sizes", data, 10):
        part = data.rows(slice(0, hops))
        trained = part["stretches"][part.split(config.validation, config.test)["train"]]
        assert not test & set(map(tuple, trained))
    assert studies.cells_of("sizes", data, 10)[-1][2] == len(data)


def test_floor_of_simulated_hops_is_small_and_grows_with_the_step() -> None:
    data = closed_form_data(2)
    brief = HopData(data.columns, Configuration(scene=Scene(duration=0.3, landing="touchdown")).as_dict())
    found = measure_floor(brief, 2)
    assert 0 < found["start moved by 1e-05 m"]["takeoff_velocity_z"] < 0.1
    assert found["roughness over 0.001"]["takeoff_velocity_z"] < found["roughness over 0.06"]["takeoff_velocity_z"]
    varied = HopData(data.columns, Configuration(scene_ranges={"gravity": (1.0, 9.0)}).as_dict())
    with pytest.raises(InvalidParameterError, match="gravity"):
        measure_floor(varied, 2)
