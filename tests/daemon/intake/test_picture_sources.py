"""Pictures that arrive in a watched folder of a running daemon: half-written, renamed, in bursts, from cards."""

import io
import json
import os
import socket
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from gcs_plugin.daemon.intake.picture_intake import VehicleIntake
from gcs_plugin.daemon.intake.picture_sources import PictureSource
from gcs_plugin.daemon.intake.posted_pose import frame_of
from gcs_plugin.daemon.intake.watched_folder import is_complete, is_video_complete
from gcs_plugin.daemon.store.daemon_events import Events, Told
from gcs_plugin.daemon.store.picture_store import frame_key
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.links.tlog_writer import TlogWriter, write_link_log
from gcs_plugin.sim.multirotor import Airframe
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from telemetry import load
from telemetry.live.live_poses import LinkPoses
from telemetry.samples.sample import Sample
from telemetry.samples.times import ZONE_UNKNOWN
from telemetry.write.sei_writer import add_sei
from telemetry.write.tag_writer import with_pose
from tests.daemon.flight.test_daemon_flight import fly
from tests.kit.daemon_kit import GRID, camera_at, jpeg, line, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.vehicles.sim_cameras import square
from tests.kit.vehicles.telemetry_log import read_tlog

av = pytest.importorskip("av")

VEHICLES = ("half", "renamed", "burst", "card", "video", "gps")


def tagged(shot, **more) -> bytes:
    """The picture with its pose in EXIF and XMP; more: fields of the frame."""
    pose = shot.pose
    values = {k: v for k, v in pose.items() if k not in ("vehicle", "image", "time")}
    frame = frame_of(
        values, image="x", path=Path("x"), vehicle="x", time_s=pose["time"], size=(shot.camera.lens.width, 120)
    )
    return with_pose(shot.data, replace(frame, **more))


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """A daemon with a folder for each vehicle."""
    root = tmp_path_factory.mktemp("cards")
    for name in VEHICLES:
        (root / name).mkdir()
    sources = [text for name in VEHICLES for text in ("--source", f"{name}={root / name}")]
    with serving(root / "w", *sources) as served:
        yield served, root


def until(done, limit_s=300.0):
    end = time.monotonic() + limit_s
    while not done():
        assert time.monotonic() < end
        time.sleep(0.05)


def frames(served, vehicle, count):
    return served.until(f"/api/frames?vehicle={vehicle}", lambda rows: len(rows) >= count)


def stored(root, vehicle, image):
    digits = frame_key(vehicle, image).hex()
    return (root / "w" / "pictures" / digits[:2] / f"{digits}.jpg").read_bytes()


def source_of(served, vehicle):
    return next(row for row in served.get("/api/vehicles").json() if row["id"] == vehicle)["pictures"]


class Workspace:
    """Takes every picture."""

    def __init__(self):
        self.taken = []

    def add(self, pose, data):
        self.taken.append(pose)
        return len(self.taken), True


def source_to(workspace, where, said, cache):
    """A vehicle's source of pictures; what it says is added to a list."""
    events = Events()
    events.on(Told, lambda note: said.append(note.told["text"]))
    log = cache / "telemetry.tlog"
    intake = VehicleIntake("v1", workspace, events, poses=LinkPoses(), tlog=log, system=None, cache=cache)
    return PictureSource(where, intake)


def test_a_stream_without_pictures_is_told_once(tmp_path):
    """A camera that sends nothing while its drone stands on the ground: each attempt ends, and one is news."""
    said = []
    with socket.create_server(("127.0.0.1", 0)) as camera:
        where = f"tcp://127.0.0.1:{camera.getsockname()[1]}"
        source = source_to(Workspace(), where, said, tmp_path)
        source.start()
        camera.settimeout(120.0)
        for _ in range(3):
            camera.accept()[0].close()
        assert said == ["the pictures of v1: lost"]
        source.stop()
    assert source.close(120.0)


def local_time(folder, count):
    """Photos of a camera whose clock says no zone."""
    folder.mkdir()
    for number, shot in enumerate(line(count, "local")):
        (folder / f"{number}.jpg").write_bytes(tagged(shot, origin={"time": f"EXIF time {ZONE_UNKNOWN}"}))
    return folder


def test_times_without_a_zone_are_told_once_a_folder(tmp_path):
    said, workspace = [], Workspace()
    taken = workspace.taken
    source = source_to(workspace, str(local_time(tmp_path / "card", 2)), said, tmp_path)
    source.start()
    until(lambda: len(taken) == 2)
    (tmp_path / "card" / "late.jpg").write_bytes((tmp_path / "card" / "0.jpg").read_bytes() + b"0")
    until(lambda: len(taken) == 3)
    source.stop()
    assert source.close(120.0)
    assert len(said) == 1 and said[0].startswith("v1: times of ") and "no zone and are taken as UTC" in said[0]


def test_the_report_says_that_times_have_no_zone_as_a_batch_run_does(tmp_path):
    folder = local_time(tmp_path / "card", 3)
    with serving(tmp_path / "w", "--source", f"local={folder}") as served:
        served.until("/api/frames", lambda rows: sum(row["on_map"] for row in rows) == 3)
        number = served.command("/api/export", {"formats": ["gpkg"]}).json()["id"]
        served.until("/api/jobs", lambda rows: any(r["id"] == number and r["state"] == "done" for r in rows))
    warnings = json.loads((tmp_path / "w" / "report.json").read_text())["warnings"]
    (found,) = [text for text in load([folder]).warnings if "zone" in text]
    assert found in warnings and found.startswith("times of 3 pictures have no zone")


def test_a_copy_that_stalls_is_taken_only_when_it_is_whole(watched):
    served, root = watched
    first, second = (tagged(shot) for shot in line(2, "half"))
    slow, reserved = root / "half" / "slow.jpg", root / "half" / "reserved.JPG"
    slow.write_bytes(first[: len(first) // 2])  # beyond the tags and thumbnails: a reader of heads is content with it
    reserved.write_bytes(second[: len(second) // 2] + bytes(len(second) - len(second) // 2))
    (root / "half" / "no-picture.jpg").write_bytes(b"this is text, and quite some of it")
    time.sleep(3.0)
    assert frames(served, "half", 0) == []
    with slow.open("ab") as file:
        file.write(first[len(first) // 2 :])
    reserved.write_bytes(second)
    rows = frames(served, "half", 2)
    assert {row["image"] for row in rows} == {"slow.jpg", "reserved.JPG"}
    assert stored(root, "half", "slow.jpg") == first
    assert stored(root, "half", "reserved.JPG") == second


def test_files_that_appear_by_rename_are_taken_once(watched):
    served, root = watched
    for number, shot in enumerate(line(4, "renamed")):
        part = root / "renamed" / f"{number}.jpg.part"
        part.write_bytes(tagged(shot))
        os.utime(part, (1e9, 1e9))  # as old as the picture, as cameras and rsync leave it
        os.replace(part, root / "renamed" / f"{number}.jpg")
    (root / "renamed" / ".hidden.jpg").write_bytes(tagged(line(1)[0]))
    rows = frames(served, "renamed", 4)
    assert [row["image"] for row in rows] == [f"{n}.jpg" for n in range(4)]


def test_a_burst_within_one_second_comes_whole_and_in_order(watched):
    served, root = watched
    shots = line(30, "burst", step_m=2.0)
    below = root / "burst" / "DCIM" / "100MEDIA"
    below.mkdir(parents=True)
    for number, shot in enumerate(shots):
        shot.pose["time"] = 1_780_000_000.0 + number // 15  # many pictures in one second of the clock
        (below / f"DJI_{number:04d}.JPG").write_bytes(tagged(shot))
    began = time.monotonic()
    rows = frames(served, "burst", 30)
    assert [row["image"] for row in rows] == [f"DCIM/100MEDIA/DJI_{n:04d}.JPG" for n in range(30)]
    served.until("/api/frames?vehicle=burst", lambda rows: all(row["on_map"] for row in rows))
    print(f"burst of 30 on the map after {time.monotonic() - began:.1f} s")


def test_a_card_may_go_and_come_again_and_begin_its_numbers_anew(watched):
    served, root = watched
    card, pocket = root / "card", root / "pocket"
    shots = line(5, "card")
    for number in (1, 2):
        (card / f"DJI_{number:04d}.JPG").write_bytes(tagged(shots[number]))
    frames(served, "card", 2)
    card.rename(pocket)
    served.until("/api/vehicles", lambda _: "not there" in source_of(served, "card")["state"])
    (pocket / "DJI_0003.JPG").write_bytes(tagged(shots[3]))
    pocket.rename(card)
    frames(served, "card", 3)
    os.utime(card / "DJI_0001.JPG")  # touched: the same picture all the same
    (card / "DJI_0002.JPG").write_bytes(tagged(shots[4]))  # a card that was formatted: another picture, an old name
    rows = frames(served, "card", 4)
    time.sleep(1.5)
    rows = served.get("/api/frames?vehicle=card").json()
    assert len(rows) == 4
    assert stored(root, "card", "DJI_0002.JPG") == tagged(shots[2])  # what was acknowledged stays
    assert rows[3]["image"].startswith("DJI_0002~")
    assert stored(root, "card", rows[3]["image"]) == tagged(shots[4])


def test_a_video_with_its_poses_is_taken_after_landing(watched, tmp_path):
    served, root = watched
    shots = line(12, "video", step_m=6.0)
    plain = film(tmp_path / "plain.mp4", shots)
    poses = {n: sample_of(shot) for n, shot in enumerate(shots)}
    add_sei(plain, tmp_path / "uniquely_named.mp4", poses.__getitem__)
    data = (tmp_path / "uniquely_named.mp4").read_bytes()
    target = root / "video" / "DJI_0001.MP4"
    target.write_bytes(data[: len(data) // 3])
    time.sleep(2.0)
    assert frames(served, "video", 0) == []
    with target.open("ab") as file:
        file.write(data[len(data) // 3 :])
    rows = frames(served, "video", 2)
    served.until("/api/frames?vehicle=video", lambda rows: all(row["on_map"] for row in rows))
    assert all(row["image"].startswith("DJI_0001.MP4#") for row in rows)
    by_time = {round(s.pose["time"]): s.pose for s in shots}
    for row in rows:
        truth = by_time[round(datetime.fromisoformat(row["time"]).timestamp())]
        assert row["lat_deg"] == pytest.approx(truth["lat_deg"], abs=1e-6)
        assert row["height_m"] == pytest.approx(truth["height_m"], abs=0.1)
    end = time.monotonic() + 120.0
    while any(name.endswith(".jpg") for _, _, names in os.walk(root / "w" / "videos") for name in names):
        assert time.monotonic() < end, "pictures of the video are kept twice"
        time.sleep(0.05)


def test_a_table_that_comes_later_gives_photos_their_poses(watched):
    served, root = watched
    shots = line(4, "gps")
    for number, shot in enumerate(shots):
        (root / "gps" / f"{number}.jpg").write_bytes(shot.data)  # no tags at all
    served.until("/api/vehicles", lambda _: source_of(served, "gps")["without_pose"] == 4)
    assert frames(served, "gps", 0) == []
    rows = [f"{n}.jpg {s.pose['lon_deg']:.9f} {s.pose['lat_deg']:.9f} 560" for n, s in enumerate(shots)]
    (root / "gps" / "geo.txt").write_text("EPSG:4326\n" + "\n".join(rows) + "\n")
    found = frames(served, "gps", 4)
    assert found[2]["lat_deg"] == pytest.approx(shots[2].pose["lat_deg"], abs=1e-8)
    served.until("/api/vehicles", lambda _: source_of(served, "gps")["without_pose"] == 0)


def sample_of(shot) -> Sample:
    pose = shot.pose
    names = ("lat_deg", "lon_deg", "height_m", "yaw_deg", "pitch_deg", "roll_deg")
    return Sample(time_s=pose["time"], **{name: pose[name] for name in names})


def film(path, shots, rate=1):
    """The pictures as a video that began when the first one was taken."""
    begin = datetime.fromtimestamp(shots[0].pose["time"], UTC)
    with av.open(str(path), "w") as container:
        container.metadata["creation_time"] = begin.isoformat(timespec="microseconds").replace("+00:00", "Z")
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = shots[0].camera.lens.width, 120, "yuv420p"
        stream.options = {"bf": "0", "crf": "16"}
        for number, shot in enumerate(shots):
            from PIL import Image

            picture = np.asarray(Image.open(io.BytesIO(shot.data)).convert("RGB"))
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts = number
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


# -- after a flight: poses from the vehicle's own link --------------------------------------------------------------


class Recorder:
    """What a camera without any telemetry records of a simulated flight."""

    def __init__(self):
        self.shots = []

    def expose(self, vehicle, exposure):
        self.shots.append((exposure.pose, vehicle.utc_s(exposure.time_s)))

    def developed(self):
        for pose, time_s in self.shots:
            east, north = GRID.to_grid(pose.lat_deg, pose.lon_deg)
            turn = float(GRID.convergence_rad(pose.lat_deg, pose.lon_deg))
            camera = camera_at(east - EAST, north - NORTH, pose.height_m, float(np.degrees(pose.yaw_rad - turn)))
            yield pose, time_s, camera, jpeg(camera)


def timed(data: bytes, time_s: float) -> bytes:
    """A JPEG that knows when it was taken, and nothing else."""
    from PIL import Image

    picture = Image.open(io.BytesIO(data))
    exif = Image.Exif()
    moment = datetime.fromtimestamp(time_s, UTC)
    exif.get_ifd(0x8769).update(
        {0x9003: moment.strftime("%Y:%m:%d %H:%M:%S"), 0x9291: f"{moment.microsecond // 1000:03d}", 0x9011: "+00:00"}
    )
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=92, exif=exif)
    return out.getvalue()


@pytest.mark.slow
def test_a_card_read_after_landing_and_a_restart_gets_its_poses_from_the_link(tmp_path):
    """Photos that know their time only, and a video that knows when it began: the daemon's own log has the poses."""
    from tests.kit.daemon_kit import Shot

    lat, lon = (float(v) for v in GRID.to_geographic([EAST, NORTH]))
    recorder = Recorder()
    vehicles = make_swarm(
        1, autopilots=(Autopilot.ARDUPILOT,), home=(lat, lon, 500.0), airframe=Airframe(climb_m_s=8.0),
        on_exposure=recorder.expose,
    )  # fmt: skip
    card = tmp_path / "card"
    swarm = SimSwarm(vehicles, "tcpin:127.0.0.1:0", speed=6.0)
    with swarm, serving(tmp_path / "w", "--link", swarm.addresses[0]) as served:
        served.until("/api/vehicles", lambda rows: rows and rows[0].get("lat_deg") is not None)
        body = {"area": square(110), "vehicles": 1, "altitude_m": 60, "fov_min_deg": 65, "speed_m_s": 8}
        fly(served, "v1", served.command("/api/plans", body).json()["id"])
        served.until("/api/completions", lambda rows: len(rows) == 1)
    assert len(recorder.shots) > 8
    developed, pocket = list(recorder.developed()), tmp_path / "pocket"
    pocket.mkdir()
    for number, (_, time_s, _, data) in enumerate(developed):
        (pocket / f"IMG_{number:04d}.jpg").write_bytes(timed(data, time_s))
    with serving(tmp_path / "w", "--source", f"v1={card}") as served:  # no link any more: only its log is left
        pocket.rename(card)  # whole at once, as a card comes
        rows = frames(served, "v1", len(developed))
        assert len(rows) == len(developed)
        for row, (pose, _, _, _) in zip(rows, developed, strict=True):
            assert row["lat_deg"] == pytest.approx(pose.lat_deg, abs=2e-5)
            assert row["lon_deg"] == pytest.approx(pose.lon_deg, abs=3e-5)
            assert row["height_m"] == pytest.approx(pose.height_m, abs=1.0)
            turned = (row["yaw_deg"] - np.degrees(pose.yaw_rad) + 180.0) % 360.0 - 180.0
            assert abs(turned) < 5.0
        whole = len(developed)  # nobody asked for it: the job of the landing, if it still waited, or a late one
        jobs = served.until(
            "/api/jobs", lambda rows: [r for r in rows if r["state"] == "done" and r["detail"].get("frames") == whole]
        )
        assert len([r for r in jobs if r["kind"] == "refine"]) <= 2
        leg = developed[:6]
        shots = [Shot({"time": leg[0][1] + k}, data, camera) for k, (_, _, camera, data) in enumerate(leg)]
        film(card / "FLIGHT.MP4", shots)
        videos = served.until(
            "/api/frames?vehicle=v1", lambda rows: [r for r in rows if r["image"].startswith("FLIGHT.MP4#")]
        )
        posed = [row for row in videos if row["image"].startswith("FLIGHT.MP4#")]
        assert posed[0]["height_m"] == pytest.approx(60.0, abs=3.0)
        assert posed[0]["lat_deg"] == pytest.approx(leg[0][0].lat_deg, abs=3e-4)


# -- parts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "BMP", "TIFF"])
def test_pictures_say_whether_they_are_whole(kind):
    from PIL import Image

    suffix = {"JPEG": ".jpg", "PNG": ".png", "WEBP": ".webp", "BMP": ".bmp", "TIFF": ".tif"}[kind]
    noise = np.random.default_rng(1).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    out = io.BytesIO()
    Image.fromarray(noise).save(out, kind)
    data = out.getvalue()
    assert is_complete(data, suffix)
    for share in (0.2, 0.5, 0.9, 0.99):
        cut = data[: int(share * len(data))]
        assert not is_complete(cut, suffix), share
        if kind in ("JPEG", "PNG"):  # space that was reserved and not yet written
            assert not is_complete(cut + bytes(len(data) - len(cut)), suffix), share
    if kind == "JPEG":
        assert is_complete(data + bytes(100), suffix)  # some cameras pad
        progressive = io.BytesIO()
        Image.fromarray(noise).save(progressive, "JPEG", progressive=True)
        assert is_complete(progressive.getvalue(), suffix)
        assert not is_complete(progressive.getvalue()[:-200], suffix)


def test_videos_say_whether_they_are_whole(tmp_path):
    shots = line(4)
    data = film(tmp_path / "v.mp4", shots).read_bytes()
    assert is_video_complete(tmp_path / "v.mp4")
    for size in (10, 100, len(data) // 2, len(data) - 1):
        (tmp_path / "half.mp4").write_bytes(data[:size])
        assert not is_video_complete(tmp_path / "half.mp4"), size
    (tmp_path / "text.mp4").write_bytes(b"this is not a video at all")
    assert is_video_complete(tmp_path / "text.mp4")  # whoever reads it says what is wrong


def test_one_vehicles_part_of_a_log_holds_its_packets_only(tmp_path):
    writer = TlogWriter(tmp_path / "all.tlog")
    packers = {system: dialect.MAVLink(None, system, 1) for system in (1, 2)}
    for k in range(10):
        for system, packer in packers.items():
            message = dialect.MAVLink_system_time_message(1_780_000_000_000_000 + k, k)
            writer.write(1.78e9 + k, message.pack(packer, force_mavlink1=system == 2 and k % 2 == 0))
    writer.close()
    with (tmp_path / "all.tlog").open("ab") as file:
        file.write(b"\0\x05torn")
    for system in (1, 2):
        assert write_link_log(tmp_path / "all.tlog", system, tmp_path / "own.tlog") == 10
        assert [p.system for _, p in read_tlog(tmp_path / "own.tlog")] == [system] * 10
    assert write_link_log(tmp_path / "none.tlog", 1, tmp_path / "own.tlog") == 0
