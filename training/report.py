"""The demo's table as text, and its report as one self-contained page."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surrogate.storage import atomic_path
from tensegrity_gym.specimen import POSITION

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("method", "method", "s"),
    ("median_error", "median error [m]", ".2g"),
    ("mean_error", "mean error [m]", ".2g"),
    ("median_percent", "median [% of reach]", ".1f"),
    ("mean_percent", "mean [% of reach]", ".1f"),
    ("failed_percent", "failed [%]", ".0f"),
    ("wall_seconds", "wall time [s]", ".1f"),
    ("answer_milliseconds", "per answer [ms]", ".2f"),
    ("simulator_calls", "simulator calls", "d"),
)

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; font-size: 14px; }
th, td { padding: .35em .8em; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; height: auto; border: 1px solid #eee; }
figure { margin: 2em 0; } figcaption { color: #555; font-size: 14px; }
"""


def scored(floor: np.ndarray, starts: int) -> str:
    """How errors were measured, and the floor under them; ``floor``: of each target's own hop, shape (n,) [m]."""
    median, mean = 1e3 * float(np.median(floor)), 1e3 * float(floor.mean())
    return (
        f"Errors: mean distance to the target from {starts} starts, masses above the ground moved by {1e6 * POSITION:g} µm. "
        f"Floor: such moves alone carry the landings of the targets' own hops by {median:.2g} mm (mean {mean:.2g} mm)."
    )


def text_table(rows: Sequence[dict[str, Any]], caption: str) -> str:
    """Rows of :func:`training.demo.table_rows` aligned for a terminal, and a caption below."""
    cells = [[title for _, title, _ in COLUMNS]] + [[format(row[key], form) for key, _, form in COLUMNS] for row in rows]
    widths = [max(len(line[k]) for line in cells) for k in range(len(COLUMNS))]
    lines = [
        "  ".join(c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(line, widths, strict=True)))
        for line in cells
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:], caption])


def _html_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(c)}</th>" for c in header)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _figure(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    text = html.escape(caption)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'


def write(
    path: Path,
    rows: Sequence[dict[str, Any]],
    caption: str,
    facts: dict[str, Any],
    closures: dict[str, float],
    starts: str,
    stretches: Sequence[float],
    seconds: dict[str, float],
) -> Path:
    """Write the page, ``caption`` below its table; its pictures are read from the same folder and put into it."""
    shown = ", ".join(f"{s:g}" for s in stretches)
    captions = {
        "hop.png": f"The hop of stretches ({shown}), as simulated.",
        "energies.png": f"Energies of that hop. Their sum is constant to {closures['shown']:.2g} % of the stored energy; "
        f"over all stored hops, between release, take-off, touchdown and end, to {closures['data']:.2g} %.",
        "landing_map.png": "Where the stored hops came to rest and where they first touched down, coloured by λ1 − λ2 + λ3 − λ4.",
        "scatter.png": "The surrogate's predictions against simulation, on held-out hops that it never saw.",
        "plans.png": "Targets (circles), and where the answers of each method landed from each of their moved starts.",
        "error_calls.png": "Landing error against the simulator calls that a method learnt from: median over the held-out "
        "targets, band from the first to the third quartile. Dotted: the floor, how far a start moved by 10 µm alone carries a "
        f"landing. Moved starts of an answer: {starts}. One training seed: differences within the bands mean little.",
    }
    table = _html_table([t for _, t, _ in COLUMNS], [[format(row[key], form) for key, _, form in COLUMNS] for row in rows])
    note = (
        "Wall time is all a method needs before its last answer: simulating its hops, training, answering. Per answer: a "
        "batch's time over its targets. Targets are landings of other simulated hops, which no method learnt from. Hops in "
        "turn are simulated for each answer, from the unmoved start, and counted; touchdowns by a cheaper model, which flies "
        "rigidly and ends there. No answer is scored on the hop that chose it: a hop repeated from the same start lands in the "
        "same place bit by bit, however chaotic. All methods see the same moved starts; a failed hop counts as landing two "
        "reaches away. Scoring is by the paper's model in single precision, with rigid flight where touchdowns are read, and "
        "its hops count for no method."
    )
    page = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Tensegrity hop demo</title><style>{STYLE}</style>',
        f"<h1>From four stretches to a planned landing</h1>{table}<p>{html.escape(caption)}</p><p>{note}</p>",
        *(_figure(path.parent / name, caption) for name, caption in captions.items()),
        "<h2>What was run</h2>",
        _html_table(["setting", "value"], [[str(k), str(v)] for k, v in facts.items()]),
        _html_table(["stage", "wall time [s]"], [[k, f"{v:.1f}"] for k, v in seconds.items()]),
        "</html>",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(page), encoding="utf-8")
    return path
