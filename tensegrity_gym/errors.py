"""Named errors: each says what was expected, what came, and the fix."""

from __future__ import annotations


class TensegrityError(Exception):
    """Base of every error that this project raises on purpose."""


class InvalidStretchesError(TensegrityError, ValueError):
    """Stretches of wrong shape, not finite, or outside the range that the design can be asked for."""


class InvalidParameterError(TensegrityError, ValueError):
    """A design, scene or method parameter that no physical system can have, or an unknown option."""


class UnknownPresetError(TensegrityError, KeyError):
    """A scene preset that does not exist."""

    def __str__(self) -> str:  # KeyError would print the repr of the message
        return str(self.args[0]) if self.args else ""


class OutputFolderError(TensegrityError, OSError):
    """A folder that results should go to cannot be made or written."""


class DataFileError(TensegrityError, OSError):
    """A data file or checkpoint that is missing, damaged, or was made from another configuration."""


class ResetNeededError(TensegrityError, RuntimeError):
    """An env was asked to step while no episode was running."""


class MissingExtraError(TensegrityError, ImportError):
    """Something was asked for that needs an optional package which is not installed."""


class FileInUseError(TensegrityError, OSError):
    """Another process is writing the file that was asked for."""


class SkippedChunksError(TensegrityError, RuntimeError):
    """Some chunks of hops failed again and again and were left out; all others are in the file."""
