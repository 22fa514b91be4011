"""A chain of stages in a folder: each leaves a record when it is done, and is skipped while its record still fits."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from surrogate.storage import ensure_folder, hash_of, package_versions, read_json, write_json, writer_lock
from tensegrity_gym import MODEL_VERSION
from tensegrity_gym.errors import DataFileError

Results = dict[str, Any]


class Stages:
    """Runs stages in ``folder``; records lie in ``folder``/stages, one JSON file each.

    A record's hash covers the stage's settings, the version of the physics and the hashes of the stages it needs, so a
    change anywhere upstream makes a stage run again. Another covers its results, so that those which someone edited, or a
    disk damaged, are not taken for what the stage found; records from before there was one count as whole.
    """

    def __init__(self, folder: Path, say: Callable[[str], None] = print) -> None:
        self.folder = ensure_folder(folder)
        self.records = ensure_folder(folder / "stages")
        self.say = say
        self.hashes: dict[str, str] = {}
        self.seconds: dict[str, float] = {}
        self.dates: dict[str, str] = {}
        #: Of packages, when a stage was run.
        self.versions: dict[str, dict[str, str]] = {}
        self.results: dict[str, Results] = {}
        self.skipped: list[str] = []

    def run(
        self, name: str, config: Any, work: Callable[[], Results], *, needs: Sequence[str] = (), files: Sequence[str] = ()
    ) -> Results:
        """Results of stage ``name``: from its record if that fits and all its ``files`` are there, else from ``work()``.

        ``work`` returns JSON-like results; a result named "seconds" replaces the measured wall time. Two processes may work
        in one folder, on different stages: FileInUseError where another is at this one.
        """
        content = {"config": config, "needs": {n: self.hashes[n] for n in needs}, "model_version": MODEL_VERSION}
        wanted = hash_of(content)
        path = self.records / f"{name}.json"
        record = self._record(path)
        if record.get("hash") == wanted and not _whole(record):
            self.say(f"{name}: expected results of hash {record.get('results_hash')}, its record holds others: run again")
            record = {}
        if record.get("hash") == wanted and all((self.folder / f).is_file() for f in files):
            self.say(f"{name}: done before, kept")
            self.skipped.append(name)
        else:
            with writer_lock(path):
                path.unlink(missing_ok=True)  # from now on the stage's files may be others than the record tells of
                started = time.perf_counter()
                results = work()
                seconds = results.get("seconds", time.perf_counter() - started)
                date = datetime.now(UTC).isoformat(timespec="seconds")
                record = {"hash": wanted, **content, "seconds": seconds, "date": date, "results": results}
                record["versions"] = package_versions()
                record["results_hash"] = _results_hash(record)
                write_json(path, record)
            self.say(f"{name}: {seconds:.1f} s")
        self.hashes[name] = wanted
        self.seconds[name], self.dates[name] = float(record["seconds"]), record["date"]
        self.versions[name] = record.get("versions", {})
        self.results[name] = record["results"]
        return self.results[name]

    @staticmethod
    def _record(path: Path) -> dict[str, Any]:
        if not path.exists():
            return {}
        try:
            record = read_json(path)
        except DataFileError:
            return {}  # a damaged record proves nothing: run the stage again
        return record if isinstance(record, dict) else {}


def _results_hash(record: dict[str, Any]) -> str:
    """Hash of what a stage found, as it is read back: JSON knows no tuples, and no keys but text."""
    return hash_of(json.loads(json.dumps([record["results"], record["seconds"]])))


def _whole(record: dict[str, Any]) -> bool:
    """Whether a record holds what its stage found, as far as it can tell."""
    if not {"results", "seconds", "date"} <= set(record):
        return False
    return "results_hash" not in record or record["results_hash"] == _results_hash(record)
