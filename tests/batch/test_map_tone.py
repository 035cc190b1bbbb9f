"""`mosaic --tone map`: the orthoimage has the tone of the basemap, and the report says what that changed."""

import json

import numpy as np
import pytest
import rasterio

from gcs_plugin.cli.main import main
from tests.kit.scene import Scene, legs


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Photos of two legs, and a map of the same ground whose colours are tinted; the tint."""
    folder, tint = tmp_path_factory.mktemp("flight"), np.array([0.75, 0.85, 1.0])
    scene = Scene()
    scene.fly(folder / "photos", legs(count=2, photos=6))
    scene.basemap(folder / "map.tif")
    with rasterio.open(folder / "map.tif", "r+") as file:
        colours = file.read([1, 2, 3]) * tint[:, None, None]
        file.write(np.rint(colours).astype(np.uint8), [1, 2, 3])
    return folder, tint


def means(out):
    """Mean log colour of the orthoimage."""
    with rasterio.open(out / "orthoimage.tif") as file:
        data = file.read()
    return np.log(data[:3, data[3] == 255].clip(1)).mean(1)


def test_the_orthoimage_has_the_tone_of_the_map(flight, tmp_path, capsys):
    folder, tint = flight
    found = []
    for tone in ("photos", "map"):
        out = tmp_path / tone
        options = ["--basemap", str(folder / "map.tif"), "--out", str(out), "--workers", "1", "--json"]
        assert main(["mosaic", str(folder / "photos"), *options, "--tone", tone]) == 0
        found.append((means(out), " ".join(json.loads(capsys.readouterr().out)["warnings"])))
    (photos, said_photos), (mapped, said_map) = found
    assert mapped - photos == pytest.approx(np.log(tint), abs=0.08)
    assert "tones" not in said_photos
    assert "tones follow the basemap" in said_map and "another tint" in said_map


@pytest.mark.parametrize(
    "flags", [[], ["--basemap", "map.tif", "--no-gains"], ["--basemap", "map.tif", "--until", "coarse"]]
)
def test_what_cannot_have_a_maps_tone_is_refused(flight, tmp_path, capsys, flags):
    folder, _ = flight
    flags = [str(folder / f) if f == "map.tif" else f for f in flags]
    assert main(["mosaic", str(folder / "photos"), "--tone", "map", *flags, "--out", str(tmp_path / "out")]) == 2
    assert "--tone map" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
