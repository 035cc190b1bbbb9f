"""Tables of poses as other programs write them, and those that nobody knows."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orthoswarm.model.camera import rotation_from_angles
from telemetry.formats.table.geo_txt import read_geo_txt
from telemetry.formats.table.pose_csv import read_pose_csv
from telemetry.ingest.ingest import load, survey
from telemetry.samples.rotations import camera_angles_from_opk_deg
from tests.telemetry.ingest.test_photos import jpeg

GEO_ROWS = {
    # columns as OpenDroneMap documents them, whatever follows
    "a.JPG 8.25 47.5 512.0 12 -89 1 0.02 0.03 label": (12.0, -89.0, 1.0, 0.02),
    "a.JPG 8.25 47.5 512.0 12 -89 1 0.02 0.03 7 8 9": (12.0, -89.0, 1.0, 0.02),
    "a.JPG 8.25 47.5 512.0 0 0 0 0.02 0.03 strip 4": (None, None, None, 0.02),
    "a.JPG 8.25 47.5 512.0 label": (None, None, None, None),
    "a.JPG\t8.25\t47.5\t512.0": (None, None, None, None),
}


@pytest.mark.parametrize("row", GEO_ROWS)
def test_geo_txt_is_read_from_the_left_and_ends_where_its_extras_begin(tmp_path, row):
    (tmp_path / "geo.txt").write_text(f"EPSG:4326\n{row}\n")
    (found,) = read_geo_txt(tmp_path / "geo.txt").values()
    assert (found.lat_deg, found.lon_deg, found.altitude_m) == pytest.approx((47.5, 8.25, 512.0))
    assert (found.yaw_deg, found.pitch_deg, found.roll_deg, found.sigma_m) == GEO_ROWS[row]


@pytest.mark.parametrize("name", ["IMG 12 34.JPG", "DJI_0001.JPG", "7.jpg"])
def test_names_in_geo_txt_may_hold_blanks_and_numbers(tmp_path, name):
    (tmp_path / "geo.txt").write_text(f"EPSG:4326\n{name} 8.25 47.5 512.0 1 2 3 0.1 0.2 99\n")
    assert list(read_geo_txt(tmp_path / "geo.txt")) == [name.lower()]


# program: (file, text, latitude, longitude, altitude, yaw, pitch, roll, sigma)
TABLES = {
    "wingtrahub": (
        "geotags.csv",
        "image name,latitude [decimal degrees],longitude [decimal degrees],altitude [meter],yaw [degrees],"
        "pitch [degrees],roll [degrees],accuracy horizontal [meter],accuracy vertical [meter]\n"
        "a.JPG,47.5,8.25,612.5,31.0,2.5,-1.0,0.02,0.04\n",
        (47.5, 8.25, 612.5, 31.0, -87.5, -1.0, 0.02),
    ),
    "pix4d, geolocation": (
        "pix4d.csv", "a.JPG,47.5,8.25,612.5,0.02,0.04\n", (47.5, 8.25, 612.5, None, None, None, 0.02)
    ),
    "pix4dmatic": (
        "pix4d.txt", "a.JPG,47.5,8.25,612.5,38.6,3.5,8.3,0.02,0.04\n", (47.5, 8.25, 612.5, 38.6, -86.5, 8.3, 0.02)
    ),
    "metashape, reference": (
        "reference.txt",
        "#CoordinateSystem: EPSG:4326\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll,Error_(m)\n"
        "a.JPG,8.25,47.5,612.5,120.0,1.0,-2.0,0.5\n",
        (47.5, 8.25, 612.5, 120.0, -89.0, -2.0, None),
    ),
    "metashape, projected": (
        "reference.csv",
        "#CoordinateSystem: EPSG:32632\n#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll\n"
        "a.JPG,443515.066,5261002.307,612.5,120.0,1.0,-2.0\n",
        (47.5, 8.25, 612.5, 120.0, -89.0, -2.0, None),
    ),
    "metashape, omega phi kappa": (
        "cameras.txt",
        "# Cameras (1)\n# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, r12, r13, r21, r22, r23, r31, r32, r33\n"
        "a\t8.25\t47.5\t612.5\t0.0\t0.0\t-31.0\t1\t0\t0\t0\t1\t0\t0\t0\t1\n",
        (47.5, 8.25, 612.5, 31.0, -90.0, 0.0, None),
    ),
    "exiftool": (
        "exif.csv",
        "SourceFile,DateTimeOriginal,GPSLatitude,GPSLongitude,GPSAltitude,GimbalYawDegree,GimbalPitchDegree,"
        "GimbalRollDegree,RelativeAltitude\n"
        './a.JPG,2024:05:06 12:00:01,"47 deg 30\' 0.00"" N","8 deg 15\' 0.00"" E",612.5 m Above Sea Level,31,-44,0,8\n',
        (47.5, 8.25, 612.5, 31.0, -44.0, 0.0, None),
    ),
    "mission planner": (
        "location.txt",
        "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt\na.JPG 47.5 8.25 612.5 31 2 -1 0\n",
        (47.5, 8.25, 612.5, 31.0, -88.0, -1.0, None),
    ),
    "pix4d, calibrated": (
        "x_calibrated_external_camera_parameters_wgs84.txt",
        "imageName latitude longitude altitude Omega Phi Kappa\na.JPG 47.5 8.25 612.5 0.0 0.0 -31.0\n",
        (47.5, 8.25, 612.5, 31.0, -90.0, 0.0, None),
    ),
}  # fmt: skip


@pytest.mark.parametrize("program", TABLES)
def test_tables_of_other_programs_are_recognised_by_their_headers(tmp_path, program):
    name, text, expected = TABLES[program]
    jpeg(tmp_path / "a.JPG")
    (tmp_path / name).write_text(text)
    (row,) = read_pose_csv(tmp_path / name).values()
    found = (row.lat_deg, row.lon_deg, row.altitude_m, row.yaw_deg, row.pitch_deg, row.roll_deg, row.sigma_m)
    assert found == pytest.approx(expected, abs=2e-6)
    (frame,) = load([tmp_path]).frames
    assert frame.fix.lat_deg == pytest.approx(47.5, abs=2e-6)


def test_coordinates_without_a_projection_are_named_and_a_prj_beside_them_is_read(tmp_path):
    jpeg(tmp_path / "a.JPG")
    table = tmp_path / "x_calibrated_external_camera_parameters.txt"
    table.write_text("imageName X Y Z Omega Phi Kappa\na.JPG 443515.066 5261002.307 612.5 0.0 0.0 -31.0\n")
    (finding,) = [f for f in survey([tmp_path]).findings if f.code == "table-unreadable"]
    assert "projection" in finding.message
    (tmp_path / "x_wkt.prj").write_text("EPSG:32632")
    (frame,) = load([tmp_path]).frames
    assert (frame.fix.lat_deg, frame.fix.lon_deg) == pytest.approx((47.5, 8.25), abs=1e-6)


def test_a_table_of_pictures_that_nobody_knows_is_named_and_a_warning_where_photos_have_no_position(tmp_path):
    jpeg(tmp_path / "a.JPG")
    (tmp_path / "notes.csv").write_text("photo;operator;battery\na.JPG;Ann;80\n")
    (finding,) = [f for f in survey([tmp_path]).findings if f.code == "table-unknown"]
    assert "notes.csv" in finding.message and not finding.note
    (tmp_path / "geo.txt").write_text("EPSG:4326\na.JPG 8.25 47.5\n")
    (finding,) = [f for f in survey([tmp_path]).findings if f.code == "table-unknown"]
    assert finding.note


@pytest.mark.parametrize(
    ("system", "place", "words"),
    [
        ("EPSG:4326", "47.5 128.25", "exchanged"),
        ("EPSG:32632", "5261002.307 443515.066", "exchanged"),
        ("EPSG:2193", "443515.066 5261002.307", "far from where 'EPSG:2193' is used"),
        ("EPSG:32632", "443515.066 5261002.307", ""),
    ],
)
def test_coordinates_beside_the_area_of_their_system_are_told(tmp_path, system, place, words):
    jpeg(tmp_path / "a.JPG")
    (tmp_path / "geo.txt").write_text(f"{system}\na.JPG {place} 90\n")
    warnings = load([tmp_path]).warnings
    assert any(words in warning for warning in warnings) if words else not any("geo.txt" in w for w in warnings)


def test_heights_of_a_vertical_system_in_feet_are_metres(tmp_path):
    (tmp_path / "geo.txt").write_text("EPSG:32632+6360\na.JPG 443515.066 5261002.307 1000\n")
    assert read_geo_txt(tmp_path / "geo.txt")["a.jpg"].altitude_m == pytest.approx(304.8006)


def test_titles_and_decimal_commas_of_other_languages_are_read(tmp_path):
    (tmp_path / "a.csv").write_text("Bild;Breite;L\u00e4nge;H\u00f6he\na.JPG;47,5;8,25;250,5\n", encoding="cp1252")
    table = read_pose_csv(tmp_path / "a.csv")
    assert (table["a.jpg"].place, table["a.jpg"].altitude_m) == ((47.5, 8.25), 250.5)


@given(st.floats(-179, 179), st.floats(-160, -20), st.floats(-30, 30))
def test_omega_phi_kappa_is_the_same_rotation_as_ours(yaw, pitch, roll):
    rotation = rotation_from_angles(*np.radians([yaw, pitch, roll])) @ np.diag([1.0, -1.0, -1.0])
    phi = math.asin(rotation[0, 2])
    omega = math.atan2(-rotation[1, 2], rotation[2, 2])
    kappa = math.atan2(-rotation[0, 1], rotation[0, 0])
    found = camera_angles_from_opk_deg(*np.degrees([omega, phi, kappa]))
    assert rotation_from_angles(*np.radians(found)) == pytest.approx(
        rotation_from_angles(*np.radians([yaw, pitch, roll])), abs=1e-9
    )


@pytest.mark.parametrize("written", ["nan", "inf", "-1e400", "1e400"])
def test_a_time_that_cannot_be_one_is_left_out(tmp_path, written):
    (tmp_path / "poses.csv").write_text(f"image,time,lat_deg,lon_deg\na.jpg,{written},47.5,8.25\n")
    (row,) = read_pose_csv(tmp_path / "poses.csv").values()
    assert row.time_s is None
    assert row.lat_deg == 47.5


def test_positions_of_an_ellipsoid_without_a_datum_are_not_used_and_a_weak_datum_is_told(tmp_path):
    jpeg(tmp_path / "a.jpg")
    geo = tmp_path / "geo.txt"
    geo.write_text("+proj=longlat +ellps=bessel +no_defs\na.jpg 8.25 47.5 512\n")
    assert any("but no datum" in warning for warning in load([tmp_path]).warnings)
    geo.write_text("EPSG:4314\na.jpg 8.25 47.5 512\n")  # DHDN
    assert any("to 3 m only" in warning for warning in load([tmp_path]).warnings)
