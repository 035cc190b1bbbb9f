"""The renderer: where pixels come from, how exactly, and what happens when something is wrong."""

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np
import pytest

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.compute.threads import on_threads
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import Lens
from orthoswarm.model.errors import InputError
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic import renderer
from orthoswarm.mosaic.kernels.drawn_heights import heights
from orthoswarm.mosaic.kernels.pixel_sampling import UNIT, cubic_weights
from orthoswarm.mosaic.kernels.render_arrays import LATTICE_PX, crop
from orthoswarm.mosaic.radiometry import uniform
from orthoswarm.mosaic.renderer import render, serial
from orthoswarm.mosaic.visible_ground import coverage
from orthoswarm.raster.picture_file import PictureError
from orthoswarm.raster.picture_parts import PictureParts
from tests.kit import mosaic_scene as scene

FLAT = Terrain.flat(0.0)


@pytest.fixture
def canvas(tmp_path):
    with Canvas.create(tmp_path / "canvas", scene.grid(260.0), plane="frame", tile_px=128) as canvas:
        yield canvas


def whole(canvas):
    return canvas.read(0, canvas.grid.height, 0, canvas.grid.width)


def labels(canvas):
    return canvas.read_plane(0, canvas.grid.height, 0, canvas.grid.width)


@pytest.mark.parametrize(
    ("lens", "height"),
    [
        (scene.small_lens(), scene.level),
        (scene.small_lens(k1=-0.12, k2=0.02), scene.level),
        (scene.small_lens(k1=0.06, k3=0.01, cx=3.0, cy=-2.0), scene.level),
        (scene.small_lens(k1=-0.05), scene.hills),
    ],
    ids=["pinhole", "barrel", "pincushion", "hills"],
)
def test_mosaic_reproduces_the_ground_to_a_fraction_of_a_pixel(canvas, lens, height):
    flight = scene.survey(1, height, lens)
    render(flight.frames, scene.terrain_of(height), canvas, read=flight.read)
    image = whole(canvas)
    drawn = image[..., 3] == 255
    truth = scene.colour(scene.pixel_centres(canvas.grid))
    assert drawn.mean() > 0.5
    error = np.abs(image[..., :3] - truth)[drawn]
    assert np.median(error) < 0.8  # of 255 levels; rounding alone gives 0.5
    assert np.percentile(error, 99) < 4.0
    for channel in range(3):
        assert np.abs(scene.shift_of(image[..., channel].astype(float), truth[..., channel], drawn)).max() < 0.03


def test_flat_rendering_of_hills_is_wrong_so_that_terrain_matters(canvas):
    flight = scene.survey(1, scene.hills)
    render(flight.frames, FLAT, canvas, read=flight.read)
    image = whole(canvas)
    error = np.abs(image[..., :3] - scene.colour(scene.pixel_centres(canvas.grid)))[image[..., 3] == 255]
    assert np.percentile(error, 90) > 10.0


@pytest.mark.parametrize("height", [scene.level, scene.hills])
@pytest.mark.parametrize(("seed", "tilt", "k1"), [(0, 2.0, 0.0), (1, 10.0, -0.1), (2, 10.0, 0.05), (3, 30.0, 0.0)])
def test_each_pixel_comes_from_the_nearest_frame_that_sees_it(tmp_path, seed, tilt, k1, height):
    lens = scene.small_lens(k1=k1)
    flight = scene.survey(seed, height, lens, tilt_deg=tilt, count=7)
    terrain = scene.terrain_of(height)
    grid = scene.grid(300.0, 2.0)
    with Canvas.create(tmp_path / "c", grid, plane="frame", tile_px=64) as canvas:
        render(flight.frames, terrain, canvas, read=flight.read)
        mine = labels(canvas)
        drawn = whole(canvas)[..., 3] == 255
    # the renderer's heights (bicubic, then bilinear in the lattice) differ from the hills by centimetres, which may
    # move a picture's border over a pixel: compare where the borders are not within 0.3 pixels
    d2 = np.full((len(flight.frames), grid.height, grid.width), np.inf)
    sure = np.ones((grid.height, grid.width), bool)
    for k, camera in enumerate(flight.cameras):
        inside, distance = scene.seen(camera, grid, height, 0.0)
        sure &= scene.seen(camera, grid, height, -0.3)[0] == scene.seen(camera, grid, height, 0.3)[0]
        d2[k][inside] = distance[inside]
    ordered = np.nan_to_num(np.sort(d2, 0)[:2], posinf=1e12)
    sure &= ~((ordered[1] - ordered[0] < 1e-2) & (ordered[0] < 1e12))
    truth = np.where(np.isfinite(d2.min(0)), d2.argmin(0) + 1, 0)
    assert sure.mean() > 0.8
    assert (mine == truth)[sure].all()
    assert (drawn == (mine > 0)).all()


def test_what_any_frame_sees_is_covered_without_holes(canvas):
    flight = scene.survey(3, tilt_deg=8.0)
    stats = render(flight.frames, FLAT, canvas, read=flight.read)
    seen = np.any([scene.seen(c, canvas.grid, margin=-0.5)[0] for c in flight.cameras], 0)
    well = np.any([scene.seen(c, canvas.grid, margin=0.01)[0] for c in flight.cameras], 0)
    drawn = whole(canvas)[..., 3] == 255
    assert drawn[well].all()
    assert not drawn[~seen].any()
    assert (drawn & seen).sum() >= 0.97 * seen.sum()
    assert stats.drawn.covered_share == pytest.approx(drawn.sum() / seen.sum(), abs=0.01)
    assert stats.pixels.sum() == drawn.sum()


def test_coverage_is_the_union_of_what_the_cameras_see():
    flight = scene.survey(5, scene.hills, scene.small_lens(k1=-0.08), tilt_deg=15.0)
    grid = scene.grid(400.0, 5.0)
    truth = np.any([scene.seen(c, grid, scene.hills, margin=-0.5)[0] for c in flight.cameras], 0)
    mask = coverage(flight.cameras, grid, scene.terrain_of(scene.hills))
    assert truth.any() and not truth.all()
    assert (mask != truth).mean() < 0.002  # cells that a border crosses at their centre


def test_weak_frames_show_only_where_no_other_sees(canvas):
    flight = scene.Flight().take(scene.camera(east=-40)).take(scene.camera(east=10), weak=True)
    render(flight.frames, FLAT, canvas, read=flight.read)
    mine = labels(canvas)
    first = scene.seen(flight.cameras[0], canvas.grid, margin=0.01)[0]
    second = scene.seen(flight.cameras[1], canvas.grid, margin=0.01)[0]
    assert (mine[first] == 1).all()
    assert (mine[second & ~scene.seen(flight.cameras[0], canvas.grid, margin=-0.01)[0]] == 2).all()


def test_equal_distance_goes_to_the_earlier_frame(canvas):
    flight = scene.Flight()
    for yaw in (0.0, 90.0, 30.0):  # one spot, seen by three; another one beside it
        flight.take(scene.camera(yaw_deg=yaw))
    flight.take(scene.camera(east=8.0))
    render(flight.frames, FLAT, canvas, read=flight.read)
    mine = labels(canvas)
    first = scene.seen(flight.cameras[0], canvas.grid, margin=0.01)[0]
    east = scene.pixel_centres(canvas.grid)[..., 0] - scene.EAST
    assert set(np.unique(mine[first & (east < 4.0)])) == {1}
    assert set(np.unique(mine)) == {0, 1, 2, 3, 4}


def test_lone_small_picture_is_covered_to_its_border(canvas):
    flight = scene.Flight().take(scene.camera(lens=Lens(80, 60, 45.0)))
    assert render(flight.frames, FLAT, canvas, read=flight.read).drawn.covered_share > 0.97


def test_unreadable_picture_is_replaced_by_its_neighbours_and_reported(canvas):
    flight = scene.survey(2)
    bad = flight.frames[4].frame.image

    def read(path, longest):
        if path.name == bad:
            raise PictureError(f"{bad} is a damaged JPEG")
        return flight.read(path)

    stats = render(flight.frames, FLAT, canvas, read=read)
    assert stats.rejected == {bad: f"{bad} is a damaged JPEG"}
    others = [f for f in flight.frames if f.frame.image != bad]
    image, mine = whole(canvas), labels(canvas)
    expected = render(others, FLAT, canvas, read=flight.read)
    assert (image == whole(canvas)).all()
    assert stats.pixels.tolist() == np.insert(expected.pixels, 4, 0).tolist()
    assert not (mine == 5).any()


def test_picture_of_another_size_is_reported_and_not_drawn(canvas):
    flight = scene.survey(2, count=2)
    name = flight.frames[0].frame.image
    flight.pictures[name] = flight.pictures[name][:-10]
    stats = render(flight.frames, FLAT, canvas, read=flight.read)
    assert "160x110" in stats.rejected[name]
    assert stats.pixels[0] == 0 < stats.pixels[1]


def test_absurd_frames_are_left_out_with_a_reason(canvas):
    flight = scene.survey(2, count=2)
    good = flight.pictures.copy()
    flight.take(scene.camera(pitch_deg=30.0))
    flight.take(scene.camera(height=-3.0))
    flight.take(scene.camera(height=5000.0))
    flight.take(scene.camera(height=float("nan")))
    stats = render(flight.frames, FLAT, canvas, read=lambda path, longest: good[path.name])
    reasons = [stats.rejected[f.frame.image] for f in flight.frames[2:]]
    for reason, word in zip(reasons, ["horizon", "not above the ground", "5000 m", "not a number"]):
        assert word in reason


def test_nothing_to_render_gives_an_empty_canvas(canvas):
    stats = render([], FLAT, canvas)
    assert stats.drawn.covered_share == 1.0
    assert canvas.version == 0


def test_gains_multiply_the_colours(canvas):
    flight = scene.survey(1, count=2)
    name = flight.frames[0].frame.image
    render(flight.frames, FLAT, canvas, read=flight.read)
    plain, mine = whole(canvas).astype(float), labels(canvas)
    render(flight.frames, FLAT, canvas, read=flight.read, gains={name: uniform([0.5, 1.0, 1.2])})
    bright = whole(canvas).astype(float)
    assert np.abs(bright - plain * (0.5, 1.0, 1.2, 1.0))[(mine == 1) & (plain[..., 2] < 200)].max() <= 1.0
    assert (bright == plain)[mine == 2].all()


def test_new_rendering_replaces_the_old_one_everywhere(canvas):
    east, west = scene.Flight().take(scene.camera(east=70)), scene.Flight().take(scene.camera(east=-70))
    render(east.frames, FLAT, canvas, read=east.read)
    before = canvas.version
    render(west.frames, FLAT, canvas, read=west.read)
    assert (labels(canvas) == 1)[:, :130].any()
    assert not whole(canvas)[:, 230:].any()
    assert canvas.changed_since(before)


def test_bounds_renew_only_the_tiles_they_touch(canvas):
    flight = scene.survey(4)
    render(flight.frames, FLAT, canvas, read=flight.read)
    before, old = canvas.version, whole(canvas)
    west, _, _, north = canvas.grid.bounds
    dark = {f.frame.image: uniform(np.full(3, 0.5)) for f in flight.frames}
    corner = BoundingBox(west, north - 50, west + 50, north)
    stats = render(flight.frames, FLAT, canvas, read=flight.read, gains=dark, bounds=corner)
    assert canvas.changed_since(before) == [(0, 0)]
    new = whole(canvas)
    assert (new[128:] == old[128:]).all() and (new[:, 128:] == old[:, 128:]).all()
    assert (new[:128, :128] != old[:128, :128]).any()
    assert stats.pixels.sum() == (new[:128, :128, 3] == 255).sum()
    assert 0.95 < stats.drawn.covered_share <= 1.0


def test_threads_give_the_same_picture(tmp_path, monkeypatch):
    flight = scene.survey(12)
    pictures, stats = [], []
    monkeypatch.setattr(renderer, "_PICTURES_PER_TASK", 2)
    for name, run in (("one", serial), ("three", partial(on_threads, count=3))):
        with Canvas.create(tmp_path / name, scene.grid(260.0), plane="frame", tile_px=64) as canvas:
            stats.append(render(flight.frames, FLAT, canvas, read=flight.read, run=run))
            pictures.append(whole(canvas))
    assert (pictures[0] == pictures[1]).all()
    assert pictures[0].any()
    assert stats[0].pixels.tolist() == stats[1].pixels.tolist()
    assert stats[0].thumbnails.keys() == stats[1].thumbnails.keys()


def test_processes_give_the_same_picture(canvas, tmp_path):
    flight = scene.survey(6)
    frames = []
    for frame in flight.frames:
        path = tmp_path / f"{frame.frame.image}.png"
        save(path, flight.pictures[frame.frame.image])
        frames.append(
            type(frame)(type(frame.frame)(**{**fields(frame.frame), "path": path}), frame.camera, "fine", 0.1)
        )
    one = render(frames, FLAT, canvas)
    alone = whole(canvas)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        two = render(frames, FLAT, canvas, run=lambda function, args: pool.map(function, args))
    assert (whole(canvas) == alone).all()
    assert two.pixels.tolist() == one.pixels.tolist()
    assert two.thumbnails.keys() == one.thumbnails.keys()


def test_coarse_map_averages_the_picture_and_does_not_alias(tmp_path):
    flight = scene.Flight().take(scene.camera())
    name = flight.frames[0].frame.image
    board = np.indices((120, 160)).sum(0) % 2 * 255
    flight.pictures[name] = np.repeat(board[..., None], 3, 2).astype(np.uint8)
    with Canvas.create(tmp_path / "c", scene.grid(200.0, 100.0 / 90.0 * 4), plane="frame") as canvas:
        render(flight.frames, FLAT, canvas, read=flight.read)
        image = whole(canvas)
    drawn = image[..., 3] == 255
    assert np.abs(image[drawn][:, :3].astype(float) - 127.5).max() < 6.0


def test_thumbnails_are_the_means_of_the_pictures_parts(canvas):
    flight = scene.Flight().take(scene.camera())
    stats = render(flight.frames, FLAT, canvas, read=flight.read)
    (small,) = stats.thumbnails.values()
    picture = next(iter(flight.pictures.values())).astype(float)
    assert np.abs(small - picture.reshape(12, 10, 16, 10, 3).mean((1, 3))).max() < 3.0


def test_real_time_canvas_is_refused(tmp_path):
    with Canvas.create(tmp_path / "c", scene.grid()) as canvas, pytest.raises(InputError, match="real-time"):
        render([], FLAT, canvas)


def test_large_lens_distortion_that_folds_draws_nothing_twice(canvas):
    flight = scene.Flight().take(scene.camera(lens=Lens(160, 120, 70.0, k1=-0.35)))
    stats = render(flight.frames, FLAT, canvas, read=flight.read)
    image = whole(canvas)
    drawn = image[..., 3] == 255
    error = np.abs(image[..., :3] - scene.colour(scene.pixel_centres(canvas.grid)))[drawn]
    assert stats.pixels[0] > 5000
    assert np.percentile(error, 90) < 4.0  # towards the fold the picture has too few pixels for the ground


def test_heights_pass_through_the_nodes_and_are_smooth_between():
    terrain = scene.terrain_of(scene.hills)
    west, north = scene.EAST - 240.0, scene.NORTH + 240.0
    lattice = heights(terrain, west, north, 2.5, 128)  # nodes every 30 m
    at = 2.5 * LATTICE_PX * np.arange(len(lattice))
    points = np.stack(np.meshgrid(west + at, north - at), -1)
    assert np.abs(lattice - scene.hills(points)).max() < 0.05
    assert np.abs(terrain.height(points) - scene.hills(points)).max() > 0.15  # bilinear would not be as good


@pytest.mark.parametrize("angle_deg", [0.0, 15.0, 45.0])
def test_a_measured_wall_is_a_step_along_a_straight_line_and_its_roof_stays_as_it_is(angle_deg):
    nodes = np.arange(-30.0, 30.1, 1.25)
    along = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    on_roof = np.stack(np.meshgrid(nodes, nodes), -1) @ along > 0.3
    over = np.where(on_roof, 9.0 + 0.2 * np.sin(nodes), 0.0).astype(np.float32)
    bare = np.full(over.shape, 100.0, np.float32)
    lattice = heights(Terrain(-30.0, -30.0, 1.25, bare + over, bare=bare), -25.6, 25.6, 0.4, 128)
    at = 0.4 * LATTICE_PX * np.arange(len(lattice))
    away = np.stack(np.meshgrid(at - 25.6, 25.6 - at), -1) @ along - 0.3
    assert (((lattice < 100.5) | (lattice > 108.5)) & (lattice < 109.5)).all()  # nothing in between, nothing above
    assert (lattice[away > 1.0] > 108.5).all() and (np.abs(lattice[away < -1.0] - 100.0) < 1e-3).all()


def test_a_surface_that_no_picture_told_keeps_its_slopes():
    z = np.where(np.arange(40) > 20, 9.0, 0.0)[:, None].repeat(40, 1).astype(np.float32)
    lattice = heights(Terrain(0.0, 0.0, 1.25, z), 10.0, 40.0, 0.25, 128)
    assert ((lattice > 2.0) & (lattice < 7.0)).any()


def test_cropped_terrain_gives_the_same_heights():
    terrain = scene.terrain_of(scene.hills)
    for east, north in ((0.0, 0.0), (590.0, 590.0), (-700.0, 50.0)):
        west, top = scene.EAST + east, scene.NORTH + north
        bounds = BoundingBox(west, top - 128.0, west + 128.0, top)
        part, full = (heights(t, west, top, 1.0, 128) for t in (crop(terrain, bounds), terrain))
        assert np.abs(part - full).max() < 1e-5


def test_bicubic_weights_sum_to_one_and_interpolate():
    weights = cubic_weights()
    assert (weights.sum(1) == UNIT).all()
    assert weights[0].tolist() == [0, UNIT, 0, 0]
    assert np.abs(weights).sum(1).max() <= 1.3 * UNIT


def save(path, rgb):
    import cv2

    assert cv2.imwrite(str(path), rgb[..., ::-1])


def fields(frame):
    return {name: getattr(frame, name) for name in frame.__slots__}


@pytest.mark.parametrize("gsd_m", [1.0, 2.5], ids=["full size", "reduced"])
def test_pictures_are_drawn_again_from_their_kept_parts_without_being_read(tmp_path, gsd_m):
    flight = scene.survey(1, scene.hills, scene.small_lens(k1=-0.05))
    terrain, grid = scene.terrain_of(scene.hills), scene.grid(260.0, gsd_m)
    parts = PictureParts.create(tmp_path / "parts", len(flight.frames), 2000.0)
    images, read = [], []

    def counted(path, longest):
        read.append(path)
        return flight.read(path)

    for name, store in (("first", parts), ("again", parts), ("whole", None)):
        read.clear()
        with Canvas.create(tmp_path / name, grid, plane="frame", tile_px=128) as canvas:
            render(flight.frames, terrain, canvas, read=counted, parts=store)
            images.append(whole(canvas))
        assert (len(read) == 0) == (name == "again")
    assert images[0][..., 3].any()
    assert np.array_equal(images[0], images[1])
    assert np.array_equal(images[0], images[2])


def test_a_picture_of_which_more_is_wanted_than_was_kept_is_read(tmp_path):
    flight = scene.survey(1)
    few, parts = flight.frames[::2], PictureParts.create(tmp_path / "parts", len(flight.frames), 2000.0)
    images = []
    for name, frames, store in (("all", flight.frames, parts), ("few", few, parts), ("whole", few, None)):
        with Canvas.create(tmp_path / name, scene.grid(260.0), plane="frame", tile_px=128) as canvas:
            render(frames, FLAT, canvas, read=flight.read, parts=store)
            images.append(whole(canvas))
    assert np.array_equal(images[1], images[2])
    assert not np.array_equal(images[0], images[1])


def test_what_one_picture_shows_at_two_places_is_counted(canvas):
    """Behind a wall that no other picture looks past, a picture shows the wall's top once more."""
    flight = scene.survey(1, count=1)
    assert render(flight.frames, FLAT, canvas, read=flight.read).drawn.twice_share == 0.0
    nadir = flight.cameras[0].nadir
    z = np.zeros((300, 300), np.float32)
    z[:, 165:175] = 15.0
    wall = Terrain(nadir[0] - 150.0, nadir[1] - 150.0, 1.0, z, bare=np.zeros_like(z))
    drawn = render(flight.frames, wall, canvas, read=flight.read).drawn
    camera_m = flight.cameras[0].position[2]
    shadow_m = 15.0 * 25.0 / (camera_m - 15.0)  # of ground behind the wall, which ends 25 m from below the camera
    width_m = drawn.area_m2 / (scene.seen(flight.cameras[0], canvas.grid)[0].any(0).sum() * canvas.grid.gsd_m)
    assert drawn.twice_share * drawn.area_m2 / width_m == pytest.approx(shadow_m, rel=0.5)
