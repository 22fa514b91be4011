"""Command line: ``python -m surrogate generate|train|evaluate``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Annotated, Any

import tyro

from tensegrity_gym.errors import TensegrityError


def main() -> int:
    """Parse, run, and turn named errors into one line and exit status 1."""
    from surrogate import evaluate, generate, train

    command: Any = tyro.cli(  # type: ignore[operator]
        Annotated[generate.GenerateConfig, tyro.conf.subcommand("generate")]
        | Annotated[train.TrainCommand, tyro.conf.subcommand("train")]
        | Annotated[evaluate.EvaluateConfig, tyro.conf.subcommand("evaluate")],  # type: ignore[arg-type]
        prog="python -m surrogate",
        description="Generate hop data, train the surrogate on it, evaluate it.",
    )
    run: dict[type, Callable[[Any], None]] = {
        generate.GenerateConfig: generate.main,
        train.TrainCommand: train.main,
        evaluate.EvaluateConfig: evaluate.main,
    }
    try:
        run[type(command)](command)
    except TensegrityError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
