"""numba settings for the kernels: nogil, strict IEEE, and a compile cache that cannot go stale.

numba keys its cache by the file of the compiled function alone, so a change in a kernel that it calls would go unseen. We
key the cache folder by a hash of the whole package ``core`` instead.
"""

from __future__ import annotations

import getpass
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba


def _cache_folder() -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    try:
        root = (
            os.environ.get("TENSEGRITY_GYM_CACHE")
            or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tensegrity_gym"
        )
        folder = Path(root) / digest.hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except (OSError, RuntimeError):  # nothing can be written there, or the user has no home at all
        folder = (
            Path(tempfile.gettempdir()) / f"tensegrity_gym-{getattr(os, 'getuid', getpass.getuser)()}" / digest.hexdigest()[:16]
        )
        folder.mkdir(parents=True, exist_ok=True)
    return str(folder)


CACHE_FOLDER = _cache_folder()


def jit(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """``numba.njit`` with nogil, strict floating point and numpy's error model; ``cache=True`` for entry points."""

    def decorate(python_function: Callable[..., Any]) -> Any:
        settings: dict[str, Any] = {"nogil": True, "error_model": "numpy", **options}
        if not settings.get("cache"):
            # LLVM leaves most of these small functions as calls, with vectors passed through memory: 3x slower
            settings.setdefault("forceinline", True)
            settings.setdefault("_nrt", False)
            return numba.njit(python_function, **settings)
        previous = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = CACHE_FOLDER  # read while the cache is attached, so restore right after
        try:
            return numba.njit(python_function, **settings)
        finally:
            numba.config.CACHE_DIR = previous

    return decorate if function is None else decorate(function)
