"""What a comparison runs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from surrogate.model import NetConfig
from surrogate.train import TrainConfig
from tensegrity_gym.errors import InvalidParameterError
from training.compare.methods import SYMMETRIC
from training.compare.targets import SCENES, VARIED
from training.inverse import InverseConfig
from training.tandem import TandemConfig

ALGORITHMS = ("sac", "td3", "ppo")


@dataclass(frozen=True)
class CompareConfig:
    """Planners and policies at equal simulator calls; a rerun goes on, also with more seeds or budgets."""

    out: Path = Path("runs/compare")
    """Folder of all results of one scene and landing."""
    scene: str = "earth"
    """Scene with registered targets: earth, moon, slope, or varied, where each target has a gravity and friction of its own
    (at touchdown only)."""
    landing: str = "touchdown"
    """Where a landing is read: touchdown or rest."""
    fidelity: str = "paper"
    """Model of the hop, for learning and for scoring alike, one that the envs know by name: paper, single, flown, ..."""
    duration: float | None = None
    """Longest time that a hop is followed [s]; None: the scene's. A touchdown needs no more than the longest flight."""
    data: Path | None = None
    """File of hops, made by `python -m surrogate generate`, in place of hops simulated for each seed: seed k takes them from
    its k-th tenth on. Small budgets of different seeds then share no hop, large ones share most."""
    budgets: tuple[int, ...] = (100, 1000, 10000)
    """Simulator calls that a method may learn from."""
    seeds: tuple[int, ...] = (10,)
    """Training seeds of the planners: one number, or one for each budget."""
    algorithms: tuple[str, ...] = ALGORITHMS
    """Policies to train."""
    symmetric: tuple[str, ...] = ()
    """Policies to train that know the symmetries of lattice and ground, as planners do (see training/symmetry.py)."""
    policy_budgets: tuple[int, ...] | None = None
    """Budgets of the policies; None: the same, none at all: no policies."""
    policy_seeds: tuple[int, ...] | None = None
    """Training seeds of the policies: one number, or one for each of their budgets; None: the same."""
    hyperparameters: Path | None = None
    """Folder of sac.toml, td3.toml and ppo.toml to train policies with, such as `python -m training tune` writes; None: the
    committed ones. Not for --write."""
    targets: int | None = None
    """Registered targets of each place (inside, boundary, beyond) to use; None: all."""
    second: bool = False
    """Other targets, drawn when the methods' development was over, to confirm; not for --write."""
    perturbations: int = 8
    """Moved starts from which every answer is simulated again."""
    tries: tuple[int, ...] = (8, 32)
    """Proposals that best-of-T simulates before it answers."""
    tries_seeds: int | None = None
    """Seeds for which best-of-T is run, which costs most hops; None: all."""
    refine: tuple[int, ...] = (4, 8)
    """Hops per answer of planners that plan each from the last, from the ensemble's answer and from the nearest stored hop."""
    bayes: int = 0
    """Hops per answer of the planner that chooses each by Bayesian optimisation, which needs the extra `botorch`; 0: leave it
    out. Not where scenes vary."""
    bayes_seeds: int | None = None
    """Seeds for which Bayesian optimisation is run; None: all."""
    search: int = 400
    """Looks per target of CMA-ES on the surrogate."""
    oracle: int = 160
    """Hops per target of CMA-ES on the simulator; 0: no oracle."""
    updates: int = 3000
    """Gradient steps of the surrogate, at most, though never less than one pass over its hops."""
    surrogate: TrainConfig = field(
        default_factory=lambda: TrainConfig(net=NetConfig(hidden=(64, 64, 64)), test=0.0, device="cpu")
    )
    """Training of the surrogate, which is small, since a planner asks it often and stored hops tell the rest."""
    inverse: InverseConfig = field(default_factory=InverseConfig)
    """Inversion of the surrogate."""
    tandem: TandemConfig = field(default_factory=TandemConfig)
    """Training of the tandem net."""
    latencies: int = 100
    """Single questions that each method's latency is measured on; 0: none."""
    threads: int | None = None
    """Threads of the simulator; None: all cores."""
    write: bool = False
    """Go on from the scores in docs/scores of the working directory, running only what they lack, and write all scores there,
    tables and figures into docs/results.md, docs/images and README.md."""
    anew: bool = False
    """Overwrite the scores in --out, with --write those in docs/scores too, and go on from none."""
    quick: bool = False
    """A run of under a minute, with hops cut off after 0.06 s, that shows that all works, and nothing else."""
    progress: bool = True
    """Show progress bars."""

    def __post_init__(self) -> None:
        if self.quick and self.write:
            raise InvalidParameterError(
                "write: expected it without --quick, got both: hops cut off after 0.06 s would overwrite the measured results in "
                "README.md and docs; leave one of them out"
            )
        if self.second and self.write:
            raise InvalidParameterError("write: expected the first targets, which the tables are of, got second; leave one out")
        if self.hyperparameters is not None and self.write:
            raise InvalidParameterError(
                f"write: expected it without --hyperparameters, as the tables are of the committed ones, got both; copy "
                f"{self.hyperparameters} to training/hyperparameters, or leave one of them out"
            )
        self._check_counts()
        if not self.budgets or min(self.budgets) < 8:
            raise InvalidParameterError(f"budgets: expected numbers >= 8, got {self.budgets}")
        each = {"seeds": (self.seeds, self.budgets), "policy_seeds": (self.seeds_of_policies, self.budgets_of_policies)}
        for name, (numbers, budgets) in each.items():
            if budgets and len(numbers) not in (1, len(budgets)):
                raise InvalidParameterError(f"{name}: expected one number, or one for each of {budgets}, got {numbers}")
        if self.bayes and self.scene in VARIED:
            raise InvalidParameterError(
                f"bayes: expected 0 where scenes vary, got {self.bayes}; leave it out, or choose one of the scenes {SCENES}"
            )
        for name in ("algorithms", "symmetric"):
            strangers = sorted(set(getattr(self, name)) - set(ALGORITHMS))
            if strangers:
                raise InvalidParameterError(f"{name}: expected some of {ALGORITHMS}, got {strangers}")

    def _check_counts(self) -> None:
        """Numbers of things, each with the least that means something; a negative one would cut lists short from behind."""
        least = {
            "seeds": (1, self.seeds or (0,)),
            "policy_seeds": (1, self.seeds_of_policies or (0,)),
            "policy_budgets": (1, self.budgets_of_policies),
            "perturbations": (1, (self.perturbations,)),
            "updates": (1, (self.updates,)),
            "tries": (1, self.tries),
            "refine": (1, self.refine),
            "search": (8, (self.search,)),  # one generation of CMA-ES
            "bayes": (0, (self.bayes,)),
            "latencies": (0, (self.latencies,)),
            "targets": (1, () if self.targets is None else (self.targets,)),
            "tries_seeds": (0, () if self.tries_seeds is None else (self.tries_seeds,)),
            "bayes_seeds": (0, () if self.bayes_seeds is None else (self.bayes_seeds,)),
        }
        for name, (bound, values) in least.items():
            if min(values, default=bound) < bound:
                raise InvalidParameterError(
                    f"{name}: expected {'an integer' if len(values) == 1 else 'integers'} >= {bound}, got {min(values)}"
                )
        if self.oracle < 0 or self.oracle == 1:
            raise InvalidParameterError(
                f"oracle: expected 0, for none, or an integer >= 2, got {self.oracle}; CMA-ES compares hops"
            )

    def shortened(self) -> CompareConfig:
        """The settings of ``quick``, in its own folder."""
        return replace(
            self,
            out=self.out / "quick",
            fidelity="flown",
            duration=0.06,
            data=None,
            budgets=(16, 32),
            seeds=(2,),
            policy_seeds=None,
            policy_budgets=None,
            algorithms=("sac",),
            symmetric=self.symmetric[:1],
            targets=2,
            perturbations=2,
            tries=(2,),
            refine=(2,),
            bayes=min(self.bayes, 2),
            search=16,
            oracle=4,
            updates=50,
            inverse=replace(self.inverse, pool=256),
            tandem=replace(self.tandem, steps=20),
            latencies=2,
        )

    @property
    def kept_path(self) -> Path:
        """Where scores are kept beside the tables made of them."""
        return Path("docs/scores") / f"{self.scene}_{self.landing}.jsonl"

    @property
    def kept(self) -> Path | None:
        """The file of scores to go on from, None for none."""
        return self.kept_path if self.write and not self.anew else None

    @property
    def budgets_of_policies(self) -> tuple[int, ...]:
        """Budgets of the policies."""
        return self.budgets if self.policy_budgets is None else self.policy_budgets

    @property
    def seeds_of_policies(self) -> tuple[int, ...]:
        """Training seeds of the policies."""
        return self.seeds if self.policy_seeds is None else self.policy_seeds

    @property
    def policies(self) -> list[str]:
        """Names of the policies' methods."""
        return [*self.algorithms, *(f"{algorithm}{SYMMETRIC}" for algorithm in self.symmetric)]

    @property
    def planner_runs(self) -> list[tuple[int, int]]:
        """Seeds and budgets of the planners, in the order in which they run."""
        return _runs(self.seeds, self.budgets)

    @property
    def policy_runs(self) -> list[tuple[int, int]]:
        """Seeds and budgets of the policies, small budgets first."""
        return sorted(_runs(self.seeds_of_policies, self.budgets_of_policies), key=lambda run: run[1])


def _runs(seeds: tuple[int, ...], budgets: tuple[int, ...]) -> list[tuple[int, int]]:
    each = dict(zip(budgets, seeds if len(seeds) > 1 else seeds * len(budgets), strict=True))
    return [(seed, budget) for seed in range(max(seeds)) for budget in budgets if seed < each[budget]]
