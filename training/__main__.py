"""Command line: ``python -m training demo|policy|compare``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Annotated, Any

import tyro

from tensegrity_gym.errors import TensegrityError


def main() -> int:
    """Parse, run, and turn named errors into one line and exit status 1."""
    from training import demo, train_policy
    from training.compare import run as comparing
    from training.compare.config import CompareConfig

    command: Any = tyro.cli(  # type: ignore[operator]
        Annotated[demo.DemoConfig, tyro.conf.subcommand("demo")]
        | Annotated[train_policy.PolicyCommand, tyro.conf.subcommand("policy")]
        | Annotated[CompareConfig, tyro.conf.subcommand("compare")],  # type: ignore[arg-type]
        prog="python -m training",
        description="The whole demo, a policy alone, or planners and policies compared.",
    )
    run: dict[type, Callable[[Any], None]] = {
        demo.DemoConfig: demo.main,
        train_policy.PolicyCommand: train_policy.main,
        CompareConfig: comparing.main,
    }
    try:
        run[type(command)](command)
    except TensegrityError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
