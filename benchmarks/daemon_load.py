"""How many pictures a second the daemon takes: N simulated companion computers post at a rate, over loopback.

    python benchmarks/daemon_load.py --vehicles 8 32 96 --rate 2 --seconds 20

Prints a line of JSON for each number of vehicles: frames accepted a second, time of a POST (median, 95 %), time from
arrival to the map (by the daemon's own metrics), CPU share of the daemon's process and its memory.
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
from pathlib import Path

import httpx
import numpy as np

from orthoswarm.geo import LocalGrid

EAST, NORTH, EPSG = 327000.0, 3383000.0, 32648


def pictures(count: int = 12) -> list[bytes]:
    """JPEGs of 640x480 with the detail of a town seen from 100 m."""
    import cv2
    import simplejpeg

    rng = np.random.default_rng(1)
    made = []
    for _ in range(count):
        coarse = cv2.resize(rng.integers(0, 255, (60, 80, 3), np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
        fine = cv2.resize(rng.integers(0, 80, (240, 320, 3), np.uint8), (640, 480))
        made.append(bytes(simplejpeg.encode_jpeg(cv2.add(coarse, fine), 88, "RGB", "420")))
    return made


async def fly(client: httpx.AsyncClient, vehicle: int, rate: float, until: float, data: list[bytes], took: list[float]):
    grid = LocalGrid(EPSG)
    number = 0
    start = time.monotonic() + vehicle / (rate * 97.0)
    while time.monotonic() < until:
        await asyncio.sleep(max(0.0, start + number / rate - time.monotonic()))
        east, north = EAST + 80.0 * (vehicle % 12), NORTH + 600.0 * (vehicle // 12) + 8.0 * number
        lat, lon = (float(v) for v in grid.to_geographic([east, north]))
        pose = {
            "vehicle": f"v{vehicle}", "image": f"{number}.jpg", "time": time.time(), "lat_deg": lat, "lon_deg": lon,
            "height_m": 100.0, "yaw_deg": 0.0, "pitch_deg": -90.0, "roll_deg": 0.0,
        }  # fmt: skip
        began = time.monotonic()
        files = {"image": ("p.jpg", data[number % len(data)], "image/jpeg")}
        answer = await client.post("/api/frames", files=files, data={"pose": json.dumps(pose)})
        answer.raise_for_status()
        took.append(time.monotonic() - began)
        number += 1


async def load(url: str, vehicles: int, rate: float, seconds: float) -> dict:
    took: list[float] = []
    data = pictures()
    limits = httpx.Limits(max_connections=vehicles)
    async with httpx.AsyncClient(base_url=url, timeout=120.0, limits=limits) as client:
        before = figures((await client.get("/metrics")).text)
        began = time.monotonic()
        await asyncio.gather(*(fly(client, v, rate, began + seconds, data, took) for v in range(vehicles)))
        wall = time.monotonic() - began
        posted = figures((await client.get("/metrics")).text)
        while figures((await client.get("/metrics")).text)["frames_drawn_total"] < len(took):
            await asyncio.sleep(0.1)
        after = figures((await client.get("/metrics")).text)
    return {
        "vehicles": vehicles,
        "asked_per_s": vehicles * rate,
        "accepted_per_s": round(len(took) / wall, 1),
        "post_ms": {q: round(1e3 * float(np.percentile(took, q)), 1) for q in (50, 95)},
        "on_map_s": {q: round(after.get(f'draw_latency_seconds{{quantile="{q}"}}', 0.0), 3) for q in (0.5, 0.9, 0.99)},
        "cpu_share_of_a_core": round((posted["cpu_seconds_total"] - before["cpu_seconds_total"]) / wall, 2),
        "resident_mb": round(after["resident_megabytes"]),
        "frames": len(took),
        "late": int(after["frames_late_total"]),
    }


def figures(text: str) -> dict[str, float]:
    pairs = re.findall(r"^orthoswarm_(\S+) (\S+)$", text, re.MULTILINE)
    return {name: float(value) for name, value in pairs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, nargs="+", default=[8, 32, 96])
    parser.add_argument("--rate", type=float, default=2.0, help="pictures a second of each vehicle")
    parser.add_argument("--seconds", type=float, default=20.0)
    args = parser.parse_args()
    for count in args.vehicles:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "gcs_plugin.cli", "serve", "--workspace", str(Path(folder) / "w")]
            process = subprocess.Popen(
                [*command, "--port", "0"], stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}
            )
            assert process.stdout is not None
            try:
                found = re.search(r"http://[^/]+", process.stdout.readline())
                assert found is not None
                time.sleep(5.0)  # kernels and workers are warm then
                print(json.dumps(asyncio.run(load(found[0], count, args.rate, args.seconds))), flush=True)
            finally:
                process.terminate()
                process.wait(30)


if __name__ == "__main__":
    main()
