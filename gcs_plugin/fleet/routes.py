"""The routes to one vehicle: the best one carries commands, another takes over when it falls silent.

One vehicle on two links (radio and LTE) is normal. Two vehicles with one system id are not: their own clocks, which
start at their boots, distinguish them.
"""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from gcs_plugin.config import HEARING

if TYPE_CHECKING:
    from gcs_plugin.fleet.link_hub import Side
    from gcs_plugin.links.transports import Peer

_KNOWN_S: Final = 30.0
_VERDICT_S: Final = 10.0
_BOOT_GAP_S: Final = 3.0
_BETTER: Final = 0.2  # share of lost packets by which another route must be better
_SMOOTHING: Final = 0.02  # weight of the newest packet in that share
_CLOCK_S: Final = 1.5
_ASK_CLOCK_S: Final = 3.0
_PACE_S: Final = 2.0


@dataclass(slots=True)
class BootClock:
    """Watches a vehicle's own clock, which only goes back at a restart (or with a second vehicle of the same id)."""

    last_s: float = -1.0
    _low: int = 0
    _returns: float = 0.0
    _restarted: float = -1e9

    def feed(self, time_boot_s: float, now: float) -> str:
        """Process a time since boot; returns "", "rebooted", or "mixed" if two clocks alternate.

        Single packets from the past are late copies: a restart shows in three in a row.
        """
        if time_boot_s >= self.last_s - 1.5:
            self._returns = 0.98 * self._returns + (1.0 if self._low else 0.0)
            self._low, self.last_s = 0, max(self.last_s, time_boot_s)
            return "mixed" if self._returns > 5.0 else ""
        self._low += 1
        if self._low < 3:
            return ""
        again, self._restarted = now - self._restarted < 10.0, now
        self._low, self.last_s = 0, time_boot_s
        return "mixed" if again else "rebooted"


@dataclass(slots=True)
class LongText:
    """A text that an autopilot sends in several messages.

    Attributes:
        number: that its parts have in common, 0 for a text in one message.
        begun: when the first part came (the fleet's clock). told: it was passed on.
    """

    number: int
    severity: int
    begun: float
    parts: dict[int, str] = field(default_factory=dict)
    told: bool = False

    @property
    def joined(self) -> str:
        """The text, with a mark for what was lost."""
        return "".join(self.parts.get(k, "...") for k in range(max(self.parts, default=-1) + 1))


@dataclass(slots=True, kw_only=True)
class Route:
    """A route on which a vehicle is heard: a sender on a link.

    Attributes:
        heard: time of the last packet (the fleet's clock).
        loss: share of packets lost recently, from the sender's counter.
        boot: the vehicle's start on that clock, from its own counter; None before the first position.
        boot_at: when that was computed; asked_at: when its clock was asked for.
        text: the autopilot's last text on it.
    """

    side: "Side"
    peer: "Peer"
    heard: float
    loss: float = 0.0
    boot: float | None = None
    boot_at: float = 0.0
    asked_at: float = 0.0
    clock: BootClock = field(default_factory=BootClock)
    text: LongText | None = None
    _mark: tuple[float, float] | None = None

    def pace(self, time_boot_s: float, now: float) -> float | None:
        """Seconds of the vehicle's clock in one of ours over the last few; None while unknown."""
        if self._mark is None or time_boot_s < self._mark[1] or now - self._mark[0] > 2.0 * _PACE_S:
            self._mark = now, time_boot_s
            return None
        seconds = now - self._mark[0]
        if seconds < _PACE_S:
            return None
        pace = (time_boot_s - self._mark[1]) / seconds
        self._mark = now, time_boot_s
        return pace

    @property
    def address(self) -> str:
        """The link and, if it has several senders, the peer."""
        name = self.side.link.name
        if isinstance(self.peer, tuple) and len(self.peer) >= 2:
            return f"{name} from {self.peer[0]}:{self.peer[1]}"
        return f"{name} number {self.peer}" if isinstance(self.peer, int) else name

    @property
    def damaged(self) -> int:
        """Number of packets with a wrong checksum from this sender, whichever vehicle behind it they are of."""
        framer = self.side.framers.get(self.peer)
        return 0 if framer is None else framer.bad_checksums

    def counted(self, lost: int) -> None:
        """Count a packet and the number lost before it."""
        for _ in range(min(lost, 20)):
            self.loss += _SMOOTHING * (1.0 - self.loss)
        self.loss -= _SMOOTHING * self.loss


@dataclass(slots=True)
class Routes:
    """All routes to one vehicle, by link and peer.

    Attributes:
        best: the one that carries commands, None before the first packet.
        claimants: addresses of the vehicles that share the system id; empty for a single one.
    """

    known: "dict[tuple[Side, Peer], Route]" = field(default_factory=dict)
    best: Route | None = None
    claimants: tuple[str, ...] = ()
    _claimed_until: float = -1.0

    def heard(self, side: "Side", peer: "Peer", now: float) -> tuple[Route, bool]:
        """The route of a packet, and whether the best route has changed with it."""
        route = self.known.get((side, peer))
        if route is None:
            route = self.known[side, peer] = Route(side=side, peer=peer, heard=now, clock=self._clock(now))
        route.heard = now
        best = self.best
        if best is None or (best is not route and now - best.heard > HEARING.fresh_s):
            self.best = route
            return route, best is not None
        return route, False

    def _clock(self, now: float) -> BootClock:
        """The watch over a new route's clock.

        A vehicle that restarts closes its TCP connection and comes back on another: where no other route is heard, the
        watch goes on, so that the clock that has gone back is noticed.
        """
        best = self.best
        return BootClock() if best is None or now - best.heard < HEARING.fresh_s else replace(best.clock)

    def stale(self, route: Route, now: float) -> bool:
        """True for a route that is not the active one: its state of the vehicle may be late."""
        return route is not self.best and self.best is not None and now - self.best.heard < 1.0

    def fresh(self, now: float, within_s: float = HEARING.fresh_s) -> list[Route]:
        """The routes with recent packets."""
        return [route for route in self.known.values() if now - route.heard < within_s]

    def towards(self, now: float, *, everywhere: bool) -> list[Route]:
        """Routes for sending: the best one, or every one on which the vehicle was heard recently."""
        if self.best is None:
            return []
        if not everywhere:
            return [self.best]
        return self.fresh(now, _KNOWN_S) or [self.best]

    def mixed(self, now: float) -> None:
        """Two clocks alternate on one route: several vehicles behind one link."""
        self._claimed_until = now + _VERDICT_S

    def compare(self, now: float) -> bool:
        """Check whether one or several vehicles send, and which route is best; True if the best route has changed."""
        fresh = self.fresh(now)
        boots = [route.boot for route in fresh if route.boot is not None and now - route.boot_at < _CLOCK_S]
        if boots and max(boots) - min(boots) > _BOOT_GAP_S:
            self._claimed_until = now + _VERDICT_S
        several = now < self._claimed_until
        self.claimants = tuple(sorted({*self.claimants, *(r.address for r in fresh)})) if several else ()
        best = self.best
        if several or best is None or len(fresh) < 2:
            return False
        better = min(fresh, key=lambda route: route.loss)
        if better is best or better.loss > best.loss - _BETTER:
            return False
        self.best = better
        return True

    def unasked(self, now: float) -> list[Route]:
        """Routes besides the best whose clock should be requested."""
        routes = [
            route
            for route in self.fresh(now)
            if route is not self.best and now - route.boot_at > _CLOCK_S and now - route.asked_at > _ASK_CLOCK_S
        ]
        for route in routes:
            route.asked_at = now
        return routes
