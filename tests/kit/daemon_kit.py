"""A daemon to test: pictures of a made-up ground with their poses, and `orthoswarm serve` as a process."""

import contextlib
import io
import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np

from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.geo import LocalGrid
from tests.kit.mosaic_scene import EAST, NORTH, picture_of

GRID = LocalGrid(32648)
FOV_DEG = 70.0
SIZE = (160, 120)
# One for all: each new client reads all certificates of the machine, which costs more than the daemon's answer.
_CLIENT = httpx.Client(
    timeout=240, verify=False, trust_env=False, limits=httpx.Limits(max_connections=None, max_keepalive_connections=0)
)


class StoppedWorkers:
    """A pool of workers whose process is taken away while it writes the file that `target` gives of its task."""

    def __init__(self, target):
        self._target, self.began, self.ends = target, threading.Event(), threading.Event()
        self.count, self.asked = 1, 0

    def run(self, function, task):
        self.ends.clear()
        self.asked += 1
        self._target(task).write_bytes(b"half")
        self.began.set()
        assert self.ends.wait(300)
        raise OrthoSwarmError("a worker process was stopped from outside")

    def abandon(self):
        self.ends.set()


def camera_at(east=0.0, north=0.0, height=60.0, yaw_deg=0.0) -> Camera:
    lens = Lens(*SIZE, focal_px(np.radians(FOV_DEG), SIZE[0]))
    rotation = rotation_from_angles(np.radians(yaw_deg), -np.pi / 2, 0.0)
    return Camera(np.array([EAST + east, NORTH + north, height]), rotation, lens)


def jpeg(camera: Camera, quality=92) -> bytes:
    import simplejpeg

    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(picture_of(camera)), quality, "RGB", "420"))


def pose_of(camera: Camera, image: str, vehicle="v1", time_s=1_780_000_000.0) -> dict:
    lat, lon = (float(v) for v in GRID.to_geographic(camera.position[:2]))
    turn = float(np.degrees(GRID.convergence_rad(lat, lon)))
    yaw = float(np.degrees(np.arctan2(-camera.rotation[0, 1], -camera.rotation[1, 1])))
    return {
        "vehicle": vehicle, "image": image, "time": time_s, "lat_deg": lat, "lon_deg": lon,
        "height_m": float(camera.position[2]), "yaw_deg": yaw + turn, "pitch_deg": -90.0, "roll_deg": 0.0,
    }  # fmt: skip


@dataclass
class Shot:
    """A picture ready to be posted."""

    pose: dict
    data: bytes
    camera: Camera | None = None


def line(count: int, vehicle="v1", east=0.0, step_m=12.0, first=0) -> list[Shot]:
    """Pictures along a straight leg to the north."""
    shots = []
    for k in range(first, first + count):
        camera = camera_at(east, k * step_m)
        shots.append(Shot(pose_of(camera, f"{k:04d}.jpg", vehicle, 1_780_000_000.0 + k), jpeg(camera), camera))
    return shots


def form(shot: Shot) -> dict:
    return {
        "files": {"image": ("picture.jpg", io.BytesIO(shot.data), "image/jpeg")},
        "data": {"pose": json.dumps(shot.pose)},
    }  # fmt: skip


@dataclass
class Served:
    """A running `orthoswarm serve`."""

    process: subprocess.Popen
    url: str
    token: str
    said: list[str] = field(default_factory=list)

    @property
    def auth(self) -> dict:
        return {"Authorization": f"Bearer {self.token}"}

    def get(self, path: str, **options) -> httpx.Response:
        return _CLIENT.get(self.url + path, **options)

    def post(self, path: str, **options) -> httpx.Response:
        return _CLIENT.post(self.url + path, **options)

    def command(self, path: str, body: dict | None = None) -> httpx.Response:
        return self.post(path, json=body or {}, headers=self.auth)

    def send(self, shot: Shot) -> httpx.Response:
        return self.post("/api/frames", **form(shot))

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(120)

    def until(self, path: str, done, limit_s=300.0):
        """Poll an address until something is so; gives its last JSON. It gives up when nothing changes for a time.

        A busy daemon may refuse to answer; its health is told with an error's status where there are problems.
        """
        before, end = None, 0.0
        while True:
            answer = self.get(path, headers=self.auth)
            value = answer.json()
            if (answer.is_success or path == "/healthz") and done(value):
                return value
            if (now := (value, self.get("/api/jobs", headers=self.auth).json())) != before:
                before, end = now, time.monotonic() + limit_s
            if time.monotonic() > end:
                raise AssertionError(f"{path} is still {now[0]}; jobs {now[1]}")
            time.sleep(0.1)

    def start_plan(self, plan: str, body: dict | None = None) -> dict:
        """Start a plan's vehicles, again until they are ready; gives the answer.

        A vehicle's state comes piece by piece and grows old on a busy machine, as it does on a poor link.
        """
        answers = []

        def starts(_rows: list[dict]) -> bool:
            answers.append(self.command(f"/api/plans/{plan}/start", body))
            return answers[-1].status_code == 202

        try:
            self.until("/api/vehicles", starts)
        except AssertionError:
            raise AssertionError(f"{plan} does not start: {answers[-1].text}") from None
        return answers[-1].json()

    def take_off(self, vehicle: str, limit_s: float = 400.0) -> None:
        """Start a vehicle's mission, again until its autopilot lets it: its own checks may take minutes.

        One whose start was not answered in time may fly all the same. Its battery may be empty, as simulated ones get.
        """
        answers = []

        def flies(rows: list[dict]) -> bool:
            row = next((r for r in rows if r["id"] == vehicle), {})
            if row.get("armed") and row.get("mission", {}).get("phase") == "active":
                return True
            time.sleep(1.0)
            answers.append(self.command(f"/api/missions/{vehicle}/start", {"override": ["battery"]}).json())
            return answers[-1]["outcome"] == "done"

        try:
            self.until("/api/vehicles", flies, limit_s)
        except AssertionError:
            raise AssertionError(f"{vehicle} does not start: {answers[-1:]}") from None


def end_with_us() -> None:
    """A test run that is killed leaves no daemon behind."""
    import ctypes

    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def start(workspace: Path, *arguments: str, port: int = 0, limit_s: float = 240.0) -> Served:
    """Start `orthoswarm serve` and wait until it answers."""
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "gcs_plugin.cli",
            "serve",
            "--workspace",
            str(workspace),
            "--port",
            str(port),
            *arguments,
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        preexec_fn=end_with_us if sys.platform == "linux" else None,
    )
    said: list[str] = []
    lines: queue.SimpleQueue = queue.SimpleQueue()

    def read() -> None:
        assert process.stdout is not None
        for text in process.stdout:
            said.append(text)
            lines.put(text)
        process.stdout.close()
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    end = time.monotonic() + limit_s
    url = ""
    while not url:
        text = lines.get(timeout=max(0.1, end - time.monotonic()))
        if text is None:
            process.wait()
            raise AssertionError(f"serve ended with {process.returncode}: {''.join(said)}")
        found = re.search(r"map: (https?://\S+?)/(#|\s|$)", text)
        url = found[1] if found else ""
    token = (workspace / "token").read_text().strip() if (workspace / "token").exists() else ""
    served = Served(process, url, token, said)
    while True:
        with contextlib.suppress(httpx.TransportError):
            if served.get("/healthz").status_code == 200:
                return served
        if process.poll() is not None or time.monotonic() > end:
            stop(served)
            raise AssertionError(f"serve does not answer: {''.join(said)}")
        time.sleep(0.05)


def stop(served: Served) -> int:
    """End it as a user does; gives its exit code."""
    if served.process.poll() is None:
        served.process.send_signal(signal.SIGINT)
        try:
            served.process.wait(120)
        except subprocess.TimeoutExpired:
            served.process.kill()
            served.process.wait(120)
    return served.process.returncode


@contextlib.contextmanager
def serving(workspace: Path, *arguments: str, port: int = 0):
    served = start(workspace, *arguments, port=port)
    try:
        yield served
    finally:
        stop(served)


def exported(jobs: list[dict]) -> bool:
    """Whether products were written last of all that changes them, and nothing else is to be done."""
    after = [job for job in jobs if job["kind"] not in ("export", "change")]
    makers = [job for job in after if job["kind"] != "coarse" or "after" in job["detail"]]
    others = [job["ended"] for job in makers if job["state"] in ("done", "failed")]
    wrote = [job["started"] for job in jobs if job["kind"] == "export" and job["state"] == "done"]
    over = all(job["state"] in ("done", "failed") for job in jobs)
    return over and bool(wrote) and max(wrote) >= max(others, default="")


def tile_over(camera: Camera, zoom=19) -> tuple[int, int, int]:
    """The web tile that holds the ground below a camera."""
    lat, lon = np.radians(GRID.to_geographic(camera.position[:2]))
    n = 1 << zoom
    return zoom, int((lon / np.pi + 1) / 2 * n), int((1 - np.arcsinh(np.tan(lat)) / np.pi) / 2 * n)
