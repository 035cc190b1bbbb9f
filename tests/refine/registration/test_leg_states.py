"""What is said of a leg: matched by its own tie points, carried by matched ones, or failed."""

from types import SimpleNamespace

import numpy as np
import pytest

from orthoswarm.refine.registration.block_state import leg_states


def vehicle(ties, *, on_map=True, carried=False, residual_m=0.3, had_map=True):
    """Legs of three photos; ties: number of tie points of each leg."""
    leg = np.repeat(np.arange(len(ties)), 3).astype(np.int32)
    camera = np.repeat(3 * np.arange(len(ties)), ties).astype(np.int32)
    residual = np.full((len(camera), 2), residual_m / np.sqrt(2))
    frames = [SimpleNamespace(image=f"{k}.jpg", vehicle="v") for k in range(len(leg))]
    flight = SimpleNamespace(leg=leg, frames=frames, adjustment=SimpleNamespace(tie_residual=residual))
    return SimpleNamespace(
        vehicle="v", flight=flight, matches=SimpleNamespace(camera=camera), on_map=on_map, carried=carried,
        coarse_shift=None, had_map=had_map, sigma_m=np.full(len(leg), 0.2),
    )  # fmt: skip


def states(*args, **options):
    return [leg.state for leg in leg_states(vehicle(*args, **options))]


def test_legs_with_ties_of_their_own_are_matched_and_carry_the_others():
    assert states([20, 0, 12]) == ["matched", "carried", "matched"]


def test_a_leg_names_its_first_and_last_picture():
    assert [leg.images for leg in leg_states(vehicle([20, 0]))] == [("0.jpg", "2.jpg"), ("3.jpg", "5.jpg")]


def test_photos_that_only_together_have_enough_ties_are_matched():
    """One tie point a leg proves nothing; six that agree put the vehicle there."""
    assert states([1, 1, 1, 1, 1, 1]) == ["matched"] * 6
    assert states([1, 0, 1, 1, 1]) == ["matched", "carried", "matched", "matched", "matched"]


@pytest.mark.parametrize("ties", [[20, 0], [1, 1, 1], [0, 0]])
def test_on_a_vehicle_of_the_map_somebody_is_matched_where_others_are_carried(ties):
    assert "matched" in states(ties)


def test_without_evidence_there_is_neither_a_match_nor_anything_that_carries():
    assert states([0, 0], on_map=False) == ["failed", "failed"]
    assert states([0, 0], on_map=False, had_map=False) == ["failed", "failed"]
    assert states([0, 0], on_map=False, carried=True) == ["carried", "carried"]
