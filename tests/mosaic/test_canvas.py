"""The canvas: sparse, bounded in memory, versioned, readable at any scale, and whole after a kill."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.canvas.overviews import reduce_rgba
from orthoswarm.model.bounding_box import BoundingBox
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.geo import GroundGrid
from orthoswarm.mosaic.realtime import RealtimeMosaic
from tests.kit import mosaic_scene as scene

ROOT = Path(__file__).resolve().parents[2]


def paint(canvas, key, value=200):
    tile = canvas.begin(key)
    tile.rgba[...] = (value, 10, 20, 255)
    tile.plane[...] = 1
    canvas.commit(key)


@pytest.fixture
def canvas(tmp_path):
    with Canvas.create(
        tmp_path / "canvas",
        GroundGrid(epsg=32648, west=0.0, north=1000.0, gsd_m=1.0, width=1000, height=700),
        tile_px=128,
    ) as canvas:
        yield canvas


def test_what_is_drawn_is_read_back_across_tiles(canvas):
    rng = np.random.default_rng(0)
    whole = np.zeros((canvas.tile_rows * 128, canvas.tile_cols * 128, 4), np.uint8)
    for key in [(0, 0), (0, 1), (1, 1), (5, 7)]:
        part = rng.integers(0, 256, (128, 128, 4), np.uint8)
        canvas.begin(key).rgba[...] = part
        canvas.commit(key)
        whole[key[0] * 128 : key[0] * 128 + 128, key[1] * 128 : key[1] * 128 + 128] = part
    for window in [(0, 700, 0, 1000), (100, 300, 50, 260), (640, 700, 900, 1000), (127, 129, 127, 129)]:
        r0, r1, c0, c1 = window
        assert (canvas.read(*window) == whole[r0:r1, c0:c1]).all()
    assert not canvas.read(300, 400, 300, 400).any()
    assert canvas.read(-5, 5, -5, 5).shape == (10, 10, 4)  # beyond the edge it is transparent


def test_hundred_square_kilometres_at_a_decimetre_just_work(tmp_path):
    grid = GroundGrid(epsg=32648, west=300000.0, north=4000000.0, gsd_m=0.1, width=100_000, height=100_000)
    with Canvas.create(tmp_path / "big", grid, memory_mb=20.0) as canvas:
        for key in [(0, 0), (97, 100), (195, 195)]:
            paint(canvas, key)
        view, view_grid = canvas.read_ground(grid.bounds, gsd_m=10.0)
        assert view_grid.gsd_m == pytest.approx(6.4)
        assert view.shape == (1563, 1563, 4)
        assert view[0, 0].tolist() == [200, 10, 20, 255]
        assert view[97 * 8 : 98 * 8, 100 * 8 : 101 * 8, 3].min() == 255
        assert np.count_nonzero(view[..., 3]) == 2 * 64 + 3 * 3
    assert disk_usage(tmp_path / "big") < 12e6  # three tiles of 2 MB, their overviews, and the index


def test_memory_stays_within_the_bound(tmp_path):
    grid = GroundGrid(epsg=32648, west=0.0, north=0.0, gsd_m=1.0, width=128 * 20, height=128 * 20)
    with Canvas.create(tmp_path / "c", grid, tile_px=128, memory_mb=1.0) as canvas:
        for r in range(20):
            for c in range(20):
                paint(canvas, (r, c), value=r * 10)
        assert canvas.mapped_mb <= 1.0
        assert (canvas.read(0, 2560, 0, 1)[:, 0, 0] == np.repeat(np.arange(20) * 10, 128)).all()
        assert canvas.mapped_mb <= 1.0


def test_versions_tell_exactly_what_changed(canvas):
    assert canvas.version == 0 and canvas.changed_since(0) == []
    paint(canvas, (2, 3))
    paint(canvas, (0, 1))
    seen = canvas.version
    assert canvas.changed_since(0) == [(2, 3), (0, 1)]
    paint(canvas, (2, 3))
    paint(canvas, (1, 1))
    assert canvas.version > seen
    assert canvas.changed_since(seen) == [(2, 3), (1, 1)]
    assert canvas.changed_since(canvas.version) == []
    assert canvas.newest(canvas.tile_bounds((0, 1))) == seen
    assert canvas.newest(canvas.tile_bounds((4, 4))) == 0


def test_begun_but_unchanged_tile_is_not_reported(canvas):
    paint(canvas, (0, 0))
    canvas.begin((0, 0))
    assert canvas.changed_since(1) == []


def test_canvas_opens_again_as_it_was_left(tmp_path):
    grid = GroundGrid(epsg=32648, west=0.0, north=1000.0, gsd_m=0.5, width=300, height=300)
    with Canvas.create(tmp_path / "c", grid, plane="frame", tile_px=64) as canvas:
        paint(canvas, (1, 2))
        version = canvas.version
    with Canvas.open(tmp_path / "c") as again:
        assert (again.grid, again.plane, again.tile_px, again.version) == (grid, "frame", 64, version)
        assert again.read(64, 65, 128, 129).tolist() == [[[200, 10, 20, 255]]]
        assert again.read_plane(64, 65, 128, 129).tolist() == [[1]]
        paint(again, (0, 0))
        assert again.version > version
    with Canvas.at(tmp_path / "c", grid, plane="frame") as same:
        assert same.version > version
    with pytest.raises(InputError, match="another grid"):
        Canvas.at(
            tmp_path / "c",
            GroundGrid(epsg=32648, west=0.0, north=1000.0, gsd_m=1.0, width=300, height=300),
            plane="frame",
        )


def test_lost_index_is_made_anew_from_the_tiles(tmp_path):
    with Canvas.create(
        tmp_path / "c", GroundGrid(epsg=32648, west=0.0, north=0.0, gsd_m=1.0, width=300, height=300), tile_px=64
    ) as canvas:
        paint(canvas, (1, 2))
    (tmp_path / "c" / "versions.u64").unlink()
    with Canvas.open(tmp_path / "c") as again:
        assert again.changed_since(0) == [(1, 2)]


def test_second_process_that_only_reads_follows_the_writer(canvas):
    paint(canvas, (0, 0))
    with Canvas.open(canvas.path, writable=False) as reader:
        assert reader.read(0, 1, 0, 1)[0, 0, 0] == 200
        paint(canvas, (0, 0), value=7)
        paint(canvas, (1, 0), value=8)
        assert reader.version == canvas.version
        assert reader.read(127, 129, 0, 1)[:, 0, 0].tolist() == [7, 8]


def test_adopted_tiles_replace_the_old_ones_for_every_reader(canvas):
    paint(canvas, (0, 0))
    paint(canvas, (0, 1))
    before = canvas.version
    with Canvas.open(canvas.path, writable=False) as reader:
        assert reader.read(0, 1, 0, 1)[0, 0, 0] == 200
        store = canvas.staging("new")
        tile = store.get((0, 0), create=True)
        tile.rgba[...] = 77
        canvas.adopt(store, [(0, 0), (0, 1), (3, 3)])
        for side in (canvas, reader):
            assert side.read(0, 1, 0, 1)[0, 0].tolist() == [77] * 4
            assert not side.read(0, 1, 128, 129).any()
            assert side.changed_since(before) == [(0, 0), (0, 1)]
            assert not side.read_reduced(8, 0, 1, 16, 17).any()


@pytest.mark.parametrize("factor", [2, 4, 8, 16, 32, 64, 128])
def test_reduced_view_is_the_mean_of_the_pixels(canvas, factor):
    rng = np.random.default_rng(factor)
    whole = np.zeros((768, 1024, 4), np.uint8)
    for key in [(0, 0), (1, 1), (2, 1)]:
        part = rng.integers(0, 256, (128, 128, 4), np.uint8)
        part[..., 3] = 255
        canvas.begin(key).rgba[...] = part
        canvas.commit(key)
        whole[key[0] * 128 : key[0] * 128 + 128, key[1] * 128 : key[1] * 128 + 128] = part
    rows, cols = 768 // factor, 1024 // factor
    view = canvas.read_reduced(factor, 0, rows, 0, cols).astype(float)
    alpha = whole[..., 3:].astype(float)
    blocks = (whole[..., :3] * alpha).reshape(rows, factor, cols, factor, 3).sum((1, 3))
    weight = alpha.reshape(rows, factor, cols, factor).sum((1, 3))
    drawn = weight > 0
    assert np.abs(view[..., :3][drawn] - blocks[drawn] / weight[drawn][:, None]).max() <= 1.5
    assert np.abs(view[..., 3] - weight / factor**2).max() <= 1.0
    part = canvas.read_reduced(factor, 1, rows, 2, min(cols, 5))
    assert (part == view[1:, 2 : min(cols, 5)]).all()


def test_reduced_view_follows_what_is_drawn_later(canvas):
    paint(canvas, (0, 0))
    assert canvas.read_reduced(8, 0, 1, 0, 1)[0, 0, 0] == 200
    paint(canvas, (0, 0), value=100)
    assert canvas.read_reduced(8, 0, 1, 0, 1)[0, 0, 0] == 100
    assert canvas.read_reduced(64, 0, 1, 0, 1)[0, 0, 0] == 100


def test_lone_pixel_is_not_lost_in_the_overview():
    picture = np.zeros((64, 64, 4), np.uint8)
    picture[17, 40] = (9, 8, 7, 255)
    assert reduce_rgba(picture, 64).tolist() == [[[9, 8, 7, 1]]]


@settings(max_examples=60, deadline=None)
@given(
    west=st.floats(-50, 1100), south=st.floats(200, 1100), width=st.floats(0.1, 700), height=st.floats(0.1, 500),
    gsd=st.floats(0.3, 40),
)  # fmt: skip
def test_read_ground_covers_what_is_asked_at_the_asked_pixel(shared_canvas, west, south, width, height, gsd):
    bounds = BoundingBox(west, south, west + width, south + height)
    view, grid = shared_canvas.read_ground(bounds, gsd)
    assert view.shape == (grid.height, grid.width, 4)
    assert grid.gsd_m <= max(1.0, gsd * 1.001) < grid.gsd_m * 2.01
    if view.size:
        inner = shared_canvas.grid.bounds
        assert grid.west <= max(west, inner[0]) + 1e-3 and grid.north >= min(bounds[3], inner[3]) - 1e-3
        assert grid.bounds[2] >= min(bounds[2], inner[2]) - 1e-3 and grid.bounds[1] <= max(south, inner[1]) + 1e-3


@pytest.fixture(scope="module")
def shared_canvas(tmp_path_factory):
    grid = GroundGrid(epsg=32648, west=0.0, north=1000.0, gsd_m=1.0, width=1000, height=700)
    with Canvas.create(tmp_path_factory.mktemp("shared") / "c", grid, tile_px=128) as canvas:
        paint(canvas, (1, 1))
        yield canvas


def test_full_disk_is_an_error_and_leaves_nothing_half_made(canvas, monkeypatch):
    paint(canvas, (0, 0))
    monkeypatch.setattr("orthoswarm.canvas.tile_store._zeros", lambda size: bytes(size // 2))  # half of it is written
    with pytest.raises(OrthoSwarmError, match="free some disk space"):
        canvas.begin((0, 1))
    monkeypatch.undo()
    assert [p.name for p in (canvas.path / "tiles").rglob("*") if p.is_file()] == ["000000.tile"]
    paint(canvas, (0, 1))
    assert canvas.read(0, 1, 128, 129)[0, 0, 0] == 200


def test_wrong_folders_are_refused_in_one_sentence(tmp_path, canvas):
    with pytest.raises(InputError, match="holds no canvas"):
        Canvas.open(tmp_path / "nothing")
    with pytest.raises(InputError, match="holds a canvas already"):
        Canvas.create(canvas.path, canvas.grid)
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "canvas.json").write_text("{}")
    with pytest.raises(InputError, match="unknown format"):
        Canvas.open(tmp_path / "odd")
    with pytest.raises(InputError, match="multiple of 64"):
        Canvas.create(tmp_path / "c", canvas.grid, tile_px=100)


KILLED = """
import sys
from pathlib import Path
from orthoswarm.canvas.canvas import Canvas
from orthoswarm.mosaic.realtime import RealtimeMosaic
from tests.kit import mosaic_scene as scene
flight = scene.survey(8)
mosaic = RealtimeMosaic(Canvas.create(Path(sys.argv[1]), scene.grid(300.0, 0.25), tile_px=256, memory_mb=1.0))
while True:
    for frame in flight.frames:
        print("add", flush=True)
        mosaic.add(flight.read(frame.frame.path), frame.camera)
"""


@pytest.mark.parametrize("adds", [1, 7])
def test_killed_process_leaves_a_canvas_that_goes_on(tmp_path, adds):
    command = [sys.executable, "-c", KILLED, str(tmp_path / "killed")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as process:
        for _ in range(adds):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
    flight = scene.survey(8)
    grid = scene.grid(300.0, 0.25)
    with Canvas.open(tmp_path / "killed") as canvas, Canvas.create(tmp_path / "whole", grid, tile_px=256) as whole:
        rgba, score = canvas.read(0, grid.height, 0, grid.width), canvas.read_plane(0, grid.height, 0, grid.width)
        assert (rgba[..., 3][score > 0] == 255).all()  # what has a score has a colour
        assert {tuple(k) for k in np.argwhere(rgba[..., 3] > 0) // 256} <= set(canvas.changed_since(0))
        for target in (canvas, whole):
            mosaic = RealtimeMosaic(target)
            for frame in flight.frames:
                mosaic.add(flight.read(frame.frame.path), frame.camera)
        assert (canvas.read(0, grid.height, 0, grid.width) == whole.read(0, grid.height, 0, grid.width)).all()
        assert (canvas.read_reduced(8, 0, 100, 0, 100) == whole.read_reduced(8, 0, 100, 0, 100)).all()


def disk_usage(folder):
    return sum(p.stat().st_blocks * 512 for p in folder.rglob("*") if p.is_file())
