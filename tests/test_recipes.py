"""The cluster recipes in docs/recipes run, with stand-ins for what only a cluster has."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surrogate import dataset
from surrogate.merge import merge

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "docs" / "recipes"
HOPS = 6


def run(command: list[str], folder: Path, **variables: str) -> None:
    """Run in ``folder`` as a job would, with this interpreter first on the path and ``srun`` that runs what it is given."""
    stand_in = folder / "bin"
    stand_in.mkdir(exist_ok=True)
    (stand_in / "srun").write_text('#!/bin/sh\nexec "$@"\n')
    (stand_in / "srun").chmod(0o755)
    path = os.pathsep.join([str(stand_in), str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)} | variables
    log = folder / "log"
    with open(log, "w") as out:  # a file: a pipe would be kept open by whatever the recipe leaves behind
        code = subprocess.run(command, cwd=folder, env=environment, stdout=out, stderr=out, timeout=200).returncode
    assert code == 0, log.read_text()


def hops_of(path: Path) -> list[int]:
    return dataset.read(path)["index"].tolist()


def test_slurm_shards_number_their_hops(tmp_path: Path) -> None:
    script = str(RECIPES / "slurm-shards.sh")
    for task in ("0", "2"):
        arguments = [str(HOPS), "shards", "--duration", "0.01"]
        run(["bash", script, *arguments], tmp_path, SLURM_ARRAY_TASK_ID=task)
    shards = [tmp_path / "shards" / f"shard{k}.h5" for k in (0, 2)]
    assert hops_of(shards[0]) == list(range(HOPS))
    assert hops_of(merge(tmp_path / "all.h5", shards)) == [*range(HOPS), *range(2 * HOPS, 3 * HOPS)]


def test_slurm_dask_makes_the_cluster_and_takes_it_down(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    command = ["bash", str(RECIPES / "slurm-dask.sh"), "hops.h5", "--hops", str(HOPS), "--chunk", "2", "--duration", "0.01"]
    run(command, tmp_path, SLURM_JOB_ID="7")
    assert hops_of(tmp_path / "hops.h5") == list(range(HOPS))
    assert not list(tmp_path.glob("*.json"))


def test_kubernetes_job_numbers_its_hops(tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")  # comes with dask
    job: dict[str, Any] = yaml.safe_load((RECIPES / "kubernetes.yaml").read_text())
    assert (job["apiVersion"], job["kind"], job["spec"]["completionMode"]) == ("batch/v1", "Job", "Indexed")
    pod = job["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert [m["name"] for m in container["volumeMounts"]] == [v["name"] for v in pod["volumes"]]
    shell, flag, line = container["command"]
    line = line.replace("/data", str(tmp_path)).replace("100000", str(HOPS)) + " --duration 0.01"
    run([shell, flag, line], tmp_path, JOB_COMPLETION_INDEX="1")
    np.testing.assert_array_equal(hops_of(tmp_path / "shard1.h5"), HOPS + np.arange(HOPS))
