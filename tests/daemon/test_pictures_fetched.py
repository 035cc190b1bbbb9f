"""Pictures stay on a vehicle's card: they are asked from it in flight, arrive, and the ground counts as seen."""

import math
import time
from pathlib import Path

import pytest

from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm
from tests.kit.daemon_kit import GRID, camera_at, jpeg, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.vehicles.file_server import CardVehicle, FileServer
from tests.kit.vehicles.sim_cameras import Cameras, square

_ON_THE_CARD = range(5, 13)


class CardCameras(Cameras):
    """Cameras whose pictures of some numbers stay on the vehicle, which serves them."""

    def expose(self, vehicle, exposure):
        if exposure.index not in _ON_THE_CARD:
            super().expose(vehicle, exposure)
            return
        pose = exposure.pose
        east, north = GRID.to_grid(pose.lat_deg, pose.lon_deg)
        turn = float(GRID.convergence_rad(pose.lat_deg, pose.lon_deg))
        camera = camera_at(east - EAST, north - NORTH, pose.height_m, math.degrees(pose.yaw_rad - turn))
        name = f"{vehicle.utc_s(exposure.time_s):.0f}-{exposure.index}.jpg"
        vehicle.files.files[f"/DCIM/{name}"] = jpeg(camera)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("autopilot", [Autopilot.ARDUPILOT, Autopilot.PX4])
def test_pictures_on_the_card_are_fetched_over_the_link(tmp_path: Path, autopilot: Autopilot) -> None:
    lat, lon = (float(v) for v in GRID.to_geographic([EAST - 80.0, NORTH - 80.0]))
    cameras, server = CardCameras(), FileServer()
    vehicle = CardVehicle(
        server, system=1, autopilot=autopilot, home=(lat, lon, 500.0), airframe=Airframe(climb_m_s=8.0),
        on_exposure=cameras.expose, boot_utc_s=time.time(),
    )  # fmt: skip
    with (
        SimSwarm([vehicle], "tcpin:127.0.0.1:0", speed=4.0) as swarm,
        serving(tmp_path / "w", "--link", swarm.addresses[0]) as served,
    ):
        cameras.served = served
        served.until("/api/vehicles", lambda rows: any(r.get("lat_deg") is not None for r in rows))
        start = served.get("/api/vehicles").json()[0]
        body = {
            "area": square(120), "vehicles": 1, "altitude_m": 60, "fov_min_deg": 65, "speed_m_s": 8,
            "autopilot": autopilot.value, "starts": [[start["lat_deg"], start["lon_deg"]]],
        }  # fmt: skip
        plan = served.command("/api/plans", body).json()
        assert served.command("/api/missions/v1/upload", {"plan": plan["id"]}).json()["outcome"] == "done"
        served.start_plan(plan["id"])
        # One that is posted late is asked for meanwhile, too, until it has come.
        served.until(
            "/api/coverage",
            lambda c: (
                c["state"] == "complete"
                and [(r["number"], r["state"]) for r in c["requests"]] == [(n, "arrived") for n in _ON_THE_CARD]
            ),
        )
        count = cameras.all_posted() + len(_ON_THE_CARD)
        served.until("/api/coverage", lambda c: not c["missing_pictures"] and sum(c["pictures"].values()) == count)
        stored = {row["image"] for row in served.get("/api/frames").json()}
        assert {path.rpartition("/")[2] for path in server.files} <= stored
        cameras.over = True
