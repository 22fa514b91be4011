"""A page about a file of hops: landing map, reach, apex, energies, failures, and how far any of it can be trusted."""

from __future__ import annotations

import base64
import html
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from surrogate import dataset
from surrogate.floor import start_of
from surrogate.hops import HopData, simulate_arguments
from surrogate.scenes import comparable, unit_of
from surrogate.storage import atomic_path, beside_data, ensure_folder
from tensegrity_gym import ENERGY_NAMES, HopStatus, simulate
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tensegrity_gym.events import flew
from tensegrity_gym.specimen import moved_start

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; font-size: 14px; }
th, td { padding: .35em .8em; border-bottom: 1px solid #ddd; text-align: left; vertical-align: top; word-break: break-word; }
img { max-width: 100%; height: auto; border: 1px solid #eee; }
figure { margin: 2em 0; } figcaption { color: #555; font-size: 14px; }
"""


@dataclass(frozen=True)
class ReportConfig:
    """Write a page and pictures about a file of hops."""

    file: Annotated[Path, tyro.conf.Positional]
    """File of hops."""
    out: Path | None = None
    """Folder of the report; None: beside the file, NAME.report."""
    floor: int = 0
    """Measure the floor with so many of the hops, started 10 um off: what no model of the landing can do better than."""

    def __post_init__(self) -> None:
        if self.floor < 0:
            raise InvalidParameterError(f"floor: expected a number of hops >= 0, got {self.floor}; 0 leaves it out")


def findings(data: HopData) -> dict[str, str]:
    """What the hops say, in words and numbers."""
    from surrogate import figures

    usable = data.rows(data.usable)
    unit = unit_of(data)
    if unit == "reaches":
        usable = comparable(usable)
        varying = ", ".join(f"{k} {a:g} to {b:g}" for k, (a, b) in data.configuration["scene_ranges"].items())
        usual = f"scenes vary ({varying}): landings from the middle of their reach, in reaches; apex times g over the Earth's"
    else:
        usual = "landings in metres from the start"
    said = {"landings": usual, "hops": f"{len(data)}, {len(data) - len(usable)} failed"}
    for status in HopStatus:
        said[f"status {status.name}"] = str(int((data["status"] == status).sum()))
    colour = figures.alternating(usable["stretches"])
    for name in figures.places(usable):
        distance = np.hypot(*usable[name].T)
        low, middle, high = np.percentile(distance, (5, 50, 95))
        said[f"{name}: distance"] = (
            f"median {middle:.3f} {unit}, 5 % {low:.3f}, 95 % {high:.3f}, farthest {distance.max():.3f} {unit}"
        )
        angle, reach, _ = figures.reach_by_direction(usable[name])
        order = np.argsort(reach)[::-1][:4]
        said[f"{name}: farthest directions"] = (
            ", ".join(f"{np.degrees(angle[k]):.0f}° ({reach[k]:.3f} {unit})" for k in order)
            + f" by the 95th percentile in sectors of {360 / len(angle):.0f}°; nearest {np.degrees(angle[reach.argmin()]):.0f}° "
            f"({reach.min():.3f} {unit})"
        )
        axes = reach[:: len(angle) // 4].mean()
        diagonals = reach[len(angle) // 8 :: len(angle) // 4].mean()
        said[f"{name}: axes against diagonals"] = (
            f"{axes:.3f} {unit} at 0/90/180/270°, which the paper finds farthest, {diagonals:.3f} {unit} at 45/135/225/315°"
        )
        along = [np.corrcoef(colour, usable[name][:, k])[0, 1] for k in (0, 1)]
        quadrant = np.corrcoef(colour, np.sign(np.prod(usable[name], axis=1)))[0, 1]
        size = np.corrcoef(np.abs(colour), distance)[0, 1]
        said[f"{name}: correlation with λ1 − λ2 + λ3 − λ4"] = (
            f"x {along[0]:+.2f}, y {along[1]:+.2f}, sign of xy {quadrant:+.2f}; of its size with the distance {size:+.2f}"
        )
    mean = usable["stretches"].mean(axis=1)
    slope, _ = np.polyfit(mean, usable["apex"], 1)
    said["apex"] = (
        f"median {np.median(usable['apex']):.3f} m, highest {usable['apex'].max():.3f} m, {slope:+.2f} m per unit of mean "
        f"stretch, correlation {np.corrcoef(mean, usable['apex'])[0, 1]:+.3f}"
    )
    total = usable["energies"].sum(axis=2)
    up = flew(usable["status"])
    drift = 100 * np.abs(total - total[:, :1])[up].max(axis=1) / usable["stored_energy"][up]
    if len(drift):
        said["energy audit"] = f"closes to {np.median(drift):.2g} % of the stored energy (median), {drift.max():.2g} % (worst)"
    kinetic = usable["energies"][:, 3, ENERGY_NAMES.index("kinetic")] / usable["stored_energy"]
    said["kinetic energy left at the end"] = f"{100 * np.median(kinetic):.2g} % of the stored energy (median)"
    said["time"] = f"{data['cpu_seconds'].sum() / max(1, int((data['image'] == 0).sum())):.3f} s of CPU per simulated hop"
    return said


def measured_floor(data: HopData, hops: int) -> dict[str, str]:
    """How far landings move when the masses of a start are moved (`moved_start`): nothing predicts them better than that."""
    from surrogate import figures

    how = simulate_arguments(data.configuration)
    rows = np.flatnonzero(data.usable & (data["image"] == 0))[:hops]
    start = start_of(data["stretches"][rows], how)
    pair = [simulate(start.stretches, equilibria=e, **how) for e in (start, moved_start(start))]
    said = {}
    for name in reversed(figures.places(data.rows(rows))):
        apart = 1e3 * np.linalg.norm(getattr(pair[0], name) - getattr(pair[1], name), axis=1)
        middle, high = np.percentile(apart, (50, 90))
        said[f"{name}: floor"] = f"{middle:.2f} mm (median), {high:.2f} mm (90 %), of {len(rows)} hops started 10 µm off"
    return said


def report(path: Path, out: Path | None = None, floor: int = 0) -> Path:
    """Write the page and its pictures into ``out``; returns the page's path."""
    from surrogate import figures

    data = dataset.read(path)
    varied = bool(data.configuration["scene_ranges"])
    if varied and floor:
        raise InvalidParameterError(f"floor: expected a file of one scene to measure it in, got scenes that vary in {path}")
    if not data.usable.any():
        raise DataFileError(f"{path}: expected at least one usable hop, got none of {len(data)}")
    folder = ensure_folder(out or beside_data(path, ".report"))
    usable = data.rows(data.usable)
    shown = comparable(usable) if varied else usable
    pictures = figures.PICTURES | (figures.VARIED if varied else {})
    for name, (draw, _) in pictures.items():
        figures.save(draw, {"outcomes.png": data, "scenes.png": usable}.get(name, shown), folder / name)
    said = findings(data) | (measured_floor(data, floor) if floor else {"floor": "not measured; --floor 32 does"})
    about = {k: str(v) for k, v in dataset.attributes(path).items() if k not in ("design", "scene")}
    body = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(path.name)}</title><style>{STYLE}</style>',
        f"<h1>{len(data)} hops</h1>",
        _table(said),
        *(_figure(folder / name, caption) for name, (_, caption) in pictures.items()),
        "<h2>What was run</h2>",
        _table(about),
        "</html>",
    ]
    page = folder / "report.html"
    with atomic_path(page) as temporary:
        temporary.write_text("\n".join(body), encoding="utf-8")
    return page


def _table(rows: dict[str, str]) -> str:
    cells = "".join(f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in rows.items())
    return f"<table>{cells}</table>"


def _figure(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    text = html.escape(caption)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'


def main(config: ReportConfig) -> None:
    """Entry of ``python -m surrogate report``."""
    print(report(config.file, config.out, config.floor))
