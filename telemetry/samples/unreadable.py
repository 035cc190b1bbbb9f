"""The failure of a reader: a damaged file must not end a run that has other inputs."""

from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

from orthoswarm.model.errors import OrthoSwarmError, RunInterruptedError

P = ParamSpec("P")
T = TypeVar("T")

MOST_TEXT_BYTES = 256 << 20
"""Larger text files (tables of poses, lists of exposures, subtitles) are refused: they are read into memory."""


class Unreadable(Exception):
    """A file cannot be read; the text is one sentence with the reason and what to do."""


def read_or_reason(read: Callable[P, T], *args: P.args, **options: P.kwargs) -> T | Unreadable:
    """The reader's result, or the reason why it cannot read the file.

    A reader parses untrusted bytes, partly in C code (FFmpeg, OpenCV, GDAL), so any exception concerns that file only,
    not the run.
    """
    try:
        return read(*args, **options)
    except RunInterruptedError:  # not this file's fault
        raise
    except Exception as error:
        return reason_of(error)


def beginning(path: Path, size: int) -> bytes:
    """The first bytes of a file, b"" if it cannot be read: enough to tell what it is."""
    try:
        with path.open("rb") as handle:
            return handle.read(size)
    except OSError:
        return b""


def reason_of(error: Exception) -> Unreadable:
    """A reader's exception as one sentence for the user."""
    if isinstance(error, Unreadable):
        return error
    if isinstance(error, OrthoSwarmError):
        return Unreadable(str(error))
    if isinstance(error, OSError):
        return Unreadable(f"the file cannot be read ({error.strerror or error}); check its permissions and the disk")
    if isinstance(error, MemoryError):
        return Unreadable("the file asks for more memory than there is; it is damaged or too large, leave it out")
    kind = type(error).__name__
    return Unreadable(f"the file is damaged in a way that is not understood ({kind}: {error}); leave it out")
