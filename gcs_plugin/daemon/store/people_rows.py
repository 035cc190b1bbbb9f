"""The people of a command post: invitations, sessions and roles, who has which vehicle, and who did what when.

A secret (of an invitation, of a session) is given out once; the journal has its hash alone. Secrets are random, so one
round of SHA-256 hides them. Who commands a free vehicle has it, until it is handed over, freed, or its pilot is gone.
"""

import csv
import hashlib
import io
import logging
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, NamedTuple

from gcs_plugin.daemon.store.daemon_events import Events
from gcs_plugin.daemon.store.journal import Journal, fact_change, packed, unpacked
from orthoswarm.export.product_files import iso_time
from orthoswarm.export.tactical.places import spreadsheet_cell
from orthoswarm.model.errors import InputError, OrthoSwarmError

_INVITED_S: Final = 24 * 3600.0  # an invitation that nobody has opened by then is void: it may lie in a chat for ever
_MOST_NAME: Final = 60  # characters
_MOST_PEOPLE: Final = 500  # invitations ever made in a workspace; beyond that something makes them by itself
_LATEST: Final = 500  # entries of the log that a page gets
_JOINED_UP_S: Final = 60.0  # drawing saves the plan with each corner: such edits of one person are one entry
_COLUMNS: Final = ("time", "name", "role", "action", "target", "outcome", "reason", "count")
_log = logging.getLogger(__name__)


class Role(IntEnum):
    """What somebody may do; each may do what those before may. The operator has the daemon's token."""

    ANYBODY = 0
    VIEWER = 1
    ANALYST = 2
    PILOT = 3
    OPERATOR = 4

    @property
    def word(self) -> str:
        """Its name for people and in JSON."""
        return self.name.lower()


INVITED: Final = {role.word: role for role in (Role.VIEWER, Role.ANALYST, Role.PILOT)}
"""The roles that an invitation can give, by word."""


@dataclass(frozen=True, slots=True)
class Person:
    """Who makes a request; `id` 0 is the operator."""

    id: int
    name: str
    role: Role


NOBODY: Final = Person(-1, "", Role.ANYBODY)
OPERATOR: Final = Person(0, "operator", Role.OPERATOR)


class Deed(NamedTuple):
    """What came of a request, for the log: `target` names a vehicle, a plan, a find."""

    action: str
    target: str
    outcome: str
    reason: str = ""


class People:
    """Invitations, sessions and the log.

    Args:
        journal: keeps them. events: tells pages of changes. clock: seconds that nobody sets.
    """

    def __init__(self, journal: Journal, events: Events, clock: Callable[[], float] = time.monotonic) -> None:
        self._journal, self._events, self._clock = journal, events, clock
        self._lock = threading.Lock()
        self._sessions: dict[bytes, Person] = {}
        self._known: dict[int, Person] = {}
        self._seen: dict[int, float] = {}
        self._read()

    def _read(self) -> None:
        rows = self._journal.rows("SELECT * FROM people WHERE session IS NOT NULL AND revoked IS NULL")
        self._sessions = {
            bytes(row["session"]): Person(row["id"], unpacked(row["name"]), INVITED[row["role"]]) for row in rows
        }
        self._known = {person.id: person for person in (OPERATOR, *self._sessions.values())}

    def invite(self, name: object, role: object) -> tuple[int, str]:
        """Invite somebody; returns the person's id and the invitation's secret.

        Raises:
            InputError: there is no such role, the name is empty, too long or taken, or there are too many people.
        """
        if not isinstance(name, str) or not 0 < len(name.strip()) <= _MOST_NAME or not name.isprintable():
            raise InputError(f"name is not a name of 1 to {_MOST_NAME} printable characters; send one")
        if not isinstance(role, str) or role not in INVITED:
            raise InputError(f"there is no such role; choose {', '.join(INVITED)}")
        name, secret = name.strip(), secrets.token_urlsafe(24)
        values = (packed(name), role, _hash(secret), time.time())
        with self._lock:
            rows = self.rows()
            if name == OPERATOR.name or any(row["name"] == name and row["state"] != "revoked" for row in rows):
                raise InputError(f"{name} is here already; choose another name, or revoke the first invitation")
            if len(rows) >= _MOST_PEOPLE:
                raise InputError(f"{_MOST_PEOPLE} people were invited already; begin another workspace")
            number = self._journal.write(
                lambda db: db.execute("INSERT INTO people (name, role, invitation, made) VALUES (?, ?, ?, ?)", values)
            ).lastrowid
        self._events.tell("people")
        return int(number or 0), secret

    def join(self, invitation: object) -> tuple[Person, str] | None:
        """Exchange an invitation for a session's secret, once; None if it is void."""
        if not isinstance(invitation, str):
            return None
        secret, now = secrets.token_urlsafe(24), time.time()
        values = (_hash(secret), now, _hash(invitation), now - _INVITED_S)
        with self._lock:
            row = self._journal.write(lambda db: db.execute(_JOIN, values).fetchone())
            self._read()
        if row is None:
            return None
        self._events.tell("people")
        return self._known[row["id"]], secret

    def revoke(self, number: int) -> bool:
        """Make somebody's invitation and session void, at once; False if there is no such person."""
        if not 0 < number < 2**62:
            return False
        values = (time.time(), number)
        with self._lock:
            change = "UPDATE people SET revoked = ? WHERE id = ? AND revoked IS NULL"
            done = self._journal.write(lambda db: db.execute(change, values)).rowcount > 0
            self._read()
        self._events.tell("people")
        return done

    def rows(self) -> list[dict[str, Any]]:
        """Everybody ever invited, as JSON values: `id`, `name`, `role`, `state`, `made`, `here`.

        `state`: invited, expired (not opened in time), joined or revoked. `here`: whether the page is open now.
        """
        rows = self._journal.rows(_EVERYBODY, (time.time() - _INVITED_S,))
        return [
            {key: row[key] for key in ("id", "role", "state")}
            | {"name": unpacked(row["name"]), "made": iso_time(row["made"]), "here": self.is_here(row["id"], 5.0)}
            for row in rows
        ]

    def of_session(self, secret: str) -> Person | None:
        """Whose session a secret is of, None if it is of none (any more)."""
        return self._sessions.get(_hash(secret))

    def find(self, number: int) -> Person | None:
        """A person who can make requests, by id."""
        return self._known.get(number)

    @property
    def has_several_pilots(self) -> bool:
        """Whether somebody besides the operator may command vehicles."""
        return sum(person.role >= Role.PILOT for person in self._known.values()) > 1

    def seen(self, person: Person) -> None:
        """Note that somebody's page or program is there."""
        self._seen[person.id] = self._clock()

    def is_here(self, number: int, within_s: float) -> bool:
        """Whether somebody was seen in the last seconds."""
        return self._clock() - self._seen.get(number, float("-inf")) < within_s

    # -- the log ---------------------------------------------------------------------------------------------------

    def note(self, person: Person, deeds: Sequence[Deed], *, edit: bool = False) -> None:
        """Add to the log, without waiting for the disk; `edit`: it is one entry with the same just before it."""
        rows = [
            (packed(person.name), person.role.word, deed.action, *map(packed, (deed.target, deed.outcome, deed.reason)))
            for deed in deeds
        ]
        now = time.time()

        def change(db: sqlite3.Connection) -> None:
            for row in rows:
                if edit and db.execute(_SAME, (now, *row, now - _JOINED_UP_S)).rowcount:
                    continue
                db.execute(_NOTE, (now, *row))

        self._journal.submit(change).add_done_callback(self._noted)

    def _noted(self, future: "Future[None]") -> None:
        if (problem := future.exception()) is not None:
            _log.warning("who did what was not noted: %s", problem)
        self._events.tell("log")

    def log(self, most: int | None = _LATEST) -> list[dict[str, Any]]:
        """The log as JSON values, newest first: `time`, `name`, `role`, `action`, `target`, `outcome`, `reason`."""
        rows = self._journal.rows("SELECT * FROM deeds ORDER BY id DESC LIMIT ?", (-1 if most is None else most,))
        texts = ("name", "target", "outcome", "reason")
        return [
            {key: unpacked(row[key]) if key in texts else row[key] for key in _COLUMNS[1:]}
            | {"time": iso_time(row["time"])}
            for row in rows
        ]

    def table(self) -> str:
        """The whole log as CSV, oldest first."""
        out = io.StringIO(newline="")
        writer = csv.writer(out)
        writer.writerow(_COLUMNS)
        for row in reversed(self.log(None)):
            writer.writerow([spreadsheet_cell(row[key]) for key in _COLUMNS])
        return out.getvalue()


_EVERYBODY: Final = """
SELECT *, CASE WHEN revoked IS NOT NULL THEN 'revoked' WHEN session IS NOT NULL THEN 'joined'
    WHEN made > ? THEN 'invited' ELSE 'expired' END AS state FROM people ORDER BY id
"""
_JOIN: Final = """
UPDATE people SET session = ?, joined = ? WHERE invitation = ? AND session IS NULL AND revoked IS NULL AND made > ?
    RETURNING id
"""
_NOTE: Final = "INSERT INTO deeds (time, name, role, action, target, outcome, reason) VALUES (?, ?, ?, ?, ?, ?, ?)"
_SAME: Final = """
UPDATE deeds SET time = ?, count = count + 1 WHERE id = (SELECT max(id) FROM deeds)
    AND name = ? AND role = ? AND action = ? AND target = ? AND outcome = ? AND reason = ? AND time > ?
"""


def _hash(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).digest()


GONE_S: Final = 20.0
"""A pilot whose page was not heard for so long has nothing any more: page reloads and short losses of the Wi-Fi take
less, and RTL, pause and land are open to everybody meanwhile."""


@dataclass(slots=True)
class _Hold:
    """A vehicle's pilot, and who has asked for it."""

    pilot: Person
    asked: Person | None = None


class Pilots:
    """Who has which vehicle; `people`: knows who is here. `events`: tells pages. `journal`: keeps it over a restart."""

    def __init__(self, people: People, events: Events, journal: Journal) -> None:
        self._people, self._events, self._journal = people, events, journal
        self._lock = threading.Lock()
        self._holds: dict[str, _Hold] = {}
        for vehicle, number in (journal.fact("holds") or {}).items():
            if (pilot := people.find(number)) is not None:
                self._holds[vehicle] = _Hold(pilot)
                people.seen(pilot)  # the page needs some seconds to find the daemon again

    def rows(self) -> list[dict[str, Any]]:
        """Vehicles with a pilot who is here, as JSON: `vehicle`, `pilot` and `asked` ({`id`, `name`} or null)."""
        with self._lock:
            held = {vehicle: self._held(vehicle) for vehicle in sorted(self._holds)}
        return [
            {"vehicle": vehicle, "pilot": _row(hold.pilot), "asked": _row(hold.asked)}
            for vehicle, hold in held.items() if hold is not None
        ]  # fmt: skip

    def claim(self, person: Person, vehicles: Iterable[str], *, whole: bool = False) -> dict[str, str]:
        """Let a pilot have the free ones of some vehicles; returns why not, for each that another has.

        Args:
            person: who commands them. vehicles: their ids. whole: take none if another has one.

        Raises:
            OrthoSwarmError: with `whole`, another pilot has one.
        """
        refused: dict[str, str] = {}
        with self._lock:
            before = dict(self._holds)
            for vehicle in vehicles:
                hold = self._held(vehicle)
                if hold is None:
                    self._holds[vehicle] = _Hold(person)
                elif hold.pilot.id != person.id:
                    refused[vehicle] = (
                        f"{hold.pilot.name} has {vehicle}; ask for it; all pilots may pause, return and land it"
                    )
            if refused and whole:
                self._holds = before
                raise OrthoSwarmError("; ".join(refused.values()))
            changed = before != self._holds
        if changed:
            self._tell()
        return refused

    def change(self, person: Person, vehicle: str, act: str) -> bool:
        """`take` a vehicle, or ask its pilot for it; as its pilot `give` it to who asked, `keep` it, or `free` it.

        Returns:
            Whether the person has the vehicle now.

        Raises:
            InputError: there is no such act.
            OrthoSwarmError: it is not this pilot's, or nobody has asked.
        """
        with self._lock:
            hold = self._held(vehicle)
            if act not in ("take", "give", "keep", "free"):
                raise InputError("there is no such act; send take, give, keep or free")
            if act == "take":
                hold = self._holds[vehicle] = hold or _Hold(person)
                hold.asked = hold.asked if hold.pilot.id == person.id else person
            elif hold is None or hold.pilot.id != person.id:
                raise OrthoSwarmError(f"you do not have {vehicle}; take it first")
            elif act == "keep":
                hold.asked = None
            elif act == "free":
                del self._holds[vehicle]
            elif hold.asked is None or self._people.find(hold.asked.id) is None:
                raise OrthoSwarmError(f"nobody asks for {vehicle} now; free it, and anybody can take it")
            else:
                self._holds[vehicle] = _Hold(hold.asked)
            now = self._held(vehicle)
        self._tell()
        return now is not None and now.pilot.id == person.id

    def _held(self, vehicle: str) -> _Hold | None:
        """The hold of a vehicle whose pilot is here and may still command."""
        hold = self._holds.get(vehicle)
        if hold is None or self._people.find(hold.pilot.id) is None:
            return None
        return hold if self._people.is_here(hold.pilot.id, GONE_S) else None

    def _tell(self) -> None:
        rows = self.rows()
        self._journal.submit(fact_change("holds", {row["vehicle"]: row["pilot"]["id"] for row in rows}))
        self._events.tell("holds", rows=rows)


def _row(person: Person | None) -> dict[str, Any] | None:
    return None if person is None else {"id": person.id, "name": person.name}
