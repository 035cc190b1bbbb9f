"""The steps of `orthoswarm demo`: city, plan, flight, map, refinement at each completion, accuracy at the end."""

import json
import multiprocessing.process
import multiprocessing.resource_tracker
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from gcs_plugin.demo.setting import FOV_MIN_DEG, HEIGHT_M, DemoSetting
from orthoswarm.compute.workers import spawn_context
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.twin.make import make_twin

if TYPE_CHECKING:
    from gcs_plugin.daemon.daemon import Daemon

_MARKER_FILE: Final = "demo.json"
_DEMO_FILES: Final = (
    "journal.db", "journal.db-wal", "journal.db-shm", "pictures", "layers", "solutions", "plans", "videos", "twin",
    "token", "telemetry.tlog", "export", "report.json", "report.html", "frames.jsonl", "footprints.gpkg",
    "realtime.tif", "coarse.tif", "orthoimage.tif", _MARKER_FILE,
)  # fmt: skip
_MOST_S: Final = 900.0
ReportProgress = Callable[[str, int, int], None]
_MOST_WAITING: Final = 4  # pictures
_SLOW_RATE: Final = 0.15  # times real time while cameras lag behind
_BEHIND_S: Final = 0.05


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
        OrthoSwarmError: the demonstration failed or did not finish in time.
    """
    _clear(out)
    began = time.monotonic()
    context = spawn_context()
    ours, theirs = context.Pipe()
    process = context.Process(target=simulate, args=(setting, theirs), name="simulator", daemon=True)
    _start(process)
    theirs.close()
    try:
        report("city", 0, 1)
        make_twin(setting.twin, out / "twin", only=0)  # the map before the disaster and the truth after it, no photos
        report("city", 1, 1)
        prepare(report)
        addresses = _receive_addresses(ours, process)
        with _daemon(setting, out, addresses) as daemon, Served(daemon, port) as served:
            opened(served.url)
            _fly(daemon, setting, report)
            ours.send("stop")
            end = ours.recv() if ours.poll(90.0) else {}
            _finish(daemon, report)
    except BaseException:
        process.terminate()  # while it builds its city it does not read the pipe
        raise
    finally:
        ours.close()
        process.join(10.0)
        if process.is_alive():
            process.terminate()
            process.join(10.0)
    if end.get("problem"):
        raise OrthoSwarmError(f"a simulated camera failed: {end['problem']}")
    report("measuring", 0, 1)
    result = _measure(setting, out, end, time.monotonic() - began)
    report("measuring", 1, 1)
    return result


def _start(process: multiprocessing.process.BaseProcess) -> None:
    """Start a process that ignores Ctrl-C in the terminal; this process terminates it.

    SIGINT is blocked meanwhile, not ignored: one that arrives now is delivered afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows: the simulator ignores the signal itself once it runs
        process.start()
        return
    multiprocessing.resource_tracker.ensure_running()  # starting it later would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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


def _receive_addresses(pipe: Any, process: Any) -> dict[str, list[str]]:
    """Addresses of the simulator's links and video streams, which it sends once it is ready."""
    end = time.monotonic() + 180.0
    while time.monotonic() < end:
        if pipe.poll(0.2):
            addresses: dict[str, list[str]] = pipe.recv()
            return addresses
        if not process.is_alive():
            break
    raise OrthoSwarmError("the simulated swarm did not start; run the demonstration again")


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
    """The daemon's web server in a thread.

    Attributes:
        url: the page's address, with the token.
    """

    def __init__(self, daemon: "Daemon", port: int) -> None:
        import uvicorn

        from gcs_plugin.web.app import make_app
        from gcs_plugin.web.guard import take_token

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
            make_app(daemon, token), log_level="warning", access_log=False, server_header=False,
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


def _fly(daemon: "Daemon", setting: DemoSetting, report: ReportProgress) -> None:
    """Plan, upload, start one after the other, and wait until all have completed."""
    links = daemon.links
    _wait(lambda: sum(row["lat_deg"] is not None for row in links.rows()) == setting.vehicles, 60.0, "the vehicles")
    report("planning", 0, 1)
    starts = [[row["lat_deg"], row["lon_deg"]] for row in links.rows()]
    body = {
        "area": setting.area(), "vehicles": setting.vehicles, "altitude_m": HEIGHT_M, "fov_min_deg": FOV_MIN_DEG,
        "speed_m_s": 12.0, "forward_overlap": 0.85, "side_overlap": 0.6, "method": "columns", "starts": starts,
        "end": "rtl", "separation_m": 4.0,
    }  # fmt: skip
    plan = daemon.plans.make(body)
    report("planning", 1, 1)
    delays = {v["id"]: v["flights"][0]["start_s"] for v in plan["vehicles"]}
    began = time.monotonic()
    for number, vehicle in enumerate(sorted(delays, key=lambda name: delays[name]), start=1):
        system = links.fleet.system_of(vehicle)
        mission = daemon.plans.mission({"plan": plan["id"]}, vehicle, links.fleet.vehicles[system].autopilot)
        links.upload(system, mission)
        # with the planned delays, at least 6 s, so that one vehicle completes while others still fly
        due = began + max(delays[vehicle], 6.0 * (number - 1)) / setting.speed
        time.sleep(max(0.0, due - time.monotonic()))
        links.finish(links.fleet.call(partial(links.fleet.start, system)))
        report("starting", number, setting.vehicles)
    photos = sum(vehicle["photos"] for vehicle in plan["vehicles"])

    def done() -> bool:
        report("flying: pictures on the map", min(daemon.drawer.drawn, photos), photos)
        return len(daemon.views.completions()) >= setting.vehicles

    _wait(done, _MOST_S, "the missions' completion")
    report("flying: pictures on the map", photos, photos)


def _finish(daemon: "Daemon", report: ReportProgress) -> None:
    """Wait until every completion's refinement is on the map, and the products are written."""

    def refined() -> bool:
        rows = daemon.views.completions()
        report("refining", sum("version" in row for row in rows), len(rows))
        failed = [job for job in daemon.jobs.all() if job.state == "failed" and job.kind != "coarse"]
        if failed:
            raise OrthoSwarmError(f"the {failed[0].kind} of {failed[0].vehicle} failed: {failed[0].message}")
        return all("version" in row for row in rows) and not daemon.jobs.open()

    _wait(refined, 300.0, "the refinement")
    report("products", 0, 1)
    job = daemon.requests.export(["cog", "gpkg", "mbtiles", "kmz"])

    def exported() -> bool:
        found = daemon.jobs.find(job.id)
        return found is not None and found.state in ("done", "failed")

    _wait(exported, 300.0, "export")
    report("products", 1, 1)


def _wait(done: Callable[[], bool], limit_s: float, what: str) -> None:
    end = time.monotonic() + limit_s
    while not done():
        if time.monotonic() > end:
            raise OrthoSwarmError(f"{what}: not finished within {limit_s:.0f} s; run the demonstration again")
        time.sleep(0.2)


def _measure(setting: DemoSetting, out: Path, end: dict[str, Any], wall_s: float) -> dict[str, Any]:
    """Compare the orthoimages with the truth and add the figures to the report."""
    from orthoswarm.evaluation.orthoimage import evaluate_ortho, find_mask
    from orthoswarm.export.product_files import write_json

    reference = out / "twin" / "truth" / "reference.tif"
    report: dict[str, Any] = json.loads((out / "report.json").read_text(encoding="utf-8"))
    figures = {
        name: evaluate_ortho(out / file, reference, find_mask(reference, None)).figures()
        for name, file in (("realtime", "realtime.tif"), ("orthoimage", "orthoimage.tif"))
    }
    about = {"vehicles": setting.vehicles, "seed": setting.seed, "pictures": end.get("taken"), "wall_s": wall_s}
    report |= {"accuracy": figures["orthoimage"], "accuracy_realtime": figures["realtime"], "demo": about}
    write_json(out / "report.json", report)
    return report


class PacedClock:
    """A clock that slows down while rendering is behind: a slow machine flies slower and loses no picture."""

    def __init__(self) -> None:
        self._real, self._now, self.slow = time.monotonic(), 0.0, False
        self._lock = threading.Lock()

    def __call__(self) -> float:
        """Simulated seconds since the start."""
        with self._lock:
            real = time.monotonic()
            self._now += (real - self._real) * (_SLOW_RATE if self.slow else 1.0)
            self._real = real
            return self._now


def simulate(setting: DemoSetting, pipe: Connection) -> None:
    """Run until "stop" is received or the pipe is closed.

    Sends {"links": [...], "streams": [...]} first, and {"taken": N, "problem": text} at the end.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # not all systems inherit this from the parent process
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    from gcs_plugin.demo.simulated_camera import RenderQueue, TwinCamera, VideoServer
    from gcs_plugin.sim.multirotor import Airframe
    from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
    from orthoswarm.twin.dataset_files import damaged_city

    stage, site = damaged_city(setting.twin)
    systems = range(1, setting.vehicles + 1)
    renderer = RenderQueue(
        cameras={s: TwinCamera(stage, site, setting, s) for s in systems},
        servers={s: VideoServer() for s in systems},
    )
    airframe = Airframe(climb_m_s=8.0, sink_m_s=6.0, gps_sigma_m=0.8)
    vehicles = make_swarm(
        setting.vehicles, home=setting.home(), airframe=airframe, seed=setting.seed, on_exposure=renderer.expose
    )
    clock = PacedClock()
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=setting.speed, clock=clock) as swarm:
        streams = [renderer.servers[s].url for s in systems]
        pipe.send({"links": swarm.addresses, "streams": streams})
        while not _stop_received(pipe):
            clock.slow = renderer.backlog > _MOST_WAITING
    renderer.close()
    _send(pipe, {"taken": renderer.taken, "problem": renderer.problem})


def _stop_received(pipe: Connection) -> bool:
    try:
        return pipe.poll(_BEHIND_S) and pipe.recv() == "stop"
    except (EOFError, OSError):
        return True


def _send(pipe: Connection, message: dict[str, Any]) -> None:
    try:
        pipe.send(message)
    except OSError:  # the demonstration has ended already
        return
