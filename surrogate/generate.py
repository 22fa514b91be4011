"""Simulate hops into one file; a rerun goes on where the last one stopped, whoever does the work."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from tqdm import tqdm

from surrogate import dataset
from surrogate.chunks import Task, run_chunk
from surrogate.hops import Configuration, HopData
from surrogate.join import Piece, join, pieces_of, runs, skipped_of
from surrogate.sampling import read_stretches, sample_size, sample_stretches, stretches_hash
from surrogate.schedule import Outcome, run_here, run_on_cluster
from surrogate.storage import beside_data, ensure_folder, remove_partials, writer_lock
from tensegrity_gym import Design, Lattice, Scene
from tensegrity_gym.auto import choose_fidelity
from tensegrity_gym.errors import InvalidParameterError, SkippedChunksError
from tensegrity_gym.fidelity import Fidelity, changed, named_fidelity
from tensegrity_gym.types import Floats

__all__ = ["GenerateConfig", "fill", "generate", "main", "sample_stretches"]

#: Hops that are committed together: some seconds of work for one core, so that starting and storing a chunk are small.
CHUNK = 128


@dataclass(frozen=True)
class GenerateConfig:
    """Simulate hops into an HDF5 file. The default run is the paper's: 40 000 equilibria, 10 000 of which hop."""

    out: Annotated[Path, tyro.conf.Positional]
    """File to write; an interrupted or smaller one of the same configuration is continued."""
    hops: int | None = None
    """Number of hops in the file; default 10 000, or all there are of a grid or a file."""
    first: int = 0
    """Number of the first hop in the sampler's sequence, for shards that are to be merged."""
    equilibria: int = 0
    """Number of equilibria in all: those past the hops go to OUT.equilibria.h5 and are not released. 0 with all hops default
    means 40 000."""
    sampler: str = "sobol"
    """sobol, uniform, lhs (a Latin hypercube of --hops points), grid, or file."""
    grid: int = 8
    """Points per axis of the grid."""
    stretches: Path | None = None
    """File of stretches, one hop a line: .npy, .csv or text; implies --sampler file."""
    seed: int = 0
    """Seed of the sampler."""
    scene: str = "earth"
    """Scene preset."""
    landing: str = "rest"
    """Where a landing is read: rest or touchdown."""
    duration: float | None = None
    """Longest time that a hop is followed [s]; None: the scene's, or what the least gravity of --ranges takes."""
    ranges: tuple[str, ...] = ()
    """Values of the scene that vary: gravity=1.6:9.8 friction=0.3:0.8 ..."""
    design: Design = field(default_factory=Design)
    """Materials and sizes."""
    fidelity: str = "paper"
    """paper, single (precision), flown (single, rigid in flight and no further than the landing: many times cheaper to
    touchdown), reference (converged in time), or auto: the cheapest model known to hold --tolerance."""
    tolerance: float | None = None
    """On the landing, with --fidelity auto [m]; None: the scene's floor."""
    stop: str | None = None
    """landing: follow hops no further than where landings are read, so that --landing touchdown has no rest; rest."""
    precision: str | None = None
    """Of the simulator's lanes; None: float32 with --fidelity paper, which is twice as fast as float64 and moves a landing by
    less than its floor; else the fidelity's."""
    dt: float | None = None
    """Time step [s]; None lets the simulator choose."""
    symmetry: bool = False
    """Add each hop's symmetry images, marked, and for training only."""
    node_positions: bool = False
    """Keep the nodes of the equilibria."""
    trajectory: str = "none"
    """none, centre (of mass) or full."""
    trajectory_rate: float = 60.0
    """Frames per second [Hz]."""
    chunk: int = CHUNK
    """Hops that are committed together."""
    threads: int | None = None
    """Threads of the simulator; None: all cores that this process may use."""
    scheduler: str = "threads"
    """threads, dask (workers of this machine), or a dask scheduler: its address, tcp://host:port, or its file.json."""
    workers: int | None = None
    """Workers of --scheduler dask; None: one a core."""
    retries: int = 2
    """How often a failed chunk is tried again before it is skipped."""


def generate(
    path: Path | str,
    hops: int,
    configuration: Configuration,
    *,
    chunk: int = CHUNK,
    threads: int | None = None,
    progress: bool = True,
    **options: Any,
) -> HopData:
    """As :func:`fill`, and return the first ``hops`` hops; of a file of more, with their share of its wall time."""
    fill(path, hops, configuration, chunk=chunk, threads=threads, progress=progress, **options)
    data = dataset.read(path, expect=configuration)
    found = data.rows(slice(0, hops * configuration.rows_per_hop))
    return replace(found, seconds=data.seconds * len(found) / len(data))


def fill(
    path: Path | str,
    hops: int,
    configuration: Configuration,
    *,
    first: int = 0,
    chunk: int = CHUNK,
    threads: int | None = None,
    progress: bool = True,
    scheduler: str = "threads",
    workers: int | None = None,
    retries: int = 2,
    stretches: Floats | None = None,
    work: Callable[..., HopData] = run_chunk,
) -> None:
    """Make ``path`` hold hops ``first`` to ``first + hops`` of the configuration, and simulate what it lacks.

    Each chunk is committed as a file of its own under ``<path>.parts``, by a rename; the parts are joined, and removed, when
    all that were asked for are there; those that a larger run left behind are joined too. Killed at any moment, nothing is lost
    but the chunks at work. A chunk that fails ``retries`` + 1 times is left out: the others are joined, and SkippedChunksError
    names it; a rerun tries it again.
    """
    path = Path(path)
    _check(hops, first, chunk, configuration, stretches)
    ensure_folder(path.parent)
    with writer_lock(path):
        remove_partials(path.parent, path.name)
        folder = path.with_name(path.name + ".parts")
        known = pieces_of([path] if path.exists() else [], configuration)
        have = known + [p for p in pieces_of(sorted(folder.glob("*.h5")), configuration) if not _covered(p, known)]
        lacking = list(_lacking(have, first, first + hops, chunk))
        skipped: list[dict[str, Any]] = []
        if lacking:
            ensure_folder(folder)
            tasks = (Task(configuration, a, b, None if stretches is None else stretches[a:b]) for a, b in lacking)
            done = hops - sum(b - a for a, b in lacking)
            with tqdm(total=hops, initial=done, unit="hop", desc=f"hops -> {path.name}", disable=not progress) as bar:
                if scheduler == "threads":
                    outcomes = run_here(tasks, work, threads, retries, bar.update)
                else:
                    outcomes = run_on_cluster(tasks, work, scheduler, workers, retries, bar.update)
                have += _commit_all(folder, outcomes, configuration, skipped, bar)
        if have and (lacking or len(have) > len(known)):  # parts may be there, of a larger run, where none is lacking
            tried = [Piece(path, a, b, 0, 0) for a, b in lacking]  # what failed of these is in ``skipped``
            before = skipped_of([path] if path.exists() else [], [*have, *tried])
            dataset.write_blocks(path, configuration.as_dict(), join(have), [*before, *skipped])
        shutil.rmtree(folder, ignore_errors=True)
    if skipped:
        lines = "; ".join(f"hops {s['first']} to {s['last'] - 1}: {s['error']}" for s in skipped[:5])
        raise SkippedChunksError(
            f"expected {len(lacking)} chunks to be simulated, {len(skipped)} failed {retries + 1} times and are not in {path} "
            f"({lines}); all others are; run the same command again to try these"
        )


def _check(hops: int, first: int, chunk: int, configuration: Configuration, stretches: Floats | None) -> None:
    for name, value, least in (("hops", hops, 1), ("first", first, 0), ("chunk", chunk, 1)):
        if value < least:
            raise InvalidParameterError(f"{name}: expected an integer >= {least}, got {value}")
    size = sample_size(configuration.sampler, configuration.sampler_size, configuration.lattice.n_cells)
    if size is not None and first + hops > size:
        raise InvalidParameterError(
            f"hops: expected at most {size} points from sampler {configuration.sampler}, got hops {first} to {first + hops - 1}"
        )
    if configuration.sampler == "file" and (stretches is None or stretches_hash(stretches) != configuration.stretches_hash):
        raise InvalidParameterError("stretches: expected those whose hash the configuration holds, got others or none")


def _covered(piece: Piece, by: Sequence[Piece]) -> bool:
    """Whether a part is in the file already: its run was killed after joining and before tidying up."""
    return any(p.first <= piece.first and piece.last <= p.last for p in by)


def _lacking(have: Sequence[Piece], start: int, stop: int, chunk: int) -> Iterator[tuple[int, int]]:
    """Runs of hops that no piece has, cut at multiples of ``chunk``."""
    there = np.zeros(stop - start, dtype=bool)
    for piece in have:
        there[max(0, piece.first - start) : max(0, piece.last - start)] = True
    for first in range(start // chunk * chunk, stop, chunk):
        numbers = np.arange(max(first, start), min(first + chunk, stop))
        missing = numbers[~there[numbers - start]]
        yield from runs(missing)


def _commit_all(
    folder: Path, outcomes: Iterator[Outcome], configuration: Configuration, skipped: list[dict[str, Any]], bar: tqdm
) -> list[Piece]:
    """Store each chunk as it comes; what failed goes to ``skipped``."""
    pieces, failed = [], 0
    for task, outcome in outcomes:
        if isinstance(outcome, Exception):
            error = f"{type(outcome).__name__}: {outcome}"[:300]
            skipped.append({"first": task.first, "last": task.last, "error": error})
        else:
            where = f"hops {task.first} to {task.last - 1}"
            dataset.check_configuration(outcome.configuration, configuration.as_dict(), where)
            part = folder / f"{task.first:010d}-{task.last:010d}.h5"
            dataset.write(part, outcome)
            pieces.append(Piece(part, task.first, task.last, 0, len(outcome)))
            failed += int((~outcome.usable).sum())
        bar.set_postfix(failed=failed, skipped=len(skipped), refresh=False)
    return pieces


def configuration_of(config: GenerateConfig) -> tuple[Configuration, Floats | None, int]:
    """Configuration, stretches (where they come from a file) and number of hops of a command."""
    changes: dict[str, Any] = {"landing": config.landing} | ({} if config.duration is None else {"duration": config.duration})
    sampler = "file" if config.stretches is not None else config.sampler
    lattice = Lattice()
    stretches = None
    if sampler == "file":
        if config.stretches is None:
            raise InvalidParameterError("sampler: expected --stretches FILE with --sampler file")
        stretches = read_stretches(config.stretches, lattice.n_cells)
    if sampler == "lhs" and config.first:
        raise InvalidParameterError(
            f"first: expected 0 with --sampler lhs, got {config.first}: a hypercube of another number of points is "
            "another one, and shards of it cannot be merged; take --sampler sobol, or stretches from a file"
        )
    default = {"grid": config.grid**lattice.n_cells, "file": 0 if stretches is None else len(stretches)}.get(sampler, 10_000)
    hops = default - (config.first if sampler in ("grid", "file") else 0) if config.hops is None else config.hops
    size = {"lhs": hops, "grid": config.grid, "file": default}.get(sampler, 0)
    scene, ranges = Scene.preset(config.scene, **changes), dict(_range(text) for text in config.ranges)
    if "gravity" in ranges and config.duration is None:
        scene = scene.lasting(ranges["gravity"][0])  # one duration for all the file: long enough for the slowest hops
    configuration = Configuration(
        design=config.design,
        scene=scene,
        lattice=lattice,
        seed=config.seed,
        sampler=sampler,
        sampler_size=size,
        stretches_hash="" if stretches is None else stretches_hash(stretches),
        dt=config.dt,
        fidelity=_fidelity(config, scene, lattice),
        scene_ranges=ranges,
        symmetry=config.symmetry,
        node_positions=config.node_positions,
        trajectory=config.trajectory,
        trajectory_rate=config.trajectory_rate,
    )
    return configuration, stretches, hops


def _fidelity(config: GenerateConfig, scene: Scene, lattice: Lattice) -> Fidelity:
    """The fidelity of a command with all its levers; an automatic one is chosen here, once, and recorded."""
    if config.fidelity == "auto":
        if config.ranges:
            raise InvalidParameterError("fidelity: expected another than auto with --ranges: it is chosen for one scene")
        chosen = choose_fidelity(config.design, scene, lattice, config.tolerance)
    elif config.tolerance is not None:
        raise InvalidParameterError(f"tolerance: expected only with --fidelity auto, got --fidelity {config.fidelity}")
    else:
        chosen = named_fidelity(config.fidelity)
    usual = "float32" if config.fidelity == "paper" else None
    return changed(chosen, {"precision": config.precision or usual, "stop": config.stop})


def _range(text: str) -> tuple[str, tuple[float, float]]:
    try:
        name, bounds = text.split("=")
        low, high = bounds.split(":")
        return name, (float(low), float(high))
    except ValueError as error:
        raise InvalidParameterError(f"ranges: expected name=low:high, got {text!r}") from error


def main(config: GenerateConfig) -> None:
    """Entry of ``python -m surrogate generate``."""
    configuration, stretches, hops = configuration_of(config)
    run = partial(
        fill,
        chunk=config.chunk,
        threads=config.threads,
        scheduler=config.scheduler,
        workers=config.workers,
        retries=config.retries,
        stretches=stretches,
    )
    run(config.out, hops, configuration, first=config.first)
    data = dataset.read(config.out, columns=["status", "landing", "cpu_seconds"])
    distance = np.linalg.norm(data["landing"][data.usable], axis=1)
    median = float(np.median(distance)) if len(distance) else float("nan")
    print(f"{config.out}: {len(data)} rows, {int((~data.usable).sum())} failed, landing at {median:.3f} m (median)")
    paper = config.hops is None and config.first == 0 and configuration.sampler in ("sobol", "uniform")
    equilibria = config.equilibria or (4 * hops if paper else 0)
    if equilibria > hops:
        beside = beside_data(config.out, ".equilibria.h5")
        alone = replace(configuration, content="equilibria", trajectory="none")
        # form-finding takes a twentieth of a hop's time: larger chunks, as large in seconds
        run(beside, equilibria - hops, alone, first=config.first + hops, chunk=8 * config.chunk)
        found = dataset.read(beside, columns=["converged"], content="equilibria")
        print(f"{beside}: {len(found)} equilibria more, {int((~found.usable).sum())} not converged")
