"""The paper's refiner: lines, scale, field of view, patches, cameras; end to end on a made-up flight."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthoswarm.matchers.matcher import Matches
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.geo import GroundGrid, local_origin
from orthoswarm.paper import PaperOptions, PaperRefiner, coarse_cameras, leg_patches
from orthoswarm.paper.coarse_cameras import find_legs, fit_line
from orthoswarm.paper.ground_scale import choose_pairs, field_of_view, gaussian, metres_per_pixel, orthogonal_centre
from orthoswarm.paper.leg_patches import HeightFilter
from orthoswarm.paper.paper_refiner import carried_shift, fit_camera, pixel_grid
from orthoswarm.raster.basemap import Basemap
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, CameraBlock, F
from orthoswarm.refine.bundle.flight_records import FlightRecords
from telemetry import load
from tests.kit.scene import FOV, Scene, legs

OPTIONS = PaperOptions(picture_matcher="sift", map_matcher="cfog")
BIAS = (6.0, -4.0)


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    """Fewer pairs and a shorter search than usual: the scenes are small."""
    monkeypatch.setattr(coarse_cameras, "_SCALE_PAIRS", 9)
    monkeypatch.setattr(leg_patches, "_PATCH_SEARCH_M", (25.0, 25.0))


# -- III.C --------------------------------------------------------------------------------------------------------


@given(st.floats(0, 2 * np.pi), st.floats(-500, 500), st.integers(0, 1000))
def test_a_line_is_found_whatever_its_heading(azimuth, offset, seed):
    rng = np.random.default_rng(seed)
    direction = np.array([np.sin(azimuth), np.cos(azimuth)])
    normal = np.array([direction[1], -direction[0]])
    along = np.linspace(0, 300, 20)
    noise = rng.normal(0, 0.5, 20)
    line = fit_line(offset * normal + along[:, None] * direction + noise[:, None] * normal)
    assert line.direction @ direction > 0.9999
    assert line.sigma_m == pytest.approx(0.5, abs=0.35)
    foot = line.project(np.array([[10.0, 20.0]]))
    assert (np.array([10.0, 20.0]) - foot[0]) @ line.direction == pytest.approx(0, abs=1e-6)
    assert line.project(foot) == pytest.approx(foot, abs=1e-6)


def test_a_leg_due_north_is_a_line_although_x_is_constant():
    line = fit_line(np.column_stack([np.full(9, 7.0), np.linspace(0, 80, 9)]))
    assert line.direction == pytest.approx([0, 1]) and line.sigma_m == pytest.approx(0, abs=1e-9)
    assert line.project(np.array([[9.0, 33.0]])) == pytest.approx(np.array([[7.0, 33.0]]))
    assert line.along(np.array([[7.0, 80.0]]))[0] == pytest.approx(40)


def records_of(xy, yaw):
    n = len(xy)
    flags = np.ones(n, bool)
    position = np.column_stack([xy, np.full(n, 80.0)])
    level = np.full(n, -np.pi / 2)
    return FlightRecords(
        position=position,
        yaw=yaw,
        pitch=level,
        roll=np.zeros(n),
        time_s=np.arange(n) * 2.0,
        has_height=flags,
        has_yaw=flags,
        has_tilt=flags,
        position_sigma=np.full(n, np.nan),
        timed=True,
    )


def test_legs_end_where_the_path_or_the_heading_turns():
    rng = np.random.default_rng(2)
    east = np.column_stack([np.arange(12) * 20.0, np.zeros(12)])
    west = np.column_stack([(11 - np.arange(12)) * 20.0, np.full(12, 60.0)])
    xy = np.concatenate([east, west]) + rng.normal(0, 0.8, (24, 2))
    yaw = np.repeat([np.pi / 2, -np.pi / 2], 12)
    leg = find_legs(records_of(xy, yaw))
    assert set(leg[2:10]) == {0} and set(leg[14:22]) == {1} and leg.max() == 1
    turned = np.full(12, np.pi / 2)
    turned[6:] += np.radians(45)
    leg = find_legs(records_of(east, turned))
    assert set(leg[:6]) == {0} and set(leg[6:]) == {1}


@given(st.integers(0, 500), st.floats(0.05, 0.3))
def test_outliers_do_not_move_a_mean(seed, share):
    rng = np.random.default_rng(seed)
    good = rng.normal(0.25, 0.005, 200)
    bad = rng.uniform(0.3, 2.0, int(200 * share))
    found = gaussian(np.concatenate([good, bad]))
    assert found.mean == pytest.approx(0.25, abs=0.003) and found.inliers < 225


@settings(max_examples=30, deadline=None)
@given(st.floats(50, 105), st.floats(-6, 6), st.floats(40, 150), st.integers(0, 99))
def test_the_field_of_view_comes_out_of_two_frames_and_the_distance_flown(fov_deg, roll_deg, height, seed):
    rng = np.random.default_rng(seed)
    size = (640, 480)
    lens = Lens(*size, focal_px(np.radians(fov_deg), size[0]))
    rotation = rotation_from_angles(0.0, -np.pi / 2, np.radians(roll_deg))
    flown = 0.3 * height
    cameras = [Camera(np.array([0.0, y, height]), rotation, lens) for y in (0.0, flown)]
    ground = np.c_[rng.uniform(-height, height, (1500, 2)), np.zeros(1500)]
    a, b = (c.project(ground) for c in cameras)
    seen = (np.minimum(a, b) >= 0).all(1) & (np.maximum(a, b) <= np.array(size) - 1).all(1)
    wrong = rng.uniform(0, 400, (40, 2))
    matches = Matches(np.r_[a[seen], wrong], np.r_[b[seen], wrong[::-1]], np.ones(seen.sum() + 40))
    centre = orthogonal_centre(rotation, lens.focal_px, size)
    assert centre == pytest.approx(tuple(cameras[0].project(np.array([0.0, 0.0, 0.0]))))
    scale = metres_per_pixel(matches, centre, 120, flown)
    found = field_of_view(scale, size[0], height, np.radians(roll_deg))
    assert np.degrees(found) == pytest.approx(fov_deg, abs=0.6)


def test_equation_4_is_the_opening_of_half_the_width():
    assert field_of_view(0.25, 640, 80.0) == pytest.approx(2 * np.arctan(80.0 / 80.0))
    assert field_of_view(0.25, 640, 80.0, np.radians(10)) > field_of_view(0.25, 640, 80.0)


def test_no_scale_without_matches_that_agree():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 400, (200, 2)), rng.uniform(0, 400, (200, 2))
    assert metres_per_pixel(Matches(a, b, np.ones(200)), (200, 200), 150, 20.0) is None
    assert metres_per_pixel(Matches.none(), (200, 200), 150, 20.0) is None


def test_pairs_have_the_wanted_distance():
    along, height = np.arange(30) * 10.0, np.full(30, 100.0)
    tasks = choose_pairs(along, height, np.zeros(30), np.arange(30) + 7, 6)
    assert 4 <= len(tasks) <= 6
    assert all(10 <= t.flown_m <= 40 and t.second > t.first >= 7 for t in tasks)


# -- III.D --------------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.05, 0.05), st.floats(0.95, 1.05), st.floats(-20, 20), st.floats(-3, 3))
def test_a_camera_follows_shift_turn_and_scale_of_its_ground(turn, scale, shift, tilt_deg):
    lens = Lens(640, 480, 400.0)
    rotation = rotation_from_angles(1.0, -np.pi / 2 + np.radians(tilt_deg), np.radians(-tilt_deg))
    camera = Camera(np.array([100.0, 50.0, 80.0]), rotation, lens)
    pixels = pixel_grid(camera)
    ground = camera.to_ground(pixels)
    matrix = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    corrected = (ground - camera.nadir) @ matrix.T + camera.nadir + shift
    moved, rms_m = fit_camera(camera, corrected, pixels)
    assert rms_m < 0.01
    assert moved.to_ground(pixels) == pytest.approx(corrected, abs=0.02)
    assert moved.position[2] == pytest.approx(80 * scale, rel=0.01)


def test_legs_that_were_not_found_lie_between_those_that_were():
    shift = carried_shift(np.arange(10.0), [(8.0, np.array([2.0, 4.0])), (2.0, np.array([0.0, 0.0]))])
    assert shift[5] == pytest.approx([1, 2]) and shift[0] == pytest.approx([0, 0]) and shift[9] == pytest.approx([2, 4])


def test_matches_on_towers_are_rejected():
    rng = np.random.default_rng(4)
    lens = np.zeros((1, 8))
    lens[0, F], lens[0, WIDTH], lens[0, HEIGHT] = 400, 640, 480
    position = np.column_stack([np.arange(5) * 30.0, np.zeros(5), np.full(5, 80.0)])
    cameras = CameraBlock(
        position, np.repeat(rotation_from_angles(0.0, -np.pi / 2, 0.0)[None], 5, 0), np.zeros(5, np.int32), lens
    )
    grid = GroundGrid(epsg=32632, west=-50.0, north=60.0, gsd_m=0.5, width=440, height=240)
    ground = np.column_stack([rng.uniform(-40, 160, 300), rng.uniform(-55, 55, 300)])
    tower = np.arange(300) < 40
    nearest = position[np.argmin(np.abs(ground[:, :1] - position[:, 0]), axis=1), :2]
    lean = np.where(tower, 15.0, 0.0)[:, None] / 80.0 * (ground - nearest)
    a = grid.to_pixel(ground + lean)
    kept = HeightFilter(cameras, grid, grid)(Matches(a, grid.to_pixel(ground), np.ones(300)), np.eye(3))
    far = np.hypot(*(ground - nearest).T) > 15
    assert kept[~tower].all() and not kept[tower & far].any()


# -- the whole ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A scene with a flight whose receiver is off by BIAS, its frames, and its map."""
    folder = tmp_path_factory.mktemp("paper")
    scene = Scene()
    shots = [replace(s, recorded=tuple(np.add(s.recorded, BIAS))) for s in legs(count=3, photos=9)]
    paths = scene.fly(folder / "photos" / "a", shots)
    frames = load([folder / "photos"]).frames
    return scene, {p.name: s for p, s in zip(paths, shots, strict=True)}, frames, scene.basemap(folder / "map.tif")


def refine_batch(grid, frames, basemap, **more):
    return PaperRefiner(grid.epsg, local_origin(grid, frames), OPTIONS).refine_batch({"a": frames}, basemap, **more)


def errors(solution, flight):
    """Distance of each picture's middle from where it is, metres."""
    scene, shots = flight[:2]
    out = []
    for placed in solution.placed:
        truth = scene.camera(shots[placed.frame.image.rsplit("/", 1)[-1]])
        middle = np.array([[160.0, 120.0]])
        out.append(np.hypot(*(placed.camera.to_ground(middle) - truth.to_ground(middle))[0]))
    return np.array(out)


def test_a_flight_comes_onto_the_map(flight):
    scene, _, frames, path = flight
    seen = []
    basemap = Basemap.open(path, scene.grid.epsg)
    refined = refine_batch(scene.grid, frames, basemap, progress=lambda *a: seen.append(a))
    (coarse,), (fine,) = refined.coarse, refined.fine
    assert len(fine.placed) == 27 and all(p.stage == "fine" for p in fine.placed)
    assert sum(leg.state == "matched" for leg in fine.legs) >= 2 and len(fine.legs) == 3
    assert np.median(errors(coarse, flight)) == pytest.approx(np.hypot(*BIAS), abs=1.5)
    assert np.median(errors(fine, flight)) < 1.2 and np.percentile(errors(fine, flight), 95) < 3.0
    assert fine.fov_deg == pytest.approx(FOV, abs=2.5)
    assert ("legs on the map", 3, 3) in seen
    time = refined.equation_5
    assert time["sequential_s"] > 0 and time["predicted_s"] < time["measured_s"]
    sigma = np.array([p.sigma_m for p in fine.placed])
    assert (errors(fine, flight) < 3 * sigma).mean() > 0.9


def test_without_a_map_it_stays_where_the_receiver_says(flight):
    scene, _, frames, _ = flight
    (fine,) = refine_batch(scene.grid, frames, None).fine
    assert {p.stage for p in fine.placed} == {"coarse"}
    assert {leg.state for leg in fine.legs} == {"failed"}


class NoMap:
    """A map that knows nothing."""

    native_gsd_m = 0.5

    def __init__(self, epsg):
        self.epsg = epsg
        self.bounds = BoundingBox(0.0, 0.0, 1.0, 1.0)

    def gray(self, bounds, gsd_m):
        grid = GroundGrid.around(self.epsg, bounds, gsd_m)
        shape = (grid.height, grid.width)
        return np.zeros(shape, np.float32), np.zeros(shape, bool)


@pytest.mark.slow
def test_a_vehicle_that_is_not_found_is_carried_by_its_neighbours(flight):
    scene, _, frames, path = flight
    refiner = PaperRefiner(scene.grid.epsg, local_origin(scene.grid, frames), OPTIONS)
    first = refiner.refine(frames, [], Basemap.open(path, scene.grid.epsg))
    carried = refiner.refine(frames, [first], NoMap(scene.grid.epsg))
    assert {leg.state for leg in carried.legs} == {"carried"}
    assert np.median(errors(carried, flight)) < 2.0
    assert any("neighbours carry it" in w for w in carried.warnings)
    alone = refiner.refine(frames, [], NoMap(scene.grid.epsg))
    assert {leg.state for leg in alone.legs} == {"failed"}
    assert np.median(errors(alone, flight)) > 5.0


def test_a_damaged_picture_is_dropped_with_its_reason(flight, tmp_path):
    scene, _, frames, path = flight
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(frames[4].path.read_bytes()[:900])
    broken = [replace(f, path=bad) if i == 4 else f for i, f in enumerate(frames)]
    (fine,) = refine_batch(scene.grid, broken, Basemap.open(path, scene.grid.epsg)).fine
    assert len(fine.placed) == 26 and "damaged" in fine.dropped[frames[4].image]
