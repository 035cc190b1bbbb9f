"""Links to vehicles: UDP, TCP and serial, non-blocking, several at once, with many vehicles on one link.

A link delivers bytes with the peer that they came from, and sends bytes to a peer: with UDP a peer is an address, with
TCP a connection, with a serial line there is one. The owner of the selector decides when to read.
"""

import abc
import contextlib
import errno
import os
import re
import selectors
import socket
import sys
from collections.abc import Iterator
from functools import partial
from typing import Any, Final, NamedTuple

from gcs_plugin.links.outgoing import Pending, Stream
from orthoswarm.model.errors import InputError

# A sender: an address, a connection, the other end of a line. Hashable, otherwise opaque.
Peer = Any

NEVER: Final = float("inf")

_DATAGRAM: Final = 65536  # bytes, UDP's most
_AT_ONCE: Final = 2000  # datagrams read in one go
_BUFFER: Final = 4 << 20  # bytes that the system keeps for us
_BACKLOG: Final = 1 << 16  # bytes that a slow receiver may be behind
_RETRY_S: Final = 2.0
_AGAIN: Final = (errno.EAGAIN, errno.EWOULDBLOCK)
EXAMPLES: Final = "udpin:0.0.0.0:14550, udpout:192.168.1.7:14550, tcp:127.0.0.1:5760 or serial:/dev/ttyUSB0:57600"


class Link(abc.ABC):
    """One link, named as the user wrote it.

    Attributes:
        problem: why it does not work at present, empty if it does. dropped: packets that could not be sent.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.problem = ""
        self.dropped = 0

    @abc.abstractmethod
    def open(self, selector: selectors.BaseSelector, now: float) -> None:
        """Open the link; its file objects are registered with `data=self`."""

    @abc.abstractmethod
    def receive(self, source: Any, events: int, now: float) -> Iterator[tuple[Peer, bytes]]:
        """All input on a file object of the link: peer and bytes."""

    @abc.abstractmethod
    def send(self, peer: Peer, data: bytes, expires: float = NEVER) -> bool:
        """Send one packet to a peer, or drop it if that would block; returns False if it was dropped at once.

        One that still waits at `expires` (monotonic seconds) is dropped then.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Close everything."""

    def tick(self, now: float) -> None:
        """Do what is due, such as connecting again; most links need nothing."""
        del now

    def greet(self) -> list[Peer]:
        """Peers that must be spoken to before they answer."""
        return []

    @property
    def polled(self) -> Any:
        """A source that cannot be selected on and must be polled, None if there is none."""
        return None


class UdpLink(Link):
    """A UDP socket: bound, it learns peers from what arrives; aimed at an address, it speaks first."""

    def __init__(self, name: str, host: str, port: int, *, listens: bool) -> None:
        super().__init__(name)
        self._listens = listens
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        try:
            self._target = (socket.gethostbyname(host), port)
            if listens:
                self._socket.bind(self._target)
        except OSError as error:
            self._socket.close()
            raise InputError(f"link {name} cannot be opened ({error.strerror}); is the port in use?") from None

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    def open(self, selector: selectors.BaseSelector, now: float) -> None:
        """Begin."""
        self._selector = selector
        if not self._listens:
            self._socket.bind(("0.0.0.0", 0))
        selector.register(self._socket, selectors.EVENT_READ, self)

    def receive(self, source: Any, events: int, now: float) -> Iterator[tuple[Peer, bytes]]:
        """Datagrams with their senders."""
        receive = self._socket.recvfrom
        for _ in range(_AT_ONCE):
            try:
                data, peer = receive(_DATAGRAM)
            except OSError as error:
                if error.errno in _AGAIN:
                    return
                continue  # the answer to something sent to a port where nobody listens
            yield peer, data

    def send(self, peer: Peer, data: bytes, expires: float = NEVER) -> bool:
        """Send one datagram."""
        try:
            self._socket.sendto(data, peer)
        except OSError:
            self.dropped += 1
            return False
        return True

    def greet(self) -> list[Peer]:
        """The address that it is aimed at."""
        return [] if self._listens else [self._target]

    def close(self) -> None:
        """Close the socket."""
        with contextlib.suppress(KeyError, ValueError, AttributeError):
            self._selector.unregister(self._socket)
        self._socket.close()


class TcpLink(Link):
    """TCP: connects to a server, again after every loss, or serves any number of connections."""

    def __init__(self, name: str, host: str, port: int, *, serves: bool = False) -> None:
        super().__init__(name)
        self._address, self._serves = (host, port), serves
        self._streams: dict[socket.socket, Stream] = {}
        self._server: socket.socket | None = None
        self._retry_at = 0.0
        if serves:
            try:
                self._server = socket.create_server((host, port), reuse_port=False)
            except OSError as error:
                raise InputError(f"link {name} cannot be opened ({error.strerror}); is the port in use?") from None
            self._server.setblocking(False)

    @property
    def port(self) -> int:
        """The local port of a server."""
        return int(self._server.getsockname()[1]) if self._server else 0

    def open(self, selector: selectors.BaseSelector, now: float) -> None:
        """Begin."""
        self._selector = selector
        if self._server is not None:
            selector.register(self._server, selectors.EVENT_READ, self)
        else:
            self._connect(now)

    def tick(self, now: float) -> None:
        """Connect again, and send what is left over."""
        for stream in list(self._streams.values()):
            if stream.connected:
                self._flush(stream, now)
        if self._server is None and not self._streams and now >= self._retry_at:
            self._connect(now)

    def receive(self, source: Any, events: int, now: float) -> Iterator[tuple[Peer, bytes]]:
        """Bytes with the connection that they came on."""
        if self._server is not None and source is self._server:
            with contextlib.suppress(OSError):
                connection, _ = self._server.accept()
                self._add(connection, connected=True)
            return
        stream = self._streams.get(source)
        if stream is None:
            return
        if (events & selectors.EVENT_WRITE or stream.pending) and not self._flush(stream, now):
            return
        if events & selectors.EVENT_READ:
            try:
                data = stream.socket.recv(_DATAGRAM)
            except OSError as error:
                if error.errno not in _AGAIN:
                    self._drop(stream, error.strerror or str(error), now)
                return
            if data:
                yield stream, data
            else:
                self._drop(stream, "the other side closed the connection", now)

    def send(self, peer: Peer, data: bytes, expires: float = NEVER) -> bool:
        """Queue for a connection."""
        if not isinstance(peer, Stream) or peer.socket not in self._streams or len(peer.pending) > _BACKLOG:
            self.dropped += 1
            return False
        peer.pending.put(data, expires)
        if peer.connected:
            return self._flush(peer, self._retry_at)
        return True

    def greet(self) -> list[Peer]:
        """All connections."""
        return [stream for stream in self._streams.values() if stream.connected]

    def close(self) -> None:
        """Close all connections."""
        for stream in list(self._streams.values()):
            self._drop(stream, "closed", 0.0)
        if self._server is not None:
            with contextlib.suppress(KeyError, ValueError, AttributeError):
                self._selector.unregister(self._server)
            self._server.close()

    def _connect(self, now: float) -> None:
        self._retry_at = now + _RETRY_S
        connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        connection.setblocking(False)
        try:
            code = connection.connect_ex(self._address)
        except OSError as error:  # the name does not resolve
            connection.close()
            self.problem = f"{self._address[0]} is not known ({error.strerror})"
            return
        if code not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
            connection.close()
            self.problem = f"no connection ({errno.errorcode.get(code, code)})"
            return
        self._add(connection, connected=False)

    def _add(self, connection: socket.socket, *, connected: bool) -> None:
        self._streams[connection] = Stream(connection, connected)
        wanted = selectors.EVENT_READ if connected else selectors.EVENT_READ | selectors.EVENT_WRITE
        self._selector.register(connection, wanted, self)

    def _flush(self, stream: Stream, now: float) -> bool:
        """Send what is pending; False if the connection is gone."""
        if not stream.connected:
            code = stream.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if code:
                self._drop(stream, f"no connection ({errno.errorcode.get(code, code)})", now)
                return False
            stream.connected, self.problem = True, ""
        try:
            more = stream.flush()
        except OSError as error:
            self._drop(stream, error.strerror or str(error), now)
            return False
        self._selector.modify(stream.socket, selectors.EVENT_READ | (selectors.EVENT_WRITE if more else 0), self)
        return True

    def _drop(self, stream: Stream, why: str, now: float) -> None:
        self._streams.pop(stream.socket, None)
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(stream.socket)
        stream.close()
        self._retry_at = now + _RETRY_S
        if not self._serves:
            self.problem = why


class SerialLink(Link):
    """A serial line or USB port; opened again when the radio is unplugged and comes back."""

    _PEER: Final = "serial"

    def __init__(self, name: str, device: str, baud: int) -> None:
        super().__init__(name)
        self._device, self._baud = device, baud
        self._port: Any = None
        self._pending = Pending()
        self._retry_at = 0.0

    def open(self, selector: selectors.BaseSelector, now: float) -> None:
        """Open the port; a port that is not there yet is tried again later."""
        self._selector = selector
        self._connect(now)

    def tick(self, now: float) -> None:
        """Open the port again, and send what is left over."""
        if self._port is None and now >= self._retry_at:
            self._connect(now)
        elif self._pending:
            self._flush(now)

    def receive(self, source: Any, events: int, now: float) -> Iterator[tuple[Peer, bytes]]:
        """Bytes of the line."""
        if self._port is None:
            return
        try:
            data = self._port.read(max(1, self._port.in_waiting))
        except (OSError, ValueError) as error:  # pyserial's own is an OSError; a ValueError: too many files are open
            self._lose(str(error), now)
            return
        if data:
            yield self._PEER, data

    def send(self, peer: Peer, data: bytes, expires: float = NEVER) -> bool:
        """Queue for the line."""
        if self._port is None or len(self._pending) > _BACKLOG:
            self.dropped += 1
            return False
        self._pending.put(data, expires)
        self._flush(self._retry_at)
        return self._port is not None

    def greet(self) -> list[Peer]:
        """The line itself."""
        return [self._PEER] if self._port is not None else []

    @property
    def polled(self) -> Any:
        """The port, where the system cannot wait for it (Windows)."""
        return self._port if sys.platform == "win32" else None

    def close(self) -> None:
        """Close the port."""
        self._lose("closed", 0.0)

    def _connect(self, now: float) -> None:
        try:
            import serial  # type: ignore[import-untyped,unused-ignore]
        except ImportError:
            raise InputError(f"link {self.name} needs pyserial; install it with: pip install pyserial") from None
        self._retry_at = now + _RETRY_S
        try:
            self._port = serial.Serial(self._device, self._baud, timeout=0, write_timeout=0)
        except (OSError, ValueError) as error:
            self.problem = f"{self._device} cannot be opened ({error})"
            return
        self.problem = ""
        if sys.platform != "win32":
            self._selector.register(self._port.fileno(), selectors.EVENT_READ, self)

    def _flush(self, now: float) -> None:
        import serial

        try:
            if data := self._pending.bytes():
                # Not by the port's own `write`, which tries for ever where the system's buffer is full.
                put = self._port.write if sys.platform == "win32" else partial(os.write, self._port.fileno())
                self._pending.sent(put(data) or 0)
        except serial.SerialTimeoutException:
            return  # its buffer is full: what is left over goes at the next tick
        except OSError as error:
            if error.errno not in _AGAIN:
                self._lose(str(error), now)

    def _lose(self, why: str, now: float) -> None:
        if self._port is None:
            return
        self.problem = why
        with contextlib.suppress(KeyError, ValueError, OSError):
            self._selector.unregister(self._port.fileno())
        with contextlib.suppress(OSError):
            self._port.close()
        self._port, self._retry_at = None, now + _RETRY_S
        self._pending.clear()


_URL = re.compile(
    r"(?:(?P<kind>[a-z]+):(?://)?(?P<host>[^:/]*)|(?P<plain>localhost|\d+\.\d+\.\d+\.\d+)):(?P<port>\d{1,5})/?",
    re.IGNORECASE,
)
# Paths by bus position have colons of their own (/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0).
_SERIAL = re.compile(
    r"(?:serial(?:_flowcontrol)?:(?://)?)?(?P<device>/dev/.+?|(?:\\\\\.\\)?COM\d+)(?:[:,](?P<baud>\d{3,}))?",
    re.IGNORECASE,
)
_KINDS: Final = {"udp": "udpin", "udpin": "udpin", "udpout": "udpout", "tcp": "tcpout", "tcpout": "tcpout",
                 "tcpin": "tcpin"}  # fmt: skip
_BAUD: Final = 57600  # of a serial link, MAVLink's usual


class LinkAddress(NamedTuple):
    """The parsed address of a link: `udpin`, `udpout`, `tcpin`, `tcpout` or `serial`, with its device and baud rate."""

    kind: str
    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.kind}://{self.host}:{self.port}"


def parse_address(text: str) -> LinkAddress:
    """Read a link's address in any usual spelling.

    `udpin:HOST:PORT` (also `udp:`, or the address alone) listens; `udpout:HOST:PORT` speaks first; `tcp:HOST:PORT`
    connects; `tcpin:HOST:PORT` serves; `serial:DEVICE[:BAUD]` or the device alone is a line (57600 baud unless said).
    `//` behind the colon is allowed.

    Raises:
        InputError: not an address of this kind.
    """
    line = _SERIAL.fullmatch(text.strip())
    if line:
        return LinkAddress("serial", line["device"], int(line["baud"] or _BAUD))
    match = _URL.fullmatch(text.strip())
    if not match or int(match["port"]) > 65535:
        raise InputError(f"'{text}' is not a link; write for example {EXAMPLES}")
    kind = _KINDS.get((match["kind"] or "udpin").lower())
    if kind is None:
        raise InputError(f"'{text}' is not a link: '{match['kind']}' is not known; write for example {EXAMPLES}")
    nowhere = "0.0.0.0" if kind.endswith("in") else "127.0.0.1"
    return LinkAddress(kind, match["plain"] or match["host"] or nowhere, int(match["port"]))


def parse_link(text: str) -> Link:
    """Make a link of its address (`parse_address` says which there are).

    Raises:
        InputError: not an address, or the port is taken.
    """
    address = parse_address(text)
    if address.kind == "serial":
        return SerialLink(text, address.host, address.port)
    if address.kind.startswith("udp"):
        return UdpLink(text, address.host, address.port, listens=address.kind == "udpin")
    return TcpLink(text, address.host, address.port, serves=address.kind == "tcpin")
