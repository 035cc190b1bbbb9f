"""Finding strips and points on a map, and what is concluded from them."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.camera import rotation_from_angles
from orthoswarm.model.geo import GroundGrid
from orthoswarm.refine.bundle.block_arrays import CameraBlock
from orthoswarm.refine.features.patch_matching import gradients, locate, template_of, window_of
from orthoswarm.refine.flight.relative_block import BestViews, FlightBlock
from orthoswarm.refine.registration.absolute_orientation import (
    clear_matches,
    edge_displacement,
    mode_shift,
    tie_half_m,
)
from orthoswarm.refine.registration.orientation_correlation import (
    PEAK_APART_PX,
    Search,
    Strip,
    by_edges,
    correlation,
    highest,
    orientation_field,
    register,
    stacked,
)
from orthoswarm.refine.registration.tie_points import LoadedMap, MapMatches, match_points, vote_lean
from orthoswarm.refine.strategy.second_pass import map_heights
from orthoswarm.refine.surface.vehicle_ground import GroundModel

GSD = 0.5


def texture(size, seed=1):
    rng = np.random.default_rng(seed)
    parts = [
        cv2.resize(rng.random((size // s, size // s)).astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
        for s in (3, 7, 16, 50)
    ]
    return cv2.normalize(sum(parts), None, 0, 255, cv2.NORM_MINMAX)


@dataclass
class FlatMap:
    """A map of 500 m x 500 m around the local origin."""

    values: np.ndarray
    epsg: int = 32633
    native_gsd_m: float = GSD

    @property
    def bounds(self):
        return BoundingBox(-250.0, -250.0, 250.0, 250.0)

    def gray(self, bounds, gsd_m):
        grid = GroundGrid.around(self.epsg, bounds, gsd_m)
        columns, rows = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
        east, north = np.moveaxis(grid.to_ground(np.stack([columns, rows], -1)), -1, 0)
        u, v = (east + 250) / GSD - 0.5, (250 - north) / GSD - 0.5
        out = cv2.remap(self.values, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        return out, (u >= 0) & (v >= 0) & (u < 999) & (v < 999)


@pytest.fixture(scope="module")
def world():
    return FlatMap(texture(1000))


def pictures_of(world, offset):
    """Six nadir pictures whose record is `offset` metres away from where they were taken."""
    true = np.array([[x, 10.0, 100.0] for x in np.linspace(-60, 60, 6)])
    rotation = np.repeat(rotation_from_angles([0.0], [-np.pi / 2], [0.0]), 6, axis=0)
    cameras = CameraBlock(true, rotation, np.zeros(6, np.int32), np.array([[300.0, 0, 0, 0, 0, 0, 320, 240]]))
    columns, rows = np.meshgrid(np.arange(320), np.arange(240))
    images = []
    for i in range(6):
        ground = cameras.camera(i, np.zeros(2)).to_ground(np.stack([columns, rows], -1).astype(float))
        u, v = (ground[..., 0] + 250) / GSD - 0.5, (250 - ground[..., 1]) / GSD - 0.5
        image = cv2.remap(world.values, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        images.append(np.clip(255 - 0.7 * image, 0, 255).astype(np.uint8))  # light and dark have changed places
    return CameraBlock(true + np.array([*offset, 0.0]), rotation, cameras.lens_id, cameras.lens), images


def test_a_strip_is_found_although_light_and_dark_changed_places(world):
    cameras, images = pictures_of(world, (17.0, -9.0))
    found = register(cameras, np.arange(6), lambda i: images[i], Search(world, np.zeros(2), 40.0, 1.0))
    np.testing.assert_allclose(found.shift, (-17.0, 9.0), atol=0.3)
    assert found.ratio < 0.6


def test_a_map_elsewhere_gives_no_match(world):
    cameras, images = pictures_of(world, (0.0, 0.0))
    away = CameraBlock(cameras.position + np.array([900.0, 0, 0]), cameras.rotation, cameras.lens_id, cameras.lens)
    assert register(away, np.arange(6), lambda i: images[i], Search(world, np.zeros(2), 60.0, 2.0)) is None


def test_correlation_finds_fractions_of_a_pixel():
    image = texture(300, seed=5)
    moved = cv2.warpAffine(image, np.array([[1, 0, 3.4], [0, 1, -2.7]]), (300, 300))
    inner = orientation_field(image[50:250, 50:250], np.ones((200, 200), bool))
    outer = orientation_field(moved[30:270, 30:270], np.ones((240, 240), bool))
    column, row, _, ratio = highest(correlation(inner, outer, 20), PEAK_APART_PX)
    assert column == pytest.approx(3.4, abs=0.2)
    assert row == pytest.approx(-2.7, abs=0.2)
    assert ratio < 0.5


def faint_strips(shift, count=4, reach=30, seed=0):
    """Strips of one flight that show little of their map under their noise, all displaced alike (but for a pixel)."""
    rng = np.random.default_rng(seed)
    whole = texture(600, seed=9)
    strips = []
    for k in range(count):
        r, c = 40 + 130 * k, 200
        dc, dr = shift + rng.integers(-1, 2, 2)
        view = whole[r + dr : r + dr + 100, c + dc : c + dc + 160]
        noise = cv2.GaussianBlur(rng.normal(0, 1, view.shape).astype(np.float32), (0, 0), 1.0)
        gray = view + 2.0 * view.std() * noise / noise.std()
        ground = whole[r - reach : r + 100 + reach, c - reach : c + 160 + reach]
        mask = np.ones(view.shape, bool), np.ones(ground.shape, bool)
        strips.append(
            Strip(
                gray=gray.astype(np.float32),
                valid=mask[0],
                ground=ground.copy(),
                known=mask[1],
                reach=reach,
                gsd_m=2.0,
                offset=(0.0, 0.0),
            )
        )
    return strips


def mirrored(strip):
    return replace(strip, ground=np.ascontiguousarray(strip.ground[::-1, ::-1]))


def test_strips_that_say_little_each_are_found_together():
    shift = np.array([9, -12])
    strips = faint_strips(shift)
    assert all(by_edges(strip)[3] > 0.5 for strip in strips)  # no one of them is clear
    east_north, z, ratio = stacked(strips)
    np.testing.assert_allclose(east_north, [18.0, 24.0], atol=3.0)
    assert z > 5.0
    assert ratio < 0.9


@pytest.mark.parametrize("seed", range(6))
def test_strips_of_other_ground_stand_out_less(seed):
    strips = faint_strips(np.array([9, -12]), seed=seed)
    assert stacked([mirrored(strip) for strip in strips])[1] < 5.0


def test_there_is_nothing_to_find_without_strips_or_edges():
    blank = [replace(s, ground=np.full_like(s.ground, 128.0)) for s in faint_strips(np.array([9, -12]))]
    assert stacked([]) is None and stacked(blank) is None
    assert all(by_edges(strip) is None for strip in blank)


def raised_ground(height_m):
    """CameraBlock, pictures and map of ground that is `height_m` above where it is believed, seen from 100 m."""
    world = FlatMap(texture(1000, seed=3))
    rotation = np.repeat(rotation_from_angles([0.0], [-np.pi / 2], [0.0]), 5, axis=0)
    position = np.array([[x, 0.0, 100.0] for x in np.linspace(-60, 60, 5)])
    cameras = CameraBlock(position, rotation, np.zeros(5, np.int32), np.array([[160.0, 0, 0, 0, 0, 0, 320, 320]]))
    columns, rows = np.meshgrid(np.arange(320), np.arange(320))
    images = []
    for i in range(5):
        ground = cameras.camera(i, np.zeros(2)).to_ground(np.stack([columns, rows], -1).astype(float), height_m)
        u, v = (ground[..., 0] + 250) / GSD - 0.5, (250 - ground[..., 1]) / GSD - 0.5
        images.append(cv2.remap(world.values, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR))
    flight = SimpleNamespace(
        cameras=lambda: cameras,
        leg=np.zeros(5, np.int32),
        pictures=SimpleNamespace(size=(320, 320), gray=lambda i: np.clip(images[i], 0, 255).astype(np.uint8)),
    )
    return flight, LoadedMap.load(world, np.zeros(2), BoundingBox(-240.0, -240.0, 240.0, 240.0), GSD)


@pytest.mark.parametrize("height_m", [-2.5, 0.0, 3.0])
def test_the_map_tells_the_height_of_what_is_seen_obliquely(height_m):
    flight, ground = raised_ground(height_m)
    points, sigma = map_heights(flight, GroundModel(), ground, others=np.zeros((0, 2)), tie_sigma_m=np.full(50, 0.1))
    assert len(points) > 50
    assert np.median(np.abs(points[:, 2] - height_m)) < 0.15
    assert np.percentile(np.abs(points[:, 2] - height_m), 90) < 0.5
    off_path = np.hypot(np.maximum(np.abs(points[:, 0]) - 60.0, 0.0), points[:, 1])
    assert (off_path > 30.0).all()  # what is seen from above is left to the pictures
    assert sigma.min() > 0.0


def test_ground_that_another_vehicle_sees_better_is_left_to_it():
    flight, ground = raised_ground(0.0)
    other = np.array([[x, 80.0] for x in np.linspace(-100, 100, 9)])
    points, _ = map_heights(flight, GroundModel(), ground, others=other, tie_sigma_m=np.full(50, 0.1))
    assert len(points)
    assert (points[:, 1] < 45.0).all()
    assert not len(
        map_heights(flight, GroundModel(), ground, others=other, tie_sigma_m=np.zeros(0))[0]
    )  # no ties, no heights
    flight.leg = np.full(5, -1, np.int32)
    assert not len(
        map_heights(flight, GroundModel(), ground, others=other, tie_sigma_m=np.full(50, 0.1))[0]
    )  # nor without a leg


def test_points_are_tied_to_a_tenth_of_a_map_pixel(world):
    inverted = FlatMap((255 - world.values).astype(np.float32))
    cameras, images = pictures_of(inverted, (1.5, -0.8))
    points = np.array([[x, y, 0.0] for x in (-40.0, 0.0, 40.0) for y in (-5.0, 10.0, 25.0)])
    points += np.array([1.5, -0.8, 0.0])
    camera = np.abs(points[:, None, 0] - cameras.position[None, :, 0]).argmin(1).astype(np.int32)
    ground = LoadedMap.load(inverted, np.zeros(2), BoundingBox(-120.0, -80.0, 120.0, 100.0), GSD)
    flipped = [255 - im for im in images]
    found = match_points(
        cameras,
        points,
        np.arange(9),
        camera=camera,
        gray=lambda i: flipped[i],
        ground=ground,
        half=16,
        reach=10,
        level=np.zeros(9),
    )
    assert len(found.point) == 9
    np.testing.assert_allclose(found.shift, np.tile([-1.5, 0.8], (9, 1)), atol=0.1)
    assert (found.ratio < 0.8).all()


def test_raised_corners_are_tied_by_the_ground_around_them(world):
    cameras, images = pictures_of(world, (0.0, 0.0))
    raised = np.array([[30.0, 20.0, 3.0], [-25.0, -8.0, 2.0]])
    camera = np.array([2, 2], np.int32)
    ground = LoadedMap.load(world, np.zeros(2), BoundingBox(-120.0, -80.0, 120.0, 100.0), GSD)
    plain = [255 - im for im in images]
    found = match_points(
        cameras,
        raised,
        np.arange(2),
        camera=camera,
        gray=lambda i: plain[i],
        ground=ground,
        half=16,
        reach=10,
        level=np.zeros(2),
    )
    np.testing.assert_allclose(found.shift, 0.0, atol=0.1)


def roofs(height, lean, seed=0, wild=0.3):
    rng = np.random.default_rng(seed)
    shift = np.outer(height, lean) + rng.normal(0, 0.2, (len(height), 2))
    bad = rng.random(len(height)) < wild
    shift[bad] = rng.uniform(-8, 8, (int(bad.sum()), 2))
    n = len(height)
    return MapMatches(
        point=np.arange(n, dtype=np.int32), camera=np.zeros(n, np.int32), shift=shift, peak=np.ones(n),
        ratio=np.zeros(n),
    )  # fmt: skip


def in_light(ground, things, east, north):
    """Ground with dark things on it that cast shadows of so many pixels, float32."""
    out = ground.copy()
    for r, c in things:
        for k in np.linspace(0.0, 1.0, 9):
            row, column = round(r - k * north), round(c + k * east)
            out[row : row + 3, column : column + 3] = 0.5 * ground[row : row + 3, column : column + 3]
    return out


def common_shift(pictures, maps, by_texture):
    shifts = []
    for picture, other in zip(pictures, maps, strict=True):
        template, window = template_of(20), window_of(20, 11)
        gradients(np.ascontiguousarray(picture[11:54, 11:54]), by_texture, np.float32(1e-3), template, 3)
        gradients(np.ascontiguousarray(other), by_texture, np.float32(1e-3), window, 0)
        shifts.append(locate(template, window, 11, 4)[:2])
    return float(np.hypot(*np.mean(shifts, axis=0)))


def test_shadows_of_another_hour_pull_less_where_texture_is_compared():
    rng = np.random.default_rng(3)
    pictures, maps = [], []
    for _ in range(60):
        ground = cv2.GaussianBlur(rng.normal(0.0, 1.0, (65, 65)).astype(np.float32), (0, 0), 1.5)
        ground = 120.0 + 12.0 * ground / ground.std()
        things = rng.integers(8, 54, (14, 2))
        pictures.append(in_light(ground, things, 3.0, 0.0))
        maps.append(in_light(ground, things, 0.0, 3.0))
    edges, texture = (common_shift(pictures, maps, by_texture) for by_texture in (False, True))
    assert edges > 0.03
    assert texture < 0.6 * edges


def test_larger_patches_are_found_where_most_of_the_ground_looks_different():
    rng = np.random.default_rng(5)
    as_it_was, now = texture(1000, 1), texture(1000, 9)
    same = cv2.GaussianBlur(rng.normal(size=as_it_was.shape).astype(np.float32), (0, 0), 12)
    today = FlatMap(np.where(same > np.quantile(same, 0.8), as_it_was, now))
    cameras, images = pictures_of(today, (0.0, 0.0))
    points = np.array([[x, y, 0.0] for x in range(-84, 85, 8) for y in range(-12, 33, 8)], float)
    camera = np.abs(points[:, None, 0] - cameras.position[None, :, 0]).argmin(1).astype(np.int32)
    ground = LoadedMap.load(FlatMap(as_it_was), np.zeros(2), BoundingBox(-160.0, -120.0, 160.0, 140.0), GSD)

    def right_ones(half):
        found = clear_matches(
            match_points(
                cameras, points, np.arange(len(points)), camera=camera, gray=lambda i: 255 - images[i], ground=ground,
                half=half, reach=10, level=np.zeros(len(points)), texture=True,
            )
        )  # fmt: skip
        return float((np.hypot(*found.shift.T) < 0.25).sum()) / len(points)

    assert right_ones(30) > 1.3 * right_ones(20) > 0.1


@pytest.mark.parametrize(("height_m", "half_m"), [(30.0, 10.0), (150.0, 15.0), (600.0, 20.0)])
def test_patches_grow_with_the_flying_height_within_limits(height_m, half_m):
    assert tie_half_m(SimpleNamespace(height_m=height_m)) == pytest.approx(half_m)


def test_what_strong_edges_pull_more_is_what_they_pull_texture():
    rng = np.random.default_rng(7)
    ground = 60.0 + 0.4 * texture(1000, 3)
    things = rng.integers(300, 700, (2500, 2))
    before, after = FlatMap(in_light(ground, things, 0.0, 3.0)), FlatMap(in_light(ground, things, 3.0, 0.0))
    cameras, images = pictures_of(after, (0.0, 0.0))
    points = np.array([[x, y, 0.0] for x in range(-84, 85, 8) for y in range(-16, 36, 8)], float)
    camera = np.abs(points[:, None, 0] - cameras.position[None, :, 0]).argmin(1).astype(np.int32)
    flight = SimpleNamespace(
        adjustment=SimpleNamespace(cameras=cameras, points=points),
        pictures=SimpleNamespace(size=(320, 320), gray=lambda i: 255 - images[i]),
        best_views=lambda: SimpleNamespace(camera=camera),
        cameras=lambda: cameras,
        height_m=float(np.median(cameras.position[:, 2])),
    )
    level = SimpleNamespace(height=lambda xy: np.zeros(len(xy)))
    loaded = LoadedMap.load(before, np.zeros(2), BoundingBox(-160.0, -120.0, 160.0, 140.0), GSD)
    chosen = np.arange(len(points))
    found = clear_matches(
        match_points(
            cameras,
            points,
            chosen,
            camera=camera,
            gray=flight.pictures.gray,
            ground=loaded,
            half=20,
            reach=10,
            level=np.zeros(len(points)),
            texture=True,
        )
    )
    off = found.shift.mean(0)
    left = off - edge_displacement(flight, level, loaded, found)
    assert np.hypot(*off) > 0.02
    assert np.hypot(*left) < 0.6 * np.hypot(*off)
    few = found.take(np.arange(10))
    assert not edge_displacement(flight, level, loaded, few).any()  # so few tell nothing


def test_the_lean_is_voted_among_outliers():
    height = np.random.default_rng(1).uniform(4, 25, 60)
    found = vote_lean(roofs(height, np.array([0.2, -0.12])), height, np.zeros(2))
    np.testing.assert_allclose(found, (0.2, -0.12), atol=0.02)


def test_few_or_contradictory_roofs_vote_for_nothing():
    height = np.random.default_rng(1).uniform(4, 25, 60)
    assert vote_lean(roofs(height[:8], np.array([0.2, -0.12])), height[:8], np.zeros(2)) is None
    assert vote_lean(roofs(height, np.array([0.2, -0.12]), wild=1.0), height, np.zeros(2)) is None


def test_the_agreed_shift_outvotes_a_scattered_majority():
    rng = np.random.default_rng(2)
    shift = np.concatenate([rng.normal((1.2, -0.7), 0.15, (40, 2)), rng.uniform(-10, 10, (60, 2))])
    np.testing.assert_allclose(mode_shift(shift), (1.2, -0.7), atol=0.08)
    np.testing.assert_array_equal(mode_shift(np.zeros((0, 2))), 0.0)


def test_each_cell_of_each_leg_gives_its_best_point():
    points = np.array([[1.0, 1, 0], [2, 2, 0], [3, 3, 0], [55, 1, 0]])
    flight = SimpleNamespace(adjustment=SimpleNamespace(points=points), leg=np.array([0, 0, 1, 0], np.int32))
    seen = BestViews(np.arange(4, dtype=np.int32), np.ones(4, np.int32), np.ones(4))
    usable = np.array([True, True, True, False])
    chosen = FlightBlock.one_per_cell(flight, seen, usable, np.array([0.5, 0.2, 0.9, 0.1]), 50.0)
    np.testing.assert_array_equal(chosen, [1, 2])
