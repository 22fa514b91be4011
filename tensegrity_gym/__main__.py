"""Entry of ``python -m tensegrity_gym``."""

import sys

from tensegrity_gym.cli import main

if __name__ == "__main__":
    sys.exit(main())
