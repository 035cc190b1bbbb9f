"""Seam leveling: steps of tone at the seams vanish, and nothing else of the mosaic changes."""

import numpy as np
import pytest

from orthoswarm.canvas.canvas import Canvas
from orthoswarm.model.placement import Terrain
from orthoswarm.mosaic.renderer import Seams, render, serial
from orthoswarm.mosaic.seams.previews import PreviewFile
from tests.kit import mosaic_scene as scene

FLAT = Terrain.flat(0.0)


def drawn(folder, flight, *, level, blend="seam", run=serial, tile_px=128):
    """The mosaic of a flight: colours (H, W, 3) as float, labels (H, W)."""
    folder.mkdir()
    previews = PreviewFile.create(folder / "previews", [f.frame.image for f in flight.frames])
    with Canvas.create(folder / "canvas", scene.grid(260.0), plane="frame", tile_px=tile_px) as canvas:
        render(flight.frames, FLAT, canvas, seams=Seams(previews, blend, level=level), read=flight.read, run=run)
        window = (0, canvas.grid.height, 0, canvas.grid.width)
        return canvas.read(*window)[..., :3].astype(float), canvas.read_plane(*window)


def on_a_lawn(flight):
    """The same flight over grass: even, but for a few grey levels."""
    for name, picture in flight.pictures.items():
        flight.pictures[name] = np.rint(110.0 + 0.06 * (picture.astype(float) - 128.0)).astype(np.uint8)
    return flight


def uneven(flight, amount=0.1):
    """Each picture's brightness varies in waves of its own, which no low polynomial follows."""
    for k, (name, picture) in enumerate(flight.pictures.items()):
        y, x = np.indices(picture.shape[:2]) / 80.0
        waves = np.exp(amount * np.sin(3.0 * x + 1.7 * k) * np.cos(2.5 * y + 0.9 * k))
        flight.pictures[name] = np.rint(picture * waves[..., None]).astype(np.uint8)
    return flight


def steps(image, labels):
    """Mean absolute step of log brightness between the places 3 pixels to either side of a seam."""
    log = np.log(image.mean(2).clip(1.0))
    found = []
    for value, label in ((log, labels), (log.T, labels.T)):
        seam = (label[:, 3:-3] != label[:, 4:-2]) & (label[:, :-6] > 0) & (label[:, 6:] > 0)
        found.append(np.abs(value[:, :-6] - value[:, 6:])[seam])
    return np.concatenate(found).mean()


@pytest.mark.parametrize("blend", ["none", "seam"])
def test_steps_on_a_lawn_vanish(tmp_path, blend):
    flight = uneven(on_a_lawn(scene.survey(1, tilt_deg=3.0)))
    before, labels = drawn(tmp_path / "before", flight, level=False, blend=blend)
    after, same = drawn(tmp_path / "after", flight, level=True, blend=blend)
    even, _ = drawn(tmp_path / "even", on_a_lawn(scene.survey(1, tilt_deg=3.0)), level=False, blend=blend)
    assert (same == labels).all()
    ground = steps(even, labels)
    assert steps(before, labels) > 3.0 * ground
    assert steps(after, labels) - ground < 0.35 * (steps(before, labels) - ground)
    shown = labels > 0
    assert after[shown].mean() == pytest.approx(before[shown].mean(), rel=0.01)  # the whole keeps its brightness


def test_pictures_that_agree_stay_as_they_are(tmp_path):
    flight = scene.survey(2, tilt_deg=3.0)
    before, labels = drawn(tmp_path / "before", flight, level=False)
    after, _ = drawn(tmp_path / "after", flight, level=True)
    assert np.abs(after - before)[labels > 0].mean() < 1.0


def test_a_thing_that_only_one_picture_shows_does_not_tint_the_ground_beside_it(tmp_path):
    flight = on_a_lawn(scene.Flight().take(scene.camera(east=-20.0)).take(scene.camera(east=20.0)))
    name = flight.frames[0].frame.image
    picture = flight.pictures[name].copy()
    picture[40:80, 78:] = 230  # a bright roof up to the picture's border, all along the seam
    flight.pictures[name] = picture
    before, labels = drawn(tmp_path / "before", flight, level=False)
    after, _ = drawn(tmp_path / "after", flight, level=True)
    lawn = (labels > 0) & (before.mean(2) < 130.0)
    assert np.abs(after - before)[lawn].mean() < 2.5


def test_the_work_may_be_spread_in_any_way(tmp_path):
    flight = uneven(on_a_lawn(scene.survey(3, tilt_deg=3.0)))
    one, _ = drawn(tmp_path / "one", flight, level=True)
    other, _ = drawn(tmp_path / "other", flight, level=True, run=lambda f, a: [f(x) for x in reversed(list(a))])
    assert (one == other).all()
