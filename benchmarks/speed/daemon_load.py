"""How many pictures a second the daemon takes: N simulated companion computers post at a rate, over loopback.

    python -m benchmarks.speed.daemon_load --vehicles 8 32 96 --rate 2 --seconds 20
    python -m benchmarks.speed.daemon_load --legs --vehicles 8 --rate 2 --seconds 60

With --legs the pictures show one ground along legs there and back, over a map, so that coarse maps of the legs are made
meanwhile; without, they are alike, and nothing but the real-time layer is made of them.

Prints a line of JSON for each number of vehicles: frames accepted a second, time of a POST (median, 95, 99 %), time
from arrival to the map (by the daemon's own metrics; 1 is the slowest of the last thousand), how long the map waited
for the newest pictures of the vehicle that it was furthest behind (looked at four times a second; what is put off
because later pictures of its vehicle are drawn does not count), CPU share of the daemon's process and of the senders,
memory, coarse maps made and the share of the time in which one was being made.
"""

import argparse
import asyncio
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import httpx
import numpy as np

from orthoswarm.model.camera import NADIR_PITCH_RAD, Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.geo import LocalGrid

EAST, NORTH, EPSG = 327000.0, 3383000.0, 32648
HEIGHT_M, GROUND_PX_M, MAP_PX_M = 100.0, 0.25, 0.5
LENS = Lens(640, 480, focal_px(float(np.radians(70.0)), 640))
LEG, STEP_M, APART_M, WIDE_M = 24, 8.0, 60.0, 200.0
ERROR_M, TURN_RAD = 2.0, 0.03
BOUNDARY = "picture-and-pose"

Picture = tuple[bytes, float, float, float]
"""A JPEG, and its record: metres east and north, yaw in radians."""
Course = Callable[[int, int], Picture]
"""Vehicle and number -> its picture."""


def same_course() -> Course:
    """A dozen pictures with the detail of a town seen from 100 m, again and again, along straight lines."""
    import cv2

    rng = np.random.default_rng(1)
    made = []
    for _ in range(12):
        coarse = cv2.resize(rng.integers(0, 255, (60, 80, 3), np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
        fine = cv2.resize(rng.integers(0, 80, (240, 320, 3), np.uint8), (640, 480))
        made.append(jpeg(cv2.add(coarse, fine)))
    return lambda vehicle, k: (made[k % 12], 80.0 * (vehicle % 12), 600.0 * (vehicle // 12) + 8.0 * k, 0.0)


def legs(vehicles: int, count: int, basemap: Path) -> Course:
    """Pictures of one ground along legs there and back, with records that are some metres off; writes the map, too."""
    ground = town(vehicles * WIDE_M + 400.0, LEG * STEP_M + 400.0)
    write_map(ground, basemap)
    rng = np.random.default_rng(2)
    made: dict[tuple[int, int], Picture] = {}
    for vehicle in range(vehicles):
        off, turn = rng.normal(0.0, ERROR_M, 2), float(rng.normal(0.0, TURN_RAD))
        for k in range(count):
            leg, step = divmod(k, LEG)
            back = leg % 2 == 1
            east = WIDE_M * vehicle + APART_M * (leg % 3)
            north = STEP_M * (LEG - 1 - step if back else step)
            yaw = np.pi if back else 0.0
            tilt, roll = rng.normal(0.0, 0.01, 2)
            rotation = rotation_from_angles(yaw, NADIR_PITCH_RAD + tilt, roll)
            picture = photograph(ground, Camera(np.array([east, north, HEIGHT_M]), rotation, LENS))
            said = np.array([east, north]) + off + rng.normal(0.0, 0.5, 2)
            made[vehicle, k] = (picture, float(said[0]), float(said[1]), yaw + turn)
    return lambda vehicle, k: made[vehicle, k % count]


def town(wide_m: float, high_m: float) -> np.ndarray:
    """Colours of a ground with detail of all sizes: uint8 (rows down from the north, columns, 3)."""
    import cv2

    rng = np.random.default_rng(1)
    size = (int(wide_m / GROUND_PX_M), int(high_m / GROUND_PX_M))
    ground = np.zeros((size[1], size[0], 3), np.float32)
    for cell_m, share in ((40.0, 80.0), (8.0, 80.0), (2.0, 60.0), (0.5, 35.0)):
        cells = rng.uniform(0.0, share, (int(high_m / cell_m) + 2, int(wide_m / cell_m) + 2, 3)).astype(np.float32)
        ground += cv2.resize(cells, size, interpolation=cv2.INTER_LINEAR)
    return ground.astype(np.uint8)


def photograph(ground: np.ndarray, camera: Camera) -> bytes:
    """The JPEG of a camera over the ground, whose south-west corner is 200 m south-west of the origin."""
    import cv2

    rows = ground.shape[0]
    to_cells = np.array(
        [[1 / GROUND_PX_M, 0.0, 200.0 / GROUND_PX_M], [0.0, -1 / GROUND_PX_M, rows - 200.0 / GROUND_PX_M], [0, 0, 1.0]]
    )
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return jpeg(cv2.warpPerspective(ground, to_cells @ camera.homography(0.0), (640, 480), flags=flags))


def jpeg(picture: np.ndarray) -> bytes:
    import simplejpeg

    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(picture), 88, "RGB", "420"))


def write_map(ground: np.ndarray, path: Path) -> None:
    """The ground as a GeoTIFF of a coarser pixel."""
    import cv2
    import rasterio
    from rasterio.transform import from_origin

    share = GROUND_PX_M / MAP_PX_M
    small = cv2.resize(ground, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    north = NORTH - 200.0 + ground.shape[0] * GROUND_PX_M
    about = {"driver": "GTiff", "height": small.shape[0], "width": small.shape[1], "count": 3, "dtype": "uint8"}
    transform = from_origin(EAST - 200.0, north, MAP_PX_M, MAP_PX_M)
    with rasterio.open(path, "w", crs=f"EPSG:{EPSG}", transform=transform, tiled=True, **about) as raster:
        raster.write(np.moveaxis(small, -1, 0))


# -- the load --------------------------------------------------------------------------------------------------------


class Connection:
    """One companion computer's persistent connection, with prepared requests.

    A general HTTP client takes more CPU for each picture than the daemon does: on one machine it would be measured
    in the daemon's place.
    """

    def __init__(self, url: str) -> None:
        self._host, _, port = url.removeprefix("http://").partition(":")
        self._port = int(port)
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def post(self, picture: bytes, pose: str) -> int:
        """Send a picture with its pose; returns the HTTP status."""
        if self._streams is None:
            self._streams = await asyncio.open_connection(self._host, self._port)
        reader, writer = self._streams
        before = (
            f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="pose"\r\n\r\n{pose}\r\n--{BOUNDARY}\r\n'
            'Content-Disposition: form-data; name="image"; filename="p.jpg"\r\nContent-Type: image/jpeg\r\n\r\n'
        ).encode()
        after = f"\r\n--{BOUNDARY}--\r\n".encode()
        length = len(before) + len(picture) + len(after)
        head = (
            f"POST /api/frames HTTP/1.1\r\nHost: {self._host}\r\nContent-Length: {length}\r\n"
            f"Content-Type: multipart/form-data; boundary={BOUNDARY}\r\n\r\n"
        ).encode()
        writer.write(b"".join((head, before, picture, after)))
        answer = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
        body = re.search(r"content-length: (\d+)", answer)
        await reader.readexactly(int(body[1]) if body else 0)
        return int(answer.split()[1])


async def fly(
    connection: Connection, vehicle: int, rate: float, *, until: float, course: Course, took: list[float]
) -> None:
    grid = LocalGrid(EPSG)
    lat_0, lon_0 = (float(v) for v in grid.to_geographic([EAST, NORTH]))
    turn = grid.convergence_rad(lat_0, lon_0)
    number = 0
    start = time.monotonic() + vehicle / (rate * 97.0)
    while time.monotonic() < until:
        await asyncio.sleep(max(0.0, start + number / rate - time.monotonic()))
        data, east, north, yaw = course(vehicle, number)
        lat, lon = (float(v) for v in grid.to_geographic([EAST + east, NORTH + north]))
        pose = {
            "vehicle": f"v{vehicle}", "image": f"{number}.jpg", "time": time.time(), "lat_deg": lat, "lon_deg": lon,
            "height_m": HEIGHT_M, "yaw_deg": float(np.degrees(yaw + turn)), "pitch_deg": -90.0, "roll_deg": 0.0,
        }  # fmt: skip
        began = time.monotonic()
        if await connection.post(data, json.dumps(pose)) != 201:
            raise RuntimeError(f"picture {number} of vehicle {vehicle} was refused")
        took.append(time.monotonic() - began)
        number += 1


async def load(url: str, vehicles: int, rate: float, seconds: float, course: Course) -> dict:
    took: list[float] = []
    async with httpx.AsyncClient(base_url=url, timeout=120.0) as client:
        before = figures((await client.get("/metrics")).text)
        began, cpu = time.monotonic(), time.process_time()
        connections = [Connection(url) for _ in range(vehicles)]
        behind: list[float] = []
        watching = asyncio.create_task(watch(client, behind))
        await asyncio.gather(
            *(fly(c, v, rate, until=began + seconds, course=course, took=took) for v, c in enumerate(connections))
        )
        watching.cancel()
        wall, cpu = time.monotonic() - began, time.process_time() - cpu
        posted = figures((await client.get("/metrics")).text)
        while figures((await client.get("/metrics")).text)["frames_drawn_total"] < len(took):
            await asyncio.sleep(0.1)
        after = figures((await client.get("/metrics")).text)
        jobs = (await client.get("/api/jobs")).json()
    return {
        "vehicles": vehicles,
        "asked_per_s": vehicles * rate,
        "accepted_per_s": round(len(took) / wall, 1),
        "post_ms": {q: round(1e3 * float(np.percentile(took, q)), 1) for q in (50, 95, 99, 100)},
        "on_map_s": {q: round(after.get(f'draw_latency_seconds{{quantile="{q}"}}', 0.0), 3) for q in (0.5, 0.99, 1)},
        "behind_s": {q: round(float(np.percentile(behind, q)), 2) for q in (50, 95, 100)},
        "later_than_1_s": int(after["frames_late_total"]),
        "cpu_share_of_a_core": round((posted["cpu_seconds_total"] - before["cpu_seconds_total"]) / wall, 2),
        "cpu_share_of_the_senders": round(cpu / wall, 2),
        "resident_mb": round(after["resident_megabytes"]),
        "frames": len(took),
        "coarse": coarse_figures(jobs, wall),
    }


async def watch(client: httpx.AsyncClient, behind: list[float]) -> None:
    """Note how far the map is behind, until cancelled."""
    while True:
        behind.append(figures((await client.get("/metrics")).text)["draw_behind_seconds"])
        await asyncio.sleep(0.25)


def coarse_figures(jobs: list[dict], wall_s: float) -> dict:
    """Coarse maps made, pictures placed in them, jobs that came to nothing, share of the time with one under way."""
    done = [job for job in jobs if job["kind"] == "coarse" and job["ended"]]
    made = [job for job in done if "frames" in job["detail"]]
    busy = sum((moment(job["ended"]) - moment(job["started"])) for job in done if job["started"])
    return {
        "maps": len(made),
        "pictures": sum(job["detail"]["frames"] for job in made),
        "nothing": sorted({job["detail"].get("note") or job["message"] for job in done if job not in made}),
        "busy_share": round(busy / wall_s, 2),
    }


def moment(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def figures(text: str) -> dict[str, float]:
    pairs = re.findall(r"^orthoswarm_(\S+) (\S+)$", text, re.MULTILINE)
    return {name: float(value) for name, value in pairs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, nargs="+", default=[8, 32, 96])
    parser.add_argument("--rate", type=float, default=2.0, help="pictures a second of each vehicle")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--legs", action="store_true", help="pictures of which coarse maps are made meanwhile")
    args = parser.parse_args()
    for count in args.vehicles:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "gcs_plugin.cli", "serve", "--workspace", str(Path(folder) / "w")]
            basemap = Path(folder) / "map.tif"
            if args.legs:
                course = legs(count, int(args.rate * args.seconds) + 2, basemap)
                command += ["--basemap", str(basemap)]
            else:
                course = same_course()
            process = subprocess.Popen(
                [*command, "--port", "0"], stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}
            )
            assert process.stdout is not None
            try:
                found = re.search(r"http://[^/]+", process.stdout.readline())
                assert found is not None
                time.sleep(5.0)  # kernels and workers are warm then
                print(json.dumps(asyncio.run(load(found[0], count, args.rate, args.seconds, course))), flush=True)
            finally:
                process.terminate()
                process.wait(30)


if __name__ == "__main__":
    main()
