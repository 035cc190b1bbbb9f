"""Key pictures: which pictures of a flight are drawn, and that no ground is lost without the others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.placement import PlacedFrame
from orthoswarm.mosaic.key_pictures import key_pictures
from tests.kit import mosaic_scene as scene


def flown(easts, yaws=(), *, vehicle="uav1"):
    """Pictures of one vehicle along a line 100 m above the ground, which see 133 by 178 m each."""
    placed = []
    for k, east in enumerate(easts):
        name = f"{vehicle}_{k:03d}.jpg"
        frame = Frame(
            image=name, path=Path(name), vehicle=vehicle, time_s=None, fix=Fix(0, 0), width=160, height=120
        )  # fmt: skip
        yaw = float(yaws[k]) if len(yaws) else 90.0
        placed.append(PlacedFrame(frame, scene.camera(east=float(east), yaw_deg=yaw), "fine", 0.1))
    return placed


def kept(placed, **how):
    chosen = {p.frame.image for p in key_pictures(placed, 0.0, **how)}
    return [k for k, p in enumerate(placed) if p.frame.image in chosen]


def test_of_pictures_that_overlap_by_nineteen_twentieths_every_second_is_drawn():
    assert kept(flown(np.arange(0, 51, 6))) == [0, 2, 4, 6, 8]


def test_pictures_that_overlap_by_four_fifths_are_all_drawn():
    assert kept(flown(np.arange(0, 270, 27))) == list(range(10))


def test_the_last_picture_before_a_gap_and_a_turn_on_the_spot_are_drawn():
    gap = flown([0, 5, 10, 200, 205])
    assert kept(gap) == [0, 2, 3, 4]
    turning = flown([0] * 10, yaws=np.arange(0, 100, 10.0))
    assert kept(turning) == list(range(10))


def test_weak_and_damaged_pictures_stay_and_carry_nothing():
    placed = flown(np.arange(0, 41, 5))
    placed[4] = replace(placed[4], weak=True)
    placed[8] = replace(placed[8], frame=replace(placed[8].frame, damaged=True))
    assert kept(placed) == [0, 2, 3, 4, 5, 7, 8]


def test_vehicles_do_not_stand_in_for_each_other():
    both = [*flown([0, 5, 10]), *flown([0, 5, 10], vehicle="uav2")]
    assert kept(both) == [0, 2, 3, 5]


def test_pictures_that_were_drawn_before_are_drawn_again_as_poses_change():
    rng = np.random.default_rng(4)
    recorded = flown(np.arange(0, 300, 5.0) + rng.normal(0, 1.0, 60))
    first = {p.frame.image for p in key_pictures(recorded, 0.0)}
    refined = flown(np.arange(0, 300, 5.0))
    again = {p.frame.image for p in key_pictures(refined, 0.0, first)}
    assert len(again - first) <= 2


@given(st.lists(st.floats(0, 30), min_size=1, max_size=30), st.integers(0, 2**31))
def test_ground_that_any_picture_sees_is_seen_nearly_as_steeply(steps, seed):
    rng = np.random.default_rng(seed)
    placed = flown(np.cumsum(steps), yaws=90 + rng.normal(0, 2, len(steps)))
    chosen = kept(placed)
    assert chosen[0] == 0 and chosen[-1] == len(placed) - 1
    east = np.array([p.camera.position[0] for p in placed])
    middles = 0.5 * (east[chosen][1:] + east[chosen][:-1])
    nearest = np.abs(middles[:, None] - east).min(1) if len(middles) else np.zeros(1)
    farthest = np.abs(middles[:, None] - east[chosen]).min(1) if len(middles) else np.zeros(1)
    assert (farthest <= np.maximum(nearest, 7.5) + 1e-6).all()
