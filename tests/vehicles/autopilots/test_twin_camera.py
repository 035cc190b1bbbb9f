"""The twin's camera under an autopilot: the whole way on simulated autopilots, and with `-m sitl` on real ones.

ORTHOSWARM_SITL is a comma-separated list of links, one autopilot each, as for the scenarios of missions.
"""

import contextlib
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.demo.demonstration import PacedClock
from gcs_plugin.demo.following_camera import LATE_S, Shutter, area_of, away_m, open_outlet, place_spec, read_spec
from gcs_plugin.demo.simulated_camera import VideoSender, VideoServer
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from orthoswarm.evaluation.orthoimage import evaluate_ortho, find_mask
from orthoswarm.model.errors import InputError
from orthoswarm.model.geo import LocalGrid, utm_epsg
from telemetry.live.live_stream import open_stream
from telemetry.samples.sample import Sample
from tests.kit.daemon_kit import end_with_us, exported, serving
from tests.kit.servers.ports import free_port

ADDRESSES = [a.strip() for a in os.environ.get("ORTHOSWARM_SITL", "").split(",") if a.strip()]
HOME = (-35.363262, 149.165237, 584.0)  # ArduPilot's own default: far from the twin's city, south of the equator
SPEED = 3.0
RATE_HZ = 1.0


@contextlib.contextmanager
def simulated(autopilot):
    vehicles = make_swarm(
        1, autopilots=(autopilot,), home=HOME, airframe=Airframe(climb_m_s=5.0, gps_sigma_m=0.3), ready_s=8.0
    )
    clock = PacedClock()
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=SPEED, clock=clock) as swarm:
        yield swarm.addresses[0], Pace(swarm, clock)


class Pace:
    """Lets simulated time run slower while the machine is too busy to render what the vehicle sees."""

    def __init__(self, swarm, clock):
        self.swarm, self.clock = swarm, clock
        self.flown_s, self.last_s = 0.0, swarm.now

    def __call__(self, taken):
        now = self.swarm.now
        self.flown_s += (now - self.last_s) if self.swarm.vehicles[1].flight.motion.up > 20.0 else 0.0
        self.last_s = now
        self.clock.share = 0.15 if RATE_HZ * self.flown_s - taken > 5.0 else 1.0


@contextlib.contextmanager
def real(address):
    if not ADDRESSES:
        pytest.skip("ORTHOSWARM_SITL names no autopilot")
    yield address, lambda taken: None


PLACES = [
    # minutes of flight; both run with -m slow
    pytest.param((simulated, Autopilot.ARDUPILOT), id="simulated-ardupilot", marks=pytest.mark.slow),
    pytest.param((simulated, Autopilot.PX4), id="simulated-px4", marks=pytest.mark.slow),
    *[
        pytest.param((real, address), id=f"sitl-{number}", marks=pytest.mark.sitl)
        for number, address in enumerate(ADDRESSES or ["no address in ORTHOSWARM_SITL"])
    ],
]


class Followed:
    """A process that runs for long, and what it says meanwhile on one of its outputs."""

    def __init__(self, words, stderr=subprocess.STDOUT, **options):
        self.process = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=stderr, text=True, preexec_fn=end_with_us, **options
        )
        self.said: list[str] = []
        self.told = threading.Condition()
        self.reader = threading.Thread(target=self.read, daemon=True)
        self.reader.start()

    def read(self):
        with self.process.stderr or self.process.stdout as stream:
            for text in stream:
                with self.told:
                    self.said.append(text)
                    self.told.notify_all()

    def wait_for(self, pattern, limit_s=180.0):
        def found():
            return next((m for text in self.said if (m := re.search(pattern, text))), None)

        with self.told:
            self.told.wait_for(lambda: found() or self.process.poll() is not None, limit_s)
            match = found()
        assert match, "".join(self.said)
        return match

    def close(self):
        self.process.kill()
        self.process.wait(30)
        self.reader.join(10.0)
        self.process.stdout.close()


class CameraProcess(Followed):
    """`orthoswarm twin camera` as a process."""

    def __init__(self, *arguments):
        words = [sys.executable, "-m", "gcs_plugin.cli", "twin", "camera", "--json", *arguments]
        super().__init__(words, subprocess.PIPE)

    def end(self):
        self.process.send_signal(signal.SIGINT)
        out = self.process.stdout.read()
        return self.process.wait(30), json.loads(out) if out else {}


@pytest.fixture(params=PLACES)
def autopilot(request):
    kind, what = request.param
    with kind(what) as place:
        yield place


def small_area(lat, lon, north_m=60.0, east_m=160.0):
    grid = LocalGrid(utm_epsg(lat, lon))
    half = 0.5 * np.array([east_m, north_m])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half + grid.to_grid(lat, lon)
    return {"type": "Polygon", "coordinates": [[[float(o), float(a)] for a, o in grid.to_geographic(corners)]]}


@pytest.mark.timeout(1800)
def test_a_real_flight_is_mapped_and_refined_from_the_twins_pictures(autopilot, tmp_path):
    """Plan, upload, start, camera, daemon, refinement: nothing here knows whether the autopilot is simulated."""
    address, pace = autopilot
    relay, video, folder = free_port(), free_port(), tmp_path / "twin"
    camera = CameraProcess(
        "--link", address, "--relay", f"tcpin:127.0.0.1:{relay}", "--stream", f"tcp://127.0.0.1:{video}",
        "--set", str(folder), "--rate", str(RATE_HZ), "--fast",
    )  # fmt: skip
    try:
        camera.wait_for("map: ")
        found = camera.wait_for(r"camera of (v\d+) \(\w+\): --source (v\d+=\S+)")
        name, source = found[1], found[2]
        arguments = ("--link", f"tcp:127.0.0.1:{relay}", "--source", source, "--basemap", str(folder / "basemap.tif"))
        with serving(tmp_path / "w", *arguments, "--fov-min", "75") as served:
            fly(served, name, pace)
            report = products(served, tmp_path / "w")
            code, said = camera.end()
        assert code == 0 and said["vehicles"][0]["pictures"] >= report["frames"]["used"] > 20
        reference = folder / "truth" / "reference.tif"
        mask = find_mask(reference, None)
        rough, fine = (evaluate_ortho(tmp_path / "w" / n, reference, mask) for n in ("realtime.tif", "orthoimage.tif"))
        assert rough.figures()["median_m"] < 1.5  # most pictures lay on the basemap when they came
        assert fine.figures()["median_m"] < min(1.0, rough.figures()["median_m"] + 0.1)
    finally:
        camera.close()


def fly(served, name, pace):
    """From an area to a flown mission that has been refined."""
    rows = served.until(
        "/api/vehicles", lambda rows: any(r["id"] == name and r.get("lat_deg") and r["gps_fix"] >= 3 for r in rows)
    )
    row = next(r for r in rows if r["id"] == name)
    body = {
        "area": small_area(row["lat_deg"], row["lon_deg"]), "vehicles": 1, "altitude_m": 60, "fov_min_deg": 75,
        "speed_m_s": 8, "forward_overlap": 0.8, "side_overlap": 0.6, "autopilot": row["autopilot"],
        "starts": [[row["lat_deg"], row["lon_deg"]]],
    }  # fmt: skip
    plan = served.command("/api/plans", body)
    assert plan.status_code == 201, plan.text
    upload = {"plan": plan.json()["id"], "mission": plan.json()["vehicles"][0]["id"]}
    answer = served.command(f"/api/missions/{name}/upload", upload)
    assert answer.status_code == 200, answer.text
    served.take_off(name)

    def refined(rows):
        pace(next(r for r in served.get("/api/vehicles").json() if r["id"] == name)["pictures"]["taken"])
        return rows and "version" in rows[0]

    done = served.until("/api/completions", refined, limit_s=1200.0)
    assert [row["vehicle"] for row in done] == [name]
    assert done[0]["layer"] == "fine" and done[0]["version"] > done[0]["version_before"]


def products(served, workspace):
    served.until("/api/jobs", exported)
    return json.loads((workspace / "report.json").read_text())


# -- parts --------------------------------------------------------------------------------------------------------


def test_pictures_are_taken_at_even_moments_of_the_vehicles_clock():
    shutter = Shutter(every_s=0.5, above_m=20.0)
    assert shutter.due(100.0, False, 50.0) is None
    assert shutter.due(100.0, True, 5.0) is None
    moments = [m for now in np.arange(100.0, 103.0, 0.1) if (m := shutter.due(float(now), True, 50.0)) is not None]
    assert np.diff(moments) == pytest.approx(0.5)
    assert len(moments) == 6
    assert shutter.skipped == 0


def test_a_camera_that_is_far_behind_skips_and_says_so():
    shutter = Shutter(every_s=0.5, above_m=20.0)
    assert shutter.due(100.0, True, 50.0) == pytest.approx(100.0 - LATE_S)
    late = shutter.due(130.0, True, 50.0)
    assert late is not None and 130.0 - late < 2.0
    assert shutter.skipped > 50
    assert shutter.due(50.0, True, 50.0) == pytest.approx(50.0 - LATE_S)  # its clock was set back


def test_a_camera_that_is_too_slow_takes_pictures_farther_apart_without_holes():
    shutter, now, moments = Shutter(every_s=0.5, above_m=20.0), 100.0, []
    while now < 220.0:
        moment = shutter.due(now, True, 50.0)
        moments += [] if moment is None else [moment]
        now += 0.02 if moment is None else 1.2  # rendering takes longer than the time between two pictures
    gaps = np.diff(moments)
    assert max(gaps) < 2.5
    assert shutter.skipped + len(moments) == pytest.approx((moments[-1] - moments[0]) / 0.5, abs=5)
    assert now - moments[-1] < 8.0


def test_pictures_can_follow_the_autopilots_triggers():
    shutter = Shutter(every_s=0.5, above_m=20.0, on_trigger=True)
    shutter.exposed(99.0)
    assert shutter.due(99.1, True, 50.0) is None  # telemetry from behind it is still to come
    assert shutter.due(99.5, True, 50.0) == 99.0
    assert shutter.due(200.0, True, 50.0) is None


@pytest.mark.parametrize("url", ["ftp://a:1", "tcp://nowhere", "udp://127.0.0.1:99999", "tcp://127.0.0.1:65530", "x"])
def test_places_for_pictures_that_are_none_are_refused(url):
    with pytest.raises(InputError):
        open_outlet(url, 9)


@pytest.mark.parametrize("arguments", [["--rate", "0"], ["--lat", "1"], ["--stream", "tcp://x"]])
def test_wrong_arguments_are_told_before_anything_is_built(arguments, tmp_path, capsys):
    base = ["--link", "tcp:127.0.0.1:9", "--stream", "udp://127.0.0.1:9", "--set", str(tmp_path / "s")]
    assert main(["twin", "camera", *base, *arguments]) == 2
    assert not (tmp_path / "s").exists()
    assert "orthoswarm" in capsys.readouterr().err


def test_the_city_lies_where_the_vehicle_stands_and_its_set_says_so(tmp_path):
    world = place_spec("tiny", 3, HOME[0], HOME[1])
    assert away_m(world, HOME[0], HOME[1]) == 0.0
    assert away_m(world, 48.1, 11.5) > 1e6
    ring = np.array(area_of(world)["coordinates"][0])
    assert ring[:, 1].min() < HOME[0] < ring[:, 1].max()
    assert ring[:, 0].min() < HOME[1] < ring[:, 0].max()
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "manifest.json").write_text(json.dumps({"generator": 0, **dataclasses.asdict(world)}))
    assert read_spec(tmp_path) == world
    (tmp_path / "truth" / "manifest.json").write_text('{"preset": 3, "surprise": 1}')
    with pytest.raises(InputError, match="empty folder"):
        read_spec(tmp_path)


def pictures(count):
    rng = np.random.default_rng(1)
    for k in range(count):
        image = np.repeat(np.repeat(rng.integers(0, 255, (30, 40, 3), dtype=np.uint8), 16, 0), 16, 1)
        yield image, Sample(time_s=1_780_000_000.0 + k, lat_deg=1.0, lon_deg=2.0 + 1e-4 * k, height_m=60.0, yaw_deg=0.0)


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_streams_can_be_joined_late_and_carry_their_poses(kind):
    port = free_port()
    sender = VideoServer("127.0.0.1", port, live=True) if kind == "tcp" else VideoSender("127.0.0.1", port)
    stop, got = threading.Event(), []

    def watch():
        for picture in open_stream(f"{kind}://127.0.0.1:{port}", stop=stop, all_pictures=True, timeout_s=3.0):
            got.append(picture)
            if len(got) >= 5:
                stop.set()

    thread = threading.Thread(target=watch, daemon=True)
    try:
        source = pictures(400)
        for _ in range(3):  # nobody watches yet
            sender.send(*next(source))
        thread.start()
        end = time.monotonic() + 30.0
        while not stop.is_set() and time.monotonic() < end:
            sender.send(*next(source))
            stop.wait(0.1)
    finally:
        stop.set()
        sender.close()
    thread.join(10.0)
    whole = [p for p in got if not p.damaged]
    assert len(whole) >= 4
    for picture in whole:
        assert picture.sample is not None
        k = picture.time_s - 1_780_000_000.0
        assert picture.sample.lon_deg == pytest.approx(2.0 + 1e-4 * k, abs=1e-6)


def test_photos_can_be_posted_to_a_daemon(tmp_path):
    with serving(tmp_path / "w") as served:
        poster = open_outlet(served.url, 3)
        for image, sample in pictures(3):
            poster.send(image, sample)
        poster.close()
        rows = served.get("/api/frames").json()
        assert [row["vehicle"] for row in rows] == ["v3"] * 3
        assert [row["lon_deg"] for row in rows] == pytest.approx([2.0, 2.0001, 2.0002])
        assert (rows[0]["width"], rows[0]["height"]) == (640, 480)
        assert poster.failed == 0
    poster.send(*next(pictures(1)))  # nobody is there any more: counted, and the flight goes on
    assert poster.failed == 1
