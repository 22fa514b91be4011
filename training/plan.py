"""Given a target, which four stretches? A planner made of a trained surrogate and its hops, and the command that asks it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from surrogate import dataset, model
from surrogate.dataset import HopData
from surrogate.frozen import FrozenLanding
from surrogate.hops import simulate_arguments
from surrogate.kriging import fit_kriging, without_images
from surrogate.model import HopNet, one_thread
from tensegrity_gym import simulate
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tensegrity_gym.scene_ranges import SceneRanges
from tensegrity_gym.types import Floats
from training.inverse import START_SEED, InverseConfig, InversePlanner, fit_energy
from training.planner import Land, targets_of
from training.refine import RefiningPlanner
from training.varied import VariedPlanner, fit_varied_kriging, inverse_planners


@dataclass(frozen=True)
class PlanCommand:
    """Which stretches land on a target? Asked of a trained surrogate and of the hops that it remembers."""

    net: Annotated[Path, tyro.conf.Positional]
    """Checkpoint made by `python -m surrogate train`."""
    data: Annotated[Path, tyro.conf.Positional]
    """HDF5 file of the hops that it was trained on, or of others of the same configuration."""
    target: Annotated[tuple[tuple[float, float], ...], tyro.conf.UseAppendAction] = ()
    """Where to land: x y, from the start [m]. Give it once for each target."""
    at: tuple[str, ...] = ()
    """Values of the scene, where the hops vary it: gravity=3.7 friction=0.5 [SI units]."""
    tries: int = 0
    """Hops to simulate for each target, in turn, each corrected by what the ones before it missed; 0: none."""
    planner: InverseConfig = field(default_factory=InverseConfig)
    """Inversion of the surrogate."""
    seed: int = 0
    """Seed of the stretches that descents start from."""
    threads: int | None = None
    """Threads of the simulator; None: all cores that this process may use."""
    json: bool = False
    """Print JSON: a list with one object for each target, lengths in m."""


@one_thread()
def planner_of(
    net: HopNet,
    card: Mapping[str, Any],
    data: HopData,
    *,
    at: Mapping[str, float] | None = None,
    config: InverseConfig | None = None,
    floor: float = 0.0,
    seed: int = 0,
    where: str = "data",
) -> InversePlanner:
    """The robust planner: the ensemble, mended and doubted by all usable hops of ``data``; of equal answers the least energy.

    Args:
        net, card: as ``surrogate.model.load`` gives them.
        data: the hops that the net was trained on, or others of their configuration; ``where`` they came from is for errors.
        at: the scene to plan in, by name [SI units], for a net that was trained on hops of scenes that vary.
        floor: how far a landing moves, in each direction, when nothing but the unknowable changes [m].

    Raises DataFileError for hops of another configuration, InvalidParameterError for a scene that the net does not know, and for
    hops whose lengths were made alike: :func:`varied_planner_of` plans with those.
    """
    if "lengths" in data.configuration:
        raise InvalidParameterError(
            f"{where}: expected landings in metres of their own scene, got lengths {data.configuration['lengths']}; "
            "take varied_planner_of, which asks and answers in metres"
        )
    known, held, of_all = _known(net, card, data, seed, where)
    _check_scene(net, at)
    config = config or InverseConfig()
    if not at:
        kriging = fit_kriging(net, known, held, 0.0, floor)
        return InversePlanner(FrozenLanding(net), config, correction=kriging, stored=known["stretches"], **of_all)
    scenes = _scenes(net)
    return _maker(net, known, scenes, held, config, floor, of_all)(np.array([at[name] for name in scenes.observed]))


@one_thread()
def varied_planner_of(
    net: HopNet,
    card: Mapping[str, Any],
    data: HopData,
    *,
    config: InverseConfig | None = None,
    floor: float = 0.0,
    seed: int = 0,
    where: str = "data",
) -> VariedPlanner:
    """As :func:`planner_of` for many scenes at once: of the env's observations, target [m] and scene values, each has its own.

    Hops whose lengths were made alike (``similarity.alike_data``), and the net that learnt from them, serve as well as those in
    metres. Raises InvalidParameterError for a net that was trained in one scene.
    """
    if not net.scene_names:
        raise InvalidParameterError(f"net: expected one trained on hops of scenes that vary, got one of {net.scene} alone")
    known, held, of_all = _known(net, card, data, seed, where)
    scenes = _scenes(net)
    make = _maker(net, known, scenes, held, config or InverseConfig(), floor, of_all)
    return VariedPlanner(make, scenes, made_alike="lengths" in data.configuration)


def _known(net: HopNet, card: Mapping[str, Any], data: HopData, seed: int, where: str) -> tuple[HopData, float, dict[str, Any]]:
    """Hops to remember, the share of them that tells how well others are mended, and what all planners of them have in common."""
    if not {"configuration", "train"} <= set(card):
        raise DataFileError(f"card: expected one that `python -m surrogate train` wrote, got {sorted(card)}; train the net again")
    model.check_data(card, data.configuration, where)
    # the hops of the test split have no test to serve here: with those of validation they tell how well others are mended
    held = card["train"]["validation"] + card["train"]["test"]
    known = without_images(net, data.rows(data.usable))
    if not len(known):
        raise InvalidParameterError(f"{where}: expected at least one hop that did not fail, got none of {len(data)}")
    of_all = {
        "energy": fit_energy(known["stretches"], known["stored_energy"]),
        "images": net.landing_images,
        "n_actuators": known["stretches"].shape[1],
        "seed": seed + START_SEED,
    }
    return known, held, of_all


def _scenes(net: HopNet) -> SceneRanges:
    return SceneRanges(net.scene, {name: (low, high) for name, (low, high) in net.scene_ranges.items()})


def _maker(
    net: HopNet,
    known: HopData,
    scenes: SceneRanges,
    held: float,
    config: InverseConfig,
    floor: float,
    of_all: Mapping[str, Any],
) -> Callable[[Floats], InversePlanner]:
    """Scene values in observed order (k,) [SI] to the planner of that scene; what all scenes share is fitted once."""
    kriging = fit_varied_kriging(net, known, scenes, known.split(held, 0.0), floor)
    return inverse_planners(FrozenLanding(net, scenes.observed), kriging, config, **of_all)


def _check_scene(net: HopNet, at: Mapping[str, float] | None) -> None:
    if not net.scene_names:
        if at:
            raise InvalidParameterError(f"at: expected no values of the scene, since the hops are all of one, got {dict(at)}")
        return
    if not at:
        wanted = ", ".join(f"{name} from {low:g} to {high:g}" for name, (low, high) in net.scene_ranges.items())
        raise InvalidParameterError(
            f"at: expected the scene to plan in, as the hops vary it ({wanted}), got none; give --at "
            + " ".join(f"{name}=..." for name in net.scene_names)
        )
    net.predict(np.full((1, net.permutations.shape[1]), 0.5), scene=at)  # names what it was not trained on


def simulator_of(data: HopData, at: Mapping[str, float] | None = None, threads: int | None = None) -> Land:
    """Hops as those of ``data`` were made: their scene (with the values ``at``), design, lattice, fidelity and time step."""
    how = simulate_arguments(data.configuration)
    how["scene"] = replace(how["scene"], **dict(at or {}))

    def land(stretches: Floats) -> Floats:
        hops = simulate(stretches, threads=threads, **how)
        return np.where(hops.failed[:, None], np.nan, hops.landing)

    return land


def ask(planner: InversePlanner, targets: Floats, land: Land | None = None, tries: int = 0) -> list[dict[str, Any]]:
    """Answers to targets (n, 2) [m], JSON-like; with ``tries`` also the best of so many hops simulated in turn by ``land``."""
    plans = planner.plan(targets)
    answers: list[dict[str, Any]] = [
        {
            "target": target.tolist(),
            "stretches": plans.stretches[k].tolist(),
            "landing": plans.landings[k].tolist(),
            "error": float(plans.errors[k]),
            "reachable": bool(plans.reachable[k]),
        }
        for k, target in enumerate(targets)
    ]
    if land is not None and tries:
        refined = RefiningPlanner(planner, land, tries).refine(targets)
        for k, answer in enumerate(answers):
            flew = bool(np.isfinite(refined.errors[k]))
            answer["simulated"] = {
                "tries": tries,
                "stretches": refined.stretches[k].tolist(),
                "landing": refined.landings[k].tolist() if flew else None,
                "error": float(refined.errors[k]) if flew else None,
            }
    return answers


def text_of(answer: Mapping[str, Any]) -> str:
    """An answer in two or three lines."""
    lines = ["target " + _point(answer["target"])]
    far = "" if answer["reachable"] else "; out of reach as far as it knows"
    lines.append(f"  planned    {_hop(answer)}, error {1e3 * answer['error']:.1f} mm expected{far}")
    simulated = answer.get("simulated")
    if simulated is not None and simulated["landing"] is None:
        lines.append(f"  simulated  none of {simulated['tries']} hops flew")
    elif simulated is not None:
        best = f"best of {simulated['tries']} in turn"
        lines.append(f"  simulated  {_hop(simulated)}, error {1e3 * simulated['error']:.2f} mm, {best}")
    return "\n".join(lines)


def _hop(answer: Mapping[str, Any]) -> str:
    return "stretches " + " ".join(f"{s:.4f}" for s in answer["stretches"]) + f"  landing {_point(answer['landing'])}"


def _point(point: list[float]) -> str:
    return f"({point[0]:.4f}, {point[1]:.4f}) m"


def _value(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError as error:
        raise InvalidParameterError(f"at: expected name=value, such as gravity=3.7, got {text!r}") from error


def main(config: PlanCommand) -> None:
    """Entry of ``python -m training plan``."""
    if not config.target:
        raise InvalidParameterError("target: expected at least one, such as --target 0.10 0.05, got none")
    if config.tries < 0:
        raise InvalidParameterError(f"tries: expected an integer >= 0, got {config.tries}")
    targets, at = targets_of(np.array(config.target)), dict(_value(text) for text in config.at)
    started = time.perf_counter()
    net, card = model.load(config.net)
    data = dataset.read(config.data)
    planner = planner_of(net, card, data, at=at, config=config.planner, seed=config.seed, where=str(config.data))
    made = time.perf_counter()
    answers = ask(planner, targets, simulator_of(data, at, config.threads), config.tries)
    ended = time.perf_counter()
    if config.json:
        print(json.dumps(answers, indent=2))
        return
    for answer in answers:
        print(text_of(answer))
    print(f"planner of {len(data)} hops made in {made - started:.2f} s, targets answered in {ended - made:.2f} s")
