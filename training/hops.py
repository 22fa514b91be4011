"""The simulator as planners and scores see it: where do stretches land, and where if the start is moved a little?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from typing import Any

import numpy as np

from tensegrity_gym import Design, Equilibria, HopResult, Scene, form_find, simulate
from tensegrity_gym.batch import thread_count
from tensegrity_gym.fidelity import named_fidelity
from tensegrity_gym.scene_ranges import SceneRanges
from tensegrity_gym.specimen import LYING, POSITION
from tensegrity_gym.types import Floats

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

    def land(self, stretches: Floats, asked: Floats | None = None) -> Floats:
        """Landings, shape (n, 2) [m]; not-a-number where a hop failed. What was ``asked`` makes no difference in one scene."""
        return _landings(self.simulate(stretches))

    def perturbed(self, stretches: Floats, times: int, asked: Floats | None = None) -> Floats:
        """Landings of the hops and of each ``times`` over from a moved start, shape (n, 1 + times, 2) [m]."""
        nominal = self.simulate(stretches)
        assert nominal.equilibria is not None, "hops start from equilibria"
        return np.concatenate([_landings(nominal)[:, None], self._from_moved(nominal.equilibria, times)], axis=1)

    def moved(self, stretches: Floats, times: int) -> Floats:
        """Landings of each hop ``times`` over from a moved start alone, shape (n, times, 2) [m]; not for fidelity "auto"."""
        modelled = named_fidelity(self.levers.get("fidelity", "paper")).design(Design())
        return self._from_moved(form_find(stretches, design=modelled, scene=self.scene, threads=self.threads), times)

    def _from_moved(self, found: Equilibria, times: int) -> Floats:
        n, moved = len(found.stretches), repeated(found, times)
        noise = np.random.default_rng(SEED).normal(0, POSITION, (times, *found.positions.shape[1:]))
        above = moved.positions[:, :, 2:] > LYING
        moved = replace(moved, positions=moved.positions + np.tile(noise, (n, 1, 1)) * above)
        return _landings(self.simulate(moved.stretches, moved)).reshape(n, times, 2)


class VariedHops:
    """Hops in scenes that vary, counted: ``asked``, observations (n, 2 + k), say in which scene each hop is made."""

    def __init__(self, scenes: SceneRanges, levers: Mapping[str, Any], threads: int | None = None) -> None:
        self.scenes, self.levers, self.threads = scenes, dict(levers), threads
        #: Hops simulated so far.
        self.calls = 0

    def at(self, values: Floats) -> Scene:
        """The scene of values (k,) [SI]."""
        return self.scenes.changed(self.scenes.base, dict(zip(self.scenes.observed, map(float, values), strict=True)))

    def land(self, stretches: Floats, asked: Floats) -> Floats:
        """Landings, shape (n, 2) [m]; not-a-number where a hop failed."""
        return self._each(asked, lambda hops, rows: hops.land(stretches[rows]))

    def perturbed(self, stretches: Floats, times: int, asked: Floats) -> Floats:
        """Landings of the hops and of each ``times`` over from a moved start, shape (n, 1 + times, 2) [m]."""
        return self._each(asked, lambda hops, rows: hops.perturbed(stretches[rows], times))

    def _each(self, asked: Floats, work: Callable[[Hops, np.ndarray], Floats]) -> Floats:
        """One batch for each scene that occurs, batches side by side; results in the order of ``asked``."""
        distinct, which = np.unique(np.asarray(asked)[:, 2:], axis=0, return_inverse=True)
        rows = [np.flatnonzero(which.reshape(-1) == k) for k in range(len(distinct))]
        batches = [Hops(self.at(values), self.levers, threads=1) for values in distinct]
        with ThreadPoolExecutor(thread_count(self.threads)) as pool:
            parts = list(pool.map(work, batches, rows))
        self.calls += sum(hops.calls for hops in batches)
        return np.concatenate(parts)[np.argsort(np.concatenate(rows))]


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
