"""The stages of a comparison. Each is kept when it is done, so that a killed or enlarged comparison goes on."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from surrogate import dataset, model
from surrogate.dataset import HopData
from surrogate.generate import sample_stretches
from surrogate.model import HopNet, one_thread
from surrogate.storage import CARD, POLICY_STATE, beside
from tensegrity_gym.task import check_fidelity, reach
from training.bayesian import BayesianConfig, BayesianPlanner, require_botorch
from training.compare import targets as registered
from training.compare.config import CompareConfig
from training.compare.learn import PLANNERS, Fitted, fit_net, from_file, model_of, simulated
from training.evolution import EvolutionConfig, EvolutionPlanner
from training.hops import Hops
from training.planner import BestOfPlanner, Planner
from training.policies import ActorPolicy
from training.refine import RefiningPlanner
from training.stages import Results, Stages

#: Hops of a pool that are simulated, and kept, together.
BLOCK = 2048
#: Random hops that the floor is measured on.
FLOOR_HOPS = 64
#: Planners whose answers hops in turn may begin from, and what the methods that do so are called, before how many they are.
REFINED = {"nearest": "repeat", "ensemble": "refine"}
#: How the names of methods begin that simulate some hops for each answer, whose number follows, and what they begin from.
SIMULATING = {"best": "ensemble", "repeat": "nearest", "refine": "ensemble", "bayes": "ensemble"}
#: Targets of questions whose latency is measured.
LATENCY_SEED = 5


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
        learning = {algorithm for algorithm, _ in config.policies.values()}
        if config.hyperparameters is not None or "ppo" in learning:
            from training.train_policy import PolicyConfig, check_calls  # stable-baselines3 takes seconds to import

            for algorithm in learning:  # what no policy can learn from is refused now, not after all planners
                for budget in config.budgets_of_policies:
                    check_calls(
                        PolicyConfig(algorithm, calls=budget, hyperparameters=self._source(algorithm), **self.policy_settings)
                    )
        changes = {} if config.duration is None else {"duration": config.duration}
        self.scenes = registered.scenes_of(config.scene, config.landing, **changes)
        self.scene = self.scenes.base
        self.hops = self._simulator()
        self.stages = Stages(Path(config.out), say=print if config.progress else lambda _: None)
        self.places = registered.read(
            config.scene, config.landing, config.targets, registered.SECOND if config.second else registered.PATH
        )
        self.targets = np.concatenate(list(self.places.values()))
        #: What every stage's record depends on.
        self.base = {"scene": asdict(self.scene), "fidelity": config.fidelity}
        self._fitted: dict[tuple[int, int], Fitted] = {}
        self._pools: dict[int, HopData] = {}

    def _simulator(self) -> Any:
        return Hops(self.scene, check_fidelity(self.config.fidelity), self.config.threads)

    @property
    def reaches(self) -> np.ndarray:
        """Reach of the scene of each target, shape (n,) [m]."""
        return np.full(len(self.targets), reach(self.scene))

    def run(self) -> None:
        """All stages, cheap ones first."""
        config = self.config
        if not find_spec("cma"):
            self.stages.say("cma: not installed, so its rows and the oracle are left out; pip install 'tensegrity-gym[cma]'")
        self._floor()
        for seed, budget in config.planner_runs:
            self._planners(seed, budget)
            if config.tries_seeds is None or seed < config.tries_seeds:
                for tries in config.tries:
                    self._best_of(tries, seed, budget)
            for tries in config.refine:
                for start in self.starts:
                    self._refined(start, tries, seed, budget)
            if config.bayes and (config.bayes_seeds is None or seed < config.bayes_seeds):
                self._bayesian(seed, budget)
        self._oracle()
        for seed, budget in config.policy_runs:
            for method in config.policies:
                self.policy(method, seed, budget)
        if config.latencies:
            self._latency()

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
        def work() -> Results:
            landings = self.hops.perturbed(sample_stretches(FLOOR_HOPS, 99), self.config.perturbations)
            return {"distances": np.linalg.norm(landings[:, 1:] - landings[:, :1], axis=2).tolist()}

        self.stages.run("floor", self.base | {"perturbations": self.config.perturbations}, work)

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

        settings = {"surrogate": asdict(config.surrogate), "updates": config.updates}
        files = [path.name, beside(path, CARD).name]
        self.stages.run(f"net_{tag}", settings, learn, needs=[f"hops_{tag}"], files=files)

        def plan() -> Results:
            fitted = self.fitted(seed, budget)
            answers = {name: fitted[name].predict(self.targets)[0].tolist() for name in self.names}
            return {name: {"stretches": answers[name], "seconds": fitted.seconds[name]} for name in self.names}

        settings = self._planning | {"planners": self.names}
        self.stages.run(f"plans_{tag}", settings | {"targets": self.targets.tolist()}, plan, needs=[f"net_{tag}", "floor"])
        for name in self.names:
            self._score(name, seed, budget, f"plans_{tag}", partial(self._kept, f"plans_{tag}", name))

    @property
    def _planning(self) -> dict[str, Any]:
        """What plans depend on besides nets and targets."""
        config = self.config
        return {
            "inverse": asdict(config.inverse),
            "tandem": asdict(config.tandem),
            "search": config.search,
            "images": True,  # of stored hops, which planners did without before
        }

    def _kept(self, stage: str, name: str) -> Results:
        return self.stages.results[stage][name]

    @property
    def names(self) -> list[str]:
        """Planners that can run here."""
        return [name for name in PLANNERS if name != "cma" or find_spec("cma")]

    def _best_of(self, tries: int, seed: int, budget: int) -> None:
        self._tried(f"best{tries}", f"best{tries}", {"tries": tries}, lambda fitted: self._best(fitted, tries), seed, budget)

    def _refined(self, start: str, tries: int, seed: int, budget: int) -> None:
        method = f"{REFINED[start]}{tries}"
        settings = {"tries": tries, "method": "secant, stretches held at the ends of their range"}
        self._tried(method, method, settings, lambda fitted: self._refining(fitted, start, tries), seed, budget)

    def _bayesian(self, seed: int, budget: int) -> None:
        tries = self.config.bayes
        settings = {"tries": tries, "process": asdict(BayesianConfig())}
        self._tried(f"bayes{tries}", "bayes", settings, lambda fitted: self._optimising(fitted, tries), seed, budget)

    def _tried(
        self, method: str, stage: str, settings: Results, planner: Callable[[Any], Planner], seed: int, budget: int
    ) -> None:
        """Answers of a planner that tries hops, and their score."""
        tag = f"{seed}_{budget}"
        name = f"{stage}_{tag}"

        def work() -> Results:
            return {"stretches": planner(self.fitted(seed, budget)).predict(self.targets)[0].tolist()}

        self.stages.run(name, settings, work, needs=[f"plans_{tag}"])
        self._score(method, seed, budget, name, lambda: self.stages.results[name])

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

        def work() -> Results:
            before = self.hops.calls
            stretches, _ = self._search_from(self.fitted(0, budget)["nearest"]).predict(self.targets)
            return {"stretches": stretches.tolist(), "calls_per_answer": (self.hops.calls - before) / len(self.targets)}

        settings = {"search": asdict(self._search), "targets": self.targets.tolist(), "images": True}
        self.stages.run("oracle", settings, work, needs=[f"net_0_{budget}"])
        self._score("oracle", 0, budget, "oracle", lambda: self.stages.results["oracle"])

    def _search_from(self, start: Planner) -> Planner:
        """CMA-ES on the simulator."""
        return EvolutionPlanner(self.hops.land, start, self._search)

    @property
    def _search(self) -> EvolutionConfig:
        # the nearest stored hop is near already, and the map is rough: a wide first generation would only lose it
        return EvolutionConfig(self.config.oracle, min(8, self.config.oracle), sigma=0.01)

    def _source(self, algorithm: str) -> Path | None:
        """The file of an algorithm's hyper-parameters, None for the committed one."""
        return self.config.hyperparameters and self.config.hyperparameters / f"{algorithm}.toml"

    def policy(self, method: str, seed: int, budget: int) -> None:
        """Train a policy, and score it."""
        from training.train_policy import PolicyConfig, train_policy  # stable-baselines3 takes seconds to import

        algorithm, symmetric = self.config.policies[method]
        name = f"policy_{method}_{seed}_{budget}"
        path = self.stages.folder / f"{name}.safetensors"
        source = self._source(algorithm)
        settings = PolicyConfig(
            algorithm,
            calls=budget,
            seed=seed,
            symmetric=symmetric,
            fidelity=self.config.fidelity,
            hyperparameters=source,
            **self.policy_settings,
        )

        def work() -> Results:
            state = beside(path, POLICY_STATE)
            actors, card = train_policy(
                self.scenes, settings, progress=self.config.progress, state=state, threads=self.config.threads
            )
            actors[budget].save(path, card)
            state.unlink(missing_ok=True)
            return {
                "seconds": card["seconds"],
                "simulating": card["simulating_seconds"],
                "values": card["train"]["hyperparameters"],
            }

        from training.algorithms import LEAST_UPDATES, hyperparameters, is_cap_passed

        values = hyperparameters(algorithm, source)
        # what stands in the file counts, not where it lies; policies from before some could know symmetries say nothing of them
        told = {k: v for k, v in asdict(settings).items() if k != "symmetric" or v}
        content: dict[str, Any] = self.base | {"config": told | {"hyperparameters": None}, "values": values}
        if is_cap_passed(values, budget):
            content["least_updates"] = LEAST_UPDATES  # trained before there was a least, a policy of so many hops is another
        self.stages.run(name, content, work, files=[path.name, beside(path, CARD).name])
        self._score(method, seed, budget, name, lambda: {"stretches": ActorPolicy.load(path).predict(self.targets)[0]})

    def _score(self, method: str, seed: int, budget: int, needs: str, answers: Callable[[], Any]) -> None:
        """Simulate the answers of a method, from their start and from moved ones."""

        def work() -> Results:
            stretches = np.array(answers()["stretches"])
            landings = self.hops.perturbed(stretches, self.config.perturbations, self.targets)
            return {"stretches": stretches.tolist(), "landings": landings.tolist()}

        content = self.base | {"perturbations": self.config.perturbations, "targets": self.targets.tolist()}
        self.stages.run(f"score_{method}_{seed}_{budget}", content, work, needs=[needs])

    def _latency(self) -> None:
        budget = max(self.config.budgets)
        largest = max(self.config.budgets_of_policies, default=None)
        policies = {m: f"policy_{m}_0_{largest}" for m in self.config.policies if largest}

        def work() -> Results:
            fitted = self.fitted(0, budget)
            asked: dict[str, Planner] = {name: fitted[name] for name in self.names}
            asked |= {f"best{t}": self._best(fitted, t) for t in self.config.tries}
            asked |= {f"{REFINED[s]}{t}": self._refining(fitted, s, t) for t in self.config.refine for s in self.starts}
            asked |= {m: ActorPolicy.load(self.stages.folder / f"{name}.safetensors") for m, name in policies.items()}
            return {name: self._questions(planner, name) for name, planner in asked.items()}

        needs = [f"net_0_{budget}", *policies.values()]
        content = {"questions": self.config.latencies, "tries": self.config.tries, "refine": self.config.refine} | self._planning
        # threads: of torch; times from before, with all, are measured again
        how = {"threads": 1, "planners": self.names, "targets": self.places["inside"].tolist()}
        self.stages.run("latency", content | how, work, needs=needs)
        if self.config.bayes and self.config.bayes_seeds != 0:  # apart, so that the others' times stay as they were
            name, tries = f"bayes{self.config.bayes}", self.config.bayes
            content = {"questions": self.config.latencies, "tries": tries, "process": asdict(BayesianConfig())} | how
            self.stages.run(
                f"latency_{name}",
                content,
                lambda: {name: self._questions(self._optimising(self.fitted(0, budget), tries), name)},
                needs=needs[:1],
            )

    def _questions(self, planner: Planner, name: str) -> list[float]:
        """Wall times of single questions [s], after two to warm up."""
        slow = name.startswith(tuple(SIMULATING))
        count = max(10, self.config.latencies // 2) if slow else self.config.latencies
        rng = np.random.default_rng(LATENCY_SEED)
        inside = self.places["inside"]
        times = []
        with one_thread():  # as planners ask their nets: tandem, CMA-ES and policies are timed alike
            for target in inside[rng.integers(len(inside), size=count + 2)]:
                started = time.perf_counter()
                planner.predict(target)
                times.append(time.perf_counter() - started)
        return times[2:]


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
    report.write_all(outcome, folder / "results.md", folder)
    if config.write:
        report.write_all(outcome, Path("docs/results.md"), Path("docs/images"), Path("README.md"))
    print(f"{report.by_budget(outcome)}\n\n{folder / 'results.md'}")
