"""Command lines of several commands: each in a module of its own, with a class of settings and a ``main`` that takes them."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import tyro

from tensegrity_gym.errors import TensegrityError


def run(prog: str, description: str, commands: Mapping[str, tuple[str, str]]) -> int:
    """Parse, run, and turn named errors into one line and exit status 1.

    ``commands``: of each its module and the name of its settings in there. Only the one that is asked for is imported; all of
    them to list what there is.
    """
    asked = [name for name in commands if name in sys.argv[1:2]] or list(commands)
    runs: dict[type, Callable[[Any], None]] = {}
    kinds: list[Any] = []
    for name in asked:
        module, settings = importlib.import_module(commands[name][0]), commands[name][1]
        kind = getattr(module, settings)
        runs[kind] = module.main
        kinds.append(Annotated[kind, tyro.conf.subcommand(name)])
    union: Any = kinds[0]
    for kind in kinds[1:]:
        union = union | kind
    if len(asked) == 1:
        command: Any = tyro.cli(next(iter(runs)), prog=f"{prog} {asked[0]}", args=sys.argv[2:])
    else:
        command = tyro.cli(union, prog=prog, description=description)
    try:
        runs[type(command)](command)
    except TensegrityError as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0
