"""Which picture a line of a table belongs to, where its paths are those of another place."""

import pytest

from telemetry.ingest.ingest import survey
from tests.telemetry.ingest.test_photos import jpeg

LATS = {"a": 47.1, "b": 47.2, "c": 47.3, "d": 47.4}


def placed(folder, pictures, names):
    """Latitudes of pictures by their names, and findings on the table, for a table that has these names."""
    for picture in pictures:
        (folder / picture).parent.mkdir(parents=True, exist_ok=True)
        jpeg(folder / picture)
    rows = "".join(f"{name},{lat},8.25\n" for name, lat in zip(names, LATS.values()))
    (folder / "exif.csv").write_text(f"SourceFile,GPSLatitude,GPSLongitude\n{rows}")
    found = survey([folder])
    codes = {f.code: f for source in found.sources for f in source.findings if f.code.startswith("table-")}
    return {frame.image: frame.fix.lat_deg for frame in found.frames()}, codes


@pytest.mark.parametrize(
    "start", ["photos/", "/home/u/photos/", "C:\\photos\\", "./photos/", "../photos/", "/Home/Ü b/"]
)
def test_paths_of_another_folder_or_machine_are_read_without_what_they_share(tmp_path, start):
    lats, findings = placed(tmp_path, ["a.JPG", "b.JPG"], [f"{start}a.JPG", f"{start}b.JPG"])
    assert lats == {"a.JPG": 47.1, "b.JPG": 47.2}
    assert list(findings) == ["table-folder"]
    assert findings["table-folder"].note


def test_folders_below_the_shared_one_tell_pictures_of_one_name_apart(tmp_path):
    pictures = ["f1/a.JPG", "f2/a.JPG", "f2/b.JPG"]
    lats, _ = placed(tmp_path, pictures, [f"/home/u/photos/{picture}" for picture in pictures])
    assert lats == {"f1/a.JPG": 47.1, "f2/a.JPG": 47.2, "f2/b.JPG": 47.3}


def test_a_folder_that_is_here_is_not_left_out(tmp_path):
    pictures = ["f1/a.JPG", "f1/b.JPG", "f2/a.JPG"]
    lats, _ = placed(tmp_path, pictures, ["/home/u/f1/a.JPG", "/home/u/f1/b.JPG"])
    assert lats == {"f1/a.JPG": 47.1, "f1/b.JPG": 47.2}


def test_one_line_is_enough(tmp_path):
    assert placed(tmp_path, ["a.JPG"], ["/home/u/photos/a.JPG"])[0] == {"a.JPG": 47.1}


def test_otherwise_lines_are_matched_by_names_that_one_picture_and_one_line_have(tmp_path):
    pictures = ["x/a.JPG", "x/b.JPG", "y/b.JPG", "y/c.JPG"]
    lats, findings = placed(tmp_path, pictures, ["/p/1/a.JPG", "/p/1/b.JPG", "/p/1/c.JPG", "/p/2/c.JPG"])
    assert lats == {"x/a.JPG": 47.1}
    assert "1 line " in findings["table-base-names"].message
    assert "3 lines" in findings["table-pictures"].message


def test_a_table_one_path_of_which_is_here_keeps_its_paths(tmp_path):
    lats, findings = placed(tmp_path, ["f1/a.JPG", "f2/b.JPG"], ["f1/a.JPG", "f1/b.JPG"])
    assert lats == {"f1/a.JPG": 47.1}
    assert list(findings) == ["table-pictures"]


def test_paths_in_a_geo_txt_are_matched_alike(tmp_path):
    jpeg(tmp_path / "a.JPG")
    (tmp_path / "geo.txt").write_text("EPSG:4326\nC:\\photos\\a.JPG 8.25 47.5\n")
    (frame,) = survey([tmp_path]).frames()
    assert frame.fix.lat_deg == 47.5


@pytest.mark.parametrize("away_deg", [0.001, 0.01])
def test_tables_that_contradict_each_other_are_told(tmp_path, away_deg):
    """500 m are more than any receiver errs by; the last table by name counts."""
    jpeg(tmp_path / "a.jpg")
    for name, lat in (("a.csv", 47.5), ("b.csv", 47.5 + away_deg)):
        (tmp_path / name).write_text(f"image,lat,lon,alt_m\na.jpg,{lat},8.25,500\n")
    found = survey([tmp_path])
    (frame,) = found.frames()
    assert frame.fix.lat_deg == pytest.approx(47.5 + away_deg)
    codes = [f.code for source in found.sources for f in source.findings]
    assert codes.count("positions-contradict") == (1 if away_deg == 0.01 else 0)
