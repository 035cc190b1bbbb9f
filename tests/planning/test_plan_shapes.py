import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from orthoswarm.model.errors import InputError
from orthoswarm.planning.area.area import coarser, make_area
from orthoswarm.planning.area.shape_files import Polygon, parse_geojson, parse_kml
from orthoswarm.planning.lines.line_spacing import footprint
from orthoswarm.planning.planner import plan_area
from tests.kit.plan_checks import on_globe

SQUARE = [[9.0, 47.0], [9.01, 47.0], [9.01, 47.01], [9.0, 47.01], [9.0, 47.0]]
HOLE = [[9.004, 47.004], [9.004, 47.006], [9.006, 47.006], [9.006, 47.004], [9.004, 47.004]]


def test_geojson_of_any_nesting_gives_its_polygons_and_lines():
    import json

    line = {"type": "LineString", "coordinates": [[9, 47, 100], [9.1, 47, 100]]}
    polygon = {"type": "Polygon", "coordinates": [SQUARE, HOLE]}
    multi = {"type": "MultiPolygon", "coordinates": [[SQUARE], [HOLE]]}
    features = [
        {"type": "Feature", "properties": None, "geometry": polygon},
        {"type": "Feature", "properties": {}, "geometry": None},
        {"type": "Feature", "geometry": {"type": "GeometryCollection", "geometries": [line, multi]}},
    ]
    shapes = parse_geojson(json.dumps({"type": "FeatureCollection", "features": features}))
    assert [len(p.holes) for p in shapes.polygons] == [1, 0, 0]
    assert shapes.polygons[0].shell.tolist() == [[lat, lon] for lon, lat in SQUARE[:-1]]
    assert shapes.lines[0].tolist() == [[47.0, 9.0], [47.0, 9.1]]


def test_kml_gives_outlines_holes_and_lines():
    def text(ring):
        return " ".join(f"{x},{y},0" for x, y in ring)

    def boundary(kind, ring):
        return f"<{kind}><LinearRing><coordinates>\n{text(ring)}\n</coordinates></LinearRing></{kind}>"

    kml = (
        '<?xml version="1.0" encoding="UTF-8"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><Polygon>'
        + boundary("outerBoundaryIs", SQUARE)
        + boundary("innerBoundaryIs", HOLE)
        + "</Polygon></Placemark><Placemark><LineString><coordinates>9,47 9.1,47</coordinates></LineString></Placemark>"
        "</Document></kml>"
    )
    shapes = parse_kml(kml.encode())
    assert len(shapes.polygons) == 1 and len(shapes.polygons[0].holes) == 1
    assert shapes.polygons[0].shell[1].tolist() == [47.0, 9.01]
    assert shapes.lines[0].tolist() == [[47.0, 9.0], [47.0, 9.1]]


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"type": "Polygon"}',
        '{"type": "Polygon", "coordinates": [[["a", "b"]]]}',
        '{"type": "Polygon", "coordinates": [[[9, 47], [9, 47], [9, 47]]]}',
        '{"type": "Polygon", "coordinates": [[[500000, 5300000], [500100, 5300000], [500000, 5300100]]]}',
        '{"type": "Polygon", "coordinates": [[[9, 47], [9, NaN], [9.1, 47]]]}',
        '{"type": "FeatureCollection"}',
        '{"type": "Polygon", "crs": {"properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}, "coordinates": []}',
    ],
)
def test_broken_geojson_is_refused_in_one_sentence(text):
    with pytest.raises(InputError) as error:
        parse_geojson(text, "area.geojson")
    assert "area.geojson" in str(error.value) and "\n" not in str(error.value)


@settings(deadline=None)
@given(st.text(max_size=200) | st.binary(max_size=200).map(lambda b: b.decode("latin-1")))
def test_any_text_is_read_or_refused(text):
    for parse in (parse_geojson, parse_kml):
        try:
            parse(text)
        except InputError as error:
            assert str(error)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["type", "coordinates", "x"]), inner),
    max_leaves=12,
)


@settings(deadline=None)
@given(
    st.sampled_from(["Polygon", "MultiPolygon", "LineString", "Feature", "FeatureCollection", "GeometryCollection"]),
    st.sampled_from(["coordinates", "geometry", "features", "geometries"]),
    json_values,
)
def test_any_json_is_read_or_refused(kind, key, value):
    import json

    try:
        parse_geojson(json.dumps({"type": kind, key: value}))
    except InputError as error:
        assert str(error)


def test_holes_and_further_zones_are_taken_out_and_kept_as_no_fly():
    area = make_area(
        [on_globe([(0, 0), (100, 0), (100, 100), (0, 100)], [[(40, 40), (60, 40), (60, 60), (40, 60)]])],
        [on_globe([(-10, -10), (10, -10), (10, 10), (-10, 10)]).shell],
    )
    assert area.size_m2 == pytest.approx(100 * 100 - 400 - 100, rel=1e-3)
    assert area.no_fly.area == pytest.approx(800, rel=1e-3)


def test_a_hole_wins_over_a_polygon_that_overlaps_it():
    ring = on_globe([(0, 0), (100, 0), (100, 100), (0, 100)], [[(40, 40), (60, 40), (60, 60), (40, 60)]])
    area = make_area([ring, on_globe([(50, 50), (150, 50), (150, 90), (50, 90)])])
    assert area.no_fly.area == pytest.approx(400, rel=1e-3)
    assert area.ground.intersection(area.no_fly).area == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("shell", "holes", "word"),
    [
        ([(0, 0), (100, 100), (100, 0), (0, 100)], [], "crosses"),
        ([(0, 0), (100, 0), (50, 0)], [], "no area"),
        ([(0, 0), (0.5, 0), (0.5, 0.5), (0, 0.5)], [], "no area"),
        ([(0, 0), (100, 0), (100, 0.1), (0, 0.1)], [], "no area"),
        ([(0, 0), (100, 0), (100, 100), (0, 100)], [[(200, 0), (210, 0), (210, 10)]], "hole"),
        ([(0, 0), (100, 0), (100, 100), (0, 100)], [[(10, 10), (60, 60), (60, 10), (10, 60)]], "crosses"),
    ],
)
def test_impossible_polygons_are_refused(shell, holes, word):
    with pytest.raises(InputError, match=word):
        make_area([on_globe(shell, holes)])


def test_points_on_a_parallel_have_no_area():
    ring = np.array([[47.0, 9.0], [47.0, 9.1], [47.0, 9.2]])
    with pytest.raises(InputError, match="no area"):
        make_area([Polygon(ring)])


def test_a_polygon_within_a_hole_cannot_be_reached():
    island = on_globe([(45, 45), (55, 45), (55, 55), (45, 55)])
    around = on_globe([(0, 0), (100, 0), (100, 100), (0, 100)], [[(40, 40), (60, 40), (60, 60), (40, 60)]])
    with pytest.raises(InputError, match="polygon 2 lies inside a no-fly zone"):
        make_area([around, island])


def test_a_hole_outside_and_an_outline_that_crosses_itself_are_told_apart():
    square = [(0, 0), (600, 0), (600, 500), (0, 500)]
    with pytest.raises(InputError, match="move the hole inside"):
        make_area([on_globe(square, [[(700, 100), (800, 100), (800, 200)]])])
    with pytest.raises(InputError, match="redraw its outline"):
        make_area([on_globe([(0, 0), (600, 500), (600, 0), (0, 500)])])
    with pytest.raises(InputError, match="redraw its outline"):
        make_area([on_globe(square, [[(100, 100), (300, 300), (300, 100), (100, 300)]])])


def ragged(count, seed=0):
    """An area with a zone, whose outlines are ragged by half a metre: shell and hole in metres."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(count) / count
    radius = 300.0 + 60.0 * np.sin(3.0 * angle) + rng.normal(0.0, 0.5, count)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return ring, 0.25 * ring[:: max(1, count // 400)]


def test_a_very_fine_outline_gets_coarser_but_never_smaller():
    shell, hole = ragged(6000)
    area = make_area([on_globe(shell, [hole])])
    outline = coarser(area, 2.0)
    assert shapely.get_num_coordinates(outline) < 0.2 * shapely.get_num_coordinates(area.ground)
    assert shapely.difference(area.ground, outline).area < 1e-3
    assert shapely.difference(outline, shapely.buffer(area.ground, 4.0)).area < 1e-3
    assert shapely.intersection(outline, area.no_fly).area < 1e-3


def test_the_outline_of_an_ordinary_area_stays_as_it_is():
    shell, hole = ragged(1200)
    area = make_area([on_globe(shell, [hole])])
    assert coarser(area, 2.0) is area.ground


def test_a_very_fine_outline_is_covered_as_it_was_drawn():
    shell, hole = ragged(6000, seed=1)
    area = make_area([on_globe(shell, [hole])])
    plan = plan_area(area, 3, 60.0, footprint(60.0, np.radians(60.0)))
    assert plan.covered_share >= 0.999 and plan.area_m2 == pytest.approx(area.size_m2)
