"""The map against the receivers: how far it lies off, how well the receivers know, and when it is doubted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from orthoswarm.model.camera import NADIR_PITCH_RAD, Camera, Lens, rotation_from_angles
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.placement import PlacedFrame
from orthoswarm.refine.registration.map_offset import measure_map_offset

LENS = Lens(640, 480, 500.0)


def recorded(vehicles: int, sigma_m: float | None = None, count: int = 20) -> list[PlacedFrame]:
    down = rotation_from_angles(0.0, NADIR_PITCH_RAD, 0.0)
    placed = []
    for v in range(vehicles):
        for k in range(count):
            fix = Fix(48.0, 11.0, 80.0, position_sigma_m=sigma_m)
            frame = Frame(
                image=f"v{v}/{k:03d}.jpg",
                path=Path("x.jpg"),
                vehicle=f"v{v}",
                time_s=float(k),
                fix=fix,
                width=640,
                height=480,
            )
            placed.append(PlacedFrame(frame, Camera(np.array([10.0 * k, 50.0 * v, 80.0]), down, LENS), "realtime", 3.0))
    return placed


def moved(before: list[PlacedFrame], east: float, north: float, stage: str = "fine", wander: float = 0.0):
    rng = np.random.default_rng(4)
    bias = {p.frame.vehicle: rng.normal(0.0, wander, 2) for p in before}
    return [
        replace(
            p,
            stage=stage,
            sigma_m=0.05,
            camera=replace(
                p.camera, position=p.camera.position + np.array([*(bias[p.frame.vehicle] + [east, north]), 0.4])
            ),
        )
        for p in before
    ]


@pytest.mark.parametrize("vehicles", [1, 3])
def test_an_offset_within_the_receivers_errors_is_stated_and_not_doubted(vehicles):
    before = recorded(vehicles)
    offset = measure_map_offset(before, moved(before, 2.0, -1.5))
    assert offset is not None
    assert (offset.east, offset.north) == pytest.approx((2.0, -1.5))
    assert 1.5 < offset.sigma < 2.5 and offset.vehicles == vehicles
    assert not offset.doubted and offset.warning() == []


@pytest.mark.parametrize("vehicles", [1, 2, 8])
def test_a_map_seven_metres_off_is_doubted(vehicles):
    before = recorded(vehicles)
    offset = measure_map_offset(before, moved(before, 5.0, -5.0))
    assert offset is not None and offset.doubted
    (text,) = offset.warning()
    assert "7.1 m (+5.0 east, -5.0 north)" in text and "--checkpoints" in text
    assert ("speaks against the map" in text) == (vehicles > 2)


def test_corrected_receivers_find_a_map_half_a_metre_off():
    before = recorded(2, sigma_m=0.02)
    offset = measure_map_offset(before, moved(before, 0.5, 0.0))
    assert offset is not None and offset.corrected and offset.sigma < 0.1 and offset.doubted
    assert "the map is probably misplaced" in offset.warning()[0]


def test_receivers_that_disagree_know_less():
    before = recorded(6)
    together = measure_map_offset(before, moved(before, 3.0, 0.0))
    apart = measure_map_offset(before, moved(before, 3.0, 0.0, wander=6.0))
    assert together is not None and apart is not None
    assert apart.sigma > 1.3 * together.sigma


def test_frames_that_do_not_lie_on_the_map_say_nothing():
    before = recorded(2)
    assert measure_map_offset(before, moved(before, 40.0, 0.0, stage="coarse")) is None
    assert measure_map_offset(before, []) is None


def test_the_sigma_covers_how_well_the_place_on_the_map_is_known():
    before = recorded(3)
    onto_coarse_map = [replace(p, sigma_m=2.4) for p in moved(before, 5.0, -5.0)]
    offset = measure_map_offset(before, onto_coarse_map)
    assert offset is not None and offset.sigma > 2.4 and not offset.doubted
