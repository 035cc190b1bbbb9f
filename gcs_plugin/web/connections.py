"""The listening socket of the web server, how many connections it holds, and how long one may say nothing.

Whoever reaches the port can open connections, without the token and without a request. Each takes one of the process's
open files, of which an ordinary account has 1,024: without limits a thousand idle connections keep pictures, pages and
commands out.
"""

import asyncio
import contextlib
import logging
import socket
import time
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from orthoswarm.model.errors import InputError

_WANTED_FILES: Final = 8192
_USUAL_FILES: Final = 1024  # where the system does not say
_SAY_AGAIN_S: Final = 60.0
REQUEST_S: Final = 10.0
"""Whoever has said nothing for so long after connecting is no client: a slow radio link takes a second or two."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """Limits of connections.

    Attributes:
        most: in all. share: of one client (address); further ones are closed at once.
        waiting: that the system holds until they are accepted; so many may be accepted at once beyond `most`.
        request_s: seconds within which the first request must have come.
    """

    most: int
    share: int
    waiting: int = 2048
    request_s: float = REQUEST_S

    @classmethod
    def of_files(cls, files: int) -> "ConnectionLimits":
        """Half of the process's open files, a quarter for one client: the rest is for pictures, journal and links."""
        return cls(most=files // 2, share=files // 4, waiting=min(2048, files // 4))


def open_files() -> int:
    """How many files the process may have open, after asking the system for more where it has few."""
    try:
        import resource
    except ImportError:  # Windows counts sockets apart
        return _WANTED_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _WANTED_FILES if hard == resource.RLIM_INFINITY else min(_WANTED_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            soft = wanted
    return _WANTED_FILES if soft == resource.RLIM_INFINITY else max(soft, _USUAL_FILES // 4)


class Connections:
    """The open connections by client; `limits`: see ConnectionLimits."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self.limits = limits
        self._open: defaultdict[str, set[asyncio.Transport]] = defaultdict(set)
        self._said = -_SAY_AGAIN_S

    def admit(self, transport: asyncio.Transport) -> bool:
        """Count a new connection; False if it is one too many."""
        client = _client(transport)
        mine = self._still_open(client)
        if len(mine) >= self.limits.share or self._count() >= self.limits.most:
            self._say(client)
            return False
        self._open[client].add(transport)
        return True

    def _still_open(self, client: str) -> set[asyncio.Transport]:
        found = {transport for transport in self._open.pop(client, ()) if not transport.is_closing()}
        if found:
            self._open[client] = found
        return found

    def _count(self) -> int:
        count = sum(map(len, self._open.values()))
        if count >= self.limits.most:  # some may be closed by now
            count = sum(len(self._still_open(client)) for client in list(self._open))
        return count

    def _say(self, client: str) -> None:
        now = time.monotonic()
        if now - self._said >= _SAY_AGAIN_S:
            self._said = now
            _log.warning("too many connections, the last one from %s: further ones are closed", client)


def _client(transport: asyncio.Transport) -> str:
    peer = transport.get_extra_info("peername")
    return str(peer[0]) if peer else ""


def bounded_protocol(connections: Connections) -> type[H11Protocol]:
    """Uvicorn's protocol of a connection, within limits."""

    class Bounded(H11Protocol):  # type: ignore[misc]
        """One connection."""

        def connection_made(self, transport: Any) -> None:
            """Serve the connection, or close it at once."""
            super().connection_made(transport)
            if connections.admit(transport):
                self.loop.call_later(connections.limits.request_s, self._require_request)
            else:
                transport.abort()

        def _require_request(self) -> None:
            # an event stream has a protocol of its own by now
            if self.cycle is None and self.transport.get_protocol() is self:
                self.transport.abort()

    return Bounded


class Server(uvicorn.Server):  # type: ignore[misc]
    """Uvicorn's server, whose connections have as little time for their handshake as for their first request."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to serve."""
        if self.config.ssl is not None:
            loop: Any = asyncio.get_running_loop()
            loop.create_server = partial(loop.create_server, ssl_handshake_timeout=REQUEST_S)
        await super().startup(sockets)


def open_listener(address: str, port: int) -> socket.socket:
    """A bound TCP socket without Nagle's algorithm on its connections.

    The protocol is stated because asyncio sets TCP_NODELAY only on sockets with IPPROTO_TCP. With Nagle's algorithm an
    answer on a persistent connection waits for the client's delayed acknowledgement, 40 ms on Linux.

    Args:
        address: IPv4 or IPv6 address, or a host name. port: 0 for any free one.

    Raises:
        InputError: it cannot be bound.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((address, port))
    except (OSError, UnicodeError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{address}:{port} cannot be served ({reason}); choose another --port or --bind") from None
    return listener
