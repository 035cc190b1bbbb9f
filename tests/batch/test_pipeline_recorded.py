"""Placing frames as recorded: defaults for what is missing, and what is said about it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthoswarm.model.camera import Camera, angles_from_rotation, rotation_from_angles
from orthoswarm.model.frame import TAGGED_TILT_SIGMA, THETA_HAT_DEG, UNSTATED_SIGMA_M, Fix, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.mosaic.recorded_pose import area_grid, recorded_cameras
from orthoswarm.refine.flight.unsolved_pictures import few_of_their_kind, hovering_vehicles, place_by_neighbours
from orthoswarm.trajectory.legs import course

GRID = LocalGrid(32632)
MIDDLE = np.array([465_000.0, 5_250_000.0])


def frame(i, east, north, vehicle="a", **other):
    lat, lon = GRID.to_geographic(np.add(MIDDLE, (east, north)))
    known = {"height_m": 100.0, "yaw_rad": 0.0, "pitch_rad": -np.pi / 2, "roll_rad": 0.0} | other
    return Frame(
        image=f"{vehicle}/{i}.jpg",
        path=Path(f"{i}.jpg"),
        vehicle=vehicle,
        time_s=float(i),
        fix=Fix(float(lat), float(lon), **known),
        width=400,
        height=300,
    )


def yaw_of(placed):
    return float(angles_from_rotation(placed.camera.rotation)[0])


def test_what_is_recorded_is_taken():
    made = recorded_cameras([frame(0, 10, 20, yaw_rad=0.5, height_m=77.0, position_sigma_m=0.02)], GRID)
    (placed,) = made.placed
    np.testing.assert_allclose(placed.camera.position, [*np.add(MIDDLE, (10, 20)), 77.0], atol=1e-6)
    fix = placed.frame.fix
    assert yaw_of(placed) == pytest.approx(0.5 - float(GRID.convergence_rad(fix.lat_deg, fix.lon_deg)))
    assert placed.camera.lens.fov_rad == pytest.approx(np.radians(THETA_HAT_DEG))
    assert placed.stage == "realtime" and not made.warnings and not made.rejected
    assert area_grid([placed.frame]).epsg == 32632


def test_field_of_view_from_the_flag_the_tags_or_the_default():
    plain, hinted = frame(0, 0, 0), replace(frame(1, 9, 0), fov_hint_rad=1.4)
    portrait = replace(frame(2, 18, 0), width=300, height=400)
    own = recorded_cameras([plain, hinted, portrait], GRID).placed
    assert own[1].camera.lens.fov_rad == pytest.approx(1.4)
    assert own[2].camera.lens.focal_px == pytest.approx(own[0].camera.lens.focal_px)
    flagged = recorded_cameras([plain, hinted, portrait], GRID, 1.0).placed
    assert {round(p.camera.lens.focal_px, 6) for p in flagged} == {round(200 / np.tan(0.5), 6)}


def test_missing_headings_follow_the_flight():
    path = [(0, 0), (0, 30), (0, 60), (0, 90), (20, 90), (40, 90), (40, 60), (40, 30)]
    frames = [frame(i, *p, yaw_rad=None) for i, p in enumerate(path)]
    made = recorded_cameras(frames, GRID)
    found = np.degrees([yaw_of(p) for p in made.placed])
    np.testing.assert_allclose(found[[0, 1, 2, 3]], 0, atol=3)
    np.testing.assert_allclose(found[4], 90, atol=3)
    np.testing.assert_allclose(np.abs(found[[6, 7]]), 180, atol=3)
    assert any("point along the flight" in w for w in made.warnings)


def test_a_hovering_drone_keeps_its_last_course():
    ground = np.array([[0, 0], [10, 0], [20, 0], [20.1, 0.2], [20.0, -0.1], [20, 0]], float)
    np.testing.assert_allclose(np.degrees(course(ground)), 90, atol=1)
    assert (course(np.zeros((4, 2))) == 0).all() and course(np.zeros((1, 2))).tolist() == [0.0]


def test_missing_heights_come_from_the_others_or_the_spacing():
    some = [frame(i, 0, 20.0 * i, height_m=None if i == 2 else 60.0) for i in range(5)]
    made = recorded_cameras(some, GRID)
    assert made.placed[2].camera.position[2] == 60.0 and not made.warnings
    none = [frame(i, 0, 20.0 * i, height_m=None) for i in range(5)]
    made = recorded_cameras(none, GRID)
    # 20 m steps at 75 % overlap: the picture's short side is 80 m of ground
    assert made.placed[0].camera.position[2] == pytest.approx(80 * made.placed[0].camera.lens.focal_px / 300)
    assert any("no photo has a height" in w for w in made.warnings)
    height = made.placed[0].camera.position[2]
    assert made.placed[0].sigma_m == pytest.approx(np.hypot(UNSTATED_SIGMA_M, TAGGED_TILT_SIGMA * height))


def test_a_position_that_cannot_be_is_left_out():
    frames = [frame(i, 0, 20.0 * i) for i in range(6)]
    frames[3] = frame(3, 90_000, 0)
    frames[4] = replace(frames[4], fix=replace(frames[4].fix, lat_deg=-80.0, lon_deg=120.0))
    made = recorded_cameras(frames, GRID)
    assert [r.image for r in made.rejected] == ["a/3.jpg", "a/4.jpg"] and len(made.placed) == 4
    assert made.rejected[0].detail == "90 km from the others"


def test_odd_pictures_follow_their_neighbours():
    frames = [frame(i, 0, 20.0 * i) for i in range(6)] + [replace(frame(6, 30, 50), width=800, height=600)]
    recorded = recorded_cameras(frames, GRID).placed
    assert few_of_their_kind(frames).tolist() == [False] * 6 + [True]
    assert not few_of_their_kind(frames[6:]).any()

    def refined(p):
        turned = rotation_from_angles(0.1, 0, 0) @ rotation_from_angles(0, 0, 0).T
        lens = replace(p.camera.lens, focal_px=0.8 * p.camera.lens.focal_px)
        camera = Camera(np.add(p.camera.position, (3.0, -2.0, 5.0)), turned @ p.camera.rotation, lens)
        return replace(p, camera=camera, stage="fine", sigma_m=0.1)

    (made,) = place_by_neighbours(recorded[6:], recorded, [refined(p) for p in recorded[:6]])
    wanted = refined(recorded[6]).camera
    np.testing.assert_allclose(made.camera.position, wanted.position)
    np.testing.assert_allclose(made.camera.rotation, wanted.rotation)
    assert made.camera.lens == wanted.lens and made.stage == "fine" and made.weak and made.sigma_m > 1
    assert place_by_neighbours(recorded[6:], recorded, []) == recorded[6:]  # stays as recorded


def test_pictures_of_one_spot_are_known():
    frames = [frame(i, 0.3 * (i % 2), 0.2 * (i % 3)) for i in range(9)]
    frames += [frame(i, 0, 20.0 * i, vehicle="b") for i in range(9)] + [frame(0, 50, 50, vehicle="c")]
    assert hovering_vehicles(recorded_cameras(frames, GRID).placed) == {"a"}


def test_a_receiver_that_wanders_about_one_spot_is_no_flight():
    rng = np.random.default_rng(4)
    frames = [frame(i, *rng.normal(0.0, 2.0, 2)) for i in range(20)]
    frames += [frame(i, 0.0, 0.8 * i, vehicle="b") for i in range(20)]  # slow, but it flies
    assert hovering_vehicles(recorded_cameras(frames, GRID).placed) == {"a"}
