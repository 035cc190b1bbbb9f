"""The HTTP API (FastAPI): thin routes over the daemon; everything that waits runs in threads."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, TypeVar

from fastapi import FastAPI, HTTPException, Query, Request, Response, WebSocket, WebSocketDisconnect
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException
from starlette.responses import FileResponse
from starlette.staticfiles import StaticFiles

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.intake.posted_pose import PostedPose, parse_pose, parse_time
from gcs_plugin.daemon.layers.web_tiles import TileAddress
from gcs_plugin.daemon.metrics import prometheus
from gcs_plugin.daemon.takeoffs import names_of
from gcs_plugin.daemon.vehicles import VehicleLinks
from gcs_plugin.web.guard import Guard, TooLarge, bounded
from orthoswarm import __version__
from orthoswarm.model.errors import InputError, OrthoSwarmError

Result = TypeVar("Result")
Linked = TypeVar("Linked")

STATIC: Final = Path(__file__).parent / "static"
MOST_PICTURE_BYTES: Final = 96_000_000
_MOST_JSON_BYTES: Final = 8_000_000
_MOST_POSE_BYTES: Final = 16_000_000
_MOST_UPLOADS: Final = 256
_BACKLOG: Final = 1500
_TYPES: Final = {"webp": "image/webp", "png": "image/png"}


class Ascii(Response):
    """JSON in ASCII, so that any text (lone surrogates included) can be sent."""

    media_type = "application/json"

    def render(self, content: Any) -> bytes:
        """The body."""
        return json.dumps(content, separators=(",", ":"), allow_nan=False).encode("ascii")


class Routes:
    """The routes' functions and what they share.

    Args:
        daemon: what they are about.
    """

    def __init__(self, daemon: Daemon) -> None:
        self.daemon = daemon
        self._threads = ThreadPoolExecutor(12, thread_name_prefix="http")
        self._tiles = ThreadPoolExecutor(4, thread_name_prefix="tiles")
        self._uploads = asyncio.Semaphore(_MOST_UPLOADS)
        self._keys: dict[tuple[str, str], tuple[asyncio.Lock, int]] = {}

    def close(self) -> None:
        """Let go of the threads."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._tiles.shutdown(wait=False, cancel_futures=True)

    async def work(self, function: Callable[..., Result], *values: Any, tiles: bool = False) -> Result:
        """Run a function in a thread; its errors become HTTP answers."""
        pool = self._tiles if tiles else self._threads
        try:
            return await asyncio.get_running_loop().run_in_executor(pool, function, *values)
        except TimeoutError:
            raise HTTPException(504, "the links did not answer in time; try again") from None
        except InputError as error:
            raise HTTPException(422, str(error)) from None
        except OrthoSwarmError as error:
            raise HTTPException(507 if "disk" in str(error) else 409, str(error)) from None

    # -- reading --------------------------------------------------------------------------------------------------

    async def health(self) -> Response:
        """Liveness, version, and what is wrong at present."""
        problems = self.daemon.problems()
        return Ascii({"status": "ok", "version": __version__, "problems": problems})

    async def metrics(self) -> Response:
        """Prometheus text."""
        text = await self.work(prometheus, self.daemon)
        return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")

    async def vehicles(self) -> Response:
        """Every vehicle that was heard on a link or sent pictures."""
        return Ascii(await self.work(self.daemon.vehicles))

    async def frames(
        self,
        vehicle: str | None = None,
        since: str | None = Query(None, description="ISO 8601, or epoch seconds: frames taken then or later"),
        limit: int | None = Query(None, ge=0),
    ) -> Response:
        """Frames in the order in which they came."""
        moment = None if since is None else await self.work(_moment, since)
        most = None if limit is None else min(limit, 2**62)  # larger ones do not fit the journal's integers
        rows = await self.work(self.daemon.frames, vehicle, moment, most)
        return Ascii(rows)

    async def layers(self) -> Response:
        """Layers with versions, bounds (west, south, east, north in degrees) and tile addresses."""
        return Ascii(await self.work(self.daemon.layer_rows))

    async def jobs(self) -> Response:
        """The latest jobs, oldest first."""
        return Ascii(await self.work(lambda: [job.document() for job in self.daemon.jobs.all()]))

    async def tile(self, layer: str, z: int, x: int, y: int, suffix: str, request: Request) -> Response:
        """A map tile; transparent where nothing is drawn. The ETag changes with the content."""
        address = TileAddress(z, x, y)
        if layer not in self.daemon.tiles.names or suffix not in _TYPES or not address.valid:
            raise HTTPException(404, "there is no such tile; see /api/layers")
        etag = f'"{await self.work(lambda: self.daemon.tiles.etag(layer, address), tiles=True)}"'
        headers = {"ETag": etag, "Cache-Control": "no-cache"}
        if etag in request.headers.get("if-none-match", ""):
            return Response(status_code=304, headers=headers)
        data, fresh = await self.work(self.daemon.tiles.tile, layer, address, suffix, tiles=True)
        return Response(data, media_type=_TYPES[suffix], headers=headers | {"ETag": f'"{fresh}"'})

    # -- pictures -------------------------------------------------------------------------------------------------

    async def post_frame(self, request: Request) -> Response:
        """Take a picture with its pose. 201 once it is safe on disk, 200 if it was there already.

        Multipart: file `image`, JSON `pose` with `vehicle`, `image`, `time`, `lat_deg`, `lon_deg`, `height_m`,
        `yaw_deg`, `pitch_deg`, `roll_deg`. Under load the answer waits.
        """
        async with self._uploads:
            pose, data = await self._upload(request)
            while self.daemon.drawer.backlog > _BACKLOG:
                await asyncio.sleep(0.02)
            async with self._one_at_a_time(pose.vehicle, pose.image):
                seq, new = await self.work(self.daemon.add_picture, pose, data)
        body = {"seq": seq, "vehicle": pose.vehicle, "image": pose.image, "new": new}
        return Ascii(body, status_code=201 if new else 200)

    async def _upload(self, request: Request) -> tuple[PostedPose, bytes]:
        """The pose and the picture's bytes of a multipart request."""
        length = request.headers.get("content-length", "0")
        if length.isdigit() and int(length) > MOST_PICTURE_BYTES + _MOST_POSE_BYTES:
            raise HTTPException(413, f"the request is larger than {MOST_PICTURE_BYTES // 1_000_000} MB")
        request._receive = bounded(request.receive, MOST_PICTURE_BYTES + _MOST_POSE_BYTES)
        try:
            form = await request.form(max_files=4, max_fields=8, max_part_size=_MOST_POSE_BYTES)
        except TooLarge as error:
            raise HTTPException(413, str(error)) from None
        except (MultiPartException, ValueError) as error:
            raise HTTPException(400, f"the request is no multipart form ({error})") from None
        except HTTPException as error:
            raise HTTPException(error.status_code, f"the request is no multipart form ({error.detail})") from None
        try:
            image, text = form.get("image"), form.get("pose")
            if not isinstance(image, UploadFile):
                raise HTTPException(422, "the form has no file 'image'; send the picture there")
            if isinstance(text, UploadFile):
                text = (await text.read(_MOST_POSE_BYTES)).decode("utf-8", "replace")
            if not isinstance(text, str):
                raise HTTPException(422, "the form has no 'pose'; send JSON there")
            pose = await self.work(_pose, text, image.filename)
            return pose, await image.read()
        finally:
            await form.close()

    @contextlib.asynccontextmanager
    async def _one_at_a_time(self, vehicle: str, image: str) -> AsyncIterator[None]:
        """The same picture sent twice at once is stored once."""
        key = (vehicle, image)
        lock, users = self._keys.get(key, (asyncio.Lock(), 0))
        self._keys[key] = (lock, users + 1)
        try:
            async with lock:
                yield
        finally:
            lock, users = self._keys[key]
            if users == 1:
                del self._keys[key]
            else:
                self._keys[key] = (lock, users - 1)

    # -- commands -------------------------------------------------------------------------------------------------

    async def refine(self, request: Request) -> Response:
        """Refine a vehicle ({"vehicle": id}) now, or all ({}). Answers with the jobs."""
        body = await self.body(request)
        vehicle = body.get("vehicle")
        if vehicle is not None and not isinstance(vehicle, str):
            raise HTTPException(422, "vehicle is no text; send the id of a vehicle, or nothing for all")
        jobs = await self.work(self.daemon.refine, vehicle)
        return Ascii([job.document() for job in jobs], status_code=202)

    async def export(self, request: Request) -> Response:
        """Write {"formats": [...]} (cog, mbtiles, kmz, gpkg, odm) into the workspace. Answers with the job."""
        body = await self.body(request)
        formats = body.get("formats", ["cog", "gpkg"])
        if not isinstance(formats, list) or not all(isinstance(name, str) for name in formats):
            raise HTTPException(422, 'formats is no list of texts; send for example ["mbtiles", "kmz"]')
        job = await self.work(self.daemon.export, formats)
        return Ascii(job.document(), status_code=202)

    async def exported(self, job: int, kind: str) -> Response:
        """A file that an export job has made; a folder as a ZIP without compression."""
        path = await self.work(self._exported, job, kind)
        return FileResponse(path, filename=path.name)

    def _exported(self, number: int, kind: str) -> Path:
        job = self.daemon.jobs.find(number)
        name = None if job is None else job.detail.get("files", {}).get(kind)
        if name is None:
            raise HTTPException(404, "that job has made no such file; see /api/jobs")
        path: Path = self.daemon.settings.workspace / name
        if path.is_dir():
            import shutil

            zipped = path.with_suffix(".zip")
            shutil.make_archive(str(path), "zip", path)
            path = zipped
        if not path.is_file():
            raise HTTPException(404, "the file was removed; export again")
        return path

    async def legs(self) -> Response:
        """The legs of refined vehicles as GeoJSON, with state (matched, carried, failed)."""
        return Ascii(await self.work(self.daemon.legs))

    async def completions(self) -> Response:
        """When vehicles completed their missions, when their refinement began and ended, who was still flying."""
        return Ascii(await self.work(self.daemon.completions))

    async def plan(self, request: Request) -> Response:
        """Plan missions for {"area": GeoJSON, "vehicles": N, "altitude_m": M, "fov_min_deg": D, ...}."""
        body = await self.body(request)
        return Ascii(await self.work(self.daemon.plans.make, body), status_code=201)

    async def plans(self) -> Response:
        """The figures of all plans."""
        return Ascii(await self.work(self.daemon.plans.all))

    async def plan_map(self, number: str) -> Response:
        """A plan as GeoJSON: area, legs, ways, starts."""
        return Response(await self.work(self.daemon.plans.geojson, number), media_type="application/geo+json")

    async def start_plan(self, number: str, request: Request) -> Response:
        """Start all vehicles of a plan at its times ({"sortie": 1}). Answers with the seconds until each takeoff.

        {"vehicles": {"v1": "alpha"}} says which vehicle flies which part where names differ. A `pause` or `rtl` of a
        vehicle that waits cancels its takeoff, a `start` starts it at once.
        """
        body = await self.body(request)
        takeoffs = self._linked(self.daemon.takeoffs)
        sortie, names = names_of(body)
        seconds = await self.work(takeoffs.begin, number, sortie, names)
        return Ascii({"plan": number, "sortie": sortie, "takeoffs_in_s": seconds}, status_code=202)

    def _linked(self, what: Linked | None) -> Linked:
        if what is None:
            raise HTTPException(409, "the daemon has no links; start it with --link")
        return what

    async def mission(self, vehicle: str, verb: str, request: Request) -> Response:
        """Upload ({"plan": id, "mission": "v1"}), start, pause, resume or rtl. Answers when the vehicle has."""
        body = await self.body(request)
        links = self.daemon.links
        if verb not in ("upload", "start", "pause", "resume", "rtl"):
            raise HTTPException(404, "there is no such command; choose upload, start, pause, resume or rtl")
        text = await self.work(self._command, self._linked(links), vehicle, verb, body)
        return Ascii({"vehicle": vehicle, "command": verb, "ok": True, "text": text})

    def _command(self, links: VehicleLinks, vehicle: str, verb: str, body: dict[str, Any]) -> str:
        system = links.system_of(vehicle)
        if verb == "upload":
            autopilot = links.fleet.vehicles[system].autopilot
            mission = self.daemon.plans.mission(body, vehicle, autopilot)
            return links.command(lambda fleet: fleet.upload(system, mission))
        waited = self._linked(self.daemon.takeoffs).cancel(vehicle)
        if waited is not None and verb in ("pause", "rtl"):
            return f"{vehicle} stays on the ground: its takeoff in {waited:.0f} s is cancelled"
        return links.command(lambda fleet: getattr(fleet, verb)(system))

    async def body(self, request: Request) -> dict[str, Any]:
        """The JSON object of a request; an empty one for an empty body."""
        request._receive = bounded(request.receive, _MOST_JSON_BYTES)
        try:
            data = await request.body()
            document = json.loads(data) if data.strip() else {}
        except TooLarge as error:
            raise HTTPException(413, str(error)) from None
        except (ValueError, RecursionError):
            raise HTTPException(422, "the request is no JSON; send a JSON object") from None
        if not isinstance(document, dict):
            raise HTTPException(422, "the request is no JSON object; send one")
        return document

    async def events(self, socket: WebSocket) -> None:
        """News as JSON texts, one a message: vehicle, frame, job, layer, completion, problem, resync."""
        await socket.accept()
        subscription = self.daemon.events.subscribe()
        reading = asyncio.ensure_future(_until_gone(socket))
        try:
            await socket.send_text(json.dumps({"type": "hello", "version": __version__}))
            while not reading.done():
                getting = asyncio.ensure_future(subscription.get())
                await asyncio.wait({getting, reading}, return_when=asyncio.FIRST_COMPLETED)
                if not getting.done():
                    getting.cancel()
                    break
                for event in getting.result():
                    await socket.send_text(json.dumps(event))
        except (WebSocketDisconnect, RuntimeError):
            pass
        finally:
            reading.cancel()
            self.daemon.events.unsubscribe(subscription)


async def _until_gone(socket: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return


def _moment(text: str) -> float | None:
    try:
        return parse_time(float(text))
    except ValueError:
        return parse_time(text.replace(" ", "+"))  # a plus sign that was not escaped


def _pose(text: str, filename: str | None) -> PostedPose:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("the pose is no JSON; send a JSON object") from None
    return parse_pose(document, filename)


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
    "responses": {"201": {"description": "new, and safe on disk"}, "200": {"description": "was there already"}},
}


def make_app(daemon: Daemon, token: str, bind: str = "127.0.0.1") -> Any:
    """The ASGI application of a daemon that was started."""
    routes = Routes(daemon)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        routes.close()

    app = FastAPI(title="OrthoSwarm", version=__version__, lifespan=lifespan, docs_url=None, redoc_url=None)
    add = app.add_api_route
    add("/healthz", routes.health)
    add("/metrics", routes.metrics)
    add("/api/vehicles", routes.vehicles)
    add("/api/frames", routes.frames)
    add("/api/frames", routes.post_frame, methods=["POST"], status_code=201, openapi_extra=_FORM)
    add("/api/layers", routes.layers)
    add("/api/jobs", routes.jobs)
    add("/api/refine", routes.refine, methods=["POST"], status_code=202)
    add("/api/export", routes.export, methods=["POST"], status_code=202)
    add("/api/export/{job}/{kind}", routes.exported)
    add("/api/legs", routes.legs)
    add("/api/completions", routes.completions)
    add("/api/plans", routes.plans)
    add("/api/plans", routes.plan, methods=["POST"], status_code=201)
    add("/api/plans/{number}/map", routes.plan_map)
    add("/api/plans/{number}/start", routes.start_plan, methods=["POST"], status_code=202)
    add("/api/missions/{vehicle}/{verb}", routes.mission, methods=["POST"])
    add("/tiles/{layer}/{z}/{x}/{y}.{suffix}", routes.tile, methods=["GET", "HEAD"])
    app.add_api_websocket_route("/api/events", routes.events)
    if STATIC.is_dir():
        app.mount("/static", StaticFiles(directory=STATIC), name="static")

    @app.get("/docs", include_in_schema=False)
    async def docs() -> Response:
        return Response((STATIC / "docs.html").read_bytes(), media_type="text/html")

    @app.get("/", include_in_schema=False)
    async def page() -> Response:
        return Response((STATIC / "index.html").read_bytes(), media_type="text/html")

    @app.get("/favicon.ico", include_in_schema=False)
    async def icon() -> Response:
        return Response(status_code=204)

    return Guard(app, token, bind)
