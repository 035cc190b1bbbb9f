"""Cameras of simulated vehicles over the made-up ground, and an area there to be flown."""

import math
import queue
import threading
import time

import httpx

from tests.kit.daemon_kit import GRID, Shot, camera_at, jpeg, pose_of
from tests.kit.mosaic_scene import EAST, NORTH


class Cameras:
    """Take a picture of the made-up ground at each exposure and post it, with the recorded pose."""

    def __init__(self):
        self.waiting: queue.SimpleQueue = queue.SimpleQueue()
        self.served = None
        self.posted = 0
        self.count = 0
        self.over = False
        threading.Thread(target=self.run, daemon=True).start()

    def expose(self, vehicle, exposure):
        self.count += 1
        self.waiting.put((vehicle.system, exposure.index, exposure.pose, vehicle.utc_s(exposure.time_s)))

    def all_posted(self):
        """Wait until the daemon has every picture; gives their number."""
        end = time.monotonic() + 300.0
        while self.posted < self.count:
            assert time.monotonic() < end, f"{self.posted} of {self.count} pictures were posted"
            time.sleep(0.05)
        return self.count

    def run(self):
        while True:
            system, index, pose, time_s = self.waiting.get()
            east, north = GRID.to_grid(pose.lat_deg, pose.lon_deg)
            turn = float(GRID.convergence_rad(pose.lat_deg, pose.lon_deg))
            camera = camera_at(east - EAST, north - NORTH, pose.height_m, math.degrees(pose.yaw_rad - turn))
            name = f"{time_s:.0f}-{index}.jpg"
            try:
                answer = self.served.send(Shot(pose_of(camera, name, f"v{system}", time_s), jpeg(camera)))
            except httpx.TransportError:
                if self.over:  # the test has ended while vehicles still fly
                    return
                raise
            if self.over and answer.status_code != 201:  # the daemon is ending
                return
            assert answer.status_code == 201, answer.text
            self.posted += 1


def square(side_m):
    lat, lon = GRID.to_geographic([EAST, NORTH])
    dlat, dlon = side_m / 111_000 / 2, side_m / 111_000 / 2 / math.cos(math.radians(lat))
    ring = [[lon - dlon, lat - dlat], [lon + dlon, lat - dlat], [lon + dlon, lat + dlat], [lon - dlon, lat + dlat]]
    return {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
