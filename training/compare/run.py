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
from surrogate.storage import CARD, beside
from training.bayesian import BayesianConfig, BayesianPlanner, require_botorch
from training.compare import latency
from training.compare import targets as registered
from training.compare.config import CompareConfig
from training.compare.learn import Fitted, fit_net
from training.compare.methods import BAYESIAN, ORACLE, PLANNERS, REFINED, answer_calls, begins_from
from training.compare.question import How, Question
from training.evolution import EvolutionConfig, EvolutionPlanner
from training.inverse import LEAST_EQUAL
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
        if config.hyperparameters is not None or "ppo" in {algorithm for algorithm, _ in config.policies.values()}:
            from training.compare import policies

            policies.check(self)

    def run(self) -> None:
        """All stages whose scores are not kept, cheap ones first."""
        config = self.config
        if not find_spec("cma"):
            self.stages.say("cma: not installed, so its rows and the oracle are left out; pip install 'tensegrity-gym[cma]'")
        if self.scores.floor is None:
            self.measure_floor()
        for seed, budget in config.planner_runs:
            if not self.is_kept(self._planner_settings(seed), seed, budget):
                self._planner_run(seed, budget)
        self._oracle()
        for seed, budget in config.policy_runs:
            for method in config.policies:
                self.policy(method, seed, budget)
        if config.latencies:
            latency.measure(self)

    def _planner_run(self, seed: int, budget: int) -> None:
        """All planners of one seed and budget."""
        self.measure_floor()
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
                self.score(name, seed, budget, f"plans_{tag}", answers, How(content, self._learnt_in(name, tag)))

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
            "least_equal": LEAST_EQUAL,
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
        how = How(self._planner_settings(seed)[method], self._learnt_in(begins_from(method), tag))
        self.score(method, seed, budget, name, lambda: self.stages.results[name], how)

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
        if self.is_kept({ORACLE: settings}, 0, budget):
            return
        self.require_planners(0, budget)

        def work() -> Results:
            before = self.hops.calls
            stretches, _ = self._search_from(self.fitted(0, budget)["nearest"]).predict(self.targets)
            return {"stretches": stretches.tolist(), "calls_per_answer": (self.hops.calls - before) / len(self.targets)}

        self.stages.run(ORACLE, settings | {"targets": self.targets.tolist()}, work, needs=[f"net_0_{budget}"])
        calls = self.stages.results[ORACLE]["calls_per_answer"]
        self.score(ORACLE, 0, budget, ORACLE, lambda: self.stages.results[ORACLE], How(settings, 0.0, calls))

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

        if not self.is_kept({method: policies.settings_of(self, method, 0, budget)}, seed, budget):
            policies.run(self, method, seed, budget)

    def require_policy(self, method: str, seed: int, budget: int) -> None:
        """Have a policy's files, though its score may be kept."""
        from training.compare import policies

        if f"policy_{method}_{seed}_{budget}" not in self.stages.results:
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
    comparison.run()
    outcome = Outcome(comparison)
    folder = comparison.stages.folder
    comparison.scores.write(folder / "scores.jsonl")
    report.write_all(outcome, folder / "results.md", folder)
    if config.write:
        comparison.scores.write(config.kept_path)
        report.write_all(outcome, Path("docs/results.md"), Path("docs/images"), Path("README.md"))
    print(f"{report.by_budget(outcome)}\n\n{folder / 'results.md'}")
