"""Planners: known inverses of closed-form maps, the box, unreachable targets, bad input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from maps import arm, throw
from scipy.optimize import minimize
from torch import Tensor

from surrogate import kriging
from surrogate.dataset import HopData
from surrogate.frozen import FrozenLanding
from surrogate.generate import sample_stretches
from surrogate.kriging import Kriging, Scale, fit_kriging
from surrogate.model import HopNet, NetConfig, scene_symmetries
from tensegrity_gym import Lattice, Scene
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tensegrity_gym.scene_ranges import scene_ranges
from training import inverse, refine
from training.evolution import EvolutionConfig, EvolutionPlanner
from training.hops import Hops
from training.inverse import InverseConfig, InversePlanner, fit_energy
from training.planner import BestOfPlanner, NearestHopPlanner, targets_of, with_images
from training.policies import ActorPolicy, _mlp
from training.refine import RefiningPlanner
from training.similarity import Scaling
from training.symmetry import Symmetry
from training.tandem import TandemConfig, TandemPlanner


@pytest.mark.parametrize("reach", [throw, arm])
def test_recovers_inverses_of_closed_form_maps(reach) -> None:
    hidden = torch.from_numpy(sample_stretches(40, 11).astype(np.float32))
    targets = reach(hidden)[0].numpy()
    stretches, _ = InversePlanner(reach).predict(targets)
    landings = reach(torch.from_numpy(stretches.astype(np.float32)))[0].numpy()
    assert np.linalg.norm(landings - targets, axis=1).max() < 1e-3
    assert stretches.min() >= 0.2
    assert stretches.max() <= 0.8


def test_answers_on_the_boundary_of_the_box_are_reached() -> None:
    def linear(stretches: Tensor) -> Tensor:
        return stretches[None, :, :2]

    plans = InversePlanner(linear).plan(np.array([(0.2, 0.8), (0.1, 0.9)]))
    np.testing.assert_allclose(plans.stretches[:, :2], [(0.2, 0.8)] * 2, atol=1e-6)
    # the second target is out of reach: the nearest landing, and said so
    np.testing.assert_allclose(plans.errors, [0.0, np.hypot(0.1, 0.1)], atol=2e-5)
    np.testing.assert_allclose(plans.landings, [(0.2, 0.8)] * 2, atol=1e-6)
    assert plans.reachable.tolist() == [True, False]


def test_a_step_that_rounding_leaves_no_solution_is_damped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two stretches steer landing and doubt: three residuals in two unknowns, whose matrix only the damping makes regular."""
    slope = torch.tensor([(1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0)])

    def residual(stretches: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        return stretches @ slope.T - torch.nn.functional.pad(goal, (0, 1)), slope.expand(len(stretches), 3, 4)

    planner = InversePlanner(lambda s: s[None, :, :2], InverseConfig(damping=1e-12, steps=80))
    monkeypatch.setattr(planner, "_residual", residual)
    plans = planner.plan(np.array([(0.8, 0.7), (0.9, 0.75)]))
    # least squares: (s0 - x)^2 + (s1 - y)^2 + (s0 + s1)^2 is least where s0 = (2x - y) / 3, s1 = (2y - x) / 3
    np.testing.assert_allclose(plans.stretches[:, :2], [(0.3, 0.2), (0.35, 0.2)], atol=1e-3)


def test_a_target_that_doubt_keeps_it_away_from_is_not_called_unreachable() -> None:
    """Two members put x at s0, and differ about y by a variance of 0.01 + 0.08 (s0 - 0.5): it stays 0.04 m short."""

    def doubtful(stretches: Tensor) -> Tensor:
        doubt = torch.sqrt(0.01 + 0.08 * (stretches[:, 0] - 0.5))
        return torch.stack([torch.stack([stretches[:, 0], sign * doubt], dim=-1) for sign in (1.0, -1.0)])

    plans = InversePlanner(doubtful).plan(np.array([(0.5, 0.0), (1.5, 0.0)]))
    np.testing.assert_allclose(plans.landings, [(0.46, 0.0), (0.8, 0.0)], atol=1e-3)
    assert plans.reachable.tolist() == [True, False]  # the first lies within the doubt of 0.08 m, the second beyond 0.18 m


def test_it_leaves_a_stored_hop_as_far_as_pays() -> None:
    """Doubt grows in proportion to the way from a stored hop, the tip of a cone that derivatives do not tell the way off.

    With a linear map J and doubt c a unit of the way x, in each direction, |d - J x|^2 + 2 c^2 |x|^2 is least, by ridge
    regression, at x = J' (J J' + 2 c^2)^-1 d. Errors within 5 % of the least count as equals (``InverseConfig.equal``).
    """
    slope, hop, doubt = np.array([[0.5, -0.3, 0.2, 0.1], [-0.1, 0.4, 0.3, -0.5]]), np.array([0.43, 0.52, 0.47, 0.55]), 0.4

    def landing(stretches: Tensor) -> Tensor:
        return (stretches.double() @ torch.from_numpy(slope.T)).float()[None]

    def correction(stretches: Tensor) -> tuple[Tensor, Tensor]:
        square = ((stretches.double() - torch.from_numpy(hop)) ** 2).sum(dim=-1)
        return torch.zeros(*stretches.shape[:-1], 2), (doubt**2 * square).float()

    apart = np.array([(0.004, 0.0), (0.0, 0.006), (-0.003, 0.004), (0.02, -0.01)])
    best = np.linalg.solve(slope @ slope.T + 2 * doubt**2 * np.eye(2), apart.T).T @ slope
    least = np.sqrt(((best @ slope.T - apart) ** 2).sum(axis=1) + 2 * doubt**2 * (best**2).sum(axis=1))
    planner = InversePlanner(landing, correction=correction, stored=hop[None])
    assert planner.plan(hop @ slope.T + apart).errors == pytest.approx(least, rel=0.05)


def test_beyond_an_arms_length_it_points_at_the_target() -> None:
    directions = np.linspace(-0.6, 0.6, 7)
    targets = 1.3 * np.column_stack([np.cos(directions), np.sin(directions)])
    plans = InversePlanner(arm, InverseConfig(steps=20)).plan(targets)
    assert not plans.reachable.any()
    np.testing.assert_allclose(plans.errors, 0.3, atol=1e-3)  # the arm is 1 m long
    np.testing.assert_allclose(plans.landings, targets / 1.3, atol=0.03)


def test_prefers_stretches_that_the_members_agree_on() -> None:
    def doubtful(stretches: Tensor) -> Tensor:
        """Two members: both put every hop at s0, but for s1 > 0.5 they disagree about y."""
        doubt = torch.relu(stretches[:, 1] - 0.5)
        return torch.stack([torch.stack([stretches[:, 0], sign * doubt], dim=-1) for sign in (1.0, -1.0)])

    stretches, _ = InversePlanner(doubtful).predict(np.array([(0.4, 0.0), (0.6, 0.0)]))
    assert (stretches[:, 1] <= 0.5 + 1e-3).all()


def test_same_question_same_answer_and_single_or_batch() -> None:
    planner = InversePlanner(throw)
    targets = np.array([(0.3, 0.1), (0.2, -0.2)])
    batch, _ = planner.predict(targets)
    assert np.array_equal(batch, planner.predict(targets)[0])
    single, state = planner.predict(targets[0])
    assert single.shape == (4,)
    assert state is None
    np.testing.assert_allclose(single, batch[0], atol=1e-4)


def test_answers_are_the_same_whatever_the_size_of_the_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    planner = InversePlanner(arm)
    targets = arm(torch.from_numpy(sample_stretches(11, 5).astype(np.float32)))[0].numpy()
    whole, proposed = planner.plan(targets), planner.propose(targets, 3)
    monkeypatch.setattr(inverse, "BLOCK", 4)
    for part, wanted in zip(planner.plan(targets), whole, strict=True):
        # products of matrices of another shape may round otherwise, and descents end where float32 does
        np.testing.assert_allclose(part, wanted, atol=1e-3)
    assert planner.propose(targets, 3).shape == proposed.shape == (11, 3, 4)


def test_of_equal_answers_the_one_that_stores_least_energy() -> None:
    def linear(stretches: Tensor) -> Tensor:
        return stretches[None, :, :2]

    def energy(stretches: np.ndarray) -> np.ndarray:
        return 10 - 3 * stretches[:, 2] - 3 * stretches[:, 3] ** 2

    targets = np.random.default_rng(0).uniform(0.3, 0.7, (20, 2))
    anything = InversePlanner(linear, InverseConfig(starts=32))
    frugal = InversePlanner(linear, InverseConfig(starts=32), energy=energy)
    assert frugal.plan(targets).errors.max() < 1e-3
    choices = anything.propose(targets, 8)
    cheapest = energy(choices.reshape(-1, 4)).reshape(20, 8).min(axis=1)
    assert (energy(frugal.plan(targets).stretches) <= cheapest + 1e-6).all()
    # a quadratic is fitted exactly
    stretches = sample_stretches(64, 3)
    np.testing.assert_allclose(fit_energy(stretches, energy(stretches))(choices[0]), energy(choices[0]), atol=1e-9)


def test_proposals_differ_and_best_of_them_is_found_by_simulating() -> None:
    """The surrogate is off by a different shift in each half of the box: only simulating tells which answers are good."""

    def real(stretches: np.ndarray) -> np.ndarray:
        return stretches[:, :2] + 0.05 * (stretches[:, 2:3] > 0.5)

    planner = InversePlanner(lambda s: s[None, :, :2])
    targets = np.random.default_rng(1).uniform(0.3, 0.7, (12, 2))
    proposed = planner.propose(targets, 8)
    gaps = np.abs(proposed[:, :, None] - proposed[:, None]).max(axis=3) + np.eye(8)
    assert gaps.min() >= 0.01
    best = BestOfPlanner(planner, real, tries=8)
    error = np.linalg.norm(real(best.predict(targets)[0]) - targets, axis=1)
    assert error.max() < 1e-3
    assert best.simulator_calls == 12 * 8
    lost = BestOfPlanner(planner, lambda s: np.where(s[:, 2:3] > 0.5, np.nan, real(s)), tries=8)
    assert (lost.predict(targets)[0][:, 2] <= 0.5).all()  # failed hops are never chosen
    with pytest.raises(InvalidParameterError, match="tries"):
        BestOfPlanner(planner, real, tries=0)


@pytest.mark.parametrize("reach", [throw, arm])
def test_tandem_net_learns_an_inverse(reach) -> None:
    def see(stretches: Tensor) -> tuple[Tensor, Tensor]:
        return reach(stretches)[0], torch.zeros(len(stretches))

    landings = reach(torch.from_numpy(sample_stretches(2000, 3).astype(np.float32)))[0].numpy()
    planner = TandemPlanner(see, landings, TandemConfig(steps=500))
    targets = landings[1000:1100]
    stretches, _ = planner.predict(targets)
    found = reach(torch.from_numpy(stretches.astype(np.float32)))[0].numpy()
    error = np.linalg.norm(found - targets, axis=1)
    assert np.median(error) < 0.03 * np.linalg.norm(landings, axis=1).max()
    np.testing.assert_allclose(planner.predict(targets[0])[0], stretches[0], atol=1e-6)


def test_tandem_net_answers_mirrored_targets_with_mirrored_stretches() -> None:
    permutations, signs = np.array([(0, 1, 2, 3), (1, 0, 3, 2)]), np.array([(1, 1), (1, -1)])

    def see(stretches: Tensor) -> tuple[Tensor, Tensor]:
        y = stretches[:, 0] - stretches[:, 1]
        return torch.stack([stretches[:, 2] + stretches[:, 3], y], dim=1), torch.zeros(len(stretches))

    landings = see(torch.from_numpy(sample_stretches(500, 3)))[0].numpy()
    planner = TandemPlanner(see, landings, TandemConfig(steps=20), permutations=permutations, signs=signs)
    above, below = np.array([(0.9, 0.2)]), np.array([(0.9, -0.2)])
    np.testing.assert_array_equal(planner.predict(above)[0][:, [1, 0, 3, 2]], planner.predict(below)[0])


@pytest.mark.parametrize("reach", [throw, arm])
def test_evolution_recovers_inverses_and_counts_its_calls(reach) -> None:
    pytest.importorskip("cma")

    def land(stretches: np.ndarray) -> np.ndarray:
        return reach(torch.from_numpy(stretches))[0].numpy()

    hidden = sample_stretches(6, 11)
    targets = land(hidden)
    stored = sample_stretches(500, 0)  # near enough that no search begins in a wrong valley
    planner = EvolutionPlanner(land, NearestHopPlanner(stored, land(stored)), EvolutionConfig(evaluations=400))
    stretches, _ = planner.predict(targets)
    assert np.linalg.norm(land(stretches) - targets, axis=1).max() < 1e-3
    assert planner.calls == 6 * 400
    assert stretches.min() >= 0.2
    assert stretches.max() <= 0.8


def test_evolution_leaves_numpys_random_numbers_alone() -> None:
    """cma seeds and draws from NumPy's global generator; that is the user's, also while hops are simulated."""
    pytest.importorskip("cma")
    stretches, targets = sample_stretches(20, 0), np.zeros((2, 2))
    noise: list[float] = []

    def land(asked: np.ndarray) -> np.ndarray:
        noise.append(np.random.rand())  # noqa: NPY002 (the generator that cma uses)
        return asked[:, :2] - 0.5

    planner = EvolutionPlanner(land, NearestHopPlanner(stretches, land(stretches)), EvolutionConfig(evaluations=24))
    answers = []
    for seed in (3, 4):
        drawn = np.random.RandomState(seed).rand(4)
        np.random.seed(seed)  # noqa: NPY002
        noise.clear()
        answers.append(planner.predict(targets)[0])
        assert [*noise, np.random.rand()] == drawn.tolist()  # noqa: NPY002
    assert np.array_equal(*answers)


def test_evolution_answers_with_its_start_where_every_hop_fails() -> None:
    pytest.importorskip("cma")
    stretches, targets = sample_stretches(20, 0), np.array([(0.1, 0.0), (-0.2, 0.1)])
    start = NearestHopPlanner(stretches, stretches[:, :2] - 0.5)
    planner = EvolutionPlanner(lambda asked: np.full((len(asked), 2), np.nan), start, EvolutionConfig(evaluations=24))
    assert np.array_equal(planner.predict(targets)[0], start.predict(targets)[0])
    assert planner.calls == 48


def test_nearest_hop_is_the_nearest() -> None:
    stretches = sample_stretches(50, 0)
    landings = np.random.default_rng(0).normal(size=(50, 2))
    planner = NearestHopPlanner(stretches, landings)
    assert np.array_equal(planner.predict(landings + 1e-9)[0], stretches)
    with pytest.raises(InvalidParameterError, match="at least one"):
        NearestHopPlanner(stretches[:0], landings[:0])


@pytest.mark.parametrize("bad", [np.array((np.nan, 0.0)), np.array(0.3), np.zeros((2, 1)), np.zeros((2, 2, 2))])
def test_targets_that_are_none_are_named(bad: np.ndarray) -> None:
    with pytest.raises(InvalidParameterError, match="targets"):
        targets_of(bad)


def test_actor_round_trip_and_refusals(tmp_path: Path) -> None:
    torch.manual_seed(0)
    actor = ActorPolicy(_mlp([2, 8, 4]), Scaling((0.5,)))
    targets = np.random.default_rng(0).normal(size=(20, 2))
    path = actor.save(tmp_path / "actor.safetensors", {"seed": 0})
    assert np.array_equal(ActorPolicy.load(path).predict(targets)[0], actor.predict(targets)[0])
    assert actor.predict(targets[0])[0].shape == (4,)
    assert (np.abs(actor.predict(1e6 * targets)[0] - 0.5) <= 0.3 + 1e-12).all()
    with pytest.raises(InvalidParameterError, match="observation"):
        actor.predict(np.zeros(5))
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DataFileError, match="checksum"):
        ActorPolicy.load(path)
    path.with_suffix(".json").write_text("{")
    with pytest.raises(DataFileError, match=r"readable JSON.*train it again"):
        ActorPolicy.load(path)
    with pytest.raises(DataFileError, match="found none; see whether"):
        ActorPolicy.load(tmp_path / "absent.safetensors")


def small_net() -> HopNet:
    """An untrained net of the 2x2 lattice on flat ground, with outputs of the size of landings."""
    torch.manual_seed(0)
    net = HopNet(NetConfig(hidden=(8, 8), members=2), *scene_symmetries(Lattice(2, 2), Scene()))
    net.output_scale.copy_(torch.linspace(0.1, 0.9, len(net.output_scale)))
    return net.eval()


def test_frozen_net_lands_where_the_net_does() -> None:
    net = small_net()
    stretches = torch.from_numpy(sample_stretches(50, 1).astype(np.float32))
    with torch.no_grad():
        torch.testing.assert_close(FrozenLanding(net)(stretches), net.landing(stretches), rtol=0, atol=1e-6)


def test_frozen_net_of_varied_scenes_lands_where_the_net_does_and_refuses_others() -> None:
    torch.manual_seed(0)
    ranges = {"gravity": (1.6, 9.81), "friction": (0.3, 0.8)}
    net = HopNet(NetConfig(hidden=(8, 8), members=2), *scene_symmetries(Lattice(2, 2), Scene()), Scene(), ranges).eval()
    stretches = torch.from_numpy(sample_stretches(50, 1).astype(np.float32))
    scenes = torch.rand(50, 2) * torch.tensor([8.0, 0.5]) + torch.tensor([1.7, 0.3])  # gravity, friction: the envs' order
    landing = FrozenLanding(net, ("gravity", "friction"))
    with torch.no_grad():
        wanted = net.landing(stretches, scenes.flip(1))  # the net's own order is the alphabet's
        torch.testing.assert_close(landing(stretches, scenes), wanted, rtol=0, atol=1e-6)
        bound = landing.at(scenes[7].numpy())(stretches)
        torch.testing.assert_close(bound[:, 7], wanted[:, 7], rtol=0, atol=1e-6)
        torch.testing.assert_close(bound, net.landing(stretches, scenes[7].flip(0)), rtol=0, atol=1e-6)
    with pytest.raises(InvalidParameterError, match="scene"):
        landing(stretches)
    with pytest.raises(InvalidParameterError, match="slope"):
        FrozenLanding(HopNet(NetConfig(hidden=(8,)), *scene_symmetries(Lattice(2, 2), Scene()), Scene(), {"slope": (0.0, 0.1)}))


def rough_data(net: HopNet, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stretches, landings that the net misses by waves of 5 mm, as equivariant as it is, and these residuals."""
    stretches = sample_stretches(count, seed)
    with torch.no_grad():
        smooth = net.landing(torch.from_numpy(stretches.astype(np.float32))).mean(dim=0).numpy()
    images = stretches[:, net.permutations.numpy()]
    wave = np.stack([np.sin(30 * images[..., 0]), np.cos(25 * images[..., 1])], axis=2)
    residual = 0.005 * (wave * net.signs[:, :2].numpy()).mean(axis=1)
    return stretches, smooth + residual, residual


def test_kriging_says_the_same_whatever_the_size_of_its_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    images = np.array([[0, 1, 2, 3], [1, 0, 3, 2]]), np.array([[1.0, 1.0], [-1.0, 1.0]])
    process = Kriging(rng.uniform(0.2, 0.8, (40, 4)), rng.normal(size=(40, 2)), *images, Scale(0.2, 1e-3, 1.0, 0.0))
    for shape in ((11, 4), (11, 3, 4)):
        at = rng.uniform(0.2, 0.8, shape)
        whole = process.shift(at)
        with monkeypatch.context() as patch:
            patch.setattr(kriging, "BLOCK", 4)
            for part, wanted in zip(process.shift(at), whole, strict=True):
                np.testing.assert_array_equal(part, wanted)
                assert part.shape[: len(shape) - 1] == shape[:-1]


def test_kriging_finds_what_the_net_misses_and_knows_how_well() -> None:
    net = small_net()
    stretches, landings, residuals = rough_data(net, 3000, 0)
    columns = {
        "index": np.arange(3000),
        "image": np.zeros(3000),
        "stretches": stretches,
        "landing": landings,
        "split_share": np.random.default_rng(0).random(3000),
        "status": np.zeros(3000, dtype=int),
    }
    process = fit_kriging(net, HopData(columns, {}), 0.1, 0.0)
    assert process is not None
    at, _, missed = rough_data(net, 500, 99)
    shift, variance = process(torch.from_numpy(at.astype(np.float32)))
    left = missed - shift.numpy()
    assert np.sqrt((left**2).mean()) < 0.3 * np.sqrt((missed**2).mean())
    assert np.sqrt(variance.mean().item()) == pytest.approx(np.sqrt((left**2).mean()), rel=0.3)
    # at a stored hop, and at its image under a symmetry, there is next to nothing left to doubt
    known, doubt = process(torch.from_numpy(stretches[:20].astype(np.float32)))
    np.testing.assert_allclose(known.numpy(), residuals[:20], atol=2e-4)
    assert doubt.max() < 0.1 * variance.mean()
    permutation, sign = net.permutations[1].numpy(), net.signs[1, :2].numpy()
    image, _ = process(torch.from_numpy(stretches[:20][:, permutation].astype(np.float32)))
    np.testing.assert_allclose(image.numpy(), sign * known.numpy(), atol=2e-4)
    # close stretches may share the first one's neighbours: nothing changes for it, and for the others less than is in doubt
    groups = torch.from_numpy(np.stack([at[:50], at[:50] + 1e-4], axis=1).astype(np.float32))
    together, each = process(groups)[0], process(groups.reshape(-1, 4))[0].reshape(50, 2, 2)
    torch.testing.assert_close(together[:, 0], each[:, 0], rtol=0, atol=1e-7)
    assert ((together - each)[:, 1].abs().max(dim=1).values < variance[:50].sqrt()).all()
    few = HopData({k: v[:3] for k, v in columns.items()}, {})
    assert fit_kriging(net, few, 0.0, 0.0) is None


@pytest.mark.parametrize("length", [0.05, 0.4])
def test_doubt_at_a_stored_hop_is_the_floor_whatever_the_length_scale(length: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A long one goes with a large variance far from all hops; a floor taken for the same share of that was ten times itself."""
    monkeypatch.setattr(kriging, "LENGTHS", (length,))
    net = small_net()
    stretches, _, residuals = rough_data(net, 1000, 0)
    images = net.permutations.numpy(), net.signs[:, :2].numpy().astype(np.float64)
    split = {"train": np.arange(900), "validation": np.arange(900, 1000)}
    floor = 3e-4
    process = kriging.fit_process(stretches, residuals, images, split, floor)
    assert process is not None
    assert process.scale.sigma * np.sqrt(process.scale.noise) == pytest.approx(floor, rel=0.1)  # by three passes
    _, variance = process(torch.from_numpy(stretches[:50].astype(np.float32)))
    # of a hop that is known to the floor, and repeated: between a root half and a root two of it, as images may coincide
    assert (np.sqrt(variance.numpy()) < 1.5 * floor).all()
    still = kriging.fit_process(stretches, np.zeros_like(residuals), images, split, floor)
    assert still is not None
    assert np.isfinite(still.shift(stretches[:5])[0]).all()


def test_hops_in_turn_find_what_the_surrogate_misses() -> None:
    """Waves of 5 mm that the surrogate knows nothing of: four hops more take another factor of ten off."""
    net = small_net()

    def real(stretches: np.ndarray) -> np.ndarray:
        images = stretches[:, net.permutations.numpy()]
        wave = np.stack([np.sin(30 * images[..., 0]), np.cos(25 * images[..., 1])], axis=2)
        smooth = FrozenLanding(net)(torch.from_numpy(stretches.astype(np.float32))).mean(dim=0).detach().numpy()
        return smooth + 0.005 * (wave * net.signs[:, :2].numpy()).mean(axis=1)

    targets = real(np.random.default_rng(5).uniform(0.25, 0.75, (8, 4)))
    planner = InversePlanner(net.landing)
    errors = []
    for tries in (1, 4, 8):
        refining = RefiningPlanner(planner, real, tries)
        errors.append(np.median(np.linalg.norm(real(refining.predict(targets)[0]) - targets, axis=1)))
        assert refining.simulator_calls == 8 * tries
    assert errors[1] < 0.3 * errors[0]
    assert errors[2] < 0.1 * errors[1]
    with pytest.raises(InvalidParameterError, match="tries"):
        RefiningPlanner(planner, real, 0)


def test_hops_in_turn_respect_the_range_and_survive_failures() -> None:
    """A linear map of which the surrogate knows half the slope; every hop of the first stretch beyond 0.6 fails."""
    slope = np.array([[0.4, 0.1, 0.0, -0.2], [0.0, 0.3, -0.1, 0.1]])

    def real(stretches: np.ndarray) -> np.ndarray:
        landings = (stretches - 0.5) @ slope.T
        landings[stretches[:, 0] > 0.6] = np.nan
        return landings

    planner = InversePlanner(lambda s: (0.5 * (s - 0.5) @ torch.tensor(slope.T, dtype=torch.float32))[None])
    targets = np.array([[0.01, 0.0], [0.08, 0.02], [0.0, 0.12], [5.0, 5.0]])
    answers, _ = RefiningPlanner(planner, real, 8).predict(targets)
    assert ((answers >= 0.2) & (answers <= 0.8)).all()
    errors = np.linalg.norm(real(answers) - targets, axis=1)
    assert np.isfinite(errors).all()  # also of the second target, straight ahead to which all hops fail
    assert (errors[[0, 2]] < 1e-3).all()
    # nothing ever flies: the first plan is the answer
    lost = RefiningPlanner(planner, lambda s: np.full((len(s), 2), np.nan), 3)
    np.testing.assert_array_equal(lost.predict(targets)[0], planner.plan(targets).stretches)


def test_steps_are_the_shortest_that_stay_in_range_and_do_what_is_wanted() -> None:
    rng = np.random.default_rng(0)
    checked = 0
    for _ in range(100):
        at = rng.uniform(0.2, 0.8, 4)
        at[rng.integers(4)] = rng.choice([0.2, 0.8, 0.79, 0.205])
        slope, wanted = rng.normal(0, 0.3, (2, 4)), rng.normal(0, 0.008, 2)
        step = refine._step(at[None], slope[None], wanted[None])[0]
        assert ((at + step >= 0.2 - 1e-12) & (at + step <= 0.8 + 1e-12)).all()
        assert np.abs(step).max() <= refine.LONGEST_STEP + 1e-12
        known = minimize(
            lambda s: s @ s,
            np.zeros(4),
            jac=lambda s: 2 * s,
            constraints={"type": "eq", "fun": lambda s: slope @ s - wanted, "jac": lambda s: slope},  # noqa: B023
            bounds=list(zip(0.2 - at, 0.8 - at, strict=True)),
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 300},
        )
        if known.success and np.abs(known.x).max() < 0.9 * refine.LONGEST_STEP and np.abs(step).max() < refine.LONGEST_STEP:
            np.testing.assert_allclose(slope @ step, wanted, atol=1e-9)
            assert np.linalg.norm(step) <= 1.02 * np.linalg.norm(known.x) + 1e-9
            checked += 1
    assert checked > 50


def test_hops_in_turn_do_not_get_stuck_near_the_end_of_the_range() -> None:
    """A step cut off at the end of the range landed elsewhere than wanted, taught nothing, and was taken again and again."""
    slope = np.array([[0.13, -0.13, -0.13, 0.13], [0.016, 0.016, -0.016, -0.016]])

    def real(stretches: np.ndarray) -> np.ndarray:
        return (stretches - 0.5) @ slope.T

    class Near:
        def predict(self, targets: np.ndarray) -> tuple[np.ndarray, None]:
            return np.array([[0.6965, 0.7963, 0.3882, 0.6688]]), None

        def slope(self, stretches: np.ndarray) -> np.ndarray:
            return slope[None]

    target = np.array([[0.0215, 0.0080]])
    assert RefiningPlanner(Near(), real, 1).refine(target).errors > 1e-3
    assert RefiningPlanner(Near(), real, 3).refine(target).errors < 1e-9


def test_hops_in_turn_from_a_stored_hop_do_not_simulate_it_again() -> None:
    """Its landing, or its image's, is known: the first hop is a step, and the answer no worse than the stored one."""
    slope = np.array([[0.13, -0.13, -0.13, 0.13], [0.016, 0.016, -0.016, -0.016]])
    images = Symmetry.of(scene_ranges("earth")).images
    asked = []

    def real(stretches: np.ndarray) -> np.ndarray:
        asked.append(stretches)
        return (stretches - 0.5) @ slope.T

    stretches = np.random.default_rng(0).uniform(0.3, 0.7, (60, 4))
    nearest = NearestHopPlanner(stretches, (stretches - 0.5) @ slope.T, images=images)
    targets = np.array([[0.02, 0.003], [-0.03, 0.001], [0.0, 0.0]])
    start = nearest.predict(targets)[0]
    np.testing.assert_allclose(nearest.recall(start), (start - 0.5) @ slope.T, atol=1e-12)
    assert np.isnan(nearest.recall(start + 1e-9)).all()
    one = RefiningPlanner(nearest, real, 1)
    found = one.refine(targets)
    assert one.simulator_calls == 3
    assert not (asked[0] == start).all(axis=1).any()
    assert (found.errors < 1e-9).all()  # the slope of the stored hops is that of the map
    # where no step flies, the stored hop is the answer, which nobody has simulated anew
    lost = RefiningPlanner(nearest, lambda s: np.full((len(s), 2), np.nan), 3).refine(targets)
    np.testing.assert_array_equal(lost.stretches, start)
    np.testing.assert_array_equal(lost.landings, nearest.recall(start))


def test_nearest_hop_counts_images_and_leaves_out_hops_without_a_landing() -> None:
    images = np.array([[0, 1, 2, 3], [2, 3, 0, 1]]), np.array([[1.0, 1.0], [-1.0, -1.0]])
    stretches = np.array([(0.2, 0.3, 0.4, 0.5), (0.6, 0.6, 0.6, 0.7), (0.5, 0.5, 0.5, 0.5)])
    landings = np.array([(0.1, 0.0), (0.0, 0.2), (np.nan, np.nan)])
    planner = NearestHopPlanner(stretches, landings, images=images)
    targets = np.array([(0.09, 0.0), (-0.09, 0.01), (0.0, -0.19)])
    expected = [(0.2, 0.3, 0.4, 0.5), (0.4, 0.5, 0.2, 0.3), (0.6, 0.7, 0.6, 0.6)]
    np.testing.assert_array_equal(planner.predict(targets)[0], expected)
    # of another scene, and so dearer than a farther one
    strange = NearestHopPlanner(stretches, landings, images=images, strangeness=np.array([1.0, 0.0, 0.0]))
    image = (0.6, 0.7, 0.6, 0.6)
    np.testing.assert_array_equal(strange.predict(targets)[0], [stretches[1], stretches[1], image])
    for broken in (stretches[:2], stretches[:0]):
        with pytest.raises(InvalidParameterError, match="at least one of them finite"):
            NearestHopPlanner(broken, np.full((3, 2), np.nan)[: len(broken) + 1])
    with pytest.raises(InvalidParameterError, match="at least one of them finite"):
        NearestHopPlanner(stretches, np.full((3, 2), np.nan))
    with pytest.raises(InvalidParameterError, match="at least one"):
        planner.predict(np.empty((0, 2)))


def test_images_land_where_the_simulator_says_that_they_do() -> None:
    """A swapped stretch or a wrong sign would give the nearest-hop baseline, and the planners' starts, hops that nobody made."""
    stretches = np.array([(0.25, 0.6, 0.4, 0.7), (0.5, 0.3, 0.65, 0.35)])
    hops = Hops(Scene.preset("earth", landing="touchdown"), {"fidelity": "flown"})
    images, landings = with_images(stretches, hops.land(stretches), small_net().landing_images)
    assert len(np.unique(images, axis=0)) == 8
    assert np.linalg.norm(landings, axis=1).min() > 0.01
    np.testing.assert_allclose(hops.land(images), landings, atol=1e-3)  # equal but for rounding, which float32 lets grow


def test_inverse_starts_from_images_and_sees_of_them_what_it_would() -> None:
    net = small_net()
    stored = np.random.default_rng(1).uniform(0.2, 0.8, (30, 4))
    alone = InversePlanner(net.landing, InverseConfig(pool=16), stored=stored)
    planner = InversePlanner(net.landing, InverseConfig(pool=16), stored=stored, images=net.landing_images)
    assert len(planner.pool) == 4 * len(alone.pool) == 4 * 46
    mean, variance = planner.see(planner.pool)
    torch.testing.assert_close(planner.pool_seen[0], mean, rtol=0, atol=1e-6)
    torch.testing.assert_close(planner.pool_seen[1], variance, rtol=1e-3, atol=1e-9)
    assert {tuple(row) for row in alone.pool.tolist()} < {tuple(row) for row in planner.pool.tolist()}


def test_stored_hops_know_a_slope_that_hops_in_turn_can_follow() -> None:
    """Exact of a linear map that commutes with the symmetries, also from hops on one side only; without any net."""
    net = small_net()
    images = net.permutations.numpy(), net.signs[:, :2].numpy()
    rng = np.random.default_rng(6)
    one = rng.normal(0, 0.3, (2, 4))
    slope = np.mean([sign[:, None] * one[:, np.argsort(p)] for p, sign in zip(*images, strict=True)], axis=0)

    def real(stretches: np.ndarray) -> np.ndarray:
        return (stretches - 0.5) @ slope.T

    for p, sign in zip(*images, strict=True):
        np.testing.assert_allclose(slope[:, np.argsort(p)] * sign[:, None], slope, atol=1e-12)
    known = rng.uniform(0.2, 0.8, (40, 4))
    planner = NearestHopPlanner(known, real(known), images=images)
    at = rng.uniform(0.3, 0.7, (6, 4))
    np.testing.assert_allclose(planner.slope(at), np.broadcast_to(slope, (6, 2, 4)), atol=1e-10)
    targets = real(at)
    answers, _ = RefiningPlanner(planner, real, 8).predict(targets)  # steps are short: one is not enough
    np.testing.assert_allclose(real(answers), targets, atol=1e-6)
    # fewer hops than a plane has unknowns: the flattest plane through them
    assert np.isfinite(NearestHopPlanner(known[:2], real(known[:2])).slope(at)).all()
