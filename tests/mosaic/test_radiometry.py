"""Radiometry: known factors and fields put on pictures are found again, and seams get less visible."""

import numpy as np
import pytest

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.geo import GroundGrid
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic import overlap_colors, radiometry
from orthoswarm.mosaic.radiometry import estimate_fields, tone_warning, uniform
from orthoswarm.mosaic.render_passes import thumbnail
from orthoswarm.mosaic.renderer import render
from tests.kit import mosaic_scene as scene

FLAT = Terrain.flat(0.0)


def uneven_flight(seed=0):
    """Three legs of three vehicles, 15 % apart in brightness and differently tinted, frames +-4 %."""
    rng = np.random.default_rng(seed)
    flight, truth = scene.Flight(), []
    for leg, tint in enumerate(([1.15, 1.1, 1.1], [1.0, 1.0, 0.95], [0.85, 0.9, 0.9])):
        for along in range(8):
            gain = np.array(tint) * (1.0 + rng.normal(0, 0.04))
            view = scene.camera(east=-60 + 60 * leg, north=-70 + 20 * along, yaw_deg=180.0 * (leg % 2))
            flight.take(view, vehicle=f"uav{leg}", gain=0.85 * gain)
            truth.append(np.log(gain))
    return flight, np.array(truth)


def middle(fields, flight=None):
    """Factors (N, 3) in the pictures' centres."""
    names = fields if flight is None else [f.frame.image for f in flight.frames]
    return np.array([fields[name][:, 0] for name in names])


def thumbnails_of(flight):
    return {name: thumbnail(picture) for name, picture in flight.pictures.items()}


def seam_steps(canvas):
    """Mean absolute step of colour across seams, over what the ground itself does there."""
    image = canvas.read(0, canvas.grid.height, 0, canvas.grid.width)[..., :3].astype(float)
    label = canvas.read_plane(0, canvas.grid.height, 0, canvas.grid.width)
    truth = scene.colour(scene.pixel_centres(canvas.grid))
    seam = (label[:, 1:] != label[:, :-1]) & (label[:, 1:] > 0) & (label[:, :-1] > 0)
    ratio = image / truth
    return np.abs(np.log(ratio[:, 1:][seam] / ratio[:, :-1][seam])).mean()


def test_seams_get_less_visible(tmp_path):
    flight, _ = uneven_flight()
    steps, means = [], []
    for name, gains in (("raw", None), ("even", estimate_fields(flight.frames, thumbnails_of(flight), FLAT))):
        with Canvas.create(tmp_path / name, scene.grid(260.0), plane="frame") as canvas:
            render(flight.frames, FLAT, canvas, read=flight.read, gains=gains)
            steps.append(seam_steps(canvas))
            image = canvas.read(0, canvas.grid.height, 0, canvas.grid.width)
            means.append(image[image[..., 3] == 255][:, :3].mean())
    assert steps[0] > 0.04
    assert steps[1] < 0.4 * steps[0]
    assert means[1] == pytest.approx(means[0], rel=0.02)  # the mosaic as a whole keeps its brightness


def test_known_gains_are_found_up_to_a_common_one():
    flight, truth = uneven_flight(1)
    gains = estimate_fields(flight.frames, thumbnails_of(flight), FLAT)
    found = np.log(middle(gains, flight))
    left = found + truth - (found + truth).mean(0)
    assert np.abs(left).mean() < 0.35 * np.abs(truth - truth.mean(0)).mean()
    assert np.abs(left).max() < 0.1


def test_a_vehicle_follows_those_that_are_drawn_already():
    flight, truth = uneven_flight(2)
    drawn = {f.frame.image: uniform(np.exp(-t)) for f, t in zip(flight.frames, truth) if f.frame.vehicle != "uav2"}
    gains = estimate_fields(flight.frames, thumbnails_of(flight), FLAT, held=drawn)
    assert all(gains[image] is gain for image, gain in drawn.items())
    found = np.log(middle(gains, flight))
    late = np.array([f.frame.vehicle == "uav2" for f in flight.frames])
    assert np.abs((found + truth)[late]).mean() < 0.35 * np.abs(truth[late]).mean()  # no common factor is free now


def test_a_dark_flight_that_meets_another_at_a_corner_takes_its_tone(monkeypatch):
    rng = np.random.default_rng(4)
    flight, drawn = scene.Flight(), {}
    for line in range(8):  # the second vehicle's half lies north-east of the first one's
        late = line >= 4
        for along in range(16):
            east, north = -70 + 15 * line + 35 * late, -75 + 8 * along + 140 * late
            yaw, roll, pitch = rng.normal(0, 4, 3)
            view = scene.camera(
                east, north, 35.0, yaw_deg=180.0 * (line % 2) + yaw, roll_deg=roll, pitch_deg=pitch - 90
            )
            gain = (0.75 if late else 1.0) * np.exp(rng.normal(0, 0.03, 3))
            flight.take(view, vehicle="uav1" if late else "uav0", gain=gain)
            if not late:
                drawn[flight.frames[-1].frame.image] = uniform(1.0 / gain)
    small = thumbnails_of(flight)
    found = middle(estimate_fields(flight.frames, small, FLAT, held=drawn))
    for name, value in {"_REWEIGHTINGS": 20, "_SOLVER_TOLERANCE": 1e-6, "_SOLVER_STEPS": 1000}.items():
        monkeypatch.setattr(radiometry, name, value)
    exact = middle(estimate_fields(flight.frames, small, FLAT, held=drawn))
    assert np.abs(np.log(found / exact)).max() < 0.005  # half a grey level of 100
    assert np.abs(np.log(0.75 * exact[64:])).mean() < 0.1  # of 0.29


def test_even_pictures_are_left_alone():
    flight = scene.survey(2)
    gains = estimate_fields(flight.frames, thumbnails_of(flight), FLAT)
    assert np.abs(middle(gains) - 1.0).max() < 0.05


def at_corner(field, x=0.7, y=0.5):
    return field @ np.array([1.0, x, y, x * x, x * y, y * y])


def test_vignetting_is_taken_out():
    flight = scene.survey(2, tilt_deg=1.0)
    y, x = (np.indices((120, 160)) - np.array([59.5, 79.5])[:, None, None]) / 80.0
    fall = 1.0 - 0.3 * (x**2 + y**2)
    small = {name: thumbnail((p * fall[..., None]).astype(np.uint8)) for name, p in flight.pictures.items()}
    gains = estimate_fields(flight.frames, small, FLAT)
    brighter = np.array([at_corner(g) / g[:, 0] for g in gains.values()])
    wanted = 1.0 / (1.0 - 0.3 * (0.7**2 + 0.5**2))
    assert brighter.mean() == pytest.approx(wanted, abs=0.5 * (wanted - 1.0))


def test_a_picture_that_is_darker_on_one_side_is_evened_out():
    flight = scene.survey(3, tilt_deg=1.0)
    x = (np.arange(160) - 79.5) / 80.0
    small = thumbnails_of(flight)
    odd = flight.frames[len(flight.frames) // 2].frame.image
    small[odd] = thumbnail((flight.pictures[odd] * np.exp(0.15 * x)[None, :, None]).astype(np.uint8))
    gains = estimate_fields(flight.frames, small, FLAT)
    slopes = {name: float(np.mean(g[:, 1] / g[:, 0])) for name, g in gains.items()}
    others = np.median([slope for name, slope in slopes.items() if name != odd])
    assert -0.15 < slopes[odd] - others < -0.03


def test_a_picture_with_a_bright_middle_is_evened_out():
    flight = scene.survey(3, tilt_deg=1.0)
    y, x = (np.indices((120, 160)) - np.array([59.5, 79.5])[:, None, None]) / 80.0
    small = thumbnails_of(flight)
    odd = flight.frames[len(flight.frames) // 2].frame.image
    bright = flight.pictures[odd] * np.exp(-0.12 * (x**2 + y**2))[..., None]
    small[odd] = thumbnail(bright.astype(np.uint8))
    gains = estimate_fields(flight.frames, small, FLAT)
    rise = {name: float(np.log(at_corner(g) / g[:, 0]).mean()) for name, g in gains.items()}
    others = np.median([value for name, value in rise.items() if name != odd])
    assert 0.2 * 0.12 * 0.74 < rise[odd] - others < 0.12 * 0.74


def test_frame_without_thumbnail_gets_its_vehicles_gain():
    flight, _ = uneven_flight()
    small = thumbnails_of(flight)
    missing = flight.frames[3].frame.image
    del small[missing]
    gains = estimate_fields(flight.frames, small, FLAT)
    own = np.array([gains[f.frame.image][:, 0] for f in flight.frames if f.frame.vehicle == "uav0"])
    assert gains[missing][:, 0] == pytest.approx(own.mean(0), abs=0.06)


def test_dark_and_burnt_out_pictures_say_nothing():
    flight, _ = uneven_flight()
    small = thumbnails_of(flight)
    for k, name in enumerate(small):
        small[name] = np.full((12, 16, 3), 255 if k % 2 else 2, np.uint8)
    gains = estimate_fields(flight.frames, small, FLAT)
    assert middle(gains) == pytest.approx(1.0)


@pytest.mark.parametrize("threads", [2, 3, 16])
def test_the_result_does_not_depend_on_the_number_of_threads(threads):
    flight = scene.survey(4, scene.hills)
    small, ground = thumbnails_of(flight), scene.terrain_of(scene.hills)
    alone = estimate_fields(flight.frames, small, ground)
    shared = estimate_fields(flight.frames, small, ground, threads=threads)
    assert len(alone) == len(flight.frames)
    assert all(np.array_equal(alone[image], shared[image]) for image in alone)


def test_fields_evaluated_few_at_a_time_are_the_same(monkeypatch):
    flight = scene.survey(4, scene.hills)
    small, ground = thumbnails_of(flight), scene.terrain_of(scene.hills)
    at_once = estimate_fields(flight.frames, small, ground)
    monkeypatch.setattr(radiometry, "_FIELDS_AT_ONCE", 5)
    monkeypatch.setattr(overlap_colors, "_RATIOS_AT_ONCE", 100)
    few = estimate_fields(flight.frames, small, ground)
    assert all(np.array_equal(at_once[image], few[image]) for image in at_once)


def test_nothing_to_compare_gives_no_gains():
    flight = scene.survey(0, count=1)
    assert estimate_fields(flight.frames, thumbnails_of(flight), FLAT) == {}
    assert estimate_fields([], {}, FLAT) == {}


class TintedMap:
    """The scene's ground as a map of another season or sensor; nothing west of a line."""

    def __init__(self, tint=(1.0, 1.0, 1.0), west=-1e9, *, grey=False):
        self.tint, self.west, self.grey = np.array(tint), west, grey

    def rgb(self, bounds, gsd_m):
        grid = GroundGrid.around(0, bounds, gsd_m)
        ground = scene.pixel_centres(grid)
        fine = [scene.colour(ground + gsd_m * np.array([e, n])) for e in (-0.3, 0.0, 0.3) for n in (-0.3, 0.0, 0.3)]
        colour = np.mean(fine, axis=0)
        if self.grey:
            colour = colour.mean(-1, keepdims=True).repeat(3, -1)
        return np.clip(colour * self.tint, 0, 255).astype(np.uint8), ground[..., 0] > scene.EAST + self.west


def test_the_tone_of_a_map_is_taken_over(tmp_path):
    flight, truth = uneven_flight(3)
    tint = np.array([0.8, 1.0, 1.1])
    fields = estimate_fields(flight.frames, thumbnails_of(flight), FLAT, tone=TintedMap(tint))
    applied = np.log(middle(fields, flight)) + truth + np.log(0.85)  # of the ground's true colours
    assert applied.mean(0) == pytest.approx(np.log(tint), abs=0.06)
    assert applied.std(0).max() < 0.05
    assert "another tint" in tone_warning(fields)


def test_a_map_of_a_part_of_the_area_is_enough_for_its_tone():
    flight, truth = uneven_flight(3)
    fields = estimate_fields(flight.frames, thumbnails_of(flight), FLAT, tone=TintedMap((0.9, 0.9, 0.9), west=0.0))
    applied = np.log(middle(fields, flight)) + truth + np.log(0.85)
    assert applied.mean() == pytest.approx(np.log(0.9), abs=0.08)
    assert applied.std(0).max() < 0.07  # and where there is none pictures still agree with the others


class MapWithoutDarkGround(TintedMap):
    """A map with holes where the ground is dark, such as crowns that a reconstruction could not measure."""

    def rgb(self, bounds, gsd_m):
        ground = scene.pixel_centres(GroundGrid.around(0, bounds, gsd_m))
        steps = gsd_m * (np.arange(6) - 2.5) / 6
        parts = np.stack([scene.colour(ground + np.array([e, n])) for e in steps for n in steps])
        shown = parts.mean(-1, keepdims=True) > 120
        count = shown.sum(0)
        return ((parts * shown).sum(0) / np.maximum(count, 1)).clip(0, 255).astype(np.uint8), count[..., 0] > 0


def test_holes_of_a_map_do_not_change_its_tone():
    flight = scene.survey(2)
    fields = estimate_fields(flight.frames, thumbnails_of(flight), FLAT, tone=MapWithoutDarkGround())
    assert middle(fields).mean() == pytest.approx(1.0, abs=0.05)


def test_a_grey_map_gives_no_hue():
    flight = scene.survey(2)
    fields = estimate_fields(flight.frames, thumbnails_of(flight), FLAT, tone=TintedMap((0.8, 0.8, 0.8), grey=True))
    red, green, blue = middle(fields).mean(0)
    assert max(red, green, blue) - min(red, green, blue) < 0.04
    assert green == pytest.approx(0.8, abs=0.05)


def test_a_map_that_shows_nothing_here_changes_nothing():
    flight, _ = uneven_flight(4)
    alone = estimate_fields(flight.frames, thumbnails_of(flight), FLAT)
    beside = estimate_fields(flight.frames, thumbnails_of(flight), FLAT, tone=TintedMap(west=1e6))
    assert middle(beside) == pytest.approx(middle(alone))
