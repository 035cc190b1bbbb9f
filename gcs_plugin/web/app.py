"""The HTTP API (FastAPI): thin routes over the daemon; blocking calls run in threads."""

import asyncio
import contextlib
import os
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from fastapi import FastAPI, HTTPException, Query, Request, Response, WebSocket
from starlette.responses import FileResponse

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.exports import zipped_folder
from gcs_plugin.daemon.intake.posted_pose import parse_time
from gcs_plugin.daemon.layers.realtime_layer import LATENCY_S
from gcs_plugin.daemon.layers.web_tiles import TileAddress
from gcs_plugin.daemon.store.frame_rows import stage_counts
from gcs_plugin.daemon.store.job_rows import job_counts
from gcs_plugin.web.answers import JsonAnswer, body_of, in_thread, install_error_answers, json_body, parse_json
from gcs_plugin.web.assets import Assets, Packed
from gcs_plugin.web.command_routes import CommandRoutes
from gcs_plugin.web.event_stream import Standstill, stream_events
from gcs_plugin.web.guard import Access, Guard
from gcs_plugin.web.map_services import MapServices
from gcs_plugin.web.people_routes import PeopleRoutes
from gcs_plugin.web.uploads import UploadRoute, read_area
from orthoswarm import __version__
from orthoswarm.compute.workers import peak_rss_mb
from orthoswarm.export.tactical.places import feature
from orthoswarm.report.trust import trust_overlay

Result = TypeVar("Result")
STATIC: Final = Path(__file__).parent / "static"
_TYPES: Final = {"webp": "image/webp", "png": "image/png"}
_MOST_TABLE: Final = 1_000_000  # bytes of a table of surveyed points
_QUANTILES: Final = (0.5, 0.9, 0.99, 1)


class Call(NamedTuple):
    """A route that answers with what a function of the daemon gives; one that changes something gets the JSON body."""

    path: str
    name: str
    function: Callable[..., Any]
    text: str
    method: str = "GET"
    status: int = 200


def calls(daemon: Daemon) -> list[Call]:
    """The routes that do nothing but call a part of a daemon, in a thread."""
    views, plans, console = daemon.views, daemon.plans, daemon.console
    return [
        Call("/api/vehicles", "vehicles", views.vehicles, "Every vehicle that was heard on a link or sent pictures."),
        Call("/api/routes", "routes", daemon.links.routes,
             "The missions that vehicles hold, as points [item, longitude, latitude]; `route` as in /api/vehicles."),
        Call("/api/layers", "layers", views.layers,
             "Layers with versions, bounds (west, south, east, north in degrees) and tile addresses."),
        Call("/api/jobs", "jobs", daemon.jobs.documents, "The latest jobs, oldest first."),
        Call("/api/legs", "legs", views.legs,
             "The legs of refined vehicles as GeoJSON, with state (matched, carried, failed)."),
        Call("/api/completions", "completions", views.completions,
             "Times of vehicles' completions and of their refinements, and the vehicles still flying then."),
        Call("/api/plans", "plans", plans.all, "The figures of all plans."),
        Call("/api/plans", "plan", plans.make,
             'Plan missions for {"area": GeoJSON, "vehicles": N, "altitude_m": M, "fov_min_deg": D, ...}.',
             "POST", 201),
        Call("/api/traffic", "traffic", daemon.links.traffic.rows,
             "Other aircraft that the vehicles' ADS-B receivers hear."),
        Call("/api/plan", "put_console_plan", console.put_plan,
             "Replace the operator's plan; 409 if it has another `version` than the one that was changed.", "PUT"),
        Call("/api/change", "change", daemon.changes.document,
             "Ground that changed since the basemap, as of the last export: `version` (0: nothing yet), shares,"
             " `objects`, the largest first (area, probability, kind, bounds, photos), `corners` of /api/change.png."),
        Call("/api/finds", "finds", console.finds, "Marked finds, oldest first."),
        Call("/api/finds", "add_find", console.add_find,
             "Mark a find: `lat_deg`, `lon_deg`, `sigma_m`, `note`; `time` (ISO 8601) if it was marked before now.",
             "POST", 201),
        Call("/api/points", "points", daemon.points.rows,
             "Surveyed points with their marks in pictures, and how well these fit: `off_m`, `rays_miss_m`, `off_px`."),
        Call("/api/points/marks", "mark_point", daemon.points.mark,
             'Mark a point in a picture: {"name": N, "seq": S, "column": C, "row": R}; null for both takes it away.',
             "POST"),
        Call("/api/coverage/vehicles", "vehicles", daemon.gap_flights.vehicles,
             "Vehicles that could fly the gaps: battery, minutes left (null: unknown), and why one cannot at present."),
        Call("/api/coverage/flight", "flight", daemon.gap_flights.plan,
             'Plan a flight over the gaps for {"vehicles": {"v1": minutes or null}, "altitude_m": M}; nothing is'
             " uploaded.\n\nAnswers the plan's figures with `id` and `names` (the plan's vehicle -> yours). Upload and"
             " start it as any plan.", "POST", 201),
    ]  # fmt: skip


class HttpRoutes:
    """The functions of the routes; `daemon`: the daemon that they call."""

    def __init__(self, daemon: Daemon) -> None:
        self.daemon = daemon
        self._threads = ThreadPoolExecutor(12, thread_name_prefix="http")
        self._tiles = ThreadPoolExecutor(4, thread_name_prefix="tiles")
        self.standstill = Standstill()
        self.uploads = UploadRoute(daemon)
        self.commands = CommandRoutes(daemon, self.standstill)

    def close(self) -> None:
        """Stop the threads."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._tiles.shutdown(wait=False, cancel_futures=True)
        self.uploads.close()
        self.commands.close()

    async def work(self, function: Callable[..., Result], *values: Any, tiles: bool = False) -> Result:
        """Run a function in a thread."""
        return await in_thread(self._tiles if tiles else self._threads, function, *values)

    def install(self, app: FastAPI, call: Call) -> None:
        """Add the route of a call."""

        async def read() -> Response:
            return JsonAnswer(await self.work(call.function), status_code=call.status)

        async def change(request: Request) -> Response:
            return JsonAnswer(await self.work(call.function, await json_body(request)), status_code=call.status)

        app.add_api_route(
            call.path, read if call.method == "GET" else change, methods=[call.method], name=call.name,
            description=call.text, status_code=call.status,
        )  # fmt: skip

    # -- reading --------------------------------------------------------------------------------------------------

    async def health(self) -> Response:
        """Liveness, version, and present problems."""
        problems, waiting = self.daemon.problems(), self.uploads.waiting
        if waiting:
            problems.append(f"{waiting} uploads are waiting; they are accepted as soon as others are done")
        refused = self.daemon.refused.rows()
        return JsonAnswer({"status": "ok", "version": __version__, "problems": problems, "refused": refused})

    async def metrics(self) -> Response:
        """Prometheus text."""
        text = await self.work(prometheus, self.daemon, self.uploads.waiting)
        return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")

    async def frames(
        self,
        vehicle: str | None = None,
        since: str | None = Query(None, description="ISO 8601, or epoch seconds: frames taken then or later"),
        limit: int | None = Query(None, ge=0),
        poses: bool = Query(False, description="with epsg and homography, as in frames.jsonl"),
    ) -> Response:
        """Frames in the order of their arrival."""
        moment = None if since is None else await self.work(_moment, since)
        most = None if limit is None else min(limit, 2**62)  # larger ones do not fit the journal's integers
        rows = await self.work(partial(self.daemon.views.frames, vehicle, moment, most, poses=poses))
        return JsonAnswer(rows)

    async def tile(self, request: Request, *, layer: str, z: int, x: int, y: int, suffix: str) -> Response:
        """A map tile; transparent where there is no picture. The ETag changes with the content."""
        address = TileAddress(z, x, y)
        if layer not in self.daemon.tiles.names or suffix not in _TYPES or not address.valid:
            raise HTTPException(404, "there is no such tile; see /api/layers")
        etag = f'"{await self.work(lambda: self.daemon.tiles.etag(layer, address), tiles=True)}"'
        headers = {"ETag": etag, "Cache-Control": "no-cache"}
        if etag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        data, fresh = await self.work(self.daemon.tiles.tile, layer, address, suffix, tiles=True)
        return Response(data, media_type=_TYPES[suffix], headers=headers | {"ETag": f'"{fresh}"'})

    async def coverage(self) -> Response:
        """Coverage of the planned area: `state`, shares, `gaps` (each with area, cause, confidence and polygon).

        `requests`: the pictures that were asked from vehicles, each with `state`, `reason`, `percent`.
        """
        return JsonAnswer(self.daemon.coverage.result.document | {"requests": self.daemon.picture_requests.rows()})

    async def cells(self, request: Request) -> Response:
        """The states of the cells as a PNG, an overlay with the `corners` of /api/coverage."""
        found = self.daemon.coverage.result
        if not found.png:
            raise HTTPException(404, "there is no area yet; plan one, or draw it")
        headers = {"ETag": f'"{found.document["version"]}"', "Cache-Control": "no-cache"}
        if headers["ETag"] in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        return Response(found.png, media_type="image/png", headers=headers)

    def _trusted(self) -> tuple[int, Path]:
        """Where not to trust the map: the raster of the last export, and its version, 0 if there is none."""
        path = self.daemon.settings.workspace / "confidence.tif"
        exported = path.is_file() and path.with_name("report.json").is_file()  # which is written after it
        return (path.stat().st_mtime_ns // 1_000_000 if exported else 0), path

    async def trust(self) -> Response:
        """How far the map can be trusted, as of the last export: `version` (0: nothing yet), `headline`, `corners`."""
        version, path = self._trusted()
        if not version:
            return JsonAnswer({"version": 0, "headline": "", "corners": None})
        _, corners = await self.work(_overlay, path, version)
        report = parse_json((path.parent / "report.json").read_bytes())
        return JsonAnswer({"version": version, "headline": report.get("headline", ""), "corners": corners})

    async def trust_picture(self) -> Response:
        """Its classes as a PNG, an overlay with the `corners` of /api/trust."""
        version, path = self._trusted()
        if not version:
            raise HTTPException(404, "nothing was refined and exported yet; see /api/jobs")
        data, _ = await self.work(_overlay, path, version)
        return Response(data, media_type="image/png", headers={"ETag": f'"{version}"', "Cache-Control": "no-cache"})

    async def change_picture(self, threshold: float = Query(0.5, gt=0.0, lt=1.0, alias="from")) -> Response:
        """Ground that changed since the basemap, from a probability on, as a PNG with the `corners` of /api/change."""
        found = await self.work(self.daemon.changes.picture, round(threshold, 2))
        if found is None:
            raise HTTPException(404, "nothing was compared with the basemap yet; see /api/jobs")
        data, version = found
        headers = {"ETag": f'"{version}-{threshold:.2f}"', "Cache-Control": "no-cache"}
        return Response(data, media_type="image/png", headers=headers)

    async def gaps(self) -> Response:
        """The gaps as GeoJSON, as `orthoswarm coverage` writes them; `orthoswarm plan --gaps` reads them."""
        return JsonAnswer(self.daemon.coverage.result.gaps, media_type="application/geo+json")

    # -- commands -------------------------------------------------------------------------------------------------

    async def refine(self, request: Request) -> Response:
        """Refine a vehicle ({"vehicle": id}) now, or all ({}). Answers with the jobs."""
        body = await json_body(request)
        vehicle = body.get("vehicle")
        if vehicle is not None and not isinstance(vehicle, str):
            raise HTTPException(422, "vehicle is not text; send the id of a vehicle, or nothing for all")
        jobs = await self.work(self.daemon.requests.refine, vehicle)
        return JsonAnswer([job.document() for job in jobs], status_code=202)

    async def export(self, request: Request) -> Response:
        """Write {"formats": [...]} into the workspace; answers with the job, or with all formats if one is unknown."""
        body = await json_body(request)
        formats = body.get("formats", ["cog", "gpkg"])
        if not isinstance(formats, list) or not all(isinstance(name, str) for name in formats):
            raise HTTPException(422, 'formats is not a list of texts; send for example ["mbtiles", "kmz"]')
        job = await self.work(self.daemon.requests.export, formats)
        return JsonAnswer(job.document(), status_code=202)

    async def exported(self, job: int, kind: str) -> Response:
        """A file of an export job; a folder is sent as a ZIP file."""
        path = await self.work(self._exported, job, kind)
        return FileResponse(path, filename=path.name)

    def _exported(self, number: int, kind: str) -> Path:
        job = self.daemon.jobs.find(number)
        name = None if job is None else job.detail.get("files", {}).get(kind)
        if name is None:
            raise HTTPException(404, "that job has made no such file; see /api/jobs")
        path: Path = self.daemon.settings.workspace / name
        if path.is_dir():
            path = zipped_folder(path)
        if not path.is_file():
            raise HTTPException(404, "the file was removed; export again")
        return path

    async def plan_map(self, number: str) -> Response:
        """A plan as GeoJSON: area, legs, ways, starts."""
        return Response(await self.work(self.daemon.plans.geojson, number), media_type="application/geo+json")

    async def plan_files(self, number: str, drone: str) -> Response:
        """A plan for a drone that a maker's app flies (m300, m3e, litchi ...): a ZIP of its flights and their times."""
        data = await self.work(self.daemon.plans.maker_files, number, drone)
        name = {"Content-Disposition": f'attachment; filename="{number}-{drone}.zip"'}
        return Response(data, media_type="application/zip", headers=name)

    # -- state shared by all open pages ---------------------------------------------------------------------------

    async def console_plan(self) -> Response:
        """The operator's plan, shared by all pages: `area`, `settings`, `plan` (id), `vehicles`, `version`.

        `dem` is the name of the height model that plans follow, null without one.
        """
        dem = self.daemon.plans.dem
        return JsonAnswer(await self.work(self.daemon.console.plan) | {"dem": None if dem is None else dem.name})

    async def change_find(self, number: int, request: Request) -> Response:
        """Change a find's place and note; 409 if it has another `version` than the one that was changed."""
        body = await json_body(request)
        row = await self.work(self.daemon.console.change_find, number, body)
        if row is None:
            raise HTTPException(404, "there is no such find; see /api/finds")
        return JsonAnswer(row)

    async def delete_find(self, number: int) -> Response:
        """Delete a find."""
        if not await self.work(self.daemon.console.delete_find, number):
            raise HTTPException(404, "there is no such find; see /api/finds")
        return Response(status_code=204)

    async def find_pictures(self, number: int) -> Response:
        """The pictures that show a find, best first, see `SightingRow`."""
        return JsonAnswer(await self.work(self.daemon.exports.find_pictures, number))

    async def load_points(self, request: Request) -> Response:
        """Replace the surveyed points by those of a table, sent as the body: gcp_list.txt or CSV (docs/usage.md)."""
        table = await body_of(request, _MOST_TABLE)
        return JsonAnswer(await self.work(self.daemon.points.load, table))

    async def point_pictures(self, name: str = Query(...)) -> Response:
        """The pictures that show a surveyed point, best first, see `SightingRow`."""
        return JsonAnswer(await self.work(self.daemon.points.pictures, name))

    async def gcp_list(self) -> Response:
        """The marks as ODM's gcp_list.txt, for `mosaic --control` and other programs."""
        headers = {"Content-Disposition": 'attachment; filename="gcp_list.txt"'}
        return Response(await self.work(self.daemon.points.gcp_list), media_type="text/plain", headers=headers)

    async def place_pictures(
        self, lat_deg: float = Query(ge=-90.0, le=90.0), lon_deg: float = Query(ge=-180.0, le=180.0)
    ) -> Response:
        """The pictures that show a place, best first, see `SightingRow`."""
        return JsonAnswer(await self.work(self.daemon.exports.pictures_of, lat_deg, lon_deg))

    async def picture(self, seq: int) -> Response:
        """A picture as received; `seq` is its number in /api/frames."""
        return FileResponse(await self.work(self.daemon.exports.picture, seq))

    async def picture_view(self, seq: int) -> Response:
        """A picture as browsers show it: other formats and 16 bits become a JPEG of the same size."""
        shown = await self.work(self.daemon.exports.picture_view, seq)
        return FileResponse(shown) if isinstance(shown, Path) else Response(shown, media_type="image/jpeg")

    async def places(self) -> Response:
        """Finds and vehicles as GeoJSON."""
        found = await self.work(self.daemon.exports.places)
        return JsonAnswer({"type": "FeatureCollection", "features": [feature(place) for place in found]})

    async def events(self, socket: WebSocket) -> None:
        """Live events, and a heartbeat each second."""
        await stream_events(socket, self.daemon.events)


@lru_cache(maxsize=1)
def _overlay(path: Path, _version: int) -> tuple[bytes, list[list[float]]]:
    """See trust_overlay: computed once a version, for all pages and both routes."""
    return trust_overlay(path)


def _moment(text: str) -> float | None:
    try:
        return parse_time(float(text))
    except ValueError:
        return parse_time(text.replace(" ", "+"))  # a plus sign that was not escaped


_FORM: Final = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["image", "pose"],
                    "properties": {
                        "image": {"type": "string", "format": "binary"},
                        "pose": {
                            "type": "string",
                            "description": "JSON: vehicle, image, time, lat_deg, lon_deg, height_m, yaw_deg,"
                            " pitch_deg (-90 looks straight down), roll_deg",
                        },
                    },
                }
            }
        },
    },
    "responses": {"201": {"description": "new, and stored on disk"}, "200": {"description": "already known"}},
}


def make_app(daemon: Daemon, access: Access, address: str = "") -> Any:
    """The ASGI application of a running daemon; `address`: of its page, for those who are invited."""
    routes, people, services = HttpRoutes(daemon), PeopleRoutes(daemon, access, address), MapServices(daemon)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        watching = asyncio.ensure_future(routes.standstill.run())
        yield
        watching.cancel()
        routes.close()

    app = FastAPI(title="OrthoSwarm", version=__version__, lifespan=lifespan, docs_url=None, redoc_url=None)
    install_error_answers(app)
    for call in calls(daemon):
        routes.install(app, call)
    add = app.add_api_route
    add("/healthz", routes.health)
    add("/metrics", routes.metrics)
    add("/api/frames", routes.frames)
    add("/api/frames", routes.uploads.post_frame, methods=["POST"], status_code=201, openapi_extra=_FORM)
    add("/api/refine", routes.refine, methods=["POST"], status_code=202)
    add("/api/export", routes.export, methods=["POST"], status_code=202)
    add("/api/export/{job}/{kind}", routes.exported)
    add("/api/plans/{number}/map", routes.plan_map)
    add("/api/plans/{number}/files/{drone}", routes.plan_files)
    add("/api/plans/{number}/preflight", routes.commands.preflight, methods=["POST"])
    add("/api/plans/{number}/start", routes.commands.start_plan, methods=["POST"], status_code=202)
    add("/api/plans/{number}/start", routes.commands.cancel_start, methods=["DELETE"])
    add("/api/missions/{vehicle:path}/{verb}", routes.commands.mission, methods=["POST"])
    add("/api/areas", read_area, methods=["POST"])
    add("/api/plan", routes.console_plan)
    add("/api/finds/{number}/pictures", routes.find_pictures)
    add("/api/pictures", routes.place_pictures)
    add("/api/points", routes.load_points, methods=["PUT"])
    add("/api/points/pictures", routes.point_pictures)
    add("/api/points/gcp_list.txt", routes.gcp_list)
    add("/api/frames/{seq}/picture", routes.picture)
    add("/api/frames/{seq}/view", routes.picture_view)
    add("/api/places", routes.places)
    add("/api/finds/{number}", routes.change_find, methods=["PUT"])
    add("/api/finds/{number}", routes.delete_find, methods=["DELETE"], status_code=204)
    add("/tiles/{layer}/{z}/{x}/{y}.{suffix}", routes.tile)
    add("/tiles/{layer}/{z}/{x}/{y}.{suffix}", routes.tile, methods=["HEAD"], include_in_schema=False)
    add("/tiles/{layer}.json", services.tilejson)
    add("/wmts", services.wmts)
    add("/api/trust", routes.trust)
    add("/api/trust.png", routes.trust_picture)
    add("/api/change.png", routes.change_picture)
    add("/api/coverage", routes.coverage)
    add("/api/coverage/gaps.geojson", routes.gaps)
    add("/api/coverage/cells.png", routes.cells)
    add("/api/me", people.me)
    add("/api/session", people.join, methods=["POST"])
    add("/api/people", people.people)
    add("/api/people", people.invite, methods=["POST"], status_code=201)
    add("/api/people/{number}", people.revoke, methods=["DELETE"], status_code=204)
    add("/api/holds", people.holds)
    add("/api/holds/{vehicle:path}", people.hold, methods=["POST"])
    add("/api/log", people.log)
    app.add_api_websocket_route("/api/events", routes.events)
    assets = Assets(STATIC)
    for path, answer in (
        ("/", lambda: assets.page("index.html")), ("/docs", lambda: assets.page("docs.html")),
        ("/favicon.ico", lambda: Response(status_code=204)), ("/static/{path:path}", assets.file),
    ):  # fmt: skip
        add(path, answer, include_in_schema=False)
    return Guard(Packed(app), access, daemon.people)


def prometheus(daemon: Daemon, uploads_waiting: int = 0) -> str:
    """All figures, one metric a line with its help and type."""
    lines: list[str] = []

    def metric(name: str, kind: str, text: str, values: list[tuple[dict[str, str], float]]) -> None:
        lines.append(f"# HELP orthoswarm_{name} {text}")
        lines.append(f"# TYPE orthoswarm_{name} {kind}")
        for labels, value in values:
            inner = ",".join(f'{key}="{_escape(label)}"' for key, label in labels.items())
            lines.append(f"orthoswarm_{name}{'{' + inner + '}' if inner else ''} {_number(value)}")

    def single(name: str, kind: str, text: str, value: float) -> None:
        metric(name, kind, text, [({}, value)])

    drawer = daemon.drawer
    metric("info", "gauge", "The program's version.", [({"version": __version__}, 1)])
    single("uptime_seconds", "gauge", "Since the daemon was started.", time.time() - daemon.started)
    stages = stage_counts(daemon.journal).items()
    metric("frames", "gauge", "Frames in the workspace by stage.", [({"stage": stage}, n) for stage, n in stages])
    single(
        "frames_accepted_total", "counter", "Pictures accepted since the start.", sum(daemon.intake.accepted.values())
    )
    single("frames_drawn_total", "counter", "Frames drawn in real time since the start.", drawer.drawn)
    single("frames_late_total", "counter", "Frames drawn later than a second after they came.", drawer.late)
    single("draw_backlog", "gauge", "Frames that wait to be drawn.", drawer.backlog)
    single("draw_put_off", "gauge", "Frames that wait because they would show least.", drawer.put_off)
    text = "Longest time for which newer pictures of a vehicle have come than any that is drawn."
    single("draw_behind_seconds", "gauge", text, drawer.behind_s)
    text = "From a picture's arrival to its pixels in the tiles."
    name, below = "placed_after_seconds", 0
    lines += [f"# HELP orthoswarm_{name} {text}", f"# TYPE orthoswarm_{name} histogram"]
    for bound, count in zip((*map(str, LATENCY_S), "+Inf"), drawer.latency_counts, strict=True):
        below += count
        lines.append(f'orthoswarm_{name}_bucket{{le="{bound}"}} {below}')
    lines += [f"orthoswarm_{name}_sum {drawer.latency_sum:.3f}", f"orthoswarm_{name}_count {below}"]
    recent = sorted(drawer.latencies)
    metric(
        "draw_latency_seconds", "gauge", "From arrival to the map, of the last thousand frames.",
        [({"quantile": str(q)}, recent[min(len(recent) - 1, int(q * len(recent)))]) for q in _QUANTILES if recent],
    )  # fmt: skip
    metric(
        "layer_version", "gauge", "Grows with every change of a layer.",
        [({"layer": name}, layer.version) for name, layer in daemon.layers.items()],
    )  # fmt: skip
    counts = job_counts(daemon.journal)
    metric("jobs", "gauge", "Jobs by kind and state.", [({"kind": k, "state": s}, n) for (k, s), n in counts.items()])
    single("journal_commits_total", "counter", "Commits since the start.", daemon.journal.commits)
    metric(
        "pictures_refused_total", "counter", "Pictures refused, or not on the map, since the start, by cause.",
        [({"cause": cause}, count) for cause, count in daemon.refused.counts.items()],
    )  # fmt: skip
    single("uploads_waiting", "gauge", "Posted pictures that wait for their turn.", uploads_waiting)
    covered = daemon.coverage.result.document
    names = ("seen", "poor", "missed", "planned")
    shares = {name: covered[f"{name}_share"] for name in names}  # type: ignore[literal-required]
    metric(
        "coverage_share", "gauge", "Share of the planned area by state.",
        [({"state": name}, share) for name, share in shares.items() if share is not None],
    )  # fmt: skip
    single("coverage_gaps", "gauge", "Gaps in the planned area.", len(covered["gaps"]))
    single("coverage_seconds", "gauge", "Time that finding the gaps took last.", daemon.coverage.seconds)
    single("problems", "gauge", "Problems at present.", len(daemon.problems()))
    single("cpu_seconds_total", "counter", "CPU time of the daemon's own process.", time.process_time())
    single("resident_megabytes", "gauge", "Memory of the daemon's own process.", _resident_mb())
    return "\n".join(lines) + "\n"


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n").encode("utf-8", "replace").decode()


def _number(value: float) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _resident_mb() -> float:
    """Memory of this process now, megabytes."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, AttributeError):  # not Linux: the largest so far
        return peak_rss_mb()
