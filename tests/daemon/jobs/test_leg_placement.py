"""Pictures in flight: on the basemap as they come, else leg by leg as these finish; completion takes their place."""

import json
import math
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.cli.main import main
from gcs_plugin.daemon.jobs.job_queue import Jobs, LegWatch, Preempted
from gcs_plugin.daemon.jobs.leg_placement import MOST, newest_legs
from gcs_plugin.daemon.jobs.publisher import detail_of
from gcs_plugin.daemon.jobs.solution_file import read_solution
from gcs_plugin.daemon.jobs.worker_pool import WorkerPool
from gcs_plugin.daemon.jobs.worker_tasks import SortieResult
from gcs_plugin.daemon.store.daemon_events import Events, LegsOver
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.store.sortie_rows import LegRow
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.trajectory.legs import LEG_REACH, ended_legs
from tests.kit.daemon_kit import Shot, StoppedWorkers, exported, line, serving
from tests.kit.made_up_ground import made_up_flight, made_up_ground, write_map

GRID = LocalGrid(32631)


def lawn(legs, per_leg=20, step=5.0, apart=40.0):
    """Positions along legs there and back, beside each other."""
    out = []
    for k in range(legs):
        along = np.arange(per_leg) * step
        out += [(apart * k, y) for y in (along if k % 2 == 0 else along[::-1])]
    return np.array(out)


def frames_at(positions, first_s=1e9):
    places = GRID.to_geographic(positions + np.array([500_000.0, 5_000_000.0]))
    return [
        Frame(
            image=f"{k}.jpg",
            path=None,
            vehicle="v1",
            time_s=first_s + k,
            fix=Fix(float(lat), float(lon), 60.0),
            width=160,
            height=120,
        )
        for k, (lat, lon) in enumerate(places)
    ]


# -- noticing ---------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=30)
@given(legs=st.integers(1, 4), per_leg=st.integers(8, 30), seen=st.integers(2, 120))
def test_a_leg_that_is_over_stays_as_it_is(legs, per_leg, seen):
    path = lawn(legs, per_leg)
    early = ended_legs(path[: min(seen, len(path))])
    assert early == ended_legs(path)[: len(early)]


def test_the_last_leg_is_over_when_nothing_more_comes():
    path = lawn(2)
    assert len(ended_legs(path)) == 1
    assert len(ended_legs(path, over=True)) == 2
    assert len(ended_legs(path[: 20 + 2 * LEG_REACH], over=False)) <= 1


def test_only_the_newest_legs_are_placed_anew():
    frames, count = newest_legs(frames_at(lawn(12, 60)), 32631)
    assert 2 <= count <= 3
    assert len(frames) <= MOST
    assert int(frames[-1].image[:-4]) >= 12 * 60 - 62 - 2 * LEG_REACH
    long, _ = newest_legs(frames_at(lawn(1, 500)), 32631, over=True)
    assert len(long) == MOST


def test_a_watch_asks_when_a_leg_is_over_and_when_a_vehicle_falls_silent():
    asked, heard = [], threading.Event()

    def ask(event):
        asked.append((event.vehicle, event.sortie, event.silent))
        heard.set()

    events = Events()
    events.on(LegsOver, ask)
    watch = LegWatch(events, silent_s=3600.0)
    watch.start()
    frames = frames_at(lawn(2, 20))
    for frame in frames[:12]:
        watch.add("v1", 1, frame.time_s, frame.fix.lat_deg, frame.fix.lon_deg)
    assert not heard.wait(0.2)
    for frame in frames[12:]:
        watch.add("v1", 1, frame.time_s, frame.fix.lat_deg, frame.fix.lon_deg)
    assert heard.wait(240)
    assert asked[0] == ("v1", 1, False)
    heard.clear()
    watch.silent_s = 0.1
    assert heard.wait(240)
    assert asked[1] == ("v1", 1, True)
    heard.clear()
    assert not heard.wait(0.5)  # silence is told once
    watch.close()


# -- jobs -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def journal(tmp_path):
    journal = Journal(tmp_path / "journal.db")
    yield journal
    journal.close()


def finished(jobs, count, limit_s=240.0):
    end = time.monotonic() + limit_s
    while sum(job.state == "done" for job in jobs.all()) < count:
        assert time.monotonic() < end, jobs.all()
        time.sleep(0.01)
    return jobs.all()


def test_refinement_goes_before_what_is_in_the_background(journal):
    order = []

    def handler(run):
        order.append((run.job.kind, run.job.vehicle))
        time.sleep(0.02)
        return lambda db: None

    jobs = Jobs(journal, Events(), dict.fromkeys(("refine", "coarse", "export"), handler), WorkerPool(1), WorkerPool(1))
    for vehicle in ("v1", "v2"):
        jobs.add("coarse", vehicle, 1)
    jobs.add("coarse", "v0", 1, after="refine")
    jobs.add("export", formats=[])
    jobs.add("refine", "v3", 1)
    jobs.start()
    finished(jobs, 5)
    jobs.close()
    coarse = [vehicle for kind, vehicle in order if kind == "coarse"]
    assert coarse == ["v0", "v1", "v2"]
    assert order.index(("refine", "v3")) < order.index(("coarse", "v0"))  # an export may run beside the refinement


def test_coarse_jobs_of_a_vehicle_are_dropped_when_it_completes(journal, tmp_path):
    workers = StoppedWorkers(lambda item: tmp_path / "half")
    jobs = Jobs(journal, Events(), {"coarse": lambda run: run.run(len, "")}, WorkerPool(1), workers)
    jobs.add("coarse", "v1", 1)
    jobs.start()
    assert workers.began.wait(240)
    jobs.add("coarse", "v1", 1, over=True)
    jobs.drop("coarse", "v1", "dropped: the refinement takes its place")
    done = finished(jobs, 2)
    jobs.close()
    assert [(job.state, job.message[:7]) for job in done] == [("done", "dropped")] * 2


def test_work_that_gave_way_is_done_again(journal):
    tries = []

    def handler(run):
        tries.append(run.job.attempts)
        if len(tries) == 1:
            raise Preempted("a refinement begins")
        return lambda db: None

    jobs = Jobs(journal, Events(), {"coarse": handler}, WorkerPool(1), WorkerPool(1))
    jobs.add("coarse", "v1", 1)
    jobs.start()
    finished(jobs, 1)
    jobs.close()
    assert tries == [1, 1]  # giving way is not a failed attempt


# -- the whole way ----------------------------------------------------------------------------------------------------


def shots_over(ground, folder):
    """Pictures over the map with records that are 3 m off, as a companion computer sends them."""
    folder.mkdir()
    shots = []
    for frame in made_up_flight(ground, folder, "v1"):
        place = GRID.to_grid(frame.fix.lat_deg, frame.fix.lon_deg) + np.array([2.0, -2.2])
        lat, lon = (float(v) for v in GRID.to_geographic(place))
        pose = {
            "vehicle": "v1", "image": frame.image, "time": frame.time_s, "lat_deg": lat, "lon_deg": lon,
            "height_m": frame.fix.height_m, "yaw_deg": float(np.degrees(frame.fix.yaw_rad)), "pitch_deg": -90.0,
            "roll_deg": 0.0,
        }  # fmt: skip
        shots.append(Shot(pose, frame.path.read_bytes()))
    return shots


def layer_named(name):
    return lambda layers: not next(row for row in layers if row["name"] == name)["empty"]


def test_pictures_lie_on_the_basemap_as_they_come_and_once_refined(tmp_path, capsys):
    ground = made_up_ground()
    write_map(ground, tmp_path / "map.tif")
    shots = shots_over(ground, tmp_path / "p")
    workspace = tmp_path / "w"
    with serving(workspace, "--basemap", str(tmp_path / "map.tif")) as served:
        for shot in shots[:22]:
            assert served.send(shot).status_code == 201
        found = served.until("/api/frames", lambda rows: sum(r["placed_by"] == "map" for r in rows) == 22)
        assert {row["stage"] for row in found} == {"realtime"}
        for shot in shots[22:]:
            assert served.send(shot).status_code == 201
        rows = served.until("/api/frames?poses=1", lambda rows: sum(r["placed_by"] == "map" for r in rows) == 28)
        lies_at_its_place(rows, shots)
        assert all(0.0 < row["placed_after_s"] < 60.0 for row in rows)
        assert all(row["sigma_m"] < 1.0 for row in rows), [(r["image"], r["sigma_m"]) for r in rows]
        legs = served.get("/api/legs").json()["features"]
        assert {(leg["properties"]["stage"], leg["properties"]["state"]) for leg in legs} == {("realtime", "matched")}
        assert 'placed_after_seconds_bucket{le="+Inf"} 28' in served.get("/metrics").text
        served.until("/api/jobs", lambda rows: all(r["state"] == "done" for r in rows))
        served.command("/api/refine", {"vehicle": "v1"})
        jobs = served.until("/api/jobs", exported)
        assert all(job["state"] == "done" for job in jobs), jobs
        rows = served.get("/api/frames?poses=1").json()
        assert {(row["stage"], row["placed_by"]) for row in rows} == {("fine", "refined")}
        lies_at_its_place(rows, shots)
        legs = served.get("/api/legs").json()["features"]
        assert {leg["properties"]["stage"] for leg in legs} == {"fine"}
    for name in ("realtime.tif", "coarse.tif", "orthoimage.tif"):
        assert (workspace / name).stat().st_size > 1000
    it_is_drawn_evenly(workspace)
    all_lie_on_the_ground(workspace, ground)
    first_errors(workspace, shots, tmp_path, capsys)


def test_after_a_restart_in_flight_the_next_pictures_lie_on_the_basemap(tmp_path):
    ground = made_up_ground()
    write_map(ground, tmp_path / "map.tif")
    shots = shots_over(ground, tmp_path / "p")
    for before, upto in ((0, 22), (22, 28)):  # fewer after the restart than a vehicle is looked for with
        with serving(tmp_path / "w", "--basemap", str(tmp_path / "map.tif")) as served:
            for shot in shots[before:upto]:
                assert served.send(shot).status_code == 201
            served.until("/api/frames", lambda rows, n=upto: sum(r["placed_by"] == "map" for r in rows) == n)
            rows = served.get("/api/frames?poses=1").json()
    assert {row["stage"] for row in rows} == {"realtime"}
    lies_at_its_place(rows, shots)


def lies_at_its_place(rows, shots, within_m=0.6):
    """Homographies put the pictures' middles near their true places, from which the records are 3 m off."""
    records = {shot.pose["image"]: GRID.to_grid(shot.pose["lat_deg"], shot.pose["lon_deg"]) for shot in shots}
    for row in rows:
        assert row["epsg"] == 32631
        east, north, w = np.array(row["homography"]) @ [0.5 * (row["width"] - 1), 0.5 * (row["height"] - 1), 1.0]
        true = np.asarray(records[row["image"]]) - [2.0, -2.2]
        assert np.hypot(*([east / w, north / w] - true)) < within_m, row["image"]


def first_errors(workspace, shots, folder, capsys):
    """`evaluate --live` tells the first pictures, which were drawn where the receiver said, from those after."""
    lines = ["image,vehicle,epsg,easting,northing,height,yaw_deg,pitch_deg,roll_deg,fov_deg,width_px,height_px"]
    for shot in shots:
        east, north = GRID.to_grid(shot.pose["lat_deg"], shot.pose["lon_deg"]) - np.array([2.0, -2.2])
        yaw, image = shot.pose["yaw_deg"], shot.pose["image"]
        lines.append(f"{image},v1,32631,{east},{north},60,{yaw},-90,0,70,240,180")
    (folder / "frames.csv").write_text("\n".join(lines))
    assert main(["evaluate", "--live", str(workspace), "--truth", str(folder / "frames.csv"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["map"]["pictures"] + found["receiver"]["pictures"] == found["all"]["pictures"] == 28
    assert found["map"]["pictures"] >= 6
    assert found["map"]["p95_m"] < 0.6 < 2.0 < found["receiver"]["median_m"]
    assert found["map"]["sigma_2"] > 80.0


def test_a_vehicle_over_other_ground_stays_where_its_receiver_says(tmp_path):
    ground = made_up_ground()
    write_map(ground[::-1, ::-1].copy(), tmp_path / "map.tif")
    with serving(tmp_path / "w", "--basemap", str(tmp_path / "map.tif")) as served:
        for shot in shots_over(ground, tmp_path / "p"):
            assert served.send(shot).status_code == 201
        jobs = served.until("/api/jobs", lambda rows: rows and all(r["state"] == "done" for r in rows))
        assert "not found on the basemap" in jobs[0]["detail"]["note"]
        rows = served.until("/api/frames", lambda rows: all(r["placed_by"] for r in rows))
        assert {row["placed_by"] for row in rows} == {"receiver"}


def it_is_drawn_evenly(workspace):
    """The refined sortie was kept with a gain for each picture, near one for even pictures."""
    kept = [read_solution(path) for path in (workspace / "solutions").glob("solution*.pickle")]
    assert len(kept) == 1
    gains = np.array(list(kept[0].gains.values()))
    assert gains.shape == (28, 3, 6)
    assert np.abs(gains[..., 0] - 1.0).max() < 0.1


def all_lie_on_the_ground(workspace, ground):
    """Each layer has the ground's true colours where that is, which those of 3 m beside differ from."""
    import rasterio

    for name in ("realtime.tif", "coarse.tif", "orthoimage.tif"):
        with rasterio.open(workspace / name) as raster:
            east, north = np.meshgrid(np.arange(-70.0, -20.0), np.arange(-40.0, 40.0))
            place = list(zip((500_000.0 + east).ravel(), (5_000_000.0 + north).ravel(), strict=True))
            seen = np.array(list(raster.sample(place)), float)
        rows, cols = (210.0 - north).astype(int).ravel(), (210.0 + east).astype(int).ravel()
        good = seen[:, 3] > 200
        assert good.mean() > 0.9
        here, beside = (np.abs(seen[good, :3] - ground[rows + d, cols + d][good]).mean() for d in (0, 3))
        assert here < 0.5 * beside, name


@pytest.mark.slow
def test_pictures_that_do_not_hold_together_leave_the_real_time_map_alone(tmp_path):
    """Legs of pictures of nothing: the job ends with a note, the layer stays empty."""
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.new("RGB", (160, 120), (90, 90, 90)).save(buffer, "JPEG")
    with serving(tmp_path / "w", "--gsd", "0.5") as served:
        back = [
            Shot(
                there.pose
                | {"image": f"b{k}.jpg", "time": there.pose["time"] + 40, "lon_deg": there.pose["lon_deg"] + 4e-4},
                b"",
            )
            for k, there in enumerate(reversed(line(14)))
        ]
        for shot in [*line(14), *back]:
            served.send(Shot(shot.pose, buffer.getvalue()))
        jobs = served.until("/api/jobs", lambda rows: rows and rows[-1]["state"] in ("done", "failed"))
        assert (jobs[-1]["kind"], jobs[-1]["state"]) == ("coarse", "done")
        assert jobs[-1]["detail"]["note"]
        assert not layer_named("coarse")(served.get("/api/layers").json())


def test_an_earlier_leg_without_a_confidence_stays_so():
    box = BoundingBox(0.0, 0.0, 1.0, 1.0)
    solved = SortieResult(
        stages={}, dropped={}, legs=[], fov_deg=math.nan, fov_sigma_deg=1.0, warnings=[], bounds=box, changed=box,
        cpu_s=0.0, wall_s=0.0,
    )  # fmt: skip
    legs = [LegRow(confidence=None, sigma_m=None), LegRow(confidence=math.nan, sigma_m=2.0)]
    detail = detail_of(solved, legs)
    assert detail["legs"] == [{"confidence": None, "sigma_m": None}, {"confidence": None, "sigma_m": 2.0}]
    assert detail["fov_deg"] is None
