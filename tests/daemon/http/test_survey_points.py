"""Surveyed points: loaded from a table, marked in pictures, measured at once, and written as gcp_list.txt."""

from dataclasses import replace

import httpx
import numpy as np
import pytest

from orthoswarm.evaluation.checkpoints import read_checkpoints
from tests.kit.daemon_kit import GRID, line, serving

NAME = "P 1"


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("workspace")) as served:
        yield served


@pytest.fixture(scope="module")
def shots(served):
    shots = line(4, "v1")
    for shot in shots:
        assert served.send(shot).status_code == 201
    served.until("/api/frames", lambda rows: len(rows) == 4 and all(row["on_map"] for row in rows))
    return shots


def put(served, table):
    return httpx.put(f"{served.url}/api/points", content=table, headers=served.auth, trust_env=False)


def mark(served, **body):
    return served.command("/api/points/marks", {"name": NAME, **body})


def test_points_are_marked_and_measured_and_come_out_as_gcp_list(served, shots, tmp_path):
    ground = shots[1].camera.to_ground(np.array([95.0, 65.0]), 0.0)
    lat, lon = (float(v) for v in GRID.to_geographic(ground))
    table = f"name,lat_deg,lon_deg\n{NAME},{lat},{lon}\nfar,10.0,20.0\n"
    rows = put(served, table).json()
    assert [(row["name"], row["marks"], row["off_m"]) for row in rows] == [(NAME, [], None), ("far", [], None)]
    seen = {row["image"]: row for row in served.get(f"/api/points/pictures?name={NAME}").json()}
    assert len(seen) >= 2 and served.get("/api/points/pictures?name=far").json() == []
    for image, row in seen.items():  # where the picture shows it, and a pixel beside in the first
        camera = next(shot.camera for shot in shots if shot.pose["image"] == image)
        u, v = camera.project(np.array([[*ground, 0.0]]))[0]
        assert np.hypot(u - row["column"], v - row["row"]) < 3.0
        found = mark(served, seq=row["seq"], column=float(u), row=float(v)).json()[0]
    assert np.hypot(*found["off_m"]) < 0.5 and found["rays_miss_m"] < 0.3
    assert all(m["off_px"] < 1.0 for m in found["marks"]) and len(found["marks"]) == len(seen)
    first = found["marks"][0]
    moved = mark(served, seq=first["seq"], column=first["column"] + 15.0, row=first["row"]).json()[0]
    assert moved["rays_miss_m"] > 3 * found["rays_miss_m"] and moved["marks"][0]["off_px"] > 3.0
    text = served.get("/api/points/gcp_list.txt").text
    (tmp_path / "gcp_list.txt").write_text(text)
    (point,) = read_checkpoints(tmp_path / "gcp_list.txt")
    assert point.name == "P_1" and point.surveyed.tolist() == pytest.approx([lon, lat], abs=1e-8)
    assert sorted((m.image, m.column) for m in point.marks) == [
        (m["image"], pytest.approx(m["column"], abs=0.01)) for m in sorted(moved["marks"], key=lambda m: m["image"])
    ]
    spaced = shots[0].pose["image"].replace(".", " 1.")
    assert served.send(replace(shots[0], pose=shots[0].pose | {"image": spaced, "vehicle": "v2"})).status_code == 201
    (other,) = served.get("/api/frames?vehicle=v2").json()
    assert mark(served, seq=other["seq"], column=5.0, row=5.0).status_code == 200
    refused = served.get("/api/points/gcp_list.txt")
    assert refused.status_code == 422 and "has a blank in its name" in refused.text
    assert mark(served, seq=other["seq"], column=None, row=None).status_code == 200
    less = mark(served, seq=first["seq"], column=None, row=None).json()[0]
    assert len(less["marks"]) == len(seen) - 1
    again = put(served, table).json()  # the same table: the marks stay; what moved has none
    assert again[0]["marks"] == less["marks"]
    assert put(served, table.replace(f"{lat}", f"{lat + 1e-4}")).json()[0]["marks"] == []


def test_what_makes_no_sense_is_refused(served, shots):
    assert put(served, "name,lat_deg\nP,47\n").status_code == 422
    assert put(served, b"\xff\xfe\x00").status_code == 422
    assert put(served, f"name,lat_deg,lon_deg\n{NAME},47.0,8.0\n").status_code == 200
    seq = served.get("/api/frames").json()[0]["seq"]
    for body in (
        {"seq": 999, "column": 1, "row": 1}, {"seq": seq, "column": 1e6, "row": 1},
        {"seq": seq, "column": "a", "row": 1}, {"seq": seq, "column": 10**400, "row": 1},
        {"seq": seq, "column": None, "row": 1},
        {"seq": seq, "column": True, "row": 1}, {"column": 1, "row": 1},
        {"name": "nobody", "seq": seq, "column": 1, "row": 1},
    ):  # fmt: skip
        assert mark(served, **body).status_code == 422, body
    image = served.get("/api/frames").json()[0]["image"]
    outside = put(served, f"EPSG:4326\n8.0 47.0 NaN 5000 5000 {image} {NAME}\n")
    assert outside.status_code == 422 and "a point is marked at 5000, 5000" in outside.text
    assert served.get("/api/points/pictures?name=nobody").status_code == 422
    assert served.get("/api/points").json()[0]["marks"] == []


def test_pictures_of_one_name_are_told_apart_by_their_vehicle(tmp_path):
    with serving(tmp_path / "w") as served:
        for shot in [*line(2, "v1"), *line(2, "v2", east=10)]:
            assert served.send(shot).status_code == 201
        served.until("/api/frames", lambda rows: len(rows) == 4 and all(row["on_map"] for row in rows))
        put(served, f"name,lat_deg,lon_deg\n{NAME},48.0,11.0\n")
        frames = served.get("/api/frames").json()
        for row in frames:
            assert mark(served, seq=row["seq"], column=row["seq"], row=5.0).status_code == 200
        table = served.get("/api/points/gcp_list.txt").text
        names = {text.split()[5] for text in table.splitlines()[1:]}
        assert names == {f"{row['vehicle']}/{row['image']}" for row in frames} and len(names) == 4
        put(served, "name,lat_deg,lon_deg\nother,10.0,20.0\n")
        (again,) = put(served, table).json()
        marks = {(m["seq"], m["vehicle"], m["column"]) for m in again["marks"]}
        assert marks == {(row["seq"], row["vehicle"], row["seq"]) for row in frames}
