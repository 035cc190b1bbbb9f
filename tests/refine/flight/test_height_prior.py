"""What a flight's recorded heights are taken for: a climb is believed, a spike is not."""

import numpy as np
import pytest

from orthoswarm.refine.bundle.flight_records import FlightRecords
from orthoswarm.refine.features.flow_calibration import Calibration
from orthoswarm.refine.flight.relative_block import height_prior

KNOWN = Calibration(
    focal_px=500.0, height_m=60.0, yaw_offset=np.zeros(0), trusted_height=True, pairs=9, warnings=[], spread=0.01
)


def records(times, heights, timed=True):
    n = len(times)
    flags, zeros = np.ones(n, bool), np.zeros(n)
    return FlightRecords(
        position=np.column_stack([5.0 * np.arange(n), zeros, heights]), yaw=zeros, pitch=zeros - np.pi / 2, roll=zeros,
        time_s=np.array(times, float), has_height=flags, has_yaw=flags, has_tilt=flags,
        position_sigma=np.full(n, np.nan), timed=timed,
    )  # fmt: skip


LEVEL_S, LEVEL_M = [21.0 + 0.5 * k for k in range(8)], [60.0] * 8


@pytest.mark.parametrize("backwards", [False, True], ids=["climb", "descent"])
def test_pictures_of_a_climb_or_descent_keep_their_heights_and_the_pictures_decide(backwards):
    times, heights = np.array([0.0, 2.5, *LEVEL_S]), np.array([19.4, 25.7, *LEVEL_M])
    if backwards:
        times, heights = times[-1] - times[::-1], heights[::-1]
    z, sigma = height_prior(records(times, heights), KNOWN)
    assert np.array_equal(z, heights)
    ends = [-1, -2] if backwards else [0, 1]
    assert (sigma[ends] > 20.0).all() and (np.delete(sigma, ends) < 1.0).all()


def test_a_spike_gets_the_height_of_the_others():
    z, sigma = height_prior(records(LEVEL_S, [*LEVEL_M[:4], 92.0, *LEVEL_M[5:]]), KNOWN)
    assert np.array_equal(z, LEVEL_M)
    assert sigma[4] == pytest.approx(32.0)


def test_without_times_a_climb_cannot_be_told_from_a_spike():
    z, _ = height_prior(records(range(9), [20.0, *LEVEL_M], timed=False), KNOWN)
    assert (z == 60.0).all()
