"""What no surrogate can beat: how far a hop's outputs move when its start is moved by very little; and its roughness."""

from __future__ import annotations

from typing import Any

import numpy as np

from surrogate.hops import HopData, simulate_arguments
from surrogate.outputs import OUTPUTS
from tensegrity_gym import STRETCH_RANGE, Equilibria, HopResult, form_find, simulate
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.specimen import POSITION, moved_start
from tensegrity_gym.types import Floats

#: Distances of neighbours along a line in the stretches [-]; 10 000 hops lie about 0.06 apart.
STEPS = (1e-3, 1e-2, 6e-2)


def measure_floor(data: HopData, hops: int) -> dict[str, dict[str, float]]:
    """RMS change of each output [units of OUTPUTS] over the first ``hops`` usable hops when its start is moved; and roughness.

    Roughness over a step: the second difference of three hops on a line, a step apart, over sqrt(6), so that it is the
    deviation of the noise where the outputs are nothing but noise, and falls as step^2 where they are smooth.
    """
    c = data.configuration
    if c.get("scene_ranges"):
        raise InvalidParameterError(f"floor: expected hops of one scene, got scenes that vary in {sorted(c['scene_ranges'])}")
    how = simulate_arguments(c)
    rows = np.flatnonzero(data.usable & (data["image"] == 0))[:hops]
    random = np.random.default_rng(0)
    start = start_of(data["stretches"][rows], how)
    reference = outputs_of(simulate(start.stretches, equilibria=start, **how))
    moved = outputs_of(simulate(start.stretches, equilibria=moved_start(start), **how))
    apart = {f"start moved by {POSITION:g} m": moved - reference}
    middle = sum(STRETCH_RANGE) / 2
    for step in STEPS:
        direction = np.abs(random.normal(size=start.stretches.shape)) * np.sign(middle - start.stretches)  # inwards: in range
        direction *= step / np.linalg.norm(direction, axis=1, keepdims=True)
        once, twice = (outputs_of(simulate(start.stretches + k * direction, **how)) for k in (1, 2))
        apart[f"roughness over {step:g}"] = (reference - 2 * once + twice) / np.sqrt(6)
    return {
        name: {o.name: float(np.sqrt(np.nanmean(change[:, k] ** 2))) for k, o in enumerate(OUTPUTS)}
        for name, change in apart.items()
    }


def start_of(stretches: Floats, how: dict[str, Any]) -> Equilibria:
    """Equilibria of stretches (n, n_actuators) that ``simulate(stretches, **how)`` would start from."""
    return form_find(stretches, design=how["fidelity"].design(how["design"]), scene=how["scene"], lattice=how["lattice"])


def outputs_of(result: HopResult) -> Floats:
    """The outputs of simulated hops, shape (n, len(OUTPUTS)) [each its unit]."""
    columns = [getattr(result, o.column) for o in OUTPUTS]
    return np.column_stack([c if o.component is None else c[:, o.component] for o, c in zip(OUTPUTS, columns, strict=True)])
