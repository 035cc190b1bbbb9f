"""Vehicles on links: plan, upload, start over HTTP; completion starts the refinement by itself; a second mission."""

import json
import sys

import httpx
import pytest
import rasterio

from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from tests.kit.daemon_kit import GRID, exported, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.vehicles.sim_cameras import Cameras, square


@pytest.fixture
def flown(request, tmp_path):
    """A daemon whose two vehicles fly six times as fast as real ones unless said otherwise."""
    lat, lon = (float(v) for v in GRID.to_geographic([EAST, NORTH]))
    cameras = Cameras()
    vehicles = make_swarm(2, home=(lat, lon, 500.0), airframe=Airframe(climb_m_s=8.0), on_exposure=cameras.expose)
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=getattr(request, "param", 6.0)) as swarm:
        links = [text for address in swarm.addresses for text in ("--link", address)]
        with serving(tmp_path / "w", *links) as served:
            cameras.served = served
            yield served, cameras, tmp_path / "w"
            cameras.over = True


def places(served):
    """Where the vehicles stand, in the order of their ids."""
    return [[r["lat_deg"], r["lon_deg"]] for r in sorted(served.get("/api/vehicles").json(), key=lambda r: r["id"])]


def fly(served, vehicle, plan, mission=None):
    upload(served, vehicle, plan, mission)
    start(served, vehicle)


def upload(served, vehicle, plan, mission=None):
    body = {"plan": plan, **({"mission": mission} if mission else {})}
    answer = served.command(f"/api/missions/{vehicle}/upload", body)
    assert answer.status_code == 200, answer.text


def cancel(served, go, number):
    return httpx.request("DELETE", served.url + go, json={"id": number}, headers=served.auth, timeout=120.0)


def start(served, vehicle):
    # Each is started by itself, not at the plan's times, which keep them apart.
    answer = served.command(f"/api/missions/{vehicle}/start", {"override": ["separation"]})
    assert answer.status_code == 200 and answer.json()["outcome"] == "done", answer.text


@pytest.mark.slow
def test_completion_starts_the_refinement_while_the_others_fly(flown):
    served, cameras, workspace = flown
    served.until("/api/vehicles", lambda rows: sum(r.get("lat_deg") is not None for r in rows) == 2)
    body = {"area": square(130), "vehicles": 2, "altitude_m": 60, "fov_min_deg": 65, "end": "hover", "speed_m_s": 6}
    plan = served.command("/api/plans", body | {"starts": places(served)})
    assert plan.status_code == 201, plan.text
    number = plan.json()["id"]
    assert served.get("/api/plans").json()[0]["covered_share"] > 0.99
    assert served.get(f"/api/plans/{number}/map").json()["type"] == "FeatureCollection"
    for vehicle in ("v1", "v2"):
        upload(served, vehicle, number)
    start(served, "v1")
    start(served, "v2")  # at once, as v1 must not be over before; v2 flies for longer, and so on alone
    jobs = served.until("/api/jobs", lambda rows: any(r["kind"] == "refine" and r["state"] == "done" for r in rows))
    first = next(job for job in jobs if job["kind"] == "refine")
    assert first["vehicle"] == "v1"
    assert first["detail"]["trigger"] == "complete"
    done = served.until("/api/completions", lambda rows: len(rows) == 2 and all("version" in r for r in rows))
    assert [row["vehicle"] for row in done] == ["v1", "v2"]
    assert done[0]["still_flying"] == ["v2"]
    for row in done:
        assert row["complete_s"] <= row["refine_started_s"] <= row["refine_ended_s"]
        assert row["version"] > row["version_before"]
    posted = cameras.all_posted()
    assert posted > 10
    all_refined(served, posted)
    assert served.get("/api/legs").json()["features"]
    served.until("/api/jobs", exported)
    assert (workspace / "orthoimage.tif").exists()
    products_are_written(served, workspace)
    second_sortie(served, number)


def all_refined(served, posted):
    """Wait until all pictures are refined, those too that came after the refinement of their sortie had begun."""
    served.until(
        "/api/frames", lambda rows: len(rows) == posted and {row["stage"] for row in rows} <= {"coarse", "rejected"}
    )


def products_are_written(served, workspace):
    job = served.command("/api/export", {"formats": ["cog", "mbtiles", "kmz", "gpkg", "odm"]}).json()
    served.until("/api/jobs", lambda rows: all(r["state"] in ("done", "failed") for r in rows))
    done = next(r for r in served.get("/api/jobs").json() if r["id"] == job["id"])
    assert done["state"] == "done", done["message"]
    assert set(done["detail"]["files"]) == {"cog", "mbtiles", "kmz", "gpkg", "odm"}
    for kind in done["detail"]["files"]:
        answer = served.get(f"/api/export/{job['id']}/{kind}")
        assert answer.status_code == 200
        assert len(answer.content) > 1000
    report = json.loads((workspace / "report.json").read_text())
    assert report["unrefined"] == {}
    assert report["frames"]["used"] > 10
    assert [row["vehicle"] for row in report["completions"]] == ["v1", "v2"]
    assert any("no basemap" in text for text in report["warnings"])
    assert "the whole map lies within" in report["headline"]
    with rasterio.open(workspace / "confidence.tif") as file:
        assert file.res[0] < 3.0  # cells of what is drawn, not of all the layer's grid
        good = file.read(1, masked=True)
    trust = served.get("/api/trust").json()
    assert trust["version"] > 0 and trust["headline"] == report["headline"] and len(trust["corners"]) == 4
    assert served.get("/api/trust.png").content.startswith(b"\x89PNG")
    known = report["trust"]["good_to_m"]["2"]
    assert known == pytest.approx((good <= 2.0).sum() / good.count(), abs=1e-3)
    assert report["headline"].startswith("Distances are good to about" if known >= 0.5 else "For orientation only")
    stages = {row["name"]: row for row in report["stages"]}
    assert stages["realtime"]["items"] == report["frames"]["used"]
    if sys.platform == "linux":  # elsewhere other processes are not counted
        assert report["cpu_s"] > stages["realtime"]["cpu_s"] and report["peak_rss_mb"] > 200
    for name in (
        "realtime.tif",
        "coarse.tif",
        "orthoimage.tif",
        "frames.jsonl",
        "footprints.gpkg",
        "confidence.tif",
        "report.html",
    ):
        assert (workspace / name).stat().st_size > 1000
    assert served.command("/api/export", {"formats": ["exe"]}).status_code == 422
    assert served.get("/api/export/9999/cog").status_code == 404


def second_sortie(served, plan):
    before = len(served.get("/api/jobs").json())
    fly(served, "v1", plan)
    served.until("/api/completions", lambda rows: len(rows) == 3 and "version" in rows[-1])
    row = served.get("/api/completions").json()[-1]
    assert (row["vehicle"], row["sortie"]) == ("v1", 2)
    assert {frame["sortie"] for frame in served.get("/api/frames?vehicle=v1").json()} == {1, 2}
    asked = [job["detail"]["trigger"] for job in served.get("/api/jobs").json()[before:] if job["kind"] == "refine"]
    assert asked.count("complete") == 1 and set(asked) <= {"complete", "late"}  # late: pictures that came slowly


def test_commands_that_cannot_be_carried_out_say_why(flown):
    served, _, _ = flown
    served.until("/api/vehicles", lambda rows: len(rows) == 2)
    absent = served.command("/api/missions/v9/start", {"id": "mine"}).json()
    assert (absent["id"], absent["outcome"]) == ("mine", "not_sent") and "v9" in absent["reason"]
    refused = served.command("/api/missions/2/start").json()  # heard, and known by its number
    assert refused["outcome"] == "refused" and "mission" in refused["reason"]
    assert served.command("/api/missions/v1/explode").status_code == 404
    assert "plan" in served.command("/api/missions/v1/upload", {"plan": "../../etc"}).json()["detail"]
    assert "vehicles" in served.command("/api/plans", {"area": square(100)}).json()["detail"]
    bad = {"area": {"type": "Point"}, "vehicles": 2, "altitude_m": 60, "fov_min_deg": 65}
    assert served.command("/api/plans", bad).status_code == 422


@pytest.mark.parametrize("flown", [12.0], indirect=True)
def test_a_plan_is_started_at_its_times_once_all_hold_it(flown):
    served, _, _ = flown
    served.until("/api/vehicles", lambda rows: sum(r.get("lat_deg") is not None for r in rows) == 2)
    body = {"area": square(130), "vehicles": 2, "altitude_m": 60, "fov_min_deg": 65, "end": "hover", "speed_m_s": 8}
    plan = served.command("/api/plans", body | {"starts": places(served)}).json()
    starts = {v["id"]: v["flights"][0]["start_s"] for v in plan["vehicles"]}
    apart = max(starts.values()) - min(starts.values())
    assert apart >= 5.0  # from one start they take off one after the other
    later = max(starts, key=starts.get)
    go = f"/api/plans/{plan['id']}/start"
    upload(served, later, plan["id"])
    refused = served.command(go)
    assert refused.status_code == 409 and "no vehicle was started" in refused.json()["detail"]
    assert ({"v1", "v2"} - {later}).pop() in refused.json()["detail"] and later not in refused.json()["detail"]
    for vehicle in starts:
        upload(served, vehicle, plan["id"])
    assert served.post(go, json={}).status_code == 401  # a command
    assert served.command(go, {"sortie": 7}).status_code == 422
    assert "alpha" in served.command(go, {"vehicles": {later: "alpha"}}).json()["detail"]
    assert cancel(served, go, "never").json()["results"] == []
    cancelled = served.command(go, {"id": "never"})  # the start comes after its cancellation
    assert cancelled.status_code == 409 and "cancelled; no vehicle" in cancelled.json()["detail"]
    answer = served.command(go, {"id": "once"})
    assert answer.status_code == 202, answer.text
    assert served.command(go, {"id": "once"}).json() == answer.json()  # the first answer was lost on the way
    assert answer.json()["takeoffs_in_s"] == {
        v: pytest.approx(t - min(starts.values()), abs=0.1) for v, t in starts.items()
    }
    waiting = served.until("/api/vehicles", lambda rows: [r for r in rows if r["takeoff"]])
    assert [r["id"] for r in waiting if r["takeoff"] and r["takeoff"]["in_s"] > 1.0] == [later]
    assert "under way" in served.command(go).json()["detail"]
    served.until("/api/vehicles", lambda rows: sum(r["mission"]["phase"] == "active" for r in rows) == 1)
    assert "cancelled" in served.command(f"/api/missions/{later}/rtl").json()["reason"]
    served.until("/api/completions", lambda rows: len(rows) == 1)  # and the other one stays on the ground
    rows = {r["id"]: r for r in served.get("/api/vehicles").json()}
    assert rows[later]["takeoff"] is None and not rows[later]["armed"]


def test_a_start_that_is_cancelled_after_it_has_begun_pauses_its_vehicles(flown):
    served, _, _ = flown
    served.until("/api/vehicles", lambda rows: sum(r.get("lat_deg") is not None for r in rows) == 2)
    body = {"area": square(130), "vehicles": 2, "altitude_m": 60, "fov_min_deg": 65, "speed_m_s": 8}
    plan = served.command("/api/plans", body | {"starts": places(served)}).json()
    for vehicle in ("v1", "v2"):
        upload(served, vehicle, plan["id"])
    go = f"/api/plans/{plan['id']}/start"
    begun = served.command(go, {"id": "begun"}).json()["takeoffs_in_s"]
    rows = cancel(served, go, "begun").json()["results"]
    assert {row["vehicle"] for row in rows} == set(begun) and {row["command"] for row in rows} == {"pause"}
    waits = max(begun, key=begun.get)
    assert [row["outcome"] for row in rows if row["vehicle"] == waits] == ["done"]
    served.until("/api/vehicles", lambda rows: not any(r["takeoff"] and r["takeoff"].get("in_s") for r in rows))
