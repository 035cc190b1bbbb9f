"""Nothing that was read, and no product of another kind, is written over; what cannot be written is said before."""

import json
import shutil

import pytest

from gcs_plugin.cli.main import main
from tests.kit.scene import Scene, legs


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Photos, a map, and the product of a quick run."""
    at = tmp_path_factory.mktemp("written")
    scene = Scene()
    scene.fly(at / "photos", legs(count=1, photos=4))
    scene.basemap(at / "map.tif")
    assert main(["mosaic", str(at / "photos"), "--out", str(at / "out"), "--until", "realtime", "--workers", "1"]) == 0
    shutil.copy(at / "map.tif", at / "photos" / "kept.tif")
    (at / "points.txt").write_text("EPSG:32632\n462212 5249697 0 10 10 DJI_0001.JPG\n")
    return at


def refused(capsys, *args: object) -> str:
    capsys.readouterr()
    assert main([str(a) for a in args]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and said[0].startswith("orthoswarm: ")
    return said[0]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--dem {}/map.tif --surface {}/map.tif", "would replace --dem"),
        ("--basemap {}/map.tif --surface {}/photos/../map.tif", "would replace --basemap"),
        ("--surface {}/out/orthoimage.tif", "own orthoimage.tif"),
        ("--surface {}/out/tiles/x.tif", "own tiles"),
        ("--surface {}/photos/kept.tif", "a file of INPUT"),
        ("--basemap {}/out/realtime.tif", "own realtime.tif"),
        ("--control {}/points.txt --until realtime", "--control moves refined pictures"),
    ],
)
def test_a_run_that_would_write_over_its_inputs_is_refused(folder, capsys, flags, said):
    before = (folder / "out/realtime.tif").read_bytes(), (folder / "map.tif").read_bytes()
    words = flags.replace("{}", str(folder)).split()
    assert said in refused(capsys, "mosaic", folder / "photos", "--out", folder / "out", "--workers", "1", *words)
    assert before == ((folder / "out/realtime.tif").read_bytes(), (folder / "map.tif").read_bytes())


def test_an_export_over_a_map_or_a_file_is_refused(folder, capsys):
    out = folder / "out"
    before = (out / "realtime.tif").read_bytes()
    assert "holds a map" in refused(capsys, "export", out, "--to", "cog", "--jpeg", "--dest", out)
    assert "holds a map" in refused(capsys, "export", out, "--to", "gpkg", "--dest", out / "../out")
    assert "is a file" in refused(capsys, "export", out, "--to", "cog", "--dest", folder / "map.tif")
    assert "is a file" in refused(capsys, "export", out, "--to", "cog", "--dest", folder / "map.tif" / "below")
    assert (out / "realtime.tif").read_bytes() == before


def test_damaged_products_are_one_sentence(folder, tmp_path, capsys):
    out = shutil.copytree(folder / "out", tmp_path / "out")
    (out / "report.json").write_text("{bad")
    for kind in ("odm", "pdf", "stac", "pack"):
        assert "report.json" in refused(capsys, "export", out, "--to", kind)
    whole = (out / "realtime.tif").read_bytes()
    (out / "realtime.tif").write_bytes(whole[: len(whole) // 3])
    assert "cannot be read" in refused(capsys, "export", out, "--to", "cog")
    assert not list((out / "export").glob("*"))
    cut = out / "realtime.tif"
    assert "cut short" in refused(capsys, "evaluate", cut, "--reference", folder / "map.tif")


def test_a_field_that_cannot_be_written_is_refused_before_the_work(folder, capsys):
    args = ("evaluate", folder / "out/realtime.tif", "--reference", folder / "map.tif", "--field")
    assert "no folder" in refused(capsys, *args, folder / "nowhere/field.csv")
    assert "would replace reference" in refused(capsys, *args, folder / "map.tif")


def test_a_map_of_huge_pixels_does_not_end_the_run(folder, tmp_path):
    import rasterio

    with rasterio.open(folder / "map.tif") as source:
        profile, rgb, transform = source.profile, source.read(), source.transform
    profile.update(width=1, height=1, transform=transform @ transform.scale(1280), tiled=False)
    with rasterio.open(tmp_path / "coarse.tif", "w", **profile) as file:
        file.write(rgb[:, :1, :1])
    args = ["mosaic", folder / "photos", "--basemap", tmp_path / "coarse.tif", "--out", tmp_path / "out"]
    assert main([*map(str, args), "--until", "realtime", "--workers", "1"]) == 0
    assert json.loads((tmp_path / "out/report.json").read_text())["frames"]["used"] == 4


@pytest.mark.parametrize(
    "flag",
    ["--legs 0", "--width 0", "--every 0", "--map-gsd 0", "--rays 0", "--quality 500", "--speed-m-s 0", "--lag-s 3,1",
     "--columns 0"],
)  # fmt: skip
def test_a_twin_of_impossible_values_is_refused(tmp_path, capsys, flag):
    name = flag.split()[0]
    assert name in refused(capsys, "twin", "make", "tiny", "--out", tmp_path / "twin", *flag.split())
    assert not (tmp_path / "twin").exists()
    (tmp_path / "file").touch()
    assert "is a file" in refused(capsys, "twin", "make", "tiny", "--out", tmp_path / "file")
