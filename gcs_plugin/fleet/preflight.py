"""The check before a start, as data: for each vehicle a list of items, each ok, warning or red, with a reason.

Red items stop a start unless each is overridden by its name. What an autopilot itself checks before it arms (its
pre-arm checks, its filter) is included here, so that no vehicle takes off while another one cannot.
"""

import enum
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Final

from gcs_plugin.config import LIMITS
from gcs_plugin.fleet.autopilot_settings import Setting, SetTo
from gcs_plugin.fleet.fence_limits import fence_findings, fence_limits, in_all_zones
from gcs_plugin.fleet.heard_messages import MESSAGE_IDS
from gcs_plugin.fleet.separation.separation_check import SeparationFindings, flights_of, separation_of
from gcs_plugin.fleet.separation.separation_watch import NUMBERED, VehicleNames
from gcs_plugin.fleet.vehicle_state import Vehicle
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission.geofence import FenceZone, breach
from gcs_plugin.mission.items import FRAME_GLOBAL, GIMBAL_PITCH, MOUNT_CONTROL, TRIGGER_DISTANCE, Mission, difference
from gcs_plugin.mission.mission_builder import unflyable
from gcs_plugin.mission.plan_folder import NO_NEEDS, PlanNeeds
from gcs_plugin.mission.track import fastest_m_s, flight_seconds, highest_m, takeoff_place
from orthoswarm.model.earth import distance_m
from orthoswarm.model.plan import APART

ITEMS: Final = (
    "link", "gps", "ekf", "home", "pre-arm", "battery", "mission", "fence", "height", "return", "failsafe", "speed",
    "gimbal", "separation",
)  # fmt: skip
CONTINUED: Final = frozenset({"link", "gps", "ekf", "battery", "mission", "fence", "failsafe"})
"""Those that count before a vehicle in the air goes on with a mission that it has left."""
_LINK_S: Final = (2.0, 5.0)
_SATELLITES: Final = (6, 10)
_HOME_M: Final = 50.0
_SAME_M_S: Final = 0.05
_AIMED_DEG: Final = 20.0  # one without stabilisation leans by up to 15 degrees with its airframe (ArduCopter, 6 m/s)
_UNKNOWN_SATELLITES: Final = 255


class Level(enum.Enum):
    """The result of an item."""

    OK = "ok"
    WARNING = "warning"
    RED = "red"


@dataclass(frozen=True, slots=True)
class Item:
    """One item of a check: its name (one of ITEMS), its result, and the finding in words."""

    name: str
    level: Level
    reason: str

    def document(self) -> dict[str, str]:
        """As JSON values: `name`, `state` (`ok`, `warning`, `red`), `reason`."""
        return {"name": self.name, "state": self.level.value, "reason": self.reason}


@dataclass(frozen=True, slots=True)
class Check:
    """The check of one vehicle: its items in the order of ITEMS."""

    system: int
    items: tuple[Item, ...]

    def red(self, overridden: Iterable[str] = ()) -> list[Item]:
        """The items that stop a start, without those that are overridden by name."""
        allowed = set(overridden)
        return [item for item in self.items if item.level is Level.RED and item.name not in allowed]

    @property
    def level(self) -> Level:
        """The worst of its items."""
        levels = {item.level for item in self.items}
        return Level.RED if Level.RED in levels else Level.WARNING if Level.WARNING in levels else Level.OK

    def document(self, name: str) -> dict[str, Any]:
        """As JSON values: `vehicle`, `state` (the worst), `items`."""
        rows = [item.document() for item in self.items]
        return {"vehicle": name, "state": self.level.value, "items": rows}


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a vehicle is checked against.

    Attributes:
        mission: the plan's mission of this vehicle, None to fly what it holds.
        stored: the mission just read from the vehicle, None to use the known one.
        needs: what the plan relies on.
        legal_height_m: height above takeoff that may be flown without asking.
        near: whom it comes too near, in words. unexamined: why that could not be examined; empty if it was.
        zones: of the geofence that it holds, None if that has not been read.
        reading: its mission is still being read from it.
    """

    mission: Mission | None = None
    stored: Mission | None = None
    needs: PlanNeeds = NO_NEEDS
    legal_height_m: float = LIMITS.legal_height_m
    near: str = ""
    _: KW_ONLY
    unexamined: str = ""
    zones: Sequence[FenceZone] | None = None
    reading: bool = False


def preflight(vehicle: Vehicle, wanted: Wanted, now: float) -> Check:
    """Check one vehicle before its start, at a time of the fleet's clock."""
    mission = wanted.mission or wanted.stored or vehicle.mission
    items = (
        _link(vehicle, now), _gps(vehicle, now), _ekf(vehicle), _home(vehicle, mission, wanted), _prearm(vehicle, now),
        _battery(vehicle, mission, wanted.needs.endurance_s or LIMITS.endurance_s, now), _mission(vehicle, wanted),
        _fence(vehicle, mission, wanted.zones), _height(mission, wanted),
        _return(vehicle, wanted.needs.return_height_m), _failsafe(vehicle), _speed(vehicle, mission),
        _gimbal(vehicle, mission), _separation(wanted),
    )  # fmt: skip
    return Check(vehicle.system, items)


def preflight_all(
    vehicles: Mapping[int, Vehicle],
    missions: Mapping[int, Mission],
    stored: Mapping[int, Mission],
    starts: Mapping[int, float],
    now: float,
    *,
    needs: PlanNeeds = NO_NEEDS,
    legal_height_m: float = LIMITS.legal_height_m,
    names: VehicleNames = NUMBERED,
    separation: SeparationFindings | None = None,
    zones: Mapping[int, Sequence[FenceZone]] | None = None,
    reading: Collection[int] = (),
) -> list[Check]:
    """Check vehicles that are to start together.

    Args:
        vehicles: by system id, as the fleet knows them.
        missions: the plan's; a vehicle without one flies its stored mission.
        stored: what was read from the vehicles just now. reading: vehicles whose missions are still being read.
        starts: takeoffs in seconds after the first; default 0. now: the fleet's clock.
        needs, legal_height_m: see Wanted. zones: of the geofences that were read.
        names: of the vehicles.
        separation: of them from each other and from others, where that was examined before.
    """
    if separation is None:
        separation = separation_of(flights_of(vehicles, missions, stored, starts), names, needs)
    return [
        preflight(
            vehicle,
            Wanted(
                missions.get(s), stored.get(s), needs, legal_height_m,
                separation.near.get(s, ""), unexamined=separation.unexamined.get(s, ""), zones=(zones or {}).get(s),
                reading=s in reading,
            ),
            now,
        )
        for s, vehicle in sorted(vehicles.items())
    ]  # fmt: skip


def red_text(checks: Sequence[Check], overridden: Mapping[int, Iterable[str]]) -> dict[int, str]:
    """For each vehicle that may not start: why, in words."""
    found = {check.system: check.red(overridden.get(check.system, ())) for check in checks}
    return {system: "; ".join(f"{i.name}: {i.reason}" for i in items) for system, items in found.items() if items}


def _link(vehicle: Vehicle, now: float) -> Item:
    age = now - vehicle.heard
    if vehicle.claimants:
        return Item("link", Level.RED, f"several vehicles use its system id: {', '.join(vehicle.claimants)}")
    if vehicle.lost or age > _LINK_S[1]:
        return Item("link", Level.RED, f"silent for {age:.0f} s")
    level = Level.OK if age <= _LINK_S[0] else Level.WARNING
    return Item("link", level, f"heard {age:.1f} s ago")


def _gps(vehicle: Vehicle, now: float) -> Item:
    count = vehicle.satellites
    if (age_s := vehicle.streams.age_s(MESSAGE_IDS["GPS_RAW_INT"], now) or 0.0) > LIMITS.old_s:
        return Item("gps", Level.RED, f"it has not reported its receiver's state for {age_s:.0f} s")
    if vehicle.gps_fix < 3:
        return Item("gps", Level.RED, f"no 3D fix ({count if count != _UNKNOWN_SATELLITES else 0} satellites)")
    if vehicle.lat_deg is None:
        return Item("gps", Level.RED, "it has not reported its position")
    if (age_s := vehicle.place_age_s(now)) > LIMITS.old_s:
        return Item("gps", Level.RED, f"it has not reported its position for {age_s:.0f} s")
    if count < _SATELLITES[0]:
        return Item("gps", Level.RED, f"{count} satellites, {_SATELLITES[0]} are needed")
    level = Level.OK if count >= _SATELLITES[1] else Level.WARNING
    return Item("gps", level, "3D fix" if count == _UNKNOWN_SATELLITES else f"3D fix, {count} satellites")


def _ekf(vehicle: Vehicle) -> Item:
    if vehicle.ekf_ok is None:
        return Item("ekf", Level.WARNING, "it does not report its position filter")
    if not vehicle.ekf_ok:
        return Item("ekf", Level.RED, "its position filter has no absolute position yet; wait")
    return Item("ekf", Level.OK, "position filter is running")


def _home(vehicle: Vehicle, mission: Mission | None, wanted: Wanted) -> Item:
    off = _off_start(vehicle, mission, wanted) if mission is not None and not vehicle.flying else ""
    if off:
        return Item("home", Level.RED, f"{off}; plan from where it stands, or put it there")
    if vehicle.home is None:
        return Item("home", Level.WARNING, "not set yet; it is set when the vehicle arms")
    if vehicle.place is None:
        return Item("home", Level.WARNING, "set, but the vehicle does not report its position")
    away = distance_m(*vehicle.place, *vehicle.home)
    if away > _HOME_M and not vehicle.flying:
        return Item("home", Level.WARNING, f"home is {away:.0f} m away from where it stands")
    return Item("home", Level.OK, "set")


def _off_start(vehicle: Vehicle, mission: Mission, wanted: Wanted) -> str:
    """How far a vehicle stands from where its mission takes off, in words; empty if it stands there."""
    first = mission.items[0] if mission.first_seq and mission.items and wanted.mission is not None else None
    place = takeoff_place(mission) or (None if first is None else first.place)  # a vehicle's own item 0 is its home
    if place is not None and vehicle.place is not None:
        away = distance_m(*vehicle.place, *place)
        if away > LIMITS.start_off_m:
            return f"it stands {away:.0f} m from where its mission takes off"
    if first is not None and first.z and first.plain_frame == FRAME_GLOBAL and vehicle.alt_m is not None:
        above = vehicle.alt_m - first.z
        if abs(above) > LIMITS.start_off_height_m:
            return f"it stands {abs(above):.0f} m {'above' if above > 0 else 'below'} where its mission takes off"
    return ""


def _prearm(vehicle: Vehicle, now: float) -> Item:
    if vehicle.armed:
        return Item("pre-arm", Level.OK, "armed")
    if vehicle.prearm_ok is None:
        return Item("pre-arm", Level.WARNING, "it does not report its pre-arm checks")
    if not vehicle.prearm_ok:
        said = "; ".join(vehicle.prearm_texts(now)) or "it does not say why yet"
        return Item("pre-arm", Level.RED, f"would refuse to arm: {said}")
    return Item("pre-arm", Level.OK, "its own checks passed")


def _battery(vehicle: Vehicle, mission: Mission | None, endurance_s: float, now: float) -> Item:
    left = vehicle.battery
    if (age_s := vehicle.battery_age_s(now) or 0.0) > LIMITS.old_s:
        return Item("battery", Level.RED, f"it has not reported its battery for {age_s:.0f} s")
    if left is None:
        return Item("battery", Level.WARNING, "it does not report its battery")
    needed = flight_seconds(mission) / endurance_s if mission is not None else 0.0
    if vehicle.flying and (flown := vehicle.detector.flown) is not None and flown.places:
        needed *= 1.0 - len(flown.reached & flown.places.keys()) / len(flown.places)
    which = f" in its {vehicle.battery_name}" if vehicle.battery_name else ""
    text = f"{100 * left:.0f} % left{which}, the mission needs about {100 * needed:.0f} %"
    if left < needed or left < 0.5 * LIMITS.reserve_share:
        return Item("battery", Level.RED, f"{text}; change the battery")
    if left < needed + LIMITS.reserve_share:
        return Item("battery", Level.WARNING, f"{text}; less than {100 * LIMITS.reserve_share:.0f} % would be left")
    return Item("battery", Level.OK, text)


def _mission(vehicle: Vehicle, wanted: Wanted) -> Item:
    held = wanted.stored or vehicle.mission
    if wanted.reading:
        return Item("mission", Level.RED, "its mission is still being read from it; wait")
    if held is None:
        return Item("mission", Level.RED, "its mission has not been read yet; upload it, or wait until it is read")
    wrong = unflyable(held.items, vehicle.autopilot, in_air=vehicle.flying)
    if wrong:
        return Item("mission", Level.RED, wrong)
    if wanted.mission is not None:
        found = difference(wanted.mission, held.items)
        if found:
            return Item("mission", Level.RED, f"it does not hold this plan's mission ({found}); upload the plan")
        return Item("mission", Level.OK, "holds this plan's mission")
    return Item("mission", Level.OK, f"holds a mission of {len(held)} items")


def _fence(vehicle: Vehicle, mission: Mission | None, zones: Sequence[FenceZone] | None) -> Item:
    limits = fence_limits(vehicle)
    if mission is None:
        return Item("fence", Level.OK, "no mission to compare with its geofence")
    why = breach(mission, zones, in_all=in_all_zones(vehicle)) if zones else ""
    broken = f"{why}; change the mission or the fence" if why else ""
    findings = [] if limits is None else fence_findings(vehicle, mission, limits)
    beyond = [text for text in (broken, *(finding.text for finding in findings if finding.beyond)) if text]
    if beyond:
        return Item("fence", Level.RED, "; ".join(beyond))
    if findings:
        return Item("fence", Level.WARNING, "; ".join(finding.text for finding in findings))
    if limits is None:
        return Item("fence", Level.WARNING, "it has not said whether it keeps a geofence; look at its parameters")
    if limits.unsaid:
        return Item("fence", Level.WARNING, "it keeps a geofence but has not said all its limits; check again")
    lossy = vehicle.route is not None and vehicle.route.loss > LIMITS.lossy_share
    # ArduPilot has not said when it switches its geofence on; older versions do not say it.
    unknown = vehicle.autopilot is Autopilot.ARDUPILOT and Setting.FENCE_AUTO not in vehicle.settings
    if lossy and unknown and not limits.any:
        text = "its geofence is off; whether it switches that on as it arms may have been lost on its link"
        return Item("fence", Level.WARNING, f"{text}; look at FENCE_AUTOENABLE")
    text = "its mission keeps to its geofence" if zones or limits.any else "it has no geofence"
    return Item("fence", Level.OK, f"{text}; zones in it were not read" if zones is None else text)


def _height(mission: Mission | None, wanted: Wanted) -> Item:
    top = highest_m(mission) if mission is not None else None
    if top is None:
        return Item("height", Level.OK, "no height above takeoff in its mission")
    if top > wanted.legal_height_m:
        text = f"highest point {top:.0f} m above takeoff, over {wanted.legal_height_m:.0f} m; allow it if you may"
        return Item("height", Level.RED, text)
    return Item("height", Level.OK, f"highest point {top:.0f} m above takeoff")


def _return(vehicle: Vehicle, needed_m: float | None) -> Item:
    found, how = vehicle.settings.get(Setting.RETURN_HEIGHT), vehicle.settings.get(Setting.RETURN_TYPE)
    least = None if needed_m is None else f"the ground on its way needs {needed_m:.0f} m"
    other = "" if how is None or not how.returns else f"it returns {how.returns} ({how.name} is {how.value:g})"
    low = _too_low(vehicle, needed_m) if needed_m is not None and (how is None or how.may_fly_straight) else ""
    if low:
        return Item("return", Level.RED, f"{other}, and otherwise it {low}" if other else low)
    if how is not None and other:
        also = "" if least is None else f"; {least} above home"
        text = f"{other}, which plans and a return in turn do not know{also}; set {how.name} to 0"
        return Item("return", Level.WARNING, text)
    if found is None:
        text = "it has not said at what height it flies home"
        return Item("return", Level.WARNING, text if least is None else f"{text}; {least}")
    rally = vehicle.settings.get(Setting.RALLY_POINTS)
    if rally is not None and rally.value > 0.0:
        text = f"it may return to one of its {rally.value:.0f} rally points ({rally.name}) instead of home"
        return Item("return", Level.WARNING, f"{text}, which plans and a return in turn do not know; remove them")
    return Item("return", Level.OK, _way_home(found))


def _way_home(height: SetTo) -> str:
    """At what height a vehicle flies home, in words."""
    if not height.value:
        return f"RTL altitude: the current one ({height.name} is 0)"
    return f"RTL altitude {height.value:g} m above home, or current if higher ({height.name})"


def _too_low(vehicle: Vehicle, needed_m: float) -> str:
    """Why a straight way home is lower than the ground needs, in words; empty if it is not, or not known to be."""
    found, least = vehicle.settings.get(Setting.RETURN_HEIGHT), f"the ground on its way needs {needed_m:.0f} m"
    if found is not None and found.value < needed_m:
        return f"{_way_home(found)}, but {least}; set {found.name} to {found.native(needed_m):.0f}"
    limits = fence_limits(vehicle) if vehicle.autopilot is Autopilot.ARDUPILOT else None
    if found is None or limits is None or limits.top is None:
        return ""
    below_m = limits.top.value - limits.margin_m  # its way home stays below that
    if below_m >= needed_m:
        return ""
    text = f"flies home no higher than {below_m:g} m, below its geofence's top ({limits.top.name}), but {least}"
    return f"{text}; set {limits.top.name} to {needed_m + limits.margin_m:.0f}"


def _failsafe(vehicle: Vehicle) -> Item:
    low, alone = (vehicle.settings.get(s) for s in (Setting.LOW_BATTERY, Setting.NO_STATION))
    spared = vehicle.settings.get(Setting.NO_STATION_EXCEPT)
    if vehicle.flying and vehicle.had_failsafe:
        text = f"it is in a failsafe, or was in one in this flight ({vehicle.severe_text or 'it says no more why'})"
        return Item("failsafe", Level.RED, text)
    text = "" if alone is None else f"; without a ground station it {alone.action or 'goes on'} ({alone.name})"
    if alone is not None and alone.action and spared is not None and spared.spares_missions:
        text += f", but not on a mission ({spared.name})"
    if low is None:
        return Item("failsafe", Level.WARNING, f"it has not said what it does when its battery is low{text}")
    if not low.action:
        return Item("failsafe", Level.WARNING, f"it does nothing when its battery is low; set {low.name}{text}")
    return Item("failsafe", Level.OK, f"when its battery is low it {low.action} ({low.name}){text}")


def _separation(wanted: Wanted) -> Item:
    if wanted.near:
        return Item("separation", Level.RED, wanted.near)
    if wanted.unexamined:
        return Item("separation", Level.WARNING, f"not examined: {wanted.unexamined}")
    apart = wanted.needs.apart
    less = apart is not None and (apart.distance_m < APART.distance_m or apart.height_m < APART.height_m)
    if wanted.mission is not None and apart is not None and less:
        text = f"its plan keeps its vehicles only {apart.distance_m:g} m apart, or {apart.height_m:g} m in height"
        text += f"; alarms come below {APART.distance_m:g} m and {APART.height_m:g} m"
        return Item("separation", Level.WARNING, text)
    return Item("separation", Level.OK, "keeps apart")


def _gimbal(vehicle: Vehicle, mission: Mission | None) -> Item:
    looks_deg = vehicle.gimbal_pitch_deg
    items = mission.items if mission is not None else ()
    turned = [item.params[0] for item in items if item.command in (MOUNT_CONTROL, GIMBAL_PITCH)]
    if looks_deg is None:
        text = "its camera must look down by itself" if not turned else "its mission turns one down if there is one"
        return Item("gimbal", Level.OK, f"it reports no gimbal: {text}")
    looks = f"its gimbal is at {looks_deg:.0f} degrees (-90 is down)"
    there = abs(looks_deg - (turned[0] if turned else -90.0)) <= _AIMED_DEG
    # PX4 levels it whenever it leaves a mission, and turns it again.
    rests = vehicle.autopilot is Autopilot.PX4 and vehicle.custom_mode != vehicle.modes.mission
    if turned and (there or rests or not vehicle.flying):
        return Item("gimbal", Level.OK, f"{looks}; its mission turns it to {turned[0]:.0f}")
    if there or not any(item.command == TRIGGER_DISTANCE for item in items):
        return Item("gimbal", Level.OK, looks)
    why = f"not at {turned[0]:.0f} as its mission says" if turned else "and its mission does not turn it down"
    return Item("gimbal", Level.WARNING, f"{looks}, {why}; turn it, or plan with --gimbal-pitch")


def _speed(vehicle: Vehicle, mission: Mission | None) -> Item:
    asked = fastest_m_s(mission) if mission is not None else None
    if asked is None:
        return Item("speed", Level.OK, "its mission leaves the speed to it")
    found = vehicle.settings.get(Setting.SPEED)
    if found is None:
        return Item("speed", Level.WARNING, f"asks for {asked:g} m/s; the vehicle has not said what it is set to")
    name, most = found.name, found.value
    if asked <= most + _SAME_M_S:
        return Item("speed", Level.OK, f"asks for {asked:g} m/s, {name} is {most:g} m/s")
    flies = f"flies at {most:g} m/s" if vehicle.autopilot is Autopilot.PX4 else "may not reach that"
    text = f"is asked for {asked:g} m/s but {flies} ({name} is {most:g} m/s) and falls behind its plan"
    return Item("speed", Level.WARNING, f"{text}; plan at most {most:g} m/s, or raise {name} if it can fly faster")
