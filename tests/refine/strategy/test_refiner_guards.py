"""What keeps an adjustment from another valley: wrong tracks at a turn, a place that bends the lens, broken corners."""

from dataclasses import replace

import numpy as np
import pytest

from orthoswarm.model.camera import fov_rad
from orthoswarm.model.errors import AdjustmentError
from orthoswarm.model.geo import LocalGrid
from orthoswarm.raster.basemap import Basemap
from orthoswarm.refine.bundle import height_consistency
from orthoswarm.refine.bundle.covariance import systematic_tie_offset
from orthoswarm.refine.bundle.height_consistency import UNKNOWN_HEIGHT_SIGMA_M, FreeHeight, height_disagreement
from orthoswarm.refine.features import tracks
from orthoswarm.refine.flight.relative_block import open_flight
from orthoswarm.refine.registration.absolute_orientation import leg_corrections
from orthoswarm.refine.registration.block_state import WorkArea
from orthoswarm.refine.registration.tie_points import MapMatches
from orthoswarm.refine.strategy import vehicle_passes
from orthoswarm.refine.strategy.vehicle_passes import (
    RefinerOptions,
    adjust_by_schedule,
    adjust_without_map,
    focal_length_ran_away,
    read_frame,
    refine_alone,
)
from tests.kit import made_up_ground as kernel_warmup

EPSG, ORIGIN = 32631, np.array([500_000.0, 5_000_000.0])


@pytest.fixture(scope="module")
def made_up(tmp_path_factory):
    """28 pictures of 70 degrees in two legs, 30 m from where the warm-up has them, and their map."""
    folder = tmp_path_factory.mktemp("flight")
    ground = np.roll(kernel_warmup.made_up_ground(), 30, axis=0)
    kernel_warmup.write_map(ground, folder / "map.tif")
    return kernel_warmup.made_up_flight(ground, folder, "a"), Basemap.open(folder / "map.tif", EPSG)


def opened(frames):
    return open_flight(frames, LocalGrid(EPSG), ORIGIN, read_frame, float(np.radians(80.0)))


def fov_deg(flight):
    return float(np.degrees(fov_rad(flight.adjustment.cameras.lens[0, 0], flight.pictures.size[0])))


def test_wrong_tracks_at_a_turn_do_not_carry_the_field_of_view_away(made_up, monkeypatch):
    """Two wrong tracks of ninety are enough where the first steps give them full weight."""
    frames, _ = made_up
    monkeypatch.setattr(tracks, "_FLOW_CHANCE_SHARE", 0.0)  # else they are dropped at once
    flight = opened(frames)
    with monkeypatch.context() as wider:
        wider.setattr(vehicle_passes, "_SCHEDULE", (1e4, 1e4, 100.0, 100.0, 9.0, 9.0))
        adjust_by_schedule(flight, RefinerOptions().ground(ORIGIN))
    assert fov_deg(flight) > 90.0 and focal_length_ran_away(flight)
    flight = opened(frames)
    adjust_by_schedule(flight, RefinerOptions().ground(ORIGIN))
    assert not focal_length_ran_away(flight)
    assert fov_deg(flight) == pytest.approx(70.0, abs=0.5)


def test_without_an_answer_of_the_flow_nothing_is_called_a_runaway(made_up):
    flight = opened(made_up[0])
    flight.adjustment.cameras.lens[:, 0] *= 0.5
    assert focal_length_ran_away(flight)
    flight.calibration = replace(flight.calibration, pairs=2)
    assert not focal_length_ran_away(flight)


def free_height(**changed):
    """The adjustment of a flight that was recorded at 40 m, and comes to 32 m without that, as predicted."""
    values = {"focal_px": [900.0, 900.1, 900.1], "recorded_m": 40.0, "solved_m": 32.0, "predicted": (-8.0, 6.0)}
    return FreeHeight(**{**values, **changed})


def test_a_recorded_height_is_refuted_by_an_adjustment_that_comes_to_another():
    assert free_height().refutes_record


@pytest.mark.parametrize(
    "result",
    [
        pytest.param({"solved_m": 39.9, "predicted": (0.0, 6.0)}, id="comes to the recorded height"),
        pytest.param({"focal_px": [900.0 * 0.96**k for k in range(4)]}, id="does not converge"),
        pytest.param({"solved_m": 14.0}, id="comes to another minimum than was predicted"),
    ],
)
def test_a_recorded_height_is_kept_where_the_pictures_alone_determine_none(result):
    """The last: pictures of a level camera on ArduCopter; 32 m were predicted for 40 m, it came to 14 m."""
    assert not free_height(**result).refutes_record


@pytest.mark.parametrize("at_rest_share", [None, 0.0])
def test_heights_that_are_kept_are_those_of_the_adjustment_before(made_up, monkeypatch, at_rest_share):
    """Straight down over flat ground: set free it stays where it is, or (with a share of 0) counts as not converged."""

    def recorded(adjustment):
        return np.array([m.height_sigma < UNKNOWN_HEIGHT_SIGMA_M for m in adjustment.priors.models])

    for module in (vehicle_passes, height_consistency):
        monkeypatch.setattr(module, "contradicted_heights", recorded)
    if at_rest_share is not None:
        monkeypatch.setattr(height_consistency, "_AT_REST_SHARE", at_rest_share)
    flight = opened(made_up[0])
    adjust_without_map(flight)
    assert fov_deg(flight) == pytest.approx(70.0, abs=0.5)
    assert flight.warnings == [] and flight.calibration.trusted_height
    assert recorded(flight.adjustment).all() and height_disagreement(flight.adjustment) < 0.05


def test_an_adjustment_that_does_not_fit_its_observations_is_no_solution(made_up):
    frames, _ = made_up
    adjust_without_map(opened(frames))
    flight = opened(frames)
    rng = np.random.default_rng(1)
    wrong = rng.random(len(flight.adjustment.tracks.point)) < 0.6
    flight.adjustment.tracks.uv[wrong] += rng.uniform(-40.0, 40.0, (int(wrong.sum()), 2))
    with pytest.raises(AdjustmentError, match="of the observations fit"):
        adjust_without_map(flight)


def test_a_place_on_the_map_that_bends_the_lens_is_not_believed(made_up, monkeypatch):
    frames, basemap = made_up
    orient_on_map = vehicle_passes.orient_on_map

    def bent(flight, *args):
        found = orient_on_map(flight, *args)
        flight.adjustment.cameras.lens[:, 0] *= 0.7
        shift = np.random.default_rng(3).uniform(-5.0, 5.0, found.matches.shift.shape)
        return replace(found, matches=replace(found.matches, shift=shift))

    monkeypatch.setattr(vehicle_passes, "orient_on_map", bent)
    state = refine_alone(frames, area=WorkArea(EPSG, ORIGIN, basemap), options=RefinerOptions())
    assert not state.on_map and not len(state.matches.point)
    assert fov_deg(state.flight) == pytest.approx(70.0, abs=0.5)
    assert any("is rejected" in warning for warning in state.flight.warnings)
    monkeypatch.setattr(vehicle_passes, "orient_on_map", orient_on_map)
    state = refine_alone(frames, area=WorkArea(EPSG, ORIGIN, basemap), options=RefinerOptions())
    assert state.on_map and not any("is rejected" in warning for warning in state.flight.warnings)


def test_a_place_that_its_new_tie_points_prove_is_believed_whatever_tags_made_of_the_lens(made_up, monkeypatch):
    frames, basemap = made_up
    field_of_view_deg, confirmed = vehicle_passes.field_of_view_deg, vehicle_passes.confirmed
    misled = []

    def by_tags(adjustment, flight):
        return field_of_view_deg(adjustment, flight) + (12.0 if adjustment is not flight.adjustment else 0.0)

    def on_map(*args):
        misled.append(True)
        monkeypatch.setattr(vehicle_passes, "field_of_view_deg", by_tags)  # of the adjustment before, which is kept
        return confirmed(*args)

    monkeypatch.setattr(vehicle_passes, "confirmed", on_map)
    state = refine_alone(frames, area=WorkArea(EPSG, ORIGIN, basemap), options=RefinerOptions())
    assert misled and state.on_map and len(state.matches.point)
    assert fov_deg(state.flight) == pytest.approx(70.0, abs=0.5)
    assert not any("is rejected" in warning for warning in state.flight.warnings)


def legs_and_matches(seed=0):
    """Two legs of 20 pictures with a turn of 2 between, and 3 matches a picture, all 5 m east of where they belong."""
    rng = np.random.default_rng(seed)
    leg = np.r_[np.zeros(20), [-1, -1], np.ones(20)].astype(np.int32)
    camera = np.repeat(np.flatnonzero(leg >= 0), 3).astype(np.int32)
    shift = np.array([5.0, 0.0]) + rng.normal(0, 0.1, (len(camera), 2))
    return leg, camera, shift, rng


def as_matches(camera, shift):
    n = len(camera)
    return MapMatches(
        point=np.arange(n, dtype=np.int32), camera=camera, shift=shift, peak=np.full(n, 0.5), ratio=np.full(n, 0.4),

    )  # fmt: skip


def test_a_leg_whose_matches_agree_on_another_line_is_moved_by_it():
    leg, camera, shift, rng = legs_and_matches()
    second = leg[camera] == 1
    shift[second, 1] -= 1.5 * np.clip((32 - camera[second]) / 10.0, -1, 1)  # the corner's error runs out along the leg
    wrong = rng.random(len(camera)) < 0.15
    shift[wrong] += rng.uniform(-12, 12, (int(wrong.sum()), 2))
    out = leg_corrections(leg, as_matches(camera, shift), np.array([5.0, 0.0]))
    np.testing.assert_allclose(out[:20], np.tile([5.0, 0.0], (20, 1)))
    expected = -1.5 * np.clip((32 - np.arange(22, 42)) / 10.0, -1, 1)
    assert np.abs(out[22:, 1] - expected).max() < 0.4
    assert out[19, 1] > out[20, 1] > out[21, 1] > out[22, 1]  # the turn lies between


def test_a_leg_that_lies_about_right_or_shows_chaos_keeps_the_common_shift():
    leg, camera, shift, rng = legs_and_matches()
    second = leg[camera] == 1
    shift[second, 1] += 0.4
    common = np.array([5.0, 0.0])
    np.testing.assert_allclose(leg_corrections(leg, as_matches(camera, shift), common), np.tile(common, (42, 1)))
    shift[second] = rng.uniform(-14, 14, (int(second.sum()), 2))
    np.testing.assert_allclose(leg_corrections(leg, as_matches(camera, shift), common), np.tile(common, (42, 1)))
    few = np.r_[np.flatnonzero(~second), np.flatnonzero(second)[:3]]
    shift[second] = common + 3.0
    out = leg_corrections(leg, as_matches(camera[few], shift[few]), common)
    np.testing.assert_allclose(out, np.tile(common, (42, 1)))


def test_ties_that_agree_beside_a_picture_tell_of_its_error_and_single_ones_do_not():
    leg, camera, _, rng = legs_and_matches()
    residual = rng.normal(0, 0.1, (len(camera), 2))
    assert systematic_tie_offset(leg, camera, residual).max() < 0.1
    alone = residual.copy()
    alone[::9] += 4.0
    assert systematic_tie_offset(leg, camera, alone).max() < 0.2
    residual[np.isin(camera, np.arange(22, 28))] += (1.2, 0.0)
    off = systematic_tie_offset(leg, camera, residual)
    assert off[22:26].min() > 0.8
    assert off[:20].max() < 0.1 and off[32:].max() < 0.1  # neither the leg before the corner nor the rest of its own
    order = rng.permutation(len(camera))
    np.testing.assert_array_equal(systematic_tie_offset(leg, camera[order], residual[order]), off)
    assert not systematic_tie_offset(leg, camera[:0], residual[:0]).any()
