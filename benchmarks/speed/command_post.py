"""Many people on one daemon: pages as 20 browsers make them, over TLS, beside a simulated swarm that sends pictures.

    python -m benchmarks.speed.command_post --clients 1 20 --vehicles 8 --seconds 30

Each client is invited, holds the event stream open, and asks as the page does: vehicles every 2 s, health every 5 s,
layers and twelve tiles at most every 2 s after a layer has changed (with their ETags). One of them is a pilot who
pauses a vehicle every 2 s. Pictures of all vehicles are posted once a second.

Prints a line of JSON for each number of clients: requests a second, their times by kind (ms: median, 95 %, slowest),
how late heartbeats come, bytes a second of a client, CPU shares of the daemon, and of all clients with the vehicles.
"""

import argparse
import asyncio
import json
import os
import re
import ssl
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import websockets

from benchmarks.speed.daemon_load import EAST, EPSG, HEIGHT_M, NORTH, figures, same_course
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from orthoswarm.model.geo import LocalGrid

TILES = 12
LEVEL = 18
EVERY_S = 2.0
HEALTH_S = 5.0
FAILED = 400


class Figures:
    """Times by kind, milliseconds, and bytes that came."""

    def __init__(self) -> None:
        self.took: dict[str, list[float]] = defaultdict(list)
        self.bytes, self.failed = 0, 0

    def document(self) -> dict[str, list[float]]:
        """Median, 95 % and slowest of each kind."""
        return {kind: [round(float(np.percentile(t, q)), 1) for q in (50, 95, 100)] for kind, t in self.took.items()}


class Page:
    """One browser's page."""

    def __init__(self, url: str, session: tuple[str, str], seen: Figures) -> None:
        self._url, self._cookie, self._seen = url, "=".join(session), seen
        headers = {"Cookie": self._cookie, "Origin": url}
        limits = httpx.Limits(max_connections=6, keepalive_expiry=3.0)  # as browsers; the server waits 5 s
        self._client = httpx.AsyncClient(
            base_url=url, headers=headers, verify=False, timeout=60.0, trust_env=False, limits=limits
        )
        self._etags: dict[str, str] = {}
        self._changed = asyncio.Event()

    async def ask(self, kind: str, method: str, path: str, **options: Any) -> httpx.Response:
        """One request, measured."""
        began = time.perf_counter()
        answer = await self._client.request(method, path, **options)
        self._seen.took[kind].append(1e3 * (time.perf_counter() - began))
        self._seen.bytes += answer.num_bytes_downloaded
        self._seen.failed += answer.status_code >= FAILED
        return answer

    async def listen(self, until: float) -> None:
        """Hold the event stream open."""
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        address = self._url.replace("https", "wss") + "/api/events"
        headers = {"Cookie": self._cookie, "Origin": self._url}
        async with websockets.connect(address, ssl=context, additional_headers=headers, proxy=None) as stream:
            while (left := until - time.monotonic()) > 0:
                try:
                    text = await asyncio.wait_for(stream.recv(), left)
                except TimeoutError:
                    return
                event, self._seen.bytes = json.loads(text), self._seen.bytes + len(text)
                if event["type"] == "heartbeat":
                    self._seen.took["heartbeat"].append(1e3 * (time.time() - event["time"]))
                if event["type"] == "layer":
                    self._changed.set()

    async def look(self, until: float, first: int) -> None:
        """Ask for vehicles, and for what has changed on the map."""
        tiles = tiles_round(TILES)
        while time.monotonic() < until:
            await asyncio.sleep(EVERY_S * (0.5 + (first % 10) / 10))
            await self.ask("vehicles", "GET", "/api/vehicles")
            if not self._changed.is_set():
                continue
            self._changed.clear()
            await self.ask("layers", "GET", "/api/layers")
            await asyncio.gather(*(self._tile(path) for path in tiles))

    async def _tile(self, path: str) -> None:
        known = {"If-None-Match": self._etags[path]} if path in self._etags else {}
        answer = await self.ask("tile", "GET", path, headers=known)
        self._etags[path] = answer.headers.get("etag", "")

    async def watch_health(self, until: float) -> None:
        """Ask for problems."""
        while time.monotonic() < until:
            await self.ask("health", "GET", "/healthz")
            await asyncio.sleep(HEALTH_S)

    async def command(self, until: float) -> None:
        """Pause a vehicle again and again."""
        while time.monotonic() < until:
            await self.ask("command", "POST", "/api/missions/v1/pause", json={})
            await asyncio.sleep(EVERY_S)

    async def open(self, until: float, number: int) -> None:
        """Do all of it until then."""
        work = [self.listen(until), self.look(until, number), self.watch_health(until)]
        await asyncio.gather(*work, *([self.command(until)] if number == 0 else []))
        await self._client.aclose()


def tiles_round(count: int) -> list[str]:
    """Addresses of tiles round the place where pictures are taken."""
    lat, lon = np.radians(LocalGrid(EPSG).to_geographic([EAST + 100.0, NORTH + 100.0]))
    n = 1 << LEVEL
    x, y = int((lon / np.pi + 1) / 2 * n), int((1 - np.arcsinh(np.tan(lat)) / np.pi) / 2 * n)
    return [f"/tiles/best/{LEVEL}/{x + k % 4 - 2}/{y + k // 4 - 1}.webp" for k in range(count)]


async def send_pictures(url: str, token: str, vehicles: int, until: float) -> None:
    course, grid, number = same_course(), LocalGrid(EPSG), 0
    headers = {"Authorization": f"Bearer {token}"}
    async with httpx.AsyncClient(base_url=url, headers=headers, verify=False, timeout=60.0, trust_env=False) as client:
        while time.monotonic() < until:
            began = time.monotonic()
            for vehicle in range(1, vehicles + 1):
                data, east, north, yaw = course(vehicle, number)
                lat, lon = (float(v) for v in grid.to_geographic([EAST + east, NORTH + north]))
                pose = {
                    "vehicle": f"v{vehicle}", "image": f"{until:.0f}-{number}.jpg", "time": time.time(), "lat_deg": lat,
                    "lon_deg": lon, "height_m": HEIGHT_M, "yaw_deg": yaw, "pitch_deg": -90.0, "roll_deg": 0.0,
                }  # fmt: skip
                files = {"image": ("p.jpg", data, "image/jpeg")}
                (await client.post("/api/frames", files=files, data={"pose": json.dumps(pose)})).raise_for_status()
            number += 1
            await asyncio.sleep(max(0.0, 1.0 - (time.monotonic() - began)))


async def load(url: str, token: str, clients: int, vehicles: int, seconds: float, round_: int) -> dict:
    seen, sessions = Figures(), []
    operator = {"Authorization": f"Bearer {token}"}
    async with httpx.AsyncClient(base_url=url, verify=False, timeout=60.0, trust_env=False) as client:
        for number in range(clients):
            wanted = {"name": f"{round_}-{number}", "role": "viewer" if number else "pilot"}
            link = (await client.post("/api/people", json=wanted, headers=operator)).json()["link"]
            await client.post("/api/session", json={"invitation": link.split("=")[1]})
            sessions.append(next((cookie.name, str(cookie.value)) for cookie in client.cookies.jar))
            client.cookies.clear()
        before = figures((await client.get("/metrics", headers=operator)).text)
        began, cpu = time.monotonic(), time.process_time()
        until = began + seconds
        pages = [Page(url, session, seen) for session in sessions]
        pictures = send_pictures(url, token, vehicles, until)
        await asyncio.gather(pictures, *(page.open(until, number) for number, page in enumerate(pages)))
        wall, cpu = time.monotonic() - began, time.process_time() - cpu
        after = figures((await client.get("/metrics", headers=operator)).text)
    asked = sum(len(times) for kind, times in seen.took.items() if kind != "heartbeat")
    return {
        "clients": clients, "vehicles": vehicles, "requests_per_s": round(asked / wall, 1), "failed": seen.failed,
        "ms": seen.document(), "kb_per_s_of_a_client": round(seen.bytes / wall / clients / 1e3, 1),
        "cpu_share_of_the_daemon": round((after["cpu_seconds_total"] - before["cpu_seconds_total"]) / wall, 2),
        "cpu_share_of_clients_and_vehicles": round(cpu / wall, 2),
        "resident_mb": round(after["resident_megabytes"]),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 20])
    parser.add_argument("--vehicles", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=30.0)
    args = parser.parse_args()
    lat, lon = (float(v) for v in LocalGrid(EPSG).to_geographic([EAST, NORTH]))
    swarm = make_swarm(args.vehicles, home=(lat, lon, 500.0))
    with tempfile.TemporaryDirectory() as folder, SimSwarm(swarm, "tcpin:127.0.0.1:0") as flying:
        command = [sys.executable, "-m", "gcs_plugin.cli", "serve", "--lan", "--bind", "127.0.0.1", "--port", "0"]
        links = [text for address in flying.addresses for text in ("--link", address)]
        process = subprocess.Popen(
            [*command, "--workspace", str(Path(folder) / "w"), *links],
            stdout=subprocess.PIPE, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        assert process.stdout is not None
        try:
            found = re.search(r"(https://[^/]+)/#token=(\S+)", process.stdout.readline())
            assert found is not None
            time.sleep(8.0)  # workers are warm and vehicles heard then
            for round_, clients in enumerate(args.clients):
                row = asyncio.run(load(found[1], found[2], clients, args.vehicles, args.seconds, round_))
                print(json.dumps(row), flush=True)
        finally:
            process.terminate()
            process.wait(30)


if __name__ == "__main__":
    main()
