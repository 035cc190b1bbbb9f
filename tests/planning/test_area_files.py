"""Areas from every kind of file that people have them in."""

import asyncio
import io
import json
import sqlite3
import zipfile

import numpy as np
import pyogrio
import pytest
import shapely
from fastapi import Request

from gcs_plugin.cli.main import main
from gcs_plugin.plans.area_files import read_zones
from gcs_plugin.web.uploads import area_of, read_area
from orthoswarm.model.errors import InputError
from orthoswarm.planning.area.area import make_area
from orthoswarm.planning.area.shape_files import MOST_CORNERS, Polygon, parse_geojson

RING = [[8.544, 47.397], [8.547, 47.397], [8.547, 47.399], [8.544, 47.399], [8.544, 47.397]]
HOLE = [[8.545, 47.3975], [8.546, 47.3975], [8.546, 47.398], [8.545, 47.3975]]
GEOJSON = json.dumps({"type": "Polygon", "coordinates": [RING, HOLE]}).encode()


def rings_of(ring):
    return " ".join(f"{lon},{lat},0" for lon, lat in ring)


KML = f"""<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><Polygon>
<outerBoundaryIs><LinearRing><coordinates>{rings_of(RING)}</coordinates></LinearRing></outerBoundaryIs>
<innerBoundaryIs><LinearRing><coordinates>{rings_of(HOLE)}</coordinates></LinearRing></innerBoundaryIs>
</Polygon></Placemark></kml>""".encode()
FENCE = {"polygons": [{"inclusion": False, "polygon": [[lat, lon] for lon, lat in HOLE[:-1]]}], "circles": []}
SURVEY = {"complexItemType": "survey", "type": "ComplexItem", "polygon": [[lat, lon] for lon, lat in RING[:-1]],
          "TransectStyleComplexItem": {"Items": []}}  # fmt: skip
PLAN = json.dumps(
    {"fileType": "Plan", "geoFence": FENCE, "mission": {"items": [SURVEY], "plannedHomePosition": [47.397, 8.544, 500]}}
).encode()


def zipped(**files):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in files.items():
            archive.writestr(name.replace("__", "."), data)
    return out.getvalue()


def written(folder, name, crs, driver):
    """A vector file that GDAL writes, with the polygon in a coordinate system."""
    from pyproj import Transformer

    turn = Transformer.from_crs(4326, crs, always_xy=True)
    polygon = shapely.transform(shapely.Polygon(RING, [HOLE]), lambda p: np.column_stack(turn.transform(*p.T)))
    path = folder / name
    values = [np.array(["a"], dtype=object)]
    pyogrio.raw.write(
        path, shapely.to_wkb(np.array([polygon])), values, ["name"], geometry_type="Polygon", crs=crs, driver=driver
    )
    return path


@pytest.mark.parametrize("kind", ["geojson", "kml", "kmz", "gpkg", "zip", "plan", "kmz.zip", "json.zip"])
def test_the_same_area_comes_out_of_every_kind_of_file(tmp_path, kind):
    if kind == "gpkg":
        data = written(tmp_path, "area.gpkg", "EPSG:2056", "GPKG").read_bytes()
    elif kind == "zip":
        shape = written(tmp_path, "area.shp", "EPSG:32632", "ESRI Shapefile")
        parts = {f"inner\\{p.name}": p.read_bytes() for p in shape.parent.glob("area.*")}
        data = zipped(**parts)
    else:
        data = {"geojson": GEOJSON, "kml": KML, "kmz": zipped(doc__kml=KML), "plan": PLAN,
                "kmz.zip": zipped(doc__kml=KML), "json.zip": zipped(a__json=GEOJSON)}[kind]  # fmt: skip
    found = area_of(data, f"area.{kind}")
    rings = [*found["polygons"][0], *found["no_fly"]]
    assert len(found["polygons"]) == 1 and len(rings) == 2
    for ring, wanted in zip(rings, (RING, HOLE), strict=True):
        assert ring[0] == ring[-1]
        assert shapely.hausdorff_distance(shapely.Polygon(ring), shapely.Polygon(wanted)) < 1e-7


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.zip", zipped(readme__txt=b"x"), "without a KML, a GeoJSON or a shapefile"),
        ("a.zip", GEOJSON, "by its name but holds GeoJSON"),
        ("a.zip", b"PK\x03\x04 broken", "damaged ZIP"),
        ("a.shp", b"\x00\x00\x27\x0a" + bytes(96), "one ZIP"),
        ("a.gpkg", b"SQLite format 3\0" + bytes(500), "damaged or incomplete"),
        ("a.zip", zipped(a__shp=b"\x00\x00\x27\x0a" + bytes(96)), "damaged or incomplete"),
        ("a.xyz", b"\xff\xfe\x00", "not a text file"),
        ("../../etc/passwd", b"root", "holds neither"),
        ("a.geojson", b"", "holds neither"),
    ],
)
def test_a_file_of_no_use_is_refused_in_one_sentence_that_names_it(name, data, words):
    with pytest.raises(InputError, match=words) as refused:
        area_of(data, name)
    assert str(refused.value).startswith(name)
    assert "/tmp" not in str(refused.value)


def test_a_table_without_shapes_in_a_geopackage_is_passed_over_and_sizes_are_read(tmp_path):
    path = tmp_path / "a.gpkg"
    point, line = shapely.Point(8.544, 47.397), shapely.LineString(RING[:2])
    for shape, kind, field, size in ((point, "Point", "RADIUS_M", 100.0), (line, "LineString", "width_m", 50.0)):
        pyogrio.raw.write(path, np.array([shapely.to_wkb(shape)], object), [np.array([size])], [field], layer=kind,
                          geometry_type=kind, crs="EPSG:4326", driver="GPKG", append=path.exists())  # fmt: skip
    with sqlite3.connect(path) as file:
        file.execute("CREATE TABLE layer_styles (id INTEGER PRIMARY KEY, style TEXT)")  # as QGIS keeps them
        file.execute("INSERT INTO gpkg_contents (table_name, data_type) VALUES ('layer_styles', 'attributes')")
    found = area_of(path.read_bytes(), "a.gpkg")
    assert not found["unused"] and not found["lines"]
    circle, strip = sorted(make_area([Polygon(np.array(ring)[:-1, ::-1])]).size_m2 for [ring] in found["polygons"])[
        ::-1
    ]
    assert circle == pytest.approx(np.pi * 100.0**2, rel=0.02)
    assert strip == pytest.approx(50.0 * 226.0 + np.pi * 25.0**2, rel=0.02)


def test_a_shapefile_without_its_coordinate_system_is_refused(tmp_path):
    shape = written(tmp_path, "area.shp", "EPSG:32632", "ESRI Shapefile")
    parts = {p.name: p.read_bytes() for p in shape.parent.glob("area.*") if p.suffix != ".prj"}
    with pytest.raises(InputError, match="does not say its coordinate system"):
        area_of(zipped(**parts), "area.zip")


def circle(corners, east_deg=0.0):
    turn = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    points = np.column_stack([8.5 + east_deg + 0.01 * np.cos(turn), 47.4 + 0.01 * np.sin(turn)])
    return json.dumps({"type": "Polygon", "coordinates": [[*points.tolist(), points[0].tolist()]]}).encode()


def test_an_outline_with_too_many_corners_is_refused_before_it_is_compared_with_itself():
    most = MOST_CORNERS
    assert len(area_of(circle(most), "a.geojson")["polygons"][0][0]) == most + 1
    with pytest.raises(InputError, match=rf"a.geojson has {most + 1} corners; simplify it to at most {most}"):
        area_of(circle(most + 1), "a.geojson")


def test_areas_and_zones_that_are_used_together_are_counted_together():
    half = MOST_CORNERS // 2 + 1
    one, other = (parse_geojson(circle(half, east)).polygons[0] for east in (0.0, 0.1))
    assert make_area([one]).size_m2 > 0
    with pytest.raises(InputError, match=r"the area with its no-fly zones has \d+ corners"):
        make_area([one], [other.shell])


def test_polygons_nested_in_polygons_are_read_once_each():
    """Read again at every depth, this file of a megabyte would take half an hour."""
    ring = b"<LinearRing><coordinates>8,47 9,47 9,48</coordinates></LinearRing>"
    shape = b"<Polygon><outerBoundaryIs>" + ring + b"</outerBoundaryIs>"
    assert len(area_of(b"<kml>" + shape * 10_000 + b"</Polygon>" * 10_000 + b"</kml>", "a.kml")["polygons"]) == 10_000


def test_of_many_polygons_the_one_in_a_zone_is_named():
    places = np.stack(np.meshgrid(np.arange(30), np.arange(30)), -1).reshape(-1, 2) * 0.001 + [47.4, 8.5]
    corners = np.array([[0, 0], [0, 4e-4], [4e-4, 4e-4], [4e-4, 0]])
    polygons = [Polygon(place + corners) for place in places]
    assert make_area(polygons, [places[400] + 0.5 * corners]).ground.geom_type == "MultiPolygon"
    with pytest.raises(InputError, match="polygon 401 lies inside a no-fly zone"):
        make_area(polygons, [places[400] + 2.0 * corners - 2e-4])


def posted(data):
    """The answer to an area file that is posted."""

    async def receive():
        return {"type": "http.request", "body": data, "more_body": False}

    scope = {"type": "http", "method": "POST", "path": "/api/areas", "query_string": b"", "headers": []}
    return json.loads(asyncio.run(read_area(Request(scope, receive), "a.geojson")).body)


def test_a_large_file_is_read_in_another_process_so_that_the_server_answers_others(monkeypatch):
    def refuse(*_):
        raise InputError("this process reads no file")

    large = circle(20_000)
    wanted = area_of(large, "a.geojson")
    monkeypatch.setattr("gcs_plugin.web.uploads.read_shapes", refuse)
    assert posted(large) == wanted
    with pytest.raises(InputError, match="this process"):
        posted(circle(20))


def test_an_area_of_an_ellipsoid_without_a_datum_is_refused(tmp_path):
    path = written(tmp_path, "area.gpkg", "+proj=utm +zone=32 +ellps=bessel +units=m", "GPKG")
    with pytest.raises(InputError, match="no datum"):
        area_of(path.read_bytes(), "area.gpkg")


def test_an_old_datum_without_a_good_table_is_said_and_no_zone_is_made_of_it(tmp_path):
    path = written(tmp_path, "area.gpkg", "EPSG:31468", "GPKG")  # Germany's before ETRS89, to 3 m
    assert any("to 3 m only" in text for text in area_of(path.read_bytes(), "area.gpkg")["unused"])
    with pytest.raises(InputError, match="to 3 m only"):
        read_zones(path)
    assert main(["plan", str(path), "--vehicles", "1", "--altitude", "60", "--fov-min", "60", "--json", "--out",
                 str(tmp_path / "o")]) == 0  # fmt: skip
    assert "to 3 m only" in (tmp_path / "o" / "plan.json").read_text()
