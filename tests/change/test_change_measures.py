"""The parts of what is measured for a change: structure, offsets of the map, what leans, hues, objects."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.change.change_files import painted
from orthoswarm.change.change_map import ChangeMap, hidden_on_map, local_offsets, shifted
from orthoswarm.change.changed_objects import CHANGED, NEW_OBJECT, find_objects
from orthoswarm.change.evidence import CASES, probabilities
from orthoswarm.change.looks import ToneModel
from orthoswarm.change.seen_ground import heights_on, seen_ground
from orthoswarm.change.structure import structure
from orthoswarm.coverage.view import View
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain

GRID = GroundGrid(epsg=32632, west=500_000.0, north=5_000_000.0, gsd_m=1.0, width=192, height=192)


def texture(seed=0, rows=192, columns=192, blur=1.2):
    noise = np.random.default_rng(seed).normal(size=(rows, columns)).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), blur)
    return (120 + 30 * soft / soft.std()).astype(np.float32)


def in_common(first, second):
    """Correlation of two structures, doubled in angle."""
    a, b = first.field[20:-20, 20:-20, 2:], second.field[20:-20, 20:-20, 2:]
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))


@given(gain=st.floats(0.4, 1.6), offset=st.floats(-40.0, 40.0), turned=st.booleans())
def test_structure_is_the_same_in_other_light_and_where_dark_and_bright_change_places(gain, offset, turned):
    gray = texture()
    other = (255 - gray if turned else gray) * gain + offset
    assert in_common(structure(gray, 1.0), structure(other.astype(np.float32), 1.0)) > 0.95


def test_other_ground_has_no_structure_in_common():
    assert abs(in_common(structure(texture(1), 1.0), structure(texture(2), 1.0))) < 0.1


def test_smooth_ground_has_little_structure():
    noise = np.random.default_rng(3).normal(100.0, 0.5, (192, 192)).astype(np.float32)
    assert structure(noise, 1.0).power.mean() < 0.1 < structure(texture(), 1.0).power.mean()


@given(dx=st.floats(-2.5, 2.5), dy=st.floats(-2.5, 2.5))
def test_a_map_that_lies_some_pixels_beside_its_place_is_measured(dx, dy):
    gray = texture(4)
    wanted = np.empty((*gray.shape, 2), np.float32)
    wanted[..., 0], wanted[..., 1] = dx, dy
    moved = shifted(gray, -wanted)  # a map whose ground lies at +wanted
    found = local_offsets(structure(moved, 1.0).field, structure(gray, 1.0).field)
    assert np.abs(np.median(found, (0, 1)) - [dx, dy]).max() < 0.4


def test_offsets_of_unlike_ground_are_none():
    found = local_offsets(structure(texture(5), 1.0).field, structure(texture(6), 1.0).field)
    assert np.abs(found).max() < 0.01


def test_a_tower_hides_the_ground_onto_which_it_leans():
    height = np.zeros((60, 60), np.float32)
    height[28:32, 28:32] = 20.0
    hidden = hidden_on_map(height, (0.5, 0.0), 1.0)
    assert hidden[30, 33:38].all()  # its top is shown 10 m to the east
    assert not hidden[30, :28].any() and not hidden[:24].any() and not hidden[:, 46:].any()
    assert not hidden_on_map(height, (0.0, 0.0), 1.0).any()


def view(east, north, height=60.0, pixels=200, image="a.jpg"):
    lens = Lens(pixels, pixels, 100.0)
    camera = Camera(np.array([east, north, height]), rotation_from_angles(0.0, -np.pi / 2, 0.0), lens)
    return View.of_camera(camera, image, "v1", 0.1)


def test_pictures_are_averaged_where_they_lie_on_the_ground():
    ground = texture(7, blur=2.0)
    centre = (500_096.0, 4_999_904.0)
    views = [view(*centre), view(centre[0] + 5.0, centre[1], image="b.jpg")]

    def read(one):
        column, row = GRID.to_pixel(one.position[:2])
        x = np.broadcast_to(column + 0.6 * (np.arange(200) - 99.5), (200, 200)).astype(np.float32)
        y = np.broadcast_to((row + 0.6 * (np.arange(200) - 99.5))[:, None], (200, 200)).astype(np.float32)
        return cv2.remap(ground, x, y, cv2.INTER_LINEAR).astype(np.uint8)

    flat = np.zeros((192, 192), np.float32)
    seen = seen_ground(views, GRID, flat, read)
    middle = np.s_[70:122, 70:122]
    assert np.abs(seen.gray[middle] - ground[middle]).mean() < 3.0
    assert seen.weight[96, 96] > 1.5 and seen.weight[2, 2] == 0.0
    assert (seen.same[middle].mean() / seen.power[middle].mean()) > 0.7


def test_what_stands_elsewhere_in_each_picture_is_not_in_common():
    noise = [texture(8, 200, 200).astype(np.uint8), texture(9, 200, 200).astype(np.uint8)]
    views = [view(500_096.0, 4_999_904.0, image="a"), view(500_097.0, 4_999_904.0, image="b")]
    seen = seen_ground(views, GRID, np.zeros((192, 192), np.float32), lambda one: noise[one.image == "b"])
    middle = np.s_[80:112, 80:112]
    assert abs(seen.same[middle].mean()) < 0.25 * seen.power[middle].mean()


def test_an_unreadable_picture_is_left_out():
    seen = seen_ground([view(500_096.0, 4_999_904.0)], GRID, np.zeros((192, 192), np.float32), lambda _: None)
    assert not seen.weight.any()


def test_heights_of_a_terrain_on_a_grid():
    slope = np.add.outer(np.arange(50.0), 2.0 * np.arange(60.0)).astype(np.float32)
    terrain = Terrain(499_990.0, 4_999_790.0, 5.0, slope)
    got = heights_on(GRID, terrain, terrain.z)
    columns, rows = np.meshgrid(np.arange(192), np.arange(192))
    assert np.abs(got - terrain.height(GRID.to_ground(np.stack([columns, rows], -1)))).max() < 0.05


def test_hues_of_another_season_are_expected_and_another_hue_is_not():
    random = np.random.default_rng(10)
    palette = random.uniform(30, 220, (12, 3)).astype(np.float32)
    before = palette[random.integers(0, 12, (80, 80))] + random.normal(0, 3, (80, 80, 3)).astype(np.float32)
    mixed = before @ np.array([[0.6, 0.2, 0.1], [0.3, 0.7, 0.2], [0.1, 0.1, 0.7]], np.float32).T
    now = mixed.copy()
    now[30:40, 30:40] = (60, 200, 40)
    tone = ToneModel.of(before, now, np.ones((80, 80), bool))
    far, difference = tone.differs(before, now)
    same = np.ones((80, 80), bool)
    same[30:40, 30:40] = False
    assert np.median(far[same]) < 4.0 < np.median(far[~same])
    assert np.median(difference[same]) < 0.5 * np.median(difference[~same])


def test_a_scene_too_small_to_tell_its_tones_tells_nothing_by_hue():
    few = np.full((3, 3, 3), 100.0, np.float32)
    far, _ = ToneModel.of(few, few, np.ones((3, 3), bool)).differs(few, few + 90.0)
    assert not far.any()


@given(st.integers(0, 1000))
def test_probabilities_of_the_cases_add_up_to_one(seed):
    values = np.random.default_rng(seed).normal(0.0, 20.0, (4, 5, 36)).astype(np.float32)
    found = probabilities(values)
    assert found.shape == (4, 5, len(CASES)) and np.allclose(found.sum(-1), 1.0, atol=1e-5) and (found >= 0.0).all()


@pytest.fixture
def change_map():
    found = ChangeMap.blank(GroundGrid(epsg=32632, west=500_000.0, north=5_000_000.0, gsd_m=2.0, width=60, height=50))
    found.visible[:] = found.inside[:] = True
    found.case[:] = CASES.index("rubble or earth")
    found.probability[5:15, 5:25] = 240  # 800 m2
    found.probability[30:34, 30:34] = 200  # 64 m2
    found.probability[40, 40] = 255  # one cell
    return found


def test_objects_begin_with_the_largest_and_small_ones_are_left_out(change_map):
    seen = view(500_030.0, 4_999_980.0)
    first, second = find_objects(change_map, [seen], 0.0)
    assert (first.area_m2, second.area_m2) == (800.0, 64.0)
    assert first.kind == "rubble or earth" and first.probability == pytest.approx(240 / 255, abs=0.01)
    assert first.outline.bounds == (500_010.0, 4_999_970.0, 500_050.0, 4_999_990.0)
    assert first.photos == (("v1", "a.jpg"),)


def test_a_higher_threshold_lists_less(change_map):
    assert [one.area_m2 for one in find_objects(change_map, [], 0.0, 0.9)] == [800.0]


def test_hidden_ground_is_no_object(change_map):
    change_map.visible[:20] = False
    assert [one.area_m2 for one in find_objects(change_map, [], 0.0)] == [64.0]


def test_water_beside_rubble_is_an_object_of_its_own(change_map):
    change_map.case[5:15, 15:25] = CASES.index("water")
    kinds = {one.kind: one.area_m2 for one in find_objects(change_map, [], 0.0)}
    assert kinds["water"] == 400.0


def test_a_kind_that_is_not_sure_is_not_said_but_that_something_stands_there_now(change_map):
    change_map.case[5:15, 5:15] = CASES.index("building gone or roof damaged")
    change_map.case[30:34, 30:32] = CASES.index("building gone or roof damaged")
    change_map.height[30:34, 30:34] = 4.0
    assert [one.kind for one in find_objects(change_map, [], 0.0)] == [CHANGED, NEW_OBJECT]


def test_the_overlay_shows_what_changed_and_what_cannot_be_said():
    chance = np.array([[0, 255, 140, 100]], np.uint8)
    visible, inside = np.array([[255, 255, 255, 0]], np.uint8), np.array([[1, 1, 1, 1]], np.uint8)
    out = painted(chance, visible, inside, 0.5)[0]
    assert out[0, 3] == 0 and out[1, 3] > 0 and out[2, 3] > 0 and (out[3, :3] == (90, 100, 115)).all()
    assert painted(chance, visible, inside, 0.9)[0, 2, 3] == 0
