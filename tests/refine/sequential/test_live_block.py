"""Pictures placed one by one: near their true places, whatever their records say; a vehicle that is lost says so."""

from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.model.geo import LocalGrid
from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.picture_file import read_gray
from orthoswarm.refine.registration.block_state import WorkArea
from orthoswarm.refine.sequential.live_block import LiveBlock, spread_points
from orthoswarm.refine.strategy.vehicle_passes import RefinerOptions, refine_alone
from tests.kit.made_up_ground import made_up_flight, made_up_ground, write_map

EPSG, ORIGIN, FIRST = 32631, np.array([500_000.0, 5_000_000.0]), 20
GRID = LocalGrid(EPSG)


def moved(frame, east_m, north_m):
    place = GRID.to_grid(frame.fix.lat_deg, frame.fix.lon_deg) + np.array([east_m, north_m])
    lat, lon = (float(v) for v in GRID.to_geographic(place))
    return replace(frame, fix=replace(frame.fix, lat_deg=lat, lon_deg=lon))


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """True frames of a made-up flight, the frames as recorded, and the block after the first of them."""
    folder = tmp_path_factory.mktemp("live")
    ground = made_up_ground()
    write_map(ground, folder / "map.tif")
    true = made_up_flight(ground, folder, "v1")
    noise = np.random.default_rng(3).uniform(-1.0, 1.0, (len(true), 2))
    recorded = [moved(frame, 2.0 + e, n - 2.2) for frame, (e, n) in zip(true, noise, strict=True)]
    basemap = Basemap.open(folder / "map.tif", EPSG)
    state = refine_alone(recorded[:FIRST], area=WorkArea(EPSG, ORIGIN, basemap), options=RefinerOptions())
    assert state.on_map
    return true, recorded, lambda: LiveBlock(state, GRID, ORIGIN, basemap)


def away_m(pose, true):
    place = np.asarray(GRID.to_grid(true.fix.lat_deg, true.fix.lon_deg))
    middle = np.array(pose.camera.lens.principal_point)
    return float(np.hypot(*(pose.camera.to_ground(middle, pose.ground_z_m) - place)))


def test_each_picture_lies_within_decimetres_as_it_comes(flown):
    true, recorded, begin = flown
    block = begin()
    poses = [block.add(frame, read_gray(frame.path)) for frame in recorded[FIRST:]]
    off = [away_m(pose, frame) for pose, frame in zip(poses, true[FIRST:], strict=True)]
    assert np.median(off) < 0.3  # the map's pixel is 1 m, the records are 3 m off
    assert max(off) < 0.6
    assert all(0.05 < pose.sigma_m < 1.0 for pose in poses)
    assert {pose.camera.lens.width for pose in poses} == {true[0].width}


def test_a_record_that_leaps_misleads_no_picture(flown):
    true, recorded, begin = flown
    block = begin()
    for k in range(FIRST, FIRST + 6):
        frame = moved(recorded[k], 15.0, -9.0) if k == FIRST + 3 else recorded[k]
        assert away_m(block.add(frame, read_gray(frame.path)), true[k]) < 0.7


def test_a_picture_that_is_not_followed_lies_where_its_corrected_record_says(flown):
    true, recorded, begin = flown
    block = begin()
    pose = block.near(recorded[FIRST])
    assert away_m(pose, true[FIRST]) < 2.0 < pose.sigma_m + 1.0
    assert block.newest is recorded[FIRST - 1]


def test_a_vehicle_whose_pictures_show_nothing_is_lost(flown):
    _, recorded, begin = flown
    block = begin()
    blank = np.full((recorded[0].height, recorded[0].width), 90, np.uint8)
    assert block.add(recorded[FIRST], blank) is None


def test_points_are_chosen_far_from_each_other():
    xy = np.array([[0.0, 0.0], [0.1, 0.0], [10.0, 0.0], [10.0, 0.1], [0.0, 10.0], [10.0, 10.0], [9.9, 9.9]])
    chosen = xy[spread_points(xy, 4)]
    apart = np.hypot(*(chosen[:, None] - chosen[None]).transpose(2, 0, 1))
    assert apart[np.triu_indices(4, 1)].min() > 9.0
    assert len(spread_points(xy, 20)) == len(xy)
