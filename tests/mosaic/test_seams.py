"""Seam lines by cost: what they spare, which picture wins, and that nothing else of the mosaic changes."""

import numpy as np
import pytest

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.export.footprint_layer import write_seamlines
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.renderer import Seams, render, serial
from orthoswarm.mosaic.seams.previews import PreviewFile
from tests.kit import mosaic_scene as scene

TIME = "2026-05-28T20:26:40.125Z"
FLAT = Terrain.flat(0.0)


def drawn(folder, flight, *, blend="none", seams=True, run=serial, size_m=260.0, tile_px=128, ground=FLAT):
    """The mosaic of a flight: colours, labels and what was rendered."""
    folder.mkdir()
    previews = PreviewFile.create(folder / "previews", [f.frame.image for f in flight.frames])
    how = Seams(previews, blend) if seams else None
    with Canvas.create(folder / "canvas", scene.grid(size_m), plane="frame", tile_px=tile_px) as canvas:
        stats = render(flight.frames, ground, canvas, seams=how, read=flight.read, run=run)
        grid = canvas.grid
        window = (0, grid.height, 0, grid.width)
        return canvas.read(*window), canvas.read_plane(*window), stats


def side_by_side(apart_m=40.0):
    """Two pictures of the same ground; the seam by the nearest nadir point is the line between them."""
    flight = scene.Flight()
    return flight.take(scene.camera(east=-apart_m / 2)).take(scene.camera(east=apart_m / 2))


def car_in(flight, frame, east, north, *, half_m=6.0, level=255):
    """A square thing on the ground that only one picture shows; where it is in the mosaic."""
    camera, name = flight.cameras[frame], flight.frames[frame].frame.image
    picture = flight.pictures[name].copy()
    pixels = np.stack(np.meshgrid(np.arange(camera.lens.width), np.arange(camera.lens.height)), -1).astype(float)
    off = np.abs(camera.to_ground(pixels) - (scene.EAST + east, scene.NORTH + north)).max(-1)
    picture[off < half_m] = level
    flight.pictures[name] = picture
    return np.abs(scene.pixel_centres(scene.grid(260.0)) - (scene.EAST + east, scene.NORTH + north)).max(-1) < half_m


def test_a_thing_that_only_one_picture_shows_is_not_cut_in_half(tmp_path):
    flight = side_by_side(30.0)
    inside = car_in(flight, 0, 0.5, 5.0, half_m=3.0, level=20)
    cut = drawn(tmp_path / "nearest", flight, seams=False)[1][inside]
    assert 0.2 < (cut == 1).mean() < 0.8  # the nearest nadir point cuts it
    labels = drawn(tmp_path / "cost", flight)[1][inside]
    assert max((labels == 1).mean(), (labels == 2).mean()) > 0.98


def test_in_haze_the_clearest_picture_wins(tmp_path):
    flight = scene.Flight().take(scene.camera(east=0.0)).take(scene.camera(east=18.0))
    hazy = flight.frames[0].frame.image
    flight.pictures[hazy] = np.rint(150.0 + 0.3 * (flight.pictures[hazy].astype(float) - 128.0)).astype(np.uint8)
    nearest = drawn(tmp_path / "nearest", flight, seams=False)[1]
    # contrasts are compared at nodes some 60 m apart here: beside the clear picture's border there is none to compare
    both = np.logical_and(*(scene.seen(c, scene.grid(260.0), margin=20.0)[0] for c in flight.cameras))
    assert (nearest[both] == 1).mean() > 0.4
    assert (drawn(tmp_path / "cost", flight)[1][both] == 2).mean() > 0.95


def test_ground_behind_a_tall_thing_is_drawn_from_a_picture_that_sees_it(tmp_path):
    flight = scene.Flight().take(scene.camera(east=-10.0)).take(scene.camera(east=50.0))
    nodes = np.arange(-140.0, 141.0, 1.0)
    tower = np.where((nodes >= 2.0) & (nodes <= 8.0), 25.0, 0.0).astype(np.float32)
    tower = np.where(np.abs(nodes)[:, None] < 40.0, tower, np.float32(0.0))
    ground = Terrain(scene.EAST - 140.0, scene.NORTH - 140.0, 1.0, tower, bare=np.zeros_like(tower))
    east, north = np.moveaxis(scene.pixel_centres(scene.grid(260.0)) - (scene.EAST, scene.NORTH), -1, 0)
    behind = (east > 9.5) & (east < 11.5) & (np.abs(north) < 20.0)
    assert (drawn(tmp_path / "level", flight)[1][behind] == 1).all()  # it is nearer to the first
    assert (drawn(tmp_path / "tower", flight, ground=ground)[1][behind] == 2).mean() > 0.9


def test_alike_pictures_are_parted_near_the_line_of_equal_distance(tmp_path):
    labels = drawn(tmp_path / "cost", side_by_side())[1]
    east = scene.pixel_centres(scene.grid(260.0))[..., 0] - scene.EAST
    both = np.logical_and(*(scene.seen(c, scene.grid(260.0), margin=4.0)[0] for c in side_by_side().cameras))
    assert (labels[both & (east < -6.0)] == 1).all()
    assert (labels[both & (east > 6.0)] == 2).all()


@pytest.mark.parametrize("seed", [0, 3])
def test_as_much_is_covered_and_each_pixel_is_seen_by_its_picture(tmp_path, seed):
    flight = scene.survey(seed, tilt_deg=8.0)
    image, labels, stats = drawn(tmp_path / "cost", flight)
    plain = drawn(tmp_path / "nearest", flight, seams=False)
    assert ((labels > 0) == (plain[1] > 0)).all()
    assert stats.pixels.sum() == (labels > 0).sum()
    for k, camera in enumerate(flight.cameras):
        assert scene.seen(camera, scene.grid(260.0), margin=-0.5)[0][labels == k + 1].all()
    truth = scene.colour(scene.pixel_centres(scene.grid(260.0)))
    error = np.abs(image[..., :3] - truth)[labels > 0]
    assert np.median(error) < 0.8 and np.percentile(error, 99) < 4.0


def test_blending_changes_pixels_at_seams_only(tmp_path):
    import cv2

    flight = scene.survey(1)
    for i, frame in enumerate(flight.frames):
        scale = 1.0 + 0.1 * (i % 2)
        flight.pictures[frame.frame.image] = np.clip(flight.pictures[frame.frame.image] * scale, 0, 255).astype(
            np.uint8
        )
    sharp, labels, _ = drawn(tmp_path / "none", flight)
    mixed, same, _ = drawn(tmp_path / "seam", flight, blend="seam")
    assert (labels == same).all()
    edge = np.zeros(labels.shape, np.uint8)
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edge[1:] |= labels[1:] != labels[:-1]
    near = cv2.dilate(edge, np.ones((9, 9), np.uint8)) > 0
    changed = (sharp != mixed).any(-1)
    assert not changed[~near].any()
    assert changed.sum() > 500

    def step(image):
        level = image[..., 1].astype(float)
        across = (labels[:, 1:] != labels[:, :-1]) & (labels[:, 1:] > 0) & (labels[:, :-1] > 0)
        return np.abs(np.diff(level, axis=1))[across].mean()

    assert step(mixed) < 0.75 * step(sharp)  # the ground itself has steps of 5 levels


def test_the_order_of_the_work_changes_nothing(tmp_path):
    flight = scene.survey(2)
    forward = drawn(tmp_path / "a", flight, blend="seam", tile_px=64)
    backward = drawn(tmp_path / "b", flight, blend="seam", tile_px=64, run=lambda f, xs: map(f, reversed(list(xs))))
    assert (forward[0] == backward[0]).all() and (forward[1] == backward[1]).all()


def test_an_unreadable_picture_is_replaced_by_its_neighbours(tmp_path):
    from orthoswarm.raster.picture_file import PictureError

    flight = scene.survey(1)
    broken = flight.frames[4].frame.image

    def read(path, longest):
        if path.name == broken:
            raise PictureError(f"{path.name} is a damaged JPEG")
        return flight.pictures[path.name]

    previews = PreviewFile.create(tmp_path / "previews", [f.frame.image for f in flight.frames])
    with Canvas.create(tmp_path / "canvas", scene.grid(260.0), plane="frame", tile_px=128) as canvas:
        stats = render(flight.frames, FLAT, canvas, seams=Seams(previews), read=read)
        labels = canvas.read_plane(0, canvas.grid.height, 0, canvas.grid.width)
        alpha = canvas.read(0, canvas.grid.height, 0, canvas.grid.width)[..., 3]
    assert list(stats.rejected) == [broken]
    assert not (labels == 5).any()
    assert ((alpha == 255) == (labels > 0)).all()


def test_seamlines_say_which_picture_shows_which_ground(tmp_path):
    import pyogrio
    import shapely

    flight = scene.survey(0)
    previews = PreviewFile.create(tmp_path / "previews", [f.frame.image for f in flight.frames])
    with Canvas.create(tmp_path / "canvas", scene.grid(260.0), plane="frame", tile_px=64) as canvas:
        stats = render(flight.frames, FLAT, canvas, seams=Seams(previews), read=flight.read)
        labels = canvas.read_plane(0, canvas.grid.height, 0, canvas.grid.width)
        described = [
            lambda f=f: {"image": f.frame.image, "vehicle": f.frame.vehicle, "time": TIME, "stage": "fine"}
            for f in flight.frames
        ]
        write_seamlines(tmp_path / "seamlines.gpkg", canvas, described)
        centres = scene.pixel_centres(canvas.grid)
    meta, _, shapes, fields = pyogrio.raw.read(tmp_path / "seamlines.gpkg", layer="seamlines")
    assert list(meta["fields"]) == ["image", "vehicle", "time", "stage", "sigma_m", "area_m2"]
    assert meta["dtypes"][2] == "datetime64[ms]" and set(fields[2]) == {np.datetime64(TIME.removesuffix("Z"))}
    images = [f.frame.image for f in flight.frames]
    polygons = shapely.from_wkb(shapes)
    assert {images.index(name) for name in fields[0]} == set(np.nonzero(stats.pixels)[0])
    found = np.zeros(labels.shape, np.int32)
    for name, polygon, area in zip(fields[0], polygons, fields[5]):
        found[shapely.contains_xy(polygon, centres[..., 0], centres[..., 1])] = images.index(name) + 1
        assert area == pytest.approx(shapely.area(polygon))
    at_border = np.zeros(labels.shape, bool)  # within 2 pixels of another picture's, which outlines may be off
    for rows, cols in np.ndindex(5, 5):
        at_border |= np.roll(labels, (rows - 2, cols - 2), (0, 1)) != labels
    assert at_border.mean() < 0.2
    assert (found == labels)[~at_border].all()
