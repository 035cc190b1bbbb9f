"""One way for a reader to fail: no file, however damaged, ends a run that has other inputs."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from orthoswarm.model.errors import OrthoSwarmError

P = ParamSpec("P")
T = TypeVar("T")


class Unreadable(Exception):
    """A file cannot be read; the text is one sentence that tells the user why and what to do."""


def read_or_reason(read: Callable[P, T], *args: P.args, **options: P.kwargs) -> T | Unreadable:
    """What a reader returns, or the reason why it cannot read the file.

    A reader parses bytes that anybody may have written, some of them in C code (FFmpeg, OpenCV, GDAL), so any
    exception of it says something about that file and nothing about the run.

    Args:
        read: the reader.
        args: for it.
        options: for it.
    """
    try:
        return read(*args, **options)
    except Exception as error:
        return reason_of(error)


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
