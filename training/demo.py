"""The whole chain on real physics: simulate, learn, plan, simulate the plans, train a policy, compare, report."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from surrogate import dataset, model
from surrogate.dataset import Configuration, HopData
from surrogate.generate import generate
from surrogate.kriging import fit_kriging
from surrogate.storage import CARD, beside, package_versions
from surrogate.train import TrainConfig, train
from tensegrity_gym import MODEL_VERSION, Scene, simulate
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.specimen import POSITION
from tensegrity_gym.task import reach
from training import figures, report
from training.hops import SEED, Hops
from training.inverse import START_SEED, InverseConfig, InversePlanner
from training.planner import NearestHopPlanner, Planner
from training.policies import ActorPolicy
from training.refine import RefiningPlanner
from training.score import Score, scatter, score_stretches
from training.stages import Results, Stages

TURNS = 8  #: hops that are simulated for each answer of the planner that corrects itself
STARTS = 8  #: moved starts that each answer is scored from
STARTS_BELOW = {"touchdown": 8, "rest": 2}  #: the same below the whole budget: a hop to rest costs ten to touchdown
#: Model that answers are scored by: the paper's in single precision; touchdowns also with rigid flight, no further than there.
SCORED_BY = {"touchdown": "flown", "rest": "single"}
METHODS = {
    "nearest": "nearest stored hop",
    "planner": "planner (surrogate inverted)",
    "turns": f"planner, {TURNS} hops in turn",
    "policy": "policy (SAC)",
}
HELD_OUT_SEED = 1_000_003  #: added to the seed for the hops that targets are taken from
SHOWN_HOP = (0.3, 0.3, 0.5, 0.5)  #: stretches of the hop in the pictures


@dataclass(frozen=True)
class DemoConfig:
    """From 256 simulated hops to planned landings, with a report; a rerun continues."""

    hops: int = 256
    """Simulator calls that each method may learn from."""
    seed: int = 0
    """Seed of everything random."""
    out: Path = Path("runs/demo")
    """Folder of all results."""
    targets: int = 32
    """Held-out targets: landings of other simulated hops."""
    scene: str = "earth"
    """Scene preset."""
    landing: str = "touchdown"
    """Where a landing is read: touchdown, which repeats to a fraction of a millimetre, or rest (the paper's), which scatters by
    centimetres, so that 256 hops are too few to learn it."""
    surrogate: TrainConfig = field(default_factory=lambda: TrainConfig(test=0.0))
    """Training of the surrogate; nothing is kept back for a test, since the held-out hops are one."""
    planner: InverseConfig = field(default_factory=InverseConfig)
    """Inversion of the surrogate."""
    gradient_steps: int = 8
    """The policy's gradient steps per hop."""
    progress: bool = True
    """Show progress bars."""


def run(config: DemoConfig) -> Stages:
    """All stages; returns them with their results."""
    if config.hops < 4 or config.targets < 1:
        raise InvalidParameterError(
            f"hops and targets: expected hops >= 4 and targets >= 1, got {config.hops} and {config.targets}"
        )
    stages = Stages(Path(config.out))
    scene = Scene.preset(config.scene, landing=config.landing)
    budgets = spread_budgets(config.hops)
    _show_hop(stages, config, scene)  # also compiles the simulator, so that compiling counts in no method's time
    data = _data(stages, config, "data", Configuration(scene=scene, seed=config.seed), config.hops)
    held_out = _data(stages, config, "targets", Configuration(scene=scene, seed=config.seed + HELD_OUT_SEED), config.targets)
    held_out = held_out.rows(held_out.usable)
    for budget in budgets:
        _surrogate(stages, config, data, held_out, budget)
    _plans(stages, config, scene, data, held_out, budgets)
    _policy(stages, config, scene, held_out, budgets)
    _evaluation(stages, config, scene, held_out, budgets)
    _report(stages, config, scene, data, held_out, budgets)
    return stages


def spread_budgets(hops: int) -> list[int]:
    """Simulator calls at which methods are compared: an eighth, a quarter, a half and all of ``hops``, 4 at least."""
    return sorted({max(4, hops // k) for k in (8, 4, 2, 1)})


def _show_hop(stages: Stages, config: DemoConfig, scene: Scene) -> None:
    def work() -> Results:
        result = simulate(np.array(SHOWN_HOP), scene=scene, trajectory_rate=120.0)
        closure = figures.energies(result, stages.folder / "energies.png")
        figures.filmstrip(result, stages.folder / "hop.png")
        return {
            "stretches": SHOWN_HOP,
            "closure_percent": closure,
            "apex": float(result.apex[0]),
            "landing": result.landing[0].tolist(),
        }

    stages.run("hop", {"scene": asdict(scene), "stretches": SHOWN_HOP}, work, files=["energies.png", "hop.png"])


def _data(stages: Stages, config: DemoConfig, name: str, configuration: Configuration, hops: int) -> HopData:
    path = stages.folder / f"{name}.h5"

    def work() -> Results:
        data = generate(path, hops, configuration, progress=config.progress)
        drift = np.abs(np.ptp(data["energies"][data.usable].sum(axis=2), axis=1)) / data["stored_energy"][data.usable]
        worst = 100 * float(drift.max()) if len(drift) else float("nan")
        return {"hops": len(data), "failed": int((~data.usable).sum()), "closure_percent": worst, "seconds": data.seconds}

    stages.run(name, {"hops": hops, "configuration": configuration.as_dict()}, work, files=[path.name])
    data = dataset.read(path, expect=configuration).rows(slice(0, hops))
    if not data.usable.any():
        raise InvalidParameterError(
            f"{name}: expected at least one hop that did not fail, got none of {hops}; see `status` in {path}"
        )
    return data


def _surrogate(stages: Stages, config: DemoConfig, data: HopData, held_out: HopData, budget: int) -> None:
    name = f"surrogate_{budget}"
    path = stages.folder / f"{name}.safetensors"

    def work() -> Results:
        net, card = train(
            data.rows(slice(0, budget)), config.surrogate, progress=config.progress, desc=f"surrogate, {budget} hops"
        )
        mean, spread = net.predict(held_out["stretches"])
        card["predicted"], card["spread"] = mean.tolist(), spread.tolist()
        model.save(net, path, {k: v for k, v in card.items() if k not in ("predicted", "spread")})
        return {k: card[k] for k in ("epochs", "hops", "stopped_on", "rmse", "predicted", "spread", "seconds")}

    settings = {"train": asdict(config.surrogate), "hops": budget}
    stages.run(name, settings, work, needs=["data", "targets"], files=[path.name, beside(path, CARD).name])


def _plans(stages: Stages, config: DemoConfig, scene: Scene, data: HopData, held_out: HopData, budgets: list[int]) -> None:
    # a touchdown is told by a cheaper model, where a lattice comes to rest is not: after the tumble models land apart
    fidelity = Fidelity(flight="rigid", stop="landing") if scene.landing == "touchdown" else "paper"

    def work() -> Results:
        plans: Results = {"nearest": {}, "planner": {}, "turns": {}, "correction": {}}
        for budget in tqdm(budgets, desc="plans", unit="budget", disable=not config.progress):
            known = data.rows(slice(0, budget))
            known = known.rows(known.usable)
            net, _ = model.load(stages.folder / f"surrogate_{budget}.safetensors")
            started = time.perf_counter()
            correction = fit_kriging(net, known, config.surrogate.validation, config.surrogate.test)
            scale = None if correction is None else asdict(correction.scale)
            plans["correction"][str(budget)] = {"scale": scale, "seconds": time.perf_counter() - started}
            inverse = InversePlanner(
                net.landing,
                config.planner,
                correction=correction,
                stored=known["stretches"],
                images=net.landing_images,
                seed=config.seed + START_SEED,
            )
            planners: dict[str, Planner] = {
                "nearest": NearestHopPlanner(known["stretches"], known["landing"], images=net.landing_images),
                "planner": inverse,
            }
            if budget == config.hops:
                planners["turns"] = RefiningPlanner(inverse, Hops(scene, {"fidelity": fidelity}).land, TURNS)
            for method, planner in planners.items():
                started = time.perf_counter()
                stretches, _ = planner.predict(held_out["landing"])
                plans[method][str(budget)] = {"stretches": stretches.tolist(), "seconds": time.perf_counter() - started}
        return plans

    settings = {"planner": asdict(config.planner), "turns": TURNS, "scene": asdict(scene), "images": True}
    settings |= {"seed": config.seed + START_SEED}
    stages.run("plans", settings, work, needs=[f"surrogate_{b}" for b in budgets])


def _policy(stages: Stages, config: DemoConfig, scene: Scene, held_out: HopData, budgets: list[int]) -> None:
    # stable-baselines3 takes seconds to import
    from training.algorithms import LEAST_UPDATES
    from training.train_policy import PolicyConfig, check_calls, train_policy

    settings = PolicyConfig(calls=config.hops, seed=config.seed, updates=config.gradient_steps)
    # its hops come some at a time, and it spends an eighth of them before it begins to learn
    together = settings.together
    learnt = [b for b in budgets if b == config.hops or b > config.hops / 8 + together]
    budgets = sorted({-(-b // together) * together for b in learnt})
    path = stages.folder / "policy.safetensors"

    def work() -> Results:
        actors, card = train_policy(scene, settings, budgets=budgets, progress=config.progress)
        actors[config.hops].save(path, card)
        answers: Results = {}
        for budget in budgets:
            started = time.perf_counter()
            stretches, _ = actors[budget].predict(held_out["landing"])
            answers[str(budget)] = {"stretches": stretches.tolist(), "seconds": time.perf_counter() - started}
        return {"answers": answers, "simulator_calls": card["simulator_calls"], "seconds": card["seconds"]}

    # of the hyper-parameters what stands in their file counts
    how = {"values": check_calls(settings), "least_updates": LEAST_UPDATES}
    config_of_stage = {"policy": asdict(settings), "scene": asdict(scene), "budgets": budgets} | how
    stages.run("policy", config_of_stage, work, needs=["targets"], files=[path.name, beside(path, CARD).name])
    ActorPolicy.load(path)  # a damaged or foreign checkpoint is found now, by name


def _evaluation(stages: Stages, config: DemoConfig, scene: Scene, held_out: HopData, budgets: list[int]) -> None:
    answers = dict(stages.results["plans"]) | {"policy": stages.results["policy"]["answers"]}
    hops = Hops(scene, {"fidelity": SCORED_BY[scene.landing]})
    asked = [(method, budget) for method in METHODS for budget in answers[method]]
    starts = {b: STARTS if b == str(config.hops) else STARTS_BELOW[scene.landing] for _, b in asked}

    def work() -> Results:
        total = len(held_out) * (1 + STARTS + sum(starts[budget] for _, budget in asked))
        scores: Results = {method: {} for method in METHODS}
        with tqdm(total=total, desc="simulating the answers", unit="hop", disable=not config.progress) as bar:
            floor = scatter(held_out["stretches"], hops, STARTS)
            bar.update(hops.calls)
            for method, budget in asked:
                found = score_stretches(answers[method][budget]["stretches"], held_out["landing"], hops, starts[budget])
                scores[method][budget] = found.as_dict()
                bar.update(hops.calls - bar.n)
        return {"floor": floor.tolist(), **scores}

    settings = {"budgets": budgets, "starts": starts, "moved": POSITION, "seed": SEED, "fidelity": SCORED_BY[scene.landing]}
    stages.run("evaluation", settings, work, needs=["plans", "policy", "targets"])


def table_rows(stages: Stages, config: DemoConfig, scene: Scene, n_targets: int) -> list[dict[str, Any]]:
    """One row per method at the whole budget: errors, wall time to be able to answer, time per answer, calls."""
    simulating, whole = stages.seconds["data"], str(config.hops)
    training = {
        "nearest": simulating,
        "planner": simulating
        + stages.seconds[f"surrogate_{config.hops}"]
        + stages.results["plans"]["correction"][whole]["seconds"],
        "policy": stages.seconds["policy"],
    }
    training["turns"] = training["planner"]
    answers = dict(stages.results["plans"]) | {"policy": stages.results["policy"]["answers"]}
    calls = {"nearest": config.hops, "planner": config.hops, "turns": config.hops + TURNS * n_targets}
    calls |= {"policy": stages.results["policy"]["simulator_calls"]}
    rows = []
    for method, label in METHODS.items():
        found = Score.from_dict(stages.results["evaluation"][method][whole])
        answering = answers[method][whole]["seconds"]
        rows.append(
            {
                "method": label,
                **found.summary(reach(scene)),
                "wall_seconds": training[method] + answering,
                "answer_milliseconds": 1e3 * answering / n_targets,
                "simulator_calls": calls[method],
            }
        )
    return rows


def _report(stages: Stages, config: DemoConfig, scene: Scene, data: HopData, held_out: HopData, budgets: list[int]) -> None:
    def work() -> Results:
        folder, results = stages.folder, stages.results
        scores = {m: {int(b): Score.from_dict(s) for b, s in results["evaluation"][m].items()} for m in METHODS}
        predicted = np.array(results[f"surrogate_{config.hops}"]["predicted"])
        figures.landing_map(data.rows(data.usable), folder / "landing_map.png")
        figures.predicted_against_simulated(predicted, held_out, folder / "scatter.png")
        figures.plans(held_out["landing"], {METHODS[m]: s[config.hops] for m, s in scores.items()}, folder / "plans.png")
        shown, floor = {METHODS[m]: s for m, s in scores.items()}, np.array(results["evaluation"]["floor"])
        figures.error_against_calls(shown, reach(scene), float(np.median(floor)), folder / "error_calls.png")
        rows = table_rows(stages, config, scene, len(held_out))
        facts = {
            "hops": config.hops,
            "targets": len(held_out),
            "seed": config.seed,
            "scene": config.scene,
            "landing read at": config.landing,
            "reach [m]": f"{reach(scene):.3f}",
            "failed hops": f"{results['data']['failed']} of {len(data)}",
            "physics version": MODEL_VERSION,
            "answers scored by": f"fidelity {SCORED_BY[config.landing]}, starts moved by {1e6 * POSITION:g} µm",
            "packages": ", ".join(f"{k} {v}" for k, v in package_versions().items()),
        }
        closures = {"shown": results["hop"]["closure_percent"], "data": results["data"]["closure_percent"]}
        caption = report.scored(floor, STARTS)
        starts, below = str(STARTS), STARTS_BELOW[config.landing]
        if below < STARTS:
            starts += f", below {config.hops} calls {below}, from which medians come out a tenth lower or so"
        report.write(folder / "report.html", rows, caption, facts, closures, starts, SHOWN_HOP, dict(stages.seconds))
        return {"rows": rows, "caption": caption}

    pictures = ["landing_map.png", "scatter.png", "plans.png", "error_calls.png", "report.html"]
    stages.run(
        "report", {"scene": config.scene, "landing": config.landing}, work, needs=["hop", "data", "evaluation"], files=pictures
    )


def main(config: DemoConfig) -> None:
    """Entry of ``python -m training demo``."""
    started = time.perf_counter()
    stages = run(config)
    found = stages.results["report"]
    print(report.text_table(found["rows"], found["caption"]))
    print(f"report: {stages.folder / 'report.html'} ({time.perf_counter() - started:.0f} s in all)")
