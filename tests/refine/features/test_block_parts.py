"""Legs, units, records and the placing of weak pictures."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.earth import distance_m
from orthoswarm.model.frame import DEFAULT_HEIGHT_M, Fix, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import Leg, PlacedFrame, Solution
from orthoswarm.refine.bundle.flight_records import read_records
from orthoswarm.refine.flight.vehicle_refinement import LONGEST_UNIT_PHOTOS, merge_units, split_units
from orthoswarm.refine.flight.weakly_held_pictures import interpolate_weak
from orthoswarm.trajectory.legs import split_legs
from orthoswarm.trajectory.near_paths import separate_places


def frame(i, vehicle="a", camera="x", size=(640, 480), **fix):
    given = {
        "lat_deg": 48.0 + 1e-4 * i,
        "lon_deg": 11.0,
        "height_m": 100.0,
        "yaw_rad": 0.0,
        "pitch_rad": -np.pi / 2,
    } | fix
    return Frame(
        image=f"{vehicle}/{i:04d}.jpg",
        path=Path("none"),
        vehicle=vehicle,
        time_s=1.7e9 + i,
        fix=Fix(**given),
        width=size[0],
        height=size[1],
        camera=camera,
    )


def boustrophedon(legs=3, count=20, step=10.0, apart=60.0):
    out = []
    for k in range(legs):
        y = np.arange(count) * step
        out.append(np.c_[np.full(count, k * apart), y if k % 2 == 0 else y[::-1]])
    return np.concatenate(out)


def test_legs_of_a_lawnmower_flight_are_told_apart():
    leg = split_legs(boustrophedon())
    assert leg.max() == 2
    assert all((leg[20 * k + 2 : 20 * k + 18] == k).all() for k in range(3))


def test_a_straight_line_in_any_direction_is_one_leg():
    for angle in np.linspace(0, 2 * np.pi, 13):
        path = np.outer(np.arange(30) * 8.0, [np.sin(angle), np.cos(angle)])
        assert (split_legs(path) == 0).all()


def test_noise_of_a_receiver_does_not_cut_a_leg():
    path = np.c_[np.zeros(60), np.arange(60) * 9.0] + np.random.default_rng(0).uniform(-1, 1, (60, 2))
    assert len(np.unique(split_legs(path)[split_legs(path) >= 0])) == 1


def test_a_long_pause_ends_a_leg():
    path = np.c_[np.zeros(20), np.arange(20) * 9.0]
    time = np.arange(20.0)
    time[10:] += 300
    assert split_legs(path, time).max() == 1


def test_hovering_and_tiny_flights_do_not_fail():
    assert len(split_legs(np.zeros((15, 2)))) == 15
    assert len(split_legs(np.zeros((1, 2)))) == 1
    assert len(split_legs(np.zeros((0, 2)))) == 0


def test_every_frame_is_in_exactly_one_unit_of_one_lens():
    frames = [frame(i, camera="wide" if i < 40 else "zoom") for i in range(80)]
    frames += [frame(100 + i, size=(480, 640)) for i in range(9)]
    units = split_units({"a": frames, "b": [frame(i, "b") for i in range(5)]})
    assert sorted(f.image for u in units for f in u) == sorted(
        {f.image for f in frames} | {f"b/{i:04d}.jpg" for i in range(5)}
    )
    assert all(len({(f.vehicle, f.camera, f.width, f.height) for f in u}) == 1 for u in units)


def test_a_stray_camera_name_does_not_split_a_flight():
    frames = [frame(i, camera="odd" if i == 30 else "x") for i in range(60)]
    (unit,) = split_units({"a": frames})
    assert [f.image for f in unit] == [f.image for f in frames]


def test_long_flights_are_cut_into_even_stretches():
    units = split_units({"a": [frame(i) for i in range(LONGEST_UNIT_PHOTOS * 2 + 10)]})
    assert len(units) == 3
    assert max(map(len, units)) <= LONGEST_UNIT_PHOTOS


def test_photos_of_another_place_are_a_unit_of_their_own():
    """There and back: what was taken at one place is one unit, in order of time."""
    away = [frame(200 + i, lat_deg=48.1 + 1e-4 * i) for i in range(20)]
    frames = [*(frame(i) for i in range(20)), *away, *[frame(400 + i, lat_deg=48.0 + 1e-4 * i) for i in range(20)]]
    one, other = split_units({"a": frames})
    assert [f.image for f in one] == [f.image for f in [*frames[:20], *frames[40:]]]
    assert [f.image for f in other] == [f.image for f in away]


def test_lines_of_a_high_flight_are_one_place():
    """600 m from line to line, 300 m from photo to photo: they show common ground from 700 m."""
    frames = [
        frame(20 * k + i, lat_deg=48.0 + k * 600 / 111_200, lon_deg=11.0 + i * 300 / 74_500)
        for k in range(10)
        for i in range(20)
    ]
    (unit,) = split_units({"a": frames})
    assert len(unit) == 200


def test_two_places_visited_in_turn_are_two_units():
    """Two drones of one model in one folder, photos sorted by time."""
    frames = [frame(i, lat_deg=48.0 + 1e-5 * i + 0.02 * (i % 2)) for i in range(300)]
    one, other = split_units({"a": frames})
    assert [len(one), len(other)] == [150, 150]


def test_a_few_photos_with_wrong_positions_stay_with_the_others():
    frames = [frame(i, **({"lat_deg": 48.3} if i in (7, 8, 30) else {})) for i in range(60)]
    (unit,) = split_units({"a": frames})
    assert len(unit) == 60


places = st.lists(
    st.tuples(st.floats(-89, 89), st.floats(-180, 180), st.integers(1, 5), st.floats(0, 300)), min_size=1, max_size=6
)


@given(places, st.floats(50, 2000))
def test_places_of_different_groups_are_far_apart_and_those_of_one_are_linked(rows, gap):
    lat = np.concatenate([a + np.arange(n) * step / 111_200 for a, _, n, step in rows])
    lon = np.concatenate([np.full(n, b) for _, b, n, _ in rows])
    group = separate_places(lat, lon, gap)
    away = np.array([[distance_m(a, b, c, d) for c, d in zip(lat, lon)] for a, b in zip(lat, lon)])
    linked = connected_components(away < gap)[1]
    clear = np.abs(away - gap).min() > 0.01 * gap  # chords are a little shorter than arcs
    if clear:
        assert (group[:, None] == group).tolist() == (linked[:, None] == linked).tolist()
    assert group[0] == 0 and set(group) == set(range(group.max() + 1))


def solution(vehicle, first, count):
    camera = Camera(np.zeros(3), rotation_from_angles(0.0, -np.pi / 2, 0.0), Lens(640, 480, 320.0))
    placed = [PlacedFrame(frame(first + i, vehicle), camera, "fine", 0.1) for i in range(count)]
    return Solution(
        vehicle=vehicle,
        placed=placed,
        dropped={},
        legs=[Leg(vehicle=vehicle, first=0, last=count - 1, images=("0", str(count - 1)), state="matched")],
        fov_deg=80.0 + first,
        fov_sigma_deg=0.1,
        terrain=None,
        state=first,
    )


def test_units_of_a_vehicle_are_joined_with_their_legs_in_place():
    joined = merge_units([solution("a", 0, 5), solution("b", 0, 2), solution("a", 10, 7)])
    assert [s.vehicle for s in joined] == ["a", "b"]
    a = joined[0]
    assert [p.frame.image for p in a.placed] == [f"a/{i:04d}.jpg" for i in [*range(5), *range(10, 17)]]
    assert [(leg.first, leg.last) for leg in a.legs] == [(0, 4), (5, 11)]
    assert a.fov_deg == 90.0
    assert a.state == [0, 10]


def test_records_fill_what_is_missing_and_mark_it():
    frames = [frame(i, height_m=None, yaw_rad=None, pitch_rad=None) for i in range(5)]
    records = read_records(frames, LocalGrid(32632), np.zeros(2))
    assert not records.has_height.any() and not records.has_yaw.any() and not records.has_tilt.any()
    np.testing.assert_allclose(records.position[:, 2], DEFAULT_HEIGHT_M)
    np.testing.assert_allclose(records.pitch, -np.pi / 2)
    grid_north = -LocalGrid(32632).convergence_rad(48.0, 11.0)
    np.testing.assert_allclose(records.yaw, grid_north, atol=0.01)


def test_photos_at_the_ends_of_legs_without_headings_point_along_their_leg():
    """Not half across to the next leg: a photo assumed to be turned is not found in its neighbours."""
    path = boustrophedon(legs=4, count=10, step=15.0, apart=30.0)
    lat, lon = 48.0 + path[:, 1] / 111_200, 11.0 + path[:, 0] / 74_500
    frames = [frame(i, lat_deg=a, lon_deg=b, yaw_rad=None) for i, (a, b) in enumerate(zip(lat, lon))]
    yaw = read_records(frames, LocalGrid(32632), np.zeros(2)).yaw
    along = np.repeat([0.0, np.pi, 0.0, np.pi], 10)
    assert np.degrees(np.abs(wrap_rad(yaw - along))).max() < 5.0


def test_clocks_that_go_backwards_are_replaced_by_picture_numbers():
    frames = [frame(i) for i in range(4)]
    frames[2] = frame(0)
    records = read_records(frames, LocalGrid(32632), np.zeros(2))
    assert not records.timed
    np.testing.assert_array_equal(records.time_s, np.arange(4.0))


def test_steps_ignore_a_single_outlier():
    frames = [frame(i) for i in range(12)]
    frames[6] = frame(6, lat_deg=48.0 + 1e-4 * 6 + 2e-4)
    steps = read_records(frames, LocalGrid(32632), np.zeros(2)).steps()
    assert np.hypot(*steps[3:10, :2].T) == pytest.approx(11.12, abs=0.1)


def test_the_step_over_missing_pictures_is_the_whole_way():
    """Pictures that a busy camera skipped: the way past them is not the usual step of its neighbours."""
    frames = [frame(i) for i in (*range(8), *range(13, 21))]
    steps = np.hypot(*read_records(frames, LocalGrid(32632), np.zeros(2)).steps()[1:, :2].T)
    assert steps[7] == pytest.approx(6 * 11.12, rel=0.01)
    assert np.delete(steps, 7) == pytest.approx(11.12, abs=0.1)


def weak_at(position, recorded, leg, weak):
    """What placing weak pictures makes of solved positions, where nothing looked at the weak ones."""
    n = len(position)
    strong = np.setdiff1d(np.arange(n), weak)
    flight = SimpleNamespace(
        frames=range(n),
        leg=np.asarray(leg),
        records=SimpleNamespace(time_s=np.arange(n, dtype=float)),
        adjustment=SimpleNamespace(
            cameras=SimpleNamespace(position=position.copy(), rotation=np.tile(np.eye(3), (n, 1, 1))),
            priors=SimpleNamespace(position=recorded, rotation=np.tile(np.eye(3), (n, 1, 1))),
            obs_weight=np.ones(len(strong) * 20),
            tracks=SimpleNamespace(camera=np.repeat(strong, 20)),
        ),
    )
    sigma = np.full(n, 0.1)
    assert np.flatnonzero(interpolate_weak(flight, sigma)).tolist() == list(weak)
    return flight.adjustment.cameras.position, sigma


def test_a_weak_picture_at_a_corner_follows_the_record_and_not_the_line_across_it():
    way = np.c_[boustrophedon(2, 5), np.full(10, 100.0)]
    placed, sigma = weak_at(way, way + np.array([3.0, -2.0, 0.0]), [0] * 5 + [1] * 5, [5])
    np.testing.assert_allclose(placed[5], way[5], atol=1e-9)
    assert sigma[5] < 2.0


def test_a_weak_picture_with_an_outlier_of_a_record_stays_on_its_leg_and_says_how_far_that_is_from_it():
    way = np.c_[np.zeros(9), 10.0 * np.arange(9), np.full(9, 100.0)]
    recorded = way.copy()
    recorded[4, 0] += 18.0
    recorded[4, 2] = 5.0
    placed, sigma = weak_at(way, recorded, [0] * 9, [4])
    np.testing.assert_allclose(placed[4], [0.0, 40.0, 5.0], atol=1e-9)
    assert sigma[4] == pytest.approx(9.0)


def test_an_outlier_within_a_long_gap_is_not_followed():
    """The line across the gap is off by as much (drift): only the records around it tell that one of them has leapt."""
    rng = np.random.default_rng(4)
    way = np.c_[6.0 * np.sin(np.arange(30) / 7), 10.0 * np.arange(30), np.full(30, 100.0)]
    recorded = way + np.c_[rng.normal(0, 0.4, (30, 2)), np.zeros(30)]
    recorded[15, :2] += [9.0, -7.0]
    placed, sigma = weak_at(way, recorded, [0] * 30, list(range(6, 24)))
    assert np.hypot(*(placed - way)[6:24, :2].T).max() < 2.0
    assert 3.0 < sigma[15] < 7.0 and np.delete(sigma, 15)[6:24].max() < 2.0
