"""Weights kept as safetensors with a JSON card beside them, which holds their checksum: nothing is unpickled."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from surrogate.storage import CARD, atomic_path, beside, ensure_folder, read_json, write_json
from tensegrity_gym.errors import DataFileError


def write_weights(path: Path | str, tensors: Mapping[str, Tensor], card: Mapping[str, Any]) -> Path:
    """Write tensors to ``path`` and the card, with their checksum, beside it."""
    path = Path(path)
    kept = beside(path, CARD)
    ensure_folder(path.parent)
    content = save_tensors({name: value.cpu().contiguous() for name, value in tensors.items()})
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    write_json(kept, {**card, "sha256": hashlib.sha256(content).hexdigest()})
    return path


@contextmanager
def weights_at(
    path: Path | str, what: str, expected: Mapping[str, tuple[Any, ...]]
) -> Iterator[tuple[dict[str, Tensor], dict[str, Any]]]:
    """Tensors and card, as :func:`write_weights` wrote them, to build ``what`` from in the block.

    Raises DataFileError, which names ``path``, for files that are missing or damaged, a card that has not one of the
    ``expected`` values (the last is the usual one) of a name, and whatever the block cannot make of what it got.
    """
    path = Path(path)
    card = read_json(beside(path, CARD), fix="train it again")
    for name, values in expected.items():
        came = card.get(name) if isinstance(card, dict) else None
        if came not in values:
            raise DataFileError(f"{path}: expected {what} with {name} {values[-1]!r}, got {came!r}; train it again")
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != card["sha256"]:
            raise ValueError(f"its checksum is not {card['sha256']}, as the card says")
        yield load_tensors(content), card
    except (OSError, ValueError, LookupError, TypeError, RuntimeError, SafetensorError) as error:
        raise DataFileError(f"{path}: expected a whole checkpoint of {what} ({error}); train it again") from error
