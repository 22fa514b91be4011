"""Command line: ``python -m training demo|policy``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Annotated, Any

import tyro

from tensegrity_gym.errors import TensegrityError


def main() -> int:
    """Parse, run, and turn named errors into one line and exit status 1."""
    from training import demo, train_policy

    command: Any = tyro.cli(  # type: ignore[operator]
        Annotated[demo.DemoConfig, tyro.conf.subcommand("demo")]
        | Annotated[train_policy.PolicyCommand, tyro.conf.subcommand("policy")],  # type: ignore[arg-type]
        prog="python -m training",
        description="The whole demo, or a policy alone.",
    )
    run: dict[type, Callable[[Any], None]] = {demo.DemoConfig: demo.main, train_policy.PolicyCommand: train_policy.main}
    try:
        run[type(command)](command)
    except TensegrityError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
