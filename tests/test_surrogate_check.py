"""``check`` finds every fault that is put into a file: flipped bits, cuts, and columns that physics forbids."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surrogate import dataset, generate
from surrogate.check import CheckConfig, check, main
from surrogate.dataset import Configuration, HopData
from surrogate.rules import violations
from tensegrity_gym import HopStatus, Scene
from tensegrity_gym.errors import DataFileError
from tensegrity_gym.events import flew

# long enough for a whole flight on Earth
CONFIGURATION = Configuration(scene=Scene(duration=1.3), seed=4, precision="float32")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("good") / "hops.h5"
    generate.fill(path, 16, CONFIGURATION, progress=False)
    return path


def test_good_files_pass(good: Path) -> None:
    assert check(good) == []
    main(CheckConfig((good,)))
    flown = flew(dataset.read(good)["status"])
    assert flown.all()  # so that the rules of flight have been asked


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize(
    "scene", [Scene(duration=0.02), Scene.preset("slope", duration=1.2), Scene.preset("earth", restitution=0.3, duration=1.2)]
)
def test_good_files_of_other_scenes_pass(tmp_path: Path, scene: Scene, precision: str) -> None:
    generate.fill(tmp_path / "hops.h5", 5, Configuration(scene=scene, precision=precision), progress=False)
    assert check(tmp_path / "hops.h5") == []


def test_every_flipped_bit_is_found(good: Path, tmp_path: Path) -> None:
    whole, path, rng = good.read_bytes(), tmp_path / "flipped.h5", np.random.default_rng(1)
    for place in [0, 100, 511, 512, len(whole) - 1, *rng.integers(0, len(whole), 60).tolist()]:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        assert any("seal" in problem for problem in check(path)), place


def test_every_cut_is_found(good: Path, tmp_path: Path) -> None:
    whole, path = good.read_bytes(), tmp_path / "cut.h5"
    for size in (0, 1, 511, 512, 700, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert check(path)
        with pytest.raises(DataFileError):
            main(CheckConfig((path,)))


def test_flipped_column_is_found_without_the_seal(good: Path, tmp_path: Path) -> None:
    """What reading alone must see: a change of the least bit of any value."""
    data = dataset.read(good)
    for name, values in data.columns.items():
        path = tmp_path / f"{name}.h5"
        path.write_bytes(good.read_bytes())
        changed = values.copy()
        bits = changed.reshape(-1).view("u1")
        bits[8 * (bits.size // 16)] ^= 1
        with h5py.File(path, "r+") as file:
            file[name][...] = changed
        with pytest.raises(DataFileError, match=rf"column {name}: checksum of chunks \[0\]"):
            dataset.read(path)


def change(name: str, by: Callable[[np.ndarray], None]) -> Callable[[dict[str, np.ndarray]], None]:
    def fault(columns: dict[str, np.ndarray]) -> None:
        by(columns[name])

    return fault


def put(place: object, value: object) -> Callable[[np.ndarray], None]:
    return lambda values: values.__setitem__(place, value)


def add(place: object, value: float) -> Callable[[np.ndarray], None]:
    return lambda values: values.__setitem__(place, values[place] + value)


def swap_times(columns: dict[str, np.ndarray]) -> None:
    a, b = columns["takeoff_time"], columns["touchdown_time"]
    a[3], b[3] = b[3], a[3]


#: A fault of each kind, as columns that were wrong before they were written: checksums and seal are those of the fault.
FAULTS: dict[str, tuple[Callable[[dict[str, np.ndarray]], None], str]] = {
    "nan": (change("apex", put(2, np.nan)), "not finite"),
    "infinite": (change("rest", put((2, 1), np.inf)), "not finite"),
    "doubled": (change("index", put(5, 4)), "doubled"),
    "shuffled": (change("index", put([5, 6], [6, 5])), "ascending"),
    "image": (change("image", put(5, 1)), "symmetries"),
    "stretch": (change("stretches", put((0, 0), 0.9)), "out of range"),
    "leak": (change("split_share", put(1, 0.95)), "split_share"),
    "residual": (change("residual", put(1, 1.0)), "equilibrium"),
    "negative energy": (change("stored_energy", put(1, -1.0)), "negative"),
    "iterations": (change("iterations", put(1, -1)), "negative"),
    "status": (change("status", put(1, 9)), "HopStatus"),
    "lost flight": (change("status", put(1, int(HopStatus.UNSTABLE))), "where there is none"),
    "times": (swap_times, "out of order"),
    "too long": (change("end_time", put(1, 9.0)), "past the duration"),
    "flight time": (change("flight_time", add(1, 1e-3)), "flight_time"),
    "steps": (change("steps", add(1, 500)), "steps"),
    "landing": (change("landing", add((1, 0), 1e-6)), "scene.landing"),
    "nodes": (change("touchdown_nodes", add((1, 0), 2.0)), "out of the lattice"),
    "energy": (change("energies", add((1, 2, 0), 2.0)), "not constant"),
    "regained": (change("energies", lambda e: e.__setitem__((1, slice(1, None), 6), -e[1, 1:, 6])), "undone"),
    "still": (change("energies", lambda e: e.__setitem__((1, 1, 3), 0.0)), "kinetic"),
    "no parabola": (change("takeoff_velocity", add((1, 2), 0.05)), "free flight"),
    "apex": (change("apex", add(1, 0.01)), "free flight"),
}


SLOPES: dict[str, Configuration] = {
    "a slope": Configuration(scene=Scene.preset("slope", slope_direction=0.7, duration=1.3, landing="touchdown")),
    "slopes": Configuration(scene=Scene(duration=1.3), scene_ranges={"slope": (0.0, 0.4), "slope_direction": (-3.0, 3.0)}),
    "far": Configuration(scene=Scene(gravity=3.7, slope=0.3, slope_direction=-2.0, duration=3.0), precision="float32"),
}


@pytest.mark.parametrize("where", SLOPES)
def test_free_flight_is_asked_for_on_slopes_too(tmp_path: Path, where: str) -> None:
    """Good files pass; each quantity that the parabola ties to the others is missed when it is changed by a centimetre."""
    generate.fill(tmp_path / "hops.h5", 20, SLOPES[where], progress=False)
    assert check(tmp_path / "hops.h5") == []
    data = dataset.read(tmp_path / "hops.h5")
    assert flew(data["status"]).all()
    slope = data.columns.get("scene_slope", np.full(20, SLOPES[where].scene.slope))
    row = int(slope.argmax())
    falls = -data["takeoff_velocity"][row, 2] + 9.8 * data["flight_time"][row]
    faults: tuple[tuple[str, Any, float], ...] = (
        ("apex", row, 0.01),
        ("touchdown", (row, slice(None)), 0.05),  # times the tangent of the slope
        ("takeoff_velocity", (row, 0), 0.05),
        ("takeoff_velocity", (row, 1), 0.05),
        ("takeoff_velocity", (row, 2), 0.05),
        ("flight_time", row, 0.01 / falls),
        ("energies", (row, 1, 4), 0.3),
    )
    for name, place, change in faults:
        columns = dict(data.columns) | {name: data[name].copy()}
        columns[name][place] += change
        said = [what for what, *_ in violations(HopData(columns, data.configuration))]
        assert any("free flight" in what for what in said), (name, place)


@pytest.mark.parametrize("name", FAULTS)
def test_every_wrong_column_is_found(good: Path, tmp_path: Path, name: str) -> None:
    data = dataset.read(good)
    columns = {k: v.copy() for k, v in data.columns.items()}
    fault, said = FAULTS[name]
    fault(columns)
    problems = check(dataset.write(tmp_path / "fault.h5", HopData(columns, data.configuration)))
    assert any(said in problem for problem in problems), problems


def test_every_column_has_a_fault_that_is_found(good: Path, tmp_path: Path) -> None:
    """Shapes, types, units, meanings, attributes: each missing or changed one is named."""

    def damage(path: Path, by: Callable[[h5py.File], None]) -> list[str]:
        path.write_bytes(good.read_bytes())
        with h5py.File(path, "r+") as file:
            by(file)
        with open(path, "r+b") as raw:  # sealed anew: the seal is not what must find these
            seal = dataset.seal_of(path)
            raw.write(seal)
        return check(path)

    path = tmp_path / "damaged.h5"
    for name in dataset.COLUMNS:
        assert damage(path, lambda f, name=name: f.__delitem__(name)), name
        assert damage(path, lambda f, name=name: f[name].attrs.__setitem__("unit", "furlong")), name
        assert damage(path, lambda f, name=name: f[name].attrs.__delitem__("description")), name
        assert damage(path, lambda f, name=name: f.__delitem__(f"checksums/{name}")), name
        assert damage(path, lambda f, name=name: f[name].resize(15, axis=0)), name
    with h5py.File(good) as file:
        names = [n for n in file.attrs if n != "wall_seconds"]
    for name in names:
        assert damage(path, lambda f, name=name: f.attrs.__delitem__(name)), name
    assert damage(path, lambda f: f.create_dataset("more", data=[1.0]))
    configuration = dataset.attributes(good)["configuration"] | {"seed": 5}
    import json

    assert damage(path, lambda f: f.attrs.__setitem__("configuration", json.dumps(configuration)))


@given(hops=st.integers(0, 2500), frames=st.integers(0, 3), seed=st.integers(0, 2**31), cut=st.integers(1, 3000))
@settings(max_examples=8, deadline=None)
def test_round_trip_of_every_schema(
    tmp_path_factory: pytest.TempPathFactory, hops: int, frames: int, seed: int, cut: int
) -> None:
    """Any columns that a configuration may have, in pieces of any size, come back bit by bit and in whole chunks."""
    rng = np.random.default_rng(seed)
    configuration = Configuration(
        content="hops" if seed % 3 else "equilibria",
        scene_ranges={"gravity": (1.0, 9.0)} if seed % 2 else {},
        node_positions=hops < 50,
        trajectory="centre" if hops % 2 else "none",
    ).as_dict()
    schema = dataset.columns_of(configuration)
    shapes = {name: dataset.expected_shape(c, hops, configuration, frames) for name, c in schema.items()}
    columns = {
        name: (rng.normal(size=shape) * 10.0 ** rng.integers(-30, 30)).astype(schema[name].dtype)
        if schema[name].dtype[0] == "f"
        else rng.integers(-100, 100, size=shape).astype(schema[name].dtype)
        for name, shape in shapes.items()
    }
    data = HopData(columns, configuration)
    path = tmp_path_factory.mktemp("data") / "hops.h5"
    parts = [data.rows(slice(k, k + cut)) for k in range(0, hops, cut)]
    dataset.write_blocks(path, configuration, parts)
    back = dataset.read(path, content=None)
    for name, values in columns.items():
        assert back[name].dtype == values.dtype
        if hops:
            assert back[name].tobytes() == values.tobytes()
    assert back.configuration == configuration
    assert dataset.attributes(path)["digest"] == (data.digest if hops else back.digest)
    if hops:
        assert dataset.read(path, columns=["stretches"], content=None)["stretches"].tobytes() == columns["stretches"].tobytes()
