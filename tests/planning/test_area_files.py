"""Areas from every kind of file that people have them in."""

import io
import json
import zipfile

import numpy as np
import pyogrio
import pytest
import shapely

from gcs_plugin.web.areas import area_of
from orthoswarm.model.errors import InputError

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


@pytest.mark.parametrize("kind", ["geojson", "kml", "kmz", "gpkg", "zip", "plan"])
def test_the_same_area_comes_out_of_every_kind_of_file(tmp_path, kind):
    if kind == "gpkg":
        data = written(tmp_path, "area.gpkg", "EPSG:2056", "GPKG").read_bytes()
    elif kind == "zip":
        shape = written(tmp_path, "area.shp", "EPSG:32632", "ESRI Shapefile")
        parts = {f"inner/{p.name}": p.read_bytes() for p in shape.parent.glob("area.*")}
        data = zipped(**parts)
    else:
        data = {"geojson": GEOJSON, "kml": KML, "kmz": zipped(doc__kml=KML), "plan": PLAN}[kind]
    found = area_of(data, f"area.{kind}")
    rings = [*found["polygons"][0], *found["no_fly"]]
    assert len(found["polygons"]) == 1 and len(rings) == 2
    for ring, wanted in zip(rings, (RING, HOLE), strict=True):
        assert ring[0] == ring[-1]
        assert shapely.hausdorff_distance(shapely.Polygon(ring), shapely.Polygon(wanted)) < 1e-7


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.zip", zipped(readme__txt=b"x"), "without a KML or a shapefile"),
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


def test_a_shapefile_without_its_coordinate_system_is_refused(tmp_path):
    shape = written(tmp_path, "area.shp", "EPSG:32632", "ESRI Shapefile")
    parts = {p.name: p.read_bytes() for p in shape.parent.glob("area.*") if p.suffix != ".prj"}
    with pytest.raises(InputError, match="does not say its coordinate system"):
        area_of(zipped(**parts), "area.zip")
