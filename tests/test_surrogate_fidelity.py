"""Fidelities in hop files: recorded, told apart, checked, reported; files from before there were any."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate import dataset, generate
from surrogate.check import check
from surrogate.dataset import Configuration, HopData
from surrogate.generate import GenerateConfig, configuration_of
from surrogate.report import report
from surrogate.storage import hash_of
from tensegrity_gym import HopStatus, Scene
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tensegrity_gym.fidelity import FIDELITIES, Fidelity

SHORT = Scene(duration=0.01)
FLIGHT = Scene(duration=1.4, landing="touchdown")
ROUGH = Fidelity(bar_segments=2, precision="float32", stop="landing")


def test_the_hash_tells_fidelities_apart_and_names_are_values() -> None:
    made = [Configuration(precision=p) for p in ("float64", "float32")]
    made += [Configuration(fidelity=f) for f in ("reference", ROUGH)]
    assert len({hash_of(c.as_dict()) for c in made}) == 4
    for one, same in ((made[2], FIDELITIES["reference"]), (made[1], Fidelity(precision="float32"))):
        assert one.as_dict() == Configuration(fidelity=same).as_dict()
    assert replace(made[1], fidelity=ROUGH, precision=None).model == ROUGH
    for wrong in ({"fidelity": "perfect"}, {"precision": "float16"}):
        with pytest.raises(InvalidParameterError, match="expected"):
            Configuration(**wrong)


@pytest.mark.parametrize("fidelity", [ROUGH, Fidelity(flight="rigid", bar_softening=10.0)], ids=["rough", "rigid"])
def test_files_of_any_fidelity_are_good_and_say_which(tmp_path: Path, fidelity: Fidelity) -> None:
    configuration = Configuration(scene=FLIGHT, fidelity=fidelity, symmetry=True, node_positions=True, trajectory="full")
    path = tmp_path / "hops.h5"
    generate.fill(path, 6, configuration, progress=False)
    assert check(path) == []
    data = dataset.read(path, expect=configuration)
    stopped = fidelity.stop == "landing"
    assert (np.isnan(data["rest"]) == stopped).all()
    assert np.isfinite(data["landing"]).all()
    assert data.usable.all()
    assert ((data["status"] == HopStatus.STOPPED) == stopped).all()
    assert json.loads(dataset.attributes(path)["fidelity"]) == fidelity.levers()
    assert Fidelity(**data.configuration["fidelity"]) == fidelity
    with pytest.raises(DataFileError, match=r"fidelity: expected .*, got "):
        generate.fill(path, 8, Configuration(scene=FLIGHT), progress=False)
    text = report(path, tmp_path / "report", floor=2).read_text(encoding="utf-8")
    assert ("rest: distance" in text) != stopped
    assert "touchdown: distance" in text


def test_a_rest_that_is_no_number_is_a_fault_where_the_hop_was_followed(tmp_path: Path) -> None:
    path = tmp_path / "hops.h5"
    generate.fill(path, 2, Configuration(scene=replace(FLIGHT, landing="touchdown")), progress=False)
    data = dataset.read(path)
    columns = data.columns | {"rest": data["rest"].copy()}
    columns["rest"][1] = np.nan
    assert any("not finite" in p for p in check(dataset.write(tmp_path / "fault.h5", HopData(columns, data.configuration))))


def test_files_from_before_fidelities_are_read_but_not_continued(tmp_path: Path) -> None:
    path = tmp_path / "hops.h5"
    generate.fill(path, 4, Configuration(scene=SHORT, precision="float32"), progress=False)
    data = dataset.read(path)
    old = {k: v for k, v in data.configuration.items() if k != "fidelity"}
    dataset.write(path, HopData(data.columns, old))
    assert check(path) == []
    assert "STOPPED" not in dataset.columns_of(old)["status"].description
    with pytest.raises(DataFileError, match=r"fidelity: expected {.*}, got None"):
        generate.fill(path, 8, Configuration(scene=SHORT, precision="float32"), progress=False)


def test_commands_choose_fidelities(tmp_path: Path) -> None:
    def model(**options: object) -> Fidelity:
        return configuration_of(GenerateConfig(tmp_path / "hops.h5", hops=1, **options))[0].model  # type: ignore[arg-type]

    assert model() == Fidelity(precision="float32")
    assert model(precision="float64", stop="landing") == Fidelity(stop="landing")
    assert model(fidelity="reference") == FIDELITIES["reference"]
    assert isinstance(model(fidelity="auto", landing="touchdown", tolerance=0.01), Fidelity)
    with pytest.raises(InvalidParameterError, match="another than auto with --ranges"):
        model(fidelity="auto", ranges=("gravity=1:9",))
    with pytest.raises(InvalidParameterError, match="tolerance: expected only with"):
        model(tolerance=0.01)
    with pytest.raises(InvalidParameterError, match="fidelity: expected"):
        model(fidelity="perfect")
