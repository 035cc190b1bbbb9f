"""The clocks of a vehicle's components: `time_boot_ms` counts from the boot of the component that sends it.

A gimbal, a camera or a companion computer shares the autopilot's system id but not its clock. Their times are
converted to the autopilot's, the only clock that can be tied to UTC, by when their messages arrive between those of
the autopilot. Messages on pictures may be old, since lost ones are sent again on request: they can only be late, so the
shortest delay tells the clock. Source: MAVLink common, `time_boot_ms`; MAV_COMPONENT; camera protocol.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Final

AUTOPILOT: Final = 1  # MAV_COMP_ID_AUTOPILOT1. Component 0, of messages that came over no link, counts as it.

_ANY, _ID_ONLY, _POSITIONED, _FLIES, _BY_ID = range(1, 6)
"""What makes a component the autopilot, from weak to strong: nothing better was heard; its id is an autopilot's; it
reports the vehicle's position; its HEARTBEAT is an autopilot's; its id is, and one of the two."""
_REBOOT_S = 10.0
_SAME_CLOCK_S = 0.25
"""A component whose clock differs by less keeps the autopilot's: arrivals of a radio link tell no better."""
_CLOCK_STEP_S = 2.0
"""A change of the difference beyond this is a restart of the component, or one message that came late."""
_SMOOTHED = 50  # messages over which the difference is averaged: quartz clocks drift by milliseconds in that time
_REMEMBERED = 1000  # pictures whose numbers and times are remembered, to tell old ones from those of a restarted camera


@dataclass(slots=True)
class _Difference:
    """The autopilot's clock minus another component's, in seconds, and the number of messages it was averaged over."""

    seconds: float
    count: int = 1
    doubted: float | None = None

    def take(self, seconds: float) -> bool:
        """Average in what another message says; a step counts once a second message confirms it, which is returned."""
        step = seconds - self.seconds
        if abs(step) < _CLOCK_STEP_S:
            self.count = min(self.count + 1, _SMOOTHED)
            self.seconds += step / self.count
            self.doubted = None
        elif self.doubted is not None and abs(seconds - self.doubted) < _CLOCK_STEP_S / 2:
            self.seconds, self.count, self.doubted = seconds, 1, None
            return True
        else:
            self.doubted = seconds
        return False


@dataclass(slots=True)
class _Pictures:
    """What a component's messages on pictures tell of its clock; some are old."""

    _boot_s: dict[int, float] = field(default_factory=dict)
    _latest_s: float = 0.0
    _recent: deque[float] = field(default_factory=lambda: deque(maxlen=_SMOOTHED))

    @property
    def seconds(self) -> float:
        """The autopilot's clock minus the component's: the smallest difference at an arrival."""
        return min(self._recent)

    def take(self, number: int, boot_s: float, difference_s: float) -> bool:
        """Take in a message; returns whether the component was restarted before it."""
        restarted = boot_s < self._latest_s - _CLOCK_STEP_S and not self._is_old(number, boot_s)
        if restarted:
            self._boot_s.clear()
            self._recent.clear()
            self._latest_s = 0.0
        if boot_s >= self._latest_s or difference_s < self.seconds:  # a burst of old ones leaves those that tell
            self._recent.append(difference_s)
        self._latest_s = max(self._latest_s, boot_s)
        self._boot_s[number] = boot_s
        if len(self._boot_s) > _REMEMBERED:
            del self._boot_s[next(iter(self._boot_s))]
        return restarted

    def _is_old(self, number: int, boot_s: float) -> bool:
        """Whether a picture belongs among those that are known: numbers and times grow together."""
        known = self._boot_s.get(number)
        if known is not None:
            return abs(known - boot_s) < _SAME_CLOCK_S
        return all((boot_s < other_s) == (number < other) for other, other_s in self._boot_s.items())


@dataclass(slots=True, kw_only=True)
class SenderClocks:
    """Converts the times since boot of all components of a vehicle to its autopilot's."""

    boot_s: float = 0.0  # the autopilot's latest time since boot
    utc_minus_boot_s: float | None = None  # UTC less that, None while unknown
    reboots: int = 0  # number of times that it went back
    # number of times that times since boot began to count from another moment: at a reboot, and where the autopilot
    # turned out to be another component than was thought
    bases: int = 0
    _autopilot: int = field(default=0, repr=False)
    _rank: int = field(default=0, repr=False)
    _heard: bool = field(default=False, repr=False)
    _arrival_s: float | None = field(default=None, repr=False)
    # components whose HEARTBEAT is an autopilot's. One is chosen once it sends more than that
    fliers: set[int] = field(default_factory=set, repr=False)
    _positioned: list[int] = field(default_factory=list, repr=False)
    _others: dict[int, _Difference] = field(default_factory=dict, repr=False)
    _pictures: dict[tuple[int, str], _Pictures] = field(default_factory=dict, repr=False)

    def is_autopilot(self, component: int, *, timed: bool, positions: bool = False) -> bool:
        """Whether a component is the autopilot, as far as the messages up to now tell.

        Args:
            component: MAVLink component id of a sender. positions: it reports a valid position of the vehicle.
            timed: the message is one of those by which autopilots tell their time since boot.
        """
        if positions and component not in self._positioned:
            self._positioned.append(component)
        rank = self._rank_of(component, timed)
        if rank > self._rank:
            self._rank = rank
            if component != self._autopilot:
                if self._heard:
                    self._begin()
                self._autopilot, self._heard, self.boot_s = component, False, 0.0
        return component == self._autopilot

    def _rank_of(self, component: int, timed: bool) -> int:
        """The rank of a component that sends such a message; 0 if it cannot be the autopilot."""
        flies, positioned = component in self.fliers, component in self._positioned
        if timed and component == AUTOPILOT and (flies or positioned):
            return _BY_ID
        if timed and flies:
            return _FLIES
        if timed and positioned:
            return _POSITIONED
        if self.fliers:  # the autopilot is another one, which has not told its time yet
            return 0
        return _ID_ONLY if timed and component == AUTOPILOT else _ANY

    def places(self, component: int) -> bool:
        """Whether a component's positions are taken: the autopilot's, or another's while the autopilot sends none.

        Of several others, that is the first with an autopilot's HEARTBEAT, else the first.
        """
        if self._autopilot in self._positioned:
            return component == self._autopilot
        first = next((c for c in self._positioned if c in self.fliers), None)
        return component == (first if first is not None else next(iter(self._positioned), component))

    def heard(self, component: int, boot_s: float, arrival_s: float | None) -> float | None:
        """The time of a message that is sent at once, as the autopilot's; moves the autopilot's clock.

        Args:
            component: the sender, which `is_autopilot` was asked about. boot_s: its time since boot,
                seconds; 0 from senders without a clock, which counts as now.
            arrival_s: when the message came, seconds of any clock; None if unknown.

        Returns:
            Seconds since the autopilot's boot; None while its clock is unknown, or the sender's seems to have started
            again and no second message has confirmed that.
        """
        if boot_s > 0.0 and component == self._autopilot:
            if boot_s < self.boot_s - _REBOOT_S:
                self.reboots += 1
                self._begin()
            self.boot_s, self._arrival_s, self._heard = boot_s, arrival_s, True
            return boot_s
        if boot_s == 0.0 or not self._heard:
            return self._now(arrival_s) if boot_s == 0.0 else None
        now = self._now(arrival_s)
        known = self._others.get(component)
        if known is None:
            known = self._others[component] = _Difference(now - boot_s)
        elif known.take(now - boot_s):
            self._pictures = {key: pictures for key, pictures in self._pictures.items() if key[0] != component}
        return None if known.doubted is not None else _converted(boot_s, known.seconds, now)

    def of(
        self, component: int, boot_s: float, arrival_s: float | None, *, number: int, kind: str = ""
    ) -> float | None:
        """The time of a message on a picture, which may be an old one sent again, as the autopilot's; see `heard`.

        It tells the difference of the clocks only as long as nothing is known that the sender sends at once. The sender
        was restarted if its time goes back and the picture is none of before by its number.

        number: the picture's. kind: of the message; each has its own numbers.
        """
        if boot_s > 0.0 and component == self._autopilot:
            return boot_s
        if boot_s == 0.0 or not self._heard:
            return self._now(arrival_s) if boot_s == 0.0 else None
        now = self._now(arrival_s)
        pictures = self._pictures.setdefault((component, kind), _Pictures())
        if pictures.take(number, boot_s, now - boot_s):
            self._others.pop(component, None)
        known = self._others.get(component)
        return _converted(boot_s, pictures.seconds if known is None else known.seconds, now)

    def _now(self, arrival_s: float | None) -> float:
        """The autopilot's time when a message comes."""
        if not self._heard or arrival_s is None or self._arrival_s is None:
            return self.boot_s
        return self.boot_s + max(0.0, arrival_s - self._arrival_s)

    def _begin(self) -> None:
        """Times since boot count from another moment from now on."""
        self.bases += 1
        self.utc_minus_boot_s = None
        self._others.clear()
        self._pictures.clear()


def _converted(boot_s: float, difference_s: float, now: float) -> float:
    """A component's time by the autopilot's clock: it was sent before it came."""
    return boot_s if abs(difference_s) < _SAME_CLOCK_S else min(boot_s + difference_s, now)
