"""Surveyed points move a block onto the ground: shift, turn, scale, mistakes among them, sigma, photos and terrain."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthoswarm.control.control_observations import ControlObservation, check_control
from orthoswarm.control.ground_control import place_on_control
from orthoswarm.control.similarity import fit_similarity
from orthoswarm.evaluation.checkpoints import Checkpoint, Mark
from orthoswarm.model.camera import Camera, Lens, rotation_from_angles
from orthoswarm.model.errors import InputError
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import Leg, PlacedFrame, Refinement, Solution, Terrain

GRID = LocalGrid(32632)
MIDDLE = np.array([690_000.0, 5_330_000.0])
LENS = Lens(1600, 1200, 1300.0, k1=-0.12, k2=0.03)
TURN, SCALE, SHIFT = 0.01, 1.004, np.array([6.0, -4.0])
NADIRS = MIDDLE + np.array([[e, n] for e in (-60.0, 0.0, 60.0) for n in (-60.0, 0.0, 60.0)])


def distorted(xy: np.ndarray) -> np.ndarray:
    """Where a block that is shifted, turned and scaled has ground points."""
    c, s = SCALE * np.cos(TURN), SCALE * np.sin(TURN)
    return MIDDLE + SHIFT + (xy - MIDDLE) @ np.array([[c, s], [-s, c]])


def truth(shape=(12,), seed=1) -> np.ndarray:
    return MIDDLE + np.random.default_rng(seed).uniform(-70, 70, (*shape, 2))


def observed(surveyed, placed, sigma=0.1):
    return [ControlObservation(f"p{k}", p, s, sigma) for k, (s, p) in enumerate(zip(surveyed, placed, strict=True))]


def test_many_points_give_shift_turn_and_scale_back():
    points = truth()
    fit = fit_similarity(observed(points, distorted(points), 0.01), NADIRS, 5.0)
    assert np.abs(fit.similarity.moved(distorted(NADIRS)) - NADIRS).max() < 0.02
    assert np.allclose(fit.similarity.back(fit.similarity.moved(NADIRS)), NADIRS, atol=1e-6)
    assert not fit.left_out and not fit.contradiction


def test_one_point_shifts_the_block_and_turns_it_hardly():
    point = truth((1,))
    fit = fit_similarity(observed(point, point + SHIFT), NADIRS, 0.5)
    assert fit.similarity.moved(point + SHIFT) == pytest.approx(point, abs=0.01)
    assert np.abs(fit.similarity.moved(NADIRS) - (NADIRS - SHIFT)).max() < 0.05
    near, far = fit.similarity.sigma_m(point[0] + SHIFT), fit.similarity.sigma_m(point[0] + 300.0)
    assert 0.09 < near < 0.11 and far > 1.0


def test_a_mistaken_point_is_found_and_left_out():
    points = truth((6,))
    placed = points + SHIFT + np.random.default_rng(2).normal(0, 0.1, points.shape)
    surveyed = points.copy()
    surveyed[4] += [0.0, 30.0]
    fit = fit_similarity(observed(surveyed, placed), NADIRS, 0.5)
    assert [o.name for o in fit.left_out] == ["p4"]
    assert np.abs(fit.similarity.moved(NADIRS + SHIFT) - NADIRS).max() < 0.3


@pytest.mark.parametrize("sigma", [0.05, 1.5])
def test_points_without_a_sigma_are_believed_as_far_as_they_agree(sigma):
    rng, errors, sigmas, left_out = np.random.default_rng(6), [], [], 0
    for seed in range(100):
        surveyed = truth((9,), seed)
        points = [
            ControlObservation(f"p{k}", p + SHIFT, p + rng.normal(0, sigma, 2), 0.05, stated=False)
            for k, p in enumerate(surveyed)
        ]
        points[4] = replace(points[4], surveyed=points[4].surveyed + np.array([0.0, 28.0]))
        fit = fit_similarity(points, NADIRS, 0.5)
        assert "p4" in [o.name for o in fit.left_out]
        left_out += len(fit.left_out) - 1
        errors.append(fit.similarity.moved(MIDDLE + SHIFT) - MIDDLE)
        sigmas.append(float(fit.similarity.sigma_m(MIDDLE + SHIFT)))
    assert left_out < 0.02 * 8 * 100  # of right points
    within = np.abs(errors) / np.array(sigmas)[:, None]
    assert 0.5 < (within < 1).mean() < 0.95 and (within < 2).mean() > 0.88


def test_two_points_that_contradict_each_other_are_told():
    points = truth((2,))
    surveyed = points + np.array([[0.0, 0.0], [9.0, 0.0]])
    fit = fit_similarity(observed(surveyed, points), NADIRS, 0.5)
    assert fit.contradiction and not fit.left_out
    assert fit.similarity.sigma_m(MIDDLE) > 1.0


@pytest.mark.parametrize("points", [1, 3, 8])
def test_the_stated_sigma_is_that_of_the_error(points):
    rng = np.random.default_rng(5)
    errors, sigmas = [], []
    for seed in range(150):
        surveyed = truth((points,), seed)
        placed = surveyed + SHIFT + rng.normal(0, 0.2, surveyed.shape)
        fit = fit_similarity(observed(surveyed, placed, 0.2), NADIRS, 1e-3).similarity
        errors.append(fit.moved(MIDDLE + SHIFT) - MIDDLE)
        sigmas.append(float(fit.sigma_m(MIDDLE + SHIFT)))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.sqrt(np.mean(np.square(sigmas))), rel=0.25)


def block(stage="fine", move=distorted) -> tuple[dict[str, Camera], Refinement]:
    """True cameras over ground that slopes, and what a refiner made of them: all of it moved."""
    cameras, placed = {}, []
    for k, nadir in enumerate(NADIRS):
        rotation = rotation_from_angles(0.3 * k, np.radians(-86.0), 0.02)
        cameras[f"a/{k}.jpg"] = Camera(np.array([*nadir, 90.0]), rotation, LENS)
        c, s = np.cos(TURN), np.sin(TURN)
        about_up = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        moved = Camera(np.array([*move(nadir), 90.0 * SCALE]), about_up @ rotation, LENS)
        frame = Frame(
            image=f"a/{k}.jpg",
            path=Path("x"),
            vehicle="a",
            time_s=None,
            fix=Fix(48.0, 11.0),
            width=LENS.width,
            height=LENS.height,
        )
        placed.append(PlacedFrame(frame, moved, stage, 0.1))
    step = 10.0
    e, n = np.meshgrid(np.arange(-300, 301, step), np.arange(-300, 301, step))
    west, south = MIDDLE + SHIFT - 300.0
    slope = SCALE * 0.02 * ((np.stack([e, n], -1) @ np.array([np.cos(TURN), np.sin(TURN)])) / SCALE)
    terrain = Terrain(float(west), float(south), step, slope.astype(np.float32))
    return cameras, Refinement(
        [],
        [
            Solution(
                vehicle="a",
                placed=placed,
                dropped={},
                legs=[
                    Leg(vehicle="a", first=0, last=8, images=("0", "8"), state="matched", confidence=1.0, sigma_m=0.1)
                ],
                fov_deg=63.0,
                fov_sigma_deg=0.1,
                terrain=None,
            )
        ],
        terrain,
    )


def surveyed_points(cameras, sigma=0.02) -> list[Checkpoint]:
    out = []
    for k, xy in enumerate(truth((8,), 4)):
        point = np.array([*xy, 0.02 * (xy - MIDDLE)[0]])
        lat, lon = GRID.to_geographic(xy)
        marks = []
        for image, camera in cameras.items():
            column, row = camera.project(point)
            if 0 <= column < LENS.width and 0 <= row < LENS.height:
                marks.append(Mark(image, float(column), float(row)))
        out.append(Checkpoint(f"p{k}", np.array([lon, lat]), sigma, marks))
    return out


def test_photos_and_terrain_move_together():
    cameras, refinement = block()
    moved, did = place_on_control(refinement, surveyed_points(cameras), GRID, None)
    # 1 % of turn and 0.4 % of scale are many times what a map is wrong by: allowed for as far as the prior does
    assert did.on_map is not None and len(did.on_map.used) == 8 and did.by_receivers is None
    for p in moved.fine[0].placed:
        true = cameras[p.frame.image]
        assert np.abs(p.camera.position - true.position).max() < 0.25
        assert np.abs(p.camera.rotation - true.rotation).max() < 0.003
        assert 0.1 < p.sigma_m < 0.3
    assert moved.fine[0].legs[0].sigma_m == np.median([p.sigma_m for p in moved.fine[0].placed])
    at = truth((20,), 9)
    assert np.abs(moved.terrain.height(at) - 0.02 * (at - MIDDLE)[:, 0]).max() < 0.1
    assert did.document()["shift_m"]["east"] == pytest.approx(-SHIFT[0], abs=0.2)
    assert did.warnings == []
    assert refinement.fine[0].placed[0].camera.nadir == pytest.approx(distorted(NADIRS[0]))


def test_marks_that_miss_each_other_are_told_and_cost_certainty():
    cameras, refinement = block()
    point = max(surveyed_points(cameras), key=lambda p: len(p.marks))
    right, last = point.marks[:-1], point.marks[-1]
    assert len(right) > 1
    wrong = Mark(last.image, last.column + (100.0 if last.column < 800 else -100.0), last.row)
    _, clean = place_on_control(refinement, [replace(point, marks=right)], GRID, None)
    assert not any("mark" in w for w in clean.warnings)
    _, found = place_on_control(refinement, [replace(point, marks=[*right, wrong])], GRID, None)
    assert found.document()["shift_m"] == pytest.approx(clean.document()["shift_m"], abs=0.01)
    assert any(f"mark in {wrong.image} was left out" in w for w in found.warnings)
    _, torn = place_on_control(refinement, [replace(point, marks=[right[0], wrong])], GRID, None)
    assert any("contradict each other" in w for w in torn.warnings)
    assert torn.document()["residual_rms_m"] > 0.5
    assert torn.document()["sigma_m"] > 3 * clean.document()["sigma_m"]


def test_photos_in_the_receivers_frame_are_moved_by_their_own_points():
    cameras, refinement = block("coarse")
    moved, did = place_on_control(refinement, surveyed_points(cameras), GRID, None)
    assert did.by_receivers is not None and did.on_map is None
    assert all(p.stage == "coarse" for p in moved.fine[0].placed)
    error = [p.camera.nadir - cameras[p.frame.image].nadir for p in moved.fine[0].placed]
    assert np.abs(error).max() < 0.4  # its turn of 0.7 m at the border is more than the prior expects


def test_a_place_on_the_basemap_is_an_observation_of_what_lies_on_it():
    lat, lon = GRID.to_geographic(MIDDLE)
    map_lat, map_lon = GRID.to_geographic(MIDDLE + np.array([7.0, 0.0]))
    point = Checkpoint("corner", np.array([lon, lat]), on_map=np.array([map_lon, map_lat]))
    _, refinement = block(move=lambda xy: xy + np.array([7.0, 0.0]))
    _, did = place_on_control(refinement, [point], GRID, 0.3)
    assert did.on_map.similarity.values[:2] == pytest.approx([-7.0, 0.0], abs=0.02)
    same, did = place_on_control(refinement, [point], GRID, None)
    assert same is refinement and did.document() is None and "not used" in did.warnings[0]


def test_points_of_another_place_are_refused():
    cameras, refinement = block()
    points = surveyed_points(cameras)
    placed = refinement.fine[0].placed
    check_control(points, placed, GRID, False)
    with pytest.raises(InputError, match="coordinate system"):
        check_control(
            [Checkpoint("x", points[0].surveyed + np.array([1.0, 0.0]), marks=points[0].marks)], placed, GRID, False
        )
    with pytest.raises(InputError, match="names of the images"):
        check_control([Checkpoint("x", points[0].surveyed, marks=[Mark("no.jpg", 1.0, 1.0)])], placed, GRID, False)
    with pytest.raises(InputError, match="--pixel-scale"):
        check_control([Checkpoint("x", points[0].surveyed, marks=[Mark("a/0.jpg", 4e3, 1.0)])], placed, GRID, False)
