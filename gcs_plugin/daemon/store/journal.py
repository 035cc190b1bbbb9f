"""The daemon's journal: SQLite with a write-ahead log, written by one thread that commits many changes at once.

When `write` returns (or its future resolves), the change is on the disk: a commit is followed by fsync, and one fsync
serves all changes that waited meanwhile. Texts from outside (names of vehicles and pictures) are stored as JSON in
ASCII, so that all characters, NUL and lone surrogates included, are preserved.
"""

import contextlib
import json
import queue
import sqlite3
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Final, TypeVar

from orthoswarm.model.errors import DiskFullError, OrthoSwarmError, StorageError

Result = TypeVar("Result")

_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS vehicles (
    id TEXT PRIMARY KEY, sortie INTEGER NOT NULL DEFAULT 1, state TEXT NOT NULL DEFAULT '{}');
CREATE TABLE IF NOT EXISTS frames (
    seq INTEGER PRIMARY KEY AUTOINCREMENT, key BLOB NOT NULL UNIQUE, vehicle TEXT NOT NULL, image TEXT NOT NULL,
    sortie INTEGER NOT NULL, time REAL, arrived REAL NOT NULL, path TEXT NOT NULL,
    width INTEGER NOT NULL, height INTEGER NOT NULL, pose TEXT NOT NULL,
    drawn INTEGER NOT NULL DEFAULT 0, stage TEXT NOT NULL DEFAULT 'realtime', sigma REAL, reason TEXT, camera TEXT);
CREATE INDEX IF NOT EXISTS frames_by_vehicle ON frames (vehicle, sortie);
CREATE INDEX IF NOT EXISTS frames_to_draw ON frames (drawn) WHERE drawn = 0;
CREATE TABLE IF NOT EXISTS jobs (
    id INTEGER PRIMARY KEY AUTOINCREMENT, kind TEXT NOT NULL, vehicle TEXT, sortie INTEGER,
    state TEXT NOT NULL, progress REAL NOT NULL DEFAULT 0, message TEXT NOT NULL DEFAULT '',
    created REAL NOT NULL, started REAL, ended REAL, attempts INTEGER NOT NULL DEFAULT 0, detail TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS solutions (
    vehicle TEXT NOT NULL, sortie INTEGER NOT NULL, path TEXT NOT NULL, detail TEXT NOT NULL,
    PRIMARY KEY (vehicle, sortie));
CREATE TABLE IF NOT EXISTS coarse (
    vehicle TEXT NOT NULL, sortie INTEGER NOT NULL, path TEXT NOT NULL, detail TEXT NOT NULL,
    PRIMARY KEY (vehicle, sortie));
CREATE TABLE IF NOT EXISTS thumbnails (seq INTEGER PRIMARY KEY, rgb BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS qualities (
    seq INTEGER PRIMARY KEY, sharpness REAL, contrast REAL, flat_share REAL, saturated_share REAL);
CREATE TABLE IF NOT EXISTS exposures (
    vehicle TEXT NOT NULL, number INTEGER NOT NULL, time REAL NOT NULL, lat REAL, lon REAL,
    PRIMARY KEY (vehicle, number, time));
CREATE TABLE IF NOT EXISTS completions (
    id INTEGER PRIMARY KEY AUTOINCREMENT, vehicle TEXT NOT NULL, sortie INTEGER NOT NULL, detail TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS people (
    id INTEGER PRIMARY KEY AUTOINCREMENT, name TEXT NOT NULL, role TEXT NOT NULL, invitation BLOB NOT NULL UNIQUE,
    session BLOB UNIQUE, made REAL NOT NULL, joined REAL, revoked REAL);
CREATE TABLE IF NOT EXISTS deeds (
    id INTEGER PRIMARY KEY AUTOINCREMENT, time REAL NOT NULL, name TEXT NOT NULL, role TEXT NOT NULL,
    action TEXT NOT NULL, target TEXT NOT NULL, outcome TEXT NOT NULL, reason TEXT NOT NULL,
    count INTEGER NOT NULL DEFAULT 1);
"""
_WROTE_REFINED: Final = """
SELECT NOT EXISTS (SELECT 1 FROM jobs WHERE kind = 'refine' AND state IN ('queued', 'running')) AND EXISTS (
    SELECT 1 FROM jobs WHERE kind = 'export' AND state = 'done' AND started >= (
        SELECT max(ended) FROM jobs WHERE kind = 'refine' AND state = 'done'))
"""
_BATCH: Final = 256  # changes in one transaction
_BUSY_S: Final = 30.0

Change = Callable[[sqlite3.Connection], Any]


def packed(text: str) -> str:
    """Any text as ASCII that SQLite can hold."""
    return json.dumps(text)


def unpacked(text: str) -> str:
    """The text that was `packed`."""
    return str(json.loads(text))


def _write_error(error: Exception) -> StorageError:
    """The reason of a failed commit, as our own error."""
    if isinstance(error, sqlite3.Error) and getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL:
        return DiskFullError("the disk is full, the journal cannot be written; free some space")
    return StorageError(f"the journal cannot be written ({error}); check the workspace's disk")


class Journal:
    """Everything that must survive a crash, except pictures and map tiles.

    Attributes:
        path: the database file; made if absent.
        commits: number of commits.
    """

    def __init__(self, path: Path) -> None:
        """Open or make the journal.

        Raises:
            OrthoSwarmError: the file cannot be opened, is not a journal, or is damaged.
        """
        self.path, self.commits = path, 0
        self._local = threading.local()
        self._readers: list[sqlite3.Connection] = []
        self._guard = threading.Lock()
        self._work: queue.SimpleQueue[tuple[Change, Future[Any]] | None] = queue.SimpleQueue()
        try:
            self._writer = self._connect()
            self._writer.execute("PRAGMA journal_mode=WAL")
            self._writer.execute("PRAGMA synchronous=FULL")
            found = self._writer.execute("PRAGMA quick_check(1)").fetchone()[0]
            if found != "ok":  # a page written halfway, by a card or cable that failed
                raise sqlite3.DatabaseError("database disk image is malformed")
            self._writer.executescript(_SCHEMA)
        except sqlite3.Error as error:
            if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) == sqlite3.SQLITE_CORRUPT:
                raise OrthoSwarmError(
                    f"the journal {path} is damaged; rescue what is in it with `sqlite3 {path.name} .recover`,"
                    " or choose another workspace and send the pictures again"
                ) from None
            raise OrthoSwarmError(f"the journal {path} cannot be opened ({error}); choose another workspace") from None
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Write the waiting changes and close the file."""
        self._work.put(None)
        self._thread.join()
        with self._guard:
            for reader in self._readers:
                with contextlib.suppress(sqlite3.Error):
                    reader.close()
            self._readers.clear()
        self._writer.close()

    # -- writing --------------------------------------------------------------------------------------------------

    def submit(self, change: Callable[[sqlite3.Connection], Result]) -> "Future[Result]":
        """Queue a change; the future has the change's result once it is safe on the disk.

        A change that raises is undone by itself; others of its batch stay. A full disk fails the whole batch.
        """
        future: Future[Any] = Future()
        self._work.put((change, future))
        return future

    def write(self, change: Callable[[sqlite3.Connection], Result]) -> Result:
        """Make a change and wait until it is safe on the disk."""
        return self.submit(change).result()

    def _run(self) -> None:
        while True:
            first = self._work.get()
            if first is None:
                return
            batch, last = [first], False
            while len(batch) < _BATCH:
                try:
                    more = self._work.get_nowait()
                except queue.Empty:
                    break
                if more is None:
                    last = True
                    break
                batch.append(more)
            self._commit(batch)
            if last:
                return

    def _commit(self, batch: Sequence[tuple[Change, "Future[Any]"]]) -> None:
        outcomes: list[tuple[Future[Any], Any, BaseException | None]] = []
        try:
            self._writer.execute("BEGIN IMMEDIATE")
            for change, future in batch:
                self._writer.execute("SAVEPOINT change")
                try:
                    outcomes.append((future, change(self._writer), None))
                except Exception as error:
                    self._writer.execute("ROLLBACK TO change")
                    outcomes.append((future, None, error))
                self._writer.execute("RELEASE change")
            self._writer.execute("COMMIT")
            self.commits += 1
        except Exception as error:  # the disk is full or missing: nothing of this batch was written
            with contextlib.suppress(sqlite3.Error):
                self._writer.execute("ROLLBACK")
            reason = _write_error(error)
            for _, future in batch:
                future.set_exception(reason)
            return
        for future, value, problem in outcomes:
            if problem is not None:
                future.set_exception(problem)
            else:
                future.set_result(value)

    # -- reading --------------------------------------------------------------------------------------------------

    def rows(self, query: str, values: Sequence[Any] | Mapping[str, Any] = ()) -> list[sqlite3.Row]:
        """The rows of a query, from any thread."""
        return list(self._reader().execute(query, values))

    def one(self, query: str, values: Sequence[Any] = ()) -> sqlite3.Row | None:
        """The first row of a query, None if there is none."""
        row: sqlite3.Row | None = self._reader().execute(query, values).fetchone()
        return row

    def _reader(self) -> sqlite3.Connection:
        reader: sqlite3.Connection | None = getattr(self._local, "reader", None)
        if reader is None:
            reader = self._local.reader = self._connect()
            reader.execute("PRAGMA query_only=ON")
            with self._guard:
                self._readers.append(reader)
        return reader

    def _connect(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self.path, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
        connection.row_factory = sqlite3.Row
        return connection

    # -- small facts ----------------------------------------------------------------------------------------------

    def fact(self, key: str) -> Any:
        """A stored JSON value, None if there is none."""
        row = self.one("SELECT value FROM meta WHERE key = ?", (key,))
        return None if row is None else json.loads(row["value"])

    def remember(self, key: str, value: Any) -> None:
        """Store a JSON value."""
        self.write(fact_change(key, value))


def statement(query: str, values: Sequence[Any]) -> Change:
    """The change that one statement makes."""
    return lambda db: db.execute(query, values)


def statements(query: str, rows: Sequence[Sequence[Any]]) -> Change:
    """The change that a statement makes with each of some rows."""
    return lambda db: db.executemany(query, rows)


def fact_change(key: str, value: Any) -> Change:
    """The change that stores a JSON value, to be combined with others."""
    return statement("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, json.dumps(value)))


def drawn_forgotten(db: sqlite3.Connection) -> None:
    """The change after which all frames are drawn again."""
    db.execute("UPDATE frames SET drawn = 0")


def area_forgotten(db: sqlite3.Connection) -> None:
    """The change that drops the map's location; all frames are drawn again."""
    drawn_forgotten(db)
    db.execute("DELETE FROM meta WHERE key IN ('area', 'realtime')")


def no_change(_: sqlite3.Connection) -> None:
    """The change that changes nothing."""


def all_changes(*changes: Change) -> Change:
    """Several changes as one."""

    def change(db: sqlite3.Connection) -> None:
        for one in changes:
            one(db)

    return change


def wrote_refined(folder: Path) -> bool:
    """Whether the products were written after all refinements; true of a folder that is no workspace. Any process."""
    path = (folder / "journal.db").resolve()
    if not path.exists():
        return True
    uri = f"{path.as_uri()}?mode=ro"
    with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(uri, uri=True, timeout=_BUSY_S)) as db:
        return bool(db.execute(_WROTE_REFINED).fetchone()[0])
    return False  # its daemon is only just making it
