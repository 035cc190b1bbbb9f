"""Gaps flown from the daemon: a camera that fails for a while, the gap that this leaves, and the flight that closes it.

On real autopilots, with `-m sitl`; see test_twin_camera. tests/daemon/test_gaps_flown.py flies simulated ones.
"""

import contextlib
import http.server
import re
import threading
import time

import httpx
import pytest

from orthoswarm.model.geo import LocalGrid, utm_epsg
from tests.kit.daemon_kit import exported, serving
from tests.kit.servers.ports import free_port
from tests.vehicles.autopilots.test_twin_camera import PLACES, RATE_HZ, CameraProcess, small_area

REAL = [place for place in PLACES if any(mark.name == "sitl" for mark in place.marks)]
LENGTH_M, WIDTH_M, ALTITUDE_M = 240.0, 60.0, 40.0
FAILS_WITHIN_M = 60.0
"""Pictures nearer than this to the area's middle (east) do not arrive while the camera fails."""


class FailingUplink:
    """Takes photos that a camera posts and passes them on to a daemon; while `failing`, not those of the middle."""

    def __init__(self, port, middle_lon, metres_per_degree):
        self.url, self.failing, self.lost, self.passed = "", True, 0, 0
        self.middle_lon, self.metres_per_degree = middle_lon, metres_per_degree
        uplink = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                self.send_response(uplink.take(self.path, body, self.headers["Content-Type"]))
                self.end_headers()

            def log_message(self, *_):
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", port), Handler)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def take(self, path, body, kind):
        lon = float(re.search(rb'"lon_deg": ([-\d.]+)', body)[1])
        if not self.url or (self.failing and abs(lon - self.middle_lon) * self.metres_per_degree < FAILS_WITHIN_M):
            self.lost += 1
            return 503
        answer = httpx.post(self.url + path, content=body, headers={"Content-Type": kind}, timeout=60, trust_env=False)
        self.passed += answer.is_success
        return answer.status_code

    def close(self):
        self.server.shutdown()
        self.server.server_close()


@pytest.fixture(params=REAL)
def autopilot(request):
    kind, what = request.param
    with kind(what) as place:
        yield place


@pytest.mark.timeout(1800)
def test_a_gap_that_a_failing_camera_left_is_flown_and_closed(autopilot, tmp_path):
    address, pace = autopilot
    relay, uplink_port, folder = free_port(), free_port(), tmp_path / "twin"
    camera = CameraProcess(
        "--link", address, "--relay", f"tcpin:127.0.0.1:{relay}", "--stream", f"http://127.0.0.1:{uplink_port}",
        "--set", str(folder), "--rate", str(RATE_HZ), "--fast", "--level",
    )  # fmt: skip
    with contextlib.ExitStack() as opened:
        opened.callback(camera.close)
        camera.wait_for("map: ")
        name = camera.wait_for(r"camera of (v\d+)")[1]
        arguments = ("--link", f"tcp:127.0.0.1:{relay}", "--basemap", str(folder / "basemap.tif"), "--fov-min", "75")
        served = opened.enter_context(serving(tmp_path / "w", *arguments))
        row = row_of(served, name, lambda row: row.get("lat_deg") and row["gps_fix"] >= 3)
        home = row["lat_deg"], row["lon_deg"]
        uplink = FailingUplink(uplink_port, home[1], metres_per_degree(*home))
        opened.callback(uplink.close)
        uplink.url = served.url

        plan = planned(served, row, home)
        fly(served, plan["id"], {plan["vehicles"][0]["id"]: name}, pace, flights=1)
        before = coverage_of(served, lambda found: found["gaps"])
        assert uplink.lost > 5 and before["missed_share"] > 0.1 and before["gaps"]

        uplink.failing = False
        row_of(served, name, lambda row: not row["armed"])
        gaps = served.command("/api/coverage/flight", {"vehicles": {name: 8}})
        assert gaps.status_code == 201, gaps.text
        again = gaps.json()
        assert again["names"] == {again["vehicles"][0]["id"]: name}
        fly(served, again["id"], again["names"], pace, flights=2)
        after = coverage_of(served, lambda found: found["seen_share"] >= 0.998 and found["missed_share"] == 0.0)
        figures = [f"{100 * c['seen_share']:.2f} % seen, {len(c['gaps'])} gaps" for c in (before, after)]
        flown = [f"{p['vehicles'][0]['length_m']:.0f} m" for p in (plan, again)]
        print(f"{figures[0]} after {flown[0]} without {uplink.lost} pictures; {figures[1]} after {flown[1]} more")


def metres_per_degree(lat, lon):
    grid = LocalGrid(utm_epsg(lat, lon))
    return float(grid.to_grid(lat, lon + 1e-3)[0] - grid.to_grid(lat, lon)[0]) / 1e-3


def row_of(served, name, ready):
    rows = served.until("/api/vehicles", lambda rows: any(r["id"] == name and ready(r) for r in rows), limit_s=300.0)
    return next(r for r in rows if r["id"] == name)


def planned(served, row, home):
    body = {
        "area": small_area(*home, north_m=WIDTH_M, east_m=LENGTH_M), "vehicles": 1, "altitude_m": ALTITUDE_M,
        "fov_min_deg": 75, "speed_m_s": 8, "forward_overlap": 0.8, "side_overlap": 0.6,
        "autopilot": row["autopilot"], "starts": [home],
    }  # fmt: skip
    plan = served.command("/api/plans", body)
    assert plan.status_code == 201, plan.text
    return plan.json()


def fly(served, plan, names, pace, flights):
    """What the page does with a plan: upload, start, and follow until so many flights have been refined."""
    [(mission, name)] = names.items()
    answer = served.command(f"/api/missions/{name}/upload", {"plan": plan, "mission": mission})
    assert answer.status_code == 200, answer.text
    served.take_off(name)

    def refined(rows):
        row = next(r for r in served.get("/api/vehicles").json() if r["id"] == name)
        pace(row["pictures"]["taken"] if "pictures" in row else 0)
        return len(rows) == flights and all("version" in row for row in rows)

    served.until("/api/completions", refined, limit_s=900.0)


def coverage_of(served, wanted):
    """The coverage once everything that was refined counts, and it is as wanted."""
    served.until("/api/jobs", exported)
    time.sleep(5.0)  # gaps are found some seconds after the last picture
    return served.until("/api/coverage", wanted)
