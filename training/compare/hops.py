"""The simulator as the comparison sees it: where do stretches land, and where if the start is moved a little?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from tensegrity_gym import Equilibria, HopResult, Scene, simulate
from tensegrity_gym.types import Floats

#: Standard deviation by which each mass above the ground is moved at the start [m]: what nobody can know.
PERTURBATION = 1e-5
#: Seed of the perturbations: the same for every plan.
SEED = 777


class Hops:
    """Hops in one scene with one model of the hop, counted."""

    def __init__(self, scene: Scene, levers: Mapping[str, Any], threads: int | None = None) -> None:
        self.scene, self.levers, self.threads = scene, dict(levers), threads
        #: Hops simulated so far.
        self.calls = 0

    def simulate(self, stretches: Floats, equilibria: Equilibria | None = None) -> HopResult:
        """Hops of ``stretches``, shape (n, n_actuators)."""
        self.calls += len(stretches)
        return simulate(stretches, scene=self.scene, equilibria=equilibria, threads=self.threads, **self.levers)

    def land(self, stretches: Floats) -> Floats:
        """Landings, shape (n, 2) [m]; not-a-number where a hop failed."""
        return _landings(self.simulate(stretches))

    def perturbed(self, stretches: Floats, times: int) -> Floats:
        """Landings of the hops and of each ``times`` over from a moved start, shape (n, 1 + times, 2) [m]."""
        nominal = self.simulate(stretches)
        n, found = len(stretches), nominal.equilibria
        assert found is not None, "hops start from equilibria"
        moved = repeated(found, times)
        noise = np.random.default_rng(SEED).normal(0, PERTURBATION, (times, *found.positions.shape[1:]))
        above = moved.positions[:, :, 2:] > 1e-3
        moved = replace(moved, positions=moved.positions + np.tile(noise, (n, 1, 1)) * above)
        others = _landings(self.simulate(np.repeat(stretches, times, axis=0), moved))
        return np.concatenate([_landings(nominal)[:, None], others.reshape(n, times, 2)], axis=1)


def _landings(result: HopResult) -> Floats:
    return np.where(result.failed[:, None], np.nan, result.landing)


def repeated(equilibria: Equilibria, times: int) -> Equilibria:
    """Each equilibrium ``times`` over, in a row."""
    n = len(equilibria.stretches)

    def repeat(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: repeat(part) for name, part in value.items()}
        return np.repeat(value, times, axis=0) if isinstance(value, np.ndarray) and len(value) == n else value

    return replace(equilibria, **{f.name: repeat(getattr(equilibria, f.name)) for f in fields(equilibria)})
