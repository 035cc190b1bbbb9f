"""A real autopilot flown from MAVProxy's console (`-m sitl`), with the twin camera's pictures: see test_twin_camera.

tests/vehicles/test_mavproxy.py does the same with simulated vehicles.
"""

import json
import re

import pytest

pytest.importorskip("MAVProxy")

from tests.kit.daemon_kit import Served, exported
from tests.kit.servers.ports import free_port
from tests.vehicles.autopilots.test_fleet_scenarios import charge
from tests.vehicles.autopilots.test_gap_flight import REAL, row_of
from tests.vehicles.autopilots.test_twin_camera import RATE_HZ, CameraProcess, small_area
from tests.vehicles.test_mavproxy import MavProxy


@pytest.fixture(params=REAL)
def autopilot(request):
    kind, what = request.param
    with kind(what) as (address, _):
        yield address


@pytest.mark.timeout(1800)
def test_a_real_vehicle_is_planned_flown_and_refined_from_mavproxys_console(autopilot, tmp_path):
    charge(autopilot)
    relay, video, folder = free_port(), free_port(), tmp_path / "twin"
    camera = CameraProcess(
        "--link", autopilot, "--relay", f"tcpin:127.0.0.1:{relay}", "--stream", f"tcp://127.0.0.1:{video}",
        "--set", str(folder), "--rate", str(RATE_HZ), "--fast",
    )  # fmt: skip
    proxy = None
    try:
        camera.wait_for("map: ")
        found = camera.wait_for(r"camera of (v\d+) \(\w+\): --source (v\d+=\S+)")
        name, source = found[1], found[2]
        proxy = MavProxy(tmp_path, [f"tcp:127.0.0.1:{relay}"])
        proxy.wait("'orthoswarm serve WORKSPACE")
        basemap = folder / "basemap.tif"
        words = f"orthoswarm serve ws --port 0 --fov-min 75 --basemap {basemap} --source {source}"
        url = proxy.type(words, r"the daemon runs: (\S+)/")[1]
        served = Served(proxy.process, url, (tmp_path / "ws" / "token").read_text().strip())
        row = row_of(served, name, lambda row: row.get("lat_deg") and row["gps_fix"] >= 3)
        area = small_area(row["lat_deg"], row["lon_deg"])
        (tmp_path / "area.geojson").write_text(json.dumps(area))
        assert float(proxy.type("orthoswarm plan area.geojson 1 60 75", r"([\d.]+) % covered")[1]) > 99.0
        planned = served.get("/api/plans").json()[-1]
        proxy.type(f"orthoswarm upload {name} {planned['id']}", r"(mission|stored|verified)")
        served.until("/healthz", lambda _: passes(served, planned["id"]), 180.0)
        proxy.type(f"orthoswarm start {name}", "flies its mission")
        proxy.wait(r"MAP Mosaic orthoswarm mosaic \(\d+, \d+, 4\) 255", 300.0)
        done = served.until("/api/completions", lambda rows: rows and all("version" in r for r in rows), 900.0)
        assert [row["vehicle"] for row in done] == [name]
        proxy.type(f"orthoswarm refine {name}", f"refining {name}, sortie 1")
        proxy.type("orthoswarm layers", "fine: [1-9]")
        pictures = int(proxy.type("orthoswarm status", r"1 vehicles?, (\d+) pictures")[1])
        assert pictures > 20
        served.until("/api/jobs", exported)
        row_of(served, name, lambda row: not row["armed"])
        maps = [line for line in proxy.said if re.search(r"MAP Mosaic", line)]
        print(f"{pictures} pictures, the map layer renewed {len(maps)} times, last {maps[-1].strip()}")
    finally:
        if proxy is not None:
            proxy.close()
        camera.close()


def passes(served, plan):
    """Whether the plan's vehicles have passed their check."""
    checks = served.command(f"/api/plans/{plan}/preflight", {}).json()["checks"]
    return all(item["state"] != "red" for row in checks for item in row["items"])
