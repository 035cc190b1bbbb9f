"""The real-time module (paper III.B): one frame after the other, most orthogonal pixel wins, nothing blended."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.mosaic.footprint import LEAST_DESCENT, default_gsd, footprint, footprint_boxes, rejection, rejections
from orthoswarm.mosaic.kernels.lens_arrays import INNER, OUTER, lens_row
from orthoswarm.mosaic.kernels.realtime_kernel import aim, row_span
from orthoswarm.mosaic.realtime import RealtimeMosaic, ground_to_camera, mosaic
from tests.kit import mosaic_scene as scene


@pytest.fixture
def canvas(tmp_path):
    with Canvas.create(tmp_path / "canvas", scene.grid(260.0), tile_px=128) as canvas:
        yield canvas


def whole(canvas):
    return canvas.read(0, canvas.grid.height, 0, canvas.grid.width)


def scores(canvas):
    return canvas.read_plane(0, canvas.grid.height, 0, canvas.grid.width)


def add_all(canvas, flight, order=None):
    module = RealtimeMosaic(canvas)
    for k in order if order is not None else range(len(flight.frames)):
        frame = flight.frames[k]
        module.add(flight.read(frame.frame.path), frame.camera)


@pytest.mark.parametrize("lens", [scene.small_lens(), scene.small_lens(k1=-0.1, k2=0.01)], ids=["pinhole", "barrel"])
def test_mosaic_reproduces_the_ground_to_a_fraction_of_a_pixel(canvas, lens):
    flight = scene.survey(1, lens=lens)
    add_all(canvas, flight)
    image = whole(canvas)
    drawn = image[..., 3] == 255
    truth = scene.colour(scene.pixel_centres(canvas.grid))
    assert drawn.mean() > 0.5
    assert np.median(np.abs(image[..., :3] - truth)[drawn]) < 2.0  # bilinear flattens the waves a little
    for channel in range(3):
        assert np.abs(scene.shift_of(image[..., channel].astype(float), truth[..., channel], drawn)).max() < 0.03


@pytest.mark.parametrize("gsd_m", [1.3, 2.0])
@pytest.mark.parametrize(("seed", "tilt", "k1"), [(0, 0.0, 0.0), (1, 8.0, -0.1), (2, 30.0, 0.0), (3, 30.0, -0.1)])
def test_each_pixel_has_the_greatest_orthogonality_of_the_frames_that_see_it(tmp_path, seed, tilt, k1, gsd_m):
    flight = scene.survey(seed, lens=scene.small_lens(k1=k1), tilt_deg=tilt, count=6)
    grid = scene.grid(300.0, gsd_m)
    with Canvas.create(tmp_path / "c", grid, tile_px=64) as canvas:
        add_all(canvas, flight)
        mine, drawn = scores(canvas), whole(canvas)[..., 3] == 255
    best = np.zeros((grid.height, grid.width))
    sure = np.ones_like(best, dtype=bool)
    for camera in flight.cameras:
        inside, d2 = scene.seen(camera, grid)
        sure &= scene.seen(camera, grid, margin=-0.02)[0] == scene.seen(camera, grid, margin=0.02)[0]
        best = np.maximum(best, np.where(inside, 1.0 / np.maximum(d2, 1e-6), 0.0))
    assert sure.mean() > 0.95
    assert mine[sure] == pytest.approx(best[sure], rel=1e-3)
    assert (drawn == (mine > 0)).all()


def test_order_of_frames_does_not_matter(canvas, tmp_path):
    flight = scene.survey(3)
    add_all(canvas, flight)
    with Canvas.create(tmp_path / "other", canvas.grid, tile_px=256) as other:
        add_all(other, flight, np.random.default_rng(0).permutation(len(flight.frames)))
        assert (whole(other) == whole(canvas)).mean() > 0.9999  # sums of another tile round another way
        assert np.abs(whole(other).astype(int) - whole(canvas)).max() <= 2


def test_equal_distance_keeps_the_earlier_frame(canvas):
    camera = scene.camera()
    module = RealtimeMosaic(canvas)
    first = module.add(np.full((120, 160, 3), 10, np.uint8), camera)
    version = canvas.version
    second = module.add(np.full((120, 160, 3), 250, np.uint8), camera)
    assert first.won > 10_000 and second.won == 0 and second.tiles == [] and second.reason is None
    assert canvas.version == version
    assert set(np.unique(whole(canvas)[..., :3])) == {0, 10}


def test_added_reports_the_tiles_and_pixels_that_changed(canvas):
    flight = scene.survey(2, count=2)
    module = RealtimeMosaic(canvas)
    before = scores(canvas)
    for frame in flight.frames:
        version = canvas.version
        added = module.add(flight.read(frame.frame.path), frame.camera)
        after = scores(canvas)
        assert sorted(added.tiles) == sorted(canvas.changed_since(version))
        assert added.won == (after != before).sum()
        before = after


def test_batch_gives_the_same_mosaic_as_frame_after_frame(canvas, tmp_path):
    flight = scene.survey(5)
    add_all(canvas, flight)
    with Canvas.create(tmp_path / "batch", canvas.grid, plane="frame", tile_px=128) as batch:
        stats = mosaic(flight.frames, batch, read=flight.read)
        one, many = whole(canvas).astype(int), whole(batch).astype(int)
    both = (one[..., 3] == 255) & (many[..., 3] == 255)
    assert stats.drawn.covered_share > 0.97
    assert both.sum() > 0.97 * (one[..., 3] == 255).sum()
    assert np.percentile(np.abs(one - many)[both], 99) <= 8  # bilinear against bicubic
    assert np.abs((one - many)[both].mean(0)).max() < 0.3


def test_rgba_and_rgb_pictures_draw_the_same(canvas, tmp_path):
    flight = scene.survey(1, count=1)
    picture, camera = next(iter(flight.pictures.values())), flight.cameras[0]
    RealtimeMosaic(canvas).add(picture, camera)
    with Canvas.create(tmp_path / "c", canvas.grid, tile_px=128) as other:
        RealtimeMosaic(other).add(np.dstack([picture, np.full((120, 160), 255, np.uint8)]), camera)
        assert (whole(other) == whole(canvas)).all()


def test_coarse_map_averages_the_picture_and_does_not_alias(tmp_path):
    board = np.repeat((np.indices((120, 160)).sum(0) % 2 * 255)[..., None], 3, 2).astype(np.uint8)
    with Canvas.create(tmp_path / "c", scene.grid(200.0, 100.0 / 90.0 * 4)) as canvas:
        RealtimeMosaic(canvas).add(board, scene.camera())
        image = whole(canvas)
    assert np.abs(image[image[..., 3] == 255][:, :3].astype(float) - 127.5).max() < 6.0


@pytest.mark.parametrize(
    ("pose", "word"),
    [
        ({"pitch_deg": 30.0}, "horizon"),
        ({"height": 0.0}, "not above the ground"),
        ({"height": 5000.0}, "5000 m"),
        ({"height": float("nan")}, "not a number"),
        ({"east": 5000.0}, "outside"),
    ],
)
def test_absurd_frames_are_refused_with_a_reason(canvas, pose, word):
    added = RealtimeMosaic(canvas).add(np.zeros((120, 160, 3), np.uint8), scene.camera(**pose))
    assert added.won == 0 and word in added.reason
    assert canvas.version == 0


def test_oblique_frame_is_drawn_up_to_75_degrees(tmp_path):
    flight = scene.Flight().take(scene.camera(height=20.0, pitch_deg=-20.0, yaw_deg=37.0))
    with Canvas.create(tmp_path / "c", scene.grid(300.0, 0.5), tile_px=64) as canvas:
        add_all(canvas, flight)
        drawn = whole(canvas)[..., 3] == 255
        grid = canvas.grid
    distance = np.hypot(*(scene.pixel_centres(grid)[drawn] - flight.cameras[0].nadir).T)
    limit = 20.0 * np.tan(np.radians(75.0))
    assert 0.98 * limit < distance.max() <= limit
    inside = scene.seen(flight.cameras[0], grid, margin=0.05)[0]
    assert drawn[inside].all() and drawn.sum() <= scene.seen(flight.cameras[0], grid, margin=-0.05)[0].sum()


def test_low_frame_among_high_ones_is_drawn_where_it_is(canvas):
    flight = scene.survey(1).take(scene.camera(height=5.0))
    add_all(canvas, flight)
    image = whole(canvas)
    drawn = image[..., 3] == 255
    assert np.median(np.abs(image[..., :3] - scene.colour(scene.pixel_centres(canvas.grid)))[drawn]) < 2.0


def test_picture_must_have_its_lenses_size(canvas):
    with pytest.raises(ValueError, match=r"\(150, 120\)"):
        RealtimeMosaic(canvas).add(np.zeros((120, 150, 3), np.uint8), scene.camera())


def test_rendered_canvas_is_refused(tmp_path):
    with Canvas.create(tmp_path / "c", scene.grid(), plane="frame") as canvas, pytest.raises(InputError):
        RealtimeMosaic(canvas)


poses = st.builds(
    scene.camera,
    east=st.floats(-500, 500), north=st.floats(-500, 500), height=st.floats(5, 300), yaw_deg=st.floats(0, 360),
    pitch_deg=st.floats(-130, -10), roll_deg=st.floats(-40, 40),
)  # fmt: skip


@given(camera=poses, column=st.floats(-300, 300), row=st.floats(-300, 300))
def test_matrix_is_the_inverse_of_the_papers_homography(camera, column, row):
    ground = camera.nadir + np.array([0.5 * column, -0.5 * row])
    x, y, depth = ground_to_camera(camera, 0.0, 0.5) @ (column, row, 1.0)
    uv = camera.project(np.append(ground, 0.0))
    if depth < 1.0:
        return
    assert camera.lens.principal_point + camera.lens.focal_px * np.array([x, y]) / depth == pytest.approx(
        uv, rel=1e-9, abs=1e-6
    )
    east, north, w = camera.homography(0.0) @ np.append(uv, 1.0)
    if np.abs(uv).max() < 1e4:
        assert (east / w, north / w) == pytest.approx(tuple(ground), abs=1e-3)


@settings(max_examples=60)
@given(camera=poses, seed=st.integers(0, 1000), k1=st.sampled_from([0.0, -0.1, 0.1]))
def test_half_planes_and_boxes_hold_all_that_is_seen(camera, seed, k1):
    camera = type(camera)(camera.position, camera.rotation, Lens(160, 120, 90.0, k1=k1))
    pixels = np.random.default_rng(seed).uniform((0, 0), (159, 119), (200, 2))
    ground = camera.to_ground(pixels)
    off = np.hypot(*(ground - camera.nadir).T)
    with np.errstate(invalid="ignore"):
        ground = ground[off <= camera.position[2] * np.tan(np.radians(74.9))]
    planes, box, corners = np.empty((8, 3)), np.empty(4), np.array(outer_box(camera.lens))
    grid = scene.grid(1000.0, 0.5)
    count = aim(camera.position, camera.rotation, corners, 0.0, LEAST_DESCENT, grid.west, grid.north, 0.5, planes, box)
    assert (count > 0) or len(ground) == 0
    if rejection(camera, 0.0, 1.0) is not None:
        assert len(ground) == 0
        return
    west, south, east, north = footprint_boxes([camera], 0.0, 0.0)[0]
    at = grid.to_pixel(ground)
    assert ((planes[:count, :2] @ at.T) <= planes[:count, 2:] + 1e-3 * np.abs(planes[:count, 2:])).all()
    assert (at >= (box[0] - 0.01, box[2] - 0.01)).all() and (at <= (box[1] + 0.01, box[3] + 0.01)).all()
    assert (ground >= (west - 0.05, south - 0.05)).all() and (ground <= (east + 0.05, north + 0.05)).all()


def outer_box(lens):
    return lens_row(lens, 0.0)[OUTER:INNER]


@given(
    x=st.floats(-50, 150), y=st.floats(-50, 150), radius=st.floats(0, 100), row=st.integers(0, 99),
    turn=st.floats(0, np.pi),
)  # fmt: skip
def test_row_spans_are_the_pixels_inside(x, y, radius, row, turn):
    angles = turn + np.array([0.3, 2.0, 4.1])
    planes = np.stack([np.cos(angles), np.sin(angles), np.cos(angles) * 50 + np.sin(angles) * 50 + 30.0], 1)
    first, last = row_span(planes, np.array([x, y]), radius, row, 10, 90)
    columns = np.arange(10, 90)
    slack = (planes[:, 2:] - planes[:, :2] @ np.stack([columns, np.full(80, row)])).min(0)
    slack = np.minimum(slack, radius - np.hypot(columns - x, row - y))
    inside = (columns >= first) & (columns < last)
    assert (inside == (slack >= 0))[np.abs(slack) > 1e-6].all()


def test_many_frames_are_judged_like_one():
    cameras = [
        *scene.survey(0).cameras,
        scene.camera(pitch_deg=30.0),
        scene.camera(height=-1.0),
        scene.camera(height=9e3),
    ]
    cameras.append(scene.camera(lens=scene.small_lens(k1=-0.1), pitch_deg=-25.0))
    alone = {i: reason for i, c in enumerate(cameras) if (reason := rejection(c, 0.0, 1.0)) is not None}
    assert rejections(cameras, 0.0, 1.0) == alone
    assert sorted(alone) == [12, 13, 14]


def test_a_frame_too_coarse_for_the_map_says_how_much_and_what_to_change():
    camera = Camera(np.array([0.0, 0.0, 90.0]), rotation_from_angles(0.0, -np.pi / 2, 0.0), Lens(320, 240, 150.0))
    assert rejection(camera, 0.0, 0.5) is None
    reason = rejection(camera, 0.0, 0.01)
    assert reason is not None and "60 times" in reason and "--gsd" in reason


def test_footprint_of_a_level_camera_is_its_corners():
    camera = scene.camera(yaw_deg=20.0, pitch_deg=-80.0)
    assert footprint(camera) == pytest.approx(camera.corners())
    assert len(footprint(scene.camera(pitch_deg=30.0))) == 0


def test_default_gsd_is_the_median_ground_pixel_at_nadir():
    cameras = [scene.camera(height=h) for h in (90.0, 99.0, 180.0, -5.0)]
    assert default_gsd(cameras, 9.0) == pytest.approx(90.0 / 90.0)


def test_a_weak_picture_is_drawn_where_no_other_sees_and_gives_way(canvas, tmp_path):
    flight = scene.survey(3)
    weak, *sound = range(len(flight.frames))
    with Canvas.create(tmp_path / "sound", canvas.grid, tile_px=128) as other:
        add_all(other, flight, sound)
        expected = whole(other)
    module, frame = RealtimeMosaic(canvas), flight.frames[weak]
    module.add(flight.read(frame.frame.path), frame.camera, weak=True)
    add_all(canvas, flight, sound)
    image = whole(canvas)
    covered = expected[..., 3] == 255
    assert (image[covered] == expected[covered]).all(axis=-1).mean() > 0.9999
    assert (image[..., 3] == 255).sum() > covered.sum()
    assert module.add(flight.read(frame.frame.path), frame.camera, weak=True).won == 0
