"""How long it takes the daemon to show a vehicle refined: photos are posted, the refinement is asked for, timed.

    python -m benchmarks.speed.daemon_refine out/twin [--pack]

The folder is one that `orthoswarm twin make` wrote (photos/, basemap.tif). Prints a line of JSON for each vehicle:
its pictures, seconds from the wish to its refined pixels on the map, and CPU seconds of the solution; meanwhile the
next vehicle's pictures come in, four a second. On COMPLETE the daemon waits 0.7 s more, to see that no more pictures
come. With --pack the offline pack is asked for together with the last refinement, and a line says when its ZIP was
ready and what it is.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from orthoswarm.model.frame import Frame

RATE_HZ = 4.0


def record(frame: Frame) -> dict[str, Any]:
    """A picture's record as a companion computer posts it."""
    fix = frame.fix
    angles = {"yaw_deg": fix.yaw_rad, "pitch_deg": fix.pitch_rad, "roll_deg": fix.roll_rad}
    return {
        "vehicle": frame.vehicle, "image": frame.image, "time": frame.time_s, "lat_deg": fix.lat_deg,
        "lon_deg": fix.lon_deg, "height_m": fix.height_m,
        **{key: float(np.degrees(value)) for key, value in angles.items() if value is not None},
    }  # fmt: skip


def post(client: httpx.Client, frame: Frame) -> None:
    """A picture with its record."""
    files = {"image": (frame.path.name, frame.path.read_bytes(), "image/jpeg")}
    client.post("/api/frames", files=files, data={"pose": json.dumps(record(frame))}).raise_for_status()


def slowly(client: httpx.Client, frames: list[Frame], stop: threading.Event) -> None:
    """Post pictures as a vehicle that flies, and the rest at once when told to."""
    start = time.monotonic()
    for k, frame in enumerate(frames):
        stop.wait(max(0.0, start + k / RATE_HZ - time.monotonic()))
        post(client, frame)


def refined(client: httpx.Client, token: str, vehicle: str) -> dict:
    """Ask for a refinement and wait for it."""
    asked, headers = time.time(), {"Authorization": f"Bearer {token}"}
    (job,) = client.post("/api/refine", json={"vehicle": vehicle}, headers=headers).raise_for_status().json()
    while True:
        job = next(row for row in client.get("/api/jobs").json() if row["id"] == job["id"])
        if job["state"] in ("done", "failed"):
            break
        time.sleep(0.05)
    detail = job["detail"]
    if job["state"] == "failed":
        return {"vehicle": vehicle, "failed": job["message"]}
    return {
        "vehicle": vehicle,
        "pictures": detail["frames"],
        "on_map_s": round(detail["published_s"] - asked, 2),
        "solve_cpu_s": detail["solve_cpu_s"],
    }


def time_pack(client: httpx.Client, token: str, asked: float, workspace: Path) -> None:
    """Ask for the pack, which waits for the refinement, and print when its ZIP was ready."""
    headers = {"Authorization": f"Bearer {token}"}
    job = client.post("/api/export", json={"formats": ["pack"]}, headers=headers).raise_for_status().json()
    while True:
        job = next(row for row in client.get("/api/jobs").json() if row["id"] == job["id"])
        if job["state"] in ("done", "failed"):
            break
        time.sleep(0.1)
    if job["state"] == "failed":
        print(json.dumps({"pack": job["message"]}), flush=True)
        return
    archive = workspace / job["detail"]["files"]["pack"]
    report = json.loads((workspace / "report.json").read_text())
    figures = {
        "pack_ready_s": round(archive.stat().st_mtime - asked, 1),
        "megabytes": round(archive.stat().st_size / 1e6),
        "unrefined": report["unrefined"],
    }
    print(json.dumps(figures), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("twin", type=Path)
    parser.add_argument("--pack", action="store_true", help="time the offline pack, too")
    args = parser.parse_args()
    import telemetry

    vehicles: dict[str, list[Frame]] = {}
    for frame in telemetry.load([args.twin / "photos"]).frames:
        vehicles.setdefault(frame.vehicle, []).append(frame)
    names = sorted(vehicles)
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder) / "w"
        command = [sys.executable, "-m", "gcs_plugin.cli", "serve", "--port", "0", "--workspace", str(workspace)]
        process = subprocess.Popen(
            [*command, "--basemap", str(args.twin / "basemap.tif")], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        try:
            found = re.search(r"http://[^/]+", process.stdout.readline())
            assert found is not None
            token = (workspace / "token").read_text().strip()
            with httpx.Client(base_url=found[0], timeout=120.0) as client:
                for frame in vehicles[names[0]]:
                    post(client, frame)
                for name, other in zip(names, [*names[1:], ""], strict=True):
                    stop = threading.Event()
                    flying = threading.Thread(target=slowly, args=(client, vehicles.get(other, []), stop))
                    flying.start()
                    time.sleep(5.0)  # what came before is drawn then
                    asked = time.time()
                    waiting = None
                    if args.pack and not other:
                        waiting = threading.Timer(0.2, time_pack, (client, token, asked, workspace))
                        waiting.start()
                    print(json.dumps(refined(client, token, name)), flush=True)
                    if waiting is not None:
                        waiting.join()
                    stop.set()
                    flying.join()
        finally:
            process.terminate()
            process.wait(60)


if __name__ == "__main__":
    main()
