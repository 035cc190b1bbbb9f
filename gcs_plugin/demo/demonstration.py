"""The steps of `orthoswarm demo`: city, plan, flight, map, refinement at each completion, accuracy at the end."""

import contextlib
import json
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.demo.simulated_camera import FOV_MIN_DEG, HEIGHT_M, DemoSetting
from orthoswarm.compute.workers import spawn_context, starting_processes
from orthoswarm.model.errors import InputError, OrthoSwarmError

if TYPE_CHECKING:
    from gcs_plugin.daemon.daemon import Daemon

_MARKER_FILE: Final = "demo.json"
_DEMO_FILES: Final = (
    "journal.db", "journal.db-wal", "journal.db-shm", "pictures", "layers", "solutions", "plans", "videos", "twin",
    "token", "telemetry.tlog", "export", "report.json", "report.html", "frames.jsonl", "footprints.gpkg",
    "realtime.tif", "coarse.tif", "orthoimage.tif", "confidence.tif", _MARKER_FILE,
)  # fmt: skip
_STILL_S: Final = 600.0  # in which a machine that is twenty times slower than usual does the longest step
ReportProgress = Callable[[str, int, int], None]
_STARTS: Final = 2.5  # vehicle seconds in a second, at most, while vehicles start: their dialogues take real time
_START_ATTEMPTS: Final = 20  # on a busy machine a vehicle's state may be older than a start accepts
_SLOWEST: Final = 0.4  # vehicle seconds in a second: heartbeats then come often enough for a vehicle not to be lost
_TO_RENDER: Final = 4  # pictures that may wait while the vehicles fly as fast as they are asked to
_TO_DRAW: Final = 24  # the same, of those in streams and queues
_SAID_S: Final = 0.05
_LAST_S: Final = 60.0  # without a picture: those are lost that were under way as a reader took its stream for dead
_KEPT: Final = 0.7  # of the speed that was asked for: a flight that keeps less is told


def run_demo(
    setting: DemoSetting, out: Path, report: ReportProgress, *, port: int = 0, opened: Callable[[str], None],
    prepare: Callable[[ReportProgress], None],
) -> dict[str, Any]:  # fmt: skip
    """Run the demonstration and return the content of report.json.

    Args:
        setting: number of vehicles, seed, speed.
        out: workspace of the daemon; an earlier demonstration in it is replaced.
        report: called with a stage's name, the number of finished items and their total.
        port: of the web page.
        opened: called with the page's address.
        prepare: called with `report` before the flight; makes the machine ready for it.

    Raises:
        InputError: the folder contains other files.
        OrthoSwarmError: the demonstration failed or did not go on.
    """
    _clear(out)
    began = time.monotonic()
    with _Simulator(setting, out / "twin") as simulator:
        prepare(report)
        made = partial(getattr, simulator, "stage")
        wait_for(lambda: simulator.hear().addresses, "the city", made, lambda: report(*simulator.stage))
        with _daemon(setting, out, simulator.addresses) as daemon, Served(daemon, port) as served:
            opened(served.url)
            _fly(daemon, setting, simulator, report)
            taken = simulator.taken
            simulator.close()
            _finish(daemon, report)
    report("measuring", 0, 1)
    result = _measure(setting, out, taken, time.monotonic() - began)
    report("measuring", 1, 1)
    return result


class _Simulator:
    """The process of the city, its vehicles and their cameras, and what `hear` heard of it.

    Attributes:
        addresses: of the vehicles' links and video streams, empty until the city is there.
        stage: of the city's making: name, number of finished items, and their total.
        flown_s: seconds on the vehicles' clock. taken: pictures so far.
    """

    def __init__(self, setting: DemoSetting, folder: Path) -> None:
        context = spawn_context()
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=simulate, args=(setting, folder, theirs), name="simulator", daemon=True)
        with starting_processes():
            self._process.start()
        theirs.close()
        self.addresses: dict[str, list[str]] = {}
        self.stage: tuple[str, int, int] = ("city", 0, 1)
        self.flown_s, self.taken = 0.0, 0

    def tell(self, drawn: int, fastest: float) -> None:
        """Say how many pictures are on the map, and how many vehicle seconds may pass in a second."""
        with contextlib.suppress(OSError):  # `hear` says why it has ended
            self._pipe.send((drawn, fastest))

    def hear(self) -> "_Simulator":
        """Take in what it has told; returns itself."""
        try:
            while self._pipe.poll(0.0):
                told = self._pipe.recv()
                if "problem" in told:
                    raise OrthoSwarmError(f"a simulated camera failed: {told['problem']}")
                for name, value in told.items():
                    setattr(self, name, value)
        except (EOFError, OSError):
            raise OrthoSwarmError("the simulated swarm has ended by itself; run the demonstration again") from None
        return self

    def __enter__(self) -> "_Simulator":
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        if kind is not None:
            self._process.terminate()  # while it builds its city it does not read the pipe
        self.close()

    def close(self) -> None:
        """End it."""
        self._pipe.close()
        self._process.join(10.0)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join(10.0)


def _clear(out: Path) -> None:
    """Remove an earlier demonstration from a folder; a folder with other files is refused."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; choose a folder for --out")
    if out.exists() and any(out.iterdir()) and not (out / _MARKER_FILE).exists():
        raise InputError(f"{out} contains other files; choose an empty folder for --out")
    out.mkdir(parents=True, exist_ok=True)
    for name in _DEMO_FILES:
        path = out / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    (out / _MARKER_FILE).write_text("{}\n")


def _daemon(setting: DemoSetting, out: Path, addresses: dict[str, list[str]]) -> "Daemon":
    from gcs_plugin.daemon.daemon import Daemon
    from gcs_plugin.daemon.settings import Settings, VehicleSettings
    from orthoswarm.compute.workers import cores

    vehicles = tuple(VehicleSettings(f"v{n}", n, "", url) for n, url in enumerate(addresses["streams"], start=1))
    settings = Settings(
        workspace=out, links=tuple(addresses["links"]), basemap=out / "twin" / "basemap.tif", fov_min_deg=FOV_MIN_DEG,
        workers=max(1, cores() - 1), vehicles=vehicles,
    )  # fmt: skip
    return Daemon(settings)


class Served:
    """The daemon's web server in a thread; `url`: the page's address, with the token."""

    def __init__(self, daemon: "Daemon", port: int) -> None:
        import uvicorn

        from gcs_plugin.web.app import make_app
        from gcs_plugin.web.guard import Access, take_token

        token = take_token(daemon.settings.workspace / "token")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind(("127.0.0.1", port))
            self._socket.listen()  # a browser may connect before the server's loop runs
        except OSError as error:
            self._socket.close()
            raise InputError(f"port {port} cannot be served ({error.strerror}); choose another --port") from None
        self.url = f"http://127.0.0.1:{self._socket.getsockname()[1]}/#token={token}"
        config = uvicorn.Config(
            make_app(daemon, Access(token)), log_level="warning", access_log=False, server_header=False,
            timeout_graceful_shutdown=2,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [self._socket]}, daemon=True)

    def __enter__(self) -> "Served":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.should_exit = True
        self._thread.join(15.0)
        self._socket.close()


def _fly(daemon: "Daemon", setting: DemoSetting, simulator: _Simulator, report: ReportProgress) -> None:
    """Plan, upload, start one after the other, and wait until all have completed and their pictures are on the map."""
    links = daemon.links

    def heard() -> int:
        return sum(row["lat_deg"] is not None for row in links.rows())

    def fly_on(fastest: float) -> None:
        simulator.hear().tell(daemon.drawer.drawn, fastest)
        report("connecting vehicles", heard(), setting.vehicles)

    starting = min(_STARTS, setting.speed)
    wait_for(lambda: heard() == setting.vehicles, "the vehicles", heard, lambda: fly_on(starting))
    report("planning", 0, 1)
    starts = [[row["lat_deg"], row["lon_deg"]] for row in links.rows()]
    body = {
        "area": setting.area(), "vehicles": setting.vehicles, "altitude_m": HEIGHT_M, "fov_min_deg": FOV_MIN_DEG,
        "speed_m_s": 12.0, "forward_overlap": 0.8, "side_overlap": 0.6, "method": "columns", "starts": starts,
        "end": "rtl", "separation_m": 4.0,
    }  # fmt: skip
    plan = daemon.plans.make(body)
    report("planning", 1, 1)
    photos = sum(vehicle["photos"] for vehicle in plan["vehicles"])
    delays = {v["id"]: v["flights"][0]["start_s"] for v in plan["vehicles"]}
    began = simulator.hear().flown_s

    def shown(fastest: float) -> None:
        # The map in flight is placed leg by leg, in real time: faster vehicles would be home before.
        legs = sum(job.kind == "coarse" and job.state in ("queued", "running") for job in daemon.jobs.all())
        simulator.tell(daemon.drawer.drawn, fastest / (1 + legs))
        report("pictures on the map", min(daemon.drawer.drawn, photos - 1), photos)

    def moved() -> tuple[float, ...]:
        drawn, flown_s, taken = daemon.drawer.drawn, simulator.hear().flown_s, simulator.taken
        # The clock counts while no picture waits: a daemon that draws no more is not taken for one that waits for more.
        return len(daemon.views.completions()), taken, drawn, flown_s * (drawn >= taken)

    for number, vehicle in enumerate(sorted(delays, key=lambda name: delays[name]), start=1):
        # with the planned delays, at least 6 s, so that one vehicle completes while others still fly
        due = began + max(delays[vehicle], 6.0 * (number - 1))
        wait_for(partial(_flown, simulator, due), f"the start of {vehicle}", moved, partial(shown, starting))
        _start_vehicle(daemon, plan["id"], vehicle)
        report("starting", number, setting.vehicles)

    drawn, drawn_at = 0, time.monotonic()

    def done() -> bool:
        nonlocal drawn, drawn_at
        if daemon.drawer.drawn != drawn:
            drawn, drawn_at = daemon.drawer.drawn, time.monotonic()
        all_there = drawn >= simulator.taken or time.monotonic() - drawn_at > _LAST_S
        return all_there and len(daemon.views.completions()) >= setting.vehicles

    began, flown = time.monotonic(), simulator.hear().flown_s
    wait_for(done, "the missions' completion", moved, partial(shown, setting.speed))
    report("pictures on the map", photos, photos)
    if drawn < simulator.taken:
        report("pictures lost with a stream that was silent and opened again", simulator.taken - drawn, 1)
    rate = (simulator.flown_s - flown) / (time.monotonic() - began)
    if rate < _KEPT * setting.speed:
        report(f"flown at {rate:.1f} of real time instead of {setting.speed:.1f}, as fast as this machine draws", 1, 1)


def _flown(simulator: _Simulator, due_s: float) -> bool:
    return simulator.flown_s >= due_s


def _start_vehicle(daemon: "Daemon", plan: str, vehicle: str) -> None:
    """Upload a vehicle's mission and start it; again while the machine is too busy for that."""
    links = daemon.links
    system = links.fleet.system_of(vehicle)
    mission = daemon.plans.mission({"plan": plan}, vehicle, links.fleet.vehicles[system].autopilot)
    for attempt in range(1, _START_ATTEMPTS + 1):
        try:
            links.upload(system, mission)
            links.finish(links.fleet.call(partial(links.fleet.start, system)))
            return
        except OrthoSwarmError:
            if any(row["id"] == vehicle and row["mission"]["phase"] == "active" for row in links.rows()):
                return  # only its answer was late
            if attempt == _START_ATTEMPTS:
                raise
        time.sleep(1.0)


def _finish(daemon: "Daemon", report: ReportProgress) -> None:
    """Wait until every completion's refinement is on the map, and the products are written."""

    def moved() -> list[tuple[object, ...]]:
        return [(job.id, job.state, job.progress, job.message) for job in daemon.jobs.all()]

    def tell() -> None:
        jobs = daemon.jobs.all()
        failed = [job for job in jobs if job.state == "failed" and job.kind != "coarse"]
        if failed:
            raise OrthoSwarmError(f"the {failed[0].kind} of {failed[0].vehicle} failed: {failed[0].message}")
        report("refining", sum(job.state not in ("queued", "running") for job in jobs), len(jobs))

    wait_for(lambda: _refined(daemon), "the refinement", moved, tell)
    tell()
    report("products", 0, 1)
    job = daemon.requests.export(["cog", "gpkg", "mbtiles", "kmz"])

    def exported() -> bool:
        found = daemon.jobs.find(job.id)
        return found is not None and found.state in ("done", "failed")

    wait_for(exported, "the export", moved, lambda: report("products", 0, 1))
    report("products", 1, 1)


def _refined(daemon: "Daemon") -> bool:
    return all("version" in row for row in daemon.views.completions()) and not daemon.jobs.open()


def wait_for(done: Callable[[], object], what: str, moved: Callable[[], object], tell: Callable[[], None]) -> None:
    """Wait for something, however long it takes, as long as anything moves towards it.

    Args:
        done: whether it is there. what: its name.
        moved: a value that is another one after each step. tell: called again and again, to show how far it is.
    """
    last, since = moved(), time.monotonic()
    while not done():
        tell()
        now = moved()
        if now != last:
            last, since = now, time.monotonic()
        elif time.monotonic() - since > _STILL_S:
            raise OrthoSwarmError(f"{what}: nothing has moved for {_STILL_S:.0f} s; run the demonstration again")
        time.sleep(0.1)


def _measure(setting: DemoSetting, out: Path, taken: int, wall_s: float) -> dict[str, Any]:
    """Compare the orthoimages with the truth and add the figures to the report."""
    from orthoswarm.evaluation.orthoimage import evaluate_ortho, find_mask
    from orthoswarm.export.product_files import write_json

    reference = out / "twin" / "truth" / "reference.tif"
    report: dict[str, Any] = json.loads((out / "report.json").read_text(encoding="utf-8"))
    figures = {
        name: evaluate_ortho(out / file, reference, find_mask(reference, None)).figures()
        for name, file in (("realtime", "realtime.tif"), ("orthoimage", "orthoimage.tif"))
    }
    about = {"vehicles": setting.vehicles, "seed": setting.seed, "pictures": taken, "wall_s": wall_s}
    report |= {"accuracy": figures["orthoimage"], "accuracy_realtime": figures["realtime"], "demo": about}
    write_json(out / "report.json", report)
    return report


class PacedClock:
    """A clock that slows down while pictures wait: a slow machine flies slower and loses no picture.

    Attributes:
        share: seconds on it in a real second.
    """

    def __init__(self) -> None:
        self._real, self._now, self.share = time.monotonic(), 0.0, 1.0
        self._lock = threading.Lock()

    def __call__(self) -> float:
        """Simulated seconds since the start."""
        with self._lock:
            real = time.monotonic()
            self._now += (real - self._real) * self.share
            self._real = real
            return self._now


def vehicle_rate(fastest: float, to_render: int, to_draw: int) -> float:
    """Vehicle seconds in a second, at most the fastest, while so many pictures wait to be rendered or to be drawn."""
    behind = max(1.0, to_render / _TO_RENDER, to_draw / _TO_DRAW)
    return max(fastest / behind**2, min(fastest, _SLOWEST))


def simulate(setting: DemoSetting, folder: Path, pipe: Connection) -> None:
    """Make the twin in a folder and fly over it until the pipe is closed.

    Sends attributes of `_Simulator`: its "stage", "addresses", again and again "flown_s" and "taken", or a "problem".
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # not all systems inherit this from the parent process
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    from gcs_plugin.demo.simulated_camera import RenderQueue, TwinCamera, VideoServer
    from gcs_plugin.sim.multirotor import Airframe
    from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
    from orthoswarm.twin.make import make_scene

    try:
        made = make_scene(setting.twin, folder, lambda *stage: pipe.send({"stage": stage}))
    except OSError:  # the demonstration has ended already
        return
    systems = range(1, setting.vehicles + 1)
    renderer = RenderQueue(
        cameras={s: TwinCamera(made.stage, made.site, setting, s, rays=1) for s in systems},
        servers={s: VideoServer() for s in systems},
    )
    airframe = Airframe(climb_m_s=8.0, sink_m_s=6.0, gps_sigma_m=0.8)
    vehicles = make_swarm(
        setting.vehicles, home=setting.home(), airframe=airframe, seed=setting.seed, on_exposure=renderer.expose
    )
    clock = PacedClock()
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=setting.speed, clock=clock) as swarm, contextlib.suppress(
        EOFError, OSError  # the demonstration has ended
    ):  # fmt: skip
        streams = [renderer.servers[s].url for s in systems]
        pipe.send({"addresses": {"links": swarm.addresses, "streams": streams}})
        while not renderer.problem:
            while pipe.poll(_SAID_S):
                drawn, fastest = pipe.recv()
                rate = vehicle_rate(fastest, renderer.backlog, renderer.taken - drawn)
                clock.share = rate / setting.speed
            pipe.send({"flown_s": swarm.now, "taken": renderer.taken})
        pipe.send({"problem": renderer.problem})
    renderer.close()
