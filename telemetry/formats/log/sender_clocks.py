"""The clocks of a vehicle's components: `time_boot_ms` counts from the boot of the component that sends it.

A gimbal, a camera or a companion computer shares the autopilot's system id but not its clock. Their times are
converted to the autopilot's, the only clock that can be tied to UTC, by when their messages arrive between those of
the autopilot. Source: MAVLink common, `time_boot_ms`; MAV_COMPONENT.
"""

from dataclasses import dataclass, field
from typing import Final

AUTOPILOT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1. Component 0, of messages that came over no link, counts as it."""

_ANY, _POSITIONED, _FLIES, _BY_ID = range(1, 5)
"""What makes a component the autopilot, from weak to strong: nothing better was heard; it reports the vehicle's
position; its HEARTBEAT is an autopilot's; its id is an autopilot's."""
_REBOOT_S = 10.0
_SAME_CLOCK_S = 0.25
"""A component whose clock differs by less keeps the autopilot's: arrivals of a radio link tell no better."""
_CLOCK_STEP_S = 2.0
"""A change of the difference beyond this is a restart of the component, or one message that came late."""
_SMOOTHED = 50
"""Messages over which the difference is averaged: quartz clocks drift by milliseconds in that time."""


@dataclass(slots=True)
class _Difference:
    """The autopilot's clock minus another component's, in seconds, and the number of messages it was averaged over."""

    seconds: float
    count: int = 1
    doubted: float | None = None

    def take(self, seconds: float) -> None:
        """Average in what another message says; a step counts once a second message confirms it."""
        step = seconds - self.seconds
        if abs(step) < _CLOCK_STEP_S:
            self.count = min(self.count + 1, _SMOOTHED)
            self.seconds += step / self.count
            self.doubted = None
        elif self.doubted is not None and abs(seconds - self.doubted) < _CLOCK_STEP_S / 2:
            self.seconds, self.count, self.doubted = seconds, 1, None
        else:
            self.doubted = seconds


@dataclass(slots=True, kw_only=True)
class SenderClocks:
    """Converts the times since boot of all components of a vehicle to its autopilot's.

    Attributes:
        boot_s: the autopilot's latest time since boot. utc_minus_boot_s: UTC less that, None while unknown.
        reboots: number of times that it went back.
        bases: number of times that times since boot began to count from another moment: at a reboot, and where
            the autopilot turned out to be another component than was thought.
    """

    boot_s: float = 0.0
    utc_minus_boot_s: float | None = None
    reboots: int = 0
    bases: int = 0
    _autopilot: int = field(default=0, repr=False)
    _rank: int = field(default=0, repr=False)
    _heard: bool = field(default=False, repr=False)
    _arrival_s: float | None = field(default=None, repr=False)
    _others: dict[int, _Difference] = field(default_factory=dict, repr=False)

    def is_autopilot(self, component: int, *, positions: bool = False, flies: bool = False) -> bool:
        """Whether a component is the autopilot, as far as the messages up to now tell.

        Args:
            component: MAVLink component id of a sender.
            positions: it reports the vehicle's position. flies: its HEARTBEAT is an autopilot's.
        """
        rank = _BY_ID if component == AUTOPILOT else _FLIES if flies else _POSITIONED if positions else _ANY
        if rank > self._rank:
            self._rank = rank
            if component != self._autopilot:
                if self._heard:
                    self._begin()
                self._autopilot, self._heard, self.boot_s = component, False, 0.0
        return component == self._autopilot

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
        found = self.of(component, boot_s, arrival_s)
        difference = self._others.get(component)
        return found if difference is None or difference.doubted is None else None

    def of(self, component: int, boot_s: float, arrival_s: float | None) -> float | None:
        """The time of a message that may be old (a picture's, sent again), as the autopilot's; see `heard`."""
        if boot_s > 0.0 and component == self._autopilot:
            return boot_s
        if not self._heard:
            return None if boot_s > 0.0 else self.boot_s
        now = self.boot_s
        if arrival_s is not None and self._arrival_s is not None:
            now += max(0.0, arrival_s - self._arrival_s)
        if boot_s == 0.0:
            return now
        known = self._others.get(component)
        if known is None:
            known = self._others[component] = _Difference(now - boot_s)
        else:
            known.take(now - boot_s)
        if abs(known.seconds) < _SAME_CLOCK_S:
            return boot_s
        return min(boot_s + known.seconds, now)  # it was sent before it came

    def _begin(self) -> None:
        """Times since boot count from another moment from now on."""
        self.bases += 1
        self.utc_minus_boot_s = None
        self._others.clear()
