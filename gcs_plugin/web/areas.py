"""Reading an uploaded area file with the reader of the command line; a large one in a process of its own.

Read here it would hold up all other requests: much of the work is done by calls that no other thread interrupts.
"""

import asyncio
import json
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path, PurePath
from typing import Any, Final

from fastapi import Query, Request, Response

from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.plans.area_files import read_shapes
from gcs_plugin.web.answers import body_of, in_thread
from orthoswarm.planning.area.shape_files import Ring

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
        "unused": [*shapes.left, *unplanned, *survey.left],
    }


def _closed(ring: Ring) -> list[list[float]]:
    points = [[lon, lat] for lat, lon in ring.tolist()]
    return [*points, points[0]]
