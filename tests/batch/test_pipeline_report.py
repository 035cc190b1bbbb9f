"""The parts of the report: charts, shifts against a map, remembered results."""

import pickle
from xml.etree import ElementTree

import numpy as np
import pytest

from orthoswarm.batch.map_pictures import vehicles_warnings
from orthoswarm.batch.workspace import Workspace, run_key
from orthoswarm.compute.stage_times import Clock
from orthoswarm.compute.workers import Usage
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import GroundGrid
from orthoswarm.report.page import PALETTE, fields_of_view, time_bars
from orthoswarm.report.report_pictures import (
    Picture,
    draw_arrows,
    draw_lines,
    fill_polygons,
    moved,
    scale_bar,
    view_grid,
)
from tests.kit.looks.colour_vision import least_difference, rgb_of
from tests.kit.scene import Scene

GRID = GroundGrid(epsg=32632, west=465_000.0, north=5_250_000.0, gsd_m=0.5, width=900, height=700)


@pytest.mark.parametrize("count", [1, 3, 40])
def test_the_chart_of_fields_of_view_is_sound_svg(count):
    vehicles = [{"id": f"uav<{i}>", "fov_deg": 80.0 + i % 7, "fov_sigma_deg": 0.3} for i in range(count)]
    svg = ElementTree.fromstring(fields_of_view(vehicles))
    circles = list(svg.iter("circle"))
    assert len(circles) == count
    assert all(0 <= float(c.get("cy")) <= 220 and 0 <= float(c.get("cx")) <= 640 for c in circles)
    assert fields_of_view([{"id": "a", "fov_deg": 70.0, "fov_sigma_deg": None}]) is None


def test_the_colours_of_charts_differ_for_those_who_do_not_see_all_colours():
    assert least_difference(PALETTE) > 15
    names = ("load", "realtime", "coarse", "fine", "final")
    stages = [{"name": name, "wall_s": 1.0, "cpu_s": 1.0} for name in names]
    assert least_difference([rgb_of(part["colour"]) for part in time_bars(stages)["legend"]]) > 15


def test_bars_add_up():
    stages = [{"name": "load", "wall_s": 1.0, "cpu_s": 0.0}, {"name": "final: report", "wall_s": 3.0, "cpu_s": 0.0}]
    found = time_bars(stages)
    assert [p["share"] for p in found["bars"][0]["parts"]] == [25.0, 75.0]
    assert sum(p["share"] for p in found["bars"][1]["parts"]) == 0.0


def test_shifts_against_a_map_are_found_with_their_sign():
    gray = Scene().rgb[:700, :900, 1].copy()
    there = np.roll(gray, (2, -6), (0, 1))  # the map has all of it 1 m south and 3 m west
    yes = np.ones(gray.shape, bool)
    found = moved(gray, yes, there, yes, GRID)
    assert len(found.at) > 20 and found.blocks >= len(found.at)
    np.testing.assert_allclose(np.median(found.shift, axis=0), [-3.0, -1.0], atol=0.1)
    west, south, east, north = GRID.bounds
    assert ((found.at > (west, south)) & (found.at < (east, north))).all()


def test_noise_gives_no_arrows():
    rng = np.random.default_rng(5)
    one, other = rng.integers(0, 255, (2, 500, 500), np.uint8)
    yes = np.ones(one.shape, bool)
    assert len(moved(one, yes, other, yes, GRID).at) == 0


def test_drawings_stay_within_the_picture():
    grid = view_grid(32632, GRID.bounds, 300)
    assert max(grid.width, grid.height) <= 301
    picture = Picture(np.zeros((grid.height, grid.width, 3), np.uint8), np.ones((grid.height, grid.width), bool), grid)
    square = np.array([[465_100.0, 5_249_900.0], [465_200.0, 5_249_900.0], [465_200.0, 5_249_800.0]])
    draw_lines(picture, [square + 1e6], (255, 0, 0))
    assert not picture.rgb.any()
    fill_polygons(picture, [square], (0, 200, 0), 0.5)
    draw_lines(picture, [square], (255, 0, 0), closed=True)
    draw_arrows(picture, square[:1], square[1:2], (0, 0, 255))
    scale_bar(picture)
    assert all(picture.rgb[..., i].any() for i in range(3))


def test_a_clock_counts_all_processes():
    used = Usage(0.0, 100.0)
    clock = Clock(lambda: used)
    with clock.stage("load", 5) as stage:
        used = Usage(2.0, 300.0)
    assert clock.stages == [stage] and stage.cpu_s >= 2.0 and stage.items == 5 and stage.wall_s >= 0
    _, cpu, memory = clock.totals()
    assert cpu >= 2.0 and memory > 310


def double(n):
    return 2 * n


def test_results_are_remembered_one_by_one(tmp_path):
    asked = []

    def run(function, items):
        for item in items:
            asked.append(item)
            if item == 3 and asked.count(3) == 1:
                raise KeyboardInterrupt
            yield function(item)

    with Workspace(tmp_path / "out") as space:
        assert not space.begin("key")
        with pytest.raises(KeyboardInterrupt):
            list(space.remembering("v", run)(double, [1, 2, 3, 4]))
    with Workspace(tmp_path / "out") as space:
        assert space.begin("key")
        again = space.remembering("v", run)
        assert list(again(double, [1, 2, 3, 4])) == [2, 4, 6, 8]
        assert list(again(double, [1])) == [2]  # another call is another matter
        assert asked == [1, 2, 3, 3, 4, 1]
    with Workspace(tmp_path / "out") as space:
        assert not space.begin("other key")
        assert space.recall("v-1-0") is None


def test_that_there_is_no_result_is_remembered_as_well(tmp_path):
    asked = []

    def run(function, items):
        asked.extend(items)
        return map(function, items)

    for _ in range(2):
        with Workspace(tmp_path / "out") as space:
            space.begin("key")
            assert list(space.remembering("v", run)(only_even, [1, 2])) == [None, 2]
    assert asked == [1, 2]


def test_the_folder_is_released_only_when_its_files_are_gone(tmp_path, monkeypatch):
    """Another run that takes it loses nothing that it has written by then."""
    left = []
    close = Workspace.close

    def noted(space):
        left.extend(p.name for p in (tmp_path / "out" / ".work").rglob("*"))
        close(space)

    monkeypatch.setattr(Workspace, "close", noted)
    with Workspace(tmp_path / "out") as space:
        space.begin("key")
        space.remember("x", 1)
        space.scratch("tiles")
        space.complete()
        assert left == [] and not (tmp_path / "out" / ".work").exists()
        with Workspace(tmp_path / "out") as next_one:  # before the first is left
            next_one.begin("key")
            file = next_one.scratch("tiles") / "1"
            file.write_text("mine")
            space.__exit__(None, None, None)
            assert file.read_text() == "mine"


def only_even(x):
    return None if x % 2 else x


def test_what_is_damaged_is_done_again(tmp_path):
    with Workspace(tmp_path / "out") as space:
        space.begin("key")
        space.remember("x", {"a": 1})
        assert space.recall("x") == {"a": 1}
        (tmp_path / "out" / ".work" / "x.pickle").write_bytes(pickle.dumps([1] * 100)[:20])
        assert space.recall("x") is None and space.recall("never") is None


def test_a_run_is_known_by_its_pictures_and_options(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"1")
    frame = Frame(image="a.jpg", path=path, vehicle="v", time_s=1.0, fix=Fix(47.0, 8.0), width=4, height=3)
    first = run_key([frame], "options")
    assert first == run_key([frame], "options") != run_key([frame], "others")
    path.write_bytes(b"22")
    assert first != run_key([frame], "options")


def test_a_file_is_no_output_folder(tmp_path):
    (tmp_path / "out").write_text("x")
    with pytest.raises(InputError, match="is a file"):
        Workspace(tmp_path / "out")


def test_what_is_the_same_for_many_vehicles_is_told_once():
    """Forty flights off the map: one sentence, with the first few and how many."""
    off, own = "it lies where its receiver says", "v7: its clock is wrong"
    said = [(f"v{k}", off) for k in range(1, 41)] + [
        ("v7", own),
        ("v8", "its lens is odd"),
        ("v9", "two"),
        ("v8", "two"),
    ]
    assert vehicles_warnings(said) == [
        f"40 vehicles (v1, v2, v3 and 37 more), of each: {off}",
        own,
        "v8: its lens is odd",
        "2 vehicles (v9, v8), of each: two",
    ]
