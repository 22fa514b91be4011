"""What must hold of every row of a hop file: ranges, order, and the invariants of physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from surrogate.hops import Configuration, HopData, split_share
from tensegrity_gym import ENERGY_NAMES, STRETCH_RANGE, Design, HopStatus, Lattice, Scene
from tensegrity_gym.events import flew
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.hops import time_step

#: Largest departure of the energies' sum from constant, over the stored energy: this at steps of 20 us, where we see 3e-4, and
#: as the square of longer steps. In float32, ``rounding_heat`` comes on top.
CLOSURE, CLOSURE_STEP = 2e-3, 2e-5
#: Largest disagreement of heights that energies and flight imply [m]: a step's fall at touchdown speed, and rounding.
HEIGHT = {"float64": 3e-4, "float32": 1e-3}
TAKEOFF, TOUCHDOWN, END = 1, 2, 3
KINETIC, GRAVITATIONAL = ENERGY_NAMES.index("kinetic"), ENERGY_NAMES.index("gravitational")


Rule = Callable[[HopData], np.ndarray]


def _finite(data: HopData) -> np.ndarray:
    stopped = _stopped(data)
    good = np.ones(len(data), dtype=bool)
    for name, values in data.columns.items():
        finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
        good &= np.where(stopped, ~finite, finite) if name in ("rest", "rest_nodes") else finite
    return good


def _ascending(data: HopData) -> np.ndarray:
    key = data["index"] * 64 + data["image"]
    return np.concatenate([[True] * min(1, len(key)), np.diff(key) > 0])


def _in_range(data: HopData) -> np.ndarray:
    low, high = STRETCH_RANGE
    return ((data["stretches"] >= low) & (data["stretches"] <= high)).all(axis=1)  # type: ignore[return-value]


def _own_share(data: HopData) -> np.ndarray:
    return data["split_share"] == split_share(data["stretches"], Lattice(**data.configuration["lattice"]))


def _image_number(data: HopData) -> np.ndarray:
    images = _configuration(data).rows_per_hop
    return (data["image"] >= 0) & (data["image"] < images)


def _scene_values(data: HopData) -> np.ndarray:
    good = np.ones(len(data), dtype=bool)
    for name, (low, high) in data.configuration["scene_ranges"].items():
        good &= (data[f"scene_{name}"] >= low) & (data[f"scene_{name}"] <= high)
    return good


def _counts(data: HopData) -> np.ndarray:
    good = (data["index"] >= 0) & (data["iterations"] >= 0) & (data["cpu_seconds"] >= 0) & (data["residual"] >= 0)
    return good & (data["stored_energy"] >= 0)


def _balanced(data: HopData) -> np.ndarray:
    # a micronewton against members that carry tens of newtons
    return (data["residual"] < 1e-5 * Design(**data.configuration["design"]).critical_load) | ~_settled(data)


def _settled(data: HopData) -> np.ndarray:
    return data["converged"] == 1 if "converged" in data.columns else data["status"] != HopStatus.NOT_CONVERGED


def _status(data: HopData) -> np.ndarray:
    return np.isin(data["status"], [int(s) for s in HopStatus])


def _flew(data: HopData) -> np.ndarray:
    return flew(data["status"])


def _stopped(data: HopData) -> np.ndarray:
    """Hops that were not followed to rest, which they then have none of."""
    return data.columns.get("status", np.zeros(len(data))) == HopStatus.STOPPED


def _times(data: HopData) -> np.ndarray:
    limit = data.configuration["scene"]["duration"] * 1.01 + 2e-3  # whole strides of steps
    a, b, c = data["takeoff_time"], data["touchdown_time"], data["end_time"]
    step = c / np.maximum(data["steps"], 1)  # a hop that ends with its touchdown ends with the step before it
    order = (a >= 0) & (b >= a) & (c >= b - step)
    moved = (data["status"] == HopStatus.NOT_CONVERGED) | ((data["steps"] > 0) & (c > 0))
    return (order | ~_flew(data)) & (c <= limit) & (c >= 0) & moved


def _flight_time(data: HopData) -> np.ndarray:
    expected = np.where(_flew(data), data["touchdown_time"] - data["takeoff_time"], 0.0)
    return np.abs(data["flight_time"] - expected) < 1e-9


def _steps(data: HopData) -> np.ndarray:
    """All hops of a file take one step, so steps and time are proportional."""
    going = (data["steps"] > 0) & data.usable
    if not going.any() or _configuration(data).model.flight == "rigid":  # which takes no steps
        return np.ones(len(data), dtype=bool)
    dt = np.median(data["end_time"][going] / data["steps"][going])
    return ~going | (np.abs(data["end_time"] / dt - data["steps"]) < 1.0 + 1e-5 * data["steps"])


def _landing(data: HopData) -> np.ndarray:
    return (data["landing"] == data[data.configuration["scene"]["landing"]]).all(axis=1)


def _nodes_near(data: HopData) -> np.ndarray:
    """The mean of the nodes and the centre of mass lie in the same lattice."""
    lattice = Lattice(**data.configuration["lattice"])
    size = Design(**data.configuration["design"]).cell_height * max(lattice.nx, lattice.ny)
    near = [np.linalg.norm(data[k] - data[f"{k}_nodes"], axis=1) < 0.5 * size for k in ("rest", "touchdown")]
    return (near[0] | _stopped(data)) & near[1]


def _closure(data: HopData) -> np.ndarray:
    total = data["energies"].sum(axis=2)
    reached = np.ones(total.shape, dtype=bool)
    reached[:, (TAKEOFF, TOUCHDOWN)] = _flew(data)[:, None]  # events that a hop without flight never had
    drift = np.where(reached, np.abs(total - total[:, :1]), 0.0).max(axis=1)
    c = _configuration(data)
    dt = time_step(c.dt, c.modelled, c.lattice, c.model, allow_unstable=True)
    share = CLOSURE * max(1.0, dt / CLOSURE_STEP) ** 2
    return (drift < share * data["stored_energy"] + rounding_heat(data)) | ~data.usable


def rounding_heat(data: HopData) -> np.ndarray:
    """Most energy that rounding positions to float32 can feed into the members, which damp it away [J], shape (n,).

    Positions x are rounded at every step by an error that is uniform within half a unit in the last place u <= 2^-23 |x|:
    variance u^2 / 12 at either end of a member, k u^2 / 12 of elastic energy in it. A tenth of that is the most that we see, from
    Earth to the Moon and on slopes of up to 30 degrees (farthest is not where a hop is all the time); a quarter may pass.
    """
    configuration = _configuration(data)
    if configuration.model.precision != "float32":
        return np.zeros(len(data))
    design, lattice = configuration.modelled, configuration.lattice
    structure = design.structure(lattice)
    stiffness = design.bar_segments * structure.segment_stiffness.sum() + structure.cable_stiffness.sum()
    away = [np.nan_to_num(np.linalg.norm(data[name], axis=1)) for name in ("rest", "touchdown")]
    farthest = np.maximum.reduce([*away, data["apex"]]) + design.cell_height * max(lattice.nx, lattice.ny)
    return data["steps"] * stiffness * (2.0**-23 * farthest) ** 2 / 12 / 4


def _dissipation(data: HopData) -> np.ndarray:
    lost = data["energies"][:, :, 5:]
    first = (lost[:, 0] == 0).all(axis=1)
    slack = 1e-5 * data["stored_energy"][:, None]
    later = (lost[:, END] >= -slack).all(axis=1)
    growing = (np.diff(lost, axis=1) >= -slack[:, None]).all(axis=(1, 2))
    return (first & later & (growing | ~_flew(data))) | ~data.usable


def _kinetic(data: HopData) -> np.ndarray:
    moving = 0.5 * _mass(data) * (data["takeoff_velocity"] ** 2).sum(axis=1)
    kinetic = data["energies"][:, :, KINETIC]
    still = kinetic[:, 0] <= 1e-3 * data["stored_energy"]
    return (still & (kinetic >= 0).all(axis=1) & (kinetic[:, TAKEOFF] >= moving * (1 - 1e-4))) | ~_flew(data)


def _ballistic(data: HopData) -> np.ndarray:
    """Momentum: between take-off and touchdown the centre of mass falls freely, and the energies say so independently."""
    fall, apex = departures(data)
    height = HEIGHT[data.configuration["precision"]]
    return ((np.abs(fall) < height) & (np.abs(apex) < height)) | ~_flew(data)


def departures(data: HopData) -> tuple[np.ndarray, np.ndarray]:
    """How far flight and energies disagree, shapes (n,) [m], for hops that flew.

    The fall along gravity during the flight, -g . (v T + g T^2 / 2) / |g|, against what gravitational energy -M g . x says of
    it; and the apex against the parabola through the take-off, whose height above the ground follows from that energy and, on
    a slope, from where it lies: a flight before the touchdown.
    """
    gravity = _gravity(data)
    size, normal = np.linalg.norm(gravity, axis=1), -gravity[:, 2]
    velocity, time = data["takeoff_velocity"], data["flight_time"]
    flight = velocity * time[:, None] + gravity * (time**2 / 2)[:, None]
    potential = data["energies"][:, :, GRAVITATIONAL] / _mass(data)
    fall = (potential[:, TOUCHDOWN] - potential[:, TAKEOFF] + (gravity * flight).sum(axis=1)) / size
    takeoff = data["touchdown"] - flight[:, :2]
    rise = (potential[:, TAKEOFF] - potential[:, 0] + (gravity[:, :2] * takeoff).sum(axis=1)) / normal
    return fall, data["apex"] - rise - velocity[:, 2] ** 2 / (2 * normal)


def _failed_landings(data: HopData) -> np.ndarray:
    """What blew up or never started reads zero."""
    none = [np.all(data[k] == 0, axis=1) for k in ("landing", "takeoff_velocity")]
    return data.usable | (none[0] & none[1])


def _gravity(data: HopData) -> np.ndarray:
    """Gravity of each hop in the frame of its ground, shape (n, 3) [m/s^2]."""
    scene, names = Scene(**data.configuration["scene"]), ("gravity", "slope", "slope_direction")
    values = np.column_stack([data.columns.get(f"scene_{k}", np.full(len(data), getattr(scene, k))) for k in names])
    distinct, which = np.unique(values, axis=0, return_inverse=True)
    vectors = [replace(scene, **dict(zip(names, row.tolist(), strict=True))).gravity_vector for row in distinct]
    return np.reshape(vectors, (-1, 3))[which.ravel()]


def _mass(data: HopData) -> float:
    configuration = _configuration(data)
    return float(configuration.modelled.structure(configuration.lattice).mass.sum())


def _configuration(data: HopData) -> Configuration:
    plain = {k: v for k, v in data.configuration.items() if k not in ("schema_version", "model_version")}
    kinds: tuple[tuple[str, Any], ...] = (("design", Design), ("scene", Scene), ("lattice", Lattice), ("fidelity", Fidelity))
    made = {k: kind(**plain[k]) for k, kind in kinds if k in plain}
    return Configuration(**(plain | made))


_COMMON: tuple[tuple[str, Rule], ...] = (
    ("values: not finite", _finite),
    ("index: not ascending, or doubled", _ascending),
    ("image: not one of the lattice's symmetries", _image_number),
    ("stretches: out of range", _in_range),
    ("split_share: not that of the stretches", _own_share),
    ("scene values: out of their ranges", _scene_values),
    ("counts, times or stored energy: negative", _counts),
    ("residual: not that of an equilibrium", _balanced),
)
_HOP_RULES: tuple[tuple[str, Rule], ...] = (
    ("status: not a HopStatus", _status),
    ("times: out of order, or past the duration", _times),
    ("flight_time: not touchdown_time - takeoff_time", _flight_time),
    ("steps: not end_time over the time step", _steps),
    ("landing: not the column that scene.landing says", _landing),
    ("nodes: their mean is out of the lattice", _nodes_near),
    ("failed hops: a landing or speed where there is none", _failed_landings),
    ("energies: their sum is not constant", _closure),
    ("energies: dissipation undone", _dissipation),
    ("energies: kinetic energy below that of the centre of mass", _kinetic),
    ("momentum: no free flight between take-off and touchdown", _ballistic),
)


def violations(data: HopData) -> list[tuple[str, int, int]]:
    """Invariants that rows break: which, how many rows, and the first of them."""
    rules = [*_COMMON, *(_HOP_RULES if data.configuration["content"] == "hops" else ())]
    found = []
    for what, rule in rules:
        with np.errstate(all="ignore"):
            bad = np.flatnonzero(~rule(data))
        if len(bad):
            found.append((what, len(bad), int(bad[0])))
    return found
