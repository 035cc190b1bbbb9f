"""A camera does not trigger for a while: the gap is known when the flight is over, and one confirmation flies it."""

from pathlib import Path
from typing import Any

import pytest

from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from tests.kit.daemon_kit import GRID, Served, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.sim_cameras import Cameras, square

MISFIRES = range(6, 15)


@pytest.fixture
def flying(tmp_path: Path):
    """A daemon with two simulated vehicles, whose cameras post what they see."""
    lat, lon = (float(v) for v in GRID.to_geographic([EAST - 100.0, NORTH - 100.0]))
    cameras = Cameras()
    vehicles = make_swarm(2, home=(lat, lon, 500.0), airframe=Airframe(climb_m_s=8.0), on_exposure=cameras.expose)
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=6.0) as swarm:
        links = [text for address in swarm.addresses for text in ("--link", address)]
        with serving(tmp_path / "w", *links) as served:
            cameras.served = served
            yield served, vehicles, cameras
            cameras.over = True


def _fly(served: Served, plan: str, names: dict[str, str]) -> None:
    """What the page does after the operator's confirmation: upload to each vehicle, then start the plan."""
    for mission, vehicle in names.items():
        answer = served.command(f"/api/missions/{vehicle}/upload", {"plan": plan, "mission": mission})
        assert answer.json()["outcome"] == "done", answer.text
    served.start_plan(plan, {"vehicles": names})


def _over(served: Served, cameras: Cameras, flights: int) -> dict[str, Any]:
    """The coverage when so many flights have ended, all pictures have come and are placed, and nobody flies."""
    served.until("/api/completions", lambda rows: len(rows) == flights and all("version" in r for r in rows), 600)
    served.until("/api/vehicles", lambda rows: not any(r["armed"] for r in rows), 600)
    all_placed = {"placed": cameras.all_posted(), "recorded": 0}
    found: dict[str, Any] = served.until(
        "/api/coverage", lambda c: c["state"] == "complete" and c["pictures"] == all_placed, 600
    )
    return found


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_a_gap_of_missed_triggers_is_flown_after_one_confirmation(flying) -> None:
    served, vehicles, cameras = flying
    served.until("/api/vehicles", lambda rows: sum(r.get("lat_deg") is not None for r in rows) == 2)
    starts = [[r["lat_deg"], r["lon_deg"]] for r in sorted(served.get("/api/vehicles").json(), key=lambda r: r["id"])]
    body = {"area": square(150), "vehicles": 2, "altitude_m": 60, "fov_min_deg": 65, "speed_m_s": 8, "starts": starts}
    first = served.command("/api/plans", body).json()
    vehicles[0].flight.misfires = MISFIRES
    _fly(served, first["id"], {"v1": "v1", "v2": "v2"})

    rows = served.until("/api/coverage/vehicles", lambda rows: [r for r in rows if "flying" in r["busy"]])
    busy = next(r["id"] for r in rows if "flying" in r["busy"])
    refused = served.command("/api/coverage/flight", {"vehicles": {busy: 10.0}})
    assert refused.status_code == 409 and "still flying" in refused.text, refused.text

    missed = _over(served, cameras, flights=2)
    assert missed["missed_share"] > 0.01
    unseen = {(g["cause"], g["vehicle"]) for g in missed["gaps"] if g["cause"] != "seen poorly" and g["area_m2"] > 50}
    assert unseen == {("not triggered", "v1")}

    uploads = len(served.get("/api/plans").json())
    again = served.command("/api/coverage/flight", {"vehicles": {"v1": 10.0, "v2": 10.0}}).json()
    rows = served.get("/api/vehicles").json()
    assert all(not r["armed"] for r in rows) and len(served.get("/api/plans").json()) == uploads + 1
    assert again["covered_share"] == pytest.approx(1.0) and again["id"] != first["id"]

    _fly(served, again["id"], again["names"])
    seen = _over(served, cameras, flights=2 + len(again["names"]))
    assert seen["plan"] == first["id"]  # still the area of the first plan
    # Without a map, positions are uncertain by metres, so that edges of pictures count as seen poorly.
    assert seen["seen_share"] + seen["poor_share"] >= 0.999 and seen["missed_share"] < 0.001
