"""The grid that views are put into: replacing views, terrain, distortion, the frames.jsonl seam."""

from dataclasses import replace

import numpy as np
import shapely

from orthoswarm.coverage.coverage_grid import Cells, CellState, CoverageGrid
from orthoswarm.coverage.view import View
from orthoswarm.export.product_files import frame_row
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.placement import Terrain
from tests.kit.flown_area import CORNER, EPSG, FlownArea


def _cells(width: float = 400.0, height: float = 300.0) -> Cells:
    return Cells.of_area(EPSG, shapely.box(*CORNER, *(CORNER + np.array([width, height]))))


def test_putting_in_parts_and_replacing_equals_putting_at_once() -> None:
    views = [View.of_frame(p) for p in FlownArea(dropped={(3, 5)}).placed()]
    moved = [replace(v, position=v.position + np.array([7.0, -4.0, 3.0])) for v in views]
    once = CoverageGrid(_cells())
    once.put(views)
    parts = CoverageGrid(_cells())
    for k in range(0, len(views), 7):
        parts.put(moved[k : k + 7])
    for k in range(0, len(views), 11):
        parts.put(views[k : k + 11])
    assert np.array_equal(once.best, parts.best) and np.array_equal(once.good, parts.good)


def test_cells_are_planned_until_the_flight_is_complete() -> None:
    cover = CoverageGrid(_cells())
    assert cover.put([]) is None
    assert set(np.unique(cover.states(due=False))) == {CellState.PLANNED}
    assert set(np.unique(cover.states())) == {CellState.MISSED}


def test_a_view_sees_what_its_camera_projects_into_the_picture() -> None:
    """A tilted camera with a distorted lens over hills, against Camera.project; also through a line of frames.jsonl."""
    lens = Lens(1600, 1200, 1400.0, k1=-0.12, k2=0.03)
    camera = Camera(
        np.array([CORNER[0] + 200.0, CORNER[1] + 150.0, 90.0]), rotation_from_angles(0.7, np.radians(-70), 0.1), lens
    )
    terrain = Terrain(
        CORNER[0], CORNER[1], 20.0, np.random.default_rng(1).uniform(-10, 10, (20, 25)).astype(np.float32)
    )
    cells = _cells()
    columns, rows = np.meshgrid(np.arange(cells.grid.width), np.arange(cells.grid.height))
    ground = cells.grid.to_ground(np.stack([columns, rows], -1))
    pixel = camera.project(np.concatenate([ground, terrain.height(ground)[..., None]], -1))
    inside = ((pixel > -0.5) & (pixel < [1599.5, 1199.5])).all(-1)
    placed = replace(FlownArea().placed()[0], camera=camera)
    row = frame_row(placed, FlownArea().grid, 0.0)
    for view in (View.of_frame(placed), View.of_row(row, 0.0, FlownArea().grid)):
        cover = CoverageGrid(cells, terrain)
        cover.put([view])
        assert inside.sum() > 2000 and ((cover.best != 255) != inside).sum() <= 3


def test_oblique_views_are_poor() -> None:
    camera = Camera(
        np.array([*CORNER, 80.0]), rotation_from_angles(0.8, np.radians(-35), 0.0), Lens(1600, 1200, 1400.0)
    )
    cover = CoverageGrid(_cells())
    cover.put([View.of_camera(camera, "a", "v1", 0.1)])
    state = cover.states()
    columns, rows = np.nonzero(state == CellState.POOR)[::-1], np.nonzero(state == CellState.SEEN)[::-1]
    near = np.hypot(*(cover.cells.grid.to_ground(np.stack(rows, -1)) - CORNER).T)
    far = np.hypot(*(cover.cells.grid.to_ground(np.stack(columns, -1)) - CORNER).T)
    assert len(far) > 1000 and near.max() <= 80.0 < np.median(far)


def test_a_view_of_unknown_error_counts_nowhere_as_well_seen() -> None:
    cover = CoverageGrid(_cells())
    cover.put([View.of_frame(p) for p in FlownArea(sigma_m=float("nan")).placed()])
    assert cover.shares().seen == 0.0 and cover.shares().poor == 1.0


def test_a_view_with_ground_of_its_own_sees_what_it_sees_on_a_grid_with_that_ground() -> None:
    hills = np.random.default_rng(2).uniform(-20, 20, (20, 25)).astype(np.float32)
    terrain = Terrain(CORNER[0], CORNER[1], 20.0, hills)
    views = [View.of_frame(p) for p in FlownArea(vehicles=1).placed()]
    common, own = CoverageGrid(_cells(), terrain), CoverageGrid(_cells())
    common.put(views)
    own.put(replace(v, ground=terrain) for v in views)
    assert np.array_equal(common.best, own.best) and np.array_equal(common.good, own.good)


def test_removed_pictures_are_seen_no_longer() -> None:
    views = [View.of_frame(p) for p in FlownArea().placed()]
    without, removed = CoverageGrid(_cells()), CoverageGrid(_cells())
    without.put(views[:-9])
    removed.put(views)
    removed.put([], [(v.vehicle, v.image) for v in views[-9:]])
    assert np.array_equal(without.good, removed.good) and len(removed.views) == len(views) - 9
