"""Folders and files that are either whole or not there, and locks that die with their holder."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from tensegrity_gym.errors import DataFileError, FileInUseError, InvalidParameterError, OutputFolderError

#: Reasons for which the system refuses to write: no space, no quota, file too large, read-only.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
#: How a sealed file begins; then come the SHA-256 of its content in hex, a line feed and the content.
SEAL = b"tensegrity_gym sealed/1 sha256 "
#: How checkpoints end.
CHECKPOINT = ".safetensors"
#: How the files beside a checkpoint end, and what they are.
CARD, NET_STATE, POLICY_STATE = ".json", ".state.safetensors", ".training"
BESIDE = {
    CARD: "a checkpoint's card",
    NET_STATE: "the state of a surrogate's unfinished training",
    POLICY_STATE: "the state of a policy's unfinished training",
}
PACKAGES = ("numpy", "numba", "scipy", "h5py", "gymnasium", "torch", "stable-baselines3")


def ensure_folder(folder: Path | str) -> Path:
    """Make ``folder`` if it is missing and prove that a file can be written there, else OutputFolderError."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputFolderError(
            f"expected a folder that can be made and written, got {folder}: {error}; choose another --out"
        ) from error
    return folder


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; it takes the name ``path`` only when the block ends well.

    OutputFolderError when the system has no room for it.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield temporary
        with open(temporary, "rb") as written:
            os.fsync(written.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        if isinstance(error, DataFileError) or not _no_room(error):
            raise
        raise OutputFolderError(
            f"expected room to write {path}, got: {error}; free some, or choose another folder; nothing was overwritten"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _no_room(error: OSError) -> bool:
    # h5py tells the reason in words alone
    return error.errno in NO_ROOM or any(f"errno = {code}" in str(error) for code in NO_ROOM)


def _sync_folder(folder: Path) -> None:
    """Make a rename last through a power cut, where the system can."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF):  # some file systems sync no folders
            raise
    finally:
        os.close(descriptor)


@contextmanager
def writer_lock(path: Path | str) -> Iterator[None]:
    """Hold the right to write ``path``; FileInUseError if another process has it. The lock goes when its holder dies."""
    lock = Path(path).with_name(f".{Path(path).name}.lock")
    descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
            raise FileInUseError(
                f"expected to be the only writer of {path}, but process {holder} is at it; wait for it, or choose another file"
            ) from error
        if not _same_file(descriptor, lock):  # the last holder took it away between our open and our lock
            raise FileInUseError(f"expected to be the only writer of {path}, but another one has just ended; run this again")
        os.truncate(descriptor, 0)
        os.write(descriptor, str(os.getpid()).encode())
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
    finally:
        os.close(descriptor)


def _same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def remove_partials(folder: Path, name: str) -> None:
    """Remove what killed writers of ``name`` left half written; call it as the only writer."""
    for left in folder.glob(f".{name}.*.partial"):
        left.unlink(missing_ok=True)


def write_json(path: Path | str, content: Any) -> None:
    """Write JSON atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=True) + "\n", encoding="utf-8")


def read_json(path: Path | str, *, fix: str = "delete it to have it made again") -> Any:
    """Read JSON; DataFileError when the file is missing, or damaged, which ``fix`` says what to do about."""
    if not Path(path).exists():
        raise DataFileError(f"expected a readable JSON file at {path}, found none; see whether the name is right")
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataFileError(f"expected a readable JSON file at {path}: {error}; {fix}") from error


def write_sealed(path: Path | str, content: bytes) -> None:
    """Write ``content`` atomically, behind its SHA-256."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(SEAL + hashlib.sha256(content).hexdigest().encode() + b"\n" + content)


def beside(path: Path | str, ending: str) -> Path:
    """The file that lies beside checkpoint ``path``: its name, without the .safetensors if it has one, and ``ending``.

    Only that suffix is taken off: net_lr0.001 and net_lr0.003 are two names, each with files of its own. Names that are those
    of files beside a checkpoint are refused.
    """
    path = Path(path)
    taken = next((e for e in BESIDE if path.name.endswith(e)), None)
    if taken is not None:
        better = path.with_name((path.name.removesuffix(taken) or "net") + CHECKPOINT)
        raise InvalidParameterError(
            f"expected the name of a checkpoint, such as {better}, got {path}: what ends in {taken} is {BESIDE[taken]}; "
            "choose another name"
        )
    return path.with_name(path.name.removesuffix(CHECKPOINT) + ending)


def beside_data(path: Path | str, ending: str) -> Path:
    """What lies beside file of hops ``path``: its name, without the .h5 or .hdf5 if it has one, and ``ending``."""
    path = Path(path)
    name = path.stem if path.suffix in (".h5", ".hdf5") else path.name  # hops_0.5 and hops_0.7 are two names
    return path.with_name(name + ending)


def read_sealed(path: Path | str) -> bytes:
    """The content that :func:`write_sealed` wrote; DataFileError where a single bit of the file is another."""
    try:
        whole = Path(path).read_bytes()
    except OSError as error:
        raise DataFileError(f"{path}: expected a file that can be read, got {error}; delete it to start anew") from error
    end = len(SEAL) + 64
    if not whole.startswith(SEAL):
        raise DataFileError(
            f"{path}: expected a file that begins with {SEAL.decode()!r} and the SHA-256 of the rest, got {whole[:16]!r}: an "
            "older version wrote it, or it is damaged; delete it to start anew"
        )
    kept, came = whole[len(SEAL) : end + 1], hashlib.sha256(whole[end + 1 :]).hexdigest()
    if kept != came.encode() + b"\n":
        raise DataFileError(f"{path}: expected content of SHA-256 {kept!r}, got {came}: damaged; delete it to start anew")
    return whole[end + 1 :]


def hash_of(content: Any) -> str:
    """Hash of JSON-like content, independent of machine and key order: 16 hex digits."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def package_versions() -> dict[str, str]:
    """Versions of the packages that results may depend on; those not installed are left out."""
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions
