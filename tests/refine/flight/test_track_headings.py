"""Headings of pictures without a recorded one, measured by how the pictures turn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.geo import LocalGrid
from orthoswarm.refine.bundle.block_arrays import Tracks
from orthoswarm.refine.bundle.flight_records import read_records
from orthoswarm.refine.flight.relative_block import turns, with_measured_headings
from tests.refine.features.test_block_parts import boustrophedon, frame

LENS = Lens(640, 480, 400.0)


def seen(path, yaw, tilt, seed):
    """Tracks of points on level ground, seen from 100 m with these headings and small tilts."""
    draw = np.random.default_rng(seed)
    west, south = path.min(0) - 60
    east, north = path.max(0) + 60
    ground = np.column_stack([draw.uniform(west, east, 1500), draw.uniform(south, north, 1500), np.zeros(1500)])
    rows = []
    for k, (place, heading) in enumerate(zip(path, yaw)):
        pitch, roll = draw.normal(0.0, tilt, 2)
        camera = Camera(np.array([*place, 100.0]), rotation_from_angles(heading, pitch - np.pi / 2, roll), LENS)
        uv = camera.project(ground) + draw.normal(0.0, 0.3, (len(ground), 2))
        inside = (uv > 0).all(1) & (uv < [LENS.width, LENS.height]).all(1)
        rows += [(k, point, *uv[point]) for point in np.flatnonzero(inside)]
    table = np.array(rows)
    ids = table[:, :2].astype(np.int32)
    return Tracks(ids[:, 0], ids[:, 1], table[:, 2:], np.ones(len(table), np.float32))


def flight(legs, count, turned):
    """A path of parallel legs, and its headings; `turned`: where a picture at a leg's end already points."""
    path = boustrophedon(legs=legs, count=count, step=15.0, apart=30.0)
    yaw = np.repeat(np.where(np.arange(legs) % 2, np.pi, 0.0), count)
    ends = np.arange(1, legs) * count
    yaw[ends - 1] += wrap_rad(np.pi / 2 - yaw[ends - 1]) * turned
    yaw[ends] += wrap_rad(np.pi / 2 - yaw[ends]) * (1.0 - turned)
    return path, yaw


@settings(max_examples=15)
@given(st.floats(0.0, 1.0), st.integers(5, 9), st.integers(0, 100))
def test_wherever_an_aircraft_turns_its_pictures_headings_are_found(turned, count, seed):
    path, yaw = flight(4, count, turned)
    frames = [
        frame(i, lat_deg=48.0 + north / 111_200, lon_deg=11.0 + east / 74_500, yaw_rad=None)
        for i, (east, north) in enumerate(path)
    ]
    records = read_records(frames, LocalGrid(32632), np.zeros(2))
    found = with_measured_headings(records, seen(path, yaw, np.radians(1.0), seed))
    assert np.degrees(np.abs(wrap_rad(found.yaw - yaw))).max() < 8.0


def test_turns_are_clockwise_and_unknown_where_nothing_is_shared():
    path = np.column_stack([[0.0, 15.0, 30.0, 900.0, 915.0], np.zeros(5)])
    yaw = np.radians([0.0, 30.0, -20.0, 50.0, 60.0])
    found = np.degrees(turns(seen(path, yaw, 0.0, 1), 5))
    assert found[[1, 2, 4]] == pytest.approx([30.0, -50.0, 10.0], abs=2.0)
    assert np.isnan(found[[0, 3]]).all()


def test_recorded_headings_stay():
    path, yaw = flight(2, 6, 0.0)
    frames = [frame(i, yaw_rad=0.3 if i % 2 else None) for i in range(len(path))]
    records = read_records(frames, LocalGrid(32632), np.zeros(2))
    found = with_measured_headings(records, seen(path, yaw, 0.0, 1))
    assert (found.yaw[1::2] == records.yaw[1::2]).all()
    every = read_records([frame(i) for i in range(len(path))], LocalGrid(32632), np.zeros(2))
    assert with_measured_headings(every, seen(path, yaw, 0.0, 1)) is every
