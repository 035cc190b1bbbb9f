"""DJI's WPML in a KMZ, for Pilot 2: written as DJI's Cloud API documents it (DJI WPML), and read.

All stands in both of its files: Pilot 2 makes waylines.wpml again from template.kml when somebody edits the route.

The drone stops at each waypoint (toPointAndStopWithDiscontinuityCurvature): of WPML's four turns only this one keeps to
the straight lines before and after a waypoint, which lead around no-fly zones, and along which pictures are taken up to
their ends. Points amid a straight way, put in for their height, are passed (coordinateTurn): it cuts off height alone.
"""

import io
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from gcs_plugin.mission.makers.drone_route import DroneRoute, RoutePoint, east_north_m
from orthoswarm.export.xml_elements import element, xml_bytes
from orthoswarm.model.errors import InputError
from orthoswarm.model.plan import End

_STOP, _PASS = "toPointAndStopWithDiscontinuityCurvature", "coordinateTurn"
_STRAIGHT_DEG: Final = 1.0  # a smaller change of course has no corner that could be cut
_CUT_M: Final = 1.0  # so far before and after a point that is passed a drone may leave its line
_LEAST_CLIMB_M: Final = 1.2  # least takeOffSecurityHeight with a remote controller
_LARGEST_BYTES: Final = 50_000_000  # of a route, unpacked
_FINISH: Final[Mapping[End, str]] = {"rtl": "goHome", "land": "autoLand", "hover": "noAction"}
_OF_KML: Final = frozenset({"Document", "Folder", "Placemark", "Point", "coordinates"})
# The nose along the way, so that a picture's width lies across it.
_HEADING: Final = {"waypointHeadingMode": "followWayline", "waypointHeadingPathMode": "followBadArc"}


class DjiDrone(NamedTuple):
    """WPML's version for a drone, and its numbers of drone and camera; `lens` of a camera that has several."""

    version: str
    kind: tuple[int, int]
    camera: int
    lens: str = ""


def wpml_kmz(route: DroneRoute, drone: DjiDrone, home_m: float) -> bytes:
    """The KMZ of a route; `home_m` is the height above takeoff at which the drone comes home."""
    groups = _action_groups(route, drone)
    template = {
        "templateType": "waypoint",
        "templateId": 0,
        "waylineCoordinateSysParam": {"coordinateMode": "WGS84", "heightMode": "relativeToStartPoint"},
        "autoFlightSpeed": route.speed_m_s,
        "gimbalPitchMode": "manual",
        "globalWaypointHeadingParam": _HEADING,
        "globalWaypointTurnMode": _STOP,
        "globalUseStraightLine": 1,
        "globalHeight": route.climb_m,
        "Placemark": [_placemark(route, k, groups, in_template=True) for k in range(len(route.points))],
        "payloadParam": {"payloadPositionIndex": 0} | ({"imageFormat": drone.lens} if drone.lens else {}),
    }
    waylines = {
        "templateId": 0,
        "executeHeightMode": "relativeToStartPoint",
        "waylineId": 0,
        "autoFlightSpeed": route.speed_m_s,
        "Placemark": [_placemark(route, k, groups, in_template=False) for k in range(len(route.points))],
    }
    files = {
        "template.kml": {"missionConfig": _config(route, drone, {}), "Folder": template},
        "waylines.wpml": {"missionConfig": _config(route, drone, {"globalRTHHeight": home_m}), "Folder": waylines},
    }
    spaces = {"xmlns": "http://www.opengis.net/kml/2.2", "xmlns:wpml": f"http://www.dji.com/wpmz/{drone.version}"}
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, document in files.items():
            root = element("kml", *_elements({"Document": document}), **spaces)
            # No time of now in it: the same plan is the same file.
            archive.writestr(zipfile.ZipInfo(f"wpmz/{name}"), xml_bytes(root), zipfile.ZIP_DEFLATED)
    return data.getvalue()


def _elements(values: Mapping[str, Any]) -> Iterator[Element]:
    """Elements of WPML by tag: text, numbers, elements within, and lists of these."""
    for tag, value in values.items():
        for each in value if isinstance(value, list) else [value]:
            name = tag if tag in _OF_KML else f"wpml:{tag}"
            if isinstance(each, Mapping):
                yield element(name, *_elements(each))
            else:
                yield element(name, each if isinstance(each, str) else f"{each:.10g}")


def _config(route: DroneRoute, drone: DjiDrone, home: Mapping[str, float]) -> dict[str, Any]:
    """What both files begin with.

    Without its remote controller a drone flies on: the plan keeps clear of zones and vehicles, a straight way home not.
    """
    return {
        "flyToWaylineMode": "safely",
        "finishAction": _FINISH[route.end],
        "exitOnRCLost": "goContinue",
        "executeRCLostAction": "goBack",
        "takeOffSecurityHeight": max(route.climb_m, _LEAST_CLIMB_M),
        "globalTransitionalSpeed": route.speed_m_s,
        **home,
        "droneInfo": {"droneEnumValue": drone.kind[0], "droneSubEnumValue": drone.kind[1]},
        "payloadInfo": {"payloadEnumValue": drone.camera, "payloadPositionIndex": 0},
    }


def _placemark(route: DroneRoute, number: int, groups: Mapping[int, list[Any]], *, in_template: bool) -> dict[str, Any]:
    point, cut_m = route.points[number], _cut_m(route.points, number)
    turn = {"waypointTurnMode": _PASS, "waypointTurnDampingDist": cut_m} if cut_m else {"waypointTurnMode": _STOP}
    height_m = round(point.height_m, 3)
    place = {"Point": {"coordinates": f"{point.lon_deg:.9f},{point.lat_deg:.9f}"}, "index": number}
    shared = {"waypointTurnParam": turn, "useStraightLine": 1, "actionGroup": groups.get(number, [])}
    if not in_template:
        speed = {"executeHeight": height_m, "waypointSpeed": route.speed_m_s}
        return place | speed | {"waypointHeadingParam": _HEADING} | shared
    own = {"useGlobalHeight": 0, "ellipsoidHeight": height_m, "height": height_m}
    return place | own | {"useGlobalSpeed": 1, "useGlobalHeadingParam": 1, "useGlobalTurnParam": 0} | shared


def _cut_m(points: Sequence[RoutePoint], number: int) -> float:
    """How far before a point amid a straight way the drone may leave its line; 0 where it has to stop."""
    if number in (0, len(points) - 1) or points[number].wait_s or points[number].every_m != points[number - 1].every_m:
        return 0.0
    (x, y), (u, v) = (east_north_m(*points[k : k + 2]) for k in (number - 1, number))
    shorter_m, turn = min(math.hypot(x, y), math.hypot(u, v)), math.atan2(x * v - y * u, x * u + y * v)
    return min(_CUT_M, 0.25 * shorter_m) if shorter_m > _CUT_M and abs(turn) < math.radians(_STRAIGHT_DEG) else 0.0


def _action_groups(route: DroneRoute, drone: DjiDrone) -> dict[int, list[Any]]:
    """What is done from each waypoint on.

    The gimbal is turned at each leg again: it is level after a battery was changed amid the route.
    """
    legs, reached = route.legs(), {"actionTriggerType": "reachPoint"}
    lens = {"payloadLensIndex": drone.lens} if drone.lens else {}
    photo = {"payloadPositionIndex": 0, "fileSuffix": "leg", **lens, "useGlobalPayloadLensIndex": int(not lens)}
    wanted: list[tuple[int, int, dict[str, Any], str, dict[str, Any]]] = []
    if route.pitch_deg is not None:
        wanted += [(k, k, reached, "gimbalRotate", _gimbal(route.pitch_deg)) for k, _ in legs or [(0, 0)]]
    for first, last in legs:
        each = {"actionTriggerType": "multipleDistance", "actionTriggerParam": round(route.points[first].every_m, 3)}
        wanted.append((first, last, each, "takePhoto", photo))
    waits = {k: point.wait_s for k, point in enumerate(route.points) if point.wait_s}
    wanted += [(k, k, reached, "hover", {"hoverTime": wait_s}) for k, wait_s in waits.items()]
    groups = dict[int, list[Any]]()
    for number, (first, last, trigger, function, values) in enumerate(sorted(wanted, key=lambda group: group[0])):
        span = {"actionGroupId": number, "actionGroupStartIndex": first, "actionGroupEndIndex": last}
        action = {"actionId": 0, "actionActuatorFunc": function, "actionActuatorFuncParam": values}
        group = span | {"actionGroupMode": "sequence", "actionTrigger": trigger, "action": action}
        groups.setdefault(first, []).append(group)
    return groups


def _gimbal(pitch_deg: float) -> dict[str, Any]:
    base = {"payloadPositionIndex": 0, "gimbalHeadingYawBase": "north", "gimbalRotateMode": "absoluteAngle"}
    pitch = {"gimbalPitchRotateEnable": 1, "gimbalPitchRotateAngle": pitch_deg}
    roll, yaw = ({f"gimbal{axis}RotateEnable": 0, f"gimbal{axis}RotateAngle": 0} for axis in ("Roll", "Yaw"))
    return base | pitch | roll | yaw | {"gimbalRotateTimeEnable": 0, "gimbalRotateTime": 0}


def parse_wpml(data: bytes, name: str) -> DroneRoute:
    """The route of a KMZ that Pilot 2 or this program wrote.

    Raises:
        InputError: it is damaged, none, or says heights that no mission item can.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            found = [info for info in archive.infolist() if info.filename.endswith("waylines.wpml")]
            if not found or found[0].file_size > _LARGEST_BYTES:
                raise InputError(f"{name} holds no route of Pilot 2 (waylines.wpml), or a huge one; export it again")
            root = ElementTree.fromstring(archive.read(found[0]))
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise InputError(f"{name} is a damaged ZIP ({error}); export the route again") from None
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{name} holds no valid XML ({error}); export the route again") from None
    for node in root.iter():
        node.tag = str(node.tag).rpartition("}")[2].removeprefix("wpml:")
    folders = list(root.iter("Folder"))
    if len(folders) != 1:
        raise InputError(f"{name} holds {len(folders)} routes; export one of them")
    mode = folders[0].findtext("executeHeightMode", "").strip()
    if mode != "relativeToStartPoint":
        raise InputError(
            f"{name} has heights of the kind '{mode}'; save the route with heights relative to the takeoff"
        )
    try:
        return _read_route(root, folders[0])
    except (ValueError, TypeError, IndexError, OverflowError) as error:
        raise InputError(f"{name} has a broken value ({error}); export the route again") from None


def _read_route(root: Element, folder: Element) -> DroneRoute:
    speed_m_s, pitch_deg = _number(folder, "autoFlightSpeed"), None
    points = list[RoutePoint]()
    for mark in folder.iter("Placemark"):
        lon, lat = (float(part) for part in mark.findtext("Point/coordinates", "").split(",")[:2])
        points.append(RoutePoint(lat, lon, _number(mark, "executeHeight")))
    for group in folder.iter("actionGroup"):
        first, last = (int(_number(group, f"actionGroup{which}Index")) for which in ("Start", "End"))
        trigger, actions = group.findtext("actionTrigger/actionTriggerType"), _actions(group)
        if trigger in ("multipleDistance", "multipleTiming") and "takePhoto" in actions:
            step = _number(group, "actionTrigger/actionTriggerParam")
            every_m = step if trigger == "multipleDistance" else step * speed_m_s
            points[first:last] = [point._replace(every_m=every_m) for point in points[first:last]]
        elif "hover" in actions:
            points[first] = points[first]._replace(wait_s=_number(actions["hover"], "hoverTime"))
        turned = actions.get("gimbalRotate")
        if turned is not None and turned.findtext("gimbalPitchRotateEnable") == "1":
            pitch_deg = _number(turned, "gimbalPitchRotateAngle")
    finish, climb_m = root.findtext(".//finishAction"), _number(root, ".//takeOffSecurityHeight")
    end: End = next((end for end, action in _FINISH.items() if action == finish), "hover")
    return DroneRoute(points=tuple(points), speed_m_s=speed_m_s, climb_m=climb_m, pitch_deg=pitch_deg, end=end)


def _number(node: Element, path: str) -> float:
    return float(node.findtext(path, "").strip())


def _actions(group: Element) -> dict[str, Element]:
    """Parameters of what a group of actions does, by the names of these."""
    found = ((a.findtext("actionActuatorFunc", ""), a.find("actionActuatorFuncParam")) for a in group.iter("action"))
    return {name: Element("none") if values is None else values for name, values in found}
