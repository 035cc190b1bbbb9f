"""Folders and files of a vehicle read over MAVLink FTP, as state machines without sockets and clocks.

Each job says what to ask next (`next_request`) and is given each answer once, in any order (`answered`). Numbers of
requests, repetition and pace are those of the caller.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import Final

from gcs_plugin.daemon.store.picture_store import MOST_PICTURE_BYTES
from gcs_plugin.links.file_transfer import MOST_DATA, FtpPayload, Nak, Opcode, file_crc32

_MOST_FILES: Final = 100_000  # of a vehicle's card
_DEPTH: Final = 2  # of folders below the root
_RESET_AFTER: Final = 3  # answers that the server is busy


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
