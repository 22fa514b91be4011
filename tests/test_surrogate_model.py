"""The surrogate: exact symmetry, checkpoints, learning of a known map, and the symmetry of the simulator itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate import model
from surrogate.correction import fit_correction
from surrogate.dataset import COLUMNS, Configuration, HopData, split_share
from surrogate.generate import sample_stretches
from surrogate.model import OUTPUTS, HopNet, NetConfig
from surrogate.scores import rmse, spread
from surrogate.train import TrainConfig, train
from tensegrity_gym import Lattice, Scene, simulate
from tensegrity_gym.errors import DataFileError, InvalidParameterError, InvalidStretchesError

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
    fitted = fit_correction(net, data, 0.1, 0.1)
    assert fitted is not None
    correction, scale = fitted
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
    assert fit_correction(net, data.rows(slice(0, 1)), 0.1, 0.1) is None


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
    for text, named in ((foreign, "'other'"), ("{}", "format"), ("[]", "format"), ("{", "readable JSON")):
        path.with_suffix(".json").write_text(text)
        with pytest.raises(DataFileError, match=named):
            model.load(path)
    with pytest.raises(DataFileError, match="readable JSON"):
        model.load(tmp_path / "absent.safetensors")
