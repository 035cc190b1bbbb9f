"""The files of a simulated vehicle, served over MAVLink FTP as PX4 does.

There is one session, and a repeated request (one with the number of the last) gets the last answer again.
"""

from dataclasses import dataclass, field

from gcs_plugin.links.file_transfer import MOST_DATA, FtpPayload, Nak, Opcode, file_crc32, payload_of
from gcs_plugin.sim.simulated_vehicle import SimVehicle


@dataclass(slots=True, kw_only=True)
class FileServer:
    """Answers requests for files: path (`/DCIM/IMG_0001.JPG`) -> content.

    `has_crc` is False for a server without CALC_FILE_CRC32; `served` counts the bytes sent.
    """

    files: dict[str, bytes] = field(default_factory=dict)
    has_crc: bool = True
    served: int = 0
    _open: str | None = None
    _session: int = 0
    _last: FtpPayload | None = None

    def rebooted(self) -> None:
        """Forget the session."""
        self._open = self._last = None

    def answer(self, request: FtpPayload) -> FtpPayload:
        """The answer to a request."""
        number = (request.number + 1) & 0xFFFF
        if self._last is None or (self._last.number, self._last.request) != (number, request.opcode):
            self._last = self._made(request, number)
        return self._last

    def _made(self, request: FtpPayload, number: int) -> FtpPayload:
        data: bytes | Nak
        match request.opcode:
            case Opcode.LIST_DIRECTORY:
                data = self._listing(_text(request.data), request.offset)
            case Opcode.OPEN_FILE_RO:
                data = self._opened(_text(request.data))
            case Opcode.READ_FILE:
                data = self._read(request)
            case Opcode.CALC_FILE_CRC32 if self.has_crc:
                content = self.files.get(_text(request.data))
                data = Nak.FILE_NOT_FOUND if content is None else file_crc32(content).to_bytes(4, "little")
            case Opcode.TERMINATE_SESSION | Opcode.RESET_SESSIONS:
                self._open, data = None, b""
            case _:
                data = Nak.UNKNOWN_COMMAND
        refused = isinstance(data, Nak)
        return FtpPayload(
            number=number, opcode=Opcode.NAK if refused else Opcode.ACK,
            session=self._session, request=request.opcode, offset=request.offset,
            data=bytes([data]) if isinstance(data, Nak) else data,
        )  # fmt: skip

    def _listing(self, folder: str, first: int) -> bytes | Nak:
        """Entries from a number on, as many as fit; END_OF_FILE behind the last."""
        prefix = folder.rstrip("/") + "/"
        entries: dict[str, bytes] = {}
        for path, content in sorted(self.files.items()):
            if path.startswith(prefix):
                name, _, rest = path[len(prefix) :].partition("/")
                entries[name] = f"D{name}\0".encode() if rest else f"F{name}\t{len(content)}\0".encode()
        if not entries:
            return Nak.FILE_NOT_FOUND
        found = b""
        for entry in list(entries.values())[first:]:
            if len(found) + len(entry) > MOST_DATA:
                break
            found += entry
        return found or Nak.END_OF_FILE

    def _opened(self, path: str) -> bytes | Nak:
        if path not in self.files:
            return Nak.FILE_NOT_FOUND
        if self._open is not None:
            return Nak.NO_SESSIONS
        self._open, self._session = path, self._session % 200 + 1
        return len(self.files[path]).to_bytes(4, "little")

    def _read(self, request: FtpPayload) -> bytes | Nak:
        if self._open is None or request.session != self._session:
            return Nak.INVALID_SESSION
        data = self.files[self._open][request.offset : request.offset + min(request.size, MOST_DATA)]
        self.served += len(data)
        return data or Nak.END_OF_FILE


class CardVehicle(SimVehicle):
    """A simulated vehicle that serves its files; None for one without a server."""

    def __init__(self, files, **options):
        super().__init__(**options)
        self.files = files

    def handle(self, message, sender, now):
        """Answer requests for files, too."""
        answers = super().handle(message, sender, now)
        served = self.files is not None and not self.off and message.get_type() == "FILE_TRANSFER_PROTOCOL"
        if not served or message.target_system not in (0, self.system) or (request := payload_of(message)) is None:
            return answers
        return [self.files.answer(request).message(sender.system, sender.component)]

    def reboot(self, now, silence_s=3.0):
        """Restart, the server too."""
        super().reboot(now, silence_s)
        if self.files is not None:
            self.files.rebooted()


def _text(data: bytes) -> str:
    return data.rstrip(b"\0").decode("utf-8", "replace")
