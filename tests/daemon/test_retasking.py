"""A vehicle is lost in mid-mission: its legs are offered, and one that still flies takes them after a confirmation."""

import pytest

from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from tests.kit.daemon_kit import GRID, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.sim_cameras import Cameras, square

SILENT_S = 1e6
LAST_PICTURE = 4


@pytest.fixture
def flying(tmp_path):
    """A daemon with two simulated vehicles, whose cameras post what they see."""
    lat, lon = (float(v) for v in GRID.to_geographic([EAST - 100.0, NORTH - 100.0]))
    cameras = Cameras()
    vehicles = make_swarm(2, home=(lat, lon, 500.0), airframe=Airframe(climb_m_s=8.0), on_exposure=cameras.expose)
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=2.0) as swarm:
        links = [text for address in swarm.addresses for text in ("--link", address)]
        with serving(tmp_path / "w", *links) as served:
            cameras.served = served
            yield served, swarm
            cameras.over = True


def done(answer):
    """The command was carried out."""
    assert answer.json()["outcome"] == "done", answer.text


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_legs_of_a_lost_vehicle_are_flown_by_one_that_is_in_the_air(flying):
    served, swarm = flying
    served.until("/api/vehicles", lambda rows: sum(r.get("lat_deg") is not None for r in rows) == 2)
    starts = [[r["lat_deg"], r["lon_deg"]] for r in sorted(served.get("/api/vehicles").json(), key=lambda r: r["id"])]
    body = {"area": square(150), "vehicles": 2, "altitude_m": 60, "fov_min_deg": 65, "speed_m_s": 4, "starts": starts}
    first = served.command("/api/plans", body).json()
    swarm.vehicles[1].flight.misfires = range(LAST_PICTURE + 1, 10_000)  # what comes after its loss is lost with it
    for vehicle in ("v1", "v2"):
        done(served.command(f"/api/missions/{vehicle}/upload", {"plan": first["id"], "mission": vehicle}))
    served.start_plan(first["id"], {"vehicles": {"v1": "v1", "v2": "v2"}})

    def states(rows):
        return {row["id"]: row["flight"]["state"] for row in rows}

    served.until("/api/frames", lambda rows: sum(row["vehicle"] == "v1" for row in rows) == LAST_PICTURE)
    served.until("/api/vehicles", lambda rows: states(rows)["v2"] == "on mission")
    swarm.silence(1, SILENT_S)
    offered = served.until("/api/coverage", lambda c: [row for row in c["offers"] if row["vehicle"] == "v1"])
    assert sum(row["legs"] for row in offered["offers"]) >= 1
    assert any(gap["vehicle"] == "v1" or gap["cause"] == "not flown" for gap in offered["gaps"])
    assert states(served.get("/api/vehicles").json()) == {"v1": "lost", "v2": "on mission"}

    # Nobody is given anything without a confirmation: the plan is made, v2 goes on with its own mission.
    (row,) = [row for row in served.get("/api/coverage/vehicles").json() if row["id"] == "v2"]
    assert row["in_air"] and "still flying" in row["busy"]
    wanted = {"vehicles": {"v2": 12.0}}
    assert served.command("/api/coverage/flight", wanted).status_code == 409
    again = served.command("/api/coverage/flight", wanted | {"in_air": ["v2"]}).json()
    assert again["names"] == {"v1": "v2"} and states(served.get("/api/vehicles").json())["v2"] == "on mission"

    # The confirmation, as the page carries it out.
    done(served.command("/api/missions/v2/pause"))
    served.until("/api/vehicles", lambda rows: states(rows)["v2"] == "paused")
    done(served.command("/api/missions/v2/upload", {"plan": again["id"], "mission": "v1"}))
    served.start_plan(again["id"], {"vehicles": again["names"]})
    served.until("/api/vehicles", lambda rows: states(rows)["v2"] == "on mission")
    served.until("/api/vehicles", lambda rows: states(rows)["v2"] in ("complete", "on ground"), 300)
    served.until("/api/completions", lambda rows: [r for r in rows if r["vehicle"] == "v2" and "version" in r], 300)
    flown = served.until("/api/coverage", lambda c: c["state"] == "complete" and c["planned_share"] == 0.0, 300)

    # The lost vehicle's ground has been seen; what v2 left behind for that is offered in turn.
    assert flown["missed_share"] < offered["missed_share"] + offered["planned_share"]
    assert {row["vehicle"] for row in flown["offers"]} <= {"v2"}
