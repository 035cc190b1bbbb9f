"""Large swarms in areas: how vehicles are divided, how areas are moved onto each other, and whole runs."""

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.batch.area_refinement import divide, merged_ground
from orthoswarm.batch.pipeline import run
from orthoswarm.batch.run_state import PRODUCTS, MapOptions
from orthoswarm.batch.workspace import Workspace
from orthoswarm.compute.workers import Processes, Serial
from orthoswarm.config import DEFAULT, config_of
from orthoswarm.control.area_adjustment import AreaTie, adjust_areas
from orthoswarm.model.errors import AdjustmentError
from orthoswarm.model.placement import Terrain
from orthoswarm.model.plane_similarity import Similarity
from orthoswarm.refine.strategy.swarm_refiner import SwarmRefiner
from orthoswarm.trajectory.near_paths import near_paths
from telemetry import LoadOptions, load
from tests.kit.scene import Scene, legs

IN_AREAS = config_of({"strategy": {"area_pictures": 40}})
"""The flight of four vehicles with 16 pictures each is divided into two areas."""


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A scene, its shots, a folder with photos of four vehicles side by side, and a map."""
    folder, scene = tmp_path_factory.mktemp("areas"), Scene()
    shots = {}
    for k in range(4):
        own = legs(count=2, photos=8)
        shots[f"v{k}"] = [
            s.__class__(**{n: getattr(s, n) for n in s.__dataclass_fields__} | {"north": s.north + 60 * k - 90})
            for s in own
        ]
        scene.fly(folder / "photos" / f"v{k}", shots[f"v{k}"])
    scene.basemap(folder / "map.tif")
    return scene, shots, folder


def make(folder, out, *, basemap=True, config=IN_AREAS, workers=None, progress=lambda *_: None):
    def read(tell):
        return load([folder / "photos"], progress=tell, options=LoadOptions(exclude=(out,)))

    options = MapOptions(basemap=folder / "map.tif" if basemap else None, config=config)
    return run(read, out, options, workers or Serial(), progress)


@pytest.fixture(scope="module")
def mapped(flight, tmp_path_factory):
    out = tmp_path_factory.mktemp("mapped") / "out"
    return out, make(flight[2], out)


def errors_m(scene, shots, out):
    rows = {r["image"]: r for r in map(json.loads, (out / "frames.jsonl").read_text().splitlines())}
    assert all(row["stage"] != "rejected" for row in rows.values())
    return np.array(
        [scene.error_m(rows[f"{v}/DJI_{i:04d}.JPG"], s) for v, own in shots.items() for i, s in enumerate(own)]
    )


paths = st.lists(
    st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000), st.integers(1, 40)), min_size=1, max_size=25
).map(
    lambda rows: {
        f"v{k}": np.column_stack([e + np.linspace(0.0, 200.0, n), np.full(n, north), np.full(n, 100.0)])
        for k, (e, north, n) in enumerate(rows)
    }
)


@given(paths, st.integers(1, 200))
def test_each_vehicle_belongs_to_one_area_and_all_its_neighbours_are_there(paths, most):
    areas = divide(paths, most)
    assert sorted(v for area in areas for v in area.own) == sorted(paths)
    names, every = list(paths), list(paths.values())
    for area in areas:
        assert area.own and not {*area.own} & {*area.halo}
        assert len(area.own) == 1 or sum(len(paths[v]) for v in area.own) <= most
        near = {names[j] for v in area.own for j in near_paths(paths[v], every)}
        assert near <= {*area.own, *area.halo} if len(areas) > 1 else not area.halo
        assert {*area.halo} <= near


def test_few_pictures_are_one_area():
    paths = {f"v{k}": np.tile([500.0 * k, 0.0, 100.0], (10, 1)) for k in range(10)}
    (area,) = divide(paths, 100)
    assert area.own == tuple(paths) and area.halo == ()


@given(st.integers(0, 2**32 - 1))
def test_areas_that_were_shifted_and_turned_fit_each_other_again(seed):
    """Four areas in a row, the second held by the map: the others are moved to where they were."""
    draw = np.random.default_rng(seed)
    held = [False, True, False, False]
    nadirs = [draw.uniform(-500, 500, (40, 2)) + np.array([1000 * k, 0]) for k in range(4)]
    wrong = []
    for on_map, own in zip(held, nadirs, strict=True):
        values = draw.normal(0, (0.8, 0.8, 1e-3, 1e-3)) * (not on_map)
        wrong.append((Similarity(own.mean(0), values, np.zeros((4, 4))), 0.0 if on_map else draw.normal(0, 0.5)))

    def seen(k, place):
        similarity, up = wrong[k]
        return np.column_stack([similarity.moved(place[:, :2]), place[:, 2] + up])

    ties = []
    for k in range(3):
        for _ in range(30):
            place = np.column_stack(
                [draw.uniform(-500, 500, (8, 2)) + np.array([1000 * k + 500, 0]), np.full(8, 100.0)]
            )
            ties.append(AreaTie(k, k + 1, np.stack([seen(k, place), seen(k + 1, place)])))
    moves = adjust_areas(nadirs, held, ties)
    assert np.abs(moves[1].plane.values).max() < 1e-4
    for tie in ties:
        one, other = (
            np.column_stack([moves[k].plane.moved(p[:, :2]), p[:, 2] + moves[k].up_m])
            for k, p in zip((tie.one, tie.other), tie.place, strict=True)
        )
        assert np.abs(one - other).max() < 0.1
    end = np.array([[3000.0, 0.0]])
    assert (
        np.hypot(*(moves[3].plane.moved(wrong[3][0].moved(end)) - end)[0]) < 1.0
    )  # held by the second, two areas away


def test_areas_without_ties_stay():
    moves = adjust_areas([np.zeros((3, 2)), np.ones((3, 2))], [False, False], [])
    assert all(not move.plane.values.any() and move.up_m == 0.0 for move in moves)


def test_the_ground_is_that_of_the_area_whose_cameras_are_nearest():
    west = Terrain(0.0, 0.0, 2.0, np.full((101, 151), 1.0, np.float32))
    east = Terrain(200.0, 0.0, 1.0, np.full((201, 301), 3.0, np.float32), bare=np.full((201, 301), 2.0, np.float32))
    nadirs = [np.array([[100.0, 100.0]]), np.array([[400.0, 100.0]])]
    joined = merged_ground([west, east], nadirs)
    assert (joined.west, joined.south, joined.step_m) == (0.0, 0.0, 1.0)
    assert joined.height(np.array([[50.0, 50.0], [200.0, 100.0], [300.0, 100.0], [500.0, 200.0]])).tolist() == [
        1,
        1,
        3,
        3,
    ]
    assert joined.bare_ground().height(np.array([[50.0, 50.0], [400.0, 100.0]])).tolist() == [1, 2]
    assert merged_ground([None, None], nadirs) is None
    assert merged_ground([west, None], nadirs).height(np.array([290.0, 100.0])) == 0.0


@pytest.mark.slow
def test_a_run_in_areas_has_all_products_and_its_pictures_lie_as_in_one(flight, mapped, tmp_path):
    scene, shots, folder = flight
    out, report = mapped
    assert {p.name for p in out.iterdir()} == set(PRODUCTS)
    assert [v["id"] for v in report["vehicles"]] == ["v0", "v1", "v2", "v3"]
    assert all(leg["state"] == "matched" for leg in report["legs"])
    make(folder, tmp_path / "one", config=DEFAULT)
    ours, theirs = errors_m(scene, shots, out), errors_m(scene, shots, tmp_path / "one")
    assert np.median(ours) < 1.2 * np.median(theirs) + 0.02 and ours.max() < 1.5


def test_an_area_that_cannot_be_refined_lies_where_its_receivers_say(flight, tmp_path, monkeypatch):
    scene, shots, folder = flight
    refine_batch = SwarmRefiner.refine_batch

    def fails_once(self, vehicles, *args, halo=(), **kwargs):
        if "v0" not in {*vehicles} - {*halo}:
            raise AdjustmentError("nothing fits")
        return refine_batch(self, vehicles, *args, halo=halo, **kwargs)

    monkeypatch.setattr(SwarmRefiner, "refine_batch", fails_once)
    report = make(folder, tmp_path / "out")
    states = {leg["vehicle"]: leg["state"] for leg in report["legs"]}
    assert states == {"v0": "matched", "v1": "matched", "v2": "failed", "v3": "failed"}
    [told] = [warning for warning in report["warnings"] if "nothing fits" in warning]
    assert "v2" in told and "v3" in told
    assert np.median(errors_m(scene, shots, tmp_path / "out")[:32]) < 0.3
    monkeypatch.setattr(
        SwarmRefiner, "refine_batch", lambda *_, **__: (_ for _ in ()).throw(AdjustmentError("nothing"))
    )
    report = make(folder, tmp_path / "none")
    assert any("could not be refined (nothing)" in w for w in report["warnings"]) and not report["legs"]


def test_without_a_map_areas_are_moved_onto_each_other(flight, tmp_path):
    scene, shots, folder = flight
    make(folder, tmp_path / "areas", basemap=False)
    make(folder, tmp_path / "one", basemap=False, config=DEFAULT)
    ours, theirs = errors_m(scene, shots, tmp_path / "areas"), errors_m(scene, shots, tmp_path / "one")
    assert np.median(ours) < 1.2 * np.median(theirs) + 0.3


def test_vehicles_stand_in_their_order_whatever_areas_they_are_in(flight, tmp_path):
    """Folders by name, places from north to south: areas divide them another way."""
    scene, _, folder = flight
    for k, place in enumerate((2, 0, 3, 1)):
        shutil.copytree(folder / "photos" / f"v{place}", tmp_path / "photos" / f"w{k}")
    scene.basemap(tmp_path / "map.tif")
    report = make(tmp_path, tmp_path / "out")
    assert [v["id"] for v in report["vehicles"]] == ["w0", "w1", "w2", "w3"]


@pytest.mark.slow
def test_areas_do_not_depend_on_the_number_of_workers(flight, mapped, tmp_path):
    workers = Processes(2)
    try:
        make(flight[2], tmp_path / "out", workers=workers)
    finally:
        workers.close()
    for name in ("orthoimage.tif", "coarse.tif", "frames.jsonl"):
        assert (tmp_path / "out" / name).read_bytes() == (mapped[0] / name).read_bytes()


@pytest.mark.slow
def test_an_interrupted_run_goes_on_with_its_area_and_solves_no_vehicle_again(flight, mapped, tmp_path, monkeypatch):
    stored, remember = [], Workspace.remember

    def noted(space, name, value):
        stored.append(name)
        remember(space, name, value)

    monkeypatch.setattr(Workspace, "remember", noted)

    def stop(what, *_):
        if "area 2 of 2" in what:
            raise KeyboardInterrupt

    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        make(flight[2], out, progress=stop)
    make(flight[2], out)
    assert (out / "orthoimage.tif").read_bytes() == (mapped[0] / "orthoimage.tif").read_bytes()
    alone = [name for name in stored if " alone-" in name]
    assert len(alone) == len(set(alone)) == 4, "the first pass of a vehicle is done once, whatever areas it is in"
    assert len(stored) == len(set(stored)), "nothing that was stored is done again"
