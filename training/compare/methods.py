"""The methods that are compared: their names, what they are called, and their order in tables."""

from __future__ import annotations

import re

#: Planners that simulate nothing, by name.
PLANNERS = ("nearest", "single", "ensemble", "tandem", "cma")
#: Planners whose answers hops in turn may begin from, and what the methods that do so are called, before how many they are.
REFINED = {"nearest": "repeat", "ensemble": "refine"}
#: How the names of methods begin that simulate some hops for each answer, whose number follows, and what they begin from.
SIMULATING = {"best": "ensemble", "repeat": "nearest", "refine": "ensemble", "bayes": "ensemble"}
#: The one of them whose stages are not called as it is.
BAYESIAN = "bayes"
#: How the names of policies end that know the symmetries; before it stands the algorithm's.
SYMMETRIC = "_symmetric"
#: To raise with whatever changes answers of a planner and is no setting of it: scores made before are not kept then.
PLANNERS_VERSION = 3
#: CMA-ES on the simulator: what can be had, at a price.
ORACLE = "oracle"

LABELS = {
    "nearest": "nearest stored hop",
    "single": "planner, one net",
    "ensemble": "planner, ensemble and its doubt",
    "tandem": "tandem net",
    "cma": "CMA-ES on the surrogate",
    "sac": "SAC",
    "sac_symmetric": "SAC, knowing the symmetry",
    "td3": "TD3",
    "td3_symmetric": "TD3, knowing the symmetry",
    "ppo": "PPO",
    "ppo_symmetric": "PPO, knowing the symmetry",
}


def label(method: str) -> str:
    """A method's name in tables and figures."""
    if method.startswith("best"):
        return f"the same, best of {answer_calls(method)} simulated"
    if method.startswith("repeat"):
        return f"nearest stored hop, {answer_calls(method)} simulated in turn"
    if method.startswith("refine"):
        return f"the same, {answer_calls(method)} simulated in turn"
    if method.startswith("bayes"):
        return f"the same, {answer_calls(method)} simulated in turn by BoTorch"
    return LABELS.get(method, method)


def answer_calls(method: str) -> int:
    """Hops that a method simulates for each answer."""
    return int(re.sub("^[a-z]+", "", method) or 0) if method.startswith(tuple(SIMULATING)) else 0


def begins_from(method: str) -> str:
    """The planner whose answers a method begins from, itself where it begins from none."""
    return next((start for prefix, start in SIMULATING.items() if method.startswith(prefix)), method)


def algorithm_of(method: str) -> tuple[str, bool]:
    """The algorithm of a policy, and whether it knows the symmetries."""
    return method.removesuffix(SYMMETRIC), method.endswith(SYMMETRIC)


def place(method: str) -> tuple[int, int]:
    """Order of methods in tables: best-of-T follows the planner that proposes."""
    known = list(LABELS)
    for k, (prefix, start) in enumerate(SIMULATING.items()):
        if method.startswith(prefix):
            return known.index(start), 1000 * (k + 1) + answer_calls(method)
    return (known.index(method) if method in known else len(known)), 0
