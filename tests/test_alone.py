"""A hop that is followed alone, without lanes, against the same hop in a lane: one source, the same bits."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from tensegrity_gym import Equilibria, Fidelity, HopResult, HopStatus, Scene, form_find, rollouts, simulate
from tensegrity_gym.fidelity import CHOICES

STRETCHES = np.random.default_rng(0).uniform(0.2, 0.8, (3, 4))
#: At six times the gravity of the Earth hops are short: one tumbles on, one comes to rest, one never flies.
HEAVY = Scene(gravity=60.0, duration=1.06)
ENDS = [HopStatus.TIME_LIMIT, HopStatus.RESTED, HopStatus.NO_FLIGHT]
PRECISIONS = CHOICES["precision"]


@pytest.fixture(scope="module")
def heavy() -> Equilibria:
    return form_find(STRETCHES, scene=HEAVY, threads=1)


def in_lanes_and_alone(monkeypatch: pytest.MonkeyPatch, **options: Any) -> tuple[HopResult, HopResult]:
    """The same hops in the lanes of one vector, and one after another without."""
    results = []
    for alone in (0, len(STRETCHES)):
        monkeypatch.setattr(rollouts, "ALONE", alone)
        results.append(simulate(STRETCHES, threads=1, **options))
    return results[0], results[1]


def assert_same_bits(lanes: HopResult, alone: HopResult) -> None:
    """All arrays of the results and of their frames."""
    for one, other in ((lanes, alone), (lanes.trajectory, alone.trajectory)):
        for field in fields(one) if one is not None else ():
            a, b = getattr(one, field.name), getattr(other, field.name)
            if isinstance(a, np.ndarray):
                np.testing.assert_array_equal(a, b, err_msg=field.name, strict=True)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_hops_with_frames_to_every_end(precision: str, heavy: Equilibria, monkeypatch: pytest.MonkeyPatch) -> None:
    """Through take-off, impacts and tumbling, which amplify whatever is rounded elsewhere a million times."""
    lanes, alone = in_lanes_and_alone(
        monkeypatch, scene=HEAVY, equilibria=heavy, fidelity=Fidelity(precision=precision), trajectory_rate=100.0
    )
    assert lanes.status.tolist() == ENDS
    assert lanes.impact_count.max() > 0
    assert lanes.trajectory.frames.min() > 90
    assert_same_bits(lanes, alone)


@pytest.mark.parametrize("integrator", CHOICES["integrator"][1:])
def test_other_integrators(integrator: str, heavy: Equilibria, monkeypatch: pytest.MonkeyPatch) -> None:
    """In float64: no other test needs their float32, which takes a minute to compile."""
    fidelity = Fidelity(integrator=integrator)
    short = Scene(gravity=60.0, duration=0.1)
    assert_same_bits(*in_lanes_and_alone(monkeypatch, scene=short, equilibria=heavy, fidelity=fidelity, trajectory_rate=100.0))


@pytest.mark.parametrize("precision", PRECISIONS)
def test_hops_that_blow_up(precision: str, heavy: Equilibria, monkeypatch: pytest.MonkeyPatch) -> None:
    """Down to the mass and the member that ran away."""
    fidelity = Fidelity(precision=precision, step=1.3)
    lanes, alone = in_lanes_and_alone(monkeypatch, scene=HEAVY, equilibria=heavy, fidelity=fidelity, allow_unstable=True)
    assert (lanes.status == HopStatus.UNSTABLE).all()
    assert (lanes.failed_member >= 0).all()
    assert_same_bits(lanes, alone)


def test_a_rigid_flight_between_two_rollouts(heavy: Equilibria, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second rollout starts in mid-hop, and with fewer hops than lanes."""
    fidelity = Fidelity(precision="float32", flight="rigid", contact="nodes", clearance=0.0)
    lanes, alone = in_lanes_and_alone(monkeypatch, scene=HEAVY, equilibria=heavy, fidelity=fidelity)
    assert (lanes.flight_time > 0).any()
    assert_same_bits(lanes, alone)


@pytest.mark.parametrize(
    ("hops", "threads", "precision", "count"),
    [(1, 1, "float64", 1), (2, 1, "float64", 8), (2, 2, "float64", 1), (3, 2, "float64", 8), (3, 2, "float32", 16)],
)
def test_a_hop_a_thread_goes_alone(
    hops: int, threads: int, precision: str, count: int, heavy: Equilibria, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    real = rollouts.hop_lanes
    monkeypatch.setattr(rollouts, "hop_lanes", lambda structure, lanes: (asked.append(lanes), real(structure, lanes))[1])
    simulate(STRETCHES[:hops], scene=Scene(duration=1e-3), fidelity=Fidelity(precision=precision), threads=threads)
    assert set(asked) == {count}
    assert len(asked) == (min(hops, threads) if count == 1 else 1)
