"""The coverage of the planned area while pictures come: shares, gaps with causes, and what survives a restart."""

import base64
import io
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.kit.daemon_kit import GRID, Served, Shot, camera_at, jpeg, pose_of, serving
from tests.kit.mosaic_scene import EAST, NORTH

START_S = 1_780_000_000.0
Leg = np.ndarray


def _area(width_m: float = 260.0, height_m: float = 200.0) -> dict:
    ring = [(0.0, 0.0), (width_m, 0.0), (width_m, height_m), (0.0, height_m), (0.0, 0.0)]
    corners = np.array(ring) + np.array((EAST, NORTH))
    return {"type": "Polygon", "coordinates": [[[float(v[1]), float(v[0])] for v in GRID.to_geographic(corners)]]}


def _plan(served: Served) -> tuple[dict, dict[str, list[Leg]]]:
    """A plan for two vehicles, and vehicle -> its legs as ground points, metres from the corner."""
    body = {"area": _area(), "vehicles": 2, "altitude_m": 60.0, "fov_min_deg": 70.0}
    plan = served.command("/api/plans", body).json()
    legs: dict[str, list[Leg]] = {}
    for feature in served.get(f"/api/plans/{plan['id']}/map").json()["features"]:
        if feature["properties"].get("kind") == "leg":
            ends = np.array(feature["geometry"]["coordinates"])[[0, -1]]
            legs.setdefault(feature["properties"]["vehicle"], []).append(
                GRID.to_grid(ends[:, 1], ends[:, 0]) - [EAST, NORTH]
            )
    return plan, legs


def _shots(legs: list[Leg], vehicle: str, step_m: float, left_out: range = range(0)) -> list[Shot]:
    """Pictures along legs; those whose numbers are left out were taken but have not arrived."""
    shots: list[Shot] = []
    number = 0
    for leg in legs:
        way = leg[1] - leg[0]
        length = float(np.hypot(*way))
        heading = float(np.degrees(np.arctan2(way[0], way[1])))
        for along in np.arange(0.0, length + 0.1, step_m):
            number += 1
            if number in left_out:
                continue
            at = leg[0] + along / length * way
            camera = camera_at(float(at[0]), float(at[1]), yaw_deg=heading)
            shots.append(Shot(pose_of(camera, f"IMG_{number:04d}.jpg", vehicle, START_S + number), jpeg(camera)))
    return shots


def _send(served: Served, shots: list[Shot]) -> None:
    assert {served.send(shot).status_code for shot in shots} == {201}


def _told(served: Served, pictures: int) -> dict:
    return served.until("/api/coverage", lambda c: sum(c.get("pictures", {}).values()) == pictures)


@pytest.fixture
def served(tmp_path: Path):
    with serving(tmp_path / "w") as running:
        yield running


def test_without_an_area_there_is_no_coverage(served: Served) -> None:
    document = served.get("/api/coverage").json()
    assert document["state"] == "no area" and document["seen_share"] is None and document["gaps"] == []
    assert served.get("/api/coverage/cells.png").status_code == 404


@pytest.mark.slow
def test_flown_legs_are_seen_and_others_planned_and_a_hole_is_told_with_its_cause(tmp_path: Path) -> None:
    (tmp_path / "w").mkdir()
    (tmp_path / "w" / "orthoswarm.toml").write_text("coarse = false\n")  # recorded poses stay what counts
    with serving(tmp_path / "w") as served:
        plan, legs = _plan(served)
        before = served.until("/api/coverage", lambda c: c["plan"] == plan["id"])
        assert before["state"] == "planned" and before["planned_share"] == 1.0
        step = plan["trigger_m"]
        first = _shots(legs["v1"], "v1", step)
        _send(served, first)
        flown = _told(served, len(first))
        share = sum(np.hypot(*(leg[1] - leg[0])) for leg in legs["v1"]) / sum(
            np.hypot(*(leg[1] - leg[0])) for row in legs.values() for leg in row
        )
        assert flown["state"] == "in flight" and flown["pictures"] == {"placed": 0, "recorded": len(first)}
        assert 0.8 * share < flown["seen_share"] < 1.25 * share
        assert flown["missed_share"] == 0.0 and flown["planned_share"] > 0.2
        assert flown["recorded"]["seen_share"] == flown["seen_share"]  # nothing is placed yet
        second = _shots(legs["v2"], "v2", step, left_out=range(4, 12))
        _send(served, second)
        done = _told(served, len(first) + len(second))
        worst = done["gaps"][0]
        assert worst["cause"] == "pictures not arrived" and worst["vehicle"] == "v2"
        assert worst["area_m2"] > 300 and worst["polygon"]["type"] == "Polygon"
        assert [m["vehicle"] for m in done["missing_pictures"]] == ["v2"] * 8
        assert sum(done[f"{s}_share"] for s in ("seen", "poor", "missed", "planned")) == pytest.approx(1.0)
        features = served.get("/api/coverage/gaps.geojson").json()["features"]
        assert [f["properties"]["area_m2"] for f in features] == [g["area_m2"] for g in done["gaps"]]
        metrics = served.get("/metrics").text
        assert f'orthoswarm_coverage_share{{state="seen"}} {done["seen_share"]:.9g}' in metrics
        cells = Image.open(io.BytesIO(served.get("/api/coverage/cells.png").content))
        counts = np.bincount(np.asarray(cells).ravel(), minlength=6)
        assert counts[2] / counts[1:5].sum() == pytest.approx(done["seen_share"], abs=1e-3)
        _is_in_the_report(served, tmp_path / "w", done)
    with serving(tmp_path / "w") as served:
        again = _told(served, len(first) + len(second))
        assert [again[k] for k in ("seen_share", "poor_share", "missed_share")] == pytest.approx(
            [done[k] for k in ("seen_share", "poor_share", "missed_share")]
        )


def _is_in_the_report(served: Served, workspace: Path, coverage: dict) -> None:
    """report.html shows the cells as a picture, and the shares."""
    job = served.command("/api/export", {"formats": ["cog"]}).json()
    served.until("/api/jobs", lambda rows: any(r["id"] == job["id"] and r["state"] == "done" for r in rows))
    page = (workspace / "report.html").read_text()
    found = re.search(r'class="cells" src="data:image/png;base64,([^"]+)"', page)
    assert found is not None and f"{100 * coverage['seen_share']:.2f} %" in page
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(found[1]))))
    cells = Image.open(io.BytesIO(served.get("/api/coverage/cells.png").content))
    assert np.array_equal(shown, np.asarray(cells))


@pytest.mark.slow
def test_a_blurred_picture_is_seen_poorly(served: Served) -> None:
    plan, legs = _plan(served)
    shots = _shots(legs["v1"], "v1", plan["footprint_m"][1] * 0.75)
    blurred = 2
    for k, shot in enumerate(shots):  # the made-up ground is smooth: it gets some grain
        picture = cv2.imdecode(np.frombuffer(shot.data, np.uint8), cv2.IMREAD_COLOR)
        grain = np.random.default_rng(k).normal(0.0, 25.0, picture.shape[:2])[..., None]
        picture = np.clip(picture + grain, 0, 255).astype(np.uint8)
        shot.data = cv2.imencode(".jpg", cv2.GaussianBlur(picture, (0, 0), 4.0) if k == blurred else picture)[
            1
        ].tobytes()
    _send(served, shots)
    poor = served.until("/api/coverage", lambda c: any(g["detail"] == "blurred" for g in c["gaps"]))
    gap = next(g for g in poor["gaps"] if g["detail"] == "blurred")
    assert gap["cause"] == "seen poorly" and gap["area_m2"] > 500
