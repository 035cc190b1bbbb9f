"""The module inside the real MAVProxy, headless, with simulated vehicles; its picture on the real map's classes."""

import json
import os
import pickle
import queue
import re
import signal
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import httpx
import numpy as np
import pytest

pytest.importorskip("MAVProxy")

from gcs_plugin.links.mavlink import dialect
from gcs_plugin.links.packets import Framer
from gcs_plugin.mavproxy.packet_feed import Feed
from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from tests.kit.daemon_kit import GRID, Served, end_with_us
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.vehicles.sim_cameras import Cameras, square

PROGRAM = Path(sys.executable).with_name("mavproxy.py")


class MavProxy:
    """The real program: words in, lines out."""

    def __init__(self, folder, masters):
        # as its own console would be without a terminal; no stream requests, which would fight with the daemon's
        command = [sys.executable, str(PROGRAM), "--non-interactive", "--streamrate=-1", f"--state-basedir={folder}"]
        command += ["--default-modules", "link,mode,arm,wp,param,output", *(f"--master={m}" for m in masters)]
        driver = folder / "driver.py"
        driver.write_text(DRIVER)
        command += ["--cmd", "module load driver; module load gcs_plugin.mavproxy"]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), os.getcwd()]), "PYTHONUNBUFFERED": "1"}
        environment.pop("DISPLAY", None)
        self.process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            errors="replace", env=environment, preexec_fn=end_with_us,
        )  # fmt: skip
        self.words = folder / "words"
        self.lines: queue.Queue = queue.Queue()
        self.said: list[str] = []
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        with self.process.stdout as stream:
            for line in stream:
                self.said.append(line)
                self.lines.put(line)

    def type(self, words, answer, limit_s=300.0):
        """Type a line; gives the match of what is said to it."""
        part = self.words.with_suffix(".part")
        part.write_text(words)
        while self.words.exists():
            time.sleep(0.05)
        os.replace(part, self.words)
        return self.wait(answer, limit_s, words)

    def wait(self, answer, limit_s=120.0, words=""):
        end = time.monotonic() + limit_s
        while True:
            try:
                line = self.lines.get(timeout=max(0.01, end - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"no answer {answer!r} to '{words}':\n{self.end()}") from None
            if match := re.search(answer, line):
                return match
            assert "Traceback" not in line, self.end()
            assert not (words and line.startswith("orthoswarm: ")), f"to '{words}': {line}"

    def end(self):
        return "".join([line for line in self.said if "COMMAND_ACK" not in line][-30:])

    def close(self):
        self.process.terminate()
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(30)
        self.reader.join(60)


# Types what appears in a file, as MAVProxy's own console does with what appears on the keyboard.
DRIVER = """
import os
from MAVProxy.modules.lib import mp_module
class Driver(mp_module.MPModule):
    def __init__(self, mpstate):
        super().__init__(mpstate, "driver", "types")
        self.shown = []
        self.map = self  # stands for the map's window: takes objects as that does
    def add_object(self, thing):
        print("MAP", type(thing).__name__, thing.key, thing.rgba.shape, int(thing.rgba[..., 3].max()), flush=True)
    def idle_task(self):
        if os.path.exists("words"):
            with open("words") as file:
                words = file.read()
            os.remove("words")
            self.mpstate.functions.process_stdin(words)
def init(mpstate):
    return Driver(mpstate)
"""


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_swarm_is_planned_flown_and_refined_from_mavproxys_console(tmp_path):
    lat, lon = (float(v) for v in GRID.to_geographic([EAST, NORTH]))
    cameras = Cameras()
    vehicles = make_swarm(2, home=(lat, lon, 500.0), airframe=Airframe(climb_m_s=8.0), on_exposure=cameras.expose)
    (tmp_path / "area.geojson").write_text(json.dumps(square(130)))
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=3.0) as swarm:
        proxy = MavProxy(tmp_path, swarm.addresses)
        try:
            proxy.wait("Loaded module gcs_plugin.mavproxy")
            proxy.wait("'orthoswarm serve WORKSPACE")  # what to do, before one asks
            proxy.type("orthoswarm status", "does not answer")
            url = proxy.type("orthoswarm serve ws --port 0 --fov-min 65", r"the daemon runs: (\S+)/")[1]
            token = (tmp_path / "ws" / "token").read_text().strip()
            served = cameras.served = Served(proxy.process, url, token)
            rows = served.until("/api/vehicles", lambda rows: sum(bool(r.get("lat_deg")) for r in rows) == 2)
            assert {row["id"] for row in rows} == {"v1", "v2"}  # both, although the console has one selected
            proxy.type("orthoswarm vehicles", r"v2: ")
            assert float(proxy.type("orthoswarm plan area.geojson 2 60 65", r"([\d.]+) % covered")[1]) > 99.0
            for name in ("v1", "v2"):
                served.until(
                    "/api/vehicles", lambda rows, n=name: any(r["id"] == n and r["state"] == "found" for r in rows)
                )
                proxy.type(f"orthoswarm upload {name}", rf"vehicle {name[1]}\b.*(mission|stored|verified)")
                proxy.type(f"orthoswarm start {name}", "flies its mission")
            proxy.wait(r"MAP Mosaic orthoswarm mosaic \(\d+, \d+, 4\) 255")
            done = served.until(
                "/api/completions", lambda rows: len(rows) == 2 and all("version" in r for r in rows), limit_s=600.0
            )
            assert {row["vehicle"] for row in done} == {"v1", "v2"}
            assert cameras.all_posted() > 10
            assert "version" not in served.get("/healthz").json()["problems"]
            proxy.type("orthoswarm refine v1", "refining v1, sortie 1")
            proxy.type("orthoswarm layers", "coarse: [1-9]")
            proxy.type("orthoswarm status", r"2 vehicles, \d+ pictures")
            proxy.type("orthoswarm export mbtiles", "exporting mbtiles")
            proxy.type("orthoswarm web", re.escape(url))
            proxy.type("orthoswarm nonsense", "usage: orthoswarm")
            served.until("/api/jobs", lambda rows: all(r["state"] in ("done", "failed") for r in rows))
            assert (tmp_path / "ws" / "export" / "orthoimage.mbtiles").stat().st_size > 1000
            proxy.type("module unload gcs_plugin.mavproxy", "Unloaded module")
            ended(served.url)
        finally:
            proxy.close()


@pytest.mark.parametrize("how", ["unload", "quit", "kill"])
def test_a_daemon_that_the_console_started_ends_with_it(tmp_path, how):
    with SimSwarm(make_swarm(1), "tcpin:127.0.0.1:0") as swarm:
        proxy = MavProxy(tmp_path, swarm.addresses)
        try:
            proxy.wait("Loaded module gcs_plugin.mavproxy")
            proxy.wait("'orthoswarm serve WORKSPACE")
            proxy.type("module load gcs_plugin.mavproxy", "already loaded")
            url = proxy.type("orthoswarm serve ws --port 0 --workers 1", r"the daemon runs: (\S+)/")[1]
            if how == "unload":
                proxy.type("module unload gcs_plugin.mavproxy", "Unloaded module")
                ended(url)
                proxy.type("module load gcs_plugin.mavproxy", "Loaded module gcs_plugin.mavproxy")  # and again
                proxy.wait("'orthoswarm serve WORKSPACE")
            else:
                proxy.process.send_signal(signal.SIGTERM if how == "quit" else signal.SIGKILL)
                ended(url)
        finally:
            proxy.close()


def ended(url, limit_s=120.0):
    """The daemon has ended with the module."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        try:
            httpx.get(f"{url}/healthz", trust_env=False)
        except httpx.ConnectError:
            return
        except httpx.TransportError:  # it is busy, or just closes
            pass
        time.sleep(0.2)
    raise AssertionError("the daemon still runs")


# -- the feed -----------------------------------------------------------------------------------------------------


class Master:
    def __init__(self):
        self.sent = b""

    def write(self, raw):
        self.sent += raw


def test_the_daemons_words_go_to_the_vehicle_that_they_name():
    import socket

    daemon = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    daemon.bind(("127.0.0.1", 0))
    daemon.settimeout(60.0)
    masters = [Master(), Master()]
    state = types.SimpleNamespace(
        select_extra={}, vehicle_link_map={0: {(1, 1), (1, 100)}, 1: {(2, 1)}}, mav_master=masters
    )
    feed = Feed(state, "127.0.0.1", daemon.getsockname()[1])
    vehicle, ground = dialect.MAVLink(None, 2, 1), dialect.MAVLink(None, 255, 190)
    heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3)
    heartbeat.pack(vehicle)
    feed.packet(heartbeat)
    data, peer = daemon.recvfrom(1000)
    assert data == bytes(heartbeat.get_msgbuf())
    for target in (2, 0, 77):
        daemon.sendto(dialect.MAVLink_command_long_message(target, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0).pack(ground), peer)
    ((fd, (read, args)),) = state.select_extra.items()
    end = time.monotonic() + 60.0
    while feed.up < 3 and time.monotonic() < end:
        read(args)
    targets = [[p.message.target_system for p in Framer().feed(m.sent)] for m in masters]
    assert targets == [[0], [2, 0]]
    feed.close()
    assert fd not in state.select_extra
    daemon.close()


# -- the map ------------------------------------------------------------------------------------------------------


def test_the_mosaic_lies_right_on_the_real_maps_picture():
    """Drawn by the map's own rules (its tiles' projection, its objects' interface); only the window is missing."""
    from MAVProxy.modules.mavproxy_map import mp_tile
    from MAVProxy.modules.mavproxy_map.mp_slipmap_util import SlipObject

    from gcs_plugin.mavproxy.map_overlay import Mosaic, _lat, _lon

    n, x, y = 1 << 18, 143_000, 89_000
    rgba = np.zeros((512, 768, 4), np.uint8)
    rgba[..., 3] = 255
    rgba[..., 0] = 200
    rgba[256:320, 128:192] = (0, 0, 250, 255)  # a mark
    rgba[:128] = 0  # nothing there
    sent = Mosaic(rgba, north=_lat(y, n), west=_lon(x, n), south=_lat(y + 2, n), east=_lon(x + 3, n), version=7)
    mosaic = pickle.loads(pickle.dumps(sent))  # as it travels to the map's process
    assert isinstance(mosaic, SlipObject)
    assert mosaic.layer < "1"
    tiles = mp_tile.MPTile(download=False, service="MicrosoftSat")
    lat, lon, width, ground_width = _lat(y, n) + 0.0005, _lon(x, n) - 0.0007, 800, 700.0

    def pixmapper(place):
        return tiles.coord_to_pixel(lat, lon, width, ground_width, *place)

    image = np.full((600, 800, 3), 90, np.uint8)
    mosaic.draw(image, pixmapper, None)
    middle = pixmapper((_lat(y + 1, n) - 0.125 * (_lat(y, n) - _lat(y + 1, n)), _lon(x + 0, n) + 0.625 * 360.0 / n))
    rows, cols = np.nonzero(image[..., 2] > 240)
    assert abs(rows.mean() - middle[1]) < 1.5
    assert abs(cols.mean() - middle[0]) < 1.5
    top = pixmapper((_lat(y, n), _lon(x, n)))
    assert (image[top[1] + 5, top[0] + 50] == 90).all()  # transparent
    assert (image[5, 5] == 90).all()  # beside it
    south, west, tall, wide = mosaic.bounds()
    assert south < mosaic.north == pytest.approx(south + tall)
    assert west < mosaic.east == pytest.approx(west + wide)
    mosaic.set_hidden(True)
    assert mosaic.bounds() is None


@pytest.mark.parametrize(("lat", "ground_width"), [(10.0, 500.0), (-40.0, 50.0), (48.0, 5e6)])
def test_a_mosaic_off_the_view_or_tiny_draws_nothing_wrong(lat, ground_width):
    from MAVProxy.modules.mavproxy_map import mp_tile

    from gcs_plugin.mavproxy.map_overlay import Mosaic

    tiles = mp_tile.MPTile(download=False)
    mosaic = Mosaic(np.full((256, 256, 4), 255, np.uint8), north=48.01, west=11.0, south=48.0, east=11.015, version=1)
    image = np.zeros((300, 400, 3), np.uint8)
    mosaic.draw(image, lambda p: tiles.coord_to_pixel(lat, 10.0, 400, ground_width, *p), None)
    assert (image > 0).sum() < 100


def test_the_mosaic_is_fetched_from_a_daemon(tmp_path):
    from gcs_plugin.mavproxy.daemon_client import Client
    from gcs_plugin.mavproxy.map_overlay import fetch_mosaic
    from tests.kit.daemon_kit import line, serving

    with serving(tmp_path / "w") as served:
        client = Client(served.url)
        assert fetch_mosaic(client) is None
        shots = line(4)
        for shot in shots:
            served.send(shot)
        served.until("/api/frames", lambda rows: len(rows) == 4 and all(row["on_map"] for row in rows))
        mosaic = served.until("/healthz", lambda _: fetch_mosaic(client) is not None) and fetch_mosaic(client)
        place = shots[1].pose
        assert mosaic.south < place["lat_deg"] < mosaic.north
        assert mosaic.west < place["lon_deg"] < mosaic.east
        row = int((mosaic.north - place["lat_deg"]) / (mosaic.north - mosaic.south) * mosaic.rgba.shape[0])
        column = int((place["lon_deg"] - mosaic.west) / (mosaic.east - mosaic.west) * mosaic.rgba.shape[1])
        assert mosaic.rgba[row, column, 3] == 255
        assert mosaic.rgba.shape[0] * mosaic.rgba.shape[1] <= 48 * 256 * 256
