"""Layers and web tiles: where they lie, that they grow, and that readers see whole generations."""

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer
from rasterio.transform import from_origin

from gcs_plugin.daemon.layers.layers import MapArea, MapLayer, successor
from gcs_plugin.daemon.layers.web_tiles import (
    TileAddress,
    TileServer,
    canvas_tile,
    encode,
    ground_patch,
    open_basemap,
    over,
    resampled,
)
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.geo import GroundGrid, LocalGrid
from orthoswarm.mosaic.realtime import RealtimeMosaic
from tests.kit.daemon_kit import camera_at, tile_over
from tests.kit.made_up_ground import made_up_ground, write_map
from tests.kit.mosaic_scene import EAST, NORTH, colour, picture_of

EPSG = 32648


def drawn(path, area, *cameras):
    canvas = Canvas.create(path, area.grid)
    mosaic = RealtimeMosaic(canvas)
    for camera in cameras:
        mosaic.add(picture_of(camera), camera)
    return canvas


def small_area(gsd=0.5):
    return MapArea.around(EPSG, EAST, NORTH, gsd)


@given(st.integers(12, 22), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
def test_tile_pixels_lie_where_web_mercator_says(zoom, dlat, dlon):
    z, x, y = tile_over(camera_at(dlon * 90_000, dlat * 110_000), zoom)
    patch, gsd = ground_patch(TileAddress(z, x, y), EPSG)
    tile = TileAddress(z, x, y)
    half = np.pi * 6378137.0
    c, r = np.array([0, 77, 255]), np.array([13, 128, 255])
    east, north = Transformer.from_crs(3857, EPSG, always_xy=True).transform(
        (x * 256 + c + 0.5) * tile.pixel_m - half, half - (y * 256 + r + 0.5) * tile.pixel_m
    )
    error = np.hypot(patch[r, c, 0] - east, patch[r, c, 1] - north)
    assert error.max() < 0.02 * gsd + 1e-4


def test_a_tile_shows_the_ground(tmp_path):
    camera = camera_at()
    with drawn(tmp_path / "c", small_area(), camera) as canvas:
        address = TileAddress(*tile_over(camera, 19))
        tile = canvas_tile(canvas, address)
        patch, _ = ground_patch(address, EPSG)
    inside = tile[..., 3] == 255
    assert inside.mean() > 0.2
    error = np.abs(tile[..., :3].astype(float) - np.clip(colour(patch), 0, 255))[inside]
    assert np.median(error) < 4


def test_far_and_empty_tiles_are_transparent(tmp_path):
    layer = MapLayer("realtime")
    layer.replace(drawn(tmp_path / "c", small_area(), camera_at()))
    server = TileServer({"realtime": layer})
    for address in (TileAddress(0, 0, 0), TileAddress(5, 0, 31), TileAddress(19, 1, 1)):
        data, _ = server.tile("realtime", address, "png")
        if address.z:
            assert data == encode(None, "png")
    layer.close()


def test_the_etag_changes_with_the_content_and_only_then(tmp_path):
    layer = MapLayer("realtime")
    canvas = drawn(tmp_path / "c", small_area(), camera_at())
    layer.replace(canvas)
    server = TileServer({"realtime": layer})
    here, away = TileAddress(*tile_over(camera_at(), 20)), TileAddress(*tile_over(camera_at(900, 900), 20))
    first, far = server.tile("realtime", here, "png"), server.tile("realtime", away, "png")
    assert server.tile("realtime", here, "png") == first
    camera = camera_at(height=50)
    RealtimeMosaic(canvas).add(255 - picture_of(camera), camera_at(1.0, 1.0, 50))
    second = server.tile("realtime", here, "png")
    assert second[1] != first[1]
    assert second[0] != first[0]
    assert server.tile("realtime", away, "png") == far
    layer.close()


def test_a_grown_canvas_shows_what_the_small_one_showed(tmp_path):
    area = small_area()
    old = drawn(tmp_path / "old", area, camera_at(), camera_at(40, 60))
    west, south, east, north = area.bounds
    wide = area.grown(BoundingBox(west - 700, south, east, north + 1200))
    new = successor(old, tmp_path / "new", wide.grid, "orthogonality", share=False)
    box = BoundingBox(EAST - 100, NORTH - 100, EAST + 100, NORTH + 150)
    before, grid = old.read_ground(box)
    after, other = new.read_ground(box)
    assert before[..., 3].any()
    np.testing.assert_array_equal(before, after)
    assert (grid.west, grid.north) == pytest.approx((other.west, other.north))
    RealtimeMosaic(new).add(picture_of(camera_at()), camera_at(-3000, 3000))
    np.testing.assert_array_equal(old.read_ground(box)[0], before)
    old.close()
    new.close()


def test_a_generation_shares_tiles_but_not_changes(tmp_path):
    area = small_area()
    old = drawn(tmp_path / "old", area, camera_at(), camera_at(900, 900))
    box = BoundingBox(EAST - 60, NORTH - 60, EAST + 60, NORTH + 60)
    before = old.read_ground(box)[0]
    new = successor(old, tmp_path / "new", area.grid, "orthogonality", share=True)
    staged = new.staging("staging")
    key = old.changed_since(0)[0]
    staged.get(key, create=True).rgba[:] = 7
    new.adopt(staged, [key])
    np.testing.assert_array_equal(old.read_ground(box)[0], before)
    assert new.newest(old.tile_bounds(key)) > old.newest(old.tile_bounds(key))
    far = BoundingBox(EAST + 880, NORTH + 880, EAST + 920, NORTH + 920)
    assert new.newest(far) == old.newest(far)  # an unchanged tile keeps its version, and so its ETag
    assert new.read_reduced(8, *[v // 8 for v in old.window(far)])[..., 3].any()
    old.close()
    new.close()


def test_a_layer_is_kept_open_while_it_is_read_and_removed_after(tmp_path):
    area, layer = small_area(), MapLayer("fine")
    layer.replace(drawn(tmp_path / "a", area, camera_at()))
    with layer.reading() as canvas:
        layer.replace(drawn(tmp_path / "b", area, camera_at(50)))
        assert canvas.path.name == "a"
        assert canvas.read_reduced(8, 0, 4, 0, 4).shape == (4, 4, 4)
        assert (tmp_path / "a").exists()
    assert not (tmp_path / "a").exists()
    layer.close()
    assert (tmp_path / "b").exists()


def test_an_area_does_not_grow_without_end():
    with pytest.raises(OrthoSwarmError, match="too far"):
        small_area(0.01).grown(BoundingBox(EAST - 90_000, NORTH - 90_000, EAST, NORTH))


def test_tiles_of_512_pixels_stay_aligned_when_an_area_grows():
    area = small_area(0.137)
    grown = area.grown(BoundingBox(area.bounds[0] - 1000, area.bounds[1], area.bounds[2], area.bounds[3] + 333))
    side = 512 * area.gsd_m
    for a, b in zip(area.bounds, grown.bounds, strict=True):
        assert ((a - b) / side) == pytest.approx(round((a - b) / side), abs=1e-6)
    assert MapArea.from_document(grown.document()) == grown


@settings(max_examples=20)
@given(st.integers(0, 255), st.integers(0, 255))
def test_edges_do_not_darken(value, alpha):
    source = np.zeros((40, 40, 4), np.uint8)
    source[:, :20] = (value, value, value, 255)
    patch = np.stack(np.meshgrid(np.linspace(5, 35, 256), np.linspace(-35, -5, 256)), -1)
    tile = resampled(source, GroundGrid(epsg=EPSG, west=0, north=0, gsd_m=1, width=40, height=40), patch)
    shown = tile[..., 3] > 8
    assert np.abs(tile[..., :3][shown].astype(int) - value).max() <= 2
    lower = np.full((256, 256, 4), (10, 20, 30, alpha), np.uint8)
    np.testing.assert_array_equal(over(tile, lower)[..., :3][tile[..., 3] == 255], tile[..., :3][tile[..., 3] == 255])


def test_a_basemap_that_is_cut_short_is_refused_before_anybody_flies(tmp_path):
    write_map(made_up_ground(), tmp_path / "map.tif")
    whole = (tmp_path / "map.tif").read_bytes()
    assert open_basemap(tmp_path / "map.tif") is not None
    (tmp_path / "cut.tif").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.tif is cut short"):
        open_basemap(tmp_path / "cut.tif")


def test_a_basemap_across_the_date_line_lies_in_a_zone_beside_it(tmp_path):
    """Not in that of the mean of 179.998 and -179.998 degrees, on the other side of the world."""
    values = np.random.default_rng(0).integers(0, 255, (3, 400, 400), dtype=np.uint8)
    east, north = LocalGrid(32701).to_grid(-17.0, 180.0)
    profile = {"driver": "GTiff", "width": 400, "height": 400, "count": 3, "dtype": "uint8", "crs": "EPSG:32701"}
    with rasterio.open(
        tmp_path / "map.tif", "w", **profile, transform=from_origin(east - 200.0, north + 200.0, 1, 1)
    ) as file:
        file.write(values)
    assert open_basemap(tmp_path / "map.tif").epsg in (32701, 32760)
