"""The limits around its home that an autopilot's geofence has by its parameters, and whether a mission keeps to them.

ArduCopter acts where the distance from home reaches FENCE_RADIUS, the height above home FENCE_ALT_MAX or, once it has
been above it, FENCE_ALT_MIN (AC_Fence.cpp), but does not look at missions beforehand. PX4 starts no mission with a
place beyond GF_MAX_HOR_DIST or GF_MAX_VER_DIST, whatever GF_ACTION says (mission_feasibility_checker.cpp).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from gcs_plugin.config import LIMITS
from gcs_plugin.fleet.autopilot_settings import Setting, SetTo
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.items import FRAME_TERRAIN, LANDINGS, RTL, Mission
from gcs_plugin.mission.track import flight_path, heights_m, home_of

_TOP, _CIRCLE, _FLOOR = 1 << 0, 1 << 1, 1 << 3
_ANY_ZONE: Final = 1 << 1
"""Bit of FENCE_OPTIONS: it is enough to be in any of the inclusion zones."""
_FACTORY: Final = _TOP | _CIRCLE | 1 << 2
"""Bits of FENCE_TYPE (AC_Fence.h), and its factory setting: greatest height, circle, zones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FenceLimits:
    """What an autopilot's parameters say about its geofence.

    Attributes:
        radius, top, floor: its limits (metres from home and above it), None where it has none.
        margin_m: from there on a vehicle is near a limit.
        does: what happens beyond a limit, in words; empty if that is only reported.
        unsaid: it keeps a geofence, but has not told all of its limits.
    """

    radius: SetTo | None = None
    top: SetTo | None = None
    floor: SetTo | None = None
    margin_m: float = LIMITS.fence_margin_m
    does: str = ""
    unsaid: bool = False

    @property
    def any(self) -> bool:
        """Whether it has a limit that is known."""
        return not (self.radius is None and self.top is None and self.floor is None)


@dataclass(frozen=True, slots=True)
class FenceFinding:
    """What a mission does at a limit, in words, and whether it goes beyond it or just near it."""

    text: str
    beyond: bool


def fence_limits(vehicle: Vehicle) -> FenceLimits | None:
    """The limits of a vehicle's geofence, None if it has not told whether it keeps one."""
    said = vehicle.settings.get
    radius, top = said(Setting.FENCE_RADIUS), said(Setting.FENCE_TOP)
    if vehicle.autopilot is Autopilot.PX4:
        if radius is None or top is None:
            return None
        does = "and its autopilot starts no mission that goes beyond"
        return FenceLimits(radius=_some(radius), top=_some(top), does=does)
    fence, auto = said(Setting.FENCE), said(Setting.FENCE_AUTO)
    if fence is None and not vehicle.fence_on:
        return None
    if not (vehicle.fence_on or (fence and fence.value) or (auto and auto.value)):
        return FenceLimits()
    kinds, action, margin = said(Setting.FENCE_KINDS), said(Setting.FENCE_ACTION), said(Setting.FENCE_MARGIN)
    bits = _FACTORY if kinds is None else int(kinds.value)
    wanted = {Setting.FENCE_RADIUS: _CIRCLE, Setting.FENCE_TOP: _TOP, Setting.FENCE_FLOOR: _FLOOR}
    does = "does what FENCE_ACTION says" if action is None else action.action
    return FenceLimits(
        radius=radius if bits & _CIRCLE else None,
        top=top if bits & _TOP else None,
        floor=said(Setting.FENCE_FLOOR) if bits & _FLOOR else None,
        margin_m=LIMITS.fence_margin_m if margin is None else margin.value,
        does=f"where it {does} ({'FENCE_ACTION' if action is None else action.name})" if does else "",
        unsaid=kinds is None or any(bits & bit and said(setting) is None for setting, bit in wanted.items()),
    )


def in_all_zones(vehicle: Vehicle) -> bool:
    """Whether a vehicle must be in all inclusion zones of its geofence: ArduPilot, unless it is set up otherwise."""
    options = vehicle.settings.get(Setting.FENCE_OPTIONS)
    return vehicle.autopilot is Autopilot.ARDUPILOT and not (options is not None and int(options.value) & _ANY_ZONE)


def fence_findings(vehicle: Vehicle, mission: Mission, limits: FenceLimits) -> list[FenceFinding]:
    """Where a mission goes near the limits of a geofence or beyond them; those beyond come first."""
    # On the ground its home is set where it stands as it arms.
    home = (vehicle.home if vehicle.flying else vehicle.place) or home_of(mission)
    if home is None:
        return []
    points, _, _ = flight_path(mission, home)
    return sorted(_findings(vehicle, mission, limits, points), key=lambda finding: not finding.beyond)


def _findings(vehicle: Vehicle, mission: Mission, limits: FenceLimits, points: np.ndarray) -> Iterator[FenceFinding]:
    """The findings about a path, float64 (n, 3): east and north of home and height above it, metres."""
    margin_m = limits.margin_m
    if len(points) and limits.radius is not None:
        yield from _over(limits.radius, float(np.hypot(*points[:, :2].T).max()), limits, "goes {} m from home")
    if len(points) and limits.top is not None:
        rises_m = LIMITS.fence_px4_rise_m if vehicle.autopilot is Autopilot.PX4 else margin_m
        yield from _over(limits.top, float(points[:, 2].max()), limits, "goes up to {} m", rises_m)
        if any(i.is_nav and i.plain_frame == FRAME_TERRAIN for i in mission.items):
            text = "its mission's heights count from the ground below it"
            text += f"; whether it stays below {limits.top.value:g} m above home ({limits.top.name}) is not known"
            yield FenceFinding(text, beyond=False)
        back = vehicle.settings.get(Setting.RETURN_HEIGHT)
        px4_returns = vehicle.autopilot is Autopilot.PX4 and back is not None and back.value >= limits.top.value
        if px4_returns and back is not None:  # ArduCopter's way home stays below
            text = f"it flies home {back.value:g} m above home ({back.name}), above its geofence's top at"
            text += f" {limits.top.value:g} m ({limits.top.name}); lower {back.name}, or raise {limits.top.name}"
            yield FenceFinding(text, beyond=False)
    if limits.floor is not None:
        low_m, been_above = math.inf, False
        for item, height_m in heights_m(mission):
            if item.command in (RTL, *LANDINGS):
                continue
            been_above |= height_m >= limits.floor.value + margin_m
            low_m = min(low_m, height_m if been_above else math.inf)
        if low_m <= limits.floor.value:
            text = f"its mission goes down to {low_m:.0f} m, but its geofence begins at {limits.floor.value:g} m"
            text += f" ({limits.floor.name})" + (f", {limits.does}" if limits.does else ", which it reports")
            yield FenceFinding(f"{text}; plan higher, or lower {limits.floor.name}", beyond=bool(limits.does))


def _over(
    limit: SetTo, most_m: float, limits: FenceLimits, goes: str, near_m: float | None = None
) -> Iterator[FenceFinding]:
    """What a mission that goes up to so many metres does at a limit, if anything."""
    margin_m = limits.margin_m if near_m is None else near_m
    if most_m < limit.value - margin_m:
        return
    beyond, needed = most_m >= limit.value, math.ceil(most_m + margin_m)
    text = f"its mission {goes.format(math.ceil(most_m) if beyond else math.floor(most_m))}"
    ends = f"its geofence ends at {limit.value:g} m ({limit.name})"
    does = f", {limits.does}" if limits.does else ", which it only reports"
    text += f", but {ends}{does}" if beyond else f", and {ends}: it may be carried beyond"
    advice = f"plan within that, or set {limit.name} to {needed} if it may fly there"
    yield FenceFinding(f"{text}; {advice}", beyond=beyond and bool(limits.does))


def _some(limit: SetTo) -> SetTo | None:
    """PX4's limits; 0 is none."""
    return limit if limit.value > 0.0 else None
