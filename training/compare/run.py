"""The stages of a comparison. Each is kept when it is done, so that a killed or enlarged comparison goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from surrogate import model
from surrogate.dataset import HopData
from surrogate.model import HopNet
from surrogate.storage import CARD, beside, hash_of
from training.bayesian import BayesianConfig, BayesianPlanner, require_botorch
from training.compare import latency
from training.compare import targets as registered
from training.compare.config import CompareConfig
from training.compare.learn import Fitted, fit_net
from training.compare.methods import BAYESIAN, ORACLE, PLANNERS, PLANNERS_VERSION, REFINED, answer_calls, begins_from
from training.compare.question import Question
from training.compare.scores import Scores
from training.evolution import EvolutionConfig, EvolutionPlanner
from training.planner import BestOfPlanner, Planner
from training.refine import RefiningPlanner
from training.stages import Results


class Comparison(Question):
    """All methods that answer it."""

    #: Settings of policies that differ from the usual ones.
    policy_settings: ClassVar[dict[str, Any]] = {}
    #: Planners that hops in turn begin from.
    starts: ClassVar[tuple[str, ...]] = tuple(REFINED)

    def __init__(self, config: CompareConfig) -> None:
        if config.bayes:
            require_botorch()
        super().__init__(config)
        self._fitted: dict[tuple[int, int], Fitted] = {}
        if config.hyperparameters is not None or any(method.startswith("ppo") for method in config.policies):
            from training.compare import policies

            policies.check(self)
        self._leave_out_stale()

    def _leave_out_stale(self) -> None:
        """Of the kept scores, take only those that were made with today's settings."""
        for method in self.scores.methods:
            if method == ORACLE and not self.config.oracle:
                continue  # not asked for, and no worse for that
            if self.scores.settings(method) != hash_of(self.settings_of(method)):
                gone = self.scores.drop(method)
                self.stages.say(f"{method}: {gone} kept scores were made with other settings, left out")
        for method, found in list(self.scores.latencies.items()):
            if found.settings != latency.settings_of(self, method):
                self.scores.drop_latency(method)
                self.stages.say(f"{method}: its kept latency was measured with other settings, left out")

    def run(self) -> None:
        """All stages whose scores are not kept, cheap ones first."""
        config = self.config
        if not find_spec("cma"):
            self.stages.say("cma: not installed, so nothing of it is run; pip install 'tensegrity-gym[cma]'")
        if self.scores.floor is None:
            self.measure_floor()
        for seed, budget in config.planner_runs:
            self._planner_run(seed, budget)
        self._oracle()
        for seed, budget in config.policy_runs:
            for method in config.policies:
                self.policy(method, seed, budget)
        if config.latencies:
            latency.measure(self)

    def _lacking(self, methods: list[str], seed: int, budget: int) -> list[str]:
        """Methods whose scores are not kept."""
        lacking = [method for method in methods if (method, budget, seed) not in self.scores.lines]
        if len(lacking) < len(methods):
            self.stages.say(f"seed {seed} after {budget} calls: scores kept{f', but for {lacking}' if lacking else ''}")
        return lacking

    def _planner_run(self, seed: int, budget: int) -> None:
        """All planners of one seed and budget whose scores are not kept."""
        trying = self.trying(seed)
        lacking = self._lacking([*self.names, *trying], seed, budget)
        if not lacking:
            return
        for method in lacking:
            planner = begins_from(method)
            plan = self._plan(planner, seed, budget)
            seconds = self._learnt_in(planner, seed, budget)
            if method in trying:
                plan = self._try(*trying[method], self.trying_settings(method), plan, seed, budget)
            self.score(method, seed, budget, plan, partial(self.stages.results.__getitem__, plan), seconds=seconds)

    def require(self, method: str, seed: int, budget: int) -> str:
        """Have the hops, the net or the policy that answers come of, though scores may be kept; returns its stage."""
        if begins_from(method) in PLANNERS:
            return self._basis(begins_from(method), seed, budget)
        from training.compare import policies

        return policies.train(self, method, seed, budget)

    def settings_of(self, method: str) -> dict[str, Any]:
        """All that scores of a method depend on besides budget and seed."""
        config, start = self.config, begins_from(method)
        if start not in PLANNERS and method != ORACLE:
            from training.compare import policies  # stable-baselines3 takes seconds to import

            return policies.settings_of(self, method)
        hops = "simulated for each seed" if config.data is None else "of a file"
        settings: dict[str, Any] = {"version": PLANNERS_VERSION, "hops": hops, "start": start}
        if method == ORACLE:
            return settings | {"search": config.oracle}
        if start != "nearest":
            settings |= self.learning
        settings |= self._own_settings(start)
        return settings if method == start else settings | self.trying_settings(method)

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
            if method.startswith(REFINED["nearest"]):
                settings["begins"] = "from what the stored hop is known to land at"
        if method.startswith(BAYESIAN):
            settings["process"] = asdict(BayesianConfig())
        return settings

    def fitted(self, seed: int, budget: int) -> Fitted:
        """Planners of a seed and budget."""
        if (seed, budget) not in self._fitted:
            path = self.stages.folder / f"net_{seed}_{budget}.safetensors"
            self._fitted = {(seed, budget): self._fit(lambda: model.load(path)[0], self.learnt(seed, budget), seed)}
        return self._fitted[seed, budget]

    def _fit(self, load: Callable[[], HopNet], data: HopData, seed: int) -> Any:
        return Fitted(load, data, self.config, seed, self.images, self.floor)

    def _basis(self, planner: str, seed: int, budget: int) -> str:
        """What a planner is made from: the hops, where it needs nothing else, or the net; returns its stage."""
        self.measure_floor()  # which planners are told
        if planner != "nearest":
            return self._learn(seed, budget)
        self.learnt(seed, budget)
        return f"hops_{seed}_{budget}"

    def _learn(self, seed: int, budget: int) -> str:
        """Train a net; returns its stage."""
        path = self.stages.folder / f"net_{seed}_{budget}.safetensors"
        data = self.learnt(seed, budget)

        def work() -> Results:
            net, card = fit_net(data, self.config, seed)
            model.save(net, path, card)
            return {"seconds": card["seconds"]}

        if path.stem not in self.stages.results:
            files = [path.name, beside(path, CARD).name]
            self.stages.run(path.stem, self.learning, work, needs=[f"hops_{seed}_{budget}"], files=files)
        return path.stem

    def _plan(self, planner: str, seed: int, budget: int) -> str:
        """Answers of a planner that simulates nothing; returns their stage."""
        name = f"plan_{planner}_{seed}_{budget}"
        if name in self.stages.results:
            return name

        def work() -> Results:
            fitted = self.fitted(seed, budget)
            answers = fitted[planner].predict(self.targets)[0].tolist()
            return {"stretches": answers, "seconds": fitted.seconds[planner]}

        settings = {"version": PLANNERS_VERSION, "targets": self.targets.tolist()} | self._own_settings(planner)
        self.stages.run(name, settings, work, needs=[self._basis(planner, seed, budget), "floor"])
        return name

    @property
    def learning(self) -> dict[str, Any]:
        """What nets depend on besides hops."""
        return {"surrogate": asdict(self.config.surrogate), "updates": self.config.updates}

    def _learnt_in(self, planner: str, seed: int, budget: int) -> float:
        """Wall time that a planner learnt for, simulating left out [s]."""
        own = float(self.stages.results[f"plan_{planner}_{seed}_{budget}"]["seconds"])
        return own + (0.0 if planner == "nearest" else self.stages.seconds[f"net_{seed}_{budget}"])

    def _own_settings(self, planner: str) -> dict[str, Any]:
        """What plans depend on besides nets, hops and targets."""
        config = self.config
        own: dict[str, dict[str, Any]] = {
            "nearest": {},
            "single": {"inverse": asdict(config.inverse)},
            "ensemble": {"inverse": asdict(config.inverse)},
            "tandem": {"tandem": asdict(config.tandem)},
            "cma": {"search": config.search},
        }
        return own[planner]

    @property
    def names(self) -> list[str]:
        """Planners that can run here."""
        return [name for name in PLANNERS if name != "cma" or find_spec("cma")]

    def _try(
        self, stage: str, make: Callable[[Any], Planner], settings: dict[str, Any], plan: str, seed: int, budget: int
    ) -> str:
        """Answers of a planner that tries hops, begun as ``plan`` says; returns their stage."""
        name = f"{stage}_{seed}_{budget}"

        def work() -> Results:
            return {"stretches": make(self.fitted(seed, budget)).predict(self.targets)[0].tolist()}

        self.stages.run(name, settings, work, needs=[plan])
        return name

    def _best(self, fitted: Any, tries: int) -> Planner:
        return BestOfPlanner(fitted.inverse, self.hops.land, tries)

    def _refining(self, fitted: Any, start: str, tries: int) -> Planner:
        return RefiningPlanner(fitted[start], self.hops.land, tries)

    def _optimising(self, fitted: Any, tries: int) -> Planner:
        return BayesianPlanner(fitted.inverse, self.hops.land, fitted.data["stretches"], fitted.data["landing"], tries)

    def _oracle(self) -> None:
        if not self.config.oracle or not find_spec("cma") or ORACLE in self.scores.methods:
            return
        budget = max(self.config.budgets)
        hops = self._basis("nearest", 0, budget)

        def work() -> Results:
            before = self.hops.calls
            stretches, _ = self._search_from(self.fitted(0, budget)["nearest"]).predict(self.targets)
            return {"stretches": stretches.tolist(), "calls_per_answer": (self.hops.calls - before) / len(self.targets)}

        settings = {"search": asdict(self._search), "images": True, "targets": self.targets.tolist()}
        found = self.stages.run(ORACLE, settings, work, needs=[hops])
        calls = found["calls_per_answer"]
        self.score(ORACLE, 0, budget, ORACLE, lambda: found, seconds=0.0, calls_per_answer=calls)

    def _search_from(self, start: Planner) -> Planner:
        """CMA-ES on the simulator."""
        return EvolutionPlanner(self.hops.land, start, self._search)

    @property
    def _search(self) -> EvolutionConfig:
        # the nearest stored hop is near already, and the map is rough: a wide first generation would only lose it
        return EvolutionConfig(self.config.oracle, min(8, self.config.oracle), sigma=0.01)

    def policy(self, method: str, seed: int, budget: int) -> None:
        """Train a policy, and score it, unless its score is kept."""
        if self._lacking([method], seed, budget):
            from training.compare import policies

            policies.run(self, method, seed, budget)


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
    folder = comparison.stages.folder
    path = folder / "scores.jsonl"
    if not config.anew:
        Scores.read(path, comparison.task)  # scores of another task are refused before hours of work, not after
    comparison.run()
    outcome = Outcome(comparison)
    comparison.scores.write(path, anew=config.anew)
    report.write_all(outcome, folder / "results.md", folder)
    if config.write:
        comparison.scores.write(config.kept_path, anew=config.anew)
        report.write_all(outcome, Path("docs/results.md"), Path("docs/images"), Path("README.md"))
    print(f"{report.by_budget(outcome)}\n\n{folder / 'results.md'}")
