"""The stages of a comparison. Each is kept when it is done, so that a killed or enlarged comparison goes on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from surrogate import dataset, model
from surrogate.dataset import HopData
from surrogate.generate import sample_stretches
from surrogate.model import HopNet
from surrogate.storage import CARD, beside, hash_of, package_versions
from tensegrity_gym import MODEL_VERSION
from tensegrity_gym.task import check_fidelity, reach
from training.bayesian import BayesianConfig, BayesianPlanner, require_botorch
from training.compare import latency
from training.compare import targets as registered
from training.compare.config import CompareConfig
from training.compare.learn import Fitted, fit_net, from_file, model_of, simulated
from training.compare.methods import BAYESIAN, ORACLE, PLANNERS, REFINED, answer_calls, begins_from
from training.compare.scores import Score, Scores, measure, rounded
from training.compare.statistics import interquartile_mean
from training.evolution import EvolutionConfig, EvolutionPlanner
from training.hops import Hops
from training.planner import BestOfPlanner, Planner
from training.refine import RefiningPlanner
from training.stages import Results, Stages

#: Hops of a pool that are simulated, and kept, together.
BLOCK = 2048
#: Random hops that the floor is measured on.
FLOOR_HOPS = 64
#: Packages whose versions are noted with scores.
NOTED = ("torch", "stable-baselines3")


class Comparison:
    """One scene and landing; see ``varied`` for scenes that vary."""

    #: Settings of policies that differ from the usual ones.
    policy_settings: ClassVar[dict[str, Any]] = {}
    #: Planners that hops in turn begin from.
    starts: ClassVar[tuple[str, ...]] = tuple(REFINED)
    hops: Any

    def __init__(self, config: CompareConfig) -> None:
        self.config = config
        if config.bayes:
            require_botorch()
        changes = {} if config.duration is None else {"duration": config.duration}
        self.scenes = registered.scenes_of(config.scene, config.landing, **changes)
        self.scene = self.scenes.base
        self.hops = self._simulator()
        self.stages = Stages(Path(config.out), say=print if config.progress else lambda _: None)
        self.places = registered.read(
            config.scene, config.landing, config.targets, registered.SECOND if config.second else registered.PATH
        )
        self.targets = np.concatenate(list(self.places.values()))
        #: Which targets are of a place, shape (targets,).
        self.rows = {p: np.repeat([p == q for q in self.places], [len(t) for t in self.places.values()]) for p in self.places}
        #: What every stage's record depends on.
        self.base = {"scene": asdict(self.scene), "fidelity": config.fidelity} | self._varying()
        #: What the methods are judged by: kept scores, where there are some, and those of this run.
        self.scores = Scores(self.task) if config.kept is None else Scores.read(config.kept, self.task)
        if config.hyperparameters is not None or "ppo" in {algorithm for algorithm, _ in config.policies.values()}:
            from training.compare import policies

            policies.check(self)
        self._fitted: dict[tuple[int, int], Fitted] = {}
        self._pools: dict[int, HopData] = {}

    def _simulator(self) -> Any:
        return Hops(self.scene, check_fidelity(self.config.fidelity), self.config.threads)

    @property
    def reaches(self) -> np.ndarray:
        """Reach of the scene of each target, shape (n,) [m]."""
        return np.full(len(self.targets), reach(self.scene))

    def _varying(self) -> dict[str, Any]:
        """What records depend on where scenes vary."""
        return {}

    @property
    def units(self) -> np.ndarray:
        """What lengths are divided by in scores: metres, shape (n,) [m]."""
        return np.ones(len(self.targets))

    @property
    def task(self) -> dict[str, Any]:
        """What all scores have in common."""
        counts = {place: len(targets) for place, targets in self.places.items()}
        given = {"perturbations": self.config.perturbations, "places": counts, "targets": hash_of(self.targets.tolist())}
        return self.base | given | {"model_version": MODEL_VERSION}

    def run(self) -> None:
        """All stages whose scores are not kept, cheap ones first."""
        config = self.config
        if not find_spec("cma"):
            self.stages.say("cma: not installed, so its rows and the oracle are left out; pip install 'tensegrity-gym[cma]'")
        if self.scores.floor is None:
            self._floor()
        for seed, budget in config.planner_runs:
            if not self._is_kept(self._planner_settings(seed), seed, budget):
                self._planner_run(seed, budget)
        self._oracle()
        for seed, budget in config.policy_runs:
            for method in config.policies:
                self.policy(method, seed, budget)
        if config.latencies:
            latency.measure(self)

    def _is_kept(self, settings: Mapping[str, Any], seed: int, budget: int) -> bool:
        """Whether the kept scores have all these methods, with their settings."""
        kept = all(self.scores.holds(method, budget, seed, hash_of(content)) for method, content in settings.items())
        if kept:
            self.stages.say(f"seed {seed} after {budget} calls: scores of {', '.join(settings)} kept")
        return kept

    def _planner_run(self, seed: int, budget: int) -> None:
        """All planners of one seed and budget."""
        self._floor()
        self._planners(seed, budget)
        for method, (stage, make) in self.trying(seed).items():
            self._tried(method, stage, make, seed, budget)

    def require_planners(self, seed: int, budget: int) -> None:
        """Have the nets and plans of a seed and budget, though their scores may be kept."""
        if f"plans_{seed}_{budget}" not in self.stages.results:
            self._planner_run(seed, budget)

    def trying(self, seed: int) -> dict[str, tuple[str, Callable[[Any], Planner]]]:
        """Methods that simulate hops for each answer: their stage, and how they are made of what was fitted."""
        config = self.config
        found: dict[str, tuple[str, Callable[[Any], Planner]]] = {}
        if config.tries_seeds is None or seed < config.tries_seeds:
            found |= {f"best{t}": (f"best{t}", partial(self._best, tries=t)) for t in config.tries}
        for tries in config.refine:
            methods = {f"{REFINED[start]}{tries}": start for start in self.starts}
            found |= {m: (m, partial(self._refining, start=start, tries=tries)) for m, start in methods.items()}
        if config.bayes and (config.bayes_seeds is None or seed < config.bayes_seeds):
            found[f"{BAYESIAN}{config.bayes}"] = (BAYESIAN, partial(self._optimising, tries=config.bayes))
        return found

    def trying_settings(self, method: str) -> dict[str, Any]:
        """What answers of a method that simulates hops depend on besides plans."""
        settings: dict[str, Any] = {"tries": answer_calls(method)}
        if method.startswith(tuple(REFINED.values())):
            settings["method"] = "secant, stretches held at the ends of their range"
        if method.startswith(BAYESIAN):
            settings["process"] = asdict(BayesianConfig())
        return settings

    def _planner_settings(self, seed: int) -> dict[str, dict[str, Any]]:
        """What scores of the planners of a seed depend on besides seed and budget, by method."""
        plans = self.learning | self.planning
        return dict.fromkeys(self.names, plans) | {m: plans | self.trying_settings(m) for m in self.trying(seed)}

    def pool(self, seed: int) -> HopData:
        """The hops of a seed: as many as the largest budget; smaller budgets are its first rows."""
        if seed in self._pools:
            return self._pools[seed]
        most = max(self.config.budgets)
        if self.config.data is not None:
            found = from_file(self.config.data, self.scenes, self.config.fidelity, seed, most)
        else:
            found = dataset.concatenate([self._block(seed, k, most) for k in range(0, most, BLOCK)])
        self._pools = {seed: found}  # one at a time in memory
        return found

    def learnt(self, seed: int, budget: int) -> HopData:
        """The hops that planners of a seed and budget learn from, with a record of which they are."""
        pool, name = self.pool(seed), f"hops_{seed}_{budget}"
        found = pool.rows(slice(0, budget))
        if name not in self.stages.hashes:
            seconds = pool.seconds * budget / len(pool)
            self.stages.run(name, self.base | {"digest": found.digest}, lambda: {"seconds": seconds})
        return found

    def _block(self, seed: int, first: int, most: int) -> HopData:
        last = min(first + BLOCK, most)
        path = self.stages.folder / f"hops_{seed}_{first}_{last}.h5"

        def work() -> Results:
            part = simulated(self.hops, sample_stretches(last, seed)[first:last], seed)
            dataset.write(path, part)
            return {"seconds": part.seconds}

        self.stages.run(path.stem, self.base | {"seed": seed, "first": first, "last": last}, work, files=[path.name])
        found, made = dataset.read(path), model_of(self.config.fidelity, self.scene)
        # older files name the paper's model whichever made them; the stage's record knows
        configuration = found.configuration | {"fidelity": made.levers(), "precision": made.precision}
        return HopData(found.columns, configuration, found.seconds)

    def _floor(self) -> None:
        if "floor" in self.stages.results:
            return
        found = self.stages.run("floor", self.base | {"perturbations": self.config.perturbations}, self._moved_hops)
        moved = np.array(found["distances"]).mean(axis=1) / np.array(found.get("reaches", 1.0))
        self.scores.floor = rounded(float(interquartile_mean(moved)))

    def _moved_hops(self) -> Results:
        """How far moved starts carry random hops [m]."""
        landings = self.hops.perturbed(sample_stretches(FLOOR_HOPS, 99), self.config.perturbations)
        return {"distances": np.linalg.norm(landings[:, 1:] - landings[:, :1], axis=2).tolist()}

    @property
    def floor(self) -> float:
        """How far moved starts land from where the unmoved one does, root mean square in each direction [m]."""
        return float(np.sqrt(np.mean(np.square(self.stages.results["floor"]["distances"])) / 2))

    def fitted(self, seed: int, budget: int) -> Fitted:
        """Planners of a seed and budget."""
        if (seed, budget) not in self._fitted:
            net, _ = model.load(self.stages.folder / f"net_{seed}_{budget}.safetensors")
            self._fitted = {(seed, budget): self._fit(net, self.learnt(seed, budget), seed)}
        return self._fitted[seed, budget]

    def _fit(self, net: HopNet, data: HopData, seed: int) -> Any:
        return Fitted(net, data, self.config, seed, self.floor)

    def _planners(self, seed: int, budget: int) -> None:
        config, tag = self.config, f"{seed}_{budget}"
        path = self.stages.folder / f"net_{tag}.safetensors"
        data = self.learnt(seed, budget)

        def learn() -> Results:
            net, card = fit_net(data, config, seed)
            model.save(net, path, card)
            return {"seconds": card["seconds"]}

        files = [path.name, beside(path, CARD).name]
        self.stages.run(f"net_{tag}", self.learning, learn, needs=[f"hops_{tag}"], files=files)

        def plan() -> Results:
            fitted = self.fitted(seed, budget)
            answers = {name: fitted[name].predict(self.targets)[0].tolist() for name in self.names}
            return {name: {"stretches": answers[name], "seconds": fitted.seconds[name]} for name in self.names}

        settings = self.planning | {"planners": self.names}
        self.stages.run(f"plans_{tag}", settings | {"targets": self.targets.tolist()}, plan, needs=[f"net_{tag}", "floor"])
        for name, content in self._planner_settings(seed).items():
            if name in self.names:
                answers = partial(self._planned, f"plans_{tag}", name)
                self.score(name, seed, budget, f"plans_{tag}", answers, content, self._learnt_in(name, tag))

    @property
    def learning(self) -> dict[str, Any]:
        """What nets depend on besides hops."""
        return {"surrogate": asdict(self.config.surrogate), "updates": self.config.updates}

    def _learnt_in(self, planner: str, tag: str) -> float:
        """Wall time that a planner learnt for, simulating left out [s]."""
        own = float(self.stages.results[f"plans_{tag}"][planner]["seconds"])
        return own + (0.0 if planner == "nearest" else self.stages.seconds[f"net_{tag}"])

    @property
    def planning(self) -> dict[str, Any]:
        """What plans depend on besides nets and targets."""
        config = self.config
        return {
            "inverse": asdict(config.inverse),
            "tandem": asdict(config.tandem),
            "search": config.search,
            "images": True,  # of stored hops, which planners did without before
        }

    def _planned(self, stage: str, name: str) -> Results:
        return self.stages.results[stage][name]

    @property
    def names(self) -> list[str]:
        """Planners that can run here."""
        return [name for name in PLANNERS if name != "cma" or find_spec("cma")]

    def _tried(self, method: str, stage: str, make: Callable[[Any], Planner], seed: int, budget: int) -> None:
        """Answers of a planner that tries hops, and their score."""
        tag = f"{seed}_{budget}"
        name = f"{stage}_{tag}"

        def work() -> Results:
            return {"stretches": make(self.fitted(seed, budget)).predict(self.targets)[0].tolist()}

        self.stages.run(name, self.trying_settings(method), work, needs=[f"plans_{tag}"])
        settings = self._planner_settings(seed)[method]
        seconds = self._learnt_in(begins_from(method), tag)
        self.score(method, seed, budget, name, lambda: self.stages.results[name], settings, seconds)

    def _best(self, fitted: Any, tries: int) -> Planner:
        return BestOfPlanner(fitted.inverse, self.hops.land, tries)

    def _refining(self, fitted: Any, start: str, tries: int) -> Planner:
        return RefiningPlanner(fitted[start], self.hops.land, tries)

    def _optimising(self, fitted: Any, tries: int) -> Planner:
        return BayesianPlanner(fitted.inverse, self.hops.land, fitted.data["stretches"], fitted.data["landing"], tries)

    def _oracle(self) -> None:
        if not self.config.oracle or not find_spec("cma"):
            return
        budget = max(self.config.budgets)
        settings = {"search": asdict(self._search), "images": True}
        if self._is_kept({ORACLE: settings}, 0, budget):
            return
        self.require_planners(0, budget)

        def work() -> Results:
            before = self.hops.calls
            stretches, _ = self._search_from(self.fitted(0, budget)["nearest"]).predict(self.targets)
            return {"stretches": stretches.tolist(), "calls_per_answer": (self.hops.calls - before) / len(self.targets)}

        self.stages.run(ORACLE, settings | {"targets": self.targets.tolist()}, work, needs=[f"net_0_{budget}"])
        calls = self.stages.results[ORACLE]["calls_per_answer"]
        self.score(ORACLE, 0, budget, ORACLE, lambda: self.stages.results[ORACLE], settings, 0.0, calls)

    def _search_from(self, start: Planner) -> Planner:
        """CMA-ES on the simulator."""
        return EvolutionPlanner(self.hops.land, start, self._search)

    @property
    def _search(self) -> EvolutionConfig:
        # the nearest stored hop is near already, and the map is rough: a wide first generation would only lose it
        return EvolutionConfig(self.config.oracle, min(8, self.config.oracle), sigma=0.01)

    def policy(self, method: str, seed: int, budget: int) -> None:
        """Train a policy, and score it, unless its score is kept."""
        from training.compare import policies  # stable-baselines3 takes seconds to import

        if not self._is_kept({method: policies.settings_of(self, method, 0, budget)}, seed, budget):
            policies.run(self, method, seed, budget)

    def require_policy(self, method: str, seed: int, budget: int) -> None:
        """Have a policy's files, though its score may be kept."""
        from training.compare import policies

        if f"policy_{method}_{seed}_{budget}" not in self.stages.results:
            policies.run(self, method, seed, budget)

    def score(
        self,
        method: str,
        seed: int,
        budget: int,
        needs: str,
        answers: Callable[[], Any],
        settings: Mapping[str, Any],
        seconds: float,
        calls_per_answer: float | None = None,
    ) -> None:
        """Simulate the answers of a method, from their start and from moved ones, and take down how near they come."""

        def work() -> Results:
            stretches = np.array(answers()["stretches"])
            landings = self.hops.perturbed(stretches, self.config.perturbations, self.targets)
            return {"stretches": stretches.tolist(), "landings": landings.tolist()}

        content = self.base | {"perturbations": self.config.perturbations, "targets": self.targets.tolist()}
        name = f"score_{method}_{seed}_{budget}"
        found = self.stages.run(name, content, work, needs=[needs])
        landings = np.array(found["landings"], dtype=np.float64)[:, 1:]
        errors, scatter = measure(landings, self.targets[:, :2], self.reaches, self.units, self.rows["inside"])
        self.scores.add(
            Score(
                method,
                budget,
                seed,
                errors,
                scatter,
                rounded(seconds),
                hash_of(settings),
                self.stages.dates[name][:10],
                ", ".join(f"{name} {version}" for name, version in package_versions().items() if name in NOTED),
                calls_per_answer,
            )
        )


def comparison_of(config: CompareConfig) -> Comparison:
    """The comparison that a configuration asks for."""
    from training.compare.varied import VariedComparison

    return VariedComparison(config) if config.scene in registered.VARIED else Comparison(config)


def main(config: CompareConfig) -> None:
    """Entry of ``python -m training compare``."""
    from training.compare import report
    from training.compare.results import Outcome

    if config.quick:
        config = config.shortened()
    comparison = comparison_of(config)
    comparison.run()
    outcome = Outcome(comparison)
    folder = comparison.stages.folder
    comparison.scores.write(folder / "scores.jsonl")
    report.write_all(outcome, folder / "results.md", folder)
    if config.write:
        comparison.scores.write(config.kept_path)
        report.write_all(outcome, Path("docs/results.md"), Path("docs/images"), Path("README.md"))
    print(f"{report.by_budget(outcome)}\n\n{folder / 'results.md'}")
