"""HTTP routes of the coverage: shares and gaps, gaps as GeoJSON, cells as PNG, flights over gaps."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

from fastapi import FastAPI, HTTPException, Request, Response

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.web.answers import JsonAnswer, in_thread, json_body


class CoverageRoutes:
    """The functions of the routes.

    Args:
        daemon: the daemon with the coverage.
    """

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._threads = ThreadPoolExecutor(2, thread_name_prefix="coverage")

    def install(self, app: FastAPI) -> None:
        """Add the routes."""
        app.add_api_route("/api/coverage", self.coverage)
        app.add_api_route("/api/coverage/gaps.geojson", self.gaps)
        app.add_api_route("/api/coverage/cells.png", self.cells)
        app.add_api_route("/api/coverage/vehicles", self.vehicles)
        app.add_api_route("/api/coverage/flight", self.flight, methods=["POST"], status_code=201)

    async def vehicles(self) -> Response:
        """Vehicles that could fly the gaps: battery, minutes left (null: unknown), and why one cannot at present."""
        return JsonAnswer(await in_thread(self._threads, self._daemon.gap_flights.vehicles))

    async def flight(self, request: Request) -> Response:
        """Plan a flight over the gaps for {"vehicles": {"v1": minutes or null}, "altitude_m": M}; nothing is uploaded.

        Answers the plan's figures with `id` and `names` (the plan's vehicle -> yours). Upload and start it as any plan.
        """
        body = await json_body(request)
        return JsonAnswer(await in_thread(self._threads, self._daemon.gap_flights.plan, body), status_code=201)

    async def coverage(self) -> Response:
        """Coverage of the planned area: `state`, shares, `gaps` (each with area, cause, confidence and polygon).

        `requests`: the pictures that were asked from vehicles, each with `state`, `reason`, `percent`.
        """
        requests = self._daemon.picture_requests
        asked = [] if requests is None else requests.rows()
        return JsonAnswer(self._daemon.coverage.document | {"requests": asked})

    async def gaps(self) -> Response:
        """The gaps as GeoJSON, as `orthoswarm coverage` writes them; `orthoswarm plan --gaps` reads them."""
        return JsonAnswer(self._daemon.coverage.gaps, media_type="application/geo+json")

    async def cells(self, request: Request) -> Response:
        """The states of the cells as a PNG, an overlay with the `corners` of /api/coverage."""
        data: bytes = self._daemon.coverage.png
        if not data:
            raise HTTPException(404, "there is no area yet; plan one, or draw it")
        version: Any = self._daemon.coverage.document["version"]
        headers = {"ETag": f'"{version}"', "Cache-Control": "no-cache"}
        if f'"{version}"' in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        return Response(data, media_type="image/png", headers=headers)
