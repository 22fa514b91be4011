"""Which hops a file holds: samplers, varied scenes, symmetry images, trajectories."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from surrogate import dataset, generate
from surrogate.check import check
from surrogate.dataset import Configuration
from surrogate.generate import GenerateConfig, configuration_of
from surrogate.sampling import SAMPLERS, read_stretches, scale, stretches_hash, unit_points
from tensegrity_gym import Scene, form_find, simulate
from tensegrity_gym.errors import DataFileError, InvalidParameterError

SHORT = Scene(duration=0.02)


@pytest.mark.parametrize("sampler", ["sobol", "uniform", "lhs", "grid"])
@pytest.mark.parametrize("dimensions", [1, 2, 4, 5])
def test_any_piece_of_a_sequence_is_that_piece(sampler: str, dimensions: int) -> None:
    size = {"lhs": 64, "grid": 3}.get(sampler, 0)
    total = min(64, 3**dimensions if sampler == "grid" else 64)
    whole = unit_points(sampler, 0, total, 7, dimensions, size)
    assert whole.shape == (total, dimensions)
    assert (whole >= 0).all()
    assert (whole <= 1).all()
    for first, last in ((0, 1), (1, total), (total // 2, total // 2 + 1), (0, total)):
        assert np.array_equal(unit_points(sampler, first, last, 7, dimensions, size), whole[first:last])


def test_samplers_are_what_they_are_called() -> None:
    cube = unit_points("lhs", 0, 50, 3, 4, 50)
    assert all(np.array_equal(np.sort(np.floor(cube[:, k] * 50)), np.arange(50)) for k in range(4))
    grid = scale(unit_points("grid", 0, 81, 0, 4, 3))
    assert {tuple(row) for row in np.round(grid, 9)} == {
        (a, b, c, d) for a in (0.2, 0.5, 0.8) for b in (0.2, 0.5, 0.8) for c in (0.2, 0.5, 0.8) for d in (0.2, 0.5, 0.8)
    }
    assert not np.array_equal(unit_points("uniform", 0, 4, 1, 4), unit_points("uniform", 0, 4, 2, 4))
    with pytest.raises(InvalidParameterError, match="expected one of"):
        Configuration(sampler="halton")
    assert set(SAMPLERS) == {"sobol", "uniform", "lhs", "grid", "file"}


def test_stretches_from_a_file(tmp_path: Path) -> None:
    stretches = np.random.default_rng(0).uniform(0.2, 0.8, (5, 4))
    np.save(tmp_path / "s.npy", stretches)
    np.savetxt(tmp_path / "s.csv", stretches, delimiter=",", fmt="%.17g")
    for name in ("s.npy", "s.csv"):
        assert np.array_equal(read_stretches(tmp_path / name), stretches)
    configuration, found, hops = configuration_of(
        GenerateConfig(tmp_path / "hops.h5", stretches=tmp_path / "s.npy", duration=0.01)
    )
    assert (configuration.sampler, configuration.sampler_size, hops) == ("file", 5, 5)
    assert configuration.stretches_hash == stretches_hash(stretches)
    data = generate.generate(tmp_path / "hops.h5", 5, configuration, chunk=2, stretches=found, progress=False)
    assert np.array_equal(data["stretches"], stretches)
    with pytest.raises(InvalidParameterError, match="at most 5 points"):
        generate.fill(tmp_path / "hops.h5", 6, configuration, stretches=found, progress=False)
    with pytest.raises(InvalidParameterError, match="whose hash"):
        generate.fill(tmp_path / "hops.h5", 5, configuration, stretches=stretches[::-1], progress=False)
    (tmp_path / "bad.csv").write_text("0.1,0.5,0.5,0.5\n")
    with pytest.raises(DataFileError, match=r"stretches in \[0.2, 0.8\]"):
        read_stretches(tmp_path / "bad.csv")


def test_files_without_stretches_or_of_another_shape_are_named(tmp_path: Path) -> None:
    for name in ("none.csv", "none.txt"):
        (tmp_path / name).write_text("# a heading alone\n")
        with pytest.raises(DataFileError, match=rf"{name}: expected stretches of one hop at least, got none"):
            read_stretches(tmp_path / name)
    (tmp_path / "cut.npy").write_bytes(b"")
    np.save(tmp_path / "none.npy", np.zeros((0, 4)))
    for name, said in (("cut.npy", "one hop a line"), ("none.npy", "got none")):
        with pytest.raises(DataFileError, match=f"{name}.*{said}"):
            read_stretches(tmp_path / name)
    for shape in ((2, 4, 3), (2, 3), (1, 4, 1, 1), ()):
        np.save(tmp_path / "bad.npy", np.full(shape, 0.5))
        with pytest.raises(DataFileError, match=r"expected \(n, 4\) stretches.*got shape .*; reshape"):
            read_stretches(tmp_path / "bad.npy")
    (tmp_path / "column.txt").write_text("0.3\n0.4\n0.5\n0.6\n")  # four hops of one stretch each, not one of four
    with pytest.raises(DataFileError, match=r"got shape \(4, 1\)"):
        read_stretches(tmp_path / "column.txt")
    np.save(tmp_path / "one.npy", np.full(4, 0.5))
    assert read_stretches(tmp_path / "one.npy").shape == (1, 4)


def test_scenes_vary_in_groups_and_hop_in_their_own(tmp_path: Path) -> None:
    ranges = {"gravity": (1.6, 9.8), "friction": (0.3, 0.8)}
    configuration = Configuration(scene=SHORT, scene_ranges=ranges, hops_per_scene=3)
    data = generate.generate(tmp_path / "a.h5", 8, configuration, chunk=8, progress=False)
    other = generate.generate(tmp_path / "b.h5", 8, configuration, chunk=4, progress=False)  # chunks that cut a group
    assert data.digest == other.digest
    assert check(tmp_path / "a.h5") == []
    for name, (low, high) in ranges.items():
        values = data[f"scene_{name}"]
        assert ((values >= low) & (values <= high)).all()
        assert [len(set(values[k : k + 3])) for k in (0, 3, 6)] == [1, 1, 1]
        assert len(set(values)) == 3
    scene = Scene(gravity=data["scene_gravity"][4], friction=data["scene_friction"][4], duration=0.02)
    alone = simulate(data["stretches"][3:6], scene=scene)
    assert np.array_equal(alone.rest, data["rest"][3:6])
    with pytest.raises(InvalidParameterError, match="scene_ranges"):
        Configuration(scene_ranges={"colour": (0, 1)})
    with pytest.raises(InvalidParameterError, match="gravity"):
        Configuration(scene_ranges={"gravity": (-1.0, 1.0)})


def test_images_are_what_simulation_gives_and_stay_out_of_test_splits(tmp_path: Path) -> None:
    configuration = Configuration(scene=Scene(duration=0.25), symmetry=True, node_positions=True, trajectory="full")
    data = generate.generate(tmp_path / "hops.h5", 6, configuration, chunk=4, progress=False)
    assert check(tmp_path / "hops.h5") == []
    assert data["index"].tolist() == np.repeat(np.arange(6), 4).tolist()
    assert data["image"].tolist() == [0, 1, 2, 3] * 6
    again = simulate(data["stretches"], scene=configuration.scene, trajectory_rate=60.0)
    assert again.trajectory is not None
    size = np.abs(data["rest"]).max()
    np.testing.assert_allclose(data["rest"], again.rest, atol=1e-4 * size + 1e-6)
    np.testing.assert_allclose(data["takeoff_velocity"], again.takeoff_velocity, atol=1e-3)
    np.testing.assert_allclose(data["apex"], again.apex, atol=1e-4)
    np.testing.assert_allclose(data["node_positions"], again.equilibria.positions[:, :80], atol=1e-5)
    np.testing.assert_allclose(data["trajectory"], again.trajectory.positions, atol=1e-3)
    split = data.split(0.4, 0.3)
    for name in ("validation", "test"):
        assert (data["image"][split[name]] == 0).all()
    kept = [set(data["index"][rows].tolist()) for rows in split.values()]
    assert not any(a & b for a, b in combinations(kept, 2))


def test_slopes_keep_only_the_symmetries_that_keep_gravity() -> None:
    assert Configuration(scene=Scene.preset("slope"), symmetry=True).rows_per_hop == 2
    with pytest.raises(InvalidParameterError, match="symmetry"):
        Configuration(symmetry=True, scene_ranges={"slope": (0.0, 0.1)})


def test_equilibria_alone_continue_the_hops(tmp_path: Path) -> None:
    config = GenerateConfig(tmp_path / "run.h5", hops=3, equilibria=8, duration=0.01, node_positions=True, precision="float64")
    generate.main(config)
    hops = dataset.read(tmp_path / "run.h5")
    more = dataset.read(tmp_path / "run.equilibria.h5", content="equilibria")
    assert more["index"].tolist() == [3, 4, 5, 6, 7]
    assert np.array_equal(np.concatenate([hops["stretches"], more["stretches"]]), generate.sample_stretches(8, 0))
    assert check(tmp_path / "run.equilibria.h5") == []
    found = form_find(more["stretches"])
    assert np.array_equal(more["equilibrium_energy"], found.energy)
    assert np.array_equal(more["node_positions"], found.positions[:, :80].astype("f4"))
    with pytest.raises(DataFileError, match="expected a file of hops, got one of equilibria"):
        dataset.read(tmp_path / "run.equilibria.h5")


def test_centre_trajectory_starts_at_the_start(tmp_path: Path) -> None:
    configuration = Configuration(scene=Scene(duration=0.1), trajectory="centre", trajectory_rate=100.0)
    data = generate.generate(tmp_path / "hops.h5", 2, configuration, progress=False)
    frames = data["frames"][0]
    assert data["trajectory"].shape[2:] == (3,)
    assert frames > 5
    np.testing.assert_allclose(np.diff(data["frame_times"][0, :frames]), 0.01, rtol=0.1)
    assert np.abs(data["trajectory"][0, 0, :2]).max() < 1e-3
    assert check(tmp_path / "hops.h5") == []


def test_shards_of_a_hypercube_are_refused() -> None:
    """Hops 50 to 99 would be those of a hypercube of 100 points, and nothing to put beside one of 50."""
    assert configuration_of(GenerateConfig(Path("hops.h5"), hops=50, sampler="lhs"))[0].sampler_size == 50
    with pytest.raises(InvalidParameterError, match="first: expected 0 with --sampler lhs, got 50"):
        configuration_of(GenerateConfig(Path("hops.h5"), hops=50, first=50, sampler="lhs"))
