"""Atomic writing: a product is written under another name in the same folder, then renamed."""

import errno
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from orthoswarm.model.errors import DiskFullError, StorageError

FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})  # what the system says of a full disk, or of a used quota


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to; on success it replaces `path`, on failure it is removed.

    Raises StorageError: if the disk is full or the folder cannot be written.
    """
    part = path.with_name(f".{path.stem}.part{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove(part)
        yield part
        if part.is_dir() and path.is_dir():
            shutil.rmtree(path)
        os.replace(part, path)
    except OSError as error:
        _remove(part)
        raise disk_error(error, path) from None
    except BaseException:
        _remove(part)
        raise


def write_file(path: Path, content: str | bytes | Iterable[str]) -> None:
    """Write a file, texts in UTF-8, that appears when it is complete.

    Raises StorageError: if the disk is full or the folder cannot be written.
    """
    with atomic_write(path) as part:
        if isinstance(content, bytes):
            part.write_bytes(content)
        else:
            with part.open("w", encoding="utf-8", newline="\n") as file:
                file.writelines([content] if isinstance(content, str) else content)


def disk_error(error: OSError, path: Path) -> StorageError:
    """One clear sentence about a file that could not be written."""
    if error.errno in FULL:
        return DiskFullError(f"the disk is full, {path.name} was not written; free some space and run again")
    return StorageError(f"{path} cannot be written ({error.strerror or error}); choose another folder")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):  # what hinders it hinders the writing, which says so
            path.unlink()
