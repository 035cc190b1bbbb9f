"""How a cell of a table of poses may be written: read as a whole, or left out and counted."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from telemetry.formats.table.geo_txt import is_geo_txt, read_geo_txt
from telemetry.formats.table.pose_csv import read_pose_csv
from telemetry.formats.table.pose_table import decoded
from telemetry.ingest.ingest import survey
from tests.telemetry.ingest.test_photos import jpeg


def table(folder, text):
    (folder / "poses.csv").write_text(text, encoding="utf-8")
    return read_pose_csv(folder / "poses.csv")


def only_row(folder, text):
    (row,) = table(folder, text).values()
    return row


def decimal(value):
    return f"{value:.9f}"


def with_letter(value, letters, form):
    return f"{form(abs(value))} {letters[value < 0.0]}"


def minutes(value, separators):
    whole = int(value)
    return f"{whole}{separators[0]}{(value - whole) * 60.0:.7f}{separators[1]}"


def seconds(value, separators):
    whole = int(value)
    rest = (value - whole) * 60.0
    return f"{whole}{separators[0]}{int(rest)}{separators[1]}{(rest - int(rest)) * 60.0:.5f}{separators[2]}"


FORMS = {
    "decimal": decimal,
    "degree mark": lambda v: f"{v:.9f}°",
    "exiftool": lambda v: seconds(v, (" deg ", "' ", '"')),
    "exiftool, minutes": lambda v: minutes(v, (" deg ", "'")),
    "marks": lambda v: seconds(v, ("°", "'", '"')),
    "typeset": lambda v: seconds(v, ("°\u00a0", "\u2032", "\u2033")),
    "marks, minutes": lambda v: minutes(v, ("° ", "'")),
    "blanks": lambda v: seconds(v, (" ", " ", "")),
    "blanks, minutes": lambda v: minutes(v, (" ", "")),
    "colons": lambda v: seconds(v, (":", ":", "")),
}


@pytest.mark.parametrize("form", FORMS)
@given(lat=st.floats(-89.9, 89.9), lon=st.floats(-179.9, 179.9), comma=st.booleans(), place=st.integers(0, 3))
@settings(max_examples=30, deadline=None)
def test_every_form_of_a_coordinate_is_read_to_its_last_digit(tmp_path_factory, form, lat, lon, comma, place):
    write = FORMS[form]
    texts = {
        0: [("-" if v < 0.0 else "") + write(abs(v)) for v in (lat, lon)],
        1: [with_letter(lat, "NS", write), with_letter(lon, "EW", write)],
        2: ["NS"[lat < 0.0] + write(abs(lat)), "EW"[lon < 0.0] + write(abs(lon))],
        3: [with_letter(lat, ("North", "south"), write), with_letter(lon, ("East", "west"), write)],
    }[place]
    if comma:
        texts = [text.replace(".", ",") for text in texts]
    row = only_row(tmp_path_factory.mktemp("t"), f"image;latitude;longitude\na.JPG;{texts[0]};{texts[1]}\n")
    if max(abs(lat), abs(lon)) > 1e-5:  # 0, 0 is no position
        assert (row.lat_deg, row.lon_deg) == pytest.approx((lat, lon), abs=1e-7)


@given(
    value=st.floats(1.0, 89.0).map(decimal),
    rest=st.tuples(
        st.text("0123456789 .'°", max_size=3), st.sampled_from("x%?/*W,_"), st.text("0123456789 NS", max_size=3)
    ),
)
@settings(max_examples=200, deadline=None)
def test_a_cell_is_left_out_and_counted_if_only_its_beginning_is_understood(tmp_path_factory, value, rest):
    cell = value + "".join(rest)
    found = table(tmp_path_factory.mktemp("t"), f"image\tlat_deg\tlon_deg\taltitude_m\na.JPG\t{cell}\t8.25\t{cell}\n")
    (row,) = found.values()
    assert (row.lat_deg, row.altitude_m) == (None, None)
    assert (found.useless, found.refused) == (1, 2)


@pytest.mark.parametrize(
    "cell",
    [
        "47,512345",
        "1.047,5",
        "47.5x",
        "47.5 30",
        "47 61 0",
        "47 30 61",
        "47.5 E",
        "-47.5 N",
        "N 47.5 S",
        "47.5 O",
    ],
)
def test_a_latitude_that_is_not_understood_leaves_its_line_out(tmp_path, cell):
    jpeg(tmp_path / "a.JPG")
    found = table(tmp_path, f'image,latitude,longitude\na.JPG,"{cell}",8.25\n')
    (row,) = found.values()
    assert row.lat_deg is None
    assert (found.useless, found.refused, found.first_refused) == (1, 1, cell)
    findings = {f.code: f.message for source in survey([tmp_path]).sources for f in source.findings}
    assert f"'{cell}'" in findings["table-cells"]
    assert "table-lines" in findings


def test_decimal_commas_of_metashape_are_read(tmp_path):
    text = "#Label;X/Longitude;Y/Latitude;Z/Altitude;Yaw\na.JPG;8,251234;47,512345;612,5;31,5\n"
    row = only_row(tmp_path, text)
    assert (row.lat_deg, row.lon_deg, row.altitude_m, row.yaw_deg) == (47.512345, 8.251234, 612.5, 31.5)


def test_decimal_commas_of_pix4d_are_read_without_a_header(tmp_path):
    row = only_row(tmp_path, "a.JPG;47,512345;8,251234;612,5\n")
    assert (row.lat_deg, row.lon_deg, row.altitude_m) == (47.512345, 8.251234, 612.5)


def test_a_comma_beside_points_may_divide_thousands_and_is_not_guessed(tmp_path):
    found = table(tmp_path, "image;lat_deg;lon_deg;altitude_m\na.JPG;47.5;8.25;2,000\n")
    (row,) = found.values()
    assert (row.lat_deg, row.altitude_m, found.refused, found.first_refused) == (47.5, None, 1, "2,000")


def test_a_line_whose_numbers_the_separator_divides_is_left_out(tmp_path):
    found = table(tmp_path, "image,lat_deg,lon_deg\na.JPG,47,5,8,25\nb.JPG,47.5,8.25,,\n")
    assert list(found) == ["b.jpg"]
    assert found.useless == 1
    blanks = table(tmp_path, "image latitude longitude\na.JPG 47 30 44.44 N 8 15 4.44 E\nmy photo.JPG 47.5 8.25\n")
    assert blanks["my photo.jpg"].lat_deg == 47.5
    assert len(blanks) == blanks.useless == 1


@pytest.mark.parametrize(("south", "west"), [("South", "West"), ("S", "W"), ("s", "west")])
@pytest.mark.parametrize("sign", ["", "-"])
def test_columns_with_the_hemispheres_are_read(tmp_path, south, west, sign):
    header = "SourceFile,GPSLatitudeRef,GPSLatitude,GPSLongitude,GPSLongitudeRef"
    row = only_row(tmp_path, f"{header}\na.JPG,{south},{sign}33.912345,{sign}70.651234,{west}\n")
    assert (row.lat_deg, row.lon_deg) == (-33.912345, -70.651234)
    row = only_row(tmp_path, f"{header}\na.JPG,North,33.912345,70.651234,East\n")
    assert (row.lat_deg, row.lon_deg) == (33.912345, 70.651234)
    long = "S" * 65
    found = table(tmp_path, f"{header}\na.JPG,{long},33.912345,70.651234,East\n")
    assert (found["a.jpg"].lat_deg, found.refused) == (33.912345, 1)


@pytest.mark.parametrize(
    ("columns", "cells", "expected", "reported"),
    [
        ("GPSLatitude,GPSLatitudeRef", "47.5,Unknown ()", {"lat_deg": 47.5}, "Unknown ()"),
        ("GPSLatitude,GPSLatitudeRef", "47.5,0", {"lat_deg": 47.5}, "0"),
        ("GPSLatitude,GPSLatitudeRef", "47.5,E", {"lat_deg": 47.5}, "E"),
        ("GPSLatitude,GPSLatitudeRef", "-47.5,N", {"lat_deg": -47.5}, "N beside -47.5"),
        ("GPSLatitude,GPSAltitude,GPSAltitudeRef", "47.5,500,Unknown (5)", {"altitude_m": 500.0}, "Unknown (5)"),
        ("GPSLatitude,GPSAltitude,GPSAltitudeRef", "47.5,500,0.0", {"altitude_m": 500.0}, ""),
        ("GPSLatitude,GPSAltitude,GPSAltitudeRef", "47.5,12,1.0", {"altitude_m": -12.0}, ""),
        ("GPSLatitude,GPSAltitude,GPSAltitudeRef", "47.5,500,Above", {"altitude_m": 500.0}, ""),
        ("GPSLatitude,GPSAltitude,GPSAltitudeRef", "47.5,12,below", {"altitude_m": -12.0}, ""),
    ],
)
def test_a_reference_that_is_not_understood_is_reported_and_the_value_kept(
    tmp_path, columns, cells, expected, reported
):
    jpeg(tmp_path / "a.JPG")
    found = table(tmp_path, f"SourceFile,GPSLongitude,{columns}\na.JPG,8.25,{cells}\n")
    (row,) = found.values()
    assert {name: getattr(row, name) for name in expected} == expected
    assert (found.useless, found.refused, found.first_refused) == (0, int(bool(reported)), reported)
    findings = {f.code: f.message for source in survey([tmp_path]).sources for f in source.findings}
    assert (f"'{reported}'" in findings["table-cells"]) if reported else "table-cells" not in findings


@pytest.mark.parametrize(
    ("titles", "cells", "name", "value"),
    [
        ("alt_ft,alt_m", "1640,500", "altitude_m", 500.0),
        ("alt_m,alt_ft", "500,1640", "altitude_m", 500.0),
        ("altitude (ft),altitude (m)", "1640,500", "altitude_m", 500.0),
        ("alt_m,alt_ft", "500,", "altitude_m", 500.0),
        ("alt_m,alt_ft", ",1000", "altitude_m", 304.8),
        ("alt_ft,alt_m", "1000,n/a", "altitude_m", 304.8),
        ("yaw_rad,yaw_deg", "1.57,90", "yaw_deg", 90.0),
    ],
)
def test_a_unit_belongs_to_its_column_and_metres_and_degrees_are_preferred(tmp_path, titles, cells, name, value):
    row = only_row(tmp_path, f"image,lat,lon,{titles}\na.JPG,47.5,8.25,{cells}\n")
    assert getattr(row, name) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "altitude_m"),
    [
        ("image lat lon alt\na.JPG 47.5 8.25 500 # first\n", 500.0),
        ("image lat lon alt\na.JPG 47.5 8.25 500 7\n", 500.0),
        ("image\tlat\tlon\talt\na.JPG\t47.5\t8.25\t500\tgood\n", 500.0),
        ("image;lat;lon;alt\na.JPG;47,5;8,25;500;3\n", 500.0),
        ("image,lat,lon,alt\na.JPG,47.5,8.25,500,good\n", 500.0),
    ],
)
def test_cells_beyond_the_titles_are_ignored(tmp_path, text, altitude_m):
    row = only_row(tmp_path, text)
    assert (row.lat_deg, row.lon_deg, row.altitude_m) == (47.5, 8.25, altitude_m)


@pytest.mark.parametrize("zone", ["", "+02:00", " +0200", " Z"])
def test_a_date_and_its_time_between_blanks_are_one_cell(tmp_path, zone):
    shift = 7200.0 if "2" in zone else 0.0
    for titles, cells in (("lat lon alt time", "47.5 8.25 500 {}"), ("time lat lon alt", "{} 47.5 8.25 500")):
        row = only_row(tmp_path, f"image {titles}\na.JPG {cells.format('2024-05-01 10:00:00' + zone)}\n")
        assert (row.lat_deg, row.altitude_m, row.time_s) == (47.5, 500.0, 1714557600.0 - shift)


def test_only_the_tables_numbers_tell_whether_a_comma_is_their_decimal_mark(tmp_path):
    text = "image;lat;lon;alt;time\na.jpg;47,5;8,25;500,3;2024-05-01 10:00:00.5\n"
    row = only_row(tmp_path, text)
    assert (row.lat_deg, row.lon_deg, row.altitude_m, row.time_s) == (47.5, 8.25, 500.3, 1714557600.5)
    row = only_row(tmp_path, "image;lat;lon;alt;time\na.jpg;47.5;8.25;500.3;2024-05-01 10:00:00,5\n")
    assert (row.lat_deg, row.time_s) == (47.5, 1714557600.5)
    found = table(tmp_path, "image\tlat\tlon\talt\na.jpg\t47\t8\t1,500\nb.jpg\t47.5\t8.25\t1499.5\n")
    assert (found["a.jpg"].altitude_m, found.first_refused) == (None, "1,500")
    found = table(tmp_path, "image\tlat\tlon\talt\na.jpg\t47,5\t8,25\t1.047,5\n")
    assert (found["a.jpg"].lat_deg, found["a.jpg"].altitude_m, found.refused) == (47.5, None, 1)


@pytest.mark.parametrize(
    ("title", "cell", "metres"),
    [
        ("altitude (ft)", "2000", 609.6),
        ("altitude [feet]", "2000", 609.6),
        ("altitude_ft", "2000", 609.6),
        ("altitude (ft)", "609.6 m", 609.6),
        ("altitude (m)", "2000 ft", 609.6),
        ("altitude_m", "609.6", 609.6),
        ("GPSAltitude", "609.6 m Above Sea Level", 609.6),
        ("GPSAltitude", "12 m Below Sea Level", -12.0),
        ("GPSAltitude", "12 m Negative Sea Level (sea-level ref)", -12.0),
        ("altitude", "609.6 bananas", None),
        ("altitude", "2,000.5", None),
        ("altitude", "609.6.1", None),
    ],
)
def test_altitudes_are_read_in_the_unit_of_their_cell_or_title(tmp_path, title, cell, metres):
    found = table(tmp_path, f'image,latitude,longitude,{title}\na.JPG,47.5,8.25,"{cell}"\n')
    (row,) = found.values()
    assert row.altitude_m == (None if metres is None else pytest.approx(metres))
    assert (row.lat_deg, found.useless, found.refused) == (47.5, 0, int(metres is None))


@pytest.mark.parametrize(("ref", "metres"), [("0", 12.5), ("1", -12.5), ("3", -12.5), ("Below Sea Level", -12.5)])
def test_the_column_with_the_altitudes_sign_is_read(tmp_path, ref, metres):
    header = "SourceFile,GPSLatitude,GPSLongitude,GPSAltitudeRef,GPSAltitude"
    assert only_row(tmp_path, f"{header}\na.JPG,47.5,8.25,{ref},12.5 m\n").altitude_m == metres


@pytest.mark.parametrize("cell", ["", "-", "n/a", "NaN", "null"])
def test_a_cell_that_says_that_it_has_no_value_is_not_counted(tmp_path, cell):
    found = table(tmp_path, f"image,lat_deg,lon_deg,yaw_deg\na.JPG,47.5,8.25,{cell}\n")
    assert (found["a.jpg"].yaw_deg, found.refused) == (None, 0)


def test_angles_are_read_with_their_unit(tmp_path):
    row = only_row(tmp_path, "image,lat_deg,lon_deg,yaw (rad),pitch_deg,roll\na.JPG,47.5,8.25,0.5,-90.0 deg,1.5°\n")
    assert (row.yaw_deg, row.pitch_deg, row.roll_deg) == pytest.approx((28.6478898, -90.0, 1.5))


def test_the_larger_of_two_accuracies_counts(tmp_path):
    assert only_row(tmp_path, "image,lat,lon,accuracy_x/y\na.JPG,47.5,8.25,0.02/0.05\n").sigma_m == 0.05


@pytest.mark.parametrize(
    ("cell", "seconds"),
    [
        ("2024-05-06 12:00:00+02", 1714989600.0),
        ("2024-05-06T12:00:00.5Z", 1714996800.5),
        ("2024:05:06 12:00:00", 1714996800.0),
        ("1714996800.25", 1714996800.25),
        ("1714996800123", 1714996800.123),
        ("1714996800123456", 1714996800.123456),
        ("2024-05-06 12:00:00 CEST", None),
        ("noon", None),
    ],
)
def test_times_are_read_with_their_zone_and_in_any_unit_or_counted(tmp_path, cell, seconds):
    found = table(tmp_path, f"image,lat_deg,lon_deg,time\na.JPG,47.5,8.25,{cell}\n")
    assert found["a.jpg"].time_s == (None if seconds is None else pytest.approx(seconds, abs=1e-6))
    assert (found["a.jpg"].lat_deg, found.refused) == (47.5, int(seconds is None))


@pytest.mark.parametrize("cell", ["0", "0000:00:00 00:00:00"])
def test_a_time_of_zeros_is_none(tmp_path, cell):
    found = table(tmp_path, f"image,lat_deg,lon_deg,time\na.JPG,47.5,8.25,{cell}\n")
    assert (found["a.jpg"].time_s, found.refused) == (None, 0)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_a_table_is_read_in_the_encodings_that_programs_write(tmp_path, encoding):
    text = "image\tlat\tlon\talt\n" + "".join(f"Brücke_{k:02d}.jpg\t47.5\t8.5\t{500 + k}\n" for k in range(40))
    (tmp_path / "poses.csv").write_bytes(text.encode(encoding))
    assert {name: row.altitude_m for name, row in read_pose_csv(tmp_path / "poses.csv").items()} == {
        f"brücke_{k:02d}.jpg": 500.0 + k for k in range(40)
    }
    (tmp_path / "geo.txt").write_bytes("EPSG:4326\nBrücke_01.jpg 8.5 47.5 500\n".encode(encoding))
    assert is_geo_txt(tmp_path / "geo.txt")
    (name,) = read_geo_txt(tmp_path / "geo.txt")
    assert name == "brücke_01.jpg"


@given(text=st.text(max_size=40), cut=st.integers(0, 200))
def test_the_beginning_of_a_table_is_the_beginning_of_its_text(text, cut):
    text = text.replace("\0", "").replace("\ufeff", "")
    assert text.startswith(decoded(text.encode()[:cut]))
