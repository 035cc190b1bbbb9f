"""Uploads of pictures, limited in number in total and per client, with time-outs for stalled ones.

A radio link that is lost leaves an upload incomplete and its connection open. Without a time-out a few hundred of these
would block all further uploads.
"""

import asyncio
import contextlib
import json
import tempfile
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any, Final

from fastapi import HTTPException, Query, Request, Response
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException
from starlette.requests import ClientDisconnect

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.intake.posted_pose import PostedPose, parse_pose
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.store.picture_store import MOST_PICTURE_BYTES
from gcs_plugin.plans.area_files import read_shapes
from gcs_plugin.web.answers import JsonAnswer, body_of, in_thread
from gcs_plugin.web.guard import TooLarge, bounded
from orthoswarm.model.errors import InputError, StorageError
from orthoswarm.planning.area.shape_files import Ring

_MOST_POSE_BYTES: Final = 16_000_000
_SHORT_POSE: Final = 65_536  # bytes
_THREADS: Final = 12  # pictures that are being stored


@dataclass(frozen=True, slots=True)
class UploadLimits:
    """Limits of uploads.

    Attributes:
        most: simultaneous uploads. share: simultaneous uploads of one client (address); further ones wait.
        idle_s: seconds without a byte after which an upload is aborted. slow_s: seconds after which its mean rate must
            be at least `least_bytes_s` bytes per second.
    """

    most: int = 256
    share: int = 128
    idle_s: float = 10.0
    slow_s: float = 30.0
    least_bytes_s: float = 1000.0


class UploadRoute:
    """The route that receives pictures.

    Args:
        daemon: stores them. limits: see UploadLimits.

    Attributes:
        waiting: number of uploads that are waiting.
    """

    def __init__(self, daemon: Daemon, limits: UploadLimits = UploadLimits()) -> None:
        self._daemon, self._limits = daemon, limits
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="uploads")
        self._turn = asyncio.Condition()
        self._total, self._by_client = 0, Counter[str]()
        self._names: dict[tuple[str, str], tuple[asyncio.Lock, int]] = {}
        self.waiting = 0

    def close(self) -> None:
        """Stop the threads."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def post_frame(self, request: Request) -> Response:
        """Upload a picture with its pose. 201 once it is stored on disk, 200 if it was already known.

        Multipart: file `image`, JSON `pose` with `vehicle`, `image`, `time`, `lat_deg`, `lon_deg`, `height_m`,
        `yaw_deg`, `pitch_deg`, `roll_deg`; `gps_fix` (MAVLink's GPS_FIX_TYPE) if known. An upload without a byte for
        10 s is aborted with 408.
        """
        refused = self._daemon.refused
        async with self._slot(request):
            pose, data = await self._upload(request)
            async with self._one_at_a_time(pose.vehicle, pose.image):
                try:
                    seq, new = await in_thread(self._threads, self._daemon.intake.add, pose, data)
                except InputError as error:
                    refused.note("picture", str(error), pose.vehicle, pose.image)
                    raise
                except StorageError as error:
                    refused.note("disk", str(error), pose.vehicle, pose.image)
                    raise
        body = {"seq": seq, "vehicle": pose.vehicle, "image": pose.image, "new": new}
        return JsonAnswer(body, status_code=201 if new else 200)

    @contextlib.asynccontextmanager
    async def _slot(self, request: Request) -> AsyncIterator[None]:
        """Wait until the client may upload."""
        client = request.client.host if request.client else ""
        limits = self._limits
        self.waiting += 1
        try:
            async with self._turn:
                await self._turn.wait_for(
                    lambda: self._total < limits.most and self._by_client[client] < limits.share
                )  # fmt: skip
                self._total += 1
                self._by_client[client] += 1
        finally:
            self.waiting -= 1
        try:
            yield
        finally:
            self._total -= 1
            self._by_client[client] -= 1
            if not self._by_client[client]:
                del self._by_client[client]
            async with self._turn:
                self._turn.notify_all()

    async def _upload(self, request: Request) -> tuple[PostedPose, bytes]:
        """The pose and the picture's bytes of a multipart request."""
        try:
            return await self._read(request)
        except TooLarge as error:
            raise self._refuse(413, "picture", str(error)) from None
        except TimeoutError:
            text = "the upload stalled or was slower than 1 kB/s; send it again when the radio is better"
            raise self._refuse(408, "time", text, {"Connection": "close"}) from None
        except ClientDisconnect:
            raise self._refuse(400, "time", "the upload is incomplete; send it again") from None
        except InputError as error:
            self._daemon.refused.note("pose", str(error))
            raise

    def _refuse(self, status: int, cause: str, text: str, headers: dict[str, str] | None = None) -> HTTPException:
        self._daemon.refused.note(cause, text)
        return HTTPException(status, text, headers)

    async def _read(self, request: Request) -> tuple[PostedPose, bytes]:
        length = request.headers.get("content-length", "0")
        if length.isdigit() and int(length) > MOST_PICTURE_BYTES + _MOST_POSE_BYTES:
            raise TooLarge(f"the request is larger than {MOST_PICTURE_BYTES // 1_000_000} MB; send a smaller picture")
        receive = moving(request.receive, self._limits)
        request._receive = bounded(receive, MOST_PICTURE_BYTES + _MOST_POSE_BYTES)
        try:
            form = await request.form(max_files=4, max_fields=8, max_part_size=_MOST_POSE_BYTES)
        except (MultiPartException, ValueError) as error:
            raise InputError(f"the request is not a multipart form ({error}); send image and pose as one") from None
        except HTTPException as error:
            raise HTTPException(error.status_code, f"the request is not a multipart form ({error.detail})") from None
        try:
            image, text = form.get("image"), form.get("pose")
            if not isinstance(image, UploadFile):
                raise InputError("the form has no file 'image'; send the picture there")
            if isinstance(text, UploadFile):
                text = (await text.read(_MOST_POSE_BYTES)).decode("utf-8", "replace")
            if not isinstance(text, str):
                raise InputError("the form has no 'pose'; send JSON there")
            if len(text) <= _SHORT_POSE:  # a wait for a thread would take longer than parsing it
                return _pose(text, image.filename), await image.read()
            return await in_thread(self._threads, _pose, text, image.filename), await image.read()
        finally:
            await form.close()

    @contextlib.asynccontextmanager
    async def _one_at_a_time(self, vehicle: str, image: str) -> AsyncIterator[None]:
        """Serialise uploads of the same picture, so that it is stored once."""
        key = (vehicle, image)
        lock, users = self._names.get(key, (asyncio.Lock(), 0))
        self._names[key] = (lock, users + 1)
        try:
            async with lock:
                yield
        finally:
            lock, users = self._names[key]
            if users == 1:
                del self._names[key]
            else:
                self._names[key] = (lock, users - 1)


def moving(receive: Callable[[], Awaitable[Any]], limits: UploadLimits) -> Callable[[], Awaitable[Any]]:
    """An ASGI receive that raises TimeoutError if a body stalls, or its mean rate is too low."""
    loop = asyncio.get_running_loop()
    began, size = loop.time(), 0

    async def receiving() -> Any:
        nonlocal size
        async with asyncio.timeout(limits.idle_s):
            message = await receive()
        size += len(message.get("body", b""))
        took = loop.time() - began
        if message.get("more_body") and took > limits.slow_s and size < took * limits.least_bytes_s:
            raise TimeoutError
        return message

    return receiving


def _pose(text: str, filename: str | None) -> PostedPose:
    try:
        document = json.loads(text)  # a NaN is refused with its name
    except (ValueError, RecursionError):
        raise InputError("the pose is not JSON; send a JSON object") from None
    return parse_pose(document, filename)


MOST_BYTES: Final = 20_000_000
_MOST_NAME: Final = 200  # characters
_LARGE_BYTES: Final = 300_000
"""Larger files take longer than a tenth of a second (chosen), less than the start of a process."""
_FIELDS: Final = frozenset({"altitude_m", "fov_min_deg", "side_overlap", "forward_overlap"})
"""What of a survey has a field on the page."""
_ZIP: Final = b"PK\x03\x04"  # whose size says nothing of what is in it
_ELSEWHERE: Final = ThreadPoolExecutor(1, thread_name_prefix="areas")  # one such process at a time


async def read_area(
    request: Request, name: str = Query(..., description="the file's name; its ending says what it is")
) -> Response:
    """Read an area file, sent as the body.

    GeoJSON, KML, KMZ, zipped shapefile, GeoPackage, QGroundControl .plan. Answers `polygons` (each a list of closed
    rings of [longitude, latitude], the outline first), `lines`, `no_fly` (closed rings: exclusion fences), `settings`
    of a survey as fields of a plan's request, and in words what else it holds, `unused`.
    """
    data = await body_of(request, MOST_BYTES)
    named = (data, name[:_MOST_NAME])
    if len(data) <= _LARGE_BYTES and not data.startswith(_ZIP):
        answer = await asyncio.to_thread(_answer, named)
    else:
        answer = await in_thread(_ELSEWHERE, _answer_elsewhere, named)
    return Response(answer, media_type="application/json")


def _answer_elsewhere(named: tuple[bytes, str]) -> bytes:
    with closing(WorkerPool(1)) as pool:
        return pool.run(_answer, named)


def _answer(named: tuple[bytes, str]) -> bytes:
    """The JSON text for a file's content and name."""
    return json.dumps(area_of(*named), separators=(",", ":"), allow_nan=False).encode("ascii")


def area_of(data: bytes, name: str) -> dict[str, Any]:
    """The content of an area file as JSON values; see `read_area`; raises InputError: it cannot be read."""
    with tempfile.TemporaryDirectory(prefix="orthoswarm-") as folder:
        suffix = PurePath(name).suffix.lower()
        path = Path(folder) / f"area{suffix if suffix.isascii() and suffix[1:].isalnum() else ''}"
        path.write_bytes(data)
        shapes, zones, _, survey = read_shapes(path, name)
    settings = {value.field: value.value for value in survey.values if value.field in _FIELDS}
    unplanned = [value.words for value in survey.values if value.field not in _FIELDS]
    return {
        "polygons": [[_closed(ring) for ring in (polygon.shell, *polygon.holes)] for polygon in shapes.areas],
        "lines": [[[lon, lat] for lat, lon in line.tolist()] for line in shapes.lines],
        "no_fly": [_closed(zone) for zone in zones],
        "settings": settings,
        "unused": [*shapes.left, *shapes.doubts, *unplanned, *survey.left],
    }


def _closed(ring: Ring) -> list[list[float]]:
    points = [[lon, lat] for lat, lon in ring.tolist()]
    return [*points, points[0]]
