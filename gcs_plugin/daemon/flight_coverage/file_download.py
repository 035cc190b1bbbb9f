"""Folders and files of a vehicle read over MAVLink FTP, as state machines without sockets and clocks.

Each job says what to ask next (`next_request`) and is given each answer once, in any order (`answered`). Numbers of
requests, repetition and pace are those of an `FtpTalk`: one job at a time with one vehicle, in the links' thread.

The pace follows the delay, as in LEDBAT (RFC 6817), so that a link's other messages are not held up: answers that take
longer than the quickest lately have waited behind others, so the rate falls; it rises slowly otherwise, up to a bound.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from gcs_plugin.daemon.store.picture_store import MOST_PICTURE_BYTES
from gcs_plugin.links.file_transfer import FRAME_BYTES, MOST_DATA, FtpPayload, Nak, Opcode, file_crc32
from gcs_plugin.links.mavlink import Message

_MOST_FILES: Final = 100_000  # of a vehicle's card
_DEPTH: Final = 2  # of folders below the root
_RESET_AFTER: Final = 3  # answers that the server is busy
_AT_ONCE: Final = 4
"""ArduPilot's server holds five requests."""
_PATIENCE: Final = 4.0  # times the quickest answer
_LEAST_PATIENCE_S, _MOST_PATIENCE_S = 0.5, 4.0
_SILENT_S: Final = 12.0
_BUSY_S: Final = 5.0
_LEAST_BYTES_S: Final = 600.0
"""Two packets a second."""
_TARGET_S: Final = 0.1
_MEMORY_S: Final = 30.0
_UP, _DOWN, _LOST = 1.04, 0.75, 0.9


class FtpJob:
    """What several jobs have in common.

    Attributes:
        done: it has ended. refused: why it failed, empty if it did not. busy: times that the vehicle had no session
            left; the caller waits after each.
    """

    def __init__(self) -> None:
        self.done, self.refused, self.busy = False, "", 0

    def next_request(self) -> FtpPayload | None:
        """The next request, without its number; None while answers must come first."""
        raise NotImplementedError

    def answered(self, request: FtpPayload, answer: FtpPayload) -> None:
        """Process the answer to a request."""
        raise NotImplementedError

    def forget_asked(self) -> None:
        """Requests without an answer are given up: ask for the same again later."""
        raise NotImplementedError

    def _refuse(self, reason: str) -> None:
        self.done, self.refused = True, reason


class FolderList(FtpJob):
    """Lists the files below a folder.

    Args:
        folder: its path on the vehicle; subfolders are listed, too, down to two levels.

    Attributes:
        files: path -> bytes.
    """

    def __init__(self, folder: str) -> None:
        super().__init__()
        self.files: dict[str, int] = {}
        self._folders = deque([(folder.rstrip("/") or "/", 0)])
        self._entries, self._asked = 0, False

    def next_request(self) -> FtpPayload | None:
        """The next part of the present folder."""
        if self._asked or self.done:
            return None
        self._asked = True
        return FtpPayload(
            number=0, opcode=Opcode.LIST_DIRECTORY, offset=self._entries, data=self._folders[0][0].encode()[:MOST_DATA]
        )

    def forget_asked(self) -> None:
        """Ask for the same part again."""
        self._asked = False

    def answered(self, request: FtpPayload, answer: FtpPayload) -> None:
        r"""Add entries: `F<name>\t<bytes>`, `D<name>`, or `S` for one that is skipped, each ended by a zero."""
        self._asked = False
        if answer.opcode != Opcode.ACK:
            if answer.nak == Nak.UNKNOWN_COMMAND:
                self._refuse("it does not serve files")
            elif answer.nak == Nak.END_OF_FILE or self.files or len(self._folders) > 1:
                self._next_folder()
            else:
                self._refuse(f"it has no folder {self._folders[0][0]}")
            return
        folder, depth = self._folders[0]
        entries = [entry.decode("utf-8", "replace") for entry in answer.data.rstrip(b"\0").split(b"\0") if entry]
        self._entries += len(entries)
        for entry in entries:
            name, _, size = entry[1:].partition("\t")
            path = f"{folder.rstrip('/')}/{name}"
            if entry[0] == "F" and size.isdigit():
                self.files[path] = int(size)
            elif entry[0] == "D" and name not in (".", "..") and depth < _DEPTH:
                self._folders.append((path, depth + 1))
        if not entries or len(self.files) > _MOST_FILES:
            self._next_folder()

    def _next_folder(self) -> None:
        self._folders.popleft()
        self._entries = 0
        self.done = not self._folders


@dataclass(slots=True)
class _Parts:
    """The content of a file as far as it has come; `missing`: offset -> bytes; `to_ask`: offsets to be asked for."""

    content: bytearray
    missing: dict[int, int]
    to_ask: deque[int]

    @staticmethod
    def of_size(size: int) -> "_Parts":
        missing = {offset: min(MOST_DATA, size - offset) for offset in range(0, size, MOST_DATA)}
        return _Parts(bytearray(size), missing, deque(missing))

    def put(self, offset: int, data: bytes) -> None:
        """Add what was read; if it is less than was asked for, the rest is missing still."""
        size = self.missing.pop(offset)
        data = data[:size]
        self.content[offset : offset + len(data)] = data
        if len(data) < size:
            self.missing[offset + len(data)] = size - len(data)
            self.to_ask.append(offset + len(data))


class FileRead(FtpJob):
    """Reads a file. What has come stays when the session is lost, and the rest is read in the next one."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self.path = path
        self._parts: _Parts | None = None
        self._session: int | None = None
        self._step = Opcode.OPEN_FILE_RO
        self._asked = False
        self._again = False

    @property
    def content(self) -> bytes:
        """What was read."""
        return b"" if self._parts is None else bytes(self._parts.content)

    @property
    def share(self) -> float:
        """How much of it has come, 0 to 1."""
        if self._parts is None:
            return 0.0
        return 1.0 - sum(self._parts.missing.values()) / len(self._parts.content)

    def next_request(self) -> FtpPayload | None:
        """Open, read (several at a time), compare the checksum, close."""
        if self.done:
            return None
        if self._step is Opcode.READ_FILE:
            assert self._parts is not None and self._session is not None
            if not self._parts.to_ask:
                return None
            offset = self._parts.to_ask.popleft()
            size = self._parts.missing[offset]
            return FtpPayload(number=0, opcode=self._step, session=self._session, offset=offset, size=size)
        if self._asked:
            return None
        self._asked = True
        named = self._step in (Opcode.OPEN_FILE_RO, Opcode.CALC_FILE_CRC32)
        data = self.path.encode()[:MOST_DATA] if named else b""
        return FtpPayload(number=0, opcode=self._step, session=self._session or 0, data=data)

    def forget_asked(self) -> None:
        """Ask again for what has not come; a session that has ended meanwhile is noticed by the first answer."""
        self._asked = False
        if self._parts is not None:
            self._parts.to_ask = deque(sorted(self._parts.missing))

    def answered(self, request: FtpPayload, answer: FtpPayload) -> None:
        """Process an answer."""
        if request.opcode == Opcode.READ_FILE:
            self._read(request, answer)
            return
        if request.opcode != self._step:
            return
        self._asked = False
        accepted = answer.opcode == Opcode.ACK
        if request.opcode == Opcode.OPEN_FILE_RO:
            self._opened(answer)
        elif request.opcode == Opcode.RESET_SESSIONS:
            self._step = Opcode.OPEN_FILE_RO
        elif request.opcode == Opcode.CALC_FILE_CRC32:
            self._compare(answer.data if accepted else b"")
        elif self._parts is None:  # its checksum was wrong
            self._step, self._session = Opcode.OPEN_FILE_RO, None
        else:
            self.done = True

    def _opened(self, answer: FtpPayload) -> None:
        if answer.opcode != Opcode.ACK:
            if answer.nak == Nak.NO_SESSIONS:  # another station's, or ours whose answer was lost
                self.busy += 1
                self._step = Opcode.RESET_SESSIONS if self.busy % _RESET_AFTER == 0 else Opcode.OPEN_FILE_RO
            else:
                self._refuse("it does not serve files" if answer.nak == Nak.UNKNOWN_COMMAND else "the file is gone")
            return
        size = int.from_bytes(answer.data[:4], "little")
        if not 0 < size <= MOST_PICTURE_BYTES:
            self._refuse(f"the file has {size} bytes")
            return
        self._session, self.busy = answer.session, 0
        if self._parts is None or len(self._parts.content) != size:
            self._parts = _Parts.of_size(size)
        self._parts.to_ask = deque(sorted(self._parts.missing))
        self._step = Opcode.READ_FILE if self._parts.missing else Opcode.CALC_FILE_CRC32

    def _read(self, request: FtpPayload, answer: FtpPayload) -> None:
        parts = self._parts
        if self._step is not Opcode.READ_FILE or parts is None:
            return
        if answer.opcode != Opcode.ACK and answer.nak == Nak.INVALID_SESSION:  # the vehicle was restarted
            if request.session == self._session:
                self._step, self._session = Opcode.OPEN_FILE_RO, None
        elif answer.opcode != Opcode.ACK or not answer.data:
            self._refuse("the file cannot be read")
        elif request.offset in parts.missing:
            parts.put(request.offset, answer.data)
            if not parts.missing:
                self._step = Opcode.CALC_FILE_CRC32

    def _compare(self, checksum: bytes) -> None:
        """Compare with the vehicle's checksum, if it has one, and close the file."""
        self._step = Opcode.TERMINATE_SESSION
        if len(checksum) >= 4 and int.from_bytes(checksum[:4], "little") != file_crc32(self.content):
            if self._again:
                self._refuse("its checksum is not that of the file")
            self._again, self._parts = True, None


def numbered(payload: FtpPayload, number: int) -> FtpPayload:
    """A request with its number."""
    return replace(payload, number=number)


class LinkShare:
    """A rate that follows the delay; `most_bytes_s`: upper bound, bytes a second; `rate`: bytes a second."""

    def __init__(self, most_bytes_s: float) -> None:
        self.most, self.rate = most_bytes_s, min(most_bytes_s, 3.0 * _LEAST_BYTES_S)
        self._times: deque[tuple[float, float]] = deque()
        self._room, self._at = 0.0, 0.0
        self._fell_at = 0.0

    def allows(self, size: int, now: float) -> bool:
        """Whether a packet of so many bytes may be asked for now; it counts as asked for if so."""
        burst = max(float(size), 0.1 * self.rate)
        self._room = min(burst, self._room + self.rate * max(0.0, now - self._at))
        self._at = now
        if self._room < size:
            return False
        self._room -= size
        return True

    @property
    def quickest_s(self) -> float:
        """The shortest answer of the last half minute, seconds; a second while none is known."""
        return min((took for _, took in self._times), default=1.0)

    def answered(self, took_s: float, now: float) -> None:
        """An answer has come after so many seconds."""
        while self._times and self._times[0][0] < now - _MEMORY_S:
            self._times.popleft()
        self._times.append((now, took_s))
        if took_s > self.quickest_s + _TARGET_S:
            self._fall(_DOWN, now)
        else:
            self.rate = min(self.most, self.rate * _UP)

    def lost(self, now: float) -> None:
        """An answer has not come."""
        self._fall(_LOST, now)

    def _fall(self, share: float, now: float) -> None:
        if now - self._fell_at >= self.quickest_s + _TARGET_S:  # once for each round of answers
            self._fell_at = now
            self.rate = max(min(_LEAST_BYTES_S, self.most), self.rate * share)


@dataclass(slots=True)
class _Asked:
    payload: FtpPayload
    at: float
    tries: int = 1


@dataclass(slots=True, kw_only=True)
class FtpTalk:
    """A job under way.

    Attributes:
        job: what is done. system, component: with whom. share: the pace. send: sends messages to a system.
        silent: True once the vehicle has not answered for long; what it has sent stays with the job.
    """

    job: FtpJob
    system: int
    component: int
    share: LinkShare
    send: Callable[[int, list[Message]], None]
    began: float
    silent: bool = False
    _number: int = 0
    _asked: dict[int, _Asked] = field(default_factory=dict)
    _heard: float = field(init=False)
    _rest_until: float = 0.0

    def __post_init__(self) -> None:
        """Nothing is heard yet."""
        self._heard = self.began
        self.job.forget_asked()

    @property
    def over(self) -> bool:
        """True once nothing more is to be done."""
        return self.job.done or self.silent

    def answer(self, answer: FtpPayload, now: float) -> None:
        """Process a packet of the vehicle."""
        asked = self._asked.pop((answer.number - 1) & 0xFFFF, None)
        if asked is None:
            return
        self._heard = now
        if asked.tries == 1:
            self.share.answered(now - asked.at, now)
        busy = self.job.busy
        self.job.answered(asked.payload, answer)
        if self.job.busy > busy:
            self._rest_until = now + _BUSY_S

    def step(self, now: float) -> None:
        """Ask for more, and again for what has not come."""
        if self.over or now < self._rest_until:
            return
        if self._asked and now - max(self._heard, self.began) > _SILENT_S:
            self.silent = True
            return
        patience = min(_MOST_PATIENCE_S, max(_LEAST_PATIENCE_S, _PATIENCE * self.share.quickest_s))
        for asked in list(self._asked.values()):
            if now - asked.at > patience and self.share.allows(FRAME_BYTES, now):
                asked.at, asked.tries = now, asked.tries + 1
                self.share.lost(now)
                self._put(asked.payload)
        while len(self._asked) < _AT_ONCE:
            request = self.job.next_request() if self.share.allows(FRAME_BYTES, now) else None
            if request is None:
                return
            self._number = (self._number + 1) & 0xFFFF
            request = numbered(request, self._number)
            self._asked[self._number] = _Asked(request, now)
            self._put(request)

    def pause(self, seconds: float) -> None:
        """Time in which nothing was asked does not count as silence."""
        self._heard += seconds
        for asked in self._asked.values():
            asked.at += seconds

    def _put(self, request: FtpPayload) -> None:
        self.send(self.system, [request.message(self.system, self.component)])
