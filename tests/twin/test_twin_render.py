"""Rendering: what stands where in a picture, facades and occlusion, the leaning map, moving things."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.twin.city.scene import CELL_M, TILE_CELLS, WATER, Scene, scene_grid
from orthoswarm.twin.city.sunlight import Sun, light_map, lit_texture
from orthoswarm.twin.ray_marching import _march, lens_rays, make_stage, render, satellite_view

STILL = np.zeros(8)
NO_HAZE = np.zeros((0, 0), np.float32)


def box_scene(height, slope=0.0):
    """Dark level (or sloping) ground of 120 m with a white box of 12 x 8 m, 20 m east and 10 m north of the middle."""
    scene = Scene.blank(scene_grid(32633, (500000.0, 5000000.0), 59.0, 59.0))
    g = scene.cells
    east = g.west + (np.arange(g.width) + 0.5) * CELL_M - 500000.0
    north = g.north - (np.arange(g.height) + 0.5) * CELL_M - 5000000.0
    scene.dtm[:] = slope * east[None, :]
    inside = (np.abs(east[None, :] - 20) < 6) & (np.abs(north[:, None] - 10) < 4)
    scene.dsm[:] = np.where(inside, height + scene.dtm, scene.dtm)
    scene.albedo[:] = 40
    scene.albedo[np.repeat(np.repeat(inside, 2, 0), 2, 1)] = 250
    scene.wall[:] = (200, 0, 0)
    return scene


def stage_of(scene):
    return make_stage(scene, scene.albedo, (0.0, 0.0, 1.0), 1.0, NO_HAZE)


@pytest.mark.parametrize(
    ("height", "tilt", "k"),
    [(0.0, 0.0, (0, 0)), (12.0, 0.08, (0, 0)), (12.0, -0.1, (-0.05, 0.01)), (30.0, 0.0, (0.04, 0))],
)
def test_a_roof_appears_where_the_camera_model_puts_it(height, tilt, k):
    lens = Lens(320, 240, 220.0, k1=k[0], k2=k[1])
    camera = Camera(np.array([500003.0, 4999998.0, 90.0]), rotation_from_angles(0.7, tilt - np.pi / 2, 0.05), lens)
    image = render(stage_of(box_scene(height)), camera, lens_rays(lens), STILL)
    white = image[..., 1] > 150
    rows, cols = np.nonzero(white)
    east, north = np.meshgrid(500000 + np.linspace(14, 26, 60), 5000000 + np.linspace(6, 14, 40))
    expected = camera.project(np.stack([east, north, np.full_like(east, height)], -1)).reshape(-1, 2)
    np.testing.assert_allclose([cols.mean(), rows.mean()], expected.mean(0), atol=0.35)
    assert white.sum() == pytest.approx(np.prod(np.ptp(expected, axis=0)), rel=1.0)


def test_walls_are_seen_from_the_side_and_hide_the_ground_behind():
    lens = Lens(320, 240, 220.0)
    camera = Camera(np.array([500000.0, 5000010.0, 60.0]), rotation_from_angles(0.0, -np.pi / 2, 0.0), lens)
    image = render(stage_of(box_scene(20.0)), camera, lens_rays(lens), STILL)
    red = (image[..., 0] > 120) & (image[..., 1] < 20)
    cols = np.nonzero(red)[1]
    # the western wall runs from its foot (14 m east at level 0) to its top (14 m east at level 20)
    foot, top = (camera.project(np.array([500014.0, 5000010.0, z]))[0] for z in (0.0, 20.0))
    assert cols.min() == pytest.approx(foot, abs=1.5)
    assert cols.max() == pytest.approx(top, abs=1.5)
    # behind the roof's far edge the ground begins only where the line of sight comes down again
    edge = camera.project(np.array([500026.0, 5000010.0, 20.0]))[0]
    row = image[120, :, 1]
    assert row[round(edge) - 2] > 200
    assert row[round(edge) + 2] < 60


def test_sloping_ground_is_where_the_camera_model_puts_it():
    scene = box_scene(0.0, slope=0.12)
    lens = Lens(320, 240, 220.0)
    camera = Camera(np.array([500000.0, 5000000.0, 80.0]), rotation_from_angles(0.3, -np.pi / 2, 0.0), lens)
    rows, cols = np.nonzero(render(stage_of(scene), camera, lens_rays(lens), STILL)[..., 1] > 150)
    east, north = np.meshgrid(500000 + np.linspace(14, 26, 60), 5000000 + np.linspace(6, 14, 40))
    expected = camera.project(np.stack([east, north, 0.12 * (east - 500000)], -1)).reshape(-1, 2)
    np.testing.assert_allclose([cols.mean(), rows.mean()], expected.mean(0), atol=0.3)


@pytest.mark.parametrize("lean", [(0.3, 0.0), (0.0, -0.25), (-0.2, 0.2)])
def test_the_map_shows_roofs_leaning_and_ground_in_place(lean):
    for height in (0.0, 20.0):
        image, grid = satellite_view(stage_of(box_scene(height)), lean, 0.4)
        rows, cols = np.nonzero(image[..., 1] > 150)
        centre = grid.to_ground([cols.mean(), rows.mean()]) - np.array([500000.0, 5000000.0])
        np.testing.assert_allclose(centre, [20 + lean[0] * height, 10 + lean[1] * height], atol=0.25)


@pytest.mark.parametrize("lean", [(0.3, 0.0), (0.0, -0.25), (-0.2, 0.2), (0.0, 0.0)])
def test_the_map_is_complete_to_its_edges_whatever_stands_elsewhere(lean):
    # a tower decides at what height rays begin; where they lean, those of the edges begin outside the scene
    towered, low = (satellite_view(stage_of(box_scene(h, slope=0.05)), lean, 0.4)[0] for h in (40.0, 2.0))
    assert towered[..., 0].min() == 40.0  # walls are red
    near_box = np.zeros(towered.shape[:2], bool)
    near_box[30:-30, 30:-30] = True
    np.testing.assert_array_equal(towered[~near_box], low[~near_box])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.floats(-3, 3), st.floats(-3, 3))
@example(362881, -2.4203227286099054, -2.5)
def test_a_ray_stops_at_the_first_surface_that_it_meets(seed, bx, by):
    rng = np.random.default_rng(seed)
    dsm = np.where(rng.random((64, 64)) < 0.15, rng.uniform(2, 12, (64, 64)), rng.uniform(0, 0.5, (64, 64)))
    dsm = dsm.astype(np.float32)
    tiles = dsm.reshape(4, TILE_CELLS, 4, TILE_CELLS).max(axis=(1, 3)) + np.float32(0.3)
    ax, ay, top = 32.3 - 6 * bx, 31.6 - 6 * by, float(tiles.max())
    row, col, z, side = _march(dsm, tiles, ax, ay, 12.5, bx, by, top)
    heights = np.arange(top, -0.5, -0.002)
    x, y = ax + bx * (12.5 - heights), ay + by * (12.5 - heights)
    inside = (x >= 0) & (y >= 0) & (x < 64) & (y < 64)
    assert inside[0]
    gone = np.flatnonzero(~inside)
    heights, x, y = (v[: gone[0] if len(gone) else None] for v in (heights, x, y))
    hit = np.flatnonzero(dsm[y.astype(int), x.astype(int)] >= heights)
    if not len(hit):
        assert row == -1 or z < 0.01
        return
    k = hit[0]
    if z > heights[k] + 0.01:  # a corner that the ray grazes between two samples
        at = ax + bx * (12.5 - z), ay + by * (12.5 - z)
        assert dsm[row, col] >= z - 1e-5
        assert at == pytest.approx((np.clip(at[0], col, col + 1), np.clip(at[1], row, row + 1)), abs=1e-3)
        return
    assert z == pytest.approx(heights[k], abs=0.01)
    if side == 0:
        assert z == pytest.approx(dsm[row, col], abs=1e-5)


def test_shadows_fall_away_from_the_sun():
    scene = box_scene(10.0)
    light = light_map(scene, Sun(np.pi / 2, np.radians(45.0)))  # sun in the east: shadow 10 m to the west
    g = scene.cells
    east = g.west + (np.arange(g.width) + 0.5) * CELL_M - 500000.0
    row = int((g.north - 5000010.0) / CELL_M)
    dark = east[light[row] < 80]
    assert dark.min() == pytest.approx(4.0, abs=1.0)
    assert dark.max() == pytest.approx(14.0, abs=1.0)
    assert light[row, -3] == 128


def test_light_changes_colours_but_keeps_their_place():
    scene = box_scene(0.0)
    lit = lit_texture(scene, Sun(2.0, 0.9))
    assert lit.shape == scene.albedo.shape
    np.testing.assert_allclose(lit[5, 5].astype(float), 40.0, atol=3)


def test_water_and_haze_move_and_the_rest_stands_still():
    scene = box_scene(5.0)
    scene.kind[:, : scene.kind.shape[1] // 3] = WATER  # the western third
    haze = np.zeros((30, 30), np.float32)
    haze[17:, 17:] = 0.6  # the south-eastern corner
    stage = make_stage(scene, scene.albedo, (0.0, 0.0, 1.0), 1.0, haze)
    lens = Lens(320, 240, 170.0)
    camera = Camera(np.array([500000.0, 5000000.0, 55.0]), rotation_from_angles(0.0, -np.pi / 2, 0.0), lens)
    rays = lens_rays(lens)
    first, later = (render(stage, camera, rays, np.full(8, t)) for t in (3.0, 40.0))
    change = np.abs(first - later).mean(-1)
    assert change[:, :90].mean() > 1.0
    assert change[170:, 240:].mean() > 1.5
    assert change[40:100, 140:300].max() == 0.0
    assert first[200, 280].mean() > 100  # the veil is bright
