"""Command line: ``python -m surrogate generate|check|describe|merge|export|report|train|evaluate``."""

from __future__ import annotations

import sys

from surrogate.command_line import run

#: Commands and their settings. Modules are imported on use: a worker that makes hops needs no torch.
COMMANDS = {
    "generate": ("surrogate.generate", "GenerateConfig"),
    "check": ("surrogate.check", "CheckConfig"),
    "describe": ("surrogate.describe", "DescribeConfig"),
    "merge": ("surrogate.merge", "MergeConfig"),
    "export": ("surrogate.export", "ExportConfig"),
    "report": ("surrogate.report", "ReportConfig"),
    "train": ("surrogate.train", "TrainCommand"),
    "evaluate": ("surrogate.evaluate", "EvaluateConfig"),
}


def main() -> int:
    """Entry of ``python -m surrogate``."""
    return run("python -m surrogate", "Hop data, and a surrogate learnt from it.", COMMANDS)


if __name__ == "__main__":
    sys.exit(main())
