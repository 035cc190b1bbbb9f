"""Every shape of an area or no-fly file is used or named: circles, strips, points, what is hidden, what others left."""

import json
import zipfile

import numpy as np
import pytest
import shapely

from gcs_plugin.plans.area_files import Reach, read_no_fly, read_shapes, read_zones
from gcs_plugin.plans.plan_files import geojson, read_planned_flight, write_plan
from gcs_plugin.plans.plan_request import PlanRequest, make_plan
from orthoswarm.model.errors import InputError
from orthoswarm.planning.area import shape_files
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
    "a radius with its unit": {"type": "Feature", "properties": {"Radius": "0.15 km"}, "geometry": CENTRE},
    "a radius and a unit": {"type": "Feature", "properties": {"radius": 0.15, "units": "KM"}, "geometry": CENTRE},
    "a list of zones": [
        {
            "identifier": "X1",
            "geometry": [
                {
                    "uomDimensions": "NM",
                    "horizontalProjection": {"type": "Circle", "center": [8.5, 47.4], "radius": 150.0 / 1852.0},
                }
            ],
        }
    ],
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
        ("z.json", json.dumps({"type": "Feature", "properties": {"radius": 0.1}, "geometry": CENTRE}), "of 0.1 m"),
        ("z.json", json.dumps({"type": "Feature", "properties": {"radius": "9 rods"}, "geometry": CENTRE}), "'rods'"),
        ("z.json", json.dumps({"type": "Polygon", "coordinates": []}), "a feature without a shape"),
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
    shapes, *_ = read_shapes(tmp_path / "z.kml")
    assert not shapes.areas and shapes.left == ("a polygon switched off in the file",)
    assert len(read_zones(tmp_path / "z.kml")[0].polygons) == 1


@pytest.mark.parametrize("encoding", ["iso-8859-1", "utf-16", "utf-8-sig"])
def test_kml_is_read_in_the_encoding_that_it_declares(tmp_path, encoding):
    declared = encoding.removesuffix("-sig")
    text = f'<?xml version="1.0" encoding="{declared}"?><kml><Placemark><name>Fl\u00e4che</name></Placemark>'
    (tmp_path / "a.kml").write_bytes((text + KML_POLYGON.format("") + "</kml>").encode(encoding))
    assert len(read_shapes(tmp_path / "a.kml")[0].polygons) == 1


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", ""),
        ("9,48 ", "9, 48\n"),
        ("<kml>", "<kml><name>M\u00fcller & S\u00f6hne&nbsp;</name>"),
        ("<kml>", "\n <kml>"),
        ("</kml>", "</kml>\0\0"),
        ("<kml>", '\n<?xml version="1.0"?><kml>'),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-16-le"])
def test_kml_is_read_as_people_write_it(tmp_path, before, after, encoding):
    text = f"<kml>{KML_POLYGON.format('')}</kml>".replace(before, after, 1)
    (tmp_path / "a.kml").write_bytes(text.encode(encoding))
    [polygon] = read_shapes(tmp_path / "a.kml")[0].polygons
    assert polygon.shell.tolist() == [[48.0, 9.0], [48.0, 9.1], [48.1, 9.1]]


def test_zones_with_latitude_and_longitude_exchanged_are_refused(tmp_path):
    ring = [[47.4, 8.5], [47.41, 8.5], [47.41, 8.51], [47.4, 8.5]]
    (tmp_path / "z.json").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    with pytest.raises(InputError, match="longitude are exchanged"):
        read_no_fly([tmp_path / "z.json"], np.array([[47.4, 8.5], [47.41, 8.51]]), None)


@pytest.mark.parametrize("gap_deg", [0.0, 1e-5])
def test_a_path_drawn_round_an_area_is_asked_about(tmp_path, gap_deg):
    path = [[8.5, 47.4], [8.51, 47.4], [8.51, 47.41], [8.5 + gap_deg, 47.4]]
    (tmp_path / "a.json").write_text(json.dumps({"type": "LineString", "coordinates": path}))
    plan, _ = make_plan(PlanRequest(area=tmp_path / "a.json", vehicles=1, altitude_m=60.0, fov_min_deg=60.0))
    assert any("draw a polygon" in warning for warning in plan.warnings)


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


def national(count: int, extra=()) -> dict:
    """An ED-269 file of a country: circles every 12 km, a fourth of them polygons of 80 corners."""
    zones = []
    for k in range(count):
        lat, lon = 45.0 + 0.11 * (k // 70), 4.0 + 0.15 * (k % 70)
        if k % 4:
            shape = {"type": "Circle", "center": [lon, lat], "radius": 500.0}
        else:
            turn = np.linspace(0.0, 2.0 * np.pi, 81)
            ring = np.column_stack([lon + 0.01 * np.cos(turn), lat + 0.01 * np.sin(turn)])
            ring[-1] = ring[0]
            shape = {"type": "Polygon", "coordinates": [ring.tolist()]}
        zones.append({"identifier": f"X{k}", "geometry": [{"uomDimensions": "M", "horizontalProjection": shape}]})
    return {"title": "a country", "features": [*zones, *extra]}


def test_of_a_national_file_the_zones_near_the_flights_are_used_and_the_others_counted(tmp_path, monkeypatch):
    (tmp_path / "area.json").write_text(json.dumps(small_area(47.4, 8.5, north_m=600.0, east_m=600.0)))
    document = national(3000, ZONES["ED-269"]["features"])
    (tmp_path / "zones.json").write_text(json.dumps(document))
    parsed = []
    read = shape_files.parse_geojson
    monkeypatch.setattr(shape_files, "parse_geojson", lambda *a, **k: parsed.append(a[1]) or read(*a, **k))
    request = PlanRequest(
        area=tmp_path / "area.json", vehicles=1, altitude_m=60.0, fov_min_deg=60.0, no_fly=[tmp_path / "zones.json"]
    )
    plan, area = make_plan(request)
    assert len(parsed) == 2  # each file once
    assert any(fence.points == ((47.4, 8.5),) for fence in plan.fences) and len(plan.fences) < 5
    [note] = [w for w in plan.warnings if "zones.json" in w]
    assert f"{3001 - len(plan.fences)} zones far from the flights" in note
    zone = shapely.Point(area.grid.to_grid(47.4, 8.5)).buffer(150.0)
    flown = np.array([(p.lat_deg, p.lon_deg) for s in plan.vehicles[0].sorties for p in s.waypoints])
    assert shapely.LineString(area.grid.to_grid(*flown.T)).distance(zone) > 9.0
    [drawn] = [f for f in json.loads(geojson(plan, area))["features"] if f["properties"]["kind"] == "no-fly zone"][:1]
    assert drawn["properties"]["circles_wider_m"] == 10.0


def test_zones_beside_the_date_line_and_around_it_are_near(tmp_path):
    reach = Reach(np.array([[-16.8, 179.998], [-16.797, -179.998]]))
    across = np.array([[-16.8, 179.99], [-16.8, -179.99], [-16.79, -179.99]])
    assert reach.touches(across) and reach.touches(np.array([[-16.8, -179.96]]))
    assert not reach.touches(np.array([[-16.8, -179.9]])) and reach.touches(np.array([[-16.8, -179.9]]), 10_000.0)
    assert not Reach(np.array([[47.0, 8.0], [47.1, 8.1]])).touches(across)


def test_a_way_to_where_zones_were_not_used_is_refused(tmp_path):
    (tmp_path / "area.json").write_text(json.dumps(small_area(47.4, 8.5, north_m=300.0, east_m=300.0)))
    (tmp_path / "zones.json").write_text(json.dumps(national(500, ZONES["ED-269"]["features"])))
    request = PlanRequest(area=tmp_path / "area.json", vehicles=1, altitude_m=60.0, fov_min_deg=60.0)
    plan, _ = make_plan(request)
    flown = np.array([[48.4, 8.5], [48.41, 8.51]])
    with pytest.raises(InputError, match="farther than the zones that were used"):
        read_no_fly([tmp_path / "zones.json"], flown, None).refuse_beyond(plan)
    near = np.array([[47.4, 8.5], [47.41, 8.51]])
    read_no_fly([tmp_path / "zones.json"], near, None).refuse_beyond(plan)


def test_aixm_is_named_with_what_to_do(tmp_path):
    text = '<message:AIXMBasicMessage xmlns:message="http://www.aixm.aero/schema/5.1.1/message"/>'
    (tmp_path / "zones.xml").write_text(text)
    with pytest.raises(InputError, match=r"is AIXM.*convert them"):
        read_zones(tmp_path / "zones.xml")


def test_openair_is_named_with_what_to_do(tmp_path):
    (tmp_path / "zones.txt").write_text("* Swiss zones\nAC R\nAN LS-R4\nAH FL130\nAL GND\nDP 47:23:00 N 008:32:00 E\n")
    with pytest.raises(InputError, match=r"is OpenAir.*ED-269"):
        read_zones(tmp_path / "zones.txt")


def test_a_hole_in_a_zone_is_not_flown_and_is_named(tmp_path):
    outer = np.array([[47.4, 8.5], [47.4, 8.51], [47.41, 8.51], [47.41, 8.5]])
    rings = [[[lon, lat] for lat, lon in ring] for ring in (outer, 0.5 * (outer + outer.mean(0)))]
    (tmp_path / "zones.json").write_text(json.dumps({"type": "Polygon", "coordinates": [[*r, r[0]] for r in rings]}))
    found = read_no_fly([tmp_path / "zones.json"], outer, None)
    assert len(found.rings) == 1 and len(found.rings[0]) == 4
    assert found.notes == ["a hole in zones of zones.json: not flown either"]
