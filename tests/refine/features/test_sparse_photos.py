"""The front end for sparse photos and its adjustment: made-up flights with truth, then real ones."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.model.angles import wrap_rad
from orthoswarm.model.camera import fov_rad
from orthoswarm.model.geo import LocalGrid, area_epsg
from orthoswarm.model.task_runner import serial
from orthoswarm.raster.picture_file import PictureError, read_gray
from orthoswarm.refine.bundle.adjustment import Adjustment
from orthoswarm.refine.bundle.block_arrays import HEIGHT, WIDTH, F
from orthoswarm.refine.flight.record_findings import runs
from orthoswarm.refine.flight.sparse_adjustment import solve_sparse
from orthoswarm.refine.flight.sparse_block import in_reduced_pixels, open_sparse_flight, open_sparse_flights, own_lenses
from orthoswarm.refine.flight.sparse_start import SparseStart, assemble, read_photo_records, sparse_start
from orthoswarm.refine.initial.initial_orientation import find_initial_orientation
from orthoswarm.refine.initial.pair_graph import PairGraphBuilder
from tests.kit.sparse_world import GRID, ORIGIN, World, lawnmower, make_world, texture, without


def begin(world: World, frames=None, **options) -> SparseStart:
    frames = frames or world.frames
    records = read_photo_records(frames, GRID, ORIGIN, **options)
    tried = {(pair.first, pair.second): pair.match for pair in world.pairs}
    read = lambda frame: np.zeros((1, 1), np.uint8)  # noqa: E731
    builder = PairGraphBuilder(
        frames=frames, records=records, read_gray=read, features=list(world.features), tried=tried
    )
    start = find_initial_orientation(records, builder.pairs(), world.features)
    return assemble(builder, records, start)


def crosshatch(**options) -> World:
    one, yaw_one = lawnmower(3, 6, 30.0, 45.0, True)
    two, yaw_two = lawnmower(3, 6, 30.0, 45.0, False)
    return make_world(np.concatenate([one, two]), np.concatenate([yaw_one, yaw_two]), **options)


def fov_deg(adjustment: Adjustment) -> float:
    lens = adjustment.cameras.lens[0]
    return float(np.degrees(fov_rad(float(lens[F]), int(lens[WIDTH]))))


def shape_error(adjustment: Adjustment, world: World) -> float:
    """Scatter of the cameras about the truth after one common shift, metres."""
    off = adjustment.cameras.position - world.cameras.position
    return float(np.median(np.linalg.norm(off - np.median(off, axis=0), axis=1)))


def test_adjustment_finds_cameras_and_lens_without_any_tag():
    world = crosshatch(tilt_deg=12.0, k1=-0.03, gps_sigma=0.8)
    bare = [without(f, "height_m", "yaw_rad", "pitch_rad", "roll_rad") for f in world.frames]
    start = begin(world, bare)
    adjustment = solve_sparse(start)
    assert fov_deg(adjustment) == pytest.approx(80.0, abs=1.0)
    assert adjustment.cameras.lens[0, 1] == pytest.approx(-0.03, abs=0.02)
    assert shape_error(adjustment, world) < 0.5
    tilt = np.degrees(np.arccos(-adjustment.cameras.rotation[:, 2, 2]))
    true = np.degrees(np.arccos(-world.cameras.rotation[:, 2, 2]))
    assert np.abs(tilt - true).max() < 0.5
    residual = np.hypot(*adjustment.residuals().T)
    assert np.nanmedian(residual) < 0.6


def test_straight_down_over_flat_ground_keeps_scale_and_does_not_sink():
    xy, yaw = lawnmower(4, 6, 30.0, 45.0, True)
    world = make_world(xy, yaw, relief=0.2, gps_sigma=0.5)
    adjustment = solve_sparse(begin(world))
    true = world.cameras.lens[0, F] / 60.0
    above = np.median(adjustment.cameras.position[:, 2]) - np.median(adjustment.points[:, 2])
    assert adjustment.cameras.lens[0, F] / above == pytest.approx(true, rel=0.01)
    assert above == pytest.approx(60.0, abs=4.0)


def test_wrong_matches_are_weighted_down():
    world = crosshatch(tilt_deg=5.0)
    rng = np.random.default_rng(1)
    pairs = []
    for pair in world.pairs:
        match = pair.match.copy()
        wrong = rng.uniform(size=len(match)) < 0.08
        match[wrong, 1] = rng.integers(0, len(world.features[pair.second]), int(wrong.sum()))
        pairs.append(replace(pair, match=match))
    clean, spoiled = solve_sparse(begin(world)), solve_sparse(begin(replace(world, pairs=pairs)))
    assert shape_error(spoiled, world) < shape_error(clean, world) + 0.2
    assert fov_deg(spoiled) == pytest.approx(80.0, abs=1.0)


def test_observation_sigmas_end_as_large_as_the_noise():
    world = crosshatch(tilt_deg=5.0, noise_px=0.7)
    adjustment = solve_sparse(begin(world))
    assert np.median(adjustment.tracks.sigma_px) == pytest.approx(0.7, rel=0.2)


def test_reduced_pictures_have_the_same_cameras():
    full = solve_sparse(begin(crosshatch(tilt_deg=8.0)))
    half = in_reduced_pixels(full, 2.0, (400, 300))
    assert half.cameras.lens[0, F] == pytest.approx(full.cameras.lens[0, F] / 2.0, rel=2e-3)
    assert np.abs(half.cameras.position - full.cameras.position).max() < 0.1
    assert half.cameras.lens[0, [WIDTH, HEIGHT]].tolist() == [400, 300]
    ratio = np.nanmedian(np.hypot(*half.residuals().T)) / np.nanmedian(np.hypot(*full.residuals().T))
    assert ratio == pytest.approx(0.5, abs=0.02)


def test_findings_say_what_tags_got_wrong():
    world = crosshatch(tilt_deg=15.0)
    frames = [
        replace(f, fix=replace(f.fix, height_m=800.0, yaw_rad=f.fix.yaw_rad + (np.pi if 6 <= k < 12 else 0.0)))
        for k, f in enumerate(world.frames)
    ]
    start = begin(world, frames)
    text = "\n".join(start.warnings)
    assert "yaw is turned by 180 degrees on 6 photos (p006.jpg to p011.jpg)" in text
    assert "15 degrees off nadir where tags say 0" in text


def test_a_compass_that_reads_too_much_is_said_to():
    world = crosshatch()
    frames = [replace(f, fix=replace(f.fix, yaw_rad=f.fix.yaw_rad + np.radians(12.0))) for f in world.frames]
    assert "recorded headings are +12 degrees off" in "\n".join(begin(world, frames).warnings)


def test_right_tags_cause_no_finding():
    start = begin(crosshatch(gps_sigma=0.3))
    assert start.warnings == []
    assert start.damaged == {}
    assert len(np.unique(start.tracks.camera)) == len(start.cameras)


def test_runs_of_photos_are_named_by_their_ends():
    names = list("abcdefghij")
    assert runs(names, np.array([1, 1, 1, 0, 1, 0, 0, 0, 0, 0], bool)) == "a to c, e"


def two_vehicles():
    """The legs along north and those along east as two vehicles with lenses that differ a little."""
    world = crosshatch(tilt_deg=10.0, gps_sigma=1.0)
    return world, [replace(f, vehicle="a" if k < 18 else "b") for k, f in enumerate(world.frames)]


def test_vehicles_adjusted_together_share_a_lens_first_and_have_their_own_then():
    world, frames = two_vehicles()
    start = begin(world, frames, share_lenses=True)
    assert len(start.cameras.lens) == 1
    assert len(start.plane.tags) == 2
    own = own_lenses(solve_sparse(start), start)
    assert len(own.cameras.lens) == 2
    for lens in own.cameras.lens:
        assert np.degrees(fov_rad(float(lens[F]), 800)) == pytest.approx(80.0, abs=1.0)
    assert shape_error(own, world) < 0.5


def flat_flight(count: int = 5):
    """Pictures cut from one texture as a level camera at 60 m over flat ground would see it, north up."""
    ground = texture(7, 900, 1500)
    xy = np.stack([np.zeros(count), np.arange(count) * 20.0], 1)
    world = make_world(xy, np.zeros(count), size=(480, 360))
    scale = 0.5 * 480 / np.tan(np.radians(40.0)) / 60.0
    pictures = {}
    for k, frame in enumerate(world.frames):
        top = 500 - round(k * 20.0 * scale)
        pictures[frame.image] = ground[top : top + 360, 500:980].copy()
    return world.frames, pictures


def test_pictures_in_memory_go_all_the_way_and_threads_change_nothing():
    frames, pictures = flat_flight()
    records = read_photo_records(frames, GRID, ORIGIN)
    with ThreadPoolExecutor(2) as pool:
        runs_in = (serial, lambda function, items: pool.map(function, items))
        results = [sparse_start(frames, records, lambda f: pictures[f.image], run) for run in runs_in]
    one, two = results
    assert np.array_equal(one.tracks.uv, two.tracks.uv)
    assert np.array_equal(one.cameras.position, two.cameras.position)
    adjustment = solve_sparse(one)
    step = np.diff(adjustment.cameras.position[:, 1])
    assert np.median(step) == pytest.approx(20.0, abs=1.5)
    assert np.abs(wrap_rad(one.plane.yaw)).max() < np.radians(5.0)


def test_vehicles_come_apart_as_they_were_found_together():
    frames, pictures = flat_flight(6)
    frames = [replace(f, vehicle="a" if k % 2 else "b") for k, f in enumerate(frames)]
    units = [[f for f in frames if f.vehicle == v] for v in "ba"]
    flights = open_sparse_flights(units, GRID, ORIGIN, lambda f: pictures[f.image])
    assert [[f.image for f in flight.frames] for flight in flights] == [[f.image for f in unit] for unit in units]
    north = {f.image: p[1] for v in flights for f, p in zip(v.frames, v.adjustment.cameras.position)}
    steps = np.diff([north[f.image] for f in frames])
    assert np.median(steps) == pytest.approx(20.0, abs=1.5)
    assert np.ptp(steps) < 1.0
    for flight in flights:
        assert flight.sparse
        assert len(flight.adjustment.cameras.lens) == 1
        assert np.nanmedian(np.hypot(*flight.adjustment.residuals().T)) < 0.5


def test_damaged_and_mismatched_pictures_are_left_out_with_their_reason():
    frames, pictures = flat_flight()

    def read(frame):
        if frame.image == "p001.jpg":
            raise PictureError("p001.jpg is damaged; copy it again")
        return pictures[frame.image].T.copy() if frame.image == "p003.jpg" else pictures[frame.image]

    start = sparse_start(frames, read_photo_records(frames, GRID, ORIGIN), read)
    assert sorted(start.damaged) == [1, 3]
    assert start.damaged[1] == "p001.jpg is damaged; copy it again"
    assert "not as its header says" in start.damaged[3]
    assert np.unique(start.tracks.camera).tolist() == [0, 2, 4]


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_photos_are_no_error(count):
    frames, pictures = flat_flight()
    start = sparse_start(frames[:count], read_photo_records(frames[:count], GRID, ORIGIN), lambda f: pictures[f.image])
    adjustment = solve_sparse(start)
    assert np.isfinite(adjustment.cameras.position).all()
    assert adjustment.cameras.position[0, 2] == pytest.approx(60.0, abs=3.0)


def test_many_photos_of_one_spot_are_no_error():
    frames, pictures = flat_flight(1)
    many = [replace(frames[0], image=f"s{k}.jpg", time_s=float(k)) for k in range(9)]
    start = sparse_start(many, read_photo_records(many, GRID, ORIGIN), lambda f: pictures["p000.jpg"])
    adjustment = solve_sparse(start)
    assert np.ptp(adjustment.cameras.position, axis=0).max() < 1.0


def real_frames(folder, every: int = 1):
    import telemetry

    return telemetry.load([folder]).frames[::every]


def solved(frames):
    positions = [(f.fix.lat_deg, f.fix.lon_deg) for f in frames]
    grid = LocalGrid(area_epsg(*zip(*positions)))
    origin = np.round(grid.to_grid(*zip(*positions)).mean(0))
    begun = time.process_time()
    start = sparse_start(frames, read_photo_records(frames, grid, origin), lambda f: read_gray(f.path))
    adjustment = solve_sparse(start)
    return start, adjustment, grid, origin, time.process_time() - begun


def bare(frames):
    """Positions and times only."""
    names = ("height_m", "altitude_m", "yaw_rad", "pitch_rad", "roll_rad", "flight_yaw_rad")
    return [replace(without(f, *names), fov_hint_rad=None) for f in frames]


def test_brighton_flips_are_found_and_the_flight_is_ready_for_the_later_steps(real_data):
    frames = real_frames(real_data("brighton_beach_1600"))
    grid = LocalGrid(area_epsg([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames]))
    origin = grid.to_grid([frames[0].fix.lat_deg], [frames[0].fix.lon_deg])[0]
    flight = open_sparse_flight(frames, grid, origin, lambda f: read_gray(f.path))
    adjustment = flight.adjustment
    flipped = np.abs(np.degrees(flight.calibration.yaw_offset)) > 150.0
    assert [f.image for f, flip in zip(frames, flipped) if flip] == [f"DJI_00{k}.JPG" for k in range(24, 30)]
    assert any("DJI_0024.JPG to DJI_0029.JPG" in w for w in flight.warnings)
    assert len(np.unique(adjustment.tracks.camera)) == len(frames)
    assert flight.sparse
    assert flight.leg.tolist() == [0] * 6 + [1] * 6 + [2] * 6
    up = -adjustment.cameras.rotation[:, :2, 1]
    assert np.abs(wrap_rad(np.arctan2(up[:, 0], up[:, 1]) - np.radians(45.0))).max() < np.radians(12.0)
    assert adjustment.cameras.lens[0, WIDTH] == flight.pictures.size[0]
    assert np.nanmedian(np.hypot(*adjustment.residuals().T)) < 0.5


def test_mirafiori_scale_holds_without_lens_tags(real_data):
    frames = [replace(f, fov_hint_rad=None) for f in real_frames(real_data("mirafiori_rtk"))]
    start, adjustment, grid, origin, _ = solved(frames)
    scale = adjustment.cameras.lens[0, F] / np.median(adjustment.cameras.position[:, 2])
    assert scale == pytest.approx(42.12, rel=0.012)
    fixes = grid.to_grid([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames]) - origin
    lag = adjustment.group_values(0)[2]
    off = adjustment.cameras.position[:, :2] - fixes - lag * start.velocity
    assert np.sqrt((off**2).sum(1).mean()) < 0.08
    assert fov_deg(adjustment) == pytest.approx(45.4, abs=2.0)


@pytest.mark.slow
def test_jwcate_is_one_piece_with_its_tilts_and_lag(real_data):
    start, adjustment, *_ = solved(real_frames(real_data("jwcate_1200")))
    assert np.bincount(start.plane.component).tolist() == [36]
    tilt = np.degrees(np.arccos(-adjustment.cameras.rotation[:, 2, 2]))
    medians = [float(np.median(tilt[start.records.segment == s])) for s in range(4)]
    assert medians == pytest.approx([0.8, 4.7, 1.0, 9.0], abs=1.0)
    assert any("lag" in w for w in start.warnings)


def control_point_rms(frames, adjustment, grid, origin, table) -> float:
    index = {f.image: k for k, f in enumerate(frames)}
    rows = [line.split() for line in table.read_text().splitlines()[1:]]
    rows = [r for r in rows if r[5] in index]
    camera = np.array([index[r[5]] for r in rows])
    uv = np.array([[(float(r[3]) + 0.5) * 0.2 - 0.5, (float(r[4]) + 0.5) * 0.2 - 0.5] for r in rows])
    true = np.array([[float(r[0]), float(r[1])] for r in rows])
    level = np.full(len(rows), float(np.median(adjustment.points[:, 2])))
    for _ in range(2):
        xy = adjustment.cameras.to_ground(camera, uv, level)
        near = ((adjustment.points[:, None, :2] - xy[None]) ** 2).sum(-1).argsort(axis=0)[:12]
        level = np.median(adjustment.points[near, 2], axis=0)
    off = xy + origin - true
    return float(np.sqrt(((off - off.mean(0)) ** 2).sum(1).mean()))


def test_every_fourth_sheffield_photo_without_tags_lies_on_the_control_points(real_data):
    folder = real_data("sheffield_cross_800")
    frames = bare(real_frames(folder, 4))
    start, adjustment, grid, origin, _ = solved(frames)
    tilt = np.degrees(np.arccos(-adjustment.cameras.rotation[:, 2, 2]))
    assert np.median(tilt) == pytest.approx(15.3, abs=1.0)
    assert fov_deg(adjustment) == pytest.approx(81.2, abs=1.5)
    assert np.median(adjustment.cameras.position[:, 2]) == pytest.approx(62.5, abs=3.0)
    assert len(np.unique(start.tracks.camera)) == len(frames)
    assert control_point_rms(frames, adjustment, grid, origin, folder / "gcp_file_4000px.txt") < 0.8


@pytest.mark.slow
def test_all_sheffield_photos_lie_on_the_control_points(real_data):
    folder = real_data("sheffield_cross_800")
    frames = real_frames(folder)
    _, adjustment, grid, origin, _ = solved(frames)
    assert control_point_rms(frames, adjustment, grid, origin, folder / "gcp_file_4000px.txt") < 0.6
    assert fov_deg(adjustment) == pytest.approx(81.2, abs=1.0)


@pytest.mark.slow
def test_legs_of_sheffield_as_vehicles_fit_together(real_data):
    from orthoswarm.batch.pipeline import legs_as_vehicles

    folder = real_data("sheffield_cross_800")
    frames = real_frames(folder, 2)
    grid = LocalGrid(area_epsg([f.fix.lat_deg for f in frames], [f.fix.lon_deg for f in frames]))
    origin = np.round(grid.to_grid([frames[0].fix.lat_deg], [frames[0].fix.lon_deg])[0])
    vehicles: dict[str, list] = {}
    for frame in legs_as_vehicles(frames, grid):
        vehicles.setdefault(frame.vehicle, []).append(frame)
    assert len(vehicles) >= 8
    flights = open_sparse_flights(list(vehicles.values()), grid, origin, lambda f: read_gray(f.path))
    rows = [line.split() for line in (folder / "gcp_file_4000px.txt").read_text().splitlines()[1:]]
    off = []
    for flight in flights:
        index = {f.image: k for k, f in enumerate(flight.frames)}
        for r in (r for r in rows if r[5] in index):
            uv = np.array([[(float(r[3]) + 0.5) * 0.2 - 0.5, (float(r[4]) + 0.5) * 0.2 - 0.5]])
            xy = flight.adjustment.cameras.to_ground(np.array([index[r[5]]]), uv, np.zeros(1))
            off.append(xy[0] + origin - np.array([float(r[0]), float(r[1])]))
    spread = np.array(off) - np.mean(off, axis=0)
    assert np.sqrt((spread**2).sum(1).mean()) < 0.8
