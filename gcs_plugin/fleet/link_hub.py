"""All links together: packets in with their senders, messages out; signing, log, heartbeats.

A hub knows links, not vehicles: `gcs_plugin.fleet` does. It is polled by one thread.
"""

import contextlib
import queue
import selectors
import socket
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from gcs_plugin.links.mavlink import Message, dialect
from gcs_plugin.links.packets import Framer, Packet
from gcs_plugin.links.signing import Packer, Signing
from gcs_plugin.links.tlog_writer import TlogWriter
from gcs_plugin.links.transports import Link, Peer, parse_link
from gcs_plugin.mission.exchange import NEVER, Address
from orthoswarm.model.errors import InputError

_PEER_S: Final = 30.0
_BEAT_S: Final = 1.0


@dataclass(slots=True, eq=False)
class Side:
    """One link and its state."""

    link: Link
    packer: Packer
    signing: Signing | None
    framers: dict[Peer, Framer] = field(default_factory=dict)
    peers: dict[Peer, float] = field(default_factory=dict)


Sink = Callable[[Side, Peer, Packet, float, float], None]


class Hub:
    """The links (`sides`) of a ground station."""

    def __init__(
        self,
        links: Iterable[Link | str],
        own: Address,
        *,
        key: bytes | None = None,
        tlog: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        """Open the links.

        Args:
            links: links or their addresses.
            key: signing key; with it only signed packets are accepted.
            tlog: telemetry log to append to.
            clock: monotonic seconds. wall: UTC epoch seconds.
        """
        self.own, self._clock, self._wall = own, clock, wall
        opened = _make_links(links)
        self._tlog = TlogWriter(tlog) if tlog else None
        self._beat_at = 0.0
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._selector = selectors.DefaultSelector()
        self._bell, self._ear = socket.socketpair()
        self._bell.setblocking(False)
        self._ear.setblocking(False)
        self._selector.register(self._ear, selectors.EVENT_READ, None)
        self.sides: list[Side] = []
        self._by_link: dict[Link, Side] = {}
        for link in opened:
            signing = Signing(key, link_id=len(self.sides)) if key else None
            side = Side(link, Packer(own.system, own.component, signing), signing)
            self.sides.append(side)
            self._by_link[link] = side
            link.open(self._selector, clock())

    @property
    def rejected(self) -> int:
        """Number of packets rejected for their signature."""
        return sum(side.signing.rejected for side in self.sides if side.signing)

    def close(self) -> None:
        """Close links and log."""
        for side in self.sides:
            side.link.close()
        if self._tlog:
            self._tlog.close()
        self._selector.close()
        self._bell.close()
        self._ear.close()

    def poll(self, timeout_s: float, sink: Sink) -> None:
        """Wait for input until the time-out and pass all of it on; send heartbeats.

        Args:
            sink: called with the link's side, the peer, the packet, the clock's time and UTC seconds of its arrival.
        """
        wait = max(0.0, min(timeout_s, self._beat_at - self._clock()))
        polled = [side for side in self.sides if side.link.polled is not None]
        for key, events in self._selector.select(min(wait, 0.01) if polled else wait):
            if key.data is None:
                with contextlib.suppress(BlockingIOError):
                    self._ear.recv(4096)
                continue
            self._receive(self._by_link[key.data], key.fileobj, events, sink)
        for side in polled:
            self._receive(side, side.link.polled, selectors.EVENT_READ, sink)
        while not self._work.empty():
            self._work.get()()
        now = self._clock()
        if now >= self._beat_at:
            self._beat_at = now + _BEAT_S
            self._beat(now)

    def post(self, work: Callable[[], None]) -> None:
        """Run a function soon in the polling thread; from any thread."""
        self._work.put(work)
        with contextlib.suppress(BlockingIOError):  # full: the polling thread has been woken often enough
            self._bell.send(b"!")

    def send(self, side: Side, peer: Peer, message: Message, expires: float = NEVER) -> bool:
        """Send a message to a peer; one still waiting at `expires` (monotonic seconds) is dropped.

        Returns:
            Whether the link accepted it.
        """
        utc = self._wall()
        raw = side.packer.pack(message, utc)
        accepted = side.link.send(peer, raw, expires)
        if self._tlog is not None:
            self._tlog.write(utc, raw)
        return accepted

    def _receive(self, side: Side, source: Any, events: int, sink: Sink) -> None:
        now, utc = self._clock(), self._wall()
        framers, peers, signing, own = side.framers, side.peers, side.signing, self.own
        for peer, data in side.link.receive(source, events, now):
            framer = framers.get(peer)
            if framer is None:
                framer = framers[peer] = Framer()
                self._greet(side, peer)
            peers[peer] = now
            for packet in framer.feed(data):
                if packet.system == own.system and packet.component == own.component:
                    continue  # our own packets, sent back by a router
                if signing is not None and not signing.accept(packet, utc):
                    continue
                if self._tlog is not None:
                    self._tlog.write(utc, packet.raw)
                sink(side, peer, packet, now, utc)

    def _beat(self, now: float) -> None:
        for side in self.sides:
            side.link.tick(now)
            fresh = [peer for peer, heard in side.peers.items() if now - heard < _PEER_S]
            for peer in {*fresh, *side.link.greet()}:
                self._greet(side, peer)
            if len(side.framers) > 2 * len(fresh) + 64:  # ports that nobody uses any more
                side.framers = {peer: side.framers[peer] for peer in fresh}
                side.peers = {peer: side.peers[peer] for peer in fresh}
        if self._tlog is not None:
            self._tlog.flush()

    def _greet(self, side: Side, peer: Peer) -> None:
        heartbeat = dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
        )
        self.send(side, peer, heartbeat)


def _make_links(links: Iterable[Link | str]) -> list[Link]:
    """Make links from addresses; all are closed again if one is wrong."""
    made: list[Link] = []
    try:
        for link in links:
            made.append(parse_link(link) if isinstance(link, str) else link)
    except InputError:
        for link in made:
            link.close()
        raise
    return made
