"""The quickstart of docs/env.md runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parent.parent / "docs" / "env.md"


def test_the_quickstart_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(blocks) == 5
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in blocks:
        if "stable_baselines3" in block:
            pytest.importorskip("stable_baselines3")
        exec(compile(block, str(PAGE), "exec"), names)
    assert (tmp_path / "hop.gif").stat().st_size > 10_000
    assert len(names["frames"]) > 60  # type: ignore[arg-type]
