"""What both refiners do alike with a vehicle's frames before any picture is read."""

from pathlib import Path

import numpy as np
import pytest

from orthoswarm.batch.refiners import REFINERS, make_refiner
from orthoswarm.model.errors import OrthoSwarmError
from orthoswarm.model.frame import Fix, Frame

EPSG, ORIGIN = 32632, np.array([465_000.0, 5_250_000.0])


def hovering(count=12):
    """Frames of a vehicle that stands still in the air, and one at a place where it cannot have been."""
    spot = [Fix(lat_deg=47.4, lon_deg=8.54, height_m=80.0, yaw_rad=0.0) for _ in range(count)]
    away = Fix(lat_deg=49.4, lon_deg=8.54, height_m=80.0, yaw_rad=0.0)
    return [
        Frame(
            image=f"{i}.jpg",
            path=Path(f"missing/{i}.jpg"),
            vehicle="v",
            time_s=1000.0 + i,
            fix=fix,
            width=640,
            height=480,
        )
        for i, fix in enumerate([*spot, away])
    ]


@pytest.mark.parametrize("name", sorted(REFINERS))
def test_a_vehicle_that_hovers_stays_as_recorded(name):
    """No refiner can solve pictures of one spot, nor believe a position that is 200 km away from the others."""
    solution = make_refiner(name, EPSG, ORIGIN).refine(hovering(), [], None)
    assert len(solution.placed) == 12 and {leg.state for leg in solution.legs} == {"failed"}
    assert "far from the others" in solution.dropped["12.jpg"]
    assert any("at one spot" in warning for warning in solution.warnings)
    assert make_refiner(name, EPSG, ORIGIN).refined_frames(solution) == []


@pytest.mark.parametrize("name", sorted(REFINERS))
def test_no_frames_are_refused(name):
    with pytest.raises(OrthoSwarmError, match="no frames"):
        make_refiner(name, EPSG, ORIGIN).refine([], [], None)
    with pytest.raises(OrthoSwarmError, match="no vehicle"):
        make_refiner(name, EPSG, ORIGIN).refine_batch({}, None)
