"""What is on its way out of a stream of bytes: packets that wait here, and bytes that wait in the system's socket.

Packets can be dropped here, bytes in the system only with the connection. So it is given little, and nothing while the
other side acknowledges nothing. Only Linux says what was acknowledged; elsewhere the system's small buffer must do.
"""

import contextlib
import errno
import socket
import struct
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Final

if sys.platform == "linux":
    import fcntl
    import termios

_HELD_S: Final = 0.5  # without acknowledgement, after which the system is given no more: working connections take less
_STALLED_S: Final = 4.0  # without acknowledgement, after which a connection is reset: a command holds for 5 s
_AT_ONCE: Final = 1 << 12  # bytes given to the system at once: some seventy commands
_HOLDS: Final = 1 << 14  # bytes that the system is to hold, acknowledged or not: 0.1 s of travel at 160 kB/s
# Of every connection, where the system has them: bytes, and milliseconds.
_OPTIONS: Final = {"TCP_NODELAY": 1, "TCP_NOTSENT_LOWAT": _AT_ONCE, "TCP_USER_TIMEOUT": int(1000 * _STALLED_S)}


@dataclass(slots=True)
class Pending:
    """Packets waiting to be sent. An expired one is dropped unless it was partly sent."""

    _packets: deque[tuple[bytes, float]] = field(default_factory=deque)
    _begun: int = 0
    _size: int = 0

    def __len__(self) -> int:
        return self._size

    def put(self, data: bytes, expires: float) -> None:
        """Add a packet."""
        self._packets.append((data, expires))
        self._size += len(data)

    def bytes(self) -> bytes:
        """The bytes to send now."""
        now, begun = time.monotonic(), self._begun
        first = [self._packets[0]] if begun else []
        rest = self._packets if not begun else list(self._packets)[1:]
        self._packets = deque([*first, *(p for p in rest if p[1] >= now)])
        self._size = sum(len(data) for data, _ in self._packets) - begun
        return b"".join(data for data, _ in self._packets)[begun:]

    def sent(self, count: int) -> float:
        """Remove the bytes that were sent; returns when the first of their packets expires (monotonic seconds)."""
        self._size -= count
        count += self._begun
        first = float("inf")
        while count and self._packets:
            data, expires = self._packets[0]
            first = min(first, expires)
            if count < len(data):
                break
            self._packets.popleft()
            count -= len(data)
        self._begun = count
        return first

    def clear(self) -> None:
        """Forget all."""
        self._packets.clear()
        self._begun = self._size = 0


@dataclass(slots=True, eq=False)
class Stream:
    """One TCP connection, its output queue, and what the other side has not acknowledged."""

    socket: socket.socket
    connected: bool
    pending: Pending = field(default_factory=Pending)
    _sent: int = 0  # bytes given to the system; below: where a part ends, when it was given and expires (monotonic s)
    _parts: deque[tuple[int, float, float]] = field(default_factory=deque)

    def __post_init__(self) -> None:
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _HOLDS)
        for name, value in _OPTIONS.items():
            with contextlib.suppress(AttributeError, OSError):
                self.socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def flush(self) -> bool:
        """Give the system what is pending.

        Returns:
            True if it should be given more as soon as it takes more; False while what it has is not acknowledged.

        Raises:
            OSError: the connection is broken, or so old that it must be reset.
        """
        waits = self._waits_s()
        if waits > _STALLED_S:
            raise TimeoutError(errno.ETIMEDOUT, "the other side takes nothing")
        if waits > _HELD_S:
            return False
        if self.pending and (data := self.pending.bytes()):
            with contextlib.suppress(BlockingIOError):
                count = self.socket.send(data[:_AT_ONCE])
                self._sent += count
                self._parts.append((self._sent, time.monotonic(), self.pending.sent(count)))
        return bool(self.pending)

    def close(self) -> None:
        """Close it, and with a reset where bytes would otherwise be delivered later."""
        if self._waits_s() > _HELD_S:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.socket.close()

    def _waits_s(self) -> float:
        """How long the first byte that is not acknowledged has been waiting, for ever if one of them has expired."""
        now, acknowledged = time.monotonic(), self._sent - _unacknowledged(self.socket)
        while self._parts and self._parts[0][0] <= acknowledged:
            self._parts.popleft()
        if any(expires < now for _, _, expires in self._parts):
            return float("inf")
        return now - self._parts[0][1] if self._parts else 0.0


def _unacknowledged(connection: socket.socket) -> int:
    """Bytes that the system holds until they are acknowledged; 0 where it does not say."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # a sandbox need not have it
            return int.from_bytes(fcntl.ioctl(connection, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    return 0
