"""Command line: ``python -m surrogate generate|check|describe|merge|export|report|train|evaluate``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from typing import Annotated, Any

import tyro

from tensegrity_gym.errors import TensegrityError

#: Commands and their configurations. Modules are imported on use: a worker that makes hops needs no torch.
COMMANDS = {
    "generate": "GenerateConfig",
    "check": "CheckConfig",
    "describe": "DescribeConfig",
    "merge": "MergeConfig",
    "export": "ExportConfig",
    "report": "ReportConfig",
    "train": "TrainCommand",
    "evaluate": "EvaluateConfig",
}


def main() -> int:
    """Parse, run, and turn named errors into one line and exit status 1."""
    # only the command that was asked for is imported; all of them to list what there is
    asked = [name for name in COMMANDS if name in sys.argv[1:2]] or list(COMMANDS)
    runs: dict[type, Callable[[Any], None]] = {}
    kinds: list[Any] = []
    for name in asked:
        module = importlib.import_module(f"surrogate.{name}")
        kind = getattr(module, COMMANDS[name])
        runs[kind] = module.main
        kinds.append(Annotated[kind, tyro.conf.subcommand(name)])
    union: Any = kinds[0]
    for kind in kinds[1:]:
        union = union | kind
    if len(asked) == 1:
        command: Any = tyro.cli(next(iter(runs)), prog=f"python -m surrogate {asked[0]}", args=sys.argv[2:])
    else:
        command = tyro.cli(union, prog="python -m surrogate", description="Hop data, and a surrogate learnt from it.")
    try:
        runs[type(command)](command)
    except TensegrityError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
