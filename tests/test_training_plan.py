"""From a checkpoint and its hops to a planner: the command, what it prints, and what it refuses."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate import dataset, generate, model
from surrogate.dataset import Configuration, HopData
from surrogate.kriging import Kriging
from surrogate.model import NetConfig
from surrogate.symmetry import with_images
from surrogate.train import train
from tensegrity_gym import Design, HopStatus, Scene
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.scene_ranges import scene_ranges
from tests.test_surrogate_model import LATTICE, QUICK, closed_form_data
from training import __main__ as command_line
from training import plan
from training.inverse import InverseConfig
from training.plan import PlanCommand, ask, planner_of, simulator_of, varied_planner_of
from training.similarity import alike_data

POOL = InverseConfig(pool=512)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hops of a closed form, and a net trained on them."""
    folder = tmp_path_factory.mktemp("plan")
    data = closed_form_data(400)
    columns = data.columns | {"stored_energy": 10 - 3 * data["stretches"].mean(axis=1)}
    path = dataset.write(folder / "hops.h5", HopData(columns, data.configuration))
    net, card = train(dataset.read(path), QUICK, progress=False)
    model.save(net, folder / "net.safetensors", card)
    return folder


def command(folder: Path, *arguments: str) -> list[str]:
    return ["training", "plan", str(folder / "net.safetensors"), str(folder / "hops.h5"), *arguments]


def real(stretches: np.ndarray) -> np.ndarray:
    """Where hops of the closed form land (n, 2) [m]."""
    centred = (stretches - 0.5) / 0.3
    cells = LATTICE.cells - LATTICE.cells.mean(axis=0)
    return 0.4 * (centred @ cells) * (1 - 0.3 * centred.mean(axis=1, keepdims=True))


def test_command_says_where_each_target_is_met_and_which_is_out_of_reach(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        sys, "argv", command(folder, "--target", "0.1", "0.05", "--target", "-0.2", "-3e-2", "--target", "9", "0")
    )
    assert command_line.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[::2][:3] == ["target (0.1000, 0.0500) m", "target (-0.2000, -0.0300) m", "target (9.0000, 0.0000) m"]
    assert ["out of reach" in line for line in lines[1:6:2]] == [False, False, True]
    assert lines[6].startswith("planner of 400 hops made in")

    monkeypatch.setattr(sys, "argv", command(folder, "--target", "0.1", "0.05", "--target", "9", "0", "--json"))
    assert command_line.main() == 0
    near, far = json.loads(capsys.readouterr().out)
    assert near["target"] == [0.1, 0.05]
    assert (near["reachable"], far["reachable"]) == (True, False)
    assert np.linalg.norm(real(np.array([near["stretches"]]))[0] - near["target"]) < 3 * near["error"] < 0.06
    np.testing.assert_allclose(near["landing"], near["target"], atol=0.01)
    assert "simulated" not in near


def test_command_simulates_hops_in_turn_as_the_file_was_made(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = []

    def simulator(data: HopData, *_: object) -> plan.Land:
        made.append(data.configuration)
        return lambda stretches: real(stretches) + 0.02  # which the net knows nothing of

    monkeypatch.setattr(plan, "simulator_of", simulator)
    config = PlanCommand(folder / "net.safetensors", folder / "hops.h5", ((0.1, 0.05), (0.2, 0.0)), tries=8, json=True)
    plan.main(config)
    for answer in json.loads(capsys.readouterr().out):
        simulated = answer["simulated"]
        assert (
            simulated["error"] < 1e-3 < 0.02 < np.linalg.norm(real(np.array([answer["stretches"]]))[0] + 0.02 - answer["target"])
        )
        np.testing.assert_allclose(simulated["landing"], real(np.array([simulated["stretches"]]))[0] + 0.02)
        assert simulated["error"] == pytest.approx(np.linalg.norm(np.subtract(simulated["landing"], answer["target"])))
    assert made == [dataset.read(folder / "hops.h5").configuration]
    plan.main(replace(config, json=False))
    assert capsys.readouterr().out.count("best of 8 in turn") == 2


def test_hops_of_which_none_flies_are_said_to(folder: Path) -> None:
    net, card = model.load(folder / "net.safetensors")
    planner = planner_of(net, card, dataset.read(folder / "hops.h5"), config=POOL)
    (answer,) = ask(planner, np.array([(0.1, 0.0)]), lambda s: np.full((len(s), 2), np.nan), 3)
    assert answer["simulated"]["landing"] is None
    assert "none of 3 hops flew" in plan.text_of(answer)
    json.dumps(answer, allow_nan=False)


def test_planner_stores_every_usable_hop_and_knows_it_by_heart(folder: Path) -> None:
    net, card = model.load(folder / "net.safetensors")
    data = dataset.read(folder / "hops.h5")
    status = np.where(np.arange(len(data)) < 10, HopStatus.UNSTABLE, data["status"])
    some = HopData(data.columns | {"status": status}, data.configuration)
    whole, part = (planner_of(net, card, hops, config=POOL) for hops in (data, some))
    images = len(net.permutations)
    assert len(whole.pool) == images * (POOL.pool + len(data))
    assert len(part.pool) == len(whole.pool) - images * 10
    assert len(np.unique(whole.pool.numpy(), axis=0)) == len(whole.pool)  # no hop is a start twice
    # where a hop is stored, of whatever split, its landing is known: there is next to no doubt about it
    spread, stored = whole.pool[::images][: POOL.pool], whole.pool[::images][POOL.pool :]  # images follow each
    for rows in data.split().values():
        mean, variance = whole.see(stored[rows])
        np.testing.assert_allclose(mean.numpy(), data["landing"][rows], atol=2e-3)
        assert variance.max() < 0.05 * whole.see(spread)[1].mean()


def test_foreign_hops_scenes_and_cards_are_named(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    net, card = model.load(folder / "net.safetensors")
    data = dataset.read(folder / "hops.h5")
    for name, other in (
        ("scene", Configuration(scene=Scene.preset("moon"))),
        ("fidelity", Configuration(fidelity="flown")),
        ("design", Configuration(design=Design(bar_length=0.5))),
        ("scene_ranges", Configuration(scene_ranges={"gravity": (1.0, 9.0)})),
    ):
        with pytest.raises(DataFileError, match=f"their.h5: expected {name} .* trained on"):
            planner_of(net, card, HopData(data.columns, other.as_dict()), where="their.h5")
    planner_of(net, card, HopData(data.columns, Configuration(seed=3).as_dict()), config=POOL)  # other hops of the same kind
    with pytest.raises(DataFileError, match="surrogate train"):
        planner_of(net, {"configuration": data.configuration}, data)
    with pytest.raises(InvalidParameterError, match="all of one"):
        planner_of(net, card, data, at={"gravity": 3.7})
    failed = HopData(data.columns | {"status": np.full(len(data), HopStatus.UNSTABLE)}, data.configuration)
    with pytest.raises(InvalidParameterError, match="got none of 400"):
        planner_of(net, card, failed)
    config = PlanCommand(folder / "net.safetensors", folder / "hops.h5")
    for bad, said in (
        (config, "--target 0.10 0.05"),
        (replace(config, target=((np.nan, 0.0),)), "finite"),
        (replace(config, target=((0.1, 0.0),), tries=-1), "tries"),
        (replace(config, target=((0.1, 0.0),), at=("gravity",)), "gravity=3.7"),
    ):
        with pytest.raises(InvalidParameterError, match=said):
            plan.main(bad)
    moon = dataset.write(tmp_path / "moon.h5", HopData(data.columns, Configuration(scene=Scene.preset("moon")).as_dict()))
    monkeypatch.setattr(sys, "argv", ["training", "plan", str(folder / "net.safetensors"), str(moon), "--target", "0.1", "0"])
    assert command_line.main() == 1


def test_simulated_hops_repeat_those_of_the_file_bit_by_bit(tmp_path: Path) -> None:
    """Scene, design, lattice, fidelity and time step are the file's own, and where scenes vary that of the question."""
    odd = Configuration(
        design=Design(fitting_mass=8e-3),
        scene=Scene.preset("mars", duration=0.06),
        fidelity=Fidelity(precision="float32"),
        dt=1.5e-5,
    )
    data = generate.generate(tmp_path / "odd.h5", 3, odd, progress=False)
    np.testing.assert_array_equal(simulator_of(data)(data["stretches"]), data["landing"])
    ranges = {"friction": (0.3, 0.8), "gravity": (1.6, 9.81)}
    varied = Configuration(scene=Scene(duration=0.06), fidelity="single", scene_ranges=ranges, hops_per_scene=2)
    data = generate.generate(tmp_path / "varied.h5", 4, varied, progress=False)
    for rows in (slice(0, 2), slice(2, 4)):
        part = data.rows(rows)
        at = {name: float(part[f"scene_{name}"][0]) for name in ranges}
        np.testing.assert_array_equal(simulator_of(data, at)(part["stretches"]), part["landing"])


VARYING = Configuration(scene_ranges={"gravity": (2.0, 8.0), "friction": (0.3, 0.8)})


def varied_data(hops: int) -> HopData:
    """Hops of the closed form whose landings go as one over gravity, whatever the friction."""
    flat, rng = closed_form_data(hops), np.random.default_rng(0)
    gravity, friction = rng.uniform(2.0, 8.0, hops), rng.uniform(0.3, 0.8, hops)
    columns = flat.columns | {"scene_gravity": gravity, "scene_friction": friction}
    columns["landing"] = flat["landing"] * 4.0 / gravity[:, None]
    return HopData(columns, VARYING.as_dict())


def test_hops_of_scenes_that_vary_are_planned_in_the_one_asked_for(tmp_path: Path) -> None:
    data, flat, rng = varied_data(1200), closed_form_data(1200), np.random.default_rng(0)
    net, card = train(data, replace(QUICK, net=NetConfig(hidden=(32, 32), members=2), epochs=300), progress=False)
    targets = np.array([(0.1, 0.05), (-0.05, 0.1)])
    errors = []
    for g in (2.5, 6.0):
        planner = planner_of(net, card, data, at={"friction": 0.5, "gravity": g}, config=POOL)
        plans = planner.plan(targets)
        assert plans.reachable.all()
        errors.append(np.linalg.norm(real(plans.stretches) * 4.0 / g - targets, axis=1))
    assert np.max(errors) < 0.02
    # a planner of all scenes answers as that of each, whatever comes with it
    seen = np.array([(*target, g, 0.5) for g in (2.5, 6.0) for target in targets])
    of_all = varied_planner_of(net, card, data, config=POOL).predict(seen)[0]
    found = np.linalg.norm(real(of_all) * 4.0 / seen[:, 2:3] - seen[:, :2], axis=1)
    np.testing.assert_allclose(found, np.concatenate(errors), atol=1e-4)
    for at, said in (
        (None, "friction from 0.3 to 0.8"),
        ({"gravity": 3.0}, "friction in"),
        ({"friction": 0.5, "gravity": 9.0}, "trained"),
    ):
        with pytest.raises(InvalidParameterError, match=said):
            planner_of(net, card, data, at=at)
    alike = alike_data(data, scene_ranges(dict(VARYING.scene_ranges)))
    net, card = train(alike, replace(QUICK, net=NetConfig(hidden=(32, 32), members=2), epochs=300), progress=False)
    answers = varied_planner_of(net, card, alike, config=POOL).predict(seen)[0]  # asked in metres all the same
    assert np.linalg.norm(real(answers) * 4.0 / seen[:, 2:3] - seen[:, :2], axis=1).max() < 0.02
    with pytest.raises(InvalidParameterError, match="varied_planner_of"):
        planner_of(net, card, alike, at={"friction": 0.5, "gravity": 3.0})
    with pytest.raises(DataFileError, match="expected lengths 'as on Earth'"):  # a net of the comparison, and a file in metres
        planner_of(net, card, data, at={"friction": 0.5, "gravity": 3.0})
    tilted = replace(VARYING, scene_ranges={"restitution": (0.0, 0.5)})
    bouncing = HopData(flat.columns | {"scene_restitution": rng.uniform(0.0, 0.5, 1200)}, tilted.as_dict())
    net, card = train(bouncing, replace(QUICK, epochs=1), progress=False)
    with pytest.raises(InvalidParameterError, match="restitution"):
        planner_of(net, card, bouncing, at={"restitution": 0.2})


def test_planner_of_scenes_that_vary_wants_a_net_of_them(folder: Path) -> None:
    net, card = model.load(folder / "net.safetensors")
    with pytest.raises(InvalidParameterError, match="scenes that vary"):
        varied_planner_of(net, card, dataset.read(folder / "hops.h5"))


def test_stored_images_of_hops_are_remembered_once(folder: Path) -> None:
    """A net that knows the symmetries brings images back by itself: a file that holds them plans as one that does not."""
    net, card = model.load(folder / "net.safetensors")
    data = dataset.read(folder / "hops.h5")
    whole = with_images(data, Configuration(symmetry=True))
    assert len(whole) == 4 * len(data)
    plain, doubled = (planner_of(net, card, hops, config=POOL) for hops in (data, whole))
    for planner in (plain, doubled):
        assert isinstance(planner.correction, Kriging)
    np.testing.assert_array_equal(doubled.pool, plain.pool)
    np.testing.assert_array_equal(doubled.correction.stretches, plain.correction.stretches)
    assert doubled.correction.scale == plain.correction.scale
