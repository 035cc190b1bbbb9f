"""Every shape of an area or no-fly file is used or named: circles, strips, points, what is hidden, what others left."""

import json
import zipfile

import numpy as np
import pytest
import shapely

from gcs_plugin.plans.area_files import read_shapes, read_zones
from gcs_plugin.plans.plan_files import read_planned_flight, write_plan
from gcs_plugin.plans.plan_request import PlanRequest, make_plan
from orthoswarm.model.errors import InputError
from orthoswarm.planning.area.area import make_area
from tests.vehicles.autopilots.test_twin_camera import small_area

CENTRE = {"type": "Point", "coordinates": [8.5, 47.4]}
ZONES = {
    "ED-318": {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": {},
                "geometry": {
                    "type": "GeometryCollection",
                    "geometries": [
                        {"type": "Point", "coordinates": [8.5, 47.4], "extent": {"subType": "Circle", "radius": 150.0}}
                    ],
                },
            }
        ],
    },
    "ED-269": {
        "title": "zones",
        "features": [
            {
                "identifier": "X1",
                "geometry": [
                    {
                        "uomDimensions": "M",
                        "lowerLimit": 0,
                        "upperLimit": 120,
                        "horizontalProjection": {"type": "Circle", "center": [8.5, 47.4], "radius": 150.0},
                    }
                ],
            }
        ],
    },
    "ED-269 in feet": {
        "features": [
            {
                "identifier": "X1",
                "geometry": [
                    {
                        "uomDimensions": "FT",
                        "horizontalProjection": {"type": "Circle", "center": [8.5, 47.4], "radius": 150.0 / 0.3048},
                    }
                ],
            }
        ]
    },
    "a radius": {
        "type": "Feature",
        "properties": {"radius": 150},
        "geometry": {"type": "Point", "coordinates": [8.5, 47.4]},
    },
}


@pytest.mark.parametrize("kind", ZONES)
def test_a_circular_zone_is_flown_around_and_becomes_a_fence(tmp_path, kind):
    (tmp_path / "area.json").write_text(json.dumps(small_area(47.4, 8.5, north_m=600.0, east_m=600.0)))
    (tmp_path / "zones.json").write_text(json.dumps(ZONES[kind]))
    request = PlanRequest(
        area=tmp_path / "area.json", vehicles=1, altitude_m=60.0, fov_min_deg=60.0, no_fly=[tmp_path / "zones.json"]
    )
    plan, area = make_plan(request)
    zone = shapely.Point(area.grid.to_grid(47.4, 8.5)).buffer(150.0)
    flown = np.array([(p.lat_deg, p.lon_deg) for s in plan.vehicles[0].sorties for p in s.waypoints])
    assert shapely.LineString(area.grid.to_grid(*flown.T)).distance(zone) > 9.0  # receivers err by so much
    [fence] = plan.fences
    assert not fence.inclusion and fence.radius_m == pytest.approx(150.0) and fence.points == ((47.4, 8.5),)


LINE = {"type": "LineString", "coordinates": [[8.4, 47.4], [8.6, 47.4]]}
POLYGON = {"type": "Polygon", "coordinates": [[[9.0, 48.0], [9.1, 48.0], [9.1, 48.1], [9.0, 48.0]]]}
KML = "<kml><Placemark><{0}><coordinates>8.5,47.4 8.6,47.5</coordinates></{0}></Placemark>{1}</kml>"
KML_POLYGON = (
    "<Placemark>{}<Polygon><outerBoundaryIs><LinearRing><coordinates>9,48 9.1,48 9.1,48.1</coordinates></LinearRing>"
    "</outerBoundaryIs></Polygon></Placemark>"
)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("z.json", json.dumps({"type": "GeometryCollection", "geometries": [POLYGON, CENTRE]}), "a point"),
        ("z.json", json.dumps({"type": "GeometryCollection", "geometries": [POLYGON, LINE, LINE]}), "holds 2 lines,"),
        ("z.json", json.dumps({"type": "Feature", "properties": {}, "geometry": None}), "a feature without a shape"),
        ("z.kml", KML.format("Point", KML_POLYGON.format("")), "a point"),
        ("z.kml", KML.format("LineString", KML_POLYGON.format("")), "a line"),
    ],
)
def test_a_no_fly_file_of_which_anything_is_not_understood_is_refused(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words):
        read_zones(tmp_path / name)


def test_a_line_with_a_width_is_a_strip(tmp_path):
    (tmp_path / "z.json").write_text(json.dumps({"type": "Feature", "properties": {"width_m": 40}, "geometry": LINE}))
    [strip] = read_zones(tmp_path / "z.json")[0].polygons
    area = make_area([strip])
    assert area.size_m2 == pytest.approx(40.0 * 15_080.0, rel=0.02)


def test_what_is_switched_off_is_not_flown_but_kept_out_of(tmp_path):
    (tmp_path / "z.kml").write_text(f"<kml><Folder>{KML_POLYGON.format('<visibility>0</visibility>')}</Folder></kml>")
    shapes, _ = read_shapes(tmp_path / "z.kml")
    assert not shapes.areas and shapes.left == ("a polygon switched off in the file",)
    assert len(read_zones(tmp_path / "z.kml")[0].polygons) == 1


@pytest.mark.parametrize("encoding", ["iso-8859-1", "utf-16", "utf-8-sig"])
def test_kml_is_read_in_the_encoding_that_it_declares(tmp_path, encoding):
    declared = encoding.removesuffix("-sig")
    text = f'<?xml version="1.0" encoding="{declared}"?><kml><Placemark><name>Fl\u00e4che</name></Placemark>'
    (tmp_path / "a.kml").write_bytes((text + KML_POLYGON.format("") + "</kml>").encode(encoding))
    assert len(read_shapes(tmp_path / "a.kml")[0].polygons) == 1


def test_elements_of_an_undeclared_name_space_are_passed_over(tmp_path):
    more = '<gx:Tour gx:a="1"><name>x</name></gx:Tour>'
    (tmp_path / "a.kml").write_text(f'<?xml version="1.0"?><kml>{more}{KML_POLYGON.format("")}</kml>')
    assert len(read_shapes(tmp_path / "a.kml")[0].polygons) == 1


def test_twins_that_macos_adds_to_an_archive_are_passed_over(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.kmz", "w") as archive:
        archive.writestr("__MACOSX/._doc.kml", b"\x00\x05\x16\x07")
        archive.writestr("doc.kml", f"<kml>{KML_POLYGON.format('')}</kml>")
    assert len(read_shapes(tmp_path / "a.kmz")[0].polygons) == 1


def test_a_plan_across_the_date_line_is_cut_there(tmp_path):
    ring = [[179.998, -16.8], [180.002, -16.8], [180.002, -16.797], [179.998, -16.797], [179.998, -16.8]]
    (tmp_path / "a.json").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    request = PlanRequest(area=tmp_path / "a.json", vehicles=1, altitude_m=60.0, fov_min_deg=60.0)
    plan, area = make_plan(request)
    write_plan(tmp_path / "out", plan, area, request, picture=False)
    features = json.loads((tmp_path / "out" / "all.geojson").read_text())["features"]
    for feature in features:
        shape = shapely.geometry.shape(feature["geometry"])
        assert max(part.bounds[2] - part.bounds[0] for part in getattr(shape, "geoms", [shape])) < 0.01
    assert sum(f["properties"].get("kind") == "area" for f in features) == 2
    legs = read_planned_flight(tmp_path / "out", area.grid).legs
    assert np.linalg.norm(legs[:, 1] - legs[:, 0], axis=1).max() < 500.0
