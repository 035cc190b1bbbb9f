"""The HTTP API of a real `orthoswarm serve`: pictures in, frames, layers and tiles out, and who may ask."""

import concurrent.futures
import json
import socket
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from gcs_plugin.daemon import daemon
from gcs_plugin.daemon.settings import Settings
from orthoswarm.model.errors import InputError
from tests.kit.daemon_kit import Shot, camera_at, form, jpeg, line, pose_of, serving, tile_over


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("workspace")) as served:
        yield served


def test_it_starts_without_anything_and_says_so(served):
    health = served.get("/healthz").json()
    assert health["status"] == "ok"
    assert health["version"]
    for path in ("/api/vehicles", "/api/frames", "/api/jobs"):
        assert isinstance(served.get(path).json(), list)
    assert {layer["name"] for layer in served.get("/api/layers").json()} >= {"realtime", "coarse", "fine", "best"}
    assert "orthoswarm_frames" in served.get("/metrics").text


def test_the_map_grows_with_posted_pictures(served):
    shots = line(6, "grower", east=600)
    address = "/tiles/realtime/{}/{}/{}.png".format(*tile_over(shots[3].camera))
    empty = served.get(address)
    for shot in shots:
        answer = served.send(shot)
        assert answer.status_code == 201
        assert answer.json()["image"] == shot.pose["image"]
    rows = served.until("/api/frames?vehicle=grower", lambda rows: all(row["on_map"] for row in rows))
    assert [row["image"] for row in rows] == [shot.pose["image"] for shot in shots]
    assert {row["stage"] for row in rows} == {"realtime"}
    assert all(row["sigma_m"] > 0 for row in rows)
    full = served.get(address)
    assert full.headers["etag"] != empty.headers["etag"]
    assert full.content != empty.content
    again = served.get(address, headers={"If-None-Match": full.headers["etag"]})
    assert again.status_code == 304
    assert served.get(address.replace(".png", ".webp")).headers["content-type"] == "image/webp"


def ten_bits(shot):
    """The picture as a thermal camera writes it: values of 200 to 900 in 16 bits."""
    grey = cv2.imdecode(np.frombuffer(shot.data, np.uint8), cv2.IMREAD_GRAYSCALE).astype(float)
    deep = (200 + grey * 700 / 255).astype(np.uint16)
    pose = shot.pose | {"image": shot.pose["image"].replace(".jpg", ".png")}
    return replace(shot, pose=pose, data=cv2.imencode(".png", deep)[1].tobytes())


def pixels(answer):
    return cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)


def test_pictures_of_ten_bits_are_not_dark_on_the_map_and_in_the_view(served):
    shots = [ten_bits(shot) for shot in line(3, "thermal", east=-600)]
    for shot in shots:
        assert served.send(shot).status_code == 201
    rows = served.until("/api/frames?vehicle=thermal", lambda rows: all(row["on_map"] for row in rows))
    tile = pixels(served.get("/tiles/realtime/{}/{}/{}.png".format(*tile_over(shots[1].camera))))
    assert np.ptp(tile[tile[..., 3] > 0][:, :3]) > 150  # 700 of 65,536 levels are 3 of 256
    view = served.get(f"/api/frames/{rows[0]['seq']}/view")
    assert view.headers["content-type"] == "image/jpeg"
    assert np.ptp(pixels(view)) > 150 and pixels(view).shape[:2] == (rows[0]["height"], rows[0]["width"])
    assert served.get(f"/api/frames/{rows[0]['seq']}/picture").content == shots[0].data
    assert served.get("/api/frames/999999/view").status_code == 422


def test_pictures_of_a_place_are_named_with_their_outlines(served):
    shots = line(3, "looked", east=1500)
    for shot in shots:
        assert served.send(shot).status_code == 201
    rows = served.until("/api/frames?vehicle=looked", lambda rows: all(row["on_map"] for row in rows))
    pose = shots[1].pose
    found = served.get(f"/api/pictures?lat_deg={pose['lat_deg']}&lon_deg={pose['lon_deg']}").json()
    assert found[0]["image"] == pose["image"] and {row["vehicle"] for row in found} == {"looked"}
    assert {row["seq"] for row in found} <= {row["seq"] for row in rows}
    lon, lat = np.array(found[0]["outline"]).T
    assert len(lon) == 4 and lon.min() < pose["lon_deg"] < lon.max() and lat.min() < pose["lat_deg"] < lat.max()
    assert served.get("/api/pictures?lat_deg=0&lon_deg=0").json() == []
    assert served.get("/api/pictures?lat_deg=north&lon_deg=0").status_code == 422


def test_a_picture_that_browsers_show_is_viewed_unchanged(served):
    shot = line(1, "viewed")[0]
    assert served.send(shot).status_code == 201
    (row,) = served.get("/api/frames?vehicle=viewed").json()
    assert served.get(f"/api/frames/{row['seq']}/view").content == shot.data


def test_a_repeated_picture_is_stored_once(served):
    shot = line(1, "twice")[0]
    assert served.send(shot).status_code == 201
    assert served.send(shot).status_code == 200
    assert len(served.get("/api/frames?vehicle=twice").json()) == 1


def test_another_picture_by_a_known_name_is_told(served):
    first, other = line(2, "restarted")
    other.pose["image"] = first.pose["image"]
    for _ in range(2):
        assert served.send(first).status_code in (200, 201)
    assert "restarted" not in served.get("/healthz").text
    assert served.send(other).status_code == 200  # the first one stays
    health = served.get("/healthz").json()
    assert [(row["vehicle"], row["count"]) for row in health["refused"] if row["cause"] == "name"] == [("restarted", 1)]
    assert any("restarted sent another picture by a name that it used before" in text for text in health["problems"])


def test_the_same_picture_sent_many_times_at_once_is_stored_once(served):
    shot = line(1, "crowd")[0]
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        codes = list(pool.map(lambda _: served.send(shot).status_code, range(8)))
    assert sorted(codes) == [200] * 7 + [201]


@pytest.mark.parametrize(
    "image",
    [
        "../../etc/passwd",
        "/absolute.jpg",
        "a/b\\c:d*?.jpg",
        "naïve ☃.jpg",
        "nul\x00inside",
        "\ud800 alone",
        " ",
        "x" * 65_536,
        "video.mp4#000123",
        "'; DROP TABLE frames; --",
    ],
)
def test_names_come_back_as_posted(served, image):
    camera = camera_at(1200)
    pose = pose_of(camera, image, vehicle="odd " + image[:20])
    answer = served.send(Shot(pose, jpeg(camera)))
    assert answer.status_code == 201, answer.text
    assert answer.json()["image"] == image
    rows = [row for row in served.get("/api/frames").json() if row["image"] == image]
    assert [row["vehicle"] for row in rows] == [pose["vehicle"]]


def test_frames_are_chosen_by_vehicle_time_and_number(served):
    for shot in line(5, "chosen", east=1500):
        served.send(shot)
    whole = served.get("/api/frames", params={"vehicle": "chosen"}).json()
    since = served.get("/api/frames", params={"vehicle": "chosen", "since": whole[2]["time"]}).json()
    assert [row["image"] for row in since] == [row["image"] for row in whole[2:]]
    two = served.get("/api/frames", params={"vehicle": "chosen", "limit": 2}).json()
    assert two == whole[:2]
    for limit in (10**9, 10**23):  # without a maximum
        assert served.get("/api/frames", params={"limit": limit}).status_code == 200
    assert served.get("/api/frames", params={"since": "yesterday"}).status_code == 422


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"lat_deg": 95.0}, "lat_deg"),
        ({"lon_deg": None}, "lon_deg"),
        ({"lat_deg": float("nan")}, "lat_deg"),
        ({"yaw_deg": "north"}, "yaw_deg"),
        ({"vehicle": ""}, "vehicle"),
        ({"vehicle": 7}, "vehicle"),
        ({"time": "noon"}, "time"),
    ],
)
def test_a_wrong_pose_is_refused_in_words(served, change, word):
    shot = line(1, "wrong")[0]
    shot.pose.update(change)
    answer = served.send(shot)
    assert answer.status_code == 422
    assert word in answer.json()["detail"]


def test_what_is_no_picture_is_refused(served):
    pose = pose_of(camera_at(), "text.jpg", "wrong")
    assert served.send(Shot(pose, b"this is a text")).status_code == 422
    assert served.post("/api/frames", data={"pose": json.dumps(pose)}).status_code == 422
    assert served.post("/api/frames", content=b"{}").status_code in (400, 422)
    assert served.get("/api/frames?vehicle=wrong").json() == []


def test_a_damaged_picture_is_kept_and_said_to_be_damaged(served):
    shot = line(1, "damaged")[0]
    shot.data = shot.data[:200] + bytes(100)
    answer = served.send(shot)
    if answer.status_code == 201:
        rows = served.until(
            "/api/frames?vehicle=damaged", lambda rows: rows[0]["stage"] == "rejected" or rows[0]["on_map"]
        )
        assert rows[0]["reason"] or rows[0]["on_map"]
    else:
        assert answer.status_code == 422


def test_a_picture_that_is_cut_short_is_rejected_under_its_own_name(served):
    shot = line(1, "cut")[0]
    shot.data = shot.data[: len(shot.data) // 2]
    assert served.send(shot).status_code == 201
    (row,) = served.until("/api/frames?vehicle=cut", lambda rows: rows[0]["stage"] == "rejected")
    assert row["reason"].startswith(f"{row['image']} is a damaged JPEG")


def test_pages_of_other_sites_are_refused(served):
    shot = line(1, "foreign")[0]
    bad = served.post("/api/frames", **form(shot), headers={"Origin": "https://evil.example"})
    assert bad.status_code == 403
    assert served.post("/api/frames", **form(shot), headers={"Origin": "null"}).status_code == 403
    assert served.get("/api/frames", headers={"Host": "evil.example"}).status_code == 403
    assert served.get("/api/frames", headers={"Host": "evil.example:8650"}).status_code == 403
    good = served.post("/api/frames", **form(shot), headers={"Origin": served.url})
    assert good.status_code == 201


def test_commands_need_the_token(served):
    for path in ("/api/refine", "/api/export", "/api/missions/v1/start", "/api/coverage/flight", "/api/plans"):
        assert served.post(path, json={}).status_code == 401
        assert served.post(path, json={}, headers={"Authorization": "Bearer wrong"}).status_code == 401
        assert served.post(path + "?token=" + served.token, json={}).status_code == 401


def test_no_path_leads_out_of_the_workspace(served):
    host, port = urlsplit(served.url).hostname, urlsplit(served.url).port
    for path in ("/static/../app.py", "/static/%2e%2e/app.py", "/tiles/..%2f..%2fjournal.db/1/1/1.png", "//etc/passwd"):
        with socket.create_connection((host, port), timeout=120) as connection:
            connection.sendall(f"GET {path} HTTP/1.1\r\nHost: {host}:{port}\r\nConnection: close\r\n\r\n".encode())
            head = connection.makefile("rb").readline()
        assert b" 404 " in head or b" 403 " in head or b" 307 " in head, (path, head)


@pytest.mark.parametrize(
    "path", ["realtime/3/9/1.png", "nothing/1/1/1.png", "realtime/40/0/0.png", "realtime/1/1/1.gif"]
)
def test_there_are_no_other_tiles(served, path):
    assert served.get(f"/tiles/{path}").status_code == 404


def test_a_huge_request_is_refused(served):
    shot = line(1, "huge")[0]
    shot.data = bytes(120_000_000)
    try:
        assert served.send(shot).status_code == 413
    except Exception as error:  # the connection may be closed while the body is still being sent
        assert "Error" in type(error).__name__
    assert served.get("/healthz").status_code == 200


def test_news_come_over_the_websocket(served):
    from websockets.sync.client import connect

    address = served.url.replace("http", "ws") + "/api/events"
    with connect(address, origin=served.url, open_timeout=120) as events:
        assert json.loads(events.recv(timeout=120))["type"] == "hello"
        served.send(line(1, "news", east=2000)[0])
        kinds = set()
        while not {"frame", "layer"} <= kinds:
            event = json.loads(events.recv(timeout=120))
            kinds.add(event["type"])
            if event["type"] == "frame" and event["vehicle"] == "news":
                assert len(event["outline"]) == 4
    from websockets.exceptions import InvalidStatus, WebSocketException

    with pytest.raises((InvalidStatus, WebSocketException)):
        connect(address, origin="https://evil.example", open_timeout=120).recv(timeout=120)


def test_a_second_daemon_does_not_take_a_living_ones_workspace(served, monkeypatch):
    monkeypatch.setattr(daemon, "_LOCK_S", 0.3)
    workspace = served.process.args[served.process.args.index("--workspace") + 1]
    with pytest.raises(InputError, match="another run"):
        daemon.Daemon(Settings(workspace=Path(workspace)))
