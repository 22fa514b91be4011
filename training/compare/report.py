"""Tables of a comparison, and where they are written."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from surrogate.storage import atomic_path, ensure_folder
from tensegrity_gym import MODEL_VERSION
from tensegrity_gym.task import SUCCESS_RADIUS, TARGET_PLACES
from training.compare import figures
from training.compare.methods import ORACLE, answer_calls, label
from training.compare.results import Outcome, Summary
from training.compare.statistics import FEWEST_SEEDS, interquartile_mean


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(found: Summary, factor: float) -> str:
    middle, low, high = (f"{factor * value:.3g}" for value in (found.mean, found.low, found.high))
    if low == high:
        return middle
    return f"{middle} ({low} to {high})" if found.seeds < FEWEST_SEEDS else f"{middle} [{low}, {high}]"


def _plain(value: float) -> str:
    """Two digits and no exponent."""
    return f"{float(f'{value:.2g}'):.6g}" if value >= 1e-3 else "0"


def by_budget(outcome: Outcome) -> str:
    """Interquartile mean errors on targets inside, by method and budget."""
    budgets = _budgets(outcome)
    rows = [
        [
            label(m),
            str(answer_calls(m)),
            ", ".join(str(len(outcome.scores[m, b])) if b in outcome.budgets(m) else "–" for b in budgets),
            *(_cell(outcome.summary(m, b), outcome.factor) if b in outcome.budgets(m) else "" for b in budgets),
        ]
        for m in outcome.methods
    ]
    return table([f"error [{outcome.shown}]", "hops per answer", "seeds", *(f"after {_spaced(b)}" for b in budgets)], rows)


def _budgets(outcome: Outcome) -> list[int]:
    return sorted({b for m in outcome.methods for b in outcome.budgets(m)})


def _spaced(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def caption(outcome: Outcome) -> str:
    """What the table of :func:`by_budget` shows, and when it was run."""
    config, (first, last) = outcome.comparison.config, outcome.dates
    oracle, which = "", "second " if config.second else ""
    if outcome.oracle is not None and outcome.oracle_error is not None:
        calls = outcome.oracle.calls_per_answer
        oracle = f" CMA-ES on the simulator, {calls:.0f} hops an answer, comes to {_shown(outcome, outcome.oracle_error)}."
    scatter = ""
    if outcome.scatter is not None:
        scatter = f"; the best answers' landings lie {_shown(outcome, outcome.scatter)} from their own mean"
    text = (
        f"Interquartile mean landing error over {len(outcome.comparison.places['inside'])} {which}targets inside the reachable "
        f"region and training seeds, after so many simulator calls learnt from; {config.perturbations} starts an answer, moved "
        f"by 10 µm. Brackets: 95 % interval over seeds; parentheses, where seeds are fewer than {FEWEST_SEEDS}: their range. The "
        f"floor, how far moving its start carries a random hop's landing, is {_shown(outcome, outcome.floor)}{scatter}.{oracle} "
        f"Run {'on ' + first if first == last else f'from {first} to {last}'}."
    )
    return textwrap.fill(text, 128)


def by_place(outcome: Outcome) -> str:
    """Errors inside, on the boundary and beyond it, of each method at its largest budget."""
    rows = []
    for m in [*outcome.methods, *([ORACLE] if outcome.oracle is not None else [])]:
        budget = outcome.budgets(m)[-1]
        name = "CMA-ES on the simulator" if m == ORACLE else label(m)
        cells = [f"{outcome.factor * outcome.summary(m, budget, place).mean:.3g}" for place in TARGET_PLACES]
        rows.append([name, _spaced(budget), *cells])
    return table([f"error [{outcome.shown}] of targets", "calls", *TARGET_PLACES], rows)


def in_detail(outcome: Outcome) -> str:
    """Tails, chances, latencies and learning times at each method's largest budget."""
    rows = []
    for m in outcome.methods:
        budget = outcome.budgets(m)[-1]
        found, times = outcome.summary(m, budget), outcome.latency(m)
        comparable = m != "ensemble" and budget in outcome.budgets("ensemble")
        rows.append(
            [
                label(m),
                _spaced(budget),
                str(found.seeds),
                f"{outcome.factor * found.p95:.3g}",
                f"{100 * found.missed:.1f}",
                f"{outcome.improvement('ensemble', m, budget):.2f}" if comparable else "",
                *(["", ""] if times is None else [_plain(1e3 * t) for t in times]),
                _plain(outcome.learning_seconds(m, budget)),
                str(answer_calls(m)),
            ]
        )
    head = [
        "method",
        "calls",
        "seeds",
        f"p95 [{outcome.shown}]",
        f"farther than {SUCCESS_RADIUS:g} reach [%]",
        "P(planner better)",
        "p50 [ms]",
        "p99 [ms]",
        "learning [s]",
        "hops per answer",
    ]
    return table(head, rows)


def by_gravity(outcome: Outcome) -> str:
    """Errors in metres on targets inside, by thirds of the range of gravity, of each method at its largest budget."""
    rows = outcome.rows["inside"]
    gravity = outcome.comparison.targets[rows, 2 + outcome.comparison.scenes.observed.index("gravity")]
    edges = np.linspace(*outcome.comparison.scenes.ranges["gravity"], 4)
    third = np.clip(np.searchsorted(edges, gravity) - 1, 0, 2)
    head = [f"{low:.1f} to {high:.1f} m/s²" for low, high in pairwise(edges)]
    cells = []
    for m in outcome.methods:
        budget = outcome.budgets(m)[-1]
        errors = outcome.errors(m, budget) * outcome.unit[rows]
        parts = [errors[:, third == k] for k in range(3)]
        shown = [f"{1e3 * interquartile_mean(part):.3g}" if part.size else "" for part in parts]
        cells.append([label(m), _spaced(budget), *shown])
    return table(["error [mm] where gravity is", "calls", *head], cells)


def section(outcome: Outcome, pictures: str) -> str:
    """One scene and landing, as Markdown; ``pictures`` is where its figures lie."""
    comparison = outcome.comparison
    config, name = comparison.config, tag(outcome)
    rows = {p: len(points) for p, points in comparison.places.items()}
    budget = outcome.common_budget
    return f"""## {config.scene.capitalize()}, landing read at {config.landing}

Model version {MODEL_VERSION}, fidelity {config.fidelity}, {_scene(outcome)},
targets {", ".join(f"{n} {p}" for p, n in rows.items())}, {config.perturbations} moved starts an answer,
{"; ".join(outcome.versions)}.

{caption(outcome)}

{by_budget(outcome)}

![Error against simulator calls]({pictures}/results_{name}_calls.png)

At the largest budget of each:

{in_detail(outcome)}

{by_place(outcome)}
{chr(10) + by_gravity(outcome) + chr(10) if outcome.varied else ""}
![Share of answers that err by less than a radius, after {budget:,} calls]({pictures}/results_{name}_profile.png)

![Learning time against error]({pictures}/results_{name}_pareto.png)
"""


def short(outcome: Outcome) -> str:
    """The one table that README has, and what it shows."""
    return f"{caption(outcome)}\n\n{by_budget(outcome)}"


def _shown(outcome: Outcome, value: float) -> str:
    return f"{outcome.factor * value:.2g} {outcome.shown}"


def _scene(outcome: Outcome) -> str:
    least, most = 1e3 * outcome.reaches.min(), 1e3 * outcome.reaches.max()
    if not outcome.varied:
        return f"reach {most:.0f} mm"
    ranges = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in outcome.comparison.scenes.ranges.items())
    return f"{ranges},\nreaches of the targets' scenes {least:.0f} to {most:.0f} mm"


def tag(outcome: Outcome) -> str:
    """Name of a task in markers and files."""
    return f"{outcome.comparison.config.scene}_{outcome.comparison.config.landing}"


def write_all(outcome: Outcome, page: Path, images: Path, readme: Path | None = None) -> list[Path]:
    """Figures into ``images``; the task's section into ``page`` and its table into ``readme``, between their markers."""
    ensure_folder(images)
    name = tag(outcome)
    budget = outcome.common_budget
    written = [
        figures.sample_efficiency(outcome, images / f"results_{name}_calls.png"),
        figures.profiles(outcome, budget, images / f"results_{name}_profile.png"),
        figures.pareto(outcome, images / f"results_{name}_pareto.png"),
    ]
    relative = Path(os.path.relpath(images, page.parent)).as_posix()
    replace_between(page, name, section(outcome, relative), append=True)
    written.append(page)
    if readme is not None and readme.exists() and replace_between(readme, name, short(outcome)):
        written.append(readme)
    return written


def replace_between(path: Path, name: str, text: str, *, append: bool = False) -> bool:
    """Put ``text`` between the markers of ``name`` in ``path``; without markers at its end if ``append``. True if written."""
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    block = f"{begin}\n{text.strip()}\n{end}"
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    if pattern.search(before):
        after = pattern.sub(lambda _: block, before)
    elif append:
        after = before.rstrip() + ("\n\n" if before.strip() else "") + block + "\n"
    else:
        return False
    with atomic_path(path) as temporary:
        temporary.write_text(after, encoding="utf-8")
    return True
