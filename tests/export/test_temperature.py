"""A map of thermal pictures has their temperatures, in degrees, unchanged by balancing and blending."""

import json

import cv2
import numpy as np
import pytest
import rasterio

from gcs_plugin.cli.main import main
from tests.kit.scene import FOV, Scene, legs

SHOTS = legs(count=2, photos=8)


def degrees(rgb):
    """The temperature of a picture's ground: 5 to 45 degrees."""
    return rgb.astype(np.float32).mean(-1) / 6.0 + 5.0


def thermal(folder, kind):
    """A flight of pictures of one kind, with a map and their positions beside."""
    scene, lines = Scene(), ["EPSG:4326"]
    folder.mkdir(parents=True)
    for i, shot in enumerate(SHOTS):
        celsius = degrees(scene.picture(shot)).astype(np.float32)
        pixels = {
            "celsius": celsius, "kelvin": celsius + np.float32(273.15),
            "counts": np.rint((celsius + 273.15) / 0.04).astype(np.uint16),
            "colours": np.rint(celsius).astype(np.uint8),
        }[kind]  # fmt: skip
        cv2.imwrite(str(folder / f"{i:04d}.tif"), pixels)
        lat, lon = scene.grid.to_geographic(np.add(scene.middle, np.add((shot.east, shot.north), shot.recorded)))
        lines.append(f"{i:04d}.tif {lon:.9f} {lat:.9f} {500 + shot.height} {shot.yaw} {90 + shot.pitch} {shot.roll}")
    (folder / "geo.txt").write_text("\n".join(lines))
    scene.basemap(folder.parent / "map.tif")
    return scene


def mosaic(folder, *more):
    options = ["--basemap", folder.parent / "map.tif", "--fov-min", FOV, "--workers", 1, "--out", folder.parent / "out"]
    return main(["mosaic", *map(str, (folder, *options, *more))])


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "more"), [("celsius", ()), ("kelvin", ()), ("counts", ("0.04",))])
def test_temperatures_are_those_of_the_ground(tmp_path, kind, more):
    scene, out = thermal(tmp_path / "photos", kind), tmp_path / "out"
    assert mosaic(tmp_path / "photos", "--temperature", *more) == 0
    assert json.loads((out / "report.json").read_text())["frames"]["used"] == 16
    with rasterio.open(out / "temperature.tif") as raster, rasterio.open(out / "orthoimage.tif") as orthoimage:
        found, nodata = raster.read(1), raster.nodata
        assert raster.units == ("degC",) and raster.crs == orthoimage.crs and raster.bounds == orthoimage.bounds
        drawn = orthoimage.read(4) > 0
        some = np.random.default_rng(1).integers(0, drawn.sum(), 3000)
        rows, cols = (index[some] for index in np.nonzero(drawn))
        easts, norths = raster.xy(rows, cols)
    assert ((found != nodata) == drawn).all()
    at = scene.ground.to_pixel(np.column_stack([easts, norths])).astype(np.float32)
    truth = cv2.remap(degrees(scene.rgb), at[:, :1].copy(), at[:, 1:].copy(), cv2.INTER_LINEAR)[:, 0]
    off = found[rows, cols] - truth
    assert np.median(np.abs(off)) < 0.4 and abs(np.median(off)) < 0.1 and np.std(truth) > 3.0
    assert mosaic(tmp_path / "photos") == 0 and not (out / "temperature.tif").exists()


@pytest.mark.parametrize(
    ("kind", "more", "said"),
    [
        ("colours", ("--temperature",), "holds colours, not temperatures"),
        ("counts", ("--temperature",), "say how many kelvin one is"),
        ("celsius", ("--temperature", "3"), "takes kelvin a count"),
        ("celsius", ("--temperature", "--until", "coarse"), "goes without --until"),
    ],
)
def test_what_is_no_temperature_is_refused_before_the_work(tmp_path, capsys, kind, more, said):
    thermal(tmp_path / "photos", kind)
    assert mosaic(tmp_path / "photos", *more) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out").exists()
