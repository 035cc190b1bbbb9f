"""The output folder of a run, with the results of an interrupted run from which the next one continues."""

import contextlib
import hashlib
import os
import pickle
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any, Generic, TypeVar
from weakref import WeakSet

from orthoswarm import __version__
from orthoswarm.export.atomic_file import atomic_write, disk_error
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Frame
from orthoswarm.stores.addresses import is_stored
from orthoswarm.stores.listing import known, stamp

Result = TypeVar("Result")

VIDEO = "video"
"""Sub-folder of `.work` for pictures that were taken out of videos."""


def run_key(frames: Sequence[Frame], options: Any, *files: Path | None) -> str:
    """Key of a run: pictures (name, size, date, fix), options, other files (map, heights) by size and date.

    A run with another key starts afresh.
    """
    digest = hashlib.sha256(f"{__version__} {options!r}".encode())
    for file in files:
        with contextlib.suppress(OSError):
            version = file and (stamp(file) or (file.stat().st_size, file.stat().st_mtime_ns))
            digest.update(f"{version}".encode())
    for frame in frames:
        if is_stored(frame.path):
            digest.update(f"{known(frame.path)}".encode())
        with contextlib.suppress(OSError):
            stat = frame.path.stat()
            # Pictures of videos are taken out anew each time.
            digest.update(f"{stat.st_size} {0 if '#' in frame.image else stat.st_mtime_ns}".encode())
        digest.update(repr((frame.image, frame.vehicle, frame.time_s, frame.fix, frame.fov_hint_rad)).encode())
    return digest.hexdigest()


class Workspace:
    """An output folder that one run writes to at a time.

    Intermediate results lie in its sub-folder `.work` until the run is complete. Used as a context, a run that failed
    before it had anything to go on from (by refused input, for instance) leaves no `.work` and no folder that it made.

    Attributes:
        out: the output folder; made if absent.

    Raises:
        InputError: if another run is writing there, or it is not a folder.
        OrthoSwarmError: if it cannot be written.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self._work = out / ".work"
        self._afresh = not self._work.exists()
        self._missing = missing(out)
        if out.exists() and not out.is_dir():
            raise InputError(f"{out} is a file; choose a folder for --out")
        try:
            self._lock: IO[bytes] | None = _locked_file(self._work / "lock")
        except OSError as error:
            raise disk_error(error, out) from None
        if self._lock is None:
            raise InputError(f"another run is writing to {out}; wait for it or choose another folder")
        _locked.add(self)

    def begin(self, key: str) -> bool:
        """Get ready for a run with a key; True if results of an interrupted one with the same key are there."""
        for part in self.out.glob(".*.part*"):  # of a run that was killed
            _remove(part)
        marker = self._work / "key"
        with contextlib.suppress(OSError):
            if marker.read_text() == key:
                return any(self._work.glob("*.pickle"))
        for entry in self._work.iterdir():
            if entry.name not in ("lock", VIDEO):
                _remove(entry)
        with atomic_write(marker) as part:
            part.write_text(key)
        return False

    def recall(self, name: str, default: Any = None) -> Any:
        """A result stored by an earlier run under a name; `default` without a usable one."""
        try:
            return pickle.loads((self._work / f"{name}.pickle").read_bytes())
        except Exception:  # damaged or of another version: do it again
            return default

    def remember(self, name: str, value: Any) -> None:
        """Store a result for a later run.

        Raises:
            OrthoSwarmError: if the disk is full.
        """
        with atomic_write(self._work / f"{name}.pickle") as part, part.open("wb") as file:
            pickle.dump(value, file, pickle.HIGHEST_PROTOCOL)

    def file(self, name: str) -> Path:
        """Path of a file of intermediate results for a later run; it need not exist."""
        return self._work / name

    def scratch(self, name: str) -> Path:
        """An empty sub-folder of `.work`."""
        path = self._work / "scratch" / name
        _remove(path)
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise disk_error(error, path) from None
        return path

    def clear_scratch(self) -> None:
        """Remove temporary files that a later run cannot use."""
        _remove(self._work / "scratch")

    def remembering(
        self, name: str, run: Callable[..., Iterable[Result]], *, shared: "Shared | None" = None
    ) -> "RememberingRun[Result]":
        """A `run` (function, items) that stores each result, and does not repeat stored ones.

        Args:
            name: of the results. run: runs what is missing. shared: tells results that other calls have in common.
        """
        return RememberingRun(self, name, run, shared)

    def complete(self) -> None:
        """Remove all intermediate results: the run is done."""
        self._discard()

    def _discard(self) -> None:
        """Remove the folder and release it; another run may take it only when its files are gone."""
        for entry in self._work.glob("*"):
            if entry.name != "lock":
                _remove(entry)
        if os.name == "nt":  # where an open file cannot be removed
            self.close()
        _remove(self._work / "lock")
        self.close()
        with contextlib.suppress(OSError):
            self._work.rmdir()

    def close(self) -> None:
        """Release the folder for other runs; stored results stay."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def __enter__(self) -> "Workspace":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._lock is None:  # complete
            return
        self.clear_scratch()
        failed = kind is not None and issubclass(kind, Exception)  # and not interrupted
        if failed and self._afresh and not any(self._work.glob("*.pickle")):
            self._discard()
            unmake(self._missing)
        self.close()


_NOTHING = object()
"""In the place of a result that is not stored; None is a result."""
Shared = Callable[[Callable[..., Any], Any], str | None]
"""Tells the name of function(item) among all results of the run; None where it belongs to its call alone."""


class RememberingRun(Generic[Result]):
    """See Workspace.remembering. Calls are told apart by their order, which is the same in every run."""

    def __init__(
        self, workspace: Workspace, name: str, run: Callable[..., Iterable[Result]], shared: Shared | None = None
    ) -> None:
        self._workspace, self._name, self._run, self._shared = workspace, name, run, shared
        self._calls = 0

    def __call__(self, function: Callable[[Any], Result], items: Sequence[Any], /) -> Iterator[Result]:
        """Yield function(item) for each item, in order."""
        self._calls += 1
        return self._results(self._calls, function, items)

    def _results(self, call: int, function: Callable[[Any], Result], items: Sequence[Any]) -> Iterator[Result]:
        names = [f"{self._name}-{call}-{i}" for i in range(len(items))]
        if self._shared is not None:
            names = [self._shared(function, item) or name for item, name in zip(items, names, strict=True)]
        known = [self._workspace.recall(name, _NOTHING) for name in names]
        missing = [i for i, value in enumerate(known) if value is _NOTHING]
        fresh = iter(self._run(function, [items[i] for i in missing]))
        for i, name in enumerate(names):
            value, known[i] = known[i], None
            if value is _NOTHING:
                value = next(fresh)
                self._workspace.remember(name, value)
            yield value


def missing(folder: Path) -> list[Path]:
    """A folder and its parents that do not exist yet, the innermost first."""
    return [p for p in (folder, *folder.parents) if not p.exists()]


def unmake(folders: Iterable[Path]) -> None:
    """Remove empty folders, the innermost first."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


_locked: "WeakSet[Workspace]" = WeakSet()


def _let_go() -> None:
    """In a forked worker: close its copies of locks, which would hold the folders until the worker has ended, too."""
    for space in list(_locked):
        space.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)


def _locked_file(path: Path) -> IO[bytes] | None:
    """The lock's file, made and locked; None if another run holds it."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab")
        if not _try_lock(file):
            file.close()
            return None
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        file.close()  # the run that held it has ended meanwhile, and removed it


def _try_lock(file: IO[bytes]) -> bool:
    """Lock a file; the lock ends with the process in any case."""
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
        else:
            import fcntl

            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        return not isinstance(error, PermissionError)  # a file system without locks
    return True


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()
