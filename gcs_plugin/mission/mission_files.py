"""Missions as files: QGroundControl `.plan` (JSON) and `.waypoints` ("QGC WPL 110"), read and written.

A mission here is a list of items WITHOUT the home position and without numbers: seq 0 is home on ArduPilot and the
first item on PX4, so home is added only for upload or writing. `.plan` never holds home as an item; `.waypoints` always
does, as line 0.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

from orthoswarm.model.earth import ring_around
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import Fence, Plan, Sortie, Waypoint

Autopilot = Literal["ardupilot", "px4"]
LatLon = tuple[float, float]

FRAME_GLOBAL, FRAME_MISSION, FRAME_GLOBAL_RELATIVE, FRAME_TERRAIN = 0, 2, 3, 10
NAV_WAYPOINT, NAV_LOITER_TIME, NAV_RTL, NAV_LAND, NAV_TAKEOFF, NAV_SPLINE = 16, 19, 20, 21, 22, 82
DO_JUMP, DO_CHANGE_SPEED, DO_SET_CAM_TRIGG_DIST = 177, 178, 206
DO_MOUNT_CONTROL, DO_GIMBAL_MANAGER_PITCHYAW, DO_GIMBAL_MANAGER_CONFIGURE = 205, 1000, 1001
_ANGLES = 2.0  # MAV_MOUNT_MODE_MAVLINK_TARGETING: a DO_MOUNT_CONTROL's angles count
_LEVEL_LOCKED = 12.0  # GIMBAL_MANAGER_FLAGS: roll and pitch count from the horizon, the yaw follows the airframe
_ITSELF, _AS_IT_IS = -2.0, -1.0  # of DO_GIMBAL_MANAGER_CONFIGURE: who is to be in control
_FLOWN = (NAV_WAYPOINT, NAV_SPLINE)
_GROUND_SPEED = 1.0  # MAV_CMD_DO_CHANGE_SPEED's kind
_HIGHEST_M = 20_000.0
_CORNERS = 32  # of the polygon around a circular fence
_WITH_POSITION = {*range(16, 20), 21, 22, 31, 82, 84, 85, 94}
_FIRMWARE: dict[Autopilot, int] = {"ardupilot": 3, "px4": 12}
_MULTIROTOR = 2  # MAV_TYPE
_WINGED = frozenset({1, *range(19, 26)})  # MAV_TYPE: fixed wings, VTOLs
_ABOVE_TAKEOFF, _ABOVE_SEA, _ABOVE_GROUND = 1, 2, (3, 4)  # QGroundControl's AltMode
_LENS = ("SensorWidth", "FocalLength", "ImageWidth", "ImageHeight")
_FLOWN_ANEW = ("survey", "CorridorScan")  # QGroundControl's patterns that lines are laid over or along
_NOT_PLANNED = {
    "HoverAndCapture": "that it stops for each picture",
    "CameraTriggerInTurnAround": "pictures in turns",
    "flyAlternateTransects": "every second line first",
}
_MOST_NAME = 60  # characters of a camera's name
_ALTITUDE_MODE = {FRAME_GLOBAL_RELATIVE: 1, FRAME_TERRAIN: 4}  # QGroundControl's AltModeRelative, AltModeTerrainFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class FileItem:
    """One mission item, free of any autopilot's numbering.

    Attributes:
        frame: MAV_FRAME; 3 = heights above home.
        params: params 1 to 4; NaN where the autopilot chooses.
        lat_deg: latitude in degrees (param 5), 0 for commands without a position; lon_deg longitude (param 6).
        alt_m: height in metres in the item's frame (param 7).
    """

    command: int
    frame: int = FRAME_MISSION
    params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    lat_deg: float = 0.0
    lon_deg: float = 0.0
    alt_m: float = 0.0
    autocontinue: bool = True

    @property
    def has_position(self) -> bool:
        """True for items that are flown to."""
        return self.command in _WITH_POSITION and (self.lat_deg != 0.0 or self.lon_deg != 0.0)


class SurveyValue(NamedTuple):
    """A value of a survey as a field of the request that a plan is made of, and in words."""

    field: str
    value: float | bool
    words: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveySettings:
    """How a survey item of QGroundControl is to be flown; and what of that no plan is made of, in words."""

    values: tuple[SurveyValue, ...] = ()
    left: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionFile:
    """A mission file's content; all outlines and lines are (latitude, longitude) in degrees.

    Attributes:
        items: the items in order, home not among them.
        home: latitude, longitude (degrees) and altitude (metres) of home, None if not in the file.
        surveys: outlines of survey items. polylines: centre lines of corridor items.
        no_fly: rings of exclusion fences. fences: all fences, of both kinds.
        speed_m_s: speed set in the file, or None.
        survey: how the first survey is to be flown.
    """

    items: tuple[FileItem, ...]
    home: tuple[float, float, float] | None = None
    surveys: tuple[tuple[LatLon, ...], ...] = ()
    polylines: tuple[tuple[LatLon, ...], ...] = ()
    no_fly: tuple[tuple[LatLon, ...], ...] = field(default=())
    speed_m_s: float | None = None
    fences: tuple[Fence, ...] = ()
    survey: SurveySettings = SurveySettings()

    def lines(self) -> tuple[tuple[LatLon, ...], ...]:
        """The lines to be photographed: the sections flown with the camera triggering by distance, if any, else all.

        Each is a row of latitudes and longitudes in degrees of two or more waypoints; takeoff and landing are left out.
        """
        if not any(i.command == DO_SET_CAM_TRIGG_DIST and i.params[0] > 0.0 for i in self.items):
            path = [(i.lat_deg, i.lon_deg) for i in self.items if i.command in _FLOWN and i.has_position]
            return (tuple(path),) if len(path) > 1 else ()
        found: list[list[LatLon]] = []
        here: LatLon | None = None
        triggering = False
        for item in self.items:
            if item.command == DO_SET_CAM_TRIGG_DIST:
                triggering = item.params[0] > 0.0
                if triggering:
                    found.append([here] if here else [])
            elif item.command in _FLOWN and item.has_position:
                here = (item.lat_deg, item.lon_deg)
                if triggering:
                    found[-1].append(here)
        return tuple(tuple(line) for line in found if len(line) > 1)


def sortie_items(plan: Plan, sortie: Sortie, autopilot: Autopilot) -> tuple[FileItem, ...]:
    """The mission of one sortie: takeoff, speed, waypoints with camera triggers, the end; home not among them.

    DO_SET_CAM_TRIGG_DIST follows a leg's first waypoint (its third parameter takes a picture at once) and its last
    one with distance 0. PX4 reads yaw 0 as "turn north", so there the yaw is NaN: nose along the path, as ArduPilot
    does by itself, which lays the picture's width across the leg.

    Where the vehicle itself is to keep its height above the ground, waypoints have MAV_FRAME_GLOBAL_TERRAIN_ALT, and
    those put into a leg for their height are left out: ArduPilot follows the ground between such waypoints.
    """
    yaw = math.nan if autopilot == "px4" else 0.0
    by_vehicle = plan.over_ground is not None and plan.over_ground.by_vehicle

    def nav(command: int, lat: float, lon: float, height: float, frame: int = FRAME_GLOBAL_RELATIVE) -> FileItem:
        return FileItem(
            command=command, frame=frame, params=(0.0, 0.0, 0.0, yaw), lat_deg=lat, lon_deg=lon, alt_m=height
        )

    def fly_to(point: Waypoint) -> FileItem:
        if by_vehicle and point.above_ground_m is not None:
            return nav(NAV_WAYPOINT, point.lat_deg, point.lon_deg, point.above_ground_m, FRAME_TERRAIN)
        return nav(NAV_WAYPOINT, point.lat_deg, point.lon_deg, point.height_m)

    items = [
        nav(NAV_TAKEOFF, sortie.home_lat_deg, sortie.home_lon_deg, sortie.takeoff_height_m),
        FileItem(command=DO_CHANGE_SPEED, params=(_GROUND_SPEED, plan.speed_m_s, -1.0, 0.0)),
        *([] if plan.gimbal_pitch_deg is None else gimbal_items(plan.gimbal_pitch_deg, autopilot)),
    ]
    for point in sortie.waypoints:
        if by_vehicle and point.between:
            continue
        items.append(fly_to(point))
        if point.camera is not None:
            distance, at_once = (plan.trigger_m, 1.0) if point.camera else (0.0, 0.0)
            items.append(FileItem(command=DO_SET_CAM_TRIGG_DIST, params=(distance, 0.0, at_once, 0.0)))
        if point.wait_s:
            items.append(replace(fly_to(point), command=NAV_LOITER_TIME, params=(point.wait_s, 0.0, 0.0, yaw)))
    if plan.end == "rtl":
        items.append(FileItem(command=NAV_RTL))
    elif plan.end == "land":
        items.append(nav(NAV_LAND, sortie.home_lat_deg, sortie.home_lon_deg, 0.0))
    else:  # a plain waypoint last: both autopilots then report the mission as complete
        items.append(fly_to(sortie.waypoints[-1]))
    return tuple(items)


def gimbal_items(pitch_deg: float, autopilot: Autopilot) -> list[FileItem]:
    """Items that turn a vehicle's gimbal to a pitch, degrees; one without a gimbal flies on.

    ArduPilot takes DO_MOUNT_CONTROL in all versions. Before 4.6 it turns the nose of a vehicle whose gimbal has no yaw
    to the north until the next waypoint begins, so this stands before a mission's first waypoint, never on a leg.

    PX4 levels the gimbal where a mission is paused, and of the items before it repeats only those of the gimbal
    manager; these need the control of the gimbal, which a mission takes for the autopilot itself.
    """
    if autopilot == "ardupilot":
        return [FileItem(command=DO_MOUNT_CONTROL, params=(pitch_deg, 0.0, 0.0, 0.0), alt_m=_ANGLES)]
    claim, aim = (_ITSELF, _ITSELF, _AS_IT_IS, _AS_IT_IS), (pitch_deg, 0.0, math.nan, math.nan)
    return [
        FileItem(command=DO_GIMBAL_MANAGER_CONFIGURE, params=claim),
        FileItem(command=DO_GIMBAL_MANAGER_PITCHYAW, params=aim, lat_deg=_LEVEL_LOCKED),
    ]


def with_gimbal_items_of(autopilot: Autopilot, items: Iterable[FileItem]) -> list[FileItem]:
    """Items whose pitch of a gimbal stands in one autopilot's words, whichever they were written for.

    ArduPilot refuses a mission that asks for control of a gimbal. What else a mission does with it stays.
    """
    new, begins = list[FileItem](), list[int]()
    mount, manager = (DO_MOUNT_CONTROL, _ANGLES, 0.0), (DO_GIMBAL_MANAGER_PITCHYAW, 0.0, _LEVEL_LOCKED)
    foreign = mount if autopilot == "px4" else manager
    for item in items:
        begins.append(len(new))
        pitch_deg, yaw_deg = item.params[0], item.params[2 if item.command == DO_MOUNT_CONTROL else 1]
        pitches = yaw_deg == 0.0 and (item.command, item.alt_m, item.lat_deg) == foreign
        if pitches:
            new += gimbal_items(pitch_deg, autopilot)
        elif autopilot == "px4" or item.command != DO_GIMBAL_MANAGER_CONFIGURE:
            new.append(item)
    return [_jumps_to(item, begins) for item in new]


def _jumps_to(item: FileItem, begins: Sequence[int]) -> FileItem:
    """An item; a jump leads to where its target, counted from home, begins now."""
    target = item.params[0] - 1.0
    if item.command != DO_JUMP or not 0.0 <= target < len(begins):
        return item
    return replace(item, params=(begins[int(target)] + 1.0, *item.params[1:]))


def plan_text(
    items: Sequence[FileItem],
    home: tuple[float, float, float],
    autopilot: Autopilot,
    speed_m_s: float,
    fences: Sequence[Fence] = (),
) -> str:
    """The text of a QGroundControl `.plan`: file type "Plan", version 1, mission version 2, simple items only.

    QGroundControl sends the fence, too: an empty one replaces that of the vehicle.
    """
    document = {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "geoFence": _fence_document(fences),
        "rallyPoints": {"points": [], "version": 2},
        "mission": {
            "version": 2,
            "firmwareType": _FIRMWARE[autopilot],
            "vehicleType": _MULTIROTOR,
            "globalPlanAltitudeMode": 1,
            "cruiseSpeed": speed_m_s,
            "hoverSpeed": speed_m_s,
            "plannedHomePosition": [round(home[0], 8), round(home[1], 8), home[2]],
            "items": [_simple_item(item, number) for number, item in enumerate(items, start=1)],
        },
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _fence_document(fences: Sequence[Fence]) -> dict[str, Any]:
    """The `geoFence` of a QGroundControl plan, version 2."""
    return {
        "circles": [
            {"circle": {"center": _rounded(f.points[0]), "radius": f.radius_m}, "inclusion": f.inclusion, "version": 1}
            for f in fences
            if f.radius_m is not None
        ],
        "polygons": [
            {"inclusion": f.inclusion, "polygon": [_rounded(p) for p in f.points], "version": 1}
            for f in fences
            if f.radius_m is None
        ],
        "version": 2,
    }


def _rounded(point: LatLon) -> list[float]:
    return [round(point[0], 8), round(point[1], 8)]


def _simple_item(item: FileItem, number: int) -> dict[str, Any]:
    lat, lon, alt = round(item.lat_deg, 8), round(item.lon_deg, 8), round(item.alt_m, 3)
    values = [*(None if math.isnan(p) else p for p in item.params), lat, lon, alt]
    result: dict[str, Any] = {
        "type": "SimpleItem",
        "autoContinue": item.autocontinue,
        "command": item.command,
        "doJumpId": number,
        "frame": item.frame,
        "params": values,
    }
    if item.frame in _ALTITUDE_MODE:
        result |= {"AMSLAltAboveTerrain": None, "Altitude": alt, "AltitudeMode": _ALTITUDE_MODE[item.frame]}
    return result


def waypoints_text(items: Sequence[FileItem], home: tuple[float, float, float]) -> str:
    """The text of a `.waypoints` file: "QGC WPL 110", twelve tab-separated columns, line 0 is home.

    A parameter that PX4 is to choose is "nan", which QGroundControl (Qt's toDouble) and MAVProxy (Python's float) read
    as such; a 0 would turn its nose north.
    """
    lat, lon, alt = home
    first = FileItem(command=NAV_WAYPOINT, frame=FRAME_GLOBAL, lat_deg=lat, lon_deg=lon, alt_m=alt)
    lines = ["QGC WPL 110"]
    for number, item in enumerate([first, *items]):
        params = "\t".join(f"{p:.8g}" for p in item.params)
        position = f"{item.lat_deg:.8f}\t{item.lon_deg:.8f}\t{item.alt_m:.3f}"
        head = f"{number}\t{int(number == 0)}\t{item.frame}\t{item.command}"
        lines.append(f"{head}\t{params}\t{position}\t{int(item.autocontinue)}")
    return "\n".join(lines) + "\n"


def parse_mission(text: str, name: str = "the file") -> MissionFile:
    """Read a `.plan` or a `.waypoints` file, distinguished by content; `name` is how to call the file in an error.

    Raises:
        InputError: it is neither, or a field is missing or no number.
    """
    head = text.lstrip("\ufeff \t\r\n")
    if head.startswith("QGC WPL"):
        return _parse_waypoints(head, name)
    if not head.startswith("{"):
        raise InputError(f"{name} is neither a .plan (JSON) nor a .waypoints file ('QGC WPL 110'); check what it holds")
    try:
        document = json.loads(head)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is not valid JSON ({error}); export it again") from None
    if not isinstance(document, dict) or document.get("fileType") != "Plan":
        raise InputError(f"{name} is JSON but no QGroundControl plan (fileType is not 'Plan'); export a .plan file")
    try:
        return _parse_plan(document)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"{name} is a .plan with a broken item ({error!r}); save it again in QGroundControl") from None


def _parse_waypoints(text: str, name: str) -> MissionFile:
    version, *lines = [line for line in text.splitlines() if line.strip()]
    if version.split()[-1] not in ("110", "120"):
        raise InputError(f"{name} is '{version.strip()}', but only 'QGC WPL 110' is understood; export it again")
    rows = []
    for number, line in enumerate(lines):
        columns = line.split()
        try:
            rows.append([float(c) for c in columns])
            if len(columns) != 12:
                raise ValueError
        except ValueError:
            raise InputError(
                f"{name}, item {number}: {len(columns)} columns, but each line has twelve numbers; export it again"
            ) from None
    if not all(math.isfinite(r[2]) and math.isfinite(r[3]) for r in rows):
        raise InputError(f"{name} has a command or a frame that is not finite; export it again")
    items = [
        FileItem(
            command=int(r[3]),
            frame=int(r[2]),
            params=(r[4], r[5], r[6], r[7]),
            lat_deg=r[8],
            lon_deg=r[9],
            alt_m=r[10],
            autocontinue=r[11] != 0,
        )
        for r in rows
    ]
    home = (items[0].lat_deg, items[0].lon_deg, items[0].alt_m) if items else None
    for item in items:
        _check_item(item, name)
    return MissionFile(items=tuple(items[1:]), home=home)


def _parse_plan(document: Mapping[str, Any]) -> MissionFile:
    mission = document["mission"]
    items: list[FileItem] = []
    surveys: list[tuple[LatLon, ...]] = []
    settings: list[SurveySettings] = []
    polylines: list[tuple[LatLon, ...]] = []
    others = list[str]()
    for entry in mission["items"]:
        if entry.get("type") == "ComplexItem":
            kind = str(entry.get("complexItemType", "survey"))[:_MOST_NAME]
            if kind not in _FLOWN_ANEW:
                others.append(f"its {kind}")
                continue
            if "polygon" in entry:
                surveys.append(_ring(entry["polygon"]))
                settings.append(_survey_settings(entry))
            if "polyline" in entry:
                polylines.append(_ring(entry["polyline"]))
            style = entry.get("TransectStyleComplexItem") or {}
            items.extend(_read_item(i) for i in style.get("Items") or [])
        else:
            items.append(_read_item(entry))
    for item in items:
        _check_item(item, "an item")
    fence = document.get("geoFence") or {}
    fences = [
        Fence(inclusion=bool(p.get("inclusion", True)), points=_ring(p["polygon"])) for p in fence.get("polygons") or []
    ]
    for c in fence.get("circles") or []:
        inside, circle = bool(c.get("inclusion", True)), c["circle"]
        fences.append(Fence(inclusion=inside, points=_ring([circle["center"]]), radius_m=float(circle["radius"])))
    out = [f for f in fences if not f.inclusion]
    no_fly = [f.points if f.radius_m is None else ring_around(*f.points[0], f.radius_m, _CORNERS) for f in out]
    home = mission.get("plannedHomePosition")
    speed = mission.get("hoverSpeed") or mission.get("cruiseSpeed")
    survey = settings[0] if settings else SurveySettings()
    survey = replace(survey, left=(*survey.left, *others))
    if any(other.values != survey.values for other in settings):
        survey = replace(survey, left=(*survey.left, "other settings of further surveys"))
    if survey.values and speed:
        survey = replace(survey, left=(*survey.left, f"the speed of {float(speed):g} m/s"))
    if survey.values and mission.get("vehicleType") in _WINGED:
        survey = replace(survey, left=(*survey.left, "that it is for a vehicle that does not hover (its turns)"))
    return MissionFile(
        items=tuple(items),
        home=(float(home[0]), float(home[1]), float(home[2] if len(home) > 2 else 0.0)) if home else None,
        surveys=tuple(surveys),
        polylines=tuple(polylines),
        no_fly=tuple(no_fly),
        speed_m_s=float(speed) if speed else None,
        fences=tuple(fences),
        survey=survey,
    )


def _survey_settings(entry: Mapping[str, Any]) -> SurveySettings:
    """Settings of a survey item (version 5, with a TransectStyleComplexItem)."""
    style = entry.get("TransectStyleComplexItem") or {}
    camera = style.get("CameraCalc") or {}
    found, left = list[SurveyValue](), list[str]()
    older = _ABOVE_SEA if camera.get("DistanceToSurfaceRelative") is False else _ABOVE_TAKEOFF  # before DistanceMode
    height_m, mode = _amount(camera, "DistanceToSurface"), camera.get("DistanceMode", older)
    if height_m and mode == _ABOVE_SEA:
        left.append(f"the height of {height_m:g} m above the sea")
    elif height_m:
        found.append(SurveyValue("altitude_m", height_m, f"height {height_m:g} m"))
        left += ["that it follows the ground"] if mode in _ABOVE_GROUND or style.get("FollowTerrain") else []
    lens = _lens_values(camera)
    found += lens
    left += ["the distances of its lines and pictures, as it names no lens"] if camera and not lens else []
    if every_s := _amount(camera, "MinTriggerInterval"):
        found.append(SurveyValue("quickest_s", every_s, f"at most one picture in {every_s:g} s"))
    angle, turn_m = entry.get("angle"), _amount(style, "TurnAroundDistance")
    if camera and isinstance(angle, int | float) and math.isfinite(angle):
        found.append(SurveyValue("heading", angle % 180.0, f"lines at {angle % 180.0:g} degrees"))
    if turn_m:
        found.append(SurveyValue("run_in_m", turn_m, f"{turn_m:g} m to turn around"))
    if style.get("Refly90Degrees") is True:
        found.append(SurveyValue("cross", True, "a second time across"))
    left += [word for key, word in _NOT_PLANNED.items() if style.get(key, entry.get(key)) is True]
    return SurveySettings(values=tuple(found), left=tuple(left))


def _lens_values(camera: Mapping[str, Any]) -> list[SurveyValue]:
    """What a survey's lens sees, as QGroundControl has it: pixels are square, upright pictures lie across by height."""
    width, focal, columns, rows = (_amount(camera, key) for key in _LENS)
    if not (width and focal and columns and rows):
        return []
    landscape = camera.get("Landscape", True) is not False
    aspect = columns / rows if landscape else rows / columns
    across = width if landscape else width * aspect
    fov_deg = math.degrees(2.0 * math.atan(across / (2.0 * focal)))
    name = str(camera.get("CameraName") or "camera")[:_MOST_NAME]
    overlaps = {"side_overlap": ("side", "SideOverlap"), "forward_overlap": ("forward", "FrontalOverlap")}
    said = [(field_name, word, _amount(camera, key)) for field_name, (word, key) in overlaps.items()]
    return [
        SurveyValue("fov_min_deg", round(fov_deg, 3), f"{name} ({fov_deg:.1f} degrees)"),
        SurveyValue("aspect", round(aspect, 5), f"pictures {aspect:.3g} times as wide as high"),
        *(
            SurveyValue(name, part / 100.0, f"{word} overlap {part:g} %")
            for name, word, part in said
            if part is not None
        ),
    ]


def _amount(values: Mapping[str, Any], key: str) -> float | None:
    """A number that is not negative, None for anything else."""
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if 0.0 <= value < 1e9 else None


def _read_item(entry: Mapping[str, Any]) -> FileItem:
    values = [math.nan if v is None else float(v) for v in entry["params"]]
    if len(values) != 7:
        raise ValueError(f"an item has {len(values)} params instead of 7")
    lat, lon, alt = (0.0 if math.isnan(v) else v for v in values[4:])
    p1, p2, p3, p4 = values[:4]
    return FileItem(
        command=int(entry["command"]),
        frame=int(entry["frame"]),
        params=(p1, p2, p3, p4),
        lat_deg=lat,
        lon_deg=lon,
        alt_m=alt,
        autocontinue=bool(entry.get("autoContinue", True)),
    )


def _check_item(item: FileItem, name: str) -> None:
    _check_position(item.lat_deg, item.lon_deg, name, item.has_position)
    if not abs(item.alt_m) < _HIGHEST_M:
        raise InputError(f"{name} has the altitude {item.alt_m:g} m, where nothing flies; correct it")


def _check_position(lat: float, lon: float, name: str, used: bool) -> None:
    if used and not (abs(lat) <= 90.0 and abs(lon) <= 180.0):
        raise InputError(f"{name} has the position {lat:g}, {lon:g}, which is not a latitude and longitude; correct it")


def _ring(points: Iterable[Sequence[float]]) -> tuple[LatLon, ...]:
    ring = tuple((float(p[0]), float(p[1])) for p in points)
    for lat, lon in ring:
        _check_position(lat, lon, "a polygon", True)
    return ring
