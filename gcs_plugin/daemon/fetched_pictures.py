"""Pictures read from vehicles become pictures of the workspace, with the pose of their camera event."""

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from gcs_plugin.daemon.flight_coverage.file_numbers import PictureNames
from gcs_plugin.daemon.flight_coverage.picture_requests import PictureRequests, WantedPicture, wanted_pictures
from gcs_plugin.daemon.intake.posted_pose import PostedPose, linked_pose
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.event_bus import Events
from gcs_plugin.daemon.store.journal import Journal, packed, unpacked
from orthoswarm.model.errors import InputError
from telemetry.live.live_poses import LinkPoses

if TYPE_CHECKING:
    from gcs_plugin.daemon.vehicles import VehicleLinks

_EVENT: str = "camera event"


def make_picture_requests(
    links: "VehicleLinks",
    settings: Settings,
    *,
    journal: Journal,
    poses: LinkPoses,
    events: Events,
    missing: Callable[[], list[dict[str, Any]]],
    add_picture: Callable[[PostedPose, bytes], object],
) -> PictureRequests:
    """The daemon's requests for pictures, to be started.

    Args:
        poses: of the links, by vehicle and time. missing: returns the pictures that are known to exist but have not
            arrived. add_picture: takes a picture into the workspace.
    """

    def store(wanted: WantedPicture, name: str, data: bytes) -> None:
        linked = linked_pose(wanted.vehicle, name, wanted.time_s, poses.at(wanted.vehicle, wanted.time_s))
        add_picture(linked or _event_pose(journal, wanted, name), data)

    return PictureRequests(
        links.fleet, system_of=links.system_of, store=store, names=lambda vehicle: _names(journal, vehicle),
        wanted=lambda: wanted_pictures(missing()),
        changed=lambda: events.publish("requests"),
        folder=settings.picture_folder, most_bytes_s=settings.picture_bytes_s,
    )  # fmt: skip


def _names(journal: Journal, vehicle: str) -> PictureNames:
    """The names of a vehicle's pictures that have arrived, and how their numbers match its camera events."""
    name = (packed(vehicle),)
    pictures = journal.rows("SELECT image, time FROM frames WHERE vehicle = ? AND time IS NOT NULL", name)
    events = journal.rows("SELECT number, time FROM exposures WHERE vehicle = ?", name)
    return PictureNames.of(
        [(unpacked(row["image"]), row["time"]) for row in pictures], [(row["number"], row["time"]) for row in events]
    )


def _event_pose(journal: Journal, wanted: WantedPicture, name: str) -> PostedPose:
    """The position of a camera event, with height and angles of the vehicle's picture nearest in time.

    For pictures that the links' poses, which go back some minutes, do not reach.

    Raises:
        InputError: the event has no position.
    """
    vehicle = packed(wanted.vehicle)
    place = journal.one(
        "SELECT lat, lon FROM exposures WHERE vehicle = ? AND number = ? AND lat IS NOT NULL ORDER BY ABS(time - ?)",
        (vehicle, wanted.number, wanted.time_s),
    )
    if place is None:
        raise InputError("its camera event has no position, and the link's are too old")
    near = journal.one(
        "SELECT pose FROM frames WHERE vehicle = ? AND time IS NOT NULL ORDER BY ABS(time - ?)",
        (vehicle, wanted.time_s),
    )
    values: dict[str, Any] = {} if near is None else json.loads(near["pose"])
    values = {k: v for k, v in values.items() if k not in ("origin", "damaged", "gps_fix")}
    values |= {"lat_deg": float(place["lat"]), "lon_deg": float(place["lon"])}
    return PostedPose(wanted.vehicle, name, wanted.time_s, values, {"position": _EVENT, "time": _EVENT})
