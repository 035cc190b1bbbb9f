"""Where the map lies: pictures without a fix do not count; the basemap, then the plan, then most pictures say it."""

import json

import pytest

from gcs_plugin.daemon.intake.posted_pose import is_position, parse_pose
from gcs_plugin.daemon.layers.layers import MapLayer
from gcs_plugin.daemon.layers.map_site import Anchor, ExpectedPlace, MapSite
from gcs_plugin.daemon.layers.web_tiles import TileServer
from gcs_plugin.daemon.store.daemon_events import DrawingRestarted, Events
from gcs_plugin.daemon.store.frame_rows import add_frame
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.web_plans import Plans
from orthoswarm.model.earth import distance_m
from orthoswarm.model.frame import Fix, Frame
from tests.kit.daemon_kit import Shot, camera_at, jpeg, line, pose_of, serving, tile_over
from tests.kit.vehicles.sim_cameras import square


def moved(shots, lat_deg, lon_deg, **more):
    """The same pictures, told to be elsewhere."""
    return [Shot(shot.pose | {"lat_deg": lat_deg + 1e-4 * k, "lon_deg": lon_deg} | more, shot.data, shot.camera)
            for k, shot in enumerate(shots)]  # fmt: skip


def send_all(served, shots):
    for shot in shots:
        assert served.send(shot).status_code == 201


def drawn(served, vehicle, count):
    return served.until(f"/api/frames?vehicle={vehicle}", lambda rows: sum(row["on_map"] for row in rows) == count)


@pytest.mark.parametrize("pose", [{"lat_deg": 0.0, "lon_deg": 0.0}, {"lat_deg": 52.0, "lon_deg": 13.0, "gps_fix": 1}])
def test_a_first_picture_without_a_fix_does_not_anchor_the_map(tmp_path, pose):
    with serving(tmp_path / "w") as served:
        send_all(served, moved(line(1, "nofix"), **pose))
        (row,) = served.until("/api/frames?vehicle=nofix", lambda rows: rows[0]["stage"] == "rejected")
        assert "fix" in row["reason"]
        assert row["lat_deg"] == pose["lat_deg"]  # what was posted stays
        shots = line(4)
        send_all(served, shots)
        drawn(served, "v1", 4)
        health = served.get("/healthz").json()
        assert [(r["cause"], r["vehicle"]) for r in health["refused"]] == [("place", "nofix")]
        assert served.get("/tiles/realtime/{}/{}/{}.png".format(*tile_over(shots[2].camera))).content


@pytest.mark.slow
def test_most_pictures_anchor_the_map_and_none_is_lost(tmp_path):
    with serving(tmp_path / "w") as served:
        send_all(served, moved(line(2, "stray"), 10.0, 10.0))
        drawn(served, "stray", 2)
        send_all(served, line(5))
        drawn(served, "v1", 5)  # those that came before the majority was clear, too
        rows = served.until("/api/frames?vehicle=stray", lambda rows: all(r["reason"] for r in rows))
        assert all("km from the others" in row["reason"] for row in rows)
    with serving(tmp_path / "w") as served:  # and so it is after a restart
        assert sum(row["on_map"] for row in served.get("/api/frames?vehicle=v1").json()) == 5
        send_all(served, line(1, "late", east=40))
        drawn(served, "late", 1)


def test_a_map_that_was_begun_at_a_wrong_place_moves_once_while_pictures_are_drawn_again(tmp_path):
    journal, again, events = Journal(tmp_path / "journal.db"), [], Events()
    events.on(DrawingRestarted, lambda event: again.append(1))
    (tmp_path / "layers").mkdir()
    site = MapSite(
        journal, MapLayer("realtime"), tmp_path / "layers", gsd_m=0.5, fov_rad=None, events=events, memory_mb=64.0,
        expected=ExpectedPlace(TileServer({}), Plans(tmp_path / "plans", None, None).newest_bounds),
    )  # fmt: skip
    frames = []
    for k, (lat, lon) in enumerate([(10.0, 10.0)] * 2 + [(48.0, 11.0)] * 3):
        pose = {"lat_deg": lat, "lon_deg": lon, "height_m": 60.0}
        journal.write(add_frame(b"%d" % k, "v1", f"{k}.jpg", time_s=float(k), path="", size=(640, 480), pose=pose))
        fix = Fix(lat_deg=lat, lon_deg=lon, height_m=60.0)
        frames.append(
            Frame(image=f"{k}.jpg", path=tmp_path, vehicle="v1", time_s=float(k), fix=fix, width=640, height=480)
        )
    stray, other = frames[0], frames[4]
    assert not isinstance(site.place(stray, 0), str)  # the first one begins the map
    assert not isinstance(site.place(other, 0), str)
    assert again == [1]
    for frame in frames:  # nothing that was drawn is in the journal yet
        assert isinstance(site.place(frame, 0), str) == (frame in frames[:2])
    assert again == [1]
    journal.close()


def test_the_newest_plan_says_where_the_map_lies(tmp_path):
    body = {"area": square(150), "vehicles": 1, "altitude_m": 60, "fov_min_deg": 65}
    with serving(tmp_path / "w") as served:
        send_all(served, moved(line(6, "before"), 10.0, 10.0))
        drawn(served, "before", 6)
        assert served.command("/api/plans", body).status_code == 201
        send_all(served, line(1))  # one against six, but where the plan is
        drawn(served, "v1", 1)
        rows = served.until("/api/frames?vehicle=before", lambda rows: all(r["reason"] for r in rows))
        assert all("km from the newest plan" in row["reason"] for row in rows)


def test_distances_on_the_sphere():
    assert distance_m(0, 0, 0, 1) == pytest.approx(111_195, rel=1e-4)
    assert distance_m(48.0, 11.0, 48.0, 11.0) == 0.0
    assert distance_m(60, 0, 60, 180) == pytest.approx(60 * 111_195, rel=1e-4)  # over the pole
    box = Anchor("the basemap", (47.0, 10.0, 48.0, 11.0))
    assert box.distance_m(47.5, 10.5) == 0.0
    assert box.distance_m(49.0, 10.5) == pytest.approx(111_195, rel=1e-4)
    assert Anchor("x", (0.0, 179.5, 1.0, 179.9)).distance_m(0.5, -179.6) < 60_000  # over the date line


def test_what_is_a_position():
    assert is_position({"lat_deg": 0.5, "lon_deg": 0.0})
    assert not is_position({"lat_deg": 1e-5, "lon_deg": -1e-5})
    assert is_position({"lat_deg": 48.0, "lon_deg": 11.0, "gps_fix": 3})
    pose = pose_of(camera_at(), "a.jpg")
    assert parse_pose(json.loads(json.dumps(pose))).has_fix
    assert not parse_pose(pose | {"gps_fix": 0}).has_fix
    assert jpeg(camera_at())
