"""Command line: ``python -m training demo|plan|policy|tune|compare``."""

from __future__ import annotations

import sys

from surrogate.command_line import run

#: Commands and their settings. Modules are imported on use: who asks for a plan need not wait for stable-baselines3.
COMMANDS = {
    "demo": ("training.demo", "DemoConfig"),
    "plan": ("training.plan", "PlanCommand"),
    "policy": ("training.train_policy", "PolicyCommand"),
    "tune": ("training.tune", "TuneConfig"),
    "compare": ("training.compare.run", "CompareConfig"),
}


def main() -> int:
    """Entry of ``python -m training``."""
    said = "The whole demo, plans for targets, a policy alone or tuned, or planners and policies compared."
    return run("python -m training", said, COMMANDS)


if __name__ == "__main__":
    sys.exit(main())
