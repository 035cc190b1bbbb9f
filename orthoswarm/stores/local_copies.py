"""Local copies of files from stores, in a cache of bounded size that all processes of a machine share.

A copy appears as a whole. When the cache is full, copies go in the order of their last use, except those that were
used a moment ago; a copy that went away between two uses is fetched again.
"""

import contextlib
import math
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Final

from orthoswarm.model.errors import InputError, RunInterruptedError, StorageError
from orthoswarm.stores.addresses import address_of, is_stored
from orthoswarm.stores.listing import StoredFile, known, look_up, remember
from orthoswarm.stores.requests import CONNECTIONS, StoreRequestError, request

FOLDER_VARIABLE = "ORTHOSWARM_CACHE"
"""Environment variable that names another folder for copies than the user's cache folder."""
SIZE_VARIABLE = "ORTHOSWARM_CACHE_MB"
"""Environment variable that gives another size of that folder, megabytes: each machine has its own disk."""
_CACHE_MB: Final = 8000.0  # a flight of 500 photos of 12 megapixels takes 3 GB
_COMPARE_VARIABLE = "ORTHOSWARM_COMPARE_FROM"
"""Environment variable that tells the processes of a run when it began, epoch seconds."""
_SLACK = 16  # the cache may exceed its size by a 16th for each process that writes to it
_ABANDONED_S = 86_400.0
_TRUST_S: Final = 600.0
"""A copy that was made or compared with its store in this run, and no longer ago, is used without asking, seconds: a
request takes some 20 ms, and a picture is read two to four times in a run."""
_HELD_S: Final = 600.0  # a copy used no longer ago is not removed: another process may be about to open it
_added = 0
_lock = threading.Lock()


class CacheFullError(RunInterruptedError, StorageError):
    """Copies cannot be written: all files are concerned, and not the one that came first."""


def compare_from_now() -> None:
    """Compare each copy with its store before it is used: a run begins, and files may have been replaced.

    It concerns this process and those that it starts from now on.

    Raises InputError: the environment gives no size for the cache.
    """
    cache_bytes()
    os.environ[_COMPARE_VARIABLE] = str(time.time())


def _compared_from() -> float:
    """When the run began that this process belongs to; 0 for none."""
    try:
        return float(os.environ.get(_COMPARE_VARIABLE, 0.0))
    except ValueError:
        return 0.0


def expect(listed: Mapping[Path, StoredFile]) -> None:
    """Take over what a listing has just told; copies of anything else are compared before any process uses them."""
    remember(listed)
    now = time.time()
    for path, found in listed.items():
        copy = _place(path)
        with contextlib.suppress(OSError):
            same = found.version and _version_of(copy) == f"{found.size} {found.version}"
            os.utime(copy, (copy.stat().st_atime, now if same else 0.0))


def cache_folder() -> Path:
    """Where copies lie on this machine."""
    return Path(os.environ.get(FOLDER_VARIABLE) or Path.home() / ".cache" / "orthoswarm")


def cache_bytes() -> float:
    """How much copies may take on this machine. Raises InputError: the environment gives no number above 0."""
    said = os.environ.get(SIZE_VARIABLE) or _CACHE_MB
    try:
        limit = 1e6 * float(said)
    except ValueError:
        limit = math.nan
    if not limit > 0.0:
        raise InputError(f"{SIZE_VARIABLE} is {said}, which is no size; give megabytes, for example 8000")
    return limit


def local_file(path: Path) -> Path:
    """A local file with the content of a file, under the same name; the path itself if it is local.

    Raises:
        NotStoredError, StoreRequestError, StoreLostError, StoreAccessError: see `requests.request`.
        CacheFullError: if the copy cannot be written.
    """
    if not is_stored(path):
        return path
    _ahead.wait(path)
    return _copied(path)


def copy_ahead(paths: Iterable[Path]) -> None:
    """Begin to copy those of these files that lie in stores: they will be read soon, in this order."""
    stored = [path for path in paths if is_stored(path)]
    if stored:
        _ahead.announce(stored, CONNECTIONS)


def _copied(path: Path) -> Path:
    """The local copy of a file in a store, made if there is none or an old one."""
    copy = _place(path)
    now = time.time()
    with contextlib.suppress(FileNotFoundError):
        state = copy.stat()
        trusted = state.st_mtime >= max(now - _TRUST_S, _compared_from())
        if trusted or _is_current(path, copy):  # times of the copy: of its last use, of its last comparison
            os.utime(copy, (now, state.st_mtime if trusted else now))
            return copy
    _fetch(path, copy)
    return copy


class Ahead:
    """Files that are copied ahead of their use by a few threads: a task would wait for the network at each.

    Threads end when nothing is announced any more. What is wanted before its turn is left to the one who wants it.

    copy: copies one; raises nothing that matters, since whoever wants the file copies it again and finds out.
    """

    def __init__(self, copy: Callable[[Path], object]) -> None:
        self._copy = copy
        self._lock = threading.Lock()
        self._announced: OrderedDict[Path, None] = OrderedDict()
        self._busy: dict[Path, threading.Event] = {}
        self._threads = 0

    def announce(self, paths: Iterable[Path], threads: int) -> None:
        """Begin to copy files that will be wanted soon, in this order, so many at once."""
        with self._lock:
            self._announced.update((path, None) for path in paths if path not in self._busy)
            more = max(0, min(len(self._announced), threads) - self._threads)
            self._threads += more
        for _ in range(more):
            threading.Thread(target=self._work, daemon=True).start()

    def wait(self, path: Path) -> None:
        """Wait for a file that is being copied; one that has not begun is not copied ahead any more."""
        with self._lock:
            self._announced.pop(path, None)
            busy = self._busy.get(path)
        if busy is not None:
            busy.wait()

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._announced:
                    self._threads -= 1
                    return
                path, _ = self._announced.popitem(last=False)
                done = self._busy[path] = threading.Event()
            try:
                with contextlib.suppress(Exception):
                    self._copy(path)
            finally:
                with self._lock:
                    del self._busy[path]
                done.set()


_ahead = Ahead(_copied)


def content(path: Path) -> bytes:
    """The bytes of a file, local or in a store.

    Raises OSError: if a local file cannot be read. Else see `local_file`.
    """
    while True:
        try:
            return local_file(path).read_bytes()
        except FileNotFoundError:
            if not is_stored(path):
                raise  # a copy that another process has just removed is fetched again


def clear_old_copies() -> None:
    """Remove copies used least recently until the cache is within its size."""
    limit, now = cache_bytes(), time.time()
    copies: list[tuple[float, int, Path]] = []
    for folder in _folders(cache_folder() / "copies"):
        with contextlib.suppress(OSError):
            for entry in os.scandir(folder):
                state = entry.stat(follow_symlinks=False)
                copies.append((state.st_atime, state.st_size, Path(entry.path)))
    for part in (cache_folder() / "parts").glob("*"):
        with contextlib.suppress(OSError):
            if now - part.stat().st_mtime > _ABANDONED_S:  # of a process that was killed
                part.unlink()
    total = sum(size for _, size, _ in copies)
    for used, size, copy in sorted(copies):
        if total <= limit or now - used < _HELD_S:
            return
        with contextlib.suppress(OSError):
            copy.unlink()
            Path(f"{copy}.version").unlink(missing_ok=True)
            copy.parent.rmdir()  # if nothing else lies there
        total -= size


def _folders(top: Path) -> list[Path]:
    try:
        return [Path(entry.path) for entry in os.scandir(top) if entry.is_dir()]
    except OSError:
        return []


def _place(path: Path) -> Path:
    """Where a path's copy lies; the file keeps its name, which users see in messages and GDAL takes its format from."""
    return cache_folder() / "copies" / blake2b(address_of(path).encode(), digest_size=12).hexdigest() / path.name


def _is_current(path: Path, copy: Path) -> bool:
    """Whether the store still holds what was copied."""
    try:
        version = _version_of(copy)
    except OSError:
        return False
    found = look_up(path)
    return version == f"{found.size} {found.version}" != "None "


def _version_of(copy: Path) -> str:
    return Path(f"{copy}.version").read_text(encoding="utf-8")


def _fetch(path: Path, copy: Path) -> None:
    """Copy a file from its store; one that is replaced meanwhile is copied once more."""
    global _added
    part = cache_folder() / "parts" / f"{os.getpid()}-{threading.get_ident()}"
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        for listed in (known(path), None):
            found = listed or look_up(path)
            request(path, lambda system, key: system.get_file(key, str(part)))
            size = part.stat().st_size
            if found.size in (None, size):
                break
        else:
            raise StoreRequestError(f"{address_of(path)} came with {size} of {found.size} bytes; upload it again")
        _put_in_place(part, copy, f"{found.size} {found.version}")
    except OSError as error:
        raise CacheFullError(
            f"{cache_folder()} cannot be written ({error.strerror}); set {FOLDER_VARIABLE} to a folder with room and "
            "run the same command again to go on"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink()
    with _lock:
        _added += size
        full = _added * _SLACK > cache_bytes()
        _added = 0 if full else _added
    if full:
        clear_old_copies()


def _put_in_place(part: Path, copy: Path, version: str) -> None:
    for left in (2, 1, 0):
        try:
            copy.parent.mkdir(parents=True, exist_ok=True)
            Path(f"{copy}.version").write_text(version, encoding="utf-8")
            os.replace(part, copy)
            return
        except FileNotFoundError:  # another process has just removed the empty folder
            if not left:
                raise
