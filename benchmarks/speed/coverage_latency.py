"""Time from a leg's end to its cells: N simulated vehicles fly a plan and stream to one daemon, over loopback.

    python -m benchmarks.speed.coverage_latency --vehicles 8

The pictures near each leg's end are withheld, so that its last cells stay `planned` until the daemon knows that the
leg was flown, and are `missed` then: without them most cells would be known before the leg ends.

Prints a line of JSON: time from the vehicle's passing the end to the cells' change in /api/coverage/cells.png (median,
95 %, longest; polled every 0.1 s), legs measured, pictures, CPU share of the daemon's process, the machine's load.
"""

import argparse
import io
import json
import math
import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from PIL import Image

from benchmarks.speed.daemon_load import same_course
from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from orthoswarm.coverage.coverage_grid import CellState

HOME = (48.1371, 11.5754)
METRES = (111_200.0, 111_200.0 * math.cos(math.radians(HOME[0])))
WITHHELD_M, PASSED_M, POLL_S = 45.0, 3.0, 0.1


@dataclass
class Leg:
    """A leg of the plan: its vehicle, its ends in metres from home, and when it was passed and known (monotonic)."""

    vehicle: int
    start: np.ndarray
    end: np.ndarray
    begun: bool = False
    passed: float | None = None
    known: float | None = None


def metres(lat_deg: float, lon_deg: float) -> np.ndarray:
    """North and east of home."""
    return np.array([(lat_deg - HOME[0]) * METRES[0], (lon_deg - HOME[1]) * METRES[1]])


class Flight:
    """The vehicles, their cameras, and the legs that they fly."""

    def __init__(self, count: int) -> None:
        self.legs: list[Leg] = []
        self.pictures: queue.SimpleQueue[tuple[int, Any, float]] = queue.SimpleQueue()
        self.withheld = 0
        home = (*HOME, 500.0)
        self.vehicles = make_swarm(count, home=home, airframe=Airframe(climb_m_s=8.0), on_exposure=self._exposed)

    def _exposed(self, vehicle: Any, exposure: Any) -> None:
        at = metres(exposure.pose.lat_deg, exposure.pose.lon_deg)
        mine = [leg for leg in self.legs if leg.vehicle == vehicle.system]
        if any(np.hypot(*(at - leg.end)) < WITHHELD_M for leg in mine):
            self.withheld += 1
            return
        self.pictures.put((vehicle.system, exposure, vehicle.utc_s(exposure.time_s)))

    def look(self) -> None:
        """Note which vehicles pass an end."""
        now = time.monotonic()
        for vehicle in self.vehicles:
            pose = vehicle.pose_at(math.inf)
            at = metres(pose.lat_deg, pose.lon_deg)
            for leg in self.legs:
                if leg.vehicle != vehicle.system or leg.passed is not None:
                    continue
                leg.begun |= bool(np.hypot(*(at - leg.start)) < 2 * PASSED_M)
                if leg.begun and np.hypot(*(at - leg.end)) < PASSED_M:
                    leg.passed = now


def post(flight: Flight, client: httpx.Client) -> None:
    """Post pictures as they are taken, until the process ends."""
    course, number = same_course(), 0
    while True:
        system, exposure, time_s = flight.pictures.get()
        number += 1
        pose = {
            "vehicle": f"v{system}", "image": f"{exposure.index}.jpg", "time": time_s,
            "lat_deg": exposure.pose.lat_deg, "lon_deg": exposure.pose.lon_deg, "height_m": exposure.pose.height_m,
            "yaw_deg": math.degrees(exposure.pose.yaw_rad), "pitch_deg": -90.0, "roll_deg": 0.0,
        }  # fmt: skip
        files = {"image": ("p.jpg", course(system, number)[0], "image/jpeg")}
        client.post("/api/frames", files=files, data={"pose": json.dumps(pose)}).raise_for_status()


def cells_known(client: httpx.Client, legs: list[Leg], etag: str) -> str:
    """Note legs of which the last cells are no longer planned; gives the picture's ETag."""
    answer = client.get("/api/coverage/cells.png", headers={"If-None-Match": etag})
    now = time.monotonic()
    if answer.status_code != 200:
        return etag
    states = np.asarray(Image.open(io.BytesIO(answer.content)))
    corners = [metres(lat, lon) for lon, lat in client.get("/api/coverage").json()["corners"]]
    for leg in legs:
        if leg.passed is None or leg.known is not None:
            continue
        along = (leg.end - leg.start) / np.hypot(*(leg.end - leg.start))
        right, down = corners[1] - corners[0], corners[3] - corners[0]
        for back in np.arange(2.0, WITHHELD_M, 1.0):  # the last cell of the leg that is in the area
            spot = leg.end - back * along - corners[0]
            column = int(spot @ right / (right @ right) * states.shape[1])
            row = int(spot @ down / (down @ down) * states.shape[0])
            if (
                0 <= row < states.shape[0]
                and 0 <= column < states.shape[1]
                and states[row, column] != CellState.OUTSIDE
            ):
                leg.known = now if states[row, column] != CellState.PLANNED else None
                break
    return answer.headers.get("etag", "")


def area(side_m: float) -> dict[str, Any]:
    """A square to the north-east of home."""
    north, east = side_m / METRES[0], side_m / METRES[1]
    lat, lon = HOME
    ring = [[lon, lat], [lon + east, lat], [lon + east, lat + north], [lon, lat + north], [lon, lat]]
    return {"type": "Polygon", "coordinates": [ring]}


def cpu_s(client: httpx.Client) -> float:
    found = re.search(r"^orthoswarm_cpu_seconds_total (\S+)$", client.get("/metrics").text, re.MULTILINE)
    assert found is not None
    return float(found[1])


def measure(client: httpx.Client, flight: Flight, side_m: float) -> dict[str, Any]:
    """Plan, upload, start, and watch until all legs are known."""
    count = len(flight.vehicles)
    while sum(row.get("lat_deg") is not None for row in client.get("/api/vehicles").json()) < count:
        time.sleep(0.2)
    body = {"area": area(side_m), "vehicles": count, "altitude_m": 60, "fov_min_deg": 70, "speed_m_s": 10}
    body["starts"] = [list(HOME)] * count
    plan = client.post("/api/plans", json=body).raise_for_status().json()["id"]
    for feature in client.get(f"/api/plans/{plan}/map").json()["features"]:
        if feature["properties"]["kind"] == "leg":
            ends = [metres(lat, lon) for lon, lat, *_ in feature["geometry"]["coordinates"]]
            flight.legs.append(Leg(int(feature["properties"]["vehicle"][1:]), ends[0], ends[-1]))
    for vehicle in flight.vehicles:
        name = f"v{vehicle.system}"
        answer = client.post(f"/api/missions/{name}/upload", json={"plan": plan, "mission": name}).json()
        assert answer["outcome"] == "done", answer
    names = {f"v{v.system}": f"v{v.system}" for v in flight.vehicles}
    rows = client.post(f"/api/plans/{plan}/preflight", json={"vehicles": names}).json()["checks"]
    red = {row["vehicle"]: [i["name"] for i in row["items"] if i["state"] == "red"] for row in rows}
    client.post(f"/api/plans/{plan}/start", json={"vehicles": names, "override": red}).raise_for_status()
    threading.Thread(target=post, args=(flight, client), daemon=True).start()
    before, began, etag, end = cpu_s(client), time.monotonic(), "", time.monotonic() + 900.0
    while any(leg.known is None for leg in flight.legs) and time.monotonic() < end:
        flight.look()
        etag = cells_known(client, flight.legs, etag)
        time.sleep(POLL_S)
    took = [leg.known - leg.passed for leg in flight.legs if leg.known is not None and leg.passed is not None]
    share = (cpu_s(client) - before) / (time.monotonic() - began)
    frames = len(client.get("/api/frames").json())
    return {
        "vehicles": count, "legs": len(flight.legs), "measured": len(took),
        "leg_to_cells_s": {q: round(float(np.percentile(took, q)), 2) for q in (50, 95, 100)} if took else None,
        "pictures": frames, "withheld": flight.withheld, "daemon_cpu_share": round(share, 2),
        "load": [round(v, 1) for v in os.getloadavg()],
    }  # fmt: skip


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=8)
    parser.add_argument("--side", type=float, default=500.0, help="of the square area, metres")
    args = parser.parse_args()
    flight = Flight(args.vehicles)
    with tempfile.TemporaryDirectory() as folder, SimSwarm(flight.vehicles, "tcpin:127.0.0.1:0") as swarm:
        links = [text for address in swarm.addresses for text in ("--link", address)]
        command = [sys.executable, "-m", "gcs_plugin.cli", "serve", "--port", "0", "--workspace", folder, *links]
        served = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        try:
            assert served.stdout is not None
            found = next(m for m in (re.search(r"map: (http://[^/\s]+)", line) for line in served.stdout) if m)
            threading.Thread(target=served.stdout.read, daemon=True).start()
            token = (Path(folder) / "token").read_text().strip()
            client = httpx.Client(base_url=found[1], timeout=120.0, headers={"Authorization": f"Bearer {token}"})
            print(json.dumps(measure(client, flight, args.side)), flush=True)
        finally:
            served.terminate()
            served.wait(60)


if __name__ == "__main__":
    main()
