"""How far each place of an orthoimage can be trusted: what stands before it, who sees it, and how well it is held."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.confidence import ORIENTATION_ONLY, confidence, drawn_cells, trim_edge
from orthoswarm.mosaic.renderer import render
from tests.kit import mosaic_scene as scene

ROOF_M = 10.0


def with_box(on_top: bool) -> Terrain:
    """Level ground with a box of 40 x 40 m in the middle, drawn on its top or on the ground."""
    bare = scene.terrain_of(scene.level, step_m=2.0, reach_m=200.0)
    nodes = np.arange(bare.z.shape[0]) * 2.0 - 200.0
    inside = (np.abs(nodes)[:, None] <= 20.0) & (np.abs(nodes) <= 20.0)
    tops = np.where(inside, np.float32(ROOF_M), bare.z)
    return replace(bare, z=tops if on_top else bare.z, bare=bare.z, tops=tops)


@pytest.fixture
def drawn(tmp_path):
    def draw(terrain, **of_frames):
        flight = scene.survey(1, tilt_deg=0.0)
        frames = [replace(f, **{"sigma_m": 0.02, "stage": "fine"} | of_frames) for f in flight.frames]
        canvas = Canvas.create(tmp_path / "canvas", scene.grid(260.0), plane="frame", tile_px=128)
        render(frames, terrain, canvas, read=flight.read)
        found = confidence(*drawn_cells(canvas), frames, terrain, [None] * len(frames))
        canvas.close()
        return frames, found

    return draw


def at(found, east, north):
    """Row and column of a place, metres from the scene's middle."""
    column, row = np.round(found.grid.to_pixel([scene.EAST + east, scene.NORTH + north])).astype(int)
    return row, column


def tangent(found, cell):
    return np.tan(np.radians(found.angle_deg[cell]))


def test_a_roof_drawn_on_the_ground_leans_by_its_height_times_the_tangent(drawn):
    _, found = drawn(with_box(on_top=False))
    for place in [(0.0, 0.0), (8.0, 3.0), (-6.0, 9.0)]:
        cell = at(found, *place)
        assert found.lean_m[cell] == pytest.approx(ROOF_M * tangent(found, cell), abs=2.0)  # a node
    assert found.good_to_m[at(found, 0.0, 0.0)] >= 2.0


def test_a_roof_drawn_on_its_top_is_right_but_for_its_edges_and_what_it_hides(drawn):
    _, found = drawn(with_box(on_top=True))
    assert found.lean_m[at(found, 0.0, 0.0)] == 0.0 and found.lean_m[at(found, 10.0, 10.0)] == 0.0
    edge = at(found, 20.0, 0.0)
    assert found.lean_m[edge] > 1.0
    assert np.nanmax(found.lean_m) < 2.0 * ROOF_M
    row, column = np.nonzero(found.hidden)
    away = np.abs(found.grid.to_ground(np.column_stack([column, row])) - [scene.EAST, scene.NORTH]).max(1)
    assert len(away) and (away > 18.0).all() and (found.lean_m[found.hidden] > 0.5).all()
    assert 0.0 < found.figures()["hidden_share"] < 0.1


def test_open_ground_is_as_good_as_its_pictures(drawn):
    frames, found = drawn(with_box(on_top=False))
    nadir = frames[0].camera.nadir
    below = at(found, nadir[0] - scene.EAST, nadir[1] - scene.NORTH)
    assert found.lean_m[below] == 0.0 and found.good_to_m[below] == np.float32(0.2)
    aside = np.isfinite(found.good_to_m) & (found.lean_m == 0.0) & (found.angle_deg > 30.0)
    assert (found.good_to_m[aside] >= 0.5).all()  # low things lean there


def test_where_one_picture_sees_the_ground_no_height_is_known(drawn):
    _, found = drawn(Terrain.flat(0.0))
    single = (found.pictures == 1) & np.isfinite(found.good_to_m) & (found.angle_deg > 20.0)
    assert single.any() and (found.lean_m[single] > 1.0).all()
    many = (found.pictures >= 3) & np.isfinite(found.good_to_m)
    assert (found.lean_m[many] == 0.0).all()
    assert found.figures()["single_picture_share"] > 0.0


def test_pictures_that_no_map_holds_are_good_against_each_other(drawn):
    frames, found = drawn(Terrain.flat(0.0), stage="coarse", sigma_m=3.0)
    assert found.whole_m == pytest.approx(6.6)
    assert (found.good_to_m[found.angle_deg < 5.0] == np.float32(0.2)).all()
    assert frames[0].stage == "coarse"


def test_recorded_poses_are_for_orientation(drawn):
    _, found = drawn(Terrain.flat(0.0), stage="realtime", sigma_m=3.0)
    assert found.whole_m == 0.0
    assert (found.good_to_m[np.isfinite(found.good_to_m)] == ORIENTATION_ONLY).all()
    assert set(found.figures()["doubtful_sides"]) == {"north", "east", "south", "west"}


def test_an_object_that_several_pictures_show_is_cut(drawn):
    _, found = drawn(with_box(on_top=True))
    assert (found.objects, found.cut) == (1, 1)


def test_a_trimmed_outline_has_no_teeth_and_keeps_what_several_pictures_see(tmp_path):
    flight = scene.survey(1, tilt_deg=0.0)
    frames = [replace(f, sigma_m=0.02, stage="fine") for f in flight.frames]
    canvas = Canvas.create(tmp_path / "canvas", scene.grid(260.0), plane="frame", tile_px=128)
    render(frames, Terrain.flat(0.0), canvas, read=flight.read)
    before = confidence(*drawn_cells(canvas), frames, Terrain.flat(0.0), [None] * len(frames))
    whole = canvas.read_plane(0, canvas.grid.height, 0, canvas.grid.width) > 0
    trim_edge(canvas, frames, Terrain.flat(0.0))
    left = canvas.read_plane(0, canvas.grid.height, 0, canvas.grid.width) > 0
    assert (canvas.read(0, canvas.grid.height, 0, canvas.grid.width)[..., 3] > 0).tolist() == left.tolist()
    assert not (left & ~whole).any() and 0.6 * whole.sum() < left.sum() < whole.sum()
    cell = np.floor(before.grid.to_pixel(canvas.grid.to_ground(np.argwhere(whole & ~left)[:, ::-1])) + 0.5).astype(int)
    count = before.pictures[tuple(cell.clip(0, np.array(before.pictures.shape)[::-1] - 1).T[::-1])]
    assert np.mean(count < 3) > 0.8  # the rest are the corners that were rounded
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(5.0 / canvas.grid.gsd_m) + 1,) * 2)
    round_ = [cv2.morphologyEx(m.astype(np.uint8), cv2.MORPH_OPEN, disc).sum() / m.sum() for m in (whole, left)]
    assert 1.0 - round_[1] < min(0.2 * (1.0 - round_[0]), 0.002)
    canvas.close()
